"""Export the Gaussians of a run: `lapgs export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.rendering import refuse
from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import RunArchive

FORMATS = ("ply", "spz")
PAGE = "scene.html"


def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    file_format: Annotated[
        str,
        typer.Option("--format", help="ply (the standard 3DGS layout) or spz (version 3, smaller, lossy)."),
    ] = "ply",
    level: Annotated[
        int | None, typer.Option(help="Level to export; 0 is the finest. Default: all finished levels.")
    ] = None,
    html: Annotated[
        bool,
        typer.Option(
            "--html",
            help="Write RUN/export/scene.html instead: a viewer with the scene in one file, which opens offline.",
        ),
    ] = False,
    scene: Annotated[
        Path | None, typer.Option(help="With --html: the scene's folder now. Default: where it was trained.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write to. Default: RUN/export.")] = None,
) -> None:
    """Export the Gaussians of each level of RUN as PLY or SPZ for other viewers.

    Files are named level_<l>_base, level_<l>_residual or level_<l>_field. The base and nested levels are ordinary
    fields that open in any 3DGS viewer. A residual of a Laplacian hierarchy is not: its signed colours are added to the
    upsampled image of the coarser levels, so another viewer cannot show the composition. A comment in the header of its
    file says so.

    Examples:

        lapgs export runs/garden --format spz

        lapgs export runs/garden --level 1 --out /tmp/base

        lapgs export runs/garden --html        (a page for the web)
    """
    from lapgs_plugin.fields.spz import save_spz
    from lapgs_plugin.files import one_line_errors
    from lapgs_plugin.runs.archive import EXPORT, RunArchive

    if file_format not in FORMATS:
        raise UserInputError(f"--format {file_format}: expected {' or '.join(FORMATS)}")
    archive = RunArchive.open(run)
    refuse({"--scene": None if html else scene}, "needs --html")
    if html:
        refuse({"--format": None if file_format == "ply" else file_format}, "does not go with --html")
        _write_page(archive, level, scene, archive.path(EXPORT) if out is None else out)
        return
    levels, folder = _levels(archive, level), archive.path(EXPORT) if out is None else out
    fields = {each: archive.field(each) for each in levels}  # a damaged one ends the command before anything is written
    with one_line_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for each, field in fields.items():
        note = _note(archive, each)
        kind = "base" if each == archive.manifest.levels - 1 else "residual" if field.signed else "field"
        path = folder / f"level_{each}_{kind}.{file_format}"
        with one_line_errors(path):
            if file_format == "spz":
                save_spz(field, path, note)
            else:
                field.save_ply(path, [note])
        print(
            f"{path}: {len(field):,} Gaussians, {path.stat().st_size / 1e6:.1f} MB"
            + (", a residual" if field.signed else "")
        )


def _write_page(archive: RunArchive, level: int | None, scene: Path | None, folder: Path) -> None:
    """Write a level's field, by default the finest, as a page."""
    from lapgs_plugin.files import one_line_errors
    from lapgs_plugin.rendering.run import run_cameras
    from lapgs_plugin.reports.splat_page import write_splat_page

    chosen = archive.manifest.record(0 if level is None else level).level
    field = archive.field(chosen)
    if field.signed:
        raise UserInputError(
            f"{archive.path()}: level {chosen} is a residual, which no viewer shows by itself; train with --hierarchy "
            "nested for a page of full quality, or take the base with --level "
            f"{archive.manifest.levels - 1}"
        )
    cameras = list(run_cameras(archive, scene)[0].values())
    with one_line_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    path = folder / PAGE
    write_splat_page(field, path, archive.path().name, cameras, archive.manifest.scene.background)
    print(f"{path}: {len(field):,} Gaussians, {path.stat().st_size / 1e6:.1f} MB, opens in a browser without a network")


def _levels(archive: RunArchive, level: int | None) -> tuple[int, ...]:
    """Return the levels to export."""
    if level is None:
        archive.manifest.record(archive.manifest.levels - 1)  # raises if no level is finished
        return archive.available_levels
    return (archive.manifest.record(level).level,)


def _note(archive: RunArchive, level: int) -> str:
    """Return a comment for the file's header that says what the level is."""
    name, levels = archive.path().name, archive.manifest.levels
    if level == levels - 1:
        return f"base of {name}, a hierarchy of {levels} levels" if levels > 1 else f"field of {name}"
    if not archive.manifest.record(level).signed:
        return f"field of level {level} of {name}, a hierarchy of {levels} nested levels"
    return (
        f"residual of level {level} of {name}: signed colours over zero, to be added to the upsampled image of level "
        f"{level + 1}; not a scene by itself"
    )
