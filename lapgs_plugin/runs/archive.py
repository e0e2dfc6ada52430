"""Write and read run folders; `layout` lists their files, and how a run that is killed at any moment still opens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from lapgs_plugin.errors import FieldError, RunFolderError
from lapgs_plugin.fields.gaussian_field import GaussianField, count_gaussians
from lapgs_plugin.files import MANIFEST, FolderLock, one_line_errors
from lapgs_plugin.runs.layout import (
    CHECKPOINT,
    EXPOSURE,
    EXTENDED,
    GRIDS,
    METRICS,
    OPTIMIZER,
    PLY,
    POSES,
    REPORT,
    STABILITY,
    TRAINED_ALONG,
    exists,
    remove_results,
    remove_scratch,
    require_own_results,
    require_room,
)
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, read_manifest
from lapgs_plugin.runs.profiling import Overhead
from lapgs_plugin.runs.run_files import RunFiles
from lapgs_plugin.runs.tensors import read_tensors, write_tensors
from lapgs_plugin.runs.training_figures import sums
from lapgs_plugin.untrusted import read_json

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Exposures = dict[str, Annotated[list[Row], Field(min_length=3, max_length=3)]]
"""Affine colour transforms by photo, three rows of four numbers each: colours of the scene to colours of the photo."""
Grids = dict[str, Tensor]
"""Bilateral grids by photo, as `ops.bilateral_grid` describes them."""
Poses = dict[str, Annotated[list[float], Field(min_length=6, max_length=6)]]
"""Corrections of poses by photo, as `fields.pose` describes them: a rotation vector, and a shift in world units."""


REMEMBERED_BYTES = 1 << 30
"""Most bytes of a field that is remembered."""


class RunArchive(RunFiles):
    """Write and read one run folder. One process at a time may write to it; any number may read.

    Use `create` for a new run and `open` for an existing one. `close`, or leaving the archive as a context manager,
    releases a folder opened for writing. Methods that write raise RunFolderError when the disk is full or the folder is
    not writable, and leave the previous file as it was. A folder with links among its entries is not opened for
    writing; reading follows links to files.
    """

    def __init__(self, folder: Path, manifest: Manifest, lock: FolderLock | None) -> None:
        super().__init__(folder, manifest, lock)
        # The level that was finished last, as its PLY has it: the next one starts from it, renders it for all views and
        # trains it along, and each reading of it takes as long as some hundred iterations.
        self._remembered: dict[int, GaussianField] = {}

    @classmethod
    def create(
        cls, path: Path | str, manifest: Manifest, overwrite: bool = False, since: int | None = None
    ) -> RunArchive:
        """Start a run in a new or empty folder and lock it for writing.

        Args:
            path: the folder; created with its parents.
            overwrite: replace a run that is already there. Only files of a run are removed.
            since: nanoseconds as of `os.stat`; files written since then, by the calling program, may be there.

        Raises:
            RunFolderError: there is a run and `overwrite` is not given, the folder holds something else, another
                process is writing to it, it cannot be written, or the manifest has a value that cannot be read again.
        """
        assert not manifest.records, "a new run has no finished level"
        folder = Path(path)
        Manifest.from_json(asdict(manifest))  # refuse now a value that could not be read after training
        require_room(folder, overwrite, since)
        with one_line_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        require_own_results(folder)
        archive = cls(folder, manifest, FolderLock.acquire(folder))
        try:
            require_room(folder, overwrite, since)  # another process may have started one before the lock was ours
            with one_line_errors(folder):
                # If this is interrupted, the folder holds the old run without its checkpoint, which the new run must
                # never continue from, or an empty run, but never a manifest without its fields.
                archive.path(CHECKPOINT).unlink(missing_ok=True)
                archive._write_json(archive.path(MANIFEST), asdict(manifest), training=True)
                remove_results(folder)
        except BaseException:
            archive.close()
            raise
        return archive

    @classmethod
    def open(cls, path: Path | str, *, resume: bool = False, check: bool = True) -> RunArchive:
        """Open a run and check that the fields of its finished levels are complete.

        Args:
            resume: lock it for writing.
            check: False checks a field only when `field` reads it, for callers that can use an incomplete run.

        Raises:
            RunFolderError: there is no run, another version wrote it, a level's PLY is missing or cut short, or, with
                `resume`, another process is writing to it.
        """
        folder = Path(path)
        manifest = read_manifest(folder)
        if resume:
            require_own_results(folder)
        lock = FolderLock.acquire(folder) if resume else None
        try:
            if resume:
                manifest = read_manifest(folder)  # another process may have finished a level before the lock was ours
                with one_line_errors(folder):
                    remove_scratch(folder)
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

    def field_path(self, level: int) -> Path:
        """Return the PLY of a level: the newest version that a finished level's training or an extension wrote."""
        if exists(extended := self._extended_path(level, PLY)):
            return extended
        for later in reversed(self.available_levels):
            if exists(waiting := self._waiting_path(level, later)):
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
        """Return the field of a finished level, float32 on the CPU. It must not be written to.

        Raises:
            RunFolderError: the level is not finished, or its PLY disagrees with the manifest.
        """
        record = self._manifest.record(level)
        self._require_file(record)
        if level in self._remembered:
            return self._remembered[level]
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
        grids: Grids | None = None,
    ) -> None:
        """Write a trained level: first its PLY, then the manifest that lists it; remove its checkpoint.

        If this is interrupted before the manifest is written, the run is as before; afterwards it has this level and
        all of `trained_along`.

        Args:
            record: of the level `manifest.next_level`; the seconds that writing takes are added to its overhead as
                "archive".
            field: as trained, on any device.
            optimizer_state: for full inheritance, the state that `optimizer_state` returns to the next level; kept
                until that one is finished.
            trained_along: finished fields after joint training, by level, each with as many Gaussians as before.
            exposure: colour transforms of the training photos by name; None without compensation.
            poses: corrections of their poses; None without refinement.
            grids: bilateral grids of the training photos; None without.

        Raises:
            FieldError: a field holds NaN or inf, or is not the one that its record describes; nothing is written.
            RunFolderError: another level is the next one, a level of `trained_along` is not finished, or the run was
                opened for reading; nothing is written.
        """
        self._require_lock()
        if record.level != self._manifest.next_level:
            expected = "no more" if self._manifest.next_level is None else f"level {self._manifest.next_level}"
            raise RunFolderError(
                f"{self._folder}: level {record.level} cannot be finished now, expected {expected}; levels are "
                "finished once each, coarsest first, and a resumed loop skips those in available_levels"
            )
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
                    self._write_json(path.with_name(name), dict(learned), training=True)
            if grids is not None:
                write_tensors(path.with_name(GRIDS), grids)
            if optimizer_state is not None:
                write_tensors(path.with_name(OPTIMIZER), optimizer_state)
        record = replace(record, overhead_seconds=dict(overhead))
        self._write_manifest(replace(self._manifest, records=(*self._manifest.records, record)))
        self._settle_fields()
        self._remembered = _copied(record, field)
        with one_line_errors(self._folder):
            self.path(CHECKPOINT).unlink(missing_ok=True)
            self.path(f"level_{record.level + 1}", OPTIMIZER).unlink(missing_ok=True)

    def add_overhead(self, seconds: Mapping[str, float]) -> None:
        """Add seconds by purpose to the overhead of the level that was finished last."""
        self._require_lock()
        *before, last = self._manifest.records
        last = replace(last, overhead_seconds=sums([last.overhead_seconds, seconds]))
        self._write_manifest(replace(self._manifest, records=(*before, last)))

    def change_settings(self, settings: Mapping[str, Any]) -> None:
        """Write settings of the trainer into the manifest that an unfinished run goes on with."""
        self._require_lock()
        self._write_manifest(replace(self._manifest, settings={**self._manifest.settings, **settings}))

    def finish_extension(
        self,
        record: LevelRecord,
        fields: Mapping[int, GaussianField],
        exposure: Exposures | None,
        poses: Poses | None,
        grids: Grids | None,
        settings: Mapping[str, Any],
    ) -> None:
        """Replace fields and the finest level's record of a finished run that was trained further, all at once.

        If this is interrupted before the manifest is written, the run is as before. Figures of the fields before
        (metrics, flicker, report) are removed.

        Args:
            record: of level 0.
            fields: by level, each with as many Gaussians as before; others stay.
            exposure, poses, grids: see `finish_level`.
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
                self._write_json(path, dict(learned), training=True)
        if grids is not None:
            write_tensors(self._extended_path(record.level, GRIDS, iterations), grids)
        self._remove(METRICS, STABILITY, REPORT)
        self._write_manifest(manifest)
        self._settle_fields()
        self._remove(CHECKPOINT)

    def _write_manifest(self, manifest: Manifest) -> None:
        self._write_json(self.path(MANIFEST), asdict(manifest), training=True)
        self._manifest = manifest

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
        if not exists(path):
            raise RunFolderError(
                f"{path} does not exist, and the next level continues from it; start again with --overwrite"
            )
        return read_tensors(path, "start again with --overwrite")

    def exposure(self, level: int) -> Exposures | None:
        """Read the colour transforms of the training photos after a finished level; None without compensation.

        Raises:
            RunFolderError: the file is damaged.
        """
        learned: Exposures | None = self._learned(level, EXPOSURE, Exposures)
        return learned

    def poses(self, level: int) -> Poses | None:
        """Read the corrections of the training photos' poses after a finished level; None without refinement.

        Raises:
            RunFolderError: the file is damaged.
        """
        learned: Poses | None = self._learned(level, POSES, Poses)
        return learned

    def grids(self, level: int) -> Grids | None:
        """Read the bilateral grids of the training photos after a finished level; None without.

        Raises:
            RunFolderError: the file is damaged.
        """
        advice = "train again with --overwrite"
        if (path := self._learned_path(level, GRIDS)) is None:
            return None
        learned = read_tensors(path, advice)
        shapes = {getattr(grid, "shape", None) for grid in learned.values()}
        for name, grid in learned.items():
            fits = isinstance(grid, Tensor) and grid.dtype == torch.float32 and grid.ndim == 4 and grid.shape[-1] == 12
            if not (fits and grid.numel() > 0 and len(shapes) == 1 and bool(torch.isfinite(grid).all())):
                raise RunFolderError(
                    f"{path}: {name} is no bilateral grid, expected finite float32 (y, x, l, 12), of one shape for all "
                    f"photos; {advice}"
                )
        return learned

    def _learned(self, level: int, name: str, kind: Any) -> Any:
        """Read a JSON file about the training photos that a level wrote; None if it has none."""
        if (path := self._learned_path(level, name)) is None:
            return None
        return read_json(path, kind, error=RunFolderError, advice="train again with --overwrite")

    def _learned_path(self, level: int, name: str) -> Path | None:
        """Return a file about the training photos that a level wrote, or an extension of it; None if it has none."""
        return next(filter(exists, (self._extended_path(level, name), self.path(f"level_{level}", name))), None)

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
        if not exists(path):
            raise RunFolderError(
                f"level {record.level} of {self._folder} is missing: no {path.name}; train it again with --overwrite"
            )

    def _require_count(self, record: LevelRecord, count: int) -> None:
        if count != record.num_gaussians:
            raise RunFolderError(
                f"level {record.level} of {self._folder} holds {count} Gaussians, the manifest says "
                f"{record.num_gaussians}; train it again with --overwrite"
            )


def _require_field_of(record: LevelRecord, field: GaussianField) -> None:
    """Check that a field belongs to a record and is finite.

    Raises:
        FieldError: it does not, or holds NaN or inf.
    """
    if field.signed != record.signed:
        kinds = {True: "a residual (signed)", False: "an ordinary field (not signed)"}
        raise FieldError(
            f"level {record.level} is {kinds[field.signed]}, its record says {kinds[record.signed]}; make the field "
            "with signed=stage.signed"
        )
    if len(field) != record.num_gaussians:
        raise FieldError(f"level {record.level} has {len(field)} Gaussians, its record says {record.num_gaussians}")
    try:
        field.require_finite()
    except FieldError as error:
        raise FieldError(f"level {record.level}: {error}") from error


def _copied(record: LevelRecord, field: GaussianField) -> dict[int, GaussianField]:
    """Return by its level a copy of a field that is to be remembered: none of a large one, or of the finest level."""
    if record.level == 0 or sum(tensor.nbytes for tensor in field.parameters.values()) > REMEMBERED_BYTES:
        return {}
    copies = {
        name: tensor.detach().to("cpu", torch.float32, copy=True).contiguous()
        for name, tensor in field.parameters.items()
    }
    return {record.level: replace(field.with_parameters(copies), signed=record.signed)}
