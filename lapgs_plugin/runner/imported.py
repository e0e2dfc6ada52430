"""Import output folders of other programs as run folders: of 3DGS codebases, and of the paper authors' release.

    FOLDER/cfg_args                                        the model's options, as Python prints a Namespace
    FOLDER/point_cloud/iteration_<n>/point_cloud.ply       a 3DGS codebase's only field
    FOLDER/L<l>/point_cloud/iteration_<n>/point_cloud.ply  the release's field of level l, 0 the finest
    FOLDER/L<l>/TRAIN_INFO                                 its seconds and Gaussians, counted since the first stage
    FOLDER/runtime_breakdown.json                          its options, if it measured a breakdown
    FOLDER/lapgs_record.json                               a codebase's run as `lapgs run --off --record` measured it

The release's rasterizer for residuals evaluates SH without the 0.5 and the clamp, as our signed colour does, so the
coefficients are copied unchanged. It clamps each render before composing, on a pixel grid of its own
(`pyramid.MIXED_GRID`).
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from typing_extensions import NotRequired

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.generic import Adapter as GenericAdapter
from lapgs_plugin.adapters.info import RASTER_OPTIONS, BackboneInfo
from lapgs_plugin.adapters.registry import BACKBONES, GENERIC, all_adapters
from lapgs_plugin.errors import RunFolderError, UserInputError, errors_about
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import MIXED_GRID
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS
from lapgs_plugin.rendering.hierarchy_renderer import CLAMPED
from lapgs_plugin.runner.manifest import scene_reference
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import exists, require_room
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, PathText
from lapgs_plugin.runs.results import read_bare_record
from lapgs_plugin.scenes import smallest_size
from lapgs_plugin.untrusted import StrictWithMore, checked, read_json, read_text

CFG_ARGS, TRAIN_INFO, BREAKDOWN = "cfg_args", "TRAIN_INFO", "runtime_breakdown.json"
COPY = "copy it again"


class Options(StrictWithMore):
    """Type the options used of cfg_args, which has others, too."""

    source_path: PathText
    resolution: int
    sh_degree: Literal[0, 1, 2, 3]
    eval: bool
    white_background: NotRequired[bool]
    train_test_exp: NotRequired[bool]
    images: NotRequired[PathText | None]


class BreakdownOptions(StrictWithMore):
    """Type the options used of a breakdown."""

    blur_up: NotRequired[bool]


class BreakdownFile(StrictWithMore):
    """Type the entries used of `BREAKDOWN`."""

    config: NotRequired[BreakdownOptions]
    backbone: NotRequired[str | None]


@dataclass(frozen=True)
class ForeignLevel:
    """Describe a trained field in another program's folder.

    Attributes:
        level: level of the field, 0 for full resolution.
        iterations: iterations of its training, from its folder's name.
        ply: its file.
        seconds: optimization from the start of the first stage to the end of this one, None if not recorded.
        peak: most Gaussians up to the end of this stage, None if not recorded.
    """

    level: int
    iterations: int
    ply: Path
    seconds: float | None
    peak: int | None


@dataclass(frozen=True)
class ForeignRun:
    """Describe another program's output folder.

    Attributes:
        folder: the folder.
        options: the model's options, from cfg_args.
        levels: fields, coarsest first, without gaps.
        codebase: name of the backbone, None if the folder does not tell.
        record: measurements by `lapgs run --off --record`, empty without it.
        is_hierarchy: whether the paper authors' release wrote it.
    """

    folder: Path
    options: Mapping[str, Any]
    levels: tuple[ForeignLevel, ...]
    codebase: str | None
    record: Mapping[str, Any]
    is_hierarchy: bool

    @property
    def times_are_known(self) -> bool:
        """Whether the folder records the time of its training."""
        return bool(self.record) or all(level.seconds is not None for level in self.levels)


def read_foreign_run(folder: Path, iteration: int | None = None) -> ForeignRun:
    """Read the contents of another program's output folder.

    Args:
        folder: the folder that the program got with -m.
        iteration: iteration of the saved fields; None for the last of each level.

    Raises:
        RunFolderError: it is no such folder, lacks a level or the iteration, or was trained with options that we cannot
            render.
    """
    folder = folder.absolute()
    options = read_cfg_args(folder / CFG_ARGS)
    if options.get("train_test_exp"):
        raise RunFolderError(
            f"{folder} was trained with --train_test_exp, whose exposure of each image is no part of a field; "
            "expected a run without it"
        )
    folders = {int(path.name[1:]): path for path in folder.glob("L*") if re.fullmatch(r"L[0-9]{1,2}", path.name)}
    trained = {level: path for level, path in folders.items() if (path / "point_cloud").is_dir()}
    if not trained and (folder / "point_cloud").is_dir():
        trained = {0: folder}
    expected = list(range(max(folders, default=0), -1, -1))[: len(trained)]
    if not trained or sorted(trained, reverse=True) != expected:
        contents = ", ".join(f"L{level}" for level in sorted(trained, reverse=True)) or "no point_cloud folder"
        raise RunFolderError(
            f"{folder} holds {contents}, expected point_cloud/, or L<n>/point_cloud/ of the coarsest level and of "
            "those below it without gaps; give the folder that training wrote with -m"
        )
    is_hierarchy = trained[expected[0]] != folder
    breakdown: dict[str, Any] = {}
    if exists(folder / BREAKDOWN):
        advice = f"{COPY} or remove it"
        breakdown = read_json(folder / BREAKDOWN, BreakdownFile, error=RunFolderError, advice=advice, finite=False)
    if is_hierarchy and options.get("white_background"):
        raise RunFolderError(
            f"{folder} was trained with --white_background, which the release adds again with every residual; "
            "expected a hierarchy over black"
        )
    if breakdown.get("config", {}).get("blur_up") is False:
        raise RunFolderError(f"{folder} was trained without --blur_up, expected a run with it: our Up always blurs")
    levels = tuple(_level(level, trained[level], iteration) for level in expected)
    record = {} if is_hierarchy or not exists(folder / BARE_RECORD) else read_bare_record(folder / BARE_RECORD)
    return ForeignRun(folder, options, levels, _recognised(options, record, breakdown), record, is_hierarchy)


def read_cfg_args(path: Path) -> dict[str, Any]:
    """Return the options in a cfg_args file, the text of an argparse.Namespace, without executing it.

    Raises:
        RunFolderError: it is missing or something else, or lacks an option.
    """
    if not exists(path):
        problem = f"{path.parent} is a file" if path.parent.is_file() else f"{path} does not exist"
        raise RunFolderError(
            f"{problem}; expected a folder that a 3DGS codebase or the paper authors' release wrote with -m"
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
    """Make a run folder with copies of another program's fields.

    Args:
        run: the other program's folder.
        out: run folder to write.
        codebase: name of the backbone that trained it; None for the one that the folder tells.
        scene: new place of the scene; None if it has not moved.
        settings: settings of its rasterizer that were not the defaults and are not in the folder, such as
            {"mult": 1.0}.
        overwrite: replace the run in `out`.

    Returns:
        The archive, closed for writing.

    Raises:
        UserInputError: the codebase is unknown, or a setting is wrong.
        RunFolderError: the scene is missing, a field is damaged, or `out` cannot be written.
        SceneError: the scene cannot be read.
    """
    known, name = [*BACKBONES, GENERIC], codebase or run.codebase
    if name is None or name not in known:
        untold = f"--backbone (not given): {run.folder} does not say which backbone trained it"
        raise UserInputError(f"{untold if name is None else f'--backbone {name}'}, expected one of {', '.join(known)}")
    backbone = GenericAdapter if name == GENERIC else BACKBONES[name]
    require_room(out, overwrite)
    recorded = {name: value for name, value in run.options.items() if _is_raster_option(name, value)}
    settings = {**backbone.info.raster_defaults, **recorded, **_checked(settings or {})}
    manifest = _manifest(run, backbone.info, scene, settings)
    scene_options = {"resolution": manifest.scene.resolution, "images": manifest.scene.images}
    with errors_about(run.folder / CFG_ARGS):
        size = smallest_size(manifest.scene.path, **scene_options)
    fields = {level.level: _field(level, manifest.levels, backbone) for level in run.levels}
    with RunArchive.create(out, manifest, overwrite) as archive:
        seconds, peak = 0.0, 0
        for level in run.levels:
            field = fields[level.level]
            # The release's peak includes earlier stages: an unchanged one was theirs.
            own_peak = level.peak or 0
            record = LevelRecord(
                level=level.level,
                signed=field.signed,
                iterations=level.iterations,
                num_gaussians=len(field),
                peak_gaussians=max(len(field), own_peak if own_peak > peak else 0),
                train_seconds=max(0.0, (level.seconds or seconds) - seconds),
                overhead_seconds={},
                image_size=level_size(size, level.level),
            )
            archive.finish_level(_as_recorded(record, run.record), field)
            seconds, peak = level.seconds or seconds, max(peak, own_peak)
        for entry in run.record.get("timeline", ()):
            archive.append_history({"level": 0, **entry})
    return archive


def _as_recorded(record: LevelRecord, noted: Mapping[str, Any]) -> LevelRecord:
    """Return a level's record with the measurements of its training."""
    if not noted:
        return record
    return replace(
        record,
        train_seconds=noted["train_seconds"],
        peak_gaussians=noted["peak_gaussians"],
        mean_gaussians=noted["mean_gaussians"],
        memory_bytes=noted["memory_bytes"],
        gpu_busy_seconds=noted.get("gpu_busy_seconds"),
        overhead_seconds={"saving": noted["saving_seconds"]},
    )


