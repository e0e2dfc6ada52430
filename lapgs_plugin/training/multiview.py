"""Densify by scores from several views: the idea of FastGS (Ren et al. 2025).

A gradient says that a Gaussian should move, but not whether the image is wrong there. For scores, some training views
are rendered, and for each Gaussian the pixels with large errors are counted that it makes up.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy.ops import duplicate, remove, split
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.training.densification import Densifier, ViewScores, add_gradients, required
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.strategies import Multiview

SCORED_VIEWS = 10
"""Views that are rendered for scores."""
HIGHEST_OPACITY = 0.8
"""Opacities are lowered to this at each refinement: nothing behind an opaque Gaussian gets a gradient."""
LATE_OPACITY = 0.1
"""After densification, Gaussians with a lower opacity are removed."""
LATE_BLAME = 0.9
"""After densification, Gaussians with a larger blame are removed."""


@dataclass(frozen=True)
class ScoredView:
    """Hold one view for `view_scores`.

    Attributes:
        grey: (3, h, w) image of the field with all colours zero and unclamped, differentiable by its SH coefficients.
        prediction: (3, h, w) composed image, without gradients; hooks do not change it.
        target: (3, h, w) the photo at the level's size, whatever the supervision.
        loss: scalar, of prediction and target.
    """

    grey: Tensor
    prediction: Tensor
    target: Tensor
    loss: Tensor


def large_errors(prediction: Tensor, target: Tensor, threshold: float) -> Tensor:
    """Return where (h, w) the error, a mean over channels, is above a share of its range in the image."""
    error = (prediction - target).abs().mean(0)
    least, largest = error.aminmax()
    return error - least > threshold * (largest - least)


def pixels_and_blame(views: Iterable[ScoredView], coefficients: Tensor, threshold: float) -> list[Tensor]:
    """Return sums (n,) over some views, with one backward pass for each: of `ViewScores.pixels`, and of the blame.

    Args:
        views: an iterator may render one after the other.
        coefficients: (n, 1, 3) of SH degree 0, zeros with gradients, that each `grey` was rendered from.
        threshold: see `large_errors`.
    """
    pixels = torch.zeros_like(coefficients[:, 0, 0], requires_grad=False)
    blame = torch.zeros_like(pixels)
    for view in views if len(coefficients) else ():  # density control may have removed all
        wrong = large_errors(view.prediction, view.target, threshold)
        # The weight of a Gaussian in a pixel is the derivative of that pixel by the Gaussian's colour.
        (by_coefficients,) = torch.autograd.grad((view.grey[0] * wrong).sum(), coefficients)
        made_up = by_coefficients[:, 0, 0] / SH_C0
        pixels += made_up
        blame += view.loss * made_up
    return [pixels, blame]


def view_scores(pixels: Tensor, blame: Tensor, count: int) -> ViewScores:
    """Return the scores of Gaussians by the sums of `pixels_and_blame` over so many views, at least one."""
    if len(pixels) == 0:
        return ViewScores(pixels, blame)
    least, largest = blame.aminmax()
    return ViewScores(pixels / count, (blame - least) / (largest - least).clamp_min(torch.finfo(blame.dtype).tiny))


class MultiviewDensifier(Densifier):
    """Densify by gradients where several views have large errors; arguments as `Densifier` takes them.

    Small Gaussians are cloned by their gradient and large ones split by their absolute gradient, both only where they
    make up enough pixels with large errors. After densification, faint and most harmful Gaussians are removed a few
    times.
    """

    def __init__(self, schedule: StageSchedule, options: Multiview, extent: float) -> None:
        super().__init__(schedule, options, extent)
        self._options = options
        self.state |= {"absgrad2d": None, "shown": None}

    def score_threshold(self, iteration: int) -> float | None:
        late = iteration in self._schedule.late_prunes
        return self._options.error_threshold if late or self._schedule.refines(iteration) else None

    def after_step(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None = None,
    ) -> bool:
        if iteration in self._schedule.late_prunes:
            assert scores is not None, "needed in this iteration"
            self._remove(model, (_opacities(model) < LATE_OPACITY) | (scores.blame > LATE_BLAME))
            return True
        return super().after_step(model, iteration, result, camera, scores)

    def accumulate(self, result: RenderResult, camera: Camera) -> None:
        """Add the statistics of absolute gradients, too; see `DensityControl`."""
        super().accumulate(result, camera)
        add_gradients(self.state, ("absgrad2d", "shown"), required(result.absgrad2d, "absgrad2d"), result, camera)

    @torch.no_grad()
    def _refine(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None,
    ) -> None:
        assert scores is not None, "needed in this iteration"
        if result is not None:
            self.accumulate(result, camera)
        state, extent = self.state, self.state["scene_scale"]
        times = state["count"].clamp_min(1)
        wanted = scores.pixels > self._options.error_pixels
        small = _sizes(model) <= self._strategy.grow_scale3d * extent
        clones = wanted & small & (state["grad2d"] / times > self._options.grow_grad2d)
        splits = wanted & ~small & (state["absgrad2d"] / times > self._options.split_absgrad2d)
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


def _sizes(model: TrainableField) -> Tensor:
    """Return (n,) the largest standard deviation of each Gaussian."""
    return torch.exp(model.params["scales"].detach()).amax(-1)


def _opacities(model: TrainableField) -> Tensor:
    """Return (n,) opacities."""
    return torch.sigmoid(model.params["opacities"].detach())
