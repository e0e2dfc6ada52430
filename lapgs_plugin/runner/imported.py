"""Output folders of other programs as run folders: of 3DGS codebases, and of the paper authors' release.

    FOLDER/cfg_args                                        the model's options, as Python writes a Namespace
    FOLDER/point_cloud/iteration_<n>/point_cloud.ply       a 3DGS codebase's only field
    FOLDER/L<l>/point_cloud/iteration_<n>/point_cloud.ply  the release's field of level l, 0 the finest
    FOLDER/L<l>/TRAIN_INFO                                 its seconds and Gaussians, counted since the first stage
    FOLDER/runtime_breakdown.json                          its options, where it was asked for one
    FOLDER/lapgs_record.json                               what a codebase's run took, where `lapgs run` recorded it

The release's rasterizer for residuals evaluates SH without the 0.5 and the clamp, which is our signed colour: its
coefficients are taken over as they are. Its images are composed of renders that are clamped each, on a pixel grid of
its own (`pyramid.MIXED_GRID`).
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from lapgs_plugin.adapters.base import BackboneAdapter, BackboneInfo
from lapgs_plugin.adapters.registry import adapters
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import BARE_RECORD, one_line_errors
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import MIXED_GRID
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS
from lapgs_plugin.rasterizers.extensions import CONSTANTS
from lapgs_plugin.rendering.hierarchy_renderer import CLAMPED
from lapgs_plugin.runs.archive import LevelRecord, Manifest, PathText, RunArchive, SceneReference, read_bare_record
from lapgs_plugin.scenes import smallest_size
from lapgs_plugin.untrusted import STRICT_WITH_MORE, checked, read_json, read_text

if sys.version_info >= (3, 12):
    from typing import NotRequired, TypedDict
else:  # pydantic cannot read the older TypedDict of `typing`
    from typing_extensions import NotRequired, TypedDict

CFG_ARGS, TRAIN_INFO, BREAKDOWN = "cfg_args", "TRAIN_INFO", "runtime_breakdown.json"
COPY = "copy it again"


class Options(TypedDict):
    """What is looked up in cfg_args; codebases keep more there."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    source_path: PathText
    resolution: int
    sh_degree: Literal[0, 1, 2, 3]
    eval: bool
    white_background: NotRequired[bool]
    train_test_exp: NotRequired[bool]
    images: NotRequired[PathText | None]


class BreakdownOptions(TypedDict):
    """What is looked up in the options of a breakdown."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    blur_up: NotRequired[bool]


class BreakdownFile(TypedDict):
    """What is looked up in `BREAKDOWN`."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    config: NotRequired[BreakdownOptions]
    backbone: NotRequired[str | None]


@dataclass(frozen=True)
class ForeignLevel:
    """A trained field in another program's folder.

    Attributes:
        level: 0 is full resolution.
        iterations: it was trained for, from its folder's name.
        ply: its file.
        seconds: optimization from the start of the first stage to the end of this one, None where it is not recorded.
        peak: most Gaussians up to the end of this stage, None where it is not recorded.
    """

    level: int
    iterations: int
    ply: Path
    seconds: float | None
    peak: int | None


@dataclass(frozen=True)
class ForeignRun:
    """Another program's output folder.

    Attributes:
        folder: it.
        options: the model's options, from cfg_args.
        levels: coarsest first, without gaps.
        codebase: name of the backbone, None where the folder does not tell.
        record: what `lapgs run --off --record` noted, empty without it.
    """

    folder: Path
    options: Mapping[str, Any]
    levels: tuple[ForeignLevel, ...]
    codebase: str | None
    record: Mapping[str, Any]

    @property
    def is_hierarchy(self) -> bool:
        """Whether the authors' release wrote it."""
        return (self.folder / f"L{self.levels[0].level}").is_dir()

    @property
    def times_are_known(self) -> bool:
        return bool(self.record) or all(level.seconds is not None for level in self.levels)


