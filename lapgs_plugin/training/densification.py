"""Declare density control, and provide 3DGS's heuristics by gsplat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.ops.densification_statistics import add_statistics
from lapgs_plugin.ops.mixed_sizes import Sizes, if_mixed, sizes_on_device
from lapgs_plugin.ops.regularization import add_regularization
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.strategies import USUAL_EXTENT, Gradients, Strategy


@dataclass(frozen=True)
class ViewScores:
    """Hold each Gaussian's part in the errors of some views.

    Attributes:
        pixels: (n,) pixels with large errors that it makes up: its weights alpha T there summed, mean over views.
        blame: (n,) the same with each view weighted by its loss, scaled to the range from 0 to 1.
    """

    pixels: Tensor
    blame: Tensor


class DensityControl:
    """Edit the field of one stage between iterations. Only `after_step` must be overridden.

    Args:
        opacity_weight, scale_weight: of the mean opacity, and of the mean standard deviation in world units, in the
            loss.

    Attributes:
        state: statistics it keeps between iterations, for checkpoints: numbers, or None for what becomes a tensor
            (n, ...) of one row a Gaussian, whose rows are edited with the field's. On several ranks they are sums over
            the views of all.
        ranks: that train the field. What is drawn or rounded at random has to be the same on all.
        share: of the field's Gaussians that `model` has, on a rank with some of them.
    """

    ranks: Ranks = ALONE
    share: float = 1.0

    def __init__(self, opacity_weight: float = 0.0, scale_weight: float = 0.0) -> None:
        self.state: dict[str, Any] = {}
        self._opacity_weight, self._scale_weight = opacity_weight, scale_weight

    def needs_statistics(self, iteration: int) -> bool:
        """Return whether `after_step` of that iteration needs more of a render than its image."""
        return False

    def score_threshold(self, iteration: int) -> float | None:
        """Return the threshold of `multiview.view_scores` if `after_step` of that iteration needs these scores."""
        return None

    def accumulate(self, result: RenderResult, camera: Camera) -> None:
        """Add the statistics of a render that is not the last one of a step.

        Args:
            result: after `backward()` by the sum of its views' losses; of several views, with a leading dimension.
            camera: it was rendered from, or the last of those cameras. Gradients are those of views of its size.
        """

    def after_step(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None = None,
    ) -> bool:
        """Accumulate the statistics of a step's last render and edit the field when the schedule says so.

        Args:
            model: edited in place; its parameters are new tensors afterwards if something changed.
            iteration: of the step's last view, from 1 within the stage.
            result, camera: as `accumulate` takes them. The result is None if that render's statistics are accumulated,
                as they are on several ranks, and may be where `needs_statistics` is false.
            scores: of the field before the edit; None where `score_threshold` is None.

        Returns:
            Whether Gaussians were added, removed or reset.

        Raises:
            UserInputError: a subclass does not override it.
        """
        raise UserInputError(
            f"density control {type(self).__qualname__} has no method after_step; it has to edit a field"
        )

    def regularize(self, model: TrainableField, iterations: range) -> None:
        """Add the gradients of terms of the loss that depend on the parameters alone, after a step's backward passes.

        Here they are those of the mean opacity and the mean size, which make unneeded Gaussians transparent and small.

        Args:
            model: whose parameters hold the gradients of the sum of the views' losses.
            iterations: of the step, from 1 within the stage, one for each view; the terms count for each.
        """
        weights = self.opacity_weight(model, iterations[-1]), self._scale_weight
        if any(weights):
            factor = len(iterations) * self.share  # the means are those of all ranks' Gaussians
            add_regularization(
                model.params["opacities"], model.params["scales"], *(factor * weight for weight in weights)
            )

    def opacity_weight(self, model: TrainableField, iteration: int) -> float:
        """Return the weight of the mean opacity of a model in the loss of an iteration."""
        return self._opacity_weight


def control_of(strategy: Strategy, schedule: StageSchedule, extent: float) -> DensityControl:
    """Return the density control that a strategy makes for a stage; arguments as `Strategy.density_control` takes them.

    Raises:
        UserInputError: it makes something else.
    """
    control: object = strategy.density_control(schedule, extent)
    if not isinstance(control, DensityControl):
        raise UserInputError(
            f"strategy {type(strategy).__qualname__}: density_control returned a {type(control).__name__}, expected a "
            "DensityControl"
        )
    return control


class Densifier(DensityControl):
    """Feed a rasterizer's statistics to gsplat's `DefaultStrategy`.

    Args:
        schedule: when the stage densifies and resets.
        options: thresholds.
        extent: scene extent in world units, which decides between cloning and splitting.
    """

    def __init__(self, schedule: StageSchedule, options: Gradients, extent: float) -> None:
        super().__init__(options.opacity_weight, options.scale_weight * USUAL_EXTENT / extent)
        self._schedule = schedule
        self._strategy = DefaultStrategy(
            grow_grad2d=options.grow_grad2d,
            refine_start_iter=schedule.densify_start,
            refine_stop_iter=schedule.densify_until,
            refine_every=schedule.densify_every,
            reset_every=schedule.reset_every,
            absgrad=options.absgrad,
        )
        self.state = self._strategy.initialize_state(scene_scale=extent)

    def needs_statistics(self, iteration: int) -> bool:
        return iteration < self._schedule.densify_until

    def after_step(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None = None,
    ) -> bool:
        if not self.needs_statistics(iteration):
            return False
        refined, reset = self._schedule.refines(iteration), iteration % self._schedule.reset_every == 0
        if refined:
            self._refine(model, iteration, result, camera, scores)
        elif result is not None:
            self.accumulate(result, camera)
        if reset:
            # gsplat 1.5.3 never resets (its test reads `== 0 & step > 0`); later versions do, and twice is as once.
            self._lower_opacities(model, self._strategy.prune_opa * 2.0)
        return refined or reset

    def _refine(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None,
    ) -> None:
        """Accumulate the statistics of a render, if there is one, and add and remove Gaussians by them."""
        info = _nothing_shown(model, camera) if result is None else self._info(result, camera)
        self._strategy.step_post_backward(model.params, model.optimizers, self.state, iteration, info)

    def _info(self, result: RenderResult, camera: Camera) -> dict[str, Any]:
        """Return a render as gsplat's strategies expect it."""
        n = result.means2d.shape[-2]
        return _info(result.means2d.detach(), self._gradient(result).view(-1, n, 2), result.radii, camera)

    def accumulate(self, result: RenderResult, camera: Camera) -> None:
        """Add to the statistics of gsplat's strategy; see `DensityControl`.

        It covers all Gaussians: gsplat selects visible ones, and the processor waits for a GPU to learn their number.
        """
        add_gradients(self.state, ("grad2d", "count"), self._gradient(result), result, camera)

    def _gradient(self, result: RenderResult) -> Tensor:
        """Return gradients by the centres on the image, (n, 2) or (b, n, 2), absolute if the options say so."""
        if self._strategy.absgrad:
            return required(result.absgrad2d, "absgrad2d")
        return required(result.means2d.grad, "means2d.grad")

    def _lower_opacities(self, model: TrainableField, highest: float) -> None:
        reset_opa(model.params, model.optimizers, self.state, value=highest)


