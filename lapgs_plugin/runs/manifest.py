"""Describe a run: `manifest.json`, its records of finished levels, and how it is read and checked."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, GetPydanticSchema, NonNegativeFloat, NonNegativeInt, PositiveInt
from typing_extensions import NotRequired

from lapgs_plugin import __version__
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import MANIFEST, require_manifest
from lapgs_plugin.hierarchy.inheritance import require_degree
from lapgs_plugin.hierarchy.plan import MOST_LEVELS, Hierarchy, Stage
from lapgs_plugin.hierarchy.pyramid import MIXED_GRID
from lapgs_plugin.hierarchy.settings import GRIDS
from lapgs_plugin.untrusted import STRICT, StrictWithMore, checked, read_json, shortened, usable_path

if TYPE_CHECKING:
    from lapgs_plugin.scenes.scene import Scene

FORMAT_VERSION = 1
ADVICE = "restore it or train again with --overwrite"

PathText = Annotated[str, AfterValidator(usable_path)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(max_length=200)]


def _peak_and_images(values: dict[str, int]) -> dict[str, int]:
    """Check bytes of memory: none, or those that `profiling.PeakMemory` notes."""
    if values and values.keys() != {"peak", "images"}:
        raise ValueError(f"{shortened(sorted(values))} are counted, expected peak and images, or nothing")
    return values


def _known_grid(name: str) -> str:
    if name not in (*GRIDS, MIXED_GRID):
        raise ValueError(f"{shortened(name)} is no pixel grid, expected {' or '.join(GRIDS)}")
    return name


MemoryBytes = Annotated[dict[str, NonNegativeInt], AfterValidator(_peak_and_images)]
Settings = Annotated[dict[str, Any], GetPydanticSchema(lambda _source, schema: schema(KnownSettings))]


class KnownSettings(StrictWithMore):
    """Check settings that other rooms look up in a manifest. `training.settings` checks all of them."""

    iterations: NotRequired[PositiveInt]
    hierarchy: NotRequired[Literal["nested", "laplacian"]]
    clamped: NotRequired[bool]
    raster: NotRequired[dict[str, bool | int | float | None]]
    backbone: NotRequired[dict[str, Any]]


@dataclass(frozen=True)
class SceneReference:
    """Name the images that a run was trained on, and how they were read.

    Attributes:
        path: the scene folder, absolute.
        resolution: the resolution setting as the user wrote it, such as "1k" or "1/4".
        eval: whether every eighth view was held out.
        background: RGB in [0, 1] behind the base field.
        kind: "colmap", "transforms" or the program that exported the scene.
        images: name of the image folder in a COLMAP scene.
        masks: "none", "alpha", or the folder of masks, relative to the scene or absolute.
        unit: the length in the scene's units that is 1 for the rasterizer, see `scenes.Scene`.
        sky: "none", or the folder of masks of the sky.
        distorted: whether cameras have their lenses, and Gaussians are evaluated along rays.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    path: PathText
    resolution: Name
    eval: bool
    background: tuple[Share, Share, Share]
    kind: Name
    images: PathText = "images"
    masks: PathText = "none"
    unit: Annotated[float, Field(gt=1e-30, lt=1e30)] = 1.0
    sky: PathText = "none"
    distorted: bool = False

    @classmethod
    def of(
        cls, scene: Scene, *, resolution: str = "full", images: str = "images", masks: str = "none"
    ) -> SceneReference:
        """Return the reference of a loaded scene, for the manifest of your own loop.

        Args:
            scene: as `load_scene` returned it. Views were held out if it has any.
            resolution, images: as they were given to `load_scene`.
            masks: "none" for a loop that ignores masks, "alpha", or the folder of masks.
        """
        path = str(scene.path.absolute())
        return cls(path, resolution, bool(scene.test), scene.background, scene.kind, images, masks, scene.unit)


@dataclass(frozen=True)
class DecidedLength:
    """Tell why a level has as many iterations as it has, where views that were set aside decided that.

    Attributes:
        most: iterations that it might have had.
        after: iteration after which its length was decided.
        views: number of views.
        gain: dB that they were to gain in a third more iterations; None if too few measurements told.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    most: PositiveInt
    after: PositiveInt
    views: PositiveInt
    gain: Annotated[float, Field(allow_inf_nan=False)] | None


@dataclass(frozen=True)
class LevelRecord:
    """Describe a finished level.

    Attributes:
        level: pyramid level, 0 is full resolution.
        signed: whether its field is a residual.
        iterations: it was trained for, one for each view; a step may take several.
        num_gaussians: Gaussians in its PLY.
        peak_gaussians: most Gaussians at any moment of its training.
        train_seconds: iterative optimization alone.
        overhead_seconds: everything else by name, such as "pyramid", "cache", "inheritance"; writing the level's files
            adds "archive".
        image_size: (width, height) in pixels it was trained at.
        memory_bytes: on a GPU, the "peak" of its memory during training and the part of it that was "images".
        mean_gaussians: Gaussians being optimized, mean over the iterations; None when that was not recorded.
        breakdown_seconds: optimization by part of an iteration (`profiling.PARTS`); empty when not measured.
        gpu_busy_seconds: estimate of the seconds that the GPU executed kernels; None when not measured.
        start_gaussians: Gaussians before its first iteration; None when that was not recorded.
        decided: why it was trained for that long; None where that was planned.
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
    gpu_busy_seconds: NonNegativeFloat | None = None
    start_gaussians: NonNegativeInt | None = None
    decided: DecidedLength | None = None

    @classmethod
    def of(cls, stage: Stage, field: GaussianField, train_seconds: float = 0.0) -> LevelRecord:
        """Return the record of a stage that your own loop trained and that only measured its time.

        Args:
            stage: of the plan.
            field: as trained.
            train_seconds: of the iterations alone; shown by `lapgs eval` and `lapgs report`.
        """
        n = len(field)
        return cls(stage.level, stage.signed, stage.iterations, n, n, train_seconds, {}, stage.image_size)


