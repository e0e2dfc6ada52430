"""One stage: optimize one field against one level of the pyramid."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import FieldError, TrainingDivergedError
from lapgs_plugin.hooks import HookDispatcher, StageContext
from lapgs_plugin.imagestore import ImageStore
from lapgs_plugin.plan import Stage
from lapgs_plugin.raster import Rasterizer, RenderResult
from lapgs_plugin.training.densification import Densifier
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.settings import StageSchedule, TrainSettings
from lapgs_plugin.training.views import LevelView, view_index

FINITE_CHECK_EVERY = 100
"""Iterations between two looks at all parameters for NaN; the loss is looked at in every iteration."""
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
    """

    iteration: int = 0
    seconds: float = 0.0
    loss: float = math.nan
    peak_gaussians: int = 0


@dataclass
class StageRun:
    """A stage being trained.

    Attributes:
        stage, schedule, settings: what is to be done.
        views: the training views at the stage's level.
        accumulated: Up of the previous level's prediction by view name; None for the base.
        background: (3,) behind the base; residuals are rendered over zero.
        extent: scene extent in world units.
        model: the field, edited in place.
        densifier: density control with its statistics.
    """

    stage: Stage
    schedule: StageSchedule
    settings: TrainSettings
    views: Sequence[LevelView]
    accumulated: ImageStore | None
    background: Tensor
    extent: float
    rasterizer: Rasterizer
    hooks: HookDispatcher
    model: TrainableField
    densifier: Densifier
    progress: StageProgress = field(default_factory=StageProgress)

    def run(self, after_iteration: Callable[[StageRun], None]) -> None:
        """Train from where `progress` stands to the end of the stage.

        Args:
            after_iteration: called after every iteration, outside the timed region; may raise to stop the run.

        Raises:
            TrainingDivergedError: the loss or a parameter became NaN or infinite.
        """
        while self.progress.iteration < self.stage.iterations:
            start = time.perf_counter()
            self._iterate(self.progress.iteration + 1)
            self.progress.seconds += time.perf_counter() - start
            self.progress.iteration += 1
            after_iteration(self)

    def _iterate(self, iteration: int) -> None:
        view = self._view(iteration)
        context = StageContext(
            stage=self.stage,
            iteration=iteration,
            view=view.name,
            target=view.target,
            accumulated=self._prediction(view, iteration),
            coarse_target=view.coarse_target,
        )
        degree = self.schedule.active_sh_degree(iteration)
        self.hooks.before_render(context)
        result = self.rasterizer(self.model.field, view.camera, background=self.background, sh_degree=degree)
        image = self.hooks.compose(context, result.image)
        loss = self.hooks.loss(context, image)
        self._note_loss(loss.item(), iteration)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it without annotations
        self.hooks.after_backward(context)
        self.model.step(self.schedule.means_learning_rate(iteration) * self.extent, (degree + 1) ** 2)
        self._densify(context, result, view)
        if iteration % FINITE_CHECK_EVERY == 0 or iteration == self.stage.iterations:
            self._require_finite(iteration)

    def _view(self, iteration: int) -> LevelView:
        return self.views[view_index(iteration, len(self.views), self.settings.seed, self.stage.level)]

    def _prediction(self, view: LevelView, iteration: int) -> Tensor | None:
        """What the finished levels predict for this iteration's view, while the next one's is on its way."""
        if self.accumulated is None:
            return None
        prediction = self.accumulated.get(view.name)
        if iteration < self.stage.iterations:
            self.accumulated.announce(self._view(iteration + 1).name)
        return prediction

    def _densify(self, context: StageContext, result: RenderResult, view: LevelView) -> None:
        size = (view.camera.width, view.camera.height)
        if self.densifier.after_step(self.model, context.iteration, result, size):
            self.hooks.on_densify(context)
        self.progress.peak_gaussians = max(self.progress.peak_gaussians, len(self.model))

    def _note_loss(self, loss: float, iteration: int) -> None:
        if not math.isfinite(loss):
            raise self._diverged(f"the loss is {loss}", iteration)
        past = self.progress.loss
        self.progress.loss = loss if math.isnan(past) else LOSS_SMOOTHING * past + (1 - LOSS_SMOOTHING) * loss

    def _require_finite(self, iteration: int) -> None:
        try:
            self.model.field.detach().require_finite()
        except FieldError as error:
            raise self._diverged(str(error), iteration) from error

    def _diverged(self, what: str, iteration: int) -> TrainingDivergedError:
        return TrainingDivergedError(
            f"training diverged at level {self.stage.level}, iteration {iteration}: {what}; expected finite values; "
            "finished levels and the last checkpoint are kept, start again with other settings"
        )

    def state(self) -> dict[str, Any]:
        """Everything needed to continue this stage bit for bit, as plain tensors and numbers."""
        return {
            "level": self.stage.level,
            "progress": vars(self.progress),
            "model": self.model.state(),
            "densifier": self.densifier.state,
            "random": torch.get_rng_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned; the model must have been made from it already."""
        self.progress = StageProgress(**state["progress"])
        self.densifier.state = state["densifier"]
        torch.set_rng_state(state["random"])
