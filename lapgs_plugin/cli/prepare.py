"""Make a scene from photos: `lapgs prepare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import train_command
from lapgs_plugin.scenes.prepare.settings import PrepareSettings


@takes_settings
def prepare(
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS", help="Folder of JPEG, PNG, TIFF, BMP, WebP or HEIC photos of a static scene, or a video."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Scene folder to write.")],
    *,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the scene in OUT, or restart unfinished work.")
    ] = False,
    settings: PrepareSettings,
) -> None:
    """Make a scene from photos or a video: recover cameras and points with COLMAP, then undistort the photos.

    OUT becomes a COLMAP scene with PINHOLE cameras, which `lapgs train` and every 3DGS codebase read. Repeat the
    command to continue an interrupted run.
    """
    import logging

    from lapgs_plugin.interrupt import advise
    from lapgs_plugin.scenes.prepare.pipeline import prepare_scene

    logging.basicConfig(format="%(message)s")
    logging.getLogger("lapgs_plugin.scenes").setLevel(logging.INFO)
    advise(f"{out} keeps the finished steps, repeat the command to continue")
    result = prepare_scene(photos, out, settings, overwrite=overwrite)
    total = len(result.registered) + len(result.left_out)
    typer.echo(
        f"{out}: {len(result.registered)} of {total} photos, {result.points} points, "
        f"mean reprojection error {result.reprojection_error:.2f} pixels, "
        + ", ".join(f"{step[0].lower()}{step[1:]} {seconds:.0f} s" for step, seconds in result.seconds.items())
    )
    typer.echo(f"next: {train_command(out)}")
