"""Run folders: what a training run leaves behind.

    RUN/manifest.json              everything needed to render the run again
    RUN/level_<l>/point_cloud.ply  the field of each finished level, a standard 3DGS PLY
    RUN/level_<l>/optimizer.pt     its optimizer state, only while the next level may inherit it
    RUN/checkpoint.pt              state of an unfinished stage, the latest
    RUN/history.jsonl              one JSON object a logging tick
    RUN/preview.jpg                what the viewer shows until it can render
    RUN/metrics.json, RUN/stability.json, RUN/renders/, RUN/export/, RUN/report.html   what is made of it later

Every file but the history is written under a temporary name and renamed, and a level is listed in the manifest only
after its PLY is on the disk: a run killed at any moment is a run that opens, with the levels that were finished.

Finished fields that were trained along with level k are replaced when it is finished, or stay as they were. First they
are written to point_cloud.with_level_<k>.ply beside their predecessors. From the moment the manifest lists level k they
are the fields of their levels; then they are renamed, if need be by whoever opens the run for writing next. Those of a
level that is not listed count for nothing.
"""

from __future__ import annotations

import json
import logging
import shutil
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, BinaryIO, ClassVar, Literal

import torch
from pydantic import AfterValidator, Field, GetPydanticSchema, NonNegativeFloat, NonNegativeInt, PositiveInt

from lapgs_plugin import __version__
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
    require_manifest,
)
from lapgs_plugin.hierarchy.plan import MOST_LEVELS, Stage
from lapgs_plugin.runs.overhead import Overhead
from lapgs_plugin.untrusted import STRICT, STRICT_WITH_MORE, checked, read_json, read_json_lines, shortened, usable_path

if sys.version_info >= (3, 12):
    from typing import NotRequired, TypedDict
else:  # pydantic cannot read the older TypedDict of `typing`
    from typing_extensions import NotRequired, TypedDict

logger = logging.getLogger(__name__)

FORMAT_VERSION = 1

HISTORY, METRICS, CHECKPOINT = "history.jsonl", "metrics.json", "checkpoint.pt"
RENDERS, REPORT, STABILITY, EXPORT, CACHE = "renders", "report.html", "stability.json", "export", "cache"
PLY, OPTIMIZER = "point_cloud.ply", "optimizer.pt"
TRAINED_ALONG = "point_cloud.with_level_{}.ply"
"""Of a finished level's field as it was trained along with a finer one, until it is in its place."""

PathText = Annotated[str, AfterValidator(usable_path)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(max_length=200)]


def _peak_and_images(values: dict[str, int]) -> dict[str, int]:
    """Check bytes of memory: none, or those that `PeakMemory` notes."""
    if values and values.keys() != {"peak", "images"}:
        raise ValueError(f"{shortened(sorted(values))} are counted, expected peak and images, or nothing")
    return values


MemoryBytes = Annotated[dict[str, NonNegativeInt], AfterValidator(_peak_and_images)]
Settings = Annotated[dict[str, Any], GetPydanticSchema(lambda _source, schema: schema(KnownSettings))]


class KnownSettings(TypedDict):
    """What this package itself looks up in a manifest's settings; training programs keep more there.

    `training.settings` checks all of them before it continues a run.
    """

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    iterations: NotRequired[PositiveInt]
    hierarchy: NotRequired[Literal["nested", "laplacian"]]
    clamped: NotRequired[bool]
    raster: NotRequired[dict[str, bool | int | float | None]]


class HistoryEntry(TypedDict):
    """A line of the history, of which all but the first two are there where they were measured."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    level: NonNegativeInt
    iteration: NonNegativeInt
    elapsed: NotRequired[NonNegativeFloat]
    loss: NotRequired[float]
    psnr: NotRequired[float]
    ssim: NotRequired[float]
    num_gaussians: NotRequired[NonNegativeInt]


class MetricsOfView(TypedDict):
    """One view in `Metrics`; further figures are distances."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    name: str
    psnr: float
    ssim: float
    lpips_vgg: NotRequired[float]
    lpips_alex: NotRequired[float]
    lpips_squeeze: NotRequired[float]
    lpips_vgg_3dgs: NotRequired[float]