def _info(means2d: Tensor, gradient: Tensor, radii: Tensor, camera: Camera) -> dict[str, Any]:
    """Return centres (b, n, 2), their gradients (b, n, 2) and radii (b, n) as gsplat's strategies expect them."""
    n = gradient.shape[-2]
    centres: Any = means2d.view(-1, n, 2)
    centres.grad = centres.absgrad = gradient
    return {
        "means2d": centres,
        "radii": radii.view(-1, n, 1).expand(-1, -1, 2),  # (b, n, 2)
        "width": camera.width,
        "height": camera.height,
        "n_cameras": 1,  # gsplat multiplies by it, for the mean of the views' losses; ours is their sum
        "gaussian_ids": None,
    }


def _nothing_shown(model: TrainableField, camera: Camera) -> dict[str, Any]:
    """Return a render that shows no Gaussian as gsplat's strategies expect it."""
    none = model.params["means"].detach().new_zeros(1, len(model), 2)
    return _info(none, torch.zeros_like(none), none[..., 0].int(), camera)


def add_gradients(
    state: dict[str, Any], names: tuple[str, str], gradient: Tensor, result: RenderResult, camera: Camera
) -> None:
    """Add the gradient norms of a render, and the views that show each Gaussian, to two statistics of a `state`.

    Args:
        state: of density control, edited in place.
        names: of the sum of norms and of the count of views, (n,) each; None before the first render.
        gradient: (n, 2) or (b, n, 2) by the centres on the image.
        result, camera: as `DensityControl.accumulate` takes them.
    """
    norms, counts = names
    if state[norms] is None:
        state[norms], state[counts] = (gradient.new_zeros(gradient.shape[-2]) for _ in range(2))
    add_statistics(gradient, result.radii, camera.size, state[norms], state[counts])


def scale_to_last(result: RenderResult, sizes: Sizes) -> None:
    """Scale the gradients by centres of a render of several views, in place, as if all were as large as the last.

    Density control measures them in halves of an image, and is given one camera of a render.

    Args:
        result: after its backward pass.
        sizes: of the views.
    """
    if if_mixed(sizes) is None:
        return
    own = sizes_on_device(sizes, result.radii.device)
    factors = (own / own[-1])[:, None]  # (b, 1, 2)
    for gradient in (result.means2d.grad, result.absgrad2d):
        if gradient is not None:
            gradient.mul_(factors)


def required(gradient: Tensor | None, source: str) -> Tensor:
    """Return a gradient of a `RenderResult`.

    Raises:
        UserInputError: the rasterizer left it empty.
    """
    if gradient is None:
        raise UserInputError(
            f"--strategy densifies by the RenderResult's {source}, which this rasterizer leaves empty; choose "
            "--strategy mcmc, which can do without, or another --rasterizer"
        )
    return gradient
