"""Run a checkout's script as a hierarchy: its own `training`, archived level by level.

A call of `training(dataset, opt, pipe, ...)` becomes:

    load     the checkout's Scene, once; its images are kept at full size on the CPU
    stage    views at the level's size, targets and predictions in image stores
    archive  the field and its measurements; predictions of all views for the next stage

Each residual is a field of its own, trained by its own call of `training` with the adapter's arguments. Nested levels
are one field: a single call trains them (`single_call`). Everything between render and optimizer is the checkout's.
"""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import tempfile
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.checkouts.level_views import SceneImages
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_folder
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hooks import StageHook
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.active_stage import ActiveStage
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.context import CheckoutContext, FinishedStage, StageResult, TrainingRun
from lapgs_plugin.runner.dry_run import DryRun, undisturbed
from lapgs_plugin.runner.early_visibility import EarlyVisibility
from lapgs_plugin.runner.hook_calls import HookCaller
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.manifest import make_manifest, require_same_run
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.replacements import StageReplacements
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.single_call import SingleCall
from lapgs_plugin.runner.stage_pruning import require_pruning
from lapgs_plugin.runner.step_clock import counting_steps
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE, require_place, require_utf8
from lapgs_plugin.runs.manifest import Manifest
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.watcher import Watcher

logger = logging.getLogger(__name__)


class HierarchyDriver:
    """Run a script's main block with its `training` replaced by the stages of a hierarchy.

    Args:
        adapter: adapter of the script's backbone.
        options: settings of the hierarchy.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        resume: continue the run in the output folder.
        overwrite: replace the run in the output folder.
        hooks: hooks that run after those registered by entry point.
        measuring: what is measured; None measures held-out views at the end alone.
        watcher: may look at the fields between iterations.

    Attributes:
        folder: run folder, once the run is complete.
    """

    def __init__(
        self,
        adapter: BackboneAdapter,
        options: RunSettings,
        *,
        device: str = "cuda",
        resume: bool = False,
        overwrite: bool = False,
        hooks: Sequence[StageHook] = (),
        measuring: MeasuringOptions | None = None,
        watcher: Watcher | None = None,
    ) -> None:
        self._adapter = adapter
        self._resume, self._overwrite = resume, overwrite
        place, measuring = torch.device(device), measuring or MeasuringOptions()
        stages, parts = Stages(), IterationParts(place, measuring.breakdown)
        self._context = CheckoutContext(
            adapter=adapter,
            options=options,
            device=place,
            images=SceneImages(),
            stages=stages,
            wrapper=RasterizerWrapper(stages, parts.mark_render, EarlyVisibility() if options.run_ahead else None),
            hooks=HookCaller(stages, hooks, options.hooks),
            parts=parts,
            watcher=watcher or Watcher(),
            measuring=measuring,
        )
        self._replacements = StageReplacements(self._context, self._train)
        self._since: int | None = None  # when the script's main block began, as files have it
        self.folder: Path | None = None

    @property
    def _options(self) -> RunSettings:
        return self._context.options

    def run(self) -> None:
        """Run the main block.

        Raises:
            LapgsError: the checkout, its options, the scene and the hierarchy do not go together.
        """
        self._since = _now_in_files()
        with (
            Attachment(self._replacements.in_script()),
            # Handing a backward pass to a thread of autograd's and waiting for it takes up to a tenth of an iteration.
            torch.autograd.set_multithreading_enabled(False),
            self._context.parts.watching_optimizers(),
        ):
            self._adapter.script.run_main()

    def _train(self, call: TrainingCall) -> Any:
        """Train the hierarchy in place of the script's call of `training`, and return what its last call returned."""
        profile = self._adapter.profile
        if len(profile.source.models) > 1:
            with undisturbed(self._context.device):
                profile.choose_model(type(profile.make_model(call.values)))
        with (
            Attachment(self._replacements.in_training()),
            counting_steps(profile, lambda: self._context.stages.running),
        ):
            return self._train_attached(call)

    def _train_attached(self, call: TrainingCall) -> Any:
        """Train the hierarchy while the checkout's symbols are replaced."""
        self._adapter.refuse(call, self._has_residuals)
        require_pruning(call, self._options.prune, self._adapter.profile.model)
        given = Path(call.dataset.model_path or _default_folder())
        folder, source = given.absolute(), Path(call.dataset.source_path)
        if not self._resume:
            RunArchive.require_room(given, self._overwrite, self._since)
            require_place(given, "-m")
            require_utf8(given, "-m")
        if not source.exists():
            raise UserInputError(f"the scene {source} does not exist; give the script its folder, as in -s data/garden")
        if self._options.images_on == "disk":  # that of the run: the one of temporary files may be in memory
            self._context.images.keep_on_disk(next(filter(is_folder, (folder, *folder.parents))))
        with tempfile.TemporaryDirectory(prefix="lapgs-scene-") as scratch:
            scene = CheckoutScene.load(call, self._adapter, Path(scratch))
            scene.check_points()
            self._context.images.read_masks(source, self._options.masks)
            self._adapter.first_points(len(scene.points.points))
            size = self._context.images.smallest_size()
            self._context.options = self._options.for_size(size)
            plan = StagePlan.create(
                size,
                call.opt.iterations,
                self._options.levels,
                self._options.shares,
                self._options.kind,
            )
            if not self._has_residuals:
                plan = between_events(plan, self._schedule, call.variables)
            dry_run = DryRun(self._context, call, scene, plan, self._schedule)
            path = dry_run.color_path() if self._has_residuals else ColorPath.NATIVE
            if self._options.dry_run:
                dry_run.run(Path(scratch, "dry_run"), path)
            elif not self._has_residuals and (self._context.hooks or self._context.images.masked):
                dry_run.find_image()
            manifest = make_manifest(self._adapter, self._options, call, plan, bool(scene.test))
            with self._open_archive(folder, manifest) as archive:
                self._context.watcher.run_started(archive)
                try:
                    run = TrainingRun(self._context, call, scene, Path(scratch), archive, path)
                    acts = "; ".join(self._schedule.describe(call.variables)) or "nowhere"
                    logger.info("%s acts by iteration: %s", self._adapter.script.path.name, acts)
                    returned = self._run_stages(run, plan) if self._has_residuals else SingleCall(run, plan).train()
                except KeyboardInterrupt:
                    kept = ", ".join(map(str, archive.available_levels)) or "none"
                    logger.info("stopped; finished levels in %s: %s; --resume continues after them", given, kept)
                    raise
                finally:
                    # A run that is continued makes its images again.
                    shutil.rmtree(archive.path(CACHE), ignore_errors=True)
        self.folder = folder
        logger.info("run folder: %s; next: `lapgs eval %s`", given, shlex.quote(str(given)))
        return returned

    def _run_stages(self, run: TrainingRun, plan: StagePlan) -> Any:
        """Train or restore all stages, each by its own call, and return what the last call returned."""
        finished: list[FinishedStage] = []
        before: StageResult | None = None
        for stage in plan:
            window = self._context.window(plan, stage)
            call = self._stage_call(run, window)
            active = ActiveStage(run, window, call, tuple(finished), before)
            with self._context.stages.run(active):
                before = active.restore() if stage.level in run.archive.available_levels else active.train()
            finished.append(FinishedStage(stage, call))
        return active.returned

    def _stage_call(self, run: TrainingRun, window: StageWindow) -> TrainingCall:
        """Return the call for a stage of its own length: arguments by the adapter, all else by the script's tree."""
        level = window.stage.level
        call = self._adapter.stage_call(run.call, window, str(run.archive.path(f"level_{level}")))
        changed = self._schedule.for_stage(run.call.variables, call.values, window, self._adapter.info.unscaled)
        if changed.notes:
            logger.info("level %d, schedule: %s", level, ", ".join(changed.notes))
        return changed.applied_to(call)

    @cached_property
    def _schedule(self) -> Schedule:
        """Schedule of the script's training function."""
        return Schedule(self._adapter.profile.source.training)

    @property
    def _has_residuals(self) -> bool:
        """Whether some fields are residuals; without any, one call of the script's `training` trains all levels."""
        return self._options.levels > 1 and not self._options.nested

    def _open_archive(self, folder: Path, manifest: Manifest) -> RunArchive:
        """Create the run folder, or open it to continue the run.

        Raises:
            RunFolderError: it is in use, or was started with other options.
        """
        if not self._resume:
            return RunArchive.create(folder, manifest, self._overwrite, self._since)
        archive = RunArchive.open(folder, resume=True)
        try:
            require_same_run(archive.manifest, manifest)
            if archive.manifest.complete:
                logger.info("the run in %s is finished: nothing is left to train", folder)
        except BaseException:
            archive.close()
            raise
        return archive


