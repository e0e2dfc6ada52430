"""Run COLMAP's steps in a process of their own: features, matches, models."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from lapgs_plugin.errors import LapgsError, UserInputError
from lapgs_plugin.scenes.output import check_written, write_model
from lapgs_plugin.scenes.parallel import ProgressCallback
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.settings import AUTO, EXHAUSTIVE, GLOBAL, RETRIEVAL, SEQUENTIAL, PrepareSettings

VERIFIED = 15
"""Fewest matches of one geometry that link two photos, as in COLMAP's mapper."""
MOST_GUIDED = 500
"""Most pairs that are matched again, guided by their geometry, which takes seconds a pair on a processor."""
MOST_EXHAUSTIVE = 500
"""Most photos of which the matcher "auto" compares all pairs."""
SIMILAR = 40
"""Photos that each photo is compared with by the matcher "retrieval"."""
HAS_GLOBAL = hasattr(pycolmap, "global_mapping")
HAS_VOCABULARY = hasattr(getattr(pycolmap, "VisualIndex", None), "build")
LOOP_FROM = 40
"""Fewest photos of which sequential matching looks for loops, because the camera may come back to a place."""
LOOP_EVERY = 10
"""Step between photos that are compared with similar ones to find loops."""
LOOP_SIMILAR = 20
"""Similar photos that each of these is compared with."""
DEFAULT_MODEL = "OPENCV"
"""Camera model that "auto" fits first."""

GLOBAL_STEPS = 5
"""Steps that the global mapper logs."""

POLL_SECONDS = 0.2
LOG = "colmap.log"
WORKER = Path(__file__).with_name("colmap_worker")


def require_colmap_for(settings: PrepareSettings) -> None:
    """Raise a UserInputError if the installed pycolmap lacks something that the settings ask for."""
    if settings.matcher == RETRIEVAL and not HAS_VOCABULARY:
        raise UserInputError(
            f"--matcher retrieval: pycolmap {pycolmap.__version__} has none; upgrade it to 4.2 or newer"
        )
    if settings.mapper == GLOBAL and not HAS_GLOBAL:
        raise UserInputError(
            f"--mapper global: pycolmap {pycolmap.__version__} has none; leave it out or upgrade pycolmap"
        )


def chosen_matcher(job: Job) -> str:
    """Return the matcher that the user chose, or the one for the kind and number of photos."""
    if job.settings.matcher != AUTO:
        return job.settings.matcher
    if job.source.clip is not None:
        return SEQUENTIAL
    return RETRIEVAL if len(job.names) > MOST_EXHAUSTIVE and HAS_VOCABULARY else EXHAUSTIVE


def find_features(job: Job, camera_mode: str, rig: Sequence[dict[str, Any]] = ()) -> None:
    """Find the features of all photos.

    Args:
        job: of the photos.
        camera_mode: COLMAP's name for which of them share a camera.
        rig: cameras of a rig by folder, as `colmap_worker` takes them; none without a rig.
    """
    asked = job.settings.camera_model
    options = {
        "photos": str(job.photos.absolute()),
        "names": job.names,
        "camera_model": DEFAULT_MODEL if asked == AUTO else asked,
        "camera_mode": camera_mode,
        "rig": rig,
        "max_size": job.settings.max_size,
        "masks": str(job.masks.absolute()) if job.masks.is_dir() else None,
    }
    phase = Phase("Finding features", "photos", len(job.names), lambda: count_rows(job.database, "descriptors"))
    _run_step(job, "features", options, [phase])


def match_pairs(job: Job, rig: bool = False) -> None:
    """Match the features of those pairs of photos that the matcher chooses; of a `rig` those of different frames."""
    count, loops, matcher = len(job.names), _loops(job), chosen_matcher(job)
    total = {
        EXHAUSTIVE: count * (count - 1) // 2,
        SEQUENTIAL: neighbour_pairs(count) + loops * LOOP_SIMILAR,  # at most
        RETRIEVAL: count * min(SIMILAR, count - 1),  # at most: many pairs are found from both sides
    }[matcher]
    phases = [Phase("Matching pairs", "pairs", total, lambda: count_rows(job.database, "two_view_geometries"))]
    if matcher == RETRIEVAL or (matcher == SEQUENTIAL and loops):
        indexed = re.compile(rb"Indexing image \[(\d+)/")
        phases.insert(0, Phase("Comparing photos", "photos", count, lambda: _logged(job, indexed)))
    _run_step(job, "pairs", {**_pairing(job), "rig": rig}, phases)


