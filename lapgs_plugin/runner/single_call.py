"""Train nested levels in one call of a checkout's `training`: between two levels only the views change.

The views that the training loop holds get the finer level's size and images when the coarser level's iterations are
over. Schedules, budgets, SH degrees and optimizers stay the checkout's own, for the whole run, so nothing here depends
on the backbone. Iterations are counted, because not every checkout says which one begins.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.attachment import Attachment, of_class
from lapgs_plugin.checkouts.training_call import CHECKPOINTS, StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runner.active_stage import ActiveStage
from lapgs_plugin.runner.context import StageResult, TrainingRun
from lapgs_plugin.runner.stage_model import StageModel
from lapgs_plugin.runner.stage_pruning import pruning_iteration

logger = logging.getLogger(__name__)

SOON = 500
"""Iterations after a change of level during which it may be the cause of an error: densification, too, runs in them."""


class NestedStage(ActiveStage):
    """Run one level of a call that trains all of them.

    Args:
        run, window, call, before: as of `ActiveStage`.
        advance: called with the model before the first iteration of the next level; returns its stage.
    """

    def __init__(
        self,
        run: TrainingRun,
        window: StageWindow,
        call: TrainingCall,
        before: StageResult | None,
        advance: Callable[[Any], ActiveStage],
    ) -> None:
        super().__init__(run, window, call, (), before)
        self._advance = advance
        self._took_over = False
        if self._options.prune and (until := pruning_iteration(self._call)) is not None:
            self._prune_at = until - self.window.start  # the call counts the iterations of the whole run

    @property
    def has_more(self) -> bool:
        return self.stage.level > 0 or super().has_more

    def iteration_begins(self, gaussians: Any) -> None:
        if self.iteration == self.stage.iterations and self.stage.level > 0:
            self._advance(gaussians).iteration_begins(gaussians)
        else:
            super().iteration_begins(gaussians)

    def take_over(self, before: NestedStage, gaussians: Any) -> None:
        """Continue training the model, with the views, of the stage before."""
        self.gaussians, self._took_over = gaussians, True
        self._views.take_over(before._views)

    def _finish_despite(self, error: Exception) -> None:
        """Explain an error soon after views changed: the checkout's own message may be about sizes alone."""
        by_size = isinstance(error, RuntimeError) and not isinstance(error, torch.cuda.OutOfMemoryError)
        if by_size and self._took_over and self.iteration <= SOON:
            logger.warning(
                "%s() failed %d iterations after its views got the size of level %d; a script that keeps images of "
                "views, or what it made of them, from before its loop cannot train nested levels in one call: "
                "--hierarchy laplacian makes a call for each level",
                self._call.function.__name__,
                self.iteration,
                self.stage.level,
            )
        if self.stage.level == 0:
            super()._finish_despite(error)


class SingleCall:
    """Train all nested levels of a run that are not in its archive.

    Args:
        run: the run.
    """

    def __init__(self, run: TrainingRun) -> None:
        self._context, self._run, self._plan = run.context, run, run.plan
        finished = len(run.archive.available_levels)
        self._done, self._left = list(run.plan)[:finished], list(run.plan)[finished:]
        # Copies: the script's main block must not see the folder and the thresholds of this run.
        self._call = run.call.copied()
        self._call.dataset.model_path = str(run.archive.path("level_0"))
        self._stage: NestedStage
        self._running = ExitStack()  # of the stage, which is another one at the end of the call than at its start

    def train(self) -> Any:
        """Call the script's `training` and return what it returned.

        Raises:
            LapgsError: it ended before the finest level, or cannot be continued in the middle.
        """
        if not self._left:
            return None
        self._stage = self._next(self._restored(self._done[-1]) if self._done else None)
        with self._running:
            self._begin()
            returned = self._run_from(self._stage.window.start) if self._done else self._call.run()
            level, done = self._stage.stage.level, self._stage.window.start + self._stage.iteration
            self._stage.require_trained(done, self._plan.iterations, ended=level == 0)
            self._stage.finish()
        return returned

    def _next(self, before: StageResult | None = None) -> NestedStage:
        """Return the next stage; `before` is given if the stage before it was not trained by this call."""
        window = self._context.window(self._plan, self._left.pop(0))
        return NestedStage(self._run, window, self._call, before, self._advance)

    def _begin(self) -> None:
        own = self._run.call.opt
        for name in self._context.adapter.densify_thresholds(own):
            setattr(self._call.opt, name, getattr(own, name) * self._stage.window.threshold_factor)
        self._running.enter_context(self._context.stages.run(self._stage))
        self._stage.begin()

    def _advance(self, gaussians: Any) -> NestedStage:
        """Archive the level whose iterations are over, and bring the checkout's views to the next one."""
        finished = self._stage
        finished.finish()
        self._stage = self._next()
        self._stage.take_over(finished, gaussians)
        self._running.close()
        self._begin()
        return self._stage

    def _restored(self, stage: Stage) -> StageResult:
        """Return the result of a stage that an earlier process archived."""
        archive = self._run.archive
        carried, moments = StageModel(self._run, stage, None).load_inherited(archive)
        return StageResult(archive.field(stage.level), None, carried, moments)

    def _run_from(self, iteration: int) -> Any:
        """Make the call as if it continued from one of the checkout's own checkpoints, written after `iteration`.

        Only the number is in the file. The model has its parameters, optimizer state and SH degree already, as from
        the archive; so the checkout's way to restore them, which differs between forks, is left out.
        """
        adapter = self._context.adapter

        def restore(gaussians: Any, state: Any, training_args: Any, *_: Any) -> None:
            if gaussians.optimizer is None:  # some scripts leave that to `restore`
                gaussians.training_setup(training_args)
            adapter.resume(self._call, gaussians, iteration)

        keeping = of_class(adapter.profile.model, "restore", lambda _: restore, "training() after reading a checkpoint")
        takes = [name for name in CHECKPOINTS if name in self._call.values]
        if not (takes and keeping):
            raise UserInputError(
                f"--resume: {self._call.function.__name__}() of {adapter.script.path.name} continues from no "
                f"checkpoint, which nested levels need to start at iteration {iteration + 1}; start again with "
                "--overwrite"
            )
        with tempfile.TemporaryDirectory(prefix="lapgs-resume-") as folder, Attachment(keeping):
            path = Path(folder, "iteration.pth")
            torch.save(((), iteration), path)
            return self._call.changed(**dict.fromkeys(takes, str(path))).run()