def between_events(plan: StagePlan, schedule: Schedule, variables: Mapping[str, Any]) -> StagePlan:
    """Return a plan in which no nested level is archived right after a reset of opacities or hard pruning.

    The iterations that a level loses go to the next finer one.

    Args:
        plan: of nested levels.
        schedule: of the script.
        variables: those that its training function sees, by name.
    """
    before, stages = 0, list(plan)
    for i in range(len(stages) - 1):
        stage, finer = stages[i], stages[i + 1]
        end = before + stage.iterations
        clear = schedule.before_harm(end, variables, plan.iterations)
        if before < clear < end:
            logger.info("level %d ends after iteration %d: the script acts at %d", stage.level, clear, clear + 1)
            stages[i] = replace(stage, iterations=clear - before)
            stages[i + 1] = replace(finer, iterations=finer.iterations + end - clear)
        before += stages[i].iterations
    return replace(plan, stages=tuple(stages))


def _now_in_files() -> int:
    """Return the present time as new files have it, whose clock is behind `time.time_ns`, in nanoseconds."""
    with tempfile.TemporaryFile() as file:
        return os.fstat(file.fileno()).st_mtime_ns


def _default_folder() -> str:
    """Return the output folder that checkouts choose without -m."""
    return str(Path("output") / (os.getenv("OAR_JOB_ID") or str(uuid.uuid4())[:10]))