def match_more(job: Job) -> Path | None:
    """Match more features of the pairs with a known geometry, guided by it, and return a database with these matches.

    Returns:
        The database; None if there are no such pairs, or more than `MOST_GUIDED`.
    """
    guided = job.work / "guided.db"
    with closing(sqlite3.connect(job.database)) as connection:
        known = "FROM two_view_geometries WHERE rows >= ?"
        (total,) = connection.execute(f"SELECT COUNT(*) {known}", (VERIFIED,)).fetchone()
    if not 0 < total <= MOST_GUIDED:
        return None
    if not guided.is_file():
        partial = guided.with_suffix(".partial")
        _copy(job.database, partial)
        with closing(sqlite3.connect(partial)) as connection, connection:
            # COLMAP matches pairs without a geometry again.
            connection.execute(f"DELETE {known}", (VERIFIED,))
        before = count_rows(partial, "two_view_geometries")
        options = {**_pairing(job), "database": str(partial.absolute()), "guided": True}
        phase = Phase("Matching more", "pairs", total, lambda: count_rows(partial, "two_view_geometries") - before)
        _run_step(job, "pairs", options, [phase])
        with closing(sqlite3.connect(partial)) as connection:
            # COLMAP leaves matches in its log if the progress bar reads the database while COLMAP closes it.
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        partial.rename(guided)
    return guided


def configure_rig(job: Job, prefixes: Sequence[str], placed: pycolmap.Reconstruction) -> Path:
    """Return a copy of the database in which photos of one moment are a frame of a rig.

    Args:
        job: of the photos.
        prefixes: of the photos' names by camera, that of reference first. Names that are equal behind them are of one
            moment.
        placed: its mean poses of cameras against that of reference are the rig's, and its lenses are taken.
    """
    rigged = job.work / "rig.db"
    if not rigged.is_file():
        partial, folder = rigged.with_suffix(".partial"), job.work / "free"
        _copy(job.database, partial)
        shutil.rmtree(folder, ignore_errors=True)
        write_model(placed, folder)
        options = {"database": str(partial.absolute()), "prefixes": list(prefixes), "model": str(folder.absolute())}
        _run_step(job, "rig", options, [Phase("Finding the rig", "rigs", 1, lambda: 0)])
        partial.rename(rigged)
    return rigged


def _copy(database: Path, copy: Path) -> None:
    """Copy a database with its write-ahead log, after removing an interrupted copy, whose log would be added."""
    for suffix in ("", "-wal", "-shm"):
        Path(f"{copy}{suffix}").unlink(missing_ok=True)
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)


def _pairing(job: Job) -> dict[str, Any]:
    """Return the options of the step that matches pairs."""
    matcher = chosen_matcher(job)
    return {
        "matcher": matcher,
        "similar": SIMILAR if matcher == RETRIEVAL else LOOP_SIMILAR,
        "every": LOOP_EVERY if _loops(job) else 0,
        "tree": str((job.work / "tree.bin").absolute()),
    }