def _level(level: int, folder: Path, iteration: int | None) -> ForeignLevel:
    saved = {
        int(path.parent.name.removeprefix("iteration_")): path
        for path in (folder / "point_cloud").glob("iteration_*/point_cloud.ply")
        if re.fullmatch(r"iteration_0*[1-9][0-9]{0,8}", path.parent.name)
    }
    if not saved:
        raise RunFolderError(
            f"{folder / 'point_cloud'} holds no iteration_<n>/point_cloud.ply; expected the folder of a finished "
            "training"
        )
    chosen = max(saved) if iteration is None else iteration
    if chosen not in saved:
        iterations = ", ".join(map(str, sorted(saved)))
        raise RunFolderError(
            f"{folder / 'point_cloud'} holds fields of iterations {iterations}, expected {iteration}; choose with "
            "--iteration"
        )
    info = folder / TRAIN_INFO
    text = read_text(info, error=RunFolderError, advice=COPY) if exists(info) else ""
    seconds = re.search(r"Training Time: ([0-9]{1,12}(?:\.[0-9]{1,6})?) seconds", text)
    peak = re.search(r"Peak GS number: ([0-9]{1,12})\b", text)
    return ForeignLevel(
        level, chosen, saved[chosen], float(seconds.group(1)) if seconds else None, int(peak.group(1)) if peak else None
    )


