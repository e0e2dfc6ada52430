"""Make a scene from photos: `lapgs prepare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def prepare(
    photos: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="Folder of JPEG, PNG, TIFF, BMP or WebP photos of a static scene.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Scene folder to write.")],
    matcher: Annotated[
        str,
        typer.Option(
            help="Pairs of photos to match. exhaustive: all pairs, for up to a few hundred photos. sequential: "
            "neighbours in name order, for frames of a video."
        ),
    ] = "exhaustive",
    camera_model: Annotated[
        str,
        typer.Option(
            help="COLMAP's camera model to fit, such as SIMPLE_RADIAL (few photos) or OPENCV_FISHEYE (fisheye lens)."
        ),
    ] = "OPENCV",
    single_camera: Annotated[
        bool | None,
        typer.Option(
            "--single-camera/--own-cameras",
            help="Fit one camera to all photos, or one to each group of photos with the same EXIF data. Default: one "
            "camera if all photos have the same size.",
        ),
    ] = None,
    max_size: Annotated[
        int | None, typer.Option(help="Longest side of the scene's images in pixels. Default: that of the photos.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the scene in OUT, or restart unfinished work.")
    ] = False,
) -> None:
    """Make a scene from photos: recover cameras and points with COLMAP, then undistort the photos.

    OUT becomes a COLMAP scene with PINHOLE cameras, which `lapgs train` and every 3DGS codebase read. Repeat the
    command to continue an interrupted run.
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