def _loops(job: Job) -> int:
    """Return how many photos sequential matching also compares with similar ones."""
    return -(-len(job.names) // LOOP_EVERY) if len(job.names) >= LOOP_FROM and HAS_VOCABULARY else 0


def neighbour_pairs(count: int) -> int:
    """Return the number of pairs in sequential matching: each photo with those 1, 2, 4, 8, ... ahead."""
    return sum(max(0, count - 2**power) for power in range(pycolmap.SequentialPairingOptions().overlap))


@dataclass(frozen=True)
class Attempt:
    """Describe an attempt at placing the cameras.

    Attributes:
        title: of the progress bar.
        folder: name of the folder of its models.
        lens: camera model to fit; None for the database's.
        mapper, database: to use instead of the job's.
        rig: whether lenses and the rig of the photos are known.
    """

    title: str
    folder: str
    lens: str | None = None
    mapper: str | None = None
    database: Path | None = None
    rig: bool = False


def map_photos(job: Job, attempt: Attempt) -> list[pycolmap.Reconstruction]:
    """Recover models into the attempt's folder, unless it is there, and return them."""
    folder = job.work / attempt.folder
    if not folder.is_dir():
        unfinished, placed = folder.with_suffix(".partial"), job.work / "placed"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        placed.write_bytes(b"")
        options = {
            "photos": str(job.photos.absolute()),
            "models": str(unfinished),
            "placed": str(placed),
            "mapper": attempt.mapper or job.settings.mapper,
            "rig": attempt.rig,
        }
        if attempt.lens is not None:
            other = job.work / "simple.db"
            _copy(attempt.database or job.database, other)
            options |= {"database": str(other.absolute()), "camera_model": attempt.lens}
        elif attempt.database is not None:
            options["database"] = str(attempt.database.absolute())
        if options["mapper"] == GLOBAL:
            running = re.compile(rb"=== Running ()")
            phase = Phase(attempt.title, "steps", GLOBAL_STEPS, lambda: max(0, _logged(job, running) - 1))
        else:
            phase = Phase(attempt.title, "photos", len(job.names), lambda: _most_placed(placed), complete=False)
        _run_step(job, "map", options, [phase])
        for written in unfinished.iterdir():
            check_written(written)
        unfinished.rename(folder)
    return [pycolmap.Reconstruction(model) for model in sorted(folder.iterdir())]


def count_rows(database: Path, table: str) -> int:
    """Return the number of rows in a table of COLMAP's database, also while COLMAP writes it; 0 before it exists."""
    try:
        uri = f"{database.absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=POLL_SECONDS)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # locked, or still being made
        return 0


def _logged(job: Job, pattern: re.Pattern[bytes]) -> int:
    """Return the last number that a pattern finds in COLMAP's log, or how often it is found if it has no number."""
    with suppress(OSError):
        numbers = pattern.findall((job.work / LOG).read_bytes())
        return int(numbers[-1] or len(numbers)) if numbers else 0
    return 0


def _most_placed(file: Path) -> int:
    """Return the number of photos in the largest model so far: a line for each model, a byte for each photo."""
    return max(map(len, file.read_bytes().split(b"\n")))


@dataclass(frozen=True)
class Phase:
    """Describe a progress bar of a step of `colmap_worker`.

    Attributes:
        title, unit, total: of the bar.
        done: returns how many items are finished.
        complete: whether all are when the step succeeds.
    """

    title: str
    unit: str
    total: int
    done: Callable[[], int]
    complete: bool = True


def _run_step(job: Job, step: str, options: dict[str, Any], phases: Sequence[Phase]) -> None:
    """Run a step of `colmap_worker` with a progress bar for each phase. An interruption stops it at once.

    Raises:
        LapgsError: it failed, with COLMAP's last error.
    """
    order = json.dumps({"step": step, "database": str(job.database.absolute()), **options})
    title, log = phases[-1].title, job.work / LOG
    with job.timed(title), log.open("wb") as words:
        command = [sys.executable, str(WORKER)]
        worker = subprocess.Popen(
            command, bufsize=0, stdin=subprocess.PIPE, stdout=words, stderr=words, start_new_session=True
        )
        assert worker.stdin is not None
        try:
            with suppress(BrokenPipeError):  # reported by its exit code
                worker.stdin.write(order.encode() + b"\n")
            for phase in phases:
                with job.bar(phase.title, phase.unit) as seen:
                    _show_phase(worker, phase, seen, last=phase is phases[-1])
        finally:
            worker.kill()
            worker.wait()
            worker.stdin.close()
    if worker.returncode != 0:
        raise LapgsError(
            f"{job.work.parent}: COLMAP failed at {title.lower()} ({_last_words(log, worker.returncode)}); check free "
            f"space and memory, then repeat the command to continue, or remove {job.work} to start over"
        )


def _show_phase(worker: subprocess.Popen[bytes], phase: Phase, seen: ProgressCallback, last: bool) -> None:
    """Show the progress of a phase until it, or the last one's process, ends."""
    total, done = phase.total, phase.done()
    seen(done, total)
    while worker.poll() is None and (last or done < total):
        with suppress(subprocess.TimeoutExpired):
            worker.wait(POLL_SECONDS)
        done = max(done, phase.done())  # a busy database gives no count
        seen(min(done, total - 1), total)  # COLMAP works on after its last item
    if not worker.returncode:
        seen(total if phase.complete else min(max(done, phase.done()), total), total)


def _last_words(log: Path, code: int) -> str:
    """Return the reason for a failure: an exception of the worker, COLMAP's last error, or the exit code."""
    lines = log.read_text(errors="replace").splitlines()
    reasons = [line for line in lines if re.match(r"[EF][0-9]{8} |(\w+\.)*\w*(Error|Exception): ", line)]
    return reasons[-1].strip() if reasons else f"exit code {code}"
