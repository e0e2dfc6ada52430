"""One stage: optimize one field against one level of the pyramid."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from gsplat.strategy.ops import remove
from torch import Tensor

from lapgs_plugin.breakdown import Breakdown, breakdown_on
from lapgs_plugin.errors import FieldError, TrainingDivergedError
from lapgs_plugin.field import GaussianField
from lapgs_plugin.hooks import HookDispatcher, StageContext
from lapgs_plugin.plan import Stage
from lapgs_plugin.pruning import blended_pixels, least_blended
from lapgs_plugin.raster import Rasterizer, RenderResult, render_image
from lapgs_plugin.rendering.raised_images import RaisedImages
from lapgs_plugin.supervision import photometric_loss
from lapgs_plugin.training.densification import DensityControl
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.multiview import SCORED_VIEWS, ScoredView, ViewScores, view_scores
from lapgs_plugin.training.settings import StageSchedule, TrainSettings
from lapgs_plugin.training.views import LevelImages, LevelView, view_index

FINITE_CHECK_EVERY = 100
"""Iterations between two looks at all parameters for NaN; the loss is looked at in every iteration."""
LOSSES_READ_EVERY = 50
"""The same for the loss on a GPU: every look waits until the GPU has caught up with the processor."""
LOSS_SMOOTHING = 0.95
"""Weight of the past in the loss that is shown and logged: single views differ too much to read a trend."""


@dataclass
class StageProgress:
    """What changes while a stage runs, besides the field: enough to go on with it later.

    Attributes:
        iteration: the last finished one, from 1 within the stage; 0 before the first.
        seconds: optimization time of this stage so far.
        loss: smoothed loss, NaN before the first iteration.
        peak_gaussians: most Gaussians optimized at once in this stage.
        gaussian_steps: Gaussians optimized, summed over the iterations.
    """

    iteration: int = 0
    seconds: float = 0.0
    loss: float = math.nan
    peak_gaussians: int = 0
    gaussian_steps: int = 0


@dataclass
class StageRun:
    """A stage being trained.

    Attributes:
        stage, schedule, settings: what is to be done.
        views: the training views at the stage's level.
        images: what they are compared with.
        accumulated: Up of the previous level's prediction by view name; None for the base.
        background: (3,) behind the base; residuals are rendered over zero.
        extent: scene extent in world units.
        model: the field, edited in place.
        densifier: density control with its statistics.
        joint_from: the iteration from which the finished fields are trained too; None when they never are.
        thaw: makes these fields trainable, from their state in a checkpoint or, given None, from the archive.
        joint: those fields while they are being trained; None before.
        breakdown: told which part of an iteration begins.

    The field, the images and the background are on one device, where the stage is trained.
    """

    stage: Stage
    schedule: StageSchedule
    settings: TrainSettings
    views: Sequence[LevelView]
    images: LevelImages
    accumulated: RaisedImages | None
    background: Tensor
    extent: float
    rasterizer: Rasterizer
    hooks: HookDispatcher
    model: TrainableField
    densifier: DensityControl
    joint_from: int | None = None
    thaw: Callable[[dict[int, dict[str, Any]] | None], JointFields] | None = None
    joint: JointFields | None = None
    breakdown: Breakdown = field(default_factory=Breakdown)
    progress: StageProgress = field(default_factory=StageProgress)
    _unread: list[Tensor] = field(default_factory=list)

    def run(self, after_iteration: Callable[[StageRun], None]) -> None:
        """Train from where `progress` stands to the end of the stage.

        Args:
            after_iteration: called after every iteration, outside the timed region; may raise to stop the run.

        Raises:
            TrainingDivergedError: the loss or a parameter became NaN or infinite.
        """
        while self.progress.iteration < self.stage.iterations:
            start = time.perf_counter()
            self.breakdown.mark("other")
            self._iterate(self.progress.iteration + 1)
            self.breakdown.pause()
            self.progress.seconds += time.perf_counter() - start
            self.progress.iteration += 1
            if len(self._unread) >= self._losses_at_once or self.progress.iteration == self.stage.iterations:
                self.settle()
            after_iteration(self)

    def settle(self) -> None:
        """Wait for a GPU to finish the iterations so far, on the stage's clock, and read their losses.

        Raises:
            TrainingDivergedError: one is NaN or infinite.
        """
        if not self._unread:
            return
        start = time.perf_counter()
        losses, self._unread = torch.stack(self._unread).tolist(), []
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.progress.seconds += time.perf_counter() - start
        for back, loss in zip(range(len(losses) - 1, -1, -1), losses, strict=True):
            self._note_loss(loss, self.progress.iteration - back)

    @property
    def num_optimized(self) -> int:
        """Gaussians under training: the stage's own, and those of finished fields that are trained along."""
        along = () if self.joint is None else self.joint.models.values()
        return len(self.model) + sum(len(model) for model in along)

    @property
    def _device(self) -> torch.device:
        return self.background.device

    @property
    def _losses_at_once(self) -> int:
        """How many losses wait to be read."""
        return LOSSES_READ_EVERY if self._device.type == "cuda" else 1

    def _iterate(self, iteration: int) -> None:
        if iteration == self.joint_from:
            assert self.thaw is not None, "a stage that trains finished fields can have them"
            self.joint = self.thaw(None)
        view = self._view(iteration)
        target, coarse_target = self.images.get(view.name)
        context = StageContext(
            stage=self.stage,
            iteration=iteration,
            view=view.name,
            target=target,
            accumulated=self._prediction(view),
            coarse_target=coarse_target,
        )
        self._announce_next(iteration)
        degree = self.schedule.active_sh_degree(iteration)
        self.progress.gaussian_steps += self.num_optimized
        self.hooks.before_render(context)
        self.breakdown.mark("forward")
        gaussians = self.model.field
        rendered, result = self._render(gaussians, view, iteration, degree)
        self.breakdown.mark("loss")
        image = self.hooks.compose(context, rendered)
        loss = self.hooks.loss(context, image)
        self._keep_loss(loss.detach(), iteration)
        regularization = self.densifier.regularization(gaussians)
        self.breakdown.mark("backward")
        (loss if regularization is None else loss + regularization).backward()  # type: ignore[no-untyped-call]  # torch's
        self.breakdown.mark("other")
        self.hooks.after_backward(context)
        self.breakdown.mark("optimizer")
        if self.schedule.steps(iteration):
            means_rate = self.schedule.means_learning_rate(iteration) * self.extent
            rest = self.schedule.sh_rest_factor_at(iteration)
            self.model.step(means_rate, (degree + 1) ** 2, rest)
            if self.joint is not None:
                self.joint.step(means_rate, rest)
        self.breakdown.mark("densification")
        self._densify(context, result, view)
        self.breakdown.mark("other")
        if iteration % FINITE_CHECK_EVERY == 0 or iteration == self.stage.iterations:
            self._require_finite(iteration)

    def _render(
        self, gaussians: GaussianField, view: LevelView, iteration: int, degree: int
    ) -> tuple[Tensor, RenderResult | None]:
        """The image, and what else is known of the render where somebody looks at it."""
        if self.densifier.looks_at(iteration):
            result = self.rasterizer(gaussians, view.camera, background=self.background, sh_degree=degree)
            return result.image, result
        return render_image(self.rasterizer, gaussians, view.camera, self.background, degree), None

    def _view(self, iteration: int) -> LevelView:
        return self.views[view_index(iteration, len(self.views), self.settings.seed, self.stage.level)]

    def _prediction(self, view: LevelView) -> Tensor | None:
        """What the finished levels predict for a view."""
        if self.joint is not None:
            self.breakdown.mark("forward")
            return self.joint.predict(view.name)
        return None if self.accumulated is None else self.accumulated.get(view.name)

    def _announce_next(self, iteration: int) -> None:
        """Let the next iteration's images come while this one renders."""
        if iteration == self.stage.iterations:
            return
        name = self._view(iteration + 1).name
        self.images.announce(name)
        if self.accumulated is not None and self.joint is None:
            self.accumulated.announce(name)

    def _densify(self, context: StageContext, result: RenderResult | None, view: LevelView) -> None:
        scores = self._scores(context.iteration) if self.densifier.scored_at(context.iteration) else None
        changed = self.densifier.after_step(self.model, context.iteration, result, view.camera, scores)
        if (share := self.settings.densification.prune) and context.iteration == self.schedule.prunes_after:
            self._prune(share)
            changed = True
        if changed:
            self.hooks.on_densify(context)
        self.progress.peak_gaussians = max(self.progress.peak_gaussians, self.num_optimized)

    def _scores(self, iteration: int) -> ViewScores:
        """What some training views say about each Gaussian; the same views whenever a run comes here."""
        place = (self.settings.seed * 1_000_003 + self.stage.level) * 1_000_003 + iteration
        chosen = torch.randperm(len(self.views), generator=torch.Generator().manual_seed(place % 2**63))
        degree, (plain, grey) = self.schedule.active_sh_degree(iteration), self._grey()

        def asked(view: LevelView) -> ScoredView:
            with torch.no_grad():
                field = self.model.field.detach()
                image = render_image(self.rasterizer, field, view.camera, self.background, degree)
                below, (target, _) = self._prediction(view), self.images.get(view.name)
                self.breakdown.mark("densification")
                whole = image if below is None else image + below
                loss = photometric_loss(whole, target, self.settings.ssim_weight)
            return ScoredView(
                render_image(self.rasterizer, plain, view.camera, self.background, 0), whole, target, loss
            )

        views = (asked(self.views[index]) for index in chosen[:SCORED_VIEWS].tolist())
        return view_scores(views, grey, self.settings.densification.error_threshold)

    def _grey(self) -> tuple[GaussianField, Tensor]:
        """The field with all colours zero, and the coefficients (n, 1, 3) that say so, with gradients."""
        seen = self.model.field.detach()
        grey = seen.sh.new_zeros(len(seen), 1, 3).requires_grad_()
        return replace(seen, sh=grey, signed=True), grey

    def _prune(self, share: float) -> None:
        """Remove what training views hardly see."""
        plain, grey = self._grey()
        images = (render_image(self.rasterizer, plain, view.camera, self.background, 0) for view in self.views)
        pixels = blended_pixels(images, grey)
        remove(self.model.params, self.model.optimizers, self.densifier.state, least_blended(pixels, share))

    def _keep_loss(self, loss: Tensor, iteration: int) -> None:
        """On a CPU read it at once, before a loss that is not finite does harm."""
        if self._losses_at_once == 1:
            self._note_loss(loss.item(), iteration)
        else:
            self._unread.append(loss)

    def _note_loss(self, loss: float, iteration: int) -> None:
        if not math.isfinite(loss):
            raise self._diverged(f"the loss is {loss}, expected a finite number", iteration)
        past = self.progress.loss
        self.progress.loss = loss if math.isnan(past) else LOSS_SMOOTHING * past + (1 - LOSS_SMOOTHING) * loss

    def _require_finite(self, iteration: int) -> None:
        try:
            self.model.field.detach().require_finite()
        except FieldError as error:
            raise self._diverged(str(error), iteration) from error

    def _diverged(self, what: str, iteration: int) -> TrainingDivergedError:
        return TrainingDivergedError(
            f"training diverged at level {self.stage.level}, iteration {iteration}: {what}; "
            "finished levels and the last checkpoint are kept, start again with other settings"
        )

    def state(self) -> dict[str, Any]:
        """Everything needed to continue this stage bit for bit, as plain tensors and numbers."""
        self.settle()
        on_gpu = self._device.type == "cuda"
        return {
            "level": self.stage.level,
            "progress": vars(self.progress),
            "breakdown": self.breakdown.seconds(),
            "model": self.model.state(),
            "densifier": self.densifier.state,
            "joint": None if self.joint is None else self.joint.state(),
            "random": torch.get_rng_state(),
            **({"random_gpu": torch.cuda.get_rng_state(self._device)} if on_gpu else {}),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned; the model must have been made from it already."""
        self.progress = StageProgress(**state["progress"])
        if self.breakdown.measures:
            # What was not measured from its first iteration on would be parts of another whole.
            spent = state.get("breakdown")
            self.breakdown = breakdown_on(self._device, spent) if spent else Breakdown()
        self.densifier.state = {
            name: value.to(self._device) if isinstance(value, Tensor) else value
            for name, value in state["densifier"].items()
        }
        if (joint := state.get("joint")) is not None:
            assert self.thaw is not None
            self.joint = self.thaw(joint)
        torch.set_rng_state(state["random"])
        if "random_gpu" in state:
            torch.cuda.set_rng_state(state["random_gpu"], self._device)
