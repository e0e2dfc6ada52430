"""An experiment from its file to its finished results: prepared, launched, followed, reported."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.experiments.commands import Places, run_steps
from lapgs_plugin.experiments.expansion import PlannedRun, SceneSpec
from lapgs_plugin.experiments.launchers import Launcher
from lapgs_plugin.experiments.store import DONE, FAILED, PATIENCE, Job, Outcome, ResultStore
from lapgs_plugin.files import FolderLock, one_line_errors

RUNS, LOGS, SCENES, STORE = "runs", "logs", "scenes", "results.sqlite"
LOOK_EVERY = 0.5
"""Seconds between two looks at the store."""


@dataclass(frozen=True)
class Folder:
    """Where everything of an experiment is kept."""

    path: Path

    @property
    def store(self) -> Path:
        return self.path / STORE

    def logs(self, name: str) -> Path:
        return self.path / LOGS / name


def prepare(
    planned: Sequence[PlannedRun],
    scenes: Sequence[SceneSpec],
    places: Places,
    folder: Folder,
    evaluate: Sequence[str] | None,
) -> list[Job]:
    """The jobs of all runs that are different, in their order, after checking that their files are there.

    Args:
        planned: the runs.
        scenes: that they are trained on.
        places: where scenes and checkouts lie.
        folder: of the experiment.
        evaluate: options of `lapgs eval`; None leaves it out.

    Raises:
        UserInputError: a scene or a checkout is missing.
    """
    where = {scene.name: _sample(scene, folder) if scene.sample else places.scene(scene) for scene in scenes}
    names = dict.fromkeys(each.spec.checkout for each in planned if each.spec.checkout is not None)
    checkouts = {name: places.checkout(name) for name in names}
    jobs: dict[str, Job] = {}
    for spec in (each.spec for each in planned):
        own = folder.path.absolute() / RUNS / spec.run_id
        checkout = checkouts[spec.checkout] if spec.checkout else None
        steps = run_steps(spec, where[spec.scene], checkout, own, evaluate)
        log = str(folder.logs(f"{spec.run_id}.log").absolute())
        jobs.setdefault(spec.run_id, Job(spec.run_id, spec, str(own), log, tuple(steps), evaluate is not None))
    return list(jobs.values())


def make_samples(scenes: Sequence[SceneSpec], folder: Folder) -> None:
    """Make the sample scenes that are not there yet; one process at a time.

    Raises:
        UserInputError: a size is none.
        RunFolderError: another process holds the folder and does not come to an end.
    """
    missing = [(scene, scene.sample) for scene in scenes if scene.sample and not _sample(scene, folder).is_dir()]
    if not missing:
        return
    from lapgs_plugin.scenes.sample import make_sample_scene  # needs what reads scenes

    place = folder.path.absolute() / SCENES
    with one_line_errors(place):
        place.mkdir(parents=True, exist_ok=True)
    lock = _waited_for(place)
    try:
        for scene, sample in missing:
            if _sample(scene, folder).is_dir():  # another process made it meanwhile
                continue
            width, _, height = sample.size.partition("x")
            if not (width.isdecimal() and height.isdecimal()):
                raise UserInputError(f"scene {scene.name}: size {sample.size!r}, expected WIDTHxHEIGHT")
            make_sample_scene(
                _sample(scene, folder),
                width=int(width),
                height=int(height),
                views=sample.views,
                points=sample.points,
                progress=True,
            )
    finally:
        lock.release()


def _waited_for(place: Path) -> FolderLock:
    """The lock of a folder that another process may have for a while."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return FolderLock.acquire(place)
        except RunFolderError:
            if time.monotonic() > end:
                raise
        time.sleep(LOOK_EVERY)


def _sample(scene: SceneSpec, folder: Folder) -> Path:
    return folder.path.absolute() / SCENES / scene.name


def execute(
    store: ResultStore, run_ids: Sequence[str], start: Callable[[], Launcher], say: Callable[[Outcome], None]
) -> list[Outcome]:
    """Have all runs done, by workers of one's own and by whoever else works on the same store.

    Args:
        store: that has them.
        run_ids: the runs.
        start: starts workers; again when a worker of somebody else's died and left a run.
        say: told of every run that ends meanwhile.

    Returns:
        All runs as they are in the end, each done or failed.

    Raises:
        UserInputError: workers end without doing anything.
    """
    known = {outcome.run_id for outcome in store.outcomes(run_ids) if _ended(outcome)}

    def look() -> list[Outcome]:
        outcomes = store.outcomes(run_ids)
        for outcome in outcomes:
            if _ended(outcome) and outcome.run_id not in known:
                known.add(outcome.run_id)
                say(outcome)
        return outcomes

    while not all(_ended(outcome) for outcome in look()):
        if store.has_free(run_ids):
            before = len(known)
            launcher = start()
            try:
                while launcher.running():
                    time.sleep(LOOK_EVERY)
                    look()
                look()
                if len(known) == before and (troubles := launcher.troubles()):
                    raise UserInputError(
                        f"workers end without finishing a run: {troubles[0]}; the runs wait in the store"
                    )
            finally:
                launcher.stop()
        time.sleep(LOOK_EVERY)
    return store.outcomes(run_ids)


def _ended(outcome: Outcome) -> bool:
    return outcome.state in (DONE, FAILED)