class MetricsOfLevel(TypedDict):
    """One level in `Metrics`."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    psnr: float
    upsampled_psnr: float
    iterations: PositiveInt
    image_size: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)]
    train_seconds: NonNegativeFloat
    num_gaussians: NonNegativeInt
    mean_gaussians: NonNegativeFloat | None
    peak_gaussians: NonNegativeInt
    breakdown_seconds: dict[str, NonNegativeFloat]
    memory_bytes: MemoryBytes


class Metrics(TypedDict):
    """What `evaluation.figures.run_figures` measures, as far as it is there."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    psnr: NotRequired[float]
    ssim: NotRequired[float]
    lpips_vgg: NotRequired[float]
    lpips_alex: NotRequired[float]
    lpips_squeeze: NotRequired[float]
    lpips_vgg_3dgs: NotRequired[float]
    lpips_missing: NotRequired[dict[str, str]]
    fps: NotRequired[NonNegativeFloat]
    split: NotRequired[Literal["test", "train"]]
    num_views: NotRequired[NonNegativeInt]
    views: NotRequired[list[MetricsOfView]]
    levels: NotRequired[dict[str, MetricsOfLevel]]
    train_seconds: NotRequired[NonNegativeFloat]
    overhead_seconds: NotRequired[dict[str, NonNegativeFloat]]
    breakdown_seconds: NotRequired[dict[str, NonNegativeFloat]]
    num_gaussians: NotRequired[dict[str, NonNegativeInt]]
    weighted_gaussians: NotRequired[NonNegativeFloat]
    mean_gaussians: NotRequired[NonNegativeFloat | None]
    peak_gaussians: NotRequired[NonNegativeInt]
    peak_memory_bytes: NotRequired[NonNegativeInt | None]
    peak_memory_without_images_bytes: NotRequired[int | None]
    rasterizer: NotRequired[str]
    versions: NotRequired[dict[str, str]]


class Timeline(TypedDict):
    """A moment of a `BareRecord`."""

    __pydantic_config__ = STRICT  # type: ignore[misc]  # what pydantic documents
    iteration: NonNegativeInt
    elapsed: NonNegativeFloat
    num_gaussians: NonNegativeInt


class BareRecord(TypedDict):
    """What `lapgs run --off --record` notes of a script's own run, see `adapters.witness`."""

    __pydantic_config__ = STRICT  # type: ignore[misc]  # what pydantic documents
    iterations: PositiveInt
    train_seconds: NonNegativeFloat
    saving_seconds: NonNegativeFloat
    num_gaussians: NonNegativeInt
    peak_gaussians: NonNegativeInt
    mean_gaussians: NonNegativeFloat
    memory_bytes: MemoryBytes
    psnr: NotRequired[float]
    ssim: NotRequired[float]
    timeline: list[Timeline]


def read_bare_record(path: Path) -> dict[str, Any]:
    """What is noted in a `BARE_RECORD`.

    Raises:
        RunFolderError: it cannot be read, or is damaged.
    """
    advice = "record the run again, with `lapgs run --off --record`"
    return dict(read_json(path, BareRecord, error=RunFolderError, advice=advice))


