"""Write and read run folders.

    RUN/manifest.json              everything needed to render the run again
    RUN/level_<l>/point_cloud.ply  the field of each finished level, a standard 3DGS PLY
    RUN/level_<l>/optimizer.pt     its optimizer state, only while the next level may inherit it
    RUN/level_<l>/exposure.json    colour transforms of the training photos after that level, if exposure is compensated
    RUN/level_<l>/poses.json       corrections of the training photos' poses after that level, if these are refined
    RUN/checkpoint.pt              state of an unfinished stage, the latest
    RUN/history.jsonl              one JSON object a logging tick
    RUN/preview.jpg                an image that the viewer shows until it can render
    RUN/metrics.json, RUN/stability.json, RUN/renders/, RUN/export/, RUN/report.html   results of other commands

Every file but the history is written under a temporary name and renamed, and the manifest lists a level only after its
PLY is on the disk. So a run that is killed at any moment still opens, with the levels that were finished.

Joint training of level k also changes the finished fields. Their new versions are first written beside the old ones, to
point_cloud.with_level_<k>.ply. They count from the moment that the manifest lists level k; then they are renamed, by
the next process that opens the run for writing if this one is killed before. If level k is not listed they are removed.

Extending a finished run replaces files in the same way: new ones are written beside the old ones, to extended_<i>.NAME,
where i is the new number of iterations, and count from the moment that the manifest has this number.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

from pydantic import Field

from lapgs_plugin.errors import FieldError, RunFolderError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField, count_gaussians
from lapgs_plugin.files import (
    LOCK,
    MANIFEST,
    PREVIEW,
    TEMPORARY_PATTERN,
    FolderLock,
    atomic_write,
    one_line_errors,
)
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, read_manifest
from lapgs_plugin.runs.profiling import Overhead
from lapgs_plugin.runs.results import HistoryEntry, Metrics
from lapgs_plugin.runs.tensors import read_tensors, write_tensors
from lapgs_plugin.untrusted import read_json, read_json_lines, shortened

logger = logging.getLogger(__name__)

HISTORY, METRICS, CHECKPOINT = "history.jsonl", "metrics.json", "checkpoint.pt"
RENDERS, REPORT, STABILITY, EXPORT, CACHE = "renders", "report.html", "stability.json", "export", "cache"
PLY, OPTIMIZER, EXPOSURE, POSES = "point_cloud.ply", "optimizer.pt", "exposure.json", "poses.json"
TRAINED_ALONG = "point_cloud.with_level_{}.ply"
"""The PLY of a finished field after joint training with a finer level, until it replaces `PLY`."""
FORGET_EXTENSION = "delete it to extend the run anew"
EXTENDED = "extended_{}.{}"
"""A file of a run after its extension to a number of iterations, until it replaces the file of that name."""

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Exposures = dict[str, Annotated[list[Row], Field(min_length=3, max_length=3)]]
"""Affine colour transforms by photo, three rows of four numbers each: colours of the scene to colours of the photo."""
Poses = dict[str, Annotated[list[float], Field(min_length=6, max_length=6)]]
"""Corrections of poses by photo, as `fields.pose` describes them: a rotation vector, and a shift in world units."""


class RunArchive:
    """Write and read one run folder. One process at a time may write to it; any number may read.

    Use `create` for a new run and `open` for an existing one. `close`, or leaving the archive as a context manager,
    releases a folder opened for writing. Methods that write raise RunFolderError when the disk is full or the folder is
    not writable, and leave the previous file as it was.
    """

    def __init__(self, folder: Path, manifest: Manifest, lock: FolderLock | None) -> None:
        """Use `create` or `open`."""
        self._folder = folder
        self._manifest = manifest
        self._lock = lock

    @classmethod
    def create(cls, path: Path | str, manifest: Manifest, overwrite: bool = False) -> RunArchive:
        """Start a run in a new or empty folder and lock it for writing.

        Args:
            path: the folder; created with its parents.
            manifest: without records.
            overwrite: replace a run that is already there. Only files of a run are removed.

        Raises:
            RunFolderError: there is a run and `overwrite` is not given, the folder holds something else, another
                process is writing to it, it cannot be written, or the manifest has a value that cannot be read again.
        """
        assert not manifest.records, "a new run has no finished level"
        folder = Path(path).absolute()
        Manifest.from_json(asdict(manifest))  # refuse now what could not be read after training
        cls.require_room(folder, overwrite)
        with one_line_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        archive = cls(folder, manifest, FolderLock.acquire(folder))
        try:
            cls.require_room(folder, overwrite)  # another process may have started one before the lock was ours
            with one_line_errors(folder):
                # If this is interrupted, the folder holds the old run without its checkpoint, which the new run must
                # never continue from, or an empty run, but never a manifest without its fields.
                archive.path(CHECKPOINT).unlink(missing_ok=True)
                archive._write_json(MANIFEST, asdict(manifest), training=True)
                _remove_results(folder)
        except BaseException:
            archive.close()
            raise
        return archive

    @staticmethod
    def require_room(path: Path | str, overwrite: bool = False) -> None:
        """Check that `create` would accept the folder, before anything expensive is done. Writes nothing.

        Raises:
            RunFolderError: as `create`, except for problems that only writing shows.
        """
        folder = Path(path).absolute()
        with one_line_errors(folder, "read"):
            if folder.exists() and not folder.is_dir():
                raise RunFolderError(f"{folder} is a file, expected a folder for the run; choose another name")
        if _is_run(folder):
            if not overwrite:
                raise RunFolderError(
                    f"{folder} already holds a run; continue it with --resume (`lapgs train`, `lapgs run`) or replace "
                    "it with --overwrite"
                )
            return
        with one_line_errors(folder, "read"):
            entries = list(folder.iterdir()) if folder.exists() else []
        # A run that was killed before its first manifest leaves these two.
        strangers = [p.name for p in entries if p.name != LOCK and not p.match(TEMPORARY_PATTERN)]
        if strangers:
            raise RunFolderError(
                f"{folder} is not empty and not a run (it holds {min(strangers)}); choose a new or empty folder"
            )

    @classmethod
    def open(cls, path: Path | str, *, resume: bool = False, check: bool = True) -> RunArchive:
        """Open a run and check that the fields of its finished levels are complete.

        Args:
            path: the folder.
            resume: lock it for writing.
            check: False checks a field only when `field` reads it, for callers that can use an incomplete run.

        Raises:
            RunFolderError: there is no run, another version wrote it, a level's PLY is missing or cut short, or, with
                `resume`, another process is writing to it.
        """
        folder = Path(path).absolute()
        manifest = read_manifest(folder)
        lock = FolderLock.acquire(folder) if resume else None
        try:
            if resume:
                manifest = read_manifest(folder)  # another process may have finished a level before the lock was ours
                with one_line_errors(folder):
                    _remove_scratch(folder)
            archive = cls(folder, manifest, lock)
            if resume:
                archive._settle_fields()
            if check:
                archive._check_fields()
        except BaseException:
            if lock is not None:
                lock.release()
            raise
        return archive

    def close(self) -> None:
        """Release a folder that was locked for writing."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> RunArchive:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def manifest(self) -> Manifest:
        return self._manifest

    @property
    def available_levels(self) -> tuple[int, ...]:
        """The finished levels, coarsest first."""
        return tuple(record.level for record in self._manifest.records)

    def path(self, *parts: str) -> Path:
        """Return the path of the run folder, or of something in it."""
        return self._folder.joinpath(*parts)

    def field_path(self, level: int) -> Path:
        """Return the PLY of a level: the newest version that a finished level's training or an extension wrote."""
        if _exists(extended := self._extended_path(level, PLY)):
            return extended
        for later in reversed(self.available_levels):
            if _exists(waiting := self._waiting_path(level, later)):
                return waiting
        return self._settled_path(level)

    def _settled_path(self, level: int) -> Path:
        return self.path(f"level_{level}", PLY)

    def _extended_path(self, level: int, name: str, iterations: int | None = None) -> Path:
        """Return where a file of a level waits that an extension replaces; by default that of the manifest's run."""
        known = self._manifest.settings.get("iterations") if iterations is None else iterations
        return self.path(f"level_{level}", EXTENDED.format(known, name))

    def _waiting_path(self, level: int, later: int) -> Path:
        return self.path(f"level_{level}", TRAINED_ALONG.format(later))

    def field(self, level: int) -> GaussianField:
        """Read the field of a finished level, float32 on the CPU.

        Raises:
            RunFolderError: the level is not finished, or its PLY disagrees with the manifest.
        """
        record = self._manifest.record(level)
        self._require_file(record)
        try:
            loaded = GaussianField.load_ply(self.field_path(level))
        except FieldError as error:
            raise RunFolderError(f"level {level} of {self._folder} is damaged: {error}") from error
        self._require_count(record, len(loaded))
        return replace(loaded, signed=record.signed)

    def finish_level(
        self,
        record: LevelRecord,
        field: GaussianField,
        optimizer_state: dict[str, Any] | None = None,
        trained_along: Mapping[int, GaussianField] | None = None,
        exposure: Exposures | None = None,
        poses: Poses | None = None,
    ) -> None:
        """Write a trained level: first its PLY, then the manifest that lists it; remove its checkpoint.

        If this is interrupted before the manifest is written, the run is as before; afterwards it has this level and
        all of `trained_along`.

        Args:
            record: of the level `manifest.next_level`; the seconds that writing takes are added to its overhead as
                "archive".
            field: as trained.
            optimizer_state: for full inheritance, the state that `optimizer_state` returns to the next level; kept
                until that one is finished.
            trained_along: finished fields after joint training, by level, each with as many Gaussians as before.
            exposure: colour transforms of the training photos by name; None without compensation.
            poses: corrections of their poses; None without refinement.

        Raises:
            FieldError: a field holds NaN or inf; nothing is written.
            RunFolderError: a level of `trained_along` is not finished; nothing is written.
        """
        self._require_lock()
        trained_along = trained_along or {}
        _require_field_of(record, field)
        for level, thawed in trained_along.items():
            _require_field_of(self._manifest.record(level), thawed)
        path = self._settled_path(record.level)
        overhead = Overhead(record.overhead_seconds)
        with overhead.timed("archive"):
            for level, thawed in trained_along.items():
                waiting = self._waiting_path(level, record.level)
                with one_line_errors(waiting, training=True):
                    thawed.save_ply(waiting)
            with one_line_errors(path, training=True):
                path.parent.mkdir(exist_ok=True)
                field.save_ply(path)
            for name, learned in ((EXPOSURE, exposure), (POSES, poses)):
                if learned is not None:
                    self._write_json(str(path.with_name(name)), dict(learned), training=True)
            if optimizer_state is not None:
                write_tensors(path.with_name(OPTIMIZER), optimizer_state)
        record = replace(record, overhead_seconds=dict(overhead))
        manifest = replace(self._manifest, records=(*self._manifest.records, record))
        self._write_json(MANIFEST, asdict(manifest), training=True)
        self._manifest = manifest
        self._settle_fields()
        with one_line_errors(self._folder):
            self.path(CHECKPOINT).unlink(missing_ok=True)
            self.path(f"level_{record.level + 1}", OPTIMIZER).unlink(missing_ok=True)

    def add_overhead(self, seconds: Mapping[str, float]) -> None:
        """Add seconds by purpose to the overhead of the level that was finished last."""
        self._require_lock()
        *before, last = self._manifest.records
        total = {**last.overhead_seconds}
        for purpose, value in seconds.items():
            total[purpose] = total.get(purpose, 0.0) + value
        manifest = replace(self._manifest, records=(*before, replace(last, overhead_seconds=total)))
        self._write_json(MANIFEST, asdict(manifest), training=True)
        self._manifest = manifest

    def finish_extension(
        self,
        record: LevelRecord,
        fields: Mapping[int, GaussianField],
        exposure: Exposures | None,
        poses: Poses | None,
        settings: Mapping[str, Any],
    ) -> None:
        """Replace fields and the finest level's record of a finished run that was trained further, all at once.

        If this is interrupted before the manifest is written, the run is as before. Figures of the fields before
        (metrics, flicker, report) are removed.

        Args:
            record: of level 0.
            fields: by level, each with as many Gaussians as before; others stay.
            exposure, poses: see `finish_level`.
            settings: that changed, with "iterations".

        Raises:
            FieldError: a field holds NaN or inf; nothing is written.
        """
        self._require_lock()
        records, iterations = (*self._manifest.records[:-1], record), settings["iterations"]
        manifest = replace(self._manifest, records=records, settings={**self._manifest.settings, **settings})
        for level, field in fields.items():
            _require_field_of(manifest.record(level), field)
        for level, field in fields.items():
            path = self._extended_path(level, PLY, iterations)
            with one_line_errors(path, training=True):
                field.save_ply(path)
        for name, learned in ((EXPOSURE, exposure), (POSES, poses)):
            if learned is not None:
                path = self._extended_path(record.level, name, iterations)
                self._write_json(str(path), dict(learned), training=True)
        self._remove(METRICS, STABILITY, REPORT)
        self._write_json(MANIFEST, asdict(manifest), training=True)
        self._manifest = manifest
        self._settle_fields()
        self._remove(CHECKPOINT)

    def _remove(self, *names: str) -> None:
        with one_line_errors(self._folder):
            for name in names:
                self.path(name).unlink(missing_ok=True)

    def _settle_fields(self) -> None:
        """Rename jointly trained or extended fields to their final names, and remove those that do not count."""
        with one_line_errors(self._folder):
            for waiting in self._folder.glob(f"level_*/{EXTENDED.format('*', '*')}"):
                name = waiting.name.split(".", 1)[1]
                if waiting.name == EXTENDED.format(self._manifest.settings.get("iterations"), name):
                    waiting.replace(waiting.with_name(name))
                else:
                    waiting.unlink()
        for level in range(self._manifest.levels):
            for later in reversed(range(level)):
                waiting = self._waiting_path(level, later)
                with one_line_errors(waiting):
                    if later not in self.available_levels:
                        waiting.unlink(missing_ok=True)
                    elif waiting.exists():
                        waiting.replace(self._settled_path(level))

    def optimizer_state(self, level: int) -> dict[str, Any]:
        """Read the optimizer state that the next level inherits from a finished one, its tensors on the CPU.

        Raises:
            RunFolderError: there is none, or it cannot be read.
        """
        path = self.path(f"level_{level}", OPTIMIZER)
        if not _exists(path):
            raise RunFolderError(
                f"{path} does not exist, and the next level continues from it; start again with --overwrite"
            )
        return read_tensors(path, "start again with --overwrite")

    def exposure(self, level: int) -> Exposures | None:
        """Read the colour transforms of the training photos after a finished level; None without compensation.

        Raises:
            RunFolderError: the file is damaged.
        """
        found: Exposures | None = self._learned(level, EXPOSURE, Exposures)
        return found

    def poses(self, level: int) -> Poses | None:
        """Read the corrections of the training photos' poses after a finished level; None without refinement.

        Raises:
            RunFolderError: the file is damaged.
        """
        found: Poses | None = self._learned(level, POSES, Poses)
        return found

    def _learned(self, level: int, name: str, kind: Any) -> Any:
        """Read what a level learned of the training photos; None if it has no such file."""
        path = self._extended_path(level, name)
        if not _exists(path):
            path = self.path(f"level_{level}", name)
        if not _exists(path):
            return None
        return read_json(path, kind, error=RunFolderError, advice="train again with --overwrite")

    def append_history(self, entry: dict[str, Any]) -> None:
        """Append one entry to the history: JSON with finite numbers, with "level" and "iteration"."""
        self._require_lock()
        assert {"level", "iteration"} <= entry.keys(), "a history entry says where in the run it belongs"
        line = json.dumps(entry, allow_nan=False) + "\n"
        path = self.path(HISTORY)
        with one_line_errors(path, training=True), path.open("a", encoding="utf-8") as stream:
            stream.write(line)

    def history(self) -> list[dict[str, Any]]:
        """Return all entries in the order they were added. A last line that a crash cut short is left out.

        Raises:
            RunFolderError: another line is damaged.
        """
        path = self.path(HISTORY)
        return read_json_lines(path, HistoryEntry, error=RunFolderError) if _exists(path) else []

    def rewind_history(self, level: int, iteration: int) -> None:
        """Remove the entries after an iteration of a level, which a resumed run adds again.

        Training starts with level L-1, so an entry with a lower level is later.
        """
        self._require_lock()
        kept = [entry for entry in self.history() if (-entry["level"], entry["iteration"]) <= (-level, iteration)]
        text = "".join(json.dumps(entry) + "\n" for entry in kept)
        path = self.path(HISTORY)
        with one_line_errors(path, training=True), atomic_write(path) as stream:
            stream.write(text.encode())

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Replace the run's metrics: JSON with finite numbers. Needs no lock."""
        self._write_json(METRICS, metrics)

    def write_stability(self, figures: dict[str, Any]) -> None:
        """Replace the run's flicker metrics: JSON with finite numbers. Needs no lock."""
        self._write_json(STABILITY, figures)

    def metrics(self) -> dict[str, Any] | None:
        """Read the run's metrics; None if they were never measured.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = self.path(METRICS)
        advice = "write it again with `lapgs eval`"
        return dict(read_json(path, Metrics, error=RunFolderError, advice=advice)) if _exists(path) else None

    def save_checkpoint(self, state: dict[str, Any], extends_to: int | None = None) -> None:
        """Replace the checkpoint of the level in training.

        Args:
            state: as `tensors.write_tensors` takes it.
            extends_to: of a finished run that is trained further, the number of iterations that it will have.
        """
        self._require_lock()
        level = self._manifest.next_level
        of = {"level": 0, "extends_to": extends_to} if level is None else {"level": level}
        write_tensors(self.path(CHECKPOINT), {**of, "state": state})

    @property
    def extends_to(self) -> int | None:
        """Iterations to which an interrupted extension was to train the finished run; None if there is none.

        Raises:
            RunFolderError: the checkpoint cannot be read.
        """
        path = self.path(CHECKPOINT)
        if not self._manifest.complete or not _exists(path):
            return None
        found = read_tensors(path, FORGET_EXTENSION).get("extends_to")
        return found if type(found) is int and found > int(self._manifest.settings.get("iterations", 0)) else None

    def load_checkpoint(self) -> dict[str, Any] | None:
        """Read the checkpoint of the next level to train, its tensors on the CPU; None if there is none.

        That of a finished run is of its interrupted extension.

        Raises:
            RunFolderError: it cannot be read, or its level is neither finished nor the next.
        """
        path = self.path(CHECKPOINT)
        if not _exists(path):
            return None
        advice = "delete it to continue from the last finished level"
        saved = read_tensors(path, advice)
        level, state = saved.get("level"), saved.get("state")
        if type(level) is not int or not isinstance(state, dict):
            found = f"level {shortened(level)} and a state that is a {type(state).__name__}"
            raise RunFolderError(f"{path} holds {found}, expected a number and a dictionary; {advice}")
        if level == self._manifest.next_level or (level == 0 and self.extends_to is not None):
            return state
        if level not in self.available_levels:
            raise RunFolderError(f"{path} is of level {level}, expected {self._manifest.next_level}; {advice}")
        # A run killed right after finishing a level leaves the checkpoint of that level.
        logger.warning("%s is of level %d, which is finished: it is not used", path, level)
        return None

    def _check_fields(self) -> None:
        for record in self._manifest.records:
            self._require_file(record)
            try:
                count = count_gaussians(self.field_path(record.level))
            except FieldError as error:
                raise RunFolderError(
                    f"level {record.level} of {self._folder} is damaged: {error}; train it again with --overwrite"
                ) from error
            self._require_count(record, count)

    def _require_file(self, record: LevelRecord) -> None:
        path = self.field_path(record.level)
        with one_line_errors(path, "read"):
            is_there = path.is_file()
        if not is_there:
            raise RunFolderError(
                f"level {record.level} of {self._folder} is missing: no {path.name}; train it again with --overwrite"
            )

    def _require_count(self, record: LevelRecord, count: int) -> None:
        if count != record.num_gaussians:
            raise RunFolderError(
                f"level {record.level} of {self._folder} holds {count} Gaussians, the manifest says "
                f"{record.num_gaussians}; train it again with --overwrite"
            )

    def _write_json(self, name: str, values: dict[str, Any], training: bool = False) -> None:
        text = json.dumps(values, indent=2, allow_nan=False) + "\n"
        with one_line_errors(self.path(name), training=training), atomic_write(self.path(name)) as stream:
            stream.write(text.encode())

    def _require_lock(self) -> None:
        assert self._lock is not None, "open the run with resume=True to write to it"


def _require_field_of(record: LevelRecord, field: GaussianField) -> None:
    """Check that a field belongs to a record and is finite.

    Raises:
        FieldError: it holds NaN or inf.
    """
    assert (len(field), field.signed) == (record.num_gaussians, record.signed), "the record is of another field"
    try:
        field.require_finite()
    except FieldError as error:
        raise FieldError(f"level {record.level}: {error}") from error


def _exists(path: Path) -> bool:
    """Return whether there is a file.

    Raises:
        RunFolderError: its folder cannot be read.
    """
    with one_line_errors(path, "read"):
        return path.exists()


def _is_run(folder: Path) -> bool:
    """Return whether any version of this package wrote the manifest; other programs write a manifest.json, too.

    An unreadable one counts as ours if there is a history beside it.
    """
    with one_line_errors(folder, "read"):
        if not (folder / MANIFEST).is_file():
            return False
        try:
            values = read_json(folder / MANIFEST, dict[str, Any])
        except UserInputError:
            return (folder / HISTORY).is_file()
    return "lapgs_plugin" in str(values.get("created_by"))


def _remove_results(folder: Path) -> None:
    """Remove the files of a previous run and nothing else."""
    _remove_scratch(folder)
    for name in (HISTORY, METRICS, STABILITY, REPORT, PREVIEW):
        (folder / name).unlink(missing_ok=True)
    for name in (RENDERS, EXPORT):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for level in folder.glob("level_*/"):
        (level / PLY).unlink(missing_ok=True)
        (level / OPTIMIZER).unlink(missing_ok=True)
        (level / EXPOSURE).unlink(missing_ok=True)
        (level / POSES).unlink(missing_ok=True)
        for pattern in (TRAINED_ALONG.format("*"), EXTENDED.format("*", "*")):
            for waiting in level.glob(pattern):
                waiting.unlink()
        if not any(level.iterdir()):
            level.rmdir()


def _remove_scratch(folder: Path) -> None:
    """Remove what a killed run left: temporary files, cached predictions, an incomplete line of history."""
    for pattern in (TEMPORARY_PATTERN, f"level_*/{TEMPORARY_PATTERN}"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
    if (folder / CACHE).is_dir():
        shutil.rmtree(folder / CACHE)
    if (folder / HISTORY).exists():
        with (folder / HISTORY).open("r+b") as stream:
            stream.truncate(stream.read().rfind(b"\n") + 1)