def _recognised(options: Mapping[str, Any], record: Mapping[str, Any], breakdown: Mapping[str, Any]) -> str | None:
    """Return the backbone as we recorded it, by options that only it has, or as the release noted it; else None."""
    infos = [adapter.info for adapter in all_adapters()]
    by_options = [info for info in infos if any(name in options for name in info.telling_options)]
    told = (record.get("backbone"), *(info.name for info in by_options), breakdown.get("backbone"))
    return next((name for name in told if name in [*BACKBONES, GENERIC]), None)


def _is_raster_option(name: str, value: object) -> bool:
    """Whether it is a setting of rasterizers that changes images, with a value of its type."""
    kind = RASTER_OPTIONS.get(name)
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return kind is bool and isinstance(value, bool)


def _checked(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    for name, value in settings.items():
        if not _is_raster_option(name, value):
            forms = [f"{known}={'true|false' if kind is bool else 'NUMBER'}" for known, kind in RASTER_OPTIONS.items()]
            raise UserInputError(f"--set {name}={value}: expected one of {', '.join(forms)}")
    return settings


def _manifest(run: ForeignRun, backbone: BackboneInfo, scene: Path | None, settings: Mapping[str, Any]) -> Manifest:
    options = run.options
    path = (Path(options["source_path"]) if scene is None else scene).absolute()
    if not path.is_dir():
        hint = "say where it is now with -s" if scene is None else "give the scene's folder with -s"
        raise RunFolderError(f"the scene {path} of {run.folder} is not there; {hint}")
    return Manifest(
        scene=scene_reference(path, SimpleNamespace(**options)),
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
    return replace(backbone.saved_field(level.ply), signed=level.level != levels - 1)