@dataclass(frozen=True)
class SceneReference:
    """Which images a run was trained on, and how they were read.

    Attributes:
        path: the scene folder, absolute.
        resolution: the resolution setting as the user wrote it, such as "1k" or "1/4".
        eval: whether every eighth view was held out.
        background: RGB in [0, 1] behind the base field.
        kind: "colmap" or "transforms".
        images: name of the image folder in a COLMAP scene.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    path: PathText
    resolution: Name
    eval: bool
    background: tuple[Share, Share, Share]
    kind: Name
    images: PathText = "images"


@dataclass(frozen=True)
class LevelRecord:
    """What is known of a finished level.

    Attributes:
        level: pyramid level, 0 is full resolution.
        signed: whether its field is a residual.
        iterations: optimizer steps it was trained for.
        num_gaussians: Gaussians in its PLY.
        peak_gaussians: most Gaussians at any moment of its training.
        train_seconds: iterative optimization alone.
        overhead_seconds: everything else by name, such as "pyramid", "cache", "inheritance"; "archive" is added when
            its files have been written.
        image_size: (width, height) in pixels it was trained at.
        memory_bytes: on a GPU, "peak" of its memory during training and how much of that were "images".
        mean_gaussians: Gaussians being optimized, mean over the iterations; None when that was not recorded.
        breakdown_seconds: of the optimization by part of an iteration (`breakdown.PARTS`); empty when not measured.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    level: NonNegativeInt
    signed: bool
    iterations: PositiveInt
    num_gaussians: NonNegativeInt
    peak_gaussians: NonNegativeInt
    train_seconds: NonNegativeFloat
    overhead_seconds: dict[str, NonNegativeFloat]
    image_size: tuple[PositiveInt, PositiveInt]
    memory_bytes: MemoryBytes = field(default_factory=dict)
    mean_gaussians: NonNegativeFloat | None = None
    breakdown_seconds: dict[str, NonNegativeFloat] = field(default_factory=dict)

    @classmethod
    def of(cls, stage: Stage, field: GaussianField, train_seconds: float = 0.0) -> LevelRecord:
        """The record of a stage that one's own loop trained, and of which no more was measured than its time."""
        n = len(field)
        return cls(stage.level, stage.signed, stage.iterations, n, n, train_seconds, {}, stage.image_size)


@dataclass(frozen=True)
class Manifest:
    """Everything needed to render a run again, and what it took to train it.

    Attributes:
        scene: the images it was trained on.
        levels: number of levels L of the whole hierarchy, finished or not.
        grid: pixel grid of the pyramid, "camera" or "even".
        supervision, inherit: as named on the command line.
        sh_degree: highest SH degree of the fields.
        rasterizer: name of the rasterizer it was trained with.
        seed: what the run's random choices were seeded with.
        settings: every other setting of the trainer, as JSON.
        records: the finished levels in training order, coarsest first.
        created_by: program and version.
        created: ISO 8601 time in UTC.
        format_version: of the run folder.

    Raises:
        UserInputError: there are no levels or too many, or the records are not the first of the levels L-1, ..., 0.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    scene: SceneReference
    levels: int
    grid: Name
    supervision: Name
    inherit: Name
    sh_degree: Annotated[int, Field(ge=0, le=3)]
    rasterizer: Name
    seed: NonNegativeInt
    settings: Settings
    records: Annotated[tuple[LevelRecord, ...], Field(max_length=MOST_LEVELS)] = ()
    created_by: Name = f"lapgs_plugin {__version__}"
    created: Name = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"))
    format_version: int = FORMAT_VERSION

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MOST_LEVELS:
            raise UserInputError(f"levels is {shortened(self.levels)}, expected 1 to {MOST_LEVELS}")
        finished = [record.level for record in self.records]
        expected = list(range(self.levels - 1, -1, -1))[: len(finished)]
        if finished != expected:
            raise UserInputError(
                f"finished levels {shortened(finished)}, expected {shortened(expected)} of {self.levels}, coarsest "
                "first"
            )

    @classmethod
    def of_loop(
        cls,
        scene: SceneReference,
        levels: int,
        rasterizer: str,
        *,
        grid: str = "camera",
        inherit: str = "geometry",
        sh_degree: int = 3,
    ) -> Manifest:
        """The manifest of a run that one's own loop trains, composed images against photographs.

        Such a run is rendered and measured as any other; `lapgs train --resume` does not continue it.
        """
        return cls(scene, levels, grid, "reconstructed", inherit, sh_degree, rasterizer, seed=0, settings={})

    @property
    def complete(self) -> bool:
        """Whether every level is finished."""
        return len(self.records) == self.levels

    @property
    def next_level(self) -> int | None:
        """The level to train next, None when the run is complete."""
        return None if self.complete else self.levels - 1 - len(self.records)

    def record(self, level: int) -> LevelRecord:
        """The record of a finished level.

        Raises:
            RunFolderError: it is not finished.
        """
        for record in self.records:
            if record.level == level:
                return record
        if not 0 <= level < self.levels:
            raise RunFolderError(
                f"level {level} is not in this run, expected 0 to {self.levels - 1}; choose one of them"
            )
        finished = ", ".join(str(record.level) for record in self.records) or "none"
        raise RunFolderError(
            f"level {level} is not in this run (finished: {finished} of {self.levels}); "
            "continue it with its own command and --resume"
        )

    @classmethod
    def from_json(cls, values: dict[str, Any], name: str = "the manifest") -> Manifest:
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON.

        Args:
            values: by field.
            name: how messages call where they come from.

        Raises:
            RunFolderError: something is missing, unknown, of another type or inconsistent; names it.
        """
        advice = "restore it or train again with --overwrite"
        manifest: Manifest = checked(_as_json(values), cls, name, error=RunFolderError, advice=advice)
        if lacking := sorted({f.name for f in fields(cls)} - values.keys()):
            raise RunFolderError(f"{name} is damaged: it lacks {', '.join(lacking)}; {advice}")
        return manifest