def read_foreign_run(folder: Path, iteration: int | None = None) -> ForeignRun:
    """Find out what is in another program's output folder.

    Args:
        folder: as given to the program with -m.
        iteration: which of the saved fields; None takes the last of each level.

    Raises:
        RunFolderError: it is no such folder, lacks a level or that iteration, or was trained with options that cannot
            be rendered as they were.
    """
    folder = folder.absolute()
    options = read_cfg_args(folder / CFG_ARGS)
    if options.get("train_test_exp"):
        raise RunFolderError(
            f"{folder} was trained with --train_test_exp, whose exposure of each image is no part of a field; "
            "expected a run without it"
        )
    places = {int(path.name[1:]): path for path in folder.glob("L*") if re.fullmatch(r"L[0-9]{1,2}", path.name)}
    trained = {level: path for level, path in places.items() if (path / "point_cloud").is_dir()}
    if not trained and (folder / "point_cloud").is_dir():
        trained = {0: folder}
    expected = list(range(max(places, default=0), -1, -1))[: len(trained)]
    if not trained or sorted(trained, reverse=True) != expected:
        found = ", ".join(f"L{level}" for level in sorted(trained, reverse=True)) or "no point_cloud folder"
        raise RunFolderError(
            f"{folder} holds {found}, expected point_cloud/, or L<n>/point_cloud/ of the coarsest level and of those "
            "below it without gaps; give the folder that training wrote with -m"
        )
    breakdown: dict[str, Any] = {}
    if _is_file(folder / BREAKDOWN):
        advice = f"{COPY} or remove it"
        breakdown = read_json(folder / BREAKDOWN, BreakdownFile, error=RunFolderError, advice=advice, finite=False)
    if trained[expected[0]] != folder and options.get("white_background"):
        raise RunFolderError(
            f"{folder} was trained with --white_background, which the release adds again with every residual; "
            "expected a hierarchy over black"
        )
    if breakdown.get("config", {}).get("blur_up") is False:
        raise RunFolderError(f"{folder} was trained without --blur_up, expected a run with it: our Up always blurs")
    levels = tuple(_level(level, trained[level], iteration) for level in expected)
    is_single = levels[0].ply.is_relative_to(folder / "point_cloud")
    record = read_bare_record(folder / BARE_RECORD) if is_single and _is_file(folder / BARE_RECORD) else {}
    return ForeignRun(folder, options, levels, _recognised(options, breakdown), record)


