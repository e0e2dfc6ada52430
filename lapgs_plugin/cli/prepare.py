"""`lapgs prepare`: from a folder of photos to a scene that trains."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def prepare(
    photos: Annotated[Path, typer.Argument(help="Folder of JPEG, PNG, TIFF, BMP or WebP photos of one scene at rest.")],
    out: Annotated[Path, typer.Argument(help="Scene folder to write.")],
    matcher: Annotated[
        str,
        typer.Option(
            help="exhaustive: all pairs, for up to a few hundred photos. sequential: neighbours by name, for a video."
        ),
    ] = "exhaustive",
    camera_model: Annotated[
        str,
        typer.Option(help="COLMAP's lens model to fit: SIMPLE_RADIAL for few photos, OPENCV_FISHEYE for fisheyes, ..."),
    ] = "OPENCV",
    single_camera: Annotated[
        bool | None,
        typer.Option(
            "--single-camera/--own-cameras",
            help="All photos share one lens, or only those with the same EXIF. Default: one if all have one size.",
        ),
    ] = None,
    max_size: Annotated[
        int | None, typer.Option(help="Longest side in pixels of the scene's images. Default: as the photos.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the scene that OUT holds, or start unfinished work over.")
    ] = False,
) -> None:
    """Recover cameras and points from photos with COLMAP and undistort the photos.

    OUT becomes a scene with PINHOLE cameras that `lapgs train` and every 3DGS codebase read. An interrupted run goes on
    where it stopped when the command is repeated.
    """
    from lapgs_plugin.scenes.prepare import prepare_scene

    result = prepare_scene(
        photos,
        out,
        matcher=matcher,
        camera_model=camera_model.upper(),
        single_camera=single_camera,
        max_size=max_size,
        overwrite=overwrite,
    )
    total = len(result.registered) + len(result.left_out)
    typer.echo(
        f"{out}: {len(result.registered)} of {total} photos, {result.points} points, "
        f"mean reprojection error {result.reprojection_error:.2f} pixels, "
        + ", ".join(f"{step.lower()} {seconds:.0f} s" for step, seconds in result.seconds.items())
    )
    typer.echo(f"next: lapgs train {out} -o RUN")