def _as_json(value: Any) -> Any:
    """With lists instead of tuples, as JSON has them."""
    if isinstance(value, dict):
        return {key: _as_json(inner) for key, inner in value.items()}
    return [_as_json(inner) for inner in value] if isinstance(value, (list, tuple)) else value


class RunArchive:
    """A run folder. One process at a time may write to it; any number may read.

    Use `create` for a new run, `open` for an existing one, and the archive as a context manager (or `close`) to let go
    of a folder opened for writing. Methods that write raise RunFolderError when the disk is full or the folder is not
    writable; what was there before stays as it was.
    """

    def __init__(self, folder: Path, manifest: Manifest, lock: FolderLock | None) -> None:
        """Use `create` or `open`."""
        self._folder = folder
        self._manifest = manifest
        self._lock = lock

    @classmethod
    def create(cls, path: Path | str, manifest: Manifest, overwrite: bool = False) -> RunArchive:
        """Start a run in a new or empty folder and hold it for writing.

        Args:
            path: the folder; created with its parents.
            manifest: without records.
            overwrite: replace a run that is already there. Only files of a run are removed.

        Raises:
            RunFolderError: there is a run and `overwrite` is not given, the folder holds something else, another
                process is writing to it, it cannot be written, or the manifest holds what cannot be read again.
        """
        assert not manifest.records, "a new run has no finished level"
        folder = Path(path).absolute()
        Manifest.from_json(asdict(manifest))  # what could not be read again is refused before it is trained
        cls.require_room(folder, overwrite)
        with one_line_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        archive = cls(folder, manifest, FolderLock.acquire(folder))
        try:
            cls.require_room(folder, overwrite)  # another process may have started one before the lock was ours
            with one_line_errors(folder):
                # Should this be interrupted, the folder is first the old run without its checkpoint, which the new one
                # must never continue from, then an empty run; at no time a manifest without its fields.
                archive.path(CHECKPOINT).unlink(missing_ok=True)
                archive._write_json(MANIFEST, asdict(manifest), training=True)
                _remove_results(folder)
        except BaseException:
            archive.close()
            raise
        return archive

    @staticmethod
    def require_room(path: Path | str, overwrite: bool = False) -> None:
        """Check, before anything expensive is done, that `create` would accept the folder. Writes nothing.

        Raises:
            RunFolderError: as `create`, except for what only writing shows.
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
        """Open a run, checking that the fields of its finished levels are there and whole.

        Args:
            path: the folder.
            resume: hold it for writing.
            check: False leaves fields unlooked at until `field` reads them, for callers to whom a part of a run
                is of use.

        Raises:
            RunFolderError: there is no run, it was written by another version, a level's PLY is missing or cut short,
                or, with `resume`, another process is writing to it.
        """
        folder = Path(path).absolute()
        manifest = _read_manifest(folder)
        lock = FolderLock.acquire(folder) if resume else None
        try:
            if resume:
                manifest = _read_manifest(folder)  # the process that held it may have finished a level meanwhile
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
        """Let go of a folder that was held for writing."""
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
        """The run folder, or something in it."""
        return self._folder.joinpath(*parts)

    def field_path(self, level: int) -> Path:
        """The PLY of a level: the field as it was last trained with a level that is finished."""
        for later in reversed(self.available_levels):
            if _exists(waiting := self._waiting_path(level, later)):
                return waiting
        return self._settled_path(level)

    def _settled_path(self, level: int) -> Path:
        return self.path(f"level_{level}", PLY)

    def _waiting_path(self, level: int, later: int) -> Path:
        return self.path(f"level_{level}", TRAINED_ALONG.format(later))

    def field(self, level: int) -> GaussianField:
        """The field of a finished level, float32 on the CPU.

        Raises:
            RunFolderError: the level is not finished, or its PLY is not what the manifest says.
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
    ) -> None:
        """Keep the field of a trained level: its PLY first, then the manifest that lists it, and no checkpoint of it.

        Until the manifest is written, the run is what it was; from then on it has this level and all of
        `trained_along`, whatever happens.

        Args:
            record: of the level `manifest.next_level`; the seconds that writing takes are added to its overhead as
                "archive".
            field: as trained.
            optimizer_state: for full inheritance, what `optimizer_state` gives to the next level; kept until that one
                is finished.
            trained_along: what finished fields have become meanwhile, by level, each with as many Gaussians as before.

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
            if optimizer_state is not None:
                self._write_tensors(path.with_name(OPTIMIZER), optimizer_state)
        record = replace(record, overhead_seconds=dict(overhead))
        manifest = replace(self._manifest, records=(*self._manifest.records, record))
        self._write_json(MANIFEST, asdict(manifest), training=True)
        self._manifest = manifest
        self._settle_fields()
        with one_line_errors(self._folder):
            self.path(CHECKPOINT).unlink(missing_ok=True)
            self.path(f"level_{record.level + 1}", OPTIMIZER).unlink(missing_ok=True)

    def _settle_fields(self) -> None:
        """Put fields that were trained along in their places, and away those whose level was not finished after all."""
        for level in range(self._manifest.levels):
            for later in reversed(range(level)):
                waiting = self._waiting_path(level, later)
                with one_line_errors(waiting):
                    if later not in self.available_levels:
                        waiting.unlink(missing_ok=True)
                    elif waiting.exists():
                        waiting.replace(self._settled_path(level))

    def optimizer_state(self, level: int) -> dict[str, Any]:
        """The optimizer state that a finished level left for the next one, its tensors on the CPU.

        Raises:
            RunFolderError: there is none, or it cannot be read.
        """
        path = self.path(f"level_{level}", OPTIMIZER)
        if not _exists(path):
            raise RunFolderError(
                f"{path} does not exist, and the next level goes on with it; start again with --overwrite"
            )
        return _read_tensors(path, "start again with --overwrite")

    def append_history(self, entry: dict[str, Any]) -> None:
        """Add one entry to the history: JSON with finite numbers, having "level" and "iteration"."""
        self._require_lock()
        assert {"level", "iteration"} <= entry.keys(), "a history entry says where in the run it belongs"
        line = json.dumps(entry, allow_nan=False) + "\n"
        path = self.path(HISTORY)
        with one_line_errors(path, training=True), path.open("a", encoding="utf-8") as stream:
            stream.write(line)

    def history(self) -> list[dict[str, Any]]:
        """All entries in the order they were added. A last line torn by a crash is left out.

        Raises:
            RunFolderError: another line is damaged.
        """
        path = self.path(HISTORY)
        return read_json_lines(path, HistoryEntry, error=RunFolderError) if _exists(path) else []

    def rewind_history(self, level: int, iteration: int) -> None:
        """Drop the entries after an iteration of a level, which a resumed run will add again.

        Training visits level L-1 first, so an entry is later when its level is lower.
        """
        self._require_lock()
        kept = [entry for entry in self.history() if (-entry["level"], entry["iteration"]) <= (-level, iteration)]
        text = "".join(json.dumps(entry) + "\n" for entry in kept)
        path = self.path(HISTORY)
        with one_line_errors(path, training=True), atomic_write(path) as stream:
            stream.write(text.encode())

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Replace the run's metrics: JSON with finite numbers. Needs no hold of the folder."""
        self._write_json(METRICS, metrics)

    def write_stability(self, figures: dict[str, Any]) -> None:
        """Replace the run's figures of flicker: JSON with finite numbers. Needs no hold of the folder."""
        self._write_json(STABILITY, figures)

    def metrics(self) -> dict[str, Any] | None:
        """The run's metrics, None when they were never measured.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = self.path(METRICS)
        advice = "write it again with `lapgs eval`"
        return dict(read_json(path, Metrics, error=RunFolderError, advice=advice)) if _exists(path) else None

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint of the level in training: tensors, numbers, strings and containers of them."""
        self._require_lock()
        self._write_tensors(self.path(CHECKPOINT), {"level": self._manifest.next_level, "state": state})

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The latest checkpoint of the next level to train, its tensors on the CPU; None when there is none.

        Raises:
            RunFolderError: it cannot be read, or is of a level that is neither finished nor the next.
        """
        path = self.path(CHECKPOINT)
        if not _exists(path):
            return None
        advice = "delete it to continue from the last finished level"
        saved = _read_tensors(path, advice)
        level, state = saved.get("level"), saved.get("state")
        if type(level) is not int or not isinstance(state, dict):
            found = f"level {shortened(level)} and a state that is a {type(state).__name__}"
            raise RunFolderError(f"{path} holds {found}, expected a number and a dictionary; {advice}")
        if level == self._manifest.next_level:
            return state
        if level not in self.available_levels:
            raise RunFolderError(f"{path} is of level {level}, expected {self._manifest.next_level}; {advice}")
        # A run killed right after a level was finished leaves that level's checkpoint behind.
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

    def _write_tensors(self, path: Path, state: dict[str, Any]) -> None:
        with one_line_errors(path, training=True), atomic_write(path) as stream:
            _torch_save(state, stream)

    def _require_lock(self) -> None:
        assert self._lock is not None, "open the run with resume=True to write to it"


def _require_field_of(record: LevelRecord, field: GaussianField) -> None:
    """Check that a field is what a record is of, and may be archived.

    Raises:
        FieldError: it holds NaN or inf.
    """
    assert (len(field), field.signed) == (record.num_gaussians, record.signed), "the record is of another field"
    try:
        field.require_finite()
    except FieldError as error:
        raise FieldError(f"level {record.level}: {error}") from error


def _torch_save(state: dict[str, Any], stream: BinaryIO) -> None:
    """torch.save that lets the OSError of a full disk through; torch replaces it by a RuntimeError."""
    try:
        torch.save(state, stream)
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):
            raise error.__context__ from error
        raise


def _exists(path: Path) -> bool:
    """Whether there is a file, in a folder that may be looked into.

    Raises:
        RunFolderError: it may not.
    """
    with one_line_errors(path, "read"):
        return path.exists()


def _read_tensors(path: Path, advice: str) -> dict[str, Any]:
    """What `torch.save` wrote of a dictionary; tensors that are no more than the file holds.

    Raises:
        RunFolderError: it cannot be read, or would take more memory than it has bytes.
    """
    try:
        _require_stored(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises RuntimeError, UnpicklingError, EOFError, OSError, ... by damage
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RunFolderError(f"{path} cannot be read ({reason}); {advice}") from error
    if not isinstance(state, dict):
        raise RunFolderError(f"{path} holds a {type(state).__name__}, expected a dictionary; {advice}")
    _require_held(state, path, advice)
    return state


def _require_stored(path: Path) -> None:
    """Check that a zip file's contents are as long as it says and no longer than the file, as `torch.save` writes them.

    Raises:
        ValueError: they are packed or overlap, and would unpack to more than the file holds.
        zipfile.BadZipFile, OSError: it is no zip file, or cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    size, held = path.stat().st_size, sum(entry.file_size for entry in entries)
    if held > size or any(entry.file_size != entry.compress_size for entry in entries):
        raise ValueError(f"it unpacks to {held:,} bytes, expected no more than its own {size:,}")


