"""Make a scene from photos: `lapgs prepare`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import log_to_stderr, say, train_command
from lapgs_plugin.errors import MissingExtraError, counted
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.scenes.prepare.settings import PrepareSettings


@takes_settings
def prepare(
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS",
            help="Folder of JPEG, PNG, TIFF, BMP, WebP or HEIC photos of a static scene, a video, or a scene folder of "
            "COLMAP, nerfstudio or another program's export, whose cameras are kept.",
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Scene folder to write.")],
    *,
    settings: PrepareSettings,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the scene in OUT, or restart unfinished work.")
    ] = False,
) -> None:
    """Make a scene from photos or a video: recover cameras and points with COLMAP, then undistort the photos.

    OUT becomes a COLMAP scene with PINHOLE cameras, which `lapgs train` and every 3DGS codebase read. A scene whose
    cameras are known but distorted is only undistorted. Repeat the command to continue an interrupted run.
    """
    import logging

    from lapgs_plugin.interrupt import advise
    from lapgs_plugin.scenes.prepare.pipeline import prepare_scene

    log_to_stderr("%(message)s")
    logging.getLogger("lapgs_plugin.scenes").setLevel(logging.INFO)
    advise(f"{out} keeps the finished steps, repeat the command to continue")
    result = prepare_scene(photos, out, settings, overwrite=overwrite)
    total = len(result.registered) + len(result.left_out)
    error = f"mean reprojection error {result.reprojection_error:.2f} pixels, " if result.reprojection_error else ""
    say(
        f"{out}: {len(result.registered)} of {total} photos, {counted(result.points, 'point')}, {error}"
        + ", ".join(f"{step[0].lower()}{step[1:]} {seconds:.0f} s" for step, seconds in result.seconds.items())
    )
    say(f"next: {next_command(out)}")


def next_command(out: Path) -> str:
    """Return the command that trains the scene. It has options for minutes where a CPU would take hours."""
    from lapgs_plugin.files import is_file
    from lapgs_plugin.scenes.images import image_size
    from lapgs_plugin.training.backend import MINUTES_ON_A_CPU, choose_rasterizer, long_on_a_cpu
    from lapgs_plugin.training.settings import TrainSettings

    images = sorted(filter(is_file, (out / "images").rglob("*")))
    iterations = TrainSettings().for_photos(len(images)).iterations
    size = image_size(images[0])
    if long_on_a_cpu(size, iterations):
        with suppress(MissingExtraError):  # of a machine with a GPU
            if choose_rasterizer(AUTO) == "cpu":
                return train_command(out, MINUTES_ON_A_CPU)
    return train_command(out)
