"""Scores from several views, which say where a Gaussian more or less would help: the idea of FastGS (Ren et al. 2025).

A gradient says that a Gaussian wants to move, in whatever view was last looked at. Whether the image is wrong there is
another question: some training views are rendered, their badly shown pixels are marked, and each Gaussian is asked how
many of these it makes up.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy.ops import duplicate, remove, reset_opa, split
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.inheritance import SH_C0
from lapgs_plugin.training.densification import Densifier, add_up, refines
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.settings import Densification, StageSchedule

SCORED_VIEWS = 10
"""Views that are rendered for scores."""
HIGHEST_OPACITY = 0.8
"""What opacities are taken back to at each refinement: nothing behind an opaque Gaussian gets a gradient."""
LATE_OPACITY, LATE_BLAME = 0.1, 0.9
"""Once densification has ended what is fainter than the first goes, and what has more than the second share of the
largest blame."""


@dataclass(frozen=True)
class ViewScores:
    """What some views say about each Gaussian.

    Attributes:
        pixels: (n,) badly shown pixels that it makes up, its weights alpha T summed, in the mean over the views.
        blame: (n,) the same, each view weighted with its loss, and all stretched to lie from 0 to 1.
    """

    pixels: Tensor
    blame: Tensor


@dataclass(frozen=True)
class ScoredView:
    """A view that is asked.

    Attributes:
        grey: (3, h, w) of the field with every colour zero and unclamped, differentiable by its coefficients.
        prediction: (3, h, w) what training compares with the target, without gradients.
        target: (3, h, w).
        loss: of the two, a scalar.
    """

    grey: Tensor
    prediction: Tensor
    target: Tensor
    loss: Tensor


def badly_shown(prediction: Tensor, target: Tensor, threshold: float) -> Tensor:
    """(h, w) where the mean difference of the channels is above a share of the way from the least to the largest."""
    error = (prediction - target).abs().mean(0)
    least, largest = error.aminmax()
    return error - least > threshold * (largest - least)


def view_scores(views: Iterable[ScoredView], coefficients: Tensor, threshold: float) -> ViewScores:
    """Ask some views, one backward pass each.

    Args:
        views: at least one, rendered one after the other.
        coefficients: (n, 1, 3) of the constant harmonic, zeros with gradients, that each `grey` was rendered from.
        threshold: see `badly_shown`.
    """
    pixels = torch.zeros_like(coefficients[:, 0, 0], requires_grad=False)
    blame, count = torch.zeros_like(pixels), 0
    for view in views:
        bad = badly_shown(view.prediction, view.target, threshold)
        # A weight is the derivative of a pixel by the Gaussian's colour.
        (by_coefficients,) = torch.autograd.grad((view.grey[0] * bad).sum(), coefficients)
        made_up = by_coefficients[:, 0, 0] / SH_C0
        pixels += made_up
        blame += view.loss * made_up
        count += 1
    least, largest = blame.aminmax()
    return ViewScores(pixels / count, (blame - least) / (largest - least).clamp_min(torch.finfo(blame.dtype).tiny))


class MultiviewDensifier(Densifier):
    """Density control of one stage by gradients and by scores of several views; arguments as `Densifier` takes them.

    Cloned are small Gaussians by their gradient, split large ones by their absolute gradient, both only where enough
    badly shown pixels are theirs. After densification those go, a few times, that are faint or do most harm.
    """

    def __init__(self, schedule: StageSchedule, settings: Densification, extent: float) -> None:
        super().__init__(schedule, settings, extent)
        self._settings = settings
        self._late = schedule.late_prunes
        self.state |= {"absgrad2d": None, "shown": None}

    def scored_at(self, iteration: int) -> bool:
        """See `DensityControl`."""
        if iteration in self._late:
            return True
        return iteration < self._schedule.densify_until and refines(self._schedule, iteration)

    def after_step(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None = None,
    ) -> bool:
        """See `DensityControl`."""
        if iteration in self._late:
            assert scores is not None, "asked for in this iteration"
            self._remove(model, (_opacities(model) < LATE_OPACITY) | (scores.blame > LATE_BLAME))
            return True
        if not self.needs_statistics(iteration):
            return False
        assert result is not None, "looked at in this iteration"
        self.accumulate(result, camera)
        refined, reset = refines(self._schedule, iteration), iteration % self._schedule.reset_every == 0
        if refined:
            assert scores is not None, "asked for in this iteration"
            self._refine(model, iteration, scores)
        if reset:
            self._lower_opacities(model, self._strategy.prune_opa * 2.0)
        return refined or reset

    def accumulate(self, result: RenderResult, camera: Camera) -> None:
        """See `DensityControl`; absolute gradients, too."""
        super().accumulate(result, camera)
        assert result.absgrad2d is not None, "a rasterizer without absolute gradients"
        if self.state["absgrad2d"] is None:
            self.state["absgrad2d"], self.state["shown"] = (torch.zeros_like(self.state["count"]) for _ in range(2))
        size = camera.width, camera.height
        add_up(result.absgrad2d, result.radii, size, self.state["absgrad2d"], self.state["shown"])

    @torch.no_grad()
    def _refine(self, model: TrainableField, iteration: int, scores: ViewScores) -> None:
        state, extent = self.state, self.state["scene_scale"]
        times = state["count"].clamp_min(1)
        wanted = scores.pixels > self._settings.error_pixels
        small = _sizes(model) <= self._strategy.grow_scale3d * extent
        clones = wanted & small & (state["grad2d"] / times > self._settings.grow_grad2d)
        splits = wanted & ~small & (state["absgrad2d"] / times > self._settings.split_absgrad2d)
        edited: dict[str, Any] = {"params": model.params, "optimizers": model.optimizers, "state": state}
        count = int(clones.sum())
        if count:
            duplicate(**edited, mask=clones)
            splits = torch.cat([splits, splits.new_zeros(count)])
        if splits.any():
            split(**edited, mask=splits)
        gone = _opacities(model) < self._strategy.prune_opa
        if iteration > self._schedule.reset_every:
            gone |= _sizes(model) > self._strategy.prune_scale3d * extent
        self._remove(model, gone)
        self._lower_opacities(model, HIGHEST_OPACITY)
        for value in state.values():
            if isinstance(value, Tensor):
                value.zero_()

    def _remove(self, model: TrainableField, gone: Tensor) -> None:
        if gone.any():
            remove(model.params, model.optimizers, self.state, gone)

    def _lower_opacities(self, model: TrainableField, highest: float) -> None:
        reset_opa(model.params, model.optimizers, self.state, value=highest)


def _sizes(model: TrainableField) -> Tensor:
    """(n,) the largest standard deviation of each Gaussian."""
    return torch.exp(model.params["scales"].detach()).amax(-1)


def _opacities(model: TrainableField) -> Tensor:
    """(n,)"""
    return torch.sigmoid(model.params["opacities"].detach())
