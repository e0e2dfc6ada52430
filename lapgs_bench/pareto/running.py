"""Train every method for every budget; finished runs are kept. Each run is a process of its own, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lapgs_bench.experiments.checks import check_run
from lapgs_bench.experiments.execution import LOGS, STORE, execute
from lapgs_bench.experiments.launchers import WorkOrder, launch
from lapgs_bench.experiments.settings import WorkerSettings
from lapgs_bench.experiments.store import DONE, Job, Outcome, ResultStore
from lapgs_bench.pareto.methods import Method, job_of, run_spec
from lapgs_bench.pareto.settings import ParetoSettings
from lapgs_plugin.errors import LapgsError

WARM_UP = 100
"""Iterations of the run that gives a method's first rate."""
LEAST = 20
"""Fewest iterations of a run."""
MISSED = 0.25
"""Share of a budget by which a run may miss it; else it is planned once more."""
FARTHEST = 2.0
"""Most iterations of a run, as a factor on those by a rate alone: on a busy machine two runs say little."""

Say = Callable[[str], None]
Row = dict[str, Any]


class MethodFailedError(LapgsError):
    """Report a method whose run failed, with the end of its log, line by line."""


@dataclass(frozen=True)
class Bench:
    """Run the methods of one scene.

    Attributes:
        settings: budgets, seeds and images.
        scene: its folder.
        folder: where runs and results are written.
        say: receives a line for each run.
        done: jobs whose rows were returned; those of other defaults are refused beside a run that is missing.
    """

    settings: ParetoSettings
    scene: Path
    folder: Path
    say: Say
    done: list[Job] = field(default_factory=list)

    def check(self, method: Method) -> None:
        """Check the options of a method's first run before any other method is trained.

        Raises:
            LapgsError: its command, or the checkout's script, would refuse them.
        """
        spec = run_spec(method, self.settings, self.scene, WARM_UP, self.settings.seed_list[0])
        check_run(job_of(spec, self.scene, self.folder, None), spec, self.scene)

    def rows(self, method: Method) -> list[Row]:
        """Return a row for each budget and seed of a method, after running what is missing.

        Raises:
            MethodFailedError: a run failed.
        """
        first, *others = self.settings.seed_list
        runs = [self._run(method, WARM_UP, first, evaluated=False)]
        rows: list[Row] = []
        for budget in self.settings.budgets:
            tried = [self._run(method, planned_iterations(budget, runs), first)]
            if _miss(tried[0], budget) > MISSED:
                again = planned_iterations(budget, [*runs, *tried])
                tried += [self._run(method, again, first)] if again != tried[0]["iterations"] else []
            runs += tried
            nearest = min(tried, key=lambda run: _miss(run, budget))
            of_seeds = [nearest, *(self._run(method, nearest["iterations"], seed) for seed in others)]
            rows += [{**run, "curve": method.name, "budget": budget} for run in of_seeds]
        return rows

    def _run(self, method: Method, iterations: int, seed: int, *, evaluated: bool = True) -> Row:
        """Return the row of a run, which is only trained if it is not finished."""
        spec = run_spec(method, self.settings, self.scene, iterations, seed)
        job = job_of(spec, self.scene, self.folder, self._measuring if evaluated else None)
        store = ResultStore.create(self.folder / STORE)
        store.plan([*self.done, job])
        (outcome,) = store.outcomes([job.run_id])
        kept = outcome.state == DONE
        if not kept:
            outcome = _finished(store, self.folder.absolute(), job)
        if outcome.record is None:
            raise MethodFailedError(f"{method.name}, {iterations} iterations: {outcome.error}")
        self.done.append(job)
        seconds = outcome.record["train_seconds"]
        what = "" if evaluated else " to measure its rate"
        self.say(
            f"{method.name}, seed {seed}: {iterations:,} iterations{what} {'took' if not kept else 'had taken'} "
            f"{seconds:.1f} s"
        )
        return outcome.record

    @property
    def _measuring(self) -> Sequence[str]:
        files = self.settings.lpips_weights or []
        return [word for file in files for word in ("--lpips-weights", str(file.absolute()))]


def planned_iterations(budget: float, runs: Sequence[Row]) -> int:
    """Return the iterations of a run that should take so many seconds, by a method's runs so far.

    The seconds of a run are a constant and a rate times its iterations; the two latest runs tell both. With one run, or
    where two contradict that, the seconds are taken as proportional to the iterations.

    This is the one place where a budget becomes the length of a run.
    """
    count, seconds = _length(runs[-1])
    proportional = budget * count / seconds
    planned = proportional
    if len(runs) > 1:
        before, earlier = _length(runs[-2])
        rate = (seconds - earlier) / (count - before) if count != before else 0.0
        if rate > 0 and 0 <= seconds - rate * count < budget:
            planned = count + (budget - seconds) / rate
    return max(LEAST, round(min(planned, FARTHEST * proportional)))


def _miss(run: Row, budget: float) -> float:
    """Return by which share of a budget a run missed it."""
    seconds: float = run["train_seconds"]
    return abs(seconds / budget - 1)


def _length(run: Row) -> tuple[int, float]:
    """Return a run's iterations and seconds."""
    return run["iterations"], run["train_seconds"]


def _finished(store: ResultStore, folder: Path, job: Job) -> Outcome:
    """Run a job until it has ended, or wait for another command that runs it; it is released if this is interrupted."""
    order = WorkOrder(folder / STORE, [job.run_id], folder / LOGS / "workers", WorkerSettings(workers=1))
    (outcome,) = execute(store, order.run_ids, lambda: launch(order), lambda _: None)
    return outcome
