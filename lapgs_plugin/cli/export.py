"""Export the Gaussians of a run: `lapgs export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console, say
from lapgs_plugin.errors import UserInputError, counted, errors_about
from lapgs_plugin.options import check_values, option, refuse
from lapgs_plugin.runs.layout import require_place

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.runs.archive import RunArchive

PLY, SPZ, SPZ_4, GLB = "ply", "spz", "spz4", "glb"
SUFFIXES = {PLY: ".ply", SPZ: ".spz", SPZ_4: ".spz", GLB: ".glb"}
PAGE, MERGED, LOD = "scene.html", "merged", "lod"


@dataclass(frozen=True)
class ExportSettings:
    """Choose which fields of a run are exported, and their format.

    Raises:
        UserInputError: a value is unknown or out of range, or an option has no effect with the others.
    """

    file_format: str = option(
        PLY,
        "ply (the standard 3DGS layout), spz (version 3, smaller, lossy), spz4 (its version 4) or glb (glTF with "
        "KHR_gaussian_splatting).",
        names=("--format",),
        choices=tuple(SUFFIXES),
    )
    level: int | None = option(None, "Level to export; 0 is the finest. Default: all finished levels.")
    merge: bool = option(
        False,
        "Fit one ordinary field to the images of a run with residuals, and write it as merged.ply instead: an "
        "approximation for other viewers. Prints the PSNR that it keeps.",
    )
    iterations: int | None = option(None, "With --merge: iterations of the fit, one view each. Default: 3000.", least=1)
    html: bool = option(
        False,
        "Write scene.html instead: a viewer with the scene in one file, which opens offline and shows coarse levels "
        "while it loads. With --level: level_<l>_base.html or level_<l>_field.html.",
    )
    lod: bool = option(
        False,
        "Write the folder lod instead: levels of detail as streamed SOG (lod-meta.json), and each level as SPZ 4 and "
        "as glTF. Of nested levels, or with --merge of a run with residuals: the merged field and the base.",
    )
    clean: bool = option(
        False,
        "Remove floaters: Gaussians that fewer than three training views see, in front of the surface that other views "
        "see. Prints the PSNR of the training views before and after.",
    )
    crop: str | None = option(
        None,
        "Remove what lies outside of a box, x0,y0,z0,x1,y1,z1, or a sphere, x,y,z,r, in the scene's units; `lapgs view "
        "--crop` shows it. Prints the PSNR as --clean does.",
        metavar="BOX|SPHERE",
    )
    scene: Path | None = option(
        None, "With --merge, --html, --clean or --crop: the scene's folder now. Default: where it was trained."
    )
    out: Path | None = option(None, "Folder to write to. Default: RUN/export.", names=("--out", "-o"))

    def __post_init__(self) -> None:
        check_values(self)
        if not self.merge:
            refuse({"--iterations": self.iterations}, "needs --merge")
            needed = self.html or self.clean or self.crop is not None
            refuse({"--scene": None if needed else self.scene}, "needs --merge, --html, --clean or --crop")
        else:
            refuse({"--level": self.level}, "does not go with --merge, which makes one field of all levels")
        if self.crop is not None:
            from lapgs_plugin.fields.crop import Crop

            Crop.parse(self.crop)
        if self.html:
            refuse({"--format": None if self.file_format == PLY else self.file_format}, "does not go with --html")
        if self.lod:
            chosen = None if self.file_format == PLY else self.file_format
            refuse({"--format": chosen, "--html": self.html, "--level": self.level}, "does not go with --lod")


@takes_settings
def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    settings: ExportSettings,
) -> None:
    """Export RUN for other viewers: files of its levels, one merged field, levels of detail, or a web page.

    Files of levels are named level_<l>_base, level_<l>_residual or level_<l>_field. The base and nested levels are
    ordinary fields that open in any 3DGS viewer. A residual is not: its signed colours are added to the upsampled image
    of the coarser levels, which other viewers cannot do; --merge fits an ordinary field to the composition.

    Examples:

        lapgs export runs/garden --format spz

        lapgs export runs/garden --level 1 --out /tmp/base

        lapgs export runs/garden --merge    # residuals as one ordinary field

        lapgs export runs/garden --merge --html    # a page for the web

        lapgs export runs/nested --lod    # levels of detail

        lapgs export runs/garden --clean --crop 0,0,0,5    # in a sphere
    """
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.layout import EXPORT

    archive = RunArchive.open(run)
    folder = archive.results(EXPORT) if settings.out is None else settings.out
    require_place(folder)
    if settings.lod:
        _write_lod(archive, settings, folder / LOD)
    elif settings.html or settings.merge:
        _write_one(archive, settings, folder)
    else:
        _write_levels(archive, settings, folder)


def _write_levels(archive: RunArchive, settings: ExportSettings, folder: Path) -> None:
    """Write the field of each chosen level as a file."""
    from lapgs_plugin.rasterizers.choice import is_antialiased

    levels = _levels(archive, settings.level)
    fields = {level: archive.field(level) for level in levels}  # a damaged one is refused before anything is written
    fields = _cleaned(archive, fields, settings)
    antialiased = is_antialiased(archive.manifest)
    _require_held(fields, settings.file_format)
    _make(folder)
    for level, field in fields.items():
        path = folder / f"{_level_name(archive, level)}{SUFFIXES[settings.file_format]}"
        _write_field(field, path, _note(archive, level), settings.file_format, antialiased)
        remark = ", a residual" if field.signed else ""
        if antialiased and settings.file_format in (PLY, GLB):
            remark += ", antialiased: a viewer has to be told, as the format cannot"
        _print_written(path, field, remark)


def _write_one(archive: RunArchive, settings: ExportSettings, folder: Path) -> None:
    """Write one field, merged or of a level (by default the finest), as a file or a page."""
    chosen = archive.manifest.record(settings.level or 0).level
    field = _merged(archive, settings.scene, settings.iterations) if settings.merge else archive.field(chosen)
    if field.signed:
        raise UserInputError(
            f"{archive.path()}: level {chosen} is a residual, which no viewer shows by itself; add --merge to fit one "
            "field to the run"
        )
    if settings.html:
        _write_page(archive, settings, folder, chosen, field)
        return
    field = _cleaned(archive, {chosen: field}, settings, settings.merge)[chosen]
    _make(folder)
    path = folder / f"{MERGED}{SUFFIXES[settings.file_format]}"
    _write_field(field, path, f"one field fitted to the images of {archive.name}", settings.file_format)
    _print_written(path, field)


def _write_page(archive: RunArchive, settings: ExportSettings, folder: Path, level: int, field: GaussianField) -> None:
    """Write the page of a field, with the coarser levels of the run that it shows before the field has arrived."""
    from lapgs_plugin.rasterizers.choice import is_antialiased
    from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
    from lapgs_plugin.rendering.run import run_cameras
    from lapgs_plugin.reports.splat_page import shown_first, write_splat_page

    cameras = list(run_cameras(archive, settings.scene)[0].values())
    coarser = {number: archive.field(number) for number in archive.available_levels if number > level}
    coarser = {number: one for number, one in sorted(coarser.items()) if not one.signed}
    numbers = [level, *coarser]
    *first, _ = [numbers[index] for index in shown_first([len(field), *map(len, coarser.values())])]
    fields = {number: coarser[number] for number in first}
    if settings.merge:
        fields = _cleaned(archive, fields, settings) | _cleaned(archive, {level: field}, settings, merged=True)
    else:
        fields = _cleaned(archive, fields | {level: field}, settings)
    _make(folder)
    # Pages of several levels can lie beside each other.
    path = folder / (PAGE if settings.level is None else f"{_level_name(archive, settings.level)}.html")
    scene = archive.manifest.scene
    levels = [fields[number] for number in (*first, level)]
    write_splat_page(
        levels,
        path,
        archive.name,
        cameras,
        scene.background,
        NEAR_DEPTH * scene.unit,
        antialiased=is_antialiased(archive.manifest) and not settings.merge,
    )
    before = "".join(f"after level {number}, " for number in first)
    _print_written(path, levels[-1], f", {before}opens in a browser without a network")


def _write_lod(archive: RunArchive, settings: ExportSettings, folder: Path) -> None:
    """Write levels of detail as streamed SOG, and each of them as SPZ 4 and glTF."""
    from lapgs_plugin.errors import require_extra
    from lapgs_plugin.fields.sog import LOD_META, save_streamed_sog
    from lapgs_plugin.files import one_line_errors
    from lapgs_plugin.rasterizers.choice import is_antialiased

    require_extra("zstandard", "spz", "--lod")
    fields = _levels_of_detail(archive, settings)
    antialiased = set(fields) if is_antialiased(archive.manifest) else set()
    if settings.merge:
        antialiased -= {0}  # the merged field is fitted without
    _require_held(fields, SPZ_4, GLB)
    _make(folder)
    with one_line_errors(folder):
        save_streamed_sog(fields, folder, antialiased=antialiased)
    size = sum(path.stat().st_size for path in folder.glob("*/*"))
    counts = ", ".join(f"{len(field):,}" for _, field in sorted(fields.items()))
    say(f"{folder / LOD_META}: levels of {counts} Gaussians, {size / 1e6:.1f} MB, streamed SOG")
    for level, field in sorted(fields.items()):
        for file_format in (SPZ_4, GLB):
            path = folder / f"level_{level}{SUFFIXES[file_format]}"
            _write_field(field, path, f"level {level} of {archive.name}", file_format, level in antialiased)
            _print_written(path, field)


def _levels_of_detail(archive: RunArchive, settings: ExportSettings) -> dict[int, GaussianField]:
    """Return ordinary fields by level, cleaned as asked for: nested ones, or the merged one and the base."""
    base = archive.manifest.record(archive.manifest.levels - 1).level
    available = archive.available_levels
    if len(available) < 2:
        raise UserInputError(
            f"{archive.path()} has {counted(len(available), 'level')}, expected two or more for --lod; leave it out, "
            "or train with --hierarchy nested"
        )
    if settings.merge:
        merged = {0: _merged(archive, settings.scene, settings.iterations)}
        coarsest = _cleaned(archive, {base: archive.field(base)}, settings)
        return coarsest | _cleaned(archive, merged, settings, merged=True)
    fields = {level: archive.field(level) for level in available}
    if fields[min(fields)].signed:
        raise UserInputError(
            f"{archive.path()}: level {min(fields)} is a residual, which no viewer shows by itself; add --merge to fit "
            "one field to the run, which is then the finest level of detail"
        )
    return _cleaned(archive, fields, settings)


def _require_held(fields: Mapping[int, GaussianField], *file_formats: str) -> None:
    """Refuse fields by level that a format cannot hold, before the file of another level is written."""
    from lapgs_plugin.fields.gltf import require_glb
    from lapgs_plugin.fields.spz import require_spz

    for level, field in sorted(fields.items()):
        with errors_about(f"level {level}"):
            if not {SPZ, SPZ_4}.isdisjoint(file_formats):
                require_spz(field)
            if GLB in file_formats:
                require_glb(field)


def _make(folder: Path) -> None:
    from lapgs_plugin.files import one_line_errors

    with one_line_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


def _print_written(path: Path, field: GaussianField, remark: str = "") -> None:
    say(f"{path}: {len(field):,} Gaussians, {path.stat().st_size / 1e6:.1f} MB{remark}")


def _merged(archive: RunArchive, scene: Path | None, iterations: int | None) -> GaussianField:
    """Return a field that approximates the run, and print how well it does."""
    from lapgs_plugin.training.merge import ITERATIONS, merge_levels
    from lapgs_plugin.training.monitor import ProgressMonitor

    with ProgressMonitor(make_console(stderr=True), 1, advice=False) as monitor:
        merged = merge_levels(archive, scene, iterations=iterations or ITERATIONS, monitor=monitor)
    views = counted(merged.views, "view")
    line = f"{merged.kept:.2f} dB PSNR against the run's own images of {views} that it was not fitted to"
    if merged.photo_psnr is not None:
        line += f"; against the photos {merged.photo_psnr[1]:.2f} dB, where the run has {merged.photo_psnr[0]:.2f}"
        line += ", both after a colour fit" if merged.colors_fitted else ""
    say(f"merged field: {line}")
    return merged.field


def _cleaned(
    archive: RunArchive, fields: dict[int, GaussianField], settings: ExportSettings, merged: bool = False
) -> dict[int, GaussianField]:
    """Return fields without floaters and what lies outside of the crop, as asked for, and print what that changes.

    Args:
        fields: of some levels, or the merged one at level 0.
    """
    if not fields or (not settings.clean and settings.crop is None):
        return fields
    from lapgs_plugin.evaluation.cleaning import clean_levels
    from lapgs_plugin.fields.crop import Crop

    # A residual lies on the surface of the base, and its image is a sum with the coarser ones.
    coarser = () if merged else filter(lambda level: level > min(fields), archive.available_levels)
    run = {level: archive.field(level) for level in coarser} | fields
    crop = None if settings.crop is None else Crop.parse(settings.crop)
    levels, views = clean_levels(archive, run, settings.scene, floaters=settings.clean, crop=crop)
    for level, cleaned in sorted(levels.items(), reverse=True):
        removed = [counted(cleaned.floaters, "floater")] * settings.clean + [f"{cleaned.outside:,} outside"] * bool(
            crop
        )
        before, after = cleaned.psnr
        say(
            f"{'merged field' if merged else f'level {level}'}: removed {' and '.join(removed)} of {len(run[level]):,} "
            f"Gaussians; PSNR of {counted(views, 'training view')} {before:.2f} dB before, {after:.2f} dB after"
        )
    return {level: levels[level].field for level in fields}


def _write_field(field: GaussianField, path: Path, note: str, file_format: str, antialiased: bool = False) -> None:
    """Write a field as a file of a format. SPZ alone says whether it was trained with antialiasing."""
    from lapgs_plugin.fields.gltf import save_glb
    from lapgs_plugin.fields.spz import save_spz
    from lapgs_plugin.files import one_line_errors

    with one_line_errors(path):
        if file_format in (SPZ, SPZ_4):
            save_spz(field, path, note, 4 if file_format == SPZ_4 else 3, antialiased=antialiased)
        elif file_format == GLB:
            save_glb(field, path, note)
        else:
            field.save_ply(path, [note])


def _levels(archive: RunArchive, level: int | None) -> tuple[int, ...]:
    """Return the levels to export."""
    if level is None:
        archive.manifest.record(archive.manifest.levels - 1)  # raises if no level is finished
        return archive.available_levels
    return (archive.manifest.record(level).level,)


def _level_name(archive: RunArchive, level: int) -> str:
    """Return the name of a level's files, without suffix."""
    if level == archive.manifest.levels - 1:
        return f"level_{level}_base"
    return f"level_{level}_{'residual' if archive.manifest.record(level).signed else 'field'}"


def _note(archive: RunArchive, level: int) -> str:
    """Return a comment for the file's header that describes the level."""
    name, levels = archive.name, archive.manifest.levels
    if level == levels - 1:
        return f"base of {name}, a hierarchy of {levels} levels" if levels > 1 else f"field of {name}"
    if not archive.manifest.record(level).signed:
        return f"field of level {level} of {name}, a hierarchy of {levels} nested levels"
    return (
        f"residual of level {level} of {name}: signed colours over zero, to be added to the upsampled image of level "
        f"{level + 1}; not a scene by itself"
    )
