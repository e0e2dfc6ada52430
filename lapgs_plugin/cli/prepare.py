"""Make a scene from photos: `lapgs prepare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def prepare(
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS", help="Folder of JPEG, PNG, TIFF, BMP, WebP or HEIC photos of a static scene, or a video."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Scene folder to write.")],
    matcher: Annotated[
        str,
        typer.Option(
            help="Pairs of photos to match. exhaustive: all pairs, for up to a few hundred photos. sequential: "
            "neighbours in name order, for frames of a video. retrieval: each photo with those that look most like it. "
            "auto: sequential for a video, retrieval for more than 500 photos, else exhaustive."
        ),
    ] = "auto",
    mapper: Annotated[
        str, typer.Option(help="How cameras are placed. incremental: one after the other. global: all at once.")
    ] = "incremental",
    camera_model: Annotated[
        str,
        typer.Option(
            help="COLMAP's camera model to fit, such as SIMPLE_RADIAL (few photos) or OPENCV_FISHEYE (fisheye lens). "
            "auto: OPENCV, and SIMPLE_RADIAL if that places few photos or gives implausible focal lengths."
        ),
    ] = "auto",
    single_camera: Annotated[
        bool | None,
        typer.Option(
            "--single-camera/--own-cameras",
            help="Fit one camera to all photos, or one to each group of photos with the same EXIF data. Default: one "
            "camera if all photos have the same size and camera.",
        ),
    ] = None,
    max_size: Annotated[
        int | None, typer.Option(help="Longest side of the scene's images in pixels. Default: that of the photos.")
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            help="Folder of masks: white where a photo shows the scene, black where it is ignored (a.jpg.png, a.png or "
            "a_mask.png for a.jpg). Default: transparent pixels of the photos, if there are any."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Frames to pick from a video. Default: two a second, 40 to 240.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the scene in OUT, or restart unfinished work.")
    ] = False,
) -> None:
    """Make a scene from photos or a video: recover cameras and points with COLMAP, then undistort the photos.

    OUT becomes a COLMAP scene with PINHOLE cameras, which `lapgs train` and every 3DGS codebase read. Repeat the
    command to continue an interrupted run.
    """
    import logging

    from lapgs_plugin.interrupt import advise
    from lapgs_plugin.scenes.prepare import AUTO, prepare_scene

    logging.basicConfig(format="%(message)s")
    logging.getLogger("lapgs_plugin.scenes").setLevel(logging.INFO)
    advise("repeat the command to go on where it stopped")
    result = prepare_scene(
        photos,
        out,
        matcher=matcher,
        mapper=mapper,
        camera_model=camera_model if camera_model == AUTO else camera_model.upper(),
        single_camera=single_camera,
        max_size=max_size,
        masks=masks,
        frames=frames,
        overwrite=overwrite,
    )
    total = len(result.registered) + len(result.left_out)
    typer.echo(
        f"{out}: {len(result.registered)} of {total} photos, {result.points} points, "
        f"mean reprojection error {result.reprojection_error:.2f} pixels, "
        + ", ".join(f"{step.lower()} {seconds:.0f} s" for step, seconds in result.seconds.items())
    )
    typer.echo(f"next: lapgs train {out} -o RUN")