@dataclass(frozen=True)
class Manifest:
    """Hold everything needed to render a run again, and the cost of its training.

    Attributes:
        scene: the images it was trained on.
        levels: number of levels L of the whole hierarchy, finished or not.
        grid: pixel grid of the pyramid, "camera" or "even".
        supervision, inherit: as named on the command line.
        sh_degree: highest SH degree of the fields.
        rasterizer: name of the rasterizer it was trained with.
        seed: of the run's random choices.
        settings: every other setting of the trainer, as JSON.
        records: finished levels in training order, coarsest first.
        created_by: program and version.
        created: ISO 8601 time in UTC.
        format_version: of the run folder.

    Raises:
        UserInputError: no levels or too many, or records that are not of the levels L-1, L-2, ... in this order.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    scene: SceneReference
    levels: int
    grid: Annotated[str, AfterValidator(_known_grid)]
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
        hierarchy: Hierarchy | str = Hierarchy.LAPLACIAN,
        grid: str = "camera",
        inherit: str = "geometry",
        sh_degree: int = 3,
        unit: float = 1.0,
    ) -> Manifest:
        """Return the manifest of a run that your own loop trains, supervised by composed images.

        Such a run is rendered and measured like any other; `lapgs train --resume` does not continue it.

        Args:
            scene: the images, see `SceneReference.of`.
            levels: number of levels, 1 to 24.
            rasterizer: that renders the run best, as `--rasterizer` names it: "gsplat", "cpu", or the module of an
                extension. Where it is not available, the most similar one renders.
            hierarchy: kind of the finer levels, "laplacian" or "nested".
            grid: of the loop's `Pyramid`, "camera" or "even".
            inherit: how residuals started, "geometry", "xyz" or "full".
            sh_degree: highest of the fields, 0 to 3.
            unit: of the loop's rasterizer, `Scene.unit` if it is wrapped in `fields.units.in_unit`.

        Raises:
            UserInputError: one of these is something else.
        """
        if not isinstance(scene, SceneReference):
            raise UserInputError(
                f"scene is a {type(scene).__name__}, expected a SceneReference; SceneReference.of makes it"
            )
        if grid not in GRIDS:
            raise UserInputError(f"grid {grid}: expected {' or '.join(GRIDS)}")
        require_degree(sh_degree)
        settings = {"hierarchy": Hierarchy(hierarchy).value}
        reference = replace(scene, unit=unit)
        return cls(reference, levels, grid, "reconstructed", inherit, sh_degree, rasterizer, seed=0, settings=settings)

    @property
    def complete(self) -> bool:
        """Whether every level is finished."""
        return len(self.records) == self.levels

    @property
    def next_level(self) -> int | None:
        """The level to train next, None when the run is complete."""
        return None if self.complete else self.levels - 1 - len(self.records)

    def record(self, level: int) -> LevelRecord:
        """Return the record of a finished level.

        Raises:
            RunFolderError: the level is not finished, or there is none.
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
        """Invert `dataclasses.asdict`, also after a round trip through JSON; messages begin with `name`.

        Raises:
            RunFolderError: names a value that is missing, unknown, of another type or inconsistent.
        """
        manifest: Manifest = checked(_as_json(values), cls, name, error=RunFolderError, advice=ADVICE)
        if lacking := sorted({f.name for f in fields(cls)} - values.keys()):
            raise RunFolderError(f"{name} is damaged: it lacks {', '.join(lacking)}; {ADVICE}")
        return manifest


def _as_json(value: Any) -> Any:
    """Return values with lists instead of tuples, as JSON has them."""
    if isinstance(value, dict):
        return {key: _as_json(inner) for key, inner in value.items()}
    return [_as_json(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest of a run.

    Raises:
        RunFolderError: there is none, it is damaged, or another version wrote it.
    """
    require_manifest(folder)
    path = folder / MANIFEST
    values = read_json(path, dict[str, Any], error=RunFolderError, advice=ADVICE)
    version = values.get("format_version")
    if version != FORMAT_VERSION:
        raise RunFolderError(
            f"{path} has format_version {shortened(version)}, this version of lapgs reads {FORMAT_VERSION}; "
            f"use the version that wrote it ({shortened(values.get('created_by', 'unknown'))})"
        )
    return Manifest.from_json(values, str(path))
