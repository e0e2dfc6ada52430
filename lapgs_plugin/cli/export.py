"""`lapgs export`: the fields of a run for other viewers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import RunArchive

FORMATS = ("ply", "spz")


def export(
    run: Annotated[Path, typer.Argument(help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")],
    file_format: Annotated[
        str,
        typer.Option("--format", help="ply (standard 3DGS, exact) or spz (version 3, a tenth of the size, rounded)."),
    ] = "ply",
    level: Annotated[int | None, typer.Option(help="This level alone. Default: every finished one.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to write to. Default: RUN/export.")] = None,
) -> None:
    """Write each level of RUN as a file for other viewers: level_<l>_base, level_<l>_residual or level_<l>_field.

    The base is an ordinary field and opens in any 3DGS viewer. A residual is none: it holds what its level adds to the
    upsampled image of the levels above it, in signed colours over zero. Its file says so, in a comment of the PLY's or
    gzip's header; what another viewer shows of it is not the composition. Where levels are nested every one is an
    ordinary field.

    Examples:

        lapgs export runs/garden --format spz

        lapgs export runs/garden --level 1 --out /tmp/base
    """
    from lapgs_plugin.fields.spz import save_spz
    from lapgs_plugin.files import one_line_errors
    from lapgs_plugin.runs.archive import EXPORT, RunArchive

    if file_format not in FORMATS:
        raise UserInputError(f"--format {file_format}: expected {' or '.join(FORMATS)}")
    archive = RunArchive.open(run)
    levels, folder = _levels(archive, level), archive.path(EXPORT) if out is None else out
    fields = {each: archive.field(each) for each in levels}  # all are whole before anything is written
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


def _levels(archive: RunArchive, level: int | None) -> tuple[int, ...]:
    """The finished levels to write, or the one that is wanted."""
    if level is None:
        archive.manifest.record(archive.manifest.levels - 1)  # refuses a run without any
        return archive.available_levels
    return (archive.manifest.record(level).level,)


def _note(archive: RunArchive, level: int) -> str:
    """What a person should know who finds the file."""
    name, levels = archive.path().name, archive.manifest.levels
    if level == levels - 1:
        return f"base of {name}, a hierarchy of {levels} levels" if levels > 1 else f"field of {name}"
    if not archive.manifest.record(level).signed:
        return f"field of level {level} of {name}, a hierarchy of {levels} nested levels"
    return (
        f"residual of level {level} of {name}: signed colours over zero, to be added to the upsampled image of level "
        f"{level + 1}; not a scene by itself"
    )
