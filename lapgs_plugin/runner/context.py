"""Hold what a user asks of a run over a checkout, what its stages share, and the results that they hand on."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.compiled_modules import CompiledModules
from lapgs_plugin.checkouts.level_views import SceneImages
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.hooks import StageHook
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.archived_values import ADAPTER_MENDS, NO_RESIDUALS, explain_other_values
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.depth import CheckoutDepth
from lapgs_plugin.runner.hook_calls import HookCaller
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.late_scalars import LateScalars
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.stage_rendering import Captured, StageRendering
from lapgs_plugin.runner.visible_rows import VisibleRows
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.stages.run import StagedRun

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunRequest:
    """Hold what a user asks of a run over a checkout; the script's own call of `training` says the rest.

    Attributes:
        adapter: of the script's backbone.
        settings: of the hierarchy.
        compiled: whose compiled modules the checkout imports; None on a CPU, where all are ours.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        resume: continue the run in the output folder.
        overwrite: replace the run in the output folder.
        hooks: run after those registered by entry point.
        measuring: which figures are measured.
        watcher: may look at the fields between iterations.
    """

    adapter: BackboneAdapter
    settings: RunSettings = field(default_factory=RunSettings)
    compiled: CompiledModules | None = None
    device: str = "cuda"
    resume: bool = False
    overwrite: bool = False
    hooks: Sequence[StageHook] = ()
    measuring: MeasuringOptions = field(default_factory=MeasuringOptions)
    watcher: Watcher = field(default_factory=Watcher)


class CheckoutContext:
    """Hold the objects of a run that exist before the script's main block starts.

    Args:
        request: what the user asks for.

    Attributes:
        images: photos of the scene.
        stages: hold the running stage, or that of the dry run.
        scalars: write what the loop logs for TensorBoard.
        began: file-system time (ns) just before the main block.
        depth: of the training views, once the scene was read; None without.
    """

    def __init__(self, request: RunRequest) -> None:
        self.request, self.adapter, self.device = request, request.adapter, torch.device(request.device)
        self.images, self.stages, self.scalars = SceneImages(), Stages(), LateScalars()
        self.parts = IterationParts(self.stages, request.measuring.breakdown)
        rows = VisibleRows() if request.settings.run_ahead else None
        ours = {} if request.compiled is None else request.compiled.beside
        self.wrapper = RasterizerWrapper(self.stages, self.parts.mark_render, rows, ours)
        self.hooks = HookCaller(self.stages, request.hooks, request.settings.hooks)
        with tempfile.TemporaryFile() as file:  # its clock is behind `time.time_ns`
            self.began = os.fstat(file.fileno()).st_mtime_ns
        self._told: set[str] = set()
        self.depth: CheckoutDepth | None = None

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
        settings, start = self.request.settings, plan.iterations_before(stage.level)
        factors = settings.color_factor, settings.threshold_factor(stage)
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
class TrainingRun(StagedRun):
    """Hold a run that is ready to train, once the script has called `training`. `preparation.prepare` makes it.

    Attributes:
        settings: those of the request, with the defaults for the photos' size.
        context: the objects from before the script's main block.
        call: for the whole run.
        scene: of the checkout.
        schedule: of the script's training function.
        color_path: how the checkout's rasterizer evaluates signed colour.
        folder: its path as the user typed it.
        scene_files: folder of the files that the checkout's Scene wrote beside a model, for its viewers.
    """

    settings: RunSettings
    context: CheckoutContext
    call: TrainingCall
    scene: CheckoutScene
    schedule: Schedule
    color_path: ColorPath
    folder: Path
    scene_files: Path


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