def _require_held(state: dict[str, Any], path: Path, advice: str) -> None:
    """Check that tensors are plain ones on the CPU and together no larger than their file.

    A view can name more elements than there are in memory, which would be allocated as soon as it is copied.

    Raises:
        RunFolderError: they are not.
    """
    waiting: list[Any] = [state]
    seen: set[int] = set()
    held, size = 0, path.stat().st_size
    while waiting:
        each = waiting.pop()
        if id(each) in seen:
            continue
        seen.add(id(each))
        if isinstance(each, torch.Tensor):
            if each.layout != torch.strided or each.device.type != "cpu" or each.is_quantized:
                raise RunFolderError(f"{path} holds a {each.layout} tensor, expected dense ones; {advice}")
            held += each.nelement() * each.element_size()
        elif isinstance(each, dict):
            waiting.extend(each.values())
        elif isinstance(each, (list, tuple)):
            waiting.extend(each)
    if held > size:
        raise RunFolderError(f"{path} names tensors of {held:,} bytes, expected at most its own {size:,}; {advice}")


def _read_manifest(folder: Path) -> Manifest:
    require_manifest(folder)
    path = folder / MANIFEST
    advice = "restore it or train again with --overwrite"
    values = read_json(path, dict[str, Any], error=RunFolderError, advice=advice)
    version = values.get("format_version")
    if version != FORMAT_VERSION:
        raise RunFolderError(
            f"{path} has format_version {shortened(version)}, this version of lapgs reads {FORMAT_VERSION}; "
            f"use the version that wrote it ({shortened(values.get('created_by', 'unknown'))})"
        )
    return Manifest.from_json(values, str(path))


