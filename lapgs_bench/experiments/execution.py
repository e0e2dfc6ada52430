"""Prepare the runs of an experiment, and follow them until they have ended."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape

from lapgs_bench.experiments.commands import Locations, defaults_of, run_steps
from lapgs_bench.experiments.expansion import PlannedRun, SceneSpec
from lapgs_bench.experiments.launchers import Launcher, WorkOrder, launch
from lapgs_bench.experiments.mistakes import Mistakes
from lapgs_bench.experiments.schema import SampleScene
from lapgs_bench.experiments.settings import WorkerSettings
from lapgs_bench.experiments.store import DONE, FAILED, LOCK_TIMEOUT, Job, Outcome, ResultStore
from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.files import FolderLock, one_line_errors
from lapgs_plugin.progress import item_progress
from lapgs_plugin.scenes.resolution import parse_size

logger = logging.getLogger(__name__)

RUNS, LOGS, SCENES, STORE = "runs", "logs", "scenes", "results.sqlite"  # in an experiment's folder
MISSING = Path("SCENE")
"""Placeholder for a missing scene in commands that are only checked."""
POLL_SECONDS = 0.5
"""Seconds between two checks of the store."""


def prepare(
    planned: Sequence[PlannedRun],
    scenes: Sequence[SceneSpec],
    places: Locations,
    folder: Path,
    evaluate: Sequence[str] | None,
    mistakes: Mistakes,
) -> tuple[list[Job], dict[str, tuple[SceneSpec, Path]]]:
    """Make the jobs of all distinct runs, in order.

    Args:
        folder: the experiment's.
        evaluate: options of `lapgs eval`; None leaves it out.
        mistakes: receives missing scenes and checkouts, and resolutions that a checkout's script cannot read.

    Returns:
        The jobs, except those whose checkout, or whose scene for a checkout, is missing; and the scenes that exist, by
        name, with their folders.
    """
    where: dict[str, tuple[SceneSpec, Path]] = {}
    for scene in scenes:
        with mistakes.at(mistakes.scene_key(scene.name)):
            if scene.sample is None:
                where[scene.name] = scene, places.scene(scene)
            else:
                from lapgs_plugin.scenes.sample import check_sample_scene

                check_sample_scene(*parse_size(scene.sample.size), scene.sample.views, scene.sample.points)
                where[scene.name] = scene, _sample_folder(scene.name, scene.sample, folder)
    checkouts: dict[tuple[str, str], Path] = {}
    used = {(run.spec.checkout, run.spec.script): run.spec.backbone for run in planned if run.spec.checkout}
    for (name, script), key in used.items():
        with mistakes.at(f"backbones.{key}.checkout"):
            checkouts[name, script] = places.checkout(name, script)
    jobs: dict[str, Job] = {}
    for run in planned:
        spec = run.spec
        if spec.checkout is not None and (spec.scene not in where or (spec.checkout, spec.script) not in checkouts):
            continue
        with mistakes.at(mistakes.keys_of(run)["resolution"]):
            own = folder.absolute() / RUNS / spec.run_id
            checkout = checkouts[spec.checkout, spec.script] if spec.checkout else None
            scene_folder = where[spec.scene][1] if spec.scene in where else MISSING
            found = "" if spec.sample else str(scene_folder)
            steps = run_steps(spec, scene_folder, checkout, own, evaluate)
            log = str(folder.absolute() / LOGS / f"{spec.run_id}.log")
            jobs.setdefault(
                spec.run_id,
                Job(spec.run_id, spec, str(own), log, tuple(steps), evaluate is not None, defaults_of(spec), found),
            )
    return list(jobs.values()), where


def make_samples(scenes: Sequence[SceneSpec], folder: Path) -> None:
    """Make the sample scenes that do not exist yet, in one process at a time.

    Raises:
        RunFolderError: another process locks the folder for too long.
    """
    samples = [(_sample_folder(scene.name, scene.sample, folder), scene.sample) for scene in scenes if scene.sample]
    if all(path.is_dir() for path, _ in samples):
        return
    from lapgs_plugin.scenes.sample import make_sample_scene  # needs packages that read scenes

    parent = folder.absolute() / SCENES
    with one_line_errors(parent):
        parent.mkdir(parents=True, exist_ok=True)
    lock = FolderLock.acquire(parent, LOCK_TIMEOUT)
    try:
        for path, sample in samples:
            if not path.is_dir():  # another process may have made it meanwhile
                width, height = parse_size(sample.size)
                make_sample_scene(path, width=width, height=height, views=sample.views, points=sample.points)
    finally:
        lock.release()


def _sample_folder(name: str, sample: SampleScene, folder: Path) -> Path:
    return folder.absolute() / SCENES / f"{name}-{sample.label}"


def follow(
    jobs: Sequence[Job],
    folder: Path,
    engine: WorkerSettings,
    unit: str,
    summary: Callable[[dict[str, Any]], str],
    repeat: bool = False,
) -> list[Outcome]:
    """Run jobs on workers, with a progress bar and a line for each that ends.

    Args:
        jobs: to run, unless the store has finished them.
        folder: gets the store, and what workers say.
        engine: starts the workers.
        unit: plural of what a job makes, such as "runs".
        summary: describes a finished job by its record.
        repeat: run those again that the store has finished.

    Returns:
        All jobs, each done or failed.

    Raises:
        TrainingStoppedError: a signal stopped this command.
        UserInputError: as `execute`.
    """
    store = ResultStore.create(folder / STORE)
    store.plan(jobs, repeat)
    run_ids = [job.run_id for job in jobs]
    order = WorkOrder(folder.absolute() / STORE, run_ids, folder.absolute() / LOGS / "workers", engine)
    finished = sum(outcome.state == DONE for outcome in store.outcomes(run_ids))
    if finished:
        make_console(stderr=True).print(f"{finished} of {len(run_ids)} {unit} are done already")
    with item_progress(unit) as progress:
        task = progress.add_task("Running", total=len(run_ids), completed=finished)

        def show(outcome: Outcome) -> None:
            progress.advance(task)
            if outcome.state == FAILED:
                text = f"[red]failed[/red] {outcome.run_id}\n{escape(outcome.error)}"
            else:
                text = f"[green]done[/green]   {outcome.run_id}: {summary(outcome.record or {})}"
            progress.console.print(text, soft_wrap=True, highlight=False)

        try:
            return execute(store, run_ids, lambda: launch(order), show)
        except KeyboardInterrupt:
            raise TrainingStoppedError(f"stopped; repeat the command to continue with the remaining {unit}") from None


def execute(
    store: ResultStore, run_ids: Sequence[str], start: Callable[[], Launcher], on_end: Callable[[Outcome], None]
) -> list[Outcome]:
    """Wait until all runs have ended, done by own workers or by others on the same store.

    Args:
        start: starts workers; called again when another process's worker died and left a run.
        on_end: called for every run that ends.

    Returns:
        All runs, each done or failed.

    Raises:
        UserInputError: workers end without finishing a run.
    """
    known = {outcome.run_id for outcome in store.outcomes(run_ids) if outcome.ended}

    def all_ended() -> bool:
        outcomes = store.outcomes(run_ids)
        for outcome in outcomes:
            if outcome.ended and outcome.run_id not in known:
                known.add(outcome.run_id)
                on_end(outcome)
        return all(outcome.ended for outcome in outcomes)

    while not all_ended():
        if store.has_free(run_ids):
            before = len(known)
            launcher = start()
            try:
                while launcher.running():
                    time.sleep(POLL_SECONDS)
                    all_ended()
                all_ended()
                failures = launcher.failures()
                if failures and len(known) == before:
                    raise UserInputError(
                        f"workers end without finishing a run: {failures[0]}; the runs wait in the store"
                    )
                for failure in failures:
                    logger.warning("a worker failed, the others continue: %s", failure)
            finally:
                launcher.stop()
        time.sleep(POLL_SECONDS)
    return store.outcomes(run_ids)
