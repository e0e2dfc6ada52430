"""Make a run folder from a model that another program trained: `lapgs import-run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lapgs_plugin.adapters.registry import GENERIC, OWN
from lapgs_plugin.cli.output import say
from lapgs_plugin.errors import UserInputError


def import_run(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Output folder (-m) of a 3DGS codebase or the paper authors' release."),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder to write. Default: FOLDER/lapgs.")] = None,
    scene: Annotated[
        Path | None, typer.Option("--scene", "-s", help="Scene folder, if it was moved after training.")
    ] = None,
    backbone: Annotated[
        str | None,
        typer.Option(
            help=f"Codebase that trained it, if the folder does not tell: {', '.join(OWN)}, or {GENERIC} (any fork)."
        ),
    ] = None,
    iteration: Annotated[
        int | None, typer.Option(help="Import the model saved at this iteration. Default: the last one.")
    ] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A rasterizer option that FOLDER does not record, if it was not the default: mult=0.7, "
            "kernel_size=0.3 or antialiasing=true. Repeatable.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in OUT.")] = False,
) -> None:
    """Make a run folder from a model that was trained without this program.

    `lapgs render`, `lapgs eval`, `lapgs report` and `lapgs view` work on the result. FOLDER is the output of a 3DGS
    codebase (point_cloud/), which becomes a run of one level, or of the paper authors' release (L1/, L0/). The latter
    is rendered as its own script does, assuming that it was trained with --blur_up as in its scripts. The fields are
    copied; FOLDER stays unchanged.

    Examples:

        lapgs import-run output/garden --backbone fastgs

        lapgs import-run output/garden -o runs/garden --backbone taming
    """
    from lapgs_plugin.runner.imported import import_run as make_run
    from lapgs_plugin.runner.imported import read_foreign_run

    run = read_foreign_run(folder, iteration)
    target = folder / "lapgs" if out is None else out
    archive = make_run(
        run, target, codebase=backbone, scene=scene, settings=_parsed(setting or []), overwrite=overwrite
    )
    for record in archive.manifest.records:
        width, height = record.image_size
        say(f"level {record.level}: {record.num_gaussians:,} Gaussians, {record.iterations:,} steps, {width}x{height}")
    if not run.times_are_known:
        say("the training time is not recorded there: it is shown as 0")
    say(f"{archive.path()} holds the run")


def _parsed(texts: list[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        known = {"true": True, "false": False}
        try:
            values[name] = known[value.lower()] if value.lower() in known else float(value)
        except ValueError as error:
            raise UserInputError(f"--set {text}: expected NAME=NUMBER, true or false, such as mult=0.7") from error
    return values
