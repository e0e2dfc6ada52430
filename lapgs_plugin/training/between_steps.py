"""Log, measure, save and stop between the steps of a stage."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from lapgs_plugin.errors import TrainingStoppedError
from lapgs_plugin.interrupt import StopRequest
from lapgs_plugin.runs.training_figures import length_line
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.training.evaluation import StageEvaluation
from lapgs_plugin.training.monitor import Tick
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.stage import StageRun

CHECKPOINT_SECONDS = 60.0
"""Least time between two checkpoints unless a number of iterations is given."""
CHECKPOINT_SHARE = 0.05
"""Largest share of the time that checkpoints take then: one of tens of millions of Gaussians takes a minute itself."""
EQUAL_EVERY = 1_000
"""Iterations between two comparisons of the ranks' fields."""


@dataclass
class BetweenSteps:
    """Log, measure, save and stop when due; none of it counts as optimization time.

    Attributes:
        evaluation: of the stage; its monitor shows progress.
        watcher: looks at the fields.
        stop: of the user.
        samples: how often some views are measured in the stage.
        last_tick: seconds and iteration of the last tick, or of the start.
        last_checkpoint: when it was written, or when the stage began, by `time.monotonic`.
    """

    evaluation: StageEvaluation
    watcher: Watcher
    stop: StopRequest
    samples: int
    last_tick: tuple[float, int]
    last_checkpoint: float = field(default_factory=time.monotonic)
    _pause: float = field(default=CHECKPOINT_SECONDS, init=False)  # to the next checkpoint
    _schedule: StageSchedule | None = field(default=None, init=False)
    _due: Collection[int] = field(default=(), init=False)
    _steps: int = field(default=0, init=False)

    def __call__(self, run: StageRun) -> None:
        """Act on a step that has just ended.

        Raises:
            TrainingStoppedError: the user asked to stop; a checkpoint was written.
        """
        self._measure_gains(run)
        evaluation, test_every = self.evaluation, run.prepared.control.test_every
        iteration = run.counts.iteration
        due_test = iteration == run.stage.iterations if test_every is None else run.passed(test_every)
        due_sample = run.reached(self._sampled(run.schedule))
        due_tick = run.passed(run.record.history_every)
        if due_test or due_sample or due_tick:
            run.settle()  # so that iterations in progress do not count as overhead
        measured = evaluation.held_out(due_test, due_sample and test_every is None)
        if due_sample and run.prepared.aside:
            evaluation.note_best()
        if measured or due_tick:
            self._tick(run, measured)
        evaluation.warn_of_a_fall(measured)
        if self.watcher.wants_look():
            run.catch_up()  # without the losses of other ranks, which do not look
            with run.record.overhead.timed("view"):
                self.watcher.look(run.stage, iteration, lambda: run.fields, lambda: self.stop.requested)
        if run.passed(EQUAL_EVERY):
            run.require_equal_fields()
        stop, save = self._decided(run)
        if stop:
            run.settle()
        if stop or save:
            self._save_checkpoint(run)
        if stop:
            raise TrainingStoppedError(
                f"stopped at level {run.stage.level}, iteration {iteration} of {run.stage.iterations}; "
                f"a checkpoint is in {run.prepared.archive.path()}, the same command with --resume continues"
            )

    def _measure_gains(self, run: StageRun) -> None:
        """Measure the views that decide the stage's length, if it is time; tell the user once it is decided."""
        gains = run.gains
        if gains is None or not gains.is_due(run.counts.iteration):
            return
        run.settle()
        run.note_gains(self.evaluation.withheld())
        if (decided := gains.length) is not None:
            line = length_line(run.stage.level, gains.planned, decided)
            self.evaluation.monitor.say(f"{line}, and are trained on from here")

    def _decided(self, run: StageRun) -> tuple[bool, bool]:
        """Return whether to stop, and whether to save a checkpoint, as all ranks decide at the same step."""
        ranks, every = run.prepared.ranks, run.prepared.control.checkpoint_every
        due = every is not None and run.counts.iteration % every < run.step_views
        self._steps += 1
        if self._steps % ranks.steps_a_decision:
            return False, due
        # Rank 0 says when: it writes them, which takes longest.
        late = every is None and ranks.leads and time.monotonic() - self.last_checkpoint >= self._pause
        stop, late = ranks.decide(self.stop.requested, late)
        return stop, due or late

    def _sampled(self, schedule: StageSchedule) -> Collection[int]:
        """Return the iterations after which some views are measured, once for each schedule."""
        if self._schedule is not schedule:
            self._schedule, self._due = schedule, schedule.sampled(self.samples)
        return self._due

    def _tick(self, run: StageRun, measured: Mapping[str, float]) -> None:
        before_seconds, before_iteration = self.last_tick
        counts = run.counts
        self.last_tick = (counts.seconds, counts.iteration)
        tick = Tick(
            level=run.stage.level,
            iteration=counts.iteration,
            elapsed=run.record.elapsed_in_run(),
            loss=run.loss,
            num_gaussians=run.num_optimized,
            rate=(counts.iteration - before_iteration) / max(counts.seconds - before_seconds, 1e-9),
            **measured,
        )
        figures = {name: value for name, value in vars(tick).items() if value is not None}
        run.record.write_history(counts.iteration, figures)
        self.evaluation.monitor.tick(run.stage, tick)

    def _save_checkpoint(self, run: StageRun) -> None:
        run.require_equal_fields()
        run.require_finite(run.counts.iteration)  # Gaussians of NaN are culled: the loss does not show them
        best, overhead, began = self.evaluation.best, run.record.overhead, time.monotonic()
        with overhead.timed("checkpoints"):
            kept: dict[str, Any] = {} if best is None else {"best": best}
            state = {**run.state(), **kept, "overhead": dict(overhead)}
            run.prepared.archive.save_checkpoint(state, extends_to=run.prepared.settings.iterations)
        self.last_checkpoint = time.monotonic()
        self._pause = max(CHECKPOINT_SECONDS, (self.last_checkpoint - began) / CHECKPOINT_SHARE)
