"""Hold the objects that the stages of a run over a checkout share, and the results that they hand on."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.level_views import SceneImages
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.archived_values import ADAPTER_MENDS, NO_RESIDUALS, explain_other_values
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.hook_calls import HookCaller
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.stage_rendering import Captured, StageRendering
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.runs.watcher import Watcher

logger = logging.getLogger(__name__)


@dataclass
class CheckoutContext:
    """Hold the objects of a run that exist before the script's main block starts; see `HierarchyDriver`.

    Attributes:
        options: of the hierarchy; once the photos are read, with the defaults for their size.
        stages: hold the running stage, or that of the dry run.
    """

    adapter: BackboneAdapter
    options: RunSettings
    device: torch.device
    images: SceneImages
    stages: Stages
    wrapper: RasterizerWrapper
    hooks: HookCaller
    parts: IterationParts
    watcher: Watcher
    measuring: MeasuringOptions
    _told: set[str] = field(default_factory=set)

    def compare(self, captured: Captured, field: GaussianField, *, residual_follows: bool, state: str = "") -> None:
        """Compare what the checkout renders of a model with its archived field, and warn once if they differ.

        Raises:
            UserInputError: they differ, and a residual would be added to another image; `state` ends the line.
        """
        problem = explain_other_values(self.adapter, captured, field)
        if problem and residual_follows:
            raise UserInputError(f"{problem}; {NO_RESIDUALS}{state}")
        if problem and problem not in self._told:
            self._told.add(problem)
            line = f"{problem}: lapgs eval, render and view show other images than the checkout's own render"
            logger.warning("%s; %s", line, ADAPTER_MENDS)

    def window(self, plan: StagePlan, stage: Stage) -> StageWindow:
        """Return the place of a stage in the run."""
        options, start = self.options, plan.iterations_before(stage.level)
        factors = options.color_factor, options.threshold_factor(stage)
        return StageWindow(stage, start, plan.iterations, plan.levels, *factors)

    def render(
        self, rendering: StageRendering, call: TrainingCall, view: Any, gaussians: Any, *, black: bool = False
    ) -> Captured:
        """Render a view as the checkout does.

        Args:
            rendering: replaces the running stage's meanwhile; it captures.
            call: call of the script's `training` for the stage of these Gaussians.
            view: the checkout's camera at that stage's level.
            gaussians: the checkout's model.
            black: whether the background is black instead of the call's.
        """
        with self.stages.rendering_as(rendering):
            self.adapter.render(call, view, gaussians, self._backgrounds[call.white_background and not black])
        captured, rendering.captured = rendering.captured, None
        assert captured is not None, "a rendering that captures"
        return captured

    @cached_property
    @torch.inference_mode(False)  # kept for later calls, which may need gradients
    def _backgrounds(self) -> dict[bool, Tensor]:
        """Black and white, (3,) each, by whether it is white. Making one would be a launch in every joint render."""
        return {white: torch.full((3,), float(white), device=self.device) for white in (False, True)}


@dataclass(frozen=True)
class TrainingRun:
    """Hold the objects of a run that exist once the script has called `training`.

    Attributes:
        call: for the whole run.
        scene_files: folder of the files that the checkout's Scene wrote beside a model, for its viewers.
        archive: open for writing.
    """

    context: CheckoutContext
    call: TrainingCall
    scene: CheckoutScene
    scene_files: Path
    archive: RunArchive
    color_path: ColorPath


@dataclass(frozen=True)
class FinishedStage:
    """Name a stage whose field is in the archive."""

    stage: Stage
    call: TrainingCall  # for this stage


@dataclass(frozen=True)
class StageResult:
    """Hand a finished stage on to the next one.

    Attributes:
        field: its Gaussians, on the CPU.
        predictions: Up(I_hat^l) of every view by key; None after the finest level, and where levels are nested.
        carried: attributes for the next model.
        moments: optimizer state by parameter group, for full inheritance.
    """

    field: GaussianField
    predictions: UpsampledImages | None
    carried: Mapping[str, Any]
    moments: Mapping[str, dict[str, Tensor]]
