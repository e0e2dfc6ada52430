"""Prepare a run over a checkout: decide and check what a user and the script ask for, before a run folder is made."""

from __future__ import annotations

import logging
import os
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from lapgs_plugin.checkouts.packages import OURS
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_folder
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.registry import NONE
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.context import CheckoutContext, TrainingRun
from lapgs_plugin.runner.depth import CheckoutDepth
from lapgs_plugin.runner.dry_run import DryRun, full_gpu_told
from lapgs_plugin.runner.manifest import make_manifest, require_same_run
from lapgs_plugin.runner.rasterizer_choice import Decision, decided_without_trials
from lapgs_plugin.runner.stage_pruning import require_pruning
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import require_place, require_room, require_utf8
from lapgs_plugin.runs.manifest import Manifest, read_manifest
from lapgs_plugin.scenes.scene import require_colmap_or_transforms

logger = logging.getLogger(__name__)


@contextmanager
def prepare(context: CheckoutContext, call: TrainingCall) -> Iterator[TrainingRun]:
    """Yield a run that is ready to train. Its folder is locked for writing inside the block.

    The cheapest checks come first. The folder of a new run is made last, with its manifest.

    Args:
        context: of the run, whose replacements in `training` are attached.
        call: the script's call of `training`.

    Raises:
        LapgsError: the checkout, its options, the scene, the run folder and the hierarchy do not go together.
    """
    request, adapter, images = context.request, context.adapter, context.images
    settings = request.settings
    adapter.refuse(call, settings.has_residuals)
    require_pruning(call, settings.prune, adapter.profile.model)
    if settings.appearance != NONE and getattr(call.dataset, "train_test_exp", False):
        raise UserInputError(
            f"--appearance {settings.appearance} with --train_test_exp: both learn each photo's exposure; leave one out"
        )
    unnamed = Path("output", os.getenv("OAR_JOB_ID") or str(uuid.uuid4())[:10])  # as checkouts choose without -m
    folder, source = Path(call.dataset.model_path or unnamed), Path(call.dataset.source_path)
    absolute = folder.absolute()
    if not request.resume:
        require_room(folder, request.overwrite, context.began)
        require_place(folder, "-m")
        require_utf8(folder, "-m")
    if not source.exists():
        raise UserInputError(f"the scene {source} does not exist; give the script its folder, as in -s data/garden")
    require_colmap_or_transforms(source)
    images.clear()
    if settings.images_on == "disk":  # that of the run: the one of temporary files may be in memory
        images.keep_on_disk(next(filter(is_folder, (absolute, *absolute.parents))))
    with tempfile.TemporaryDirectory(prefix="lapgs-scene-") as scratch:
        scene = CheckoutScene.load(call, adapter, Path(scratch))
        scene.check_points()
        images.read_masks(source, settings.masks)
        keys = [images.key(camera) for camera in scene.train]
        context.depth = CheckoutDepth.load(
            settings.depth, call.dataset, images, keys, context.stages, context.hooks, context.device
        )
        adapter.first_points(len(scene.points.points))
        size = images.smallest_size()
        settings = settings.for_size(size)
        plan = StagePlan.create(size, call.opt.iterations, settings.levels, settings.shares, settings.kind)
        schedule = Schedule(adapter.profile.source.training)
        if not settings.has_residuals:
            plan = between_events(plan, schedule, call.variables)
        dry_run = DryRun(context, call, scene, plan, schedule)
        with full_gpu_told():
            rasterizer = _choose_rasterizer(context, dry_run, absolute)
            path = dry_run.color_path() if settings.has_residuals else ColorPath.NATIVE
            if settings.dry_run:
                dry_run.run(Path(scratch, "dry_run"), path)
            elif not settings.has_residuals and (
                context.hooks or images.masked or context.depth or settings.appearance != NONE
            ):
                dry_run.find_image()
            if context.depth is not None:
                dry_run.require_depth()
        manifest = make_manifest(adapter, settings, call, plan, bool(scene.test), rasterizer)
        with _open_archive(context, absolute, manifest) as archive:
            yield TrainingRun(
                settings=settings,
                plan=plan,
                archive=archive,
                device=context.device,
                context=context,
                call=call,
                scene=scene,
                schedule=schedule,
                color_path=path,
                folder=folder,
                scene_files=Path(scratch),
            )


def _choose_rasterizer(context: CheckoutContext, dry_run: DryRun, folder: Path) -> Decision | None:
    """Let the checkout's own rasterizer or ours render from here on; return whose and why, None on a CPU.

    Raises:
        RunFolderError: the run to continue was started with one that is not to be had now.
    """
    request, compiled = context.request, context.request.compiled
    if compiled is None:
        return None
    kept = read_manifest(folder) if request.resume else None
    decision = decided_without_trials(compiled, kept, tries=request.settings.dry_run) or dry_run.choose_rasterizer()
    context.wrapper.takes_ours = decision.rasterizer == OURS
    if compiled.beside or compiled.hindrance:  # else `CompiledModules.describe` has said it
        logger.info("rasterizer: %s", decision.why)
    return decision


def _open_archive(context: CheckoutContext, folder: Path, manifest: Manifest) -> RunArchive:
    """Create the run folder, or open it to continue the run.

    Raises:
        RunFolderError: it is in use, or was started with other options.
    """
    if not context.request.resume:
        return RunArchive.create(folder, manifest, context.request.overwrite, context.began)
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
