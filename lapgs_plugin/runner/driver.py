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
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.checkouts.syntax import returns_value
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.runner.active_stage import ActiveStage
from lapgs_plugin.runner.context import CheckoutContext, FinishedStage, RunRequest, StageResult, TrainingRun
from lapgs_plugin.runner.dry_run import undisturbed
from lapgs_plugin.runner.preparation import prepare
from lapgs_plugin.runner.replacements import StageReplacements
from lapgs_plugin.runner.single_call import SingleCall
from lapgs_plugin.runner.step_clock import counting_steps

logger = logging.getLogger(__name__)


class _NoResult(SystemExit):
    """End the main block, because it may use what `training` returns, which was not called."""


class HierarchyDriver:
    """Run a script's main block with its `training` replaced by the stages of a hierarchy.

    Args:
        request: what the user asks for.
    """

    def __init__(self, request: RunRequest) -> None:
        self._context = CheckoutContext(request)
        self._replacements = StageReplacements(self._context, self._train)
        self._folder: Path | None = None

    def run(self) -> Path | None:
        """Run the main block and return the folder of its run; None if it trained nothing.

        Raises:
            LapgsError: the checkout, its options, the scene and the hierarchy do not go together.
        """
        with (
            Attachment(self._replacements.in_script()),
            # Handing a backward pass to a thread of autograd's and waiting for it takes up to a tenth of an iteration.
            torch.autograd.set_multithreading_enabled(False),
            self._context.parts.watching_optimizers(),
            suppress(_NoResult),
        ):
            self._context.adapter.script.run_main()
        return self._folder

    def _train(self, call: TrainingCall) -> Any:
        """Train the hierarchy in place of the script's call of `training`, and return the result of its last call.

        Raises:
            _NoResult: the run was finished before, and `training` returns something.
        """
        profile = self._context.adapter.profile
        if len(profile.source.models) > 1:
            with undisturbed(self._context.device):
                profile.choose_model(type(profile.make_model(call.values)))
        with (
            Attachment(self._replacements.in_training()),
            counting_steps(profile, lambda: self._context.stages.running),
            self._context.scalars.written(),
        ):
            with prepare(self._context, call) as run:
                finished = run.archive.manifest.complete
                returned = _train_run(run)
            self._folder = run.archive.path()
            logger.info("run folder: %s; next: `lapgs eval %s`", run.folder, shlex.quote(str(run.folder)))
        if finished and returns_value(profile.source.training):
            logger.info(
                "%s() was not called, so that %s ends here: what follows may use its result",
                call.function.__name__,
                self._context.adapter.script.path.name,
            )
            raise _NoResult(0)
        return returned


def _train_run(run: TrainingRun) -> Any:
    """Train the stages that are not in the archive, and return the result of the script's last call."""
    context, archive = run.context, run.archive
    context.request.watcher.run_started(archive)
    try:
        acts = "; ".join(run.schedule.describe(run.call.variables)) or "nowhere"
        logger.info("%s acts by iteration: %s", context.adapter.script.path.name, acts)
        with run.image_cache():
            return _run_stages(run) if run.settings.has_residuals else SingleCall(run).train()
    except KeyboardInterrupt:
        line = "stopped; finished levels in %s: %s; --resume continues after them"
        logger.info(line, run.folder, run.finished_levels)
        raise


def _run_stages(run: TrainingRun) -> Any:
    """Train or restore all stages, each by a call of its own length, and return the result of the last one."""
    adapter, finished = run.context.adapter, list[FinishedStage]()
    before: StageResult | None = None
    for stage in run.plan:
        window = run.context.window(run.plan, stage)
        # The adapter changes arguments; the rest follows from the script's syntax tree.
        call = adapter.stage_call(run.call, window, str(run.archive.path(f"level_{stage.level}")))
        changed = run.schedule.for_stage(run.call.variables, call.values, window, adapter.info.unscaled)
        if changed.notes:
            logger.info("level %d, schedule: %s", stage.level, ", ".join(changed.notes))
        call = changed.applied_to(call)
        active = ActiveStage(run, window, call, tuple(finished), before)
        with run.context.stages.run(active):
            before = active.restore() if stage.level in run.archive.available_levels else active.train()
        finished.append(FinishedStage(stage, call))
    return active.returned