def _is_run(folder: Path) -> bool:
    """Whether the manifest was written by any version of this package; others' manifest.json files are not ours.

    One that cannot be read any more is ours where it lies beside a history.
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
    """Remove what a former run left, and nothing that a run does not write."""
    _remove_scratch(folder)
    for name in (HISTORY, METRICS, STABILITY, REPORT, PREVIEW):
        (folder / name).unlink(missing_ok=True)
    for name in (RENDERS, EXPORT):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for level in folder.glob("level_*/"):
        (level / PLY).unlink(missing_ok=True)
        (level / OPTIMIZER).unlink(missing_ok=True)
        for waiting in level.glob(TRAINED_ALONG.format("*")):
            waiting.unlink()
        if not any(level.iterdir()):
            level.rmdir()


def _remove_scratch(folder: Path) -> None:
    """Remove what a killed run could not: half-written temporaries, cached predictions, a torn line of history."""
    for pattern in (TEMPORARY_PATTERN, f"level_*/{TEMPORARY_PATTERN}"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
    if (folder / CACHE).is_dir():
        shutil.rmtree(folder / CACHE)
    if (folder / HISTORY).exists():
        with (folder / HISTORY).open("r+b") as stream:
            stream.truncate(stream.read().rfind(b"\n") + 1)