def read_cfg_args(path: Path) -> dict[str, Any]:
    """The options in a cfg_args file: the text of an argparse.Namespace, of which nothing is executed.

    Raises:
        RunFolderError: it is missing or something else, or lacks an option.
    """
    if not _is_file(path):
        raise RunFolderError(
            f"{path} does not exist; expected a folder that a 3DGS codebase or the paper authors' release wrote with -m"
        )
    text = read_text(path, error=RunFolderError, advice=COPY)
    try:
        call = ast.parse(text.strip(), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
            raise ValueError("no Namespace")
        if call.args or any(keyword.arg is None for keyword in call.keywords):
            raise ValueError("arguments without names")
        options = {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise RunFolderError(
            f"{path} is not readable ({error}), expected Namespace(name=value, ...); {COPY}"
        ) from error
    looked_up = {name: options[name] for name in Options.__annotations__ if name in options}
    return {**options, **checked(looked_up, Options, str(path), error=RunFolderError, advice=COPY)}


def import_run(
    run: ForeignRun,
    out: Path,
    *,
    codebase: str | None = None,
    scene: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> RunArchive:
    """Make a run folder of it. The fields are copied, nothing in the original changes.

    Args:
        run: what is there.
        out: the run folder.
        codebase: name of the backbone it was trained with; None takes the folder's word for it.
        scene: where its scene is now; None when it is still where it was.
        settings: options of its rasterizer that were not the defaults, such as {"mult": 1.0}.
        overwrite: replace a run that is already in `out`.

    Returns:
        The archive, closed for writing.

    Raises:
        UserInputError: the codebase is not known and not given, or a setting is none.
        RunFolderError: the scene is not there, a field is damaged, or `out` cannot be written.
        SceneError: the scene cannot be read.
    """
    known, name = adapters(), codebase or run.codebase
    if name not in known:
        raise UserInputError(
            f"--backbone {name or '(not given)'}: {run.folder} does not say what it was trained with, expected "
            f"{', '.join(known)}"
        )
    backbone = known[name]
    RunArchive.require_room(out, overwrite)
    manifest = _manifest(run, backbone.info, scene, {**backbone.info.raster_defaults, **_checked(settings or {})})
    scene_options = {"resolution": manifest.scene.resolution, "images": manifest.scene.images}
    try:
        size = smallest_size(manifest.scene.path, **scene_options)
    except UserInputError as error:  # of what cfg_args says, more often than of the scene
        raise type(error)(f"{run.folder / CFG_ARGS}: {error}") from error
    fields = {level.level: _field(level, manifest.levels, backbone) for level in run.levels}
    with RunArchive.create(out, manifest, overwrite) as archive:
        seconds, peak = 0.0, 0
        for level in run.levels:
            field = fields[level.level]
            # The release counts on from stage to stage: an unchanged peak was an earlier stage's.
            own_peak = level.peak if level.peak is not None and level.peak > peak else len(field)
            record = LevelRecord(
                level=level.level,
                signed=field.signed,
                iterations=level.iterations,
                num_gaussians=len(field),
                peak_gaussians=max(own_peak, len(field)),
                train_seconds=max(0.0, (level.seconds or seconds) - seconds),
                overhead_seconds={},
                image_size=level_size(size, level.level),
            )
            archive.finish_level(_as_recorded(record, run.record), field)
            seconds, peak = level.seconds or seconds, max(peak, level.peak or 0)
        for entry in run.record.get("timeline", ()):
            archive.append_history({"level": 0, **entry})
    return archive


def _as_recorded(record: LevelRecord, noted: Mapping[str, Any]) -> LevelRecord:
    """A level's record with what was noted while it was trained."""
    if not noted:
        return record
    return replace(
        record,
        train_seconds=noted["train_seconds"],
        peak_gaussians=noted["peak_gaussians"],
        mean_gaussians=noted["mean_gaussians"],
        memory_bytes=noted["memory_bytes"],
        overhead_seconds={"saving": noted["saving_seconds"]},
    )


def _level(level: int, place: Path, iteration: int | None) -> ForeignLevel:
    saved = {
        int(path.parent.name.removeprefix("iteration_")): path
        for path in (place / "point_cloud").glob("iteration_*/point_cloud.ply")
        if re.fullmatch(r"iteration_0*[1-9][0-9]{0,8}", path.parent.name)
    }
    chosen = max(saved, default=None) if iteration is None else iteration
    if chosen is None or chosen not in saved:
        found = ", ".join(map(str, sorted(saved))) or "none"
        raise RunFolderError(
            f"{place / 'point_cloud'} holds fields of iterations {found}, expected "
            f"{'iteration_<n>/point_cloud.ply' if iteration is None else f'{iteration}'}; choose with --iteration"
        )
    info = place / TRAIN_INFO
    with one_line_errors(info, "read"):
        text = info.read_text(encoding="utf-8", errors="replace") if info.is_file() else ""
    seconds = re.search(r"Training Time: ([0-9]{1,12}(?:\.[0-9]{1,6})?) seconds", text)
    peak = re.search(r"Peak GS number: ([0-9]{1,12})\b", text)
    return ForeignLevel(
        level, chosen, saved[chosen], float(seconds.group(1)) if seconds else None, int(peak.group(1)) if peak else None
    )


def _recognised(options: Mapping[str, Any], breakdown: Mapping[str, Any]) -> str | None:
    """The backbone by its own options, or by what the authors' release noted. Most folders do not tell."""
    known = adapters()
    for name, adapter in known.items():
        if any(option in options for option in adapter.info.telling_options):
            return name
    noted = breakdown.get("backbone")
    return noted if noted in known else None


def _is_file(path: Path) -> bool:
    with one_line_errors(path, "read"):
        return path.is_file()


def _checked(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    for name, value in settings.items():
        wanted = {"mult": (int, float), "antialiasing": (bool,)}.get(name)
        if wanted is None or name not in CONSTANTS or type(value) not in wanted:
            raise UserInputError(f"--set {name}={value}: expected mult=NUMBER or antialiasing=true|false")
    return settings


def _manifest(run: ForeignRun, backbone: BackboneInfo, scene: Path | None, settings: Mapping[str, Any]) -> Manifest:
    options = run.options
    path = (Path(options["source_path"]) if scene is None else scene).absolute()
    if not path.is_dir():
        hint = "say where it is now with -s" if scene is None else "give the scene's folder with -s"
        raise RunFolderError(f"the scene {path} of {run.folder} is not there; {hint}")
    white = bool(options.get("white_background"))
    return Manifest(
        scene=SceneReference(
            path=str(path),
            resolution=f"3dgs:{options['resolution']}",
            eval=bool(options["eval"]),
            background=(1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0),
            kind="colmap" if (path / "sparse").is_dir() else "transforms",
            images=options.get("images") or "images",
        ),
        levels=run.levels[0].level + 1,
        grid=MIXED_GRID if run.is_hierarchy else "camera",
        supervision="reconstructed",
        inherit="not recorded",
        sh_degree=int(options["sh_degree"]),
        rasterizer=backbone.rasterizer,
        seed=0,
        settings={
            "backbone": {"name": backbone.name, "imported_from": str(run.folder)},
            "iterations": sum(level.iterations for level in run.levels),
            RASTER_SETTINGS: dict(settings),
            CLAMPED: run.is_hierarchy,
        },
    )


def _field(level: ForeignLevel, levels: int, backbone: type[BackboneAdapter]) -> GaussianField:
    field = GaussianField.load_ply(level.ply)
    logits = backbone.saved_logits(field.opacity_logits)  # (n,)
    return replace(field, opacity_logits=logits, signed=level.level != levels - 1)
