"""Writing the sample scene as a COLMAP folder: images, exact poses, noisy sparse points with their tracks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.progress import item_progress
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.output import fresh_scene, write_model
from lapgs_plugin.scenes.sample.cameras import orbit_camera
from lapgs_plugin.scenes.sample.points import SparsePoints, sample_points
from lapgs_plugin.scenes.sample.raycast import render
from lapgs_plugin.scenes.sample.world import World, build_world

MIN_SIDE = 16
MAX_POINTS = 10_000_000
MAX_VIEWS = 9999  # names have four digits, so that their order is that of the views


def make_sample_scene(
    out: Path,
    *,
    width: int = 480,
    height: int = 320,
    views: int = 40,
    points: int = 4000,
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> None:
    """Write a still life of test patterns in a round library as a COLMAP scene.

    images/0000.png ... and sparse/0/ with one PINHOLE camera, exact poses, and sparse points. Lengths are metres, z is
    up. The same arguments give the same bytes on the same machine. View i is the same picture whatever `views` is.

    Args:
        out: the scene folder; new, empty, or with `overwrite` one that holds a scene. It appears when it is complete.
        width, height: image size in pixels, at least 16.
        views: number of images, 2 to 9999.
        points: number of sparse points, at least 1. Each lies on a surface that at least two views see, off by noise of
            6 mm a coordinate; their tracks hold the exact image positions.
        seed: chooses colours, patterns and cameras.
        overwrite: replace the scene that `out` holds.
        progress: show a bar on stderr.

    Raises:
        UserInputError: an argument is out of range or `out` must not be written to.
        LapgsError: the disk is full or the folder cannot be written.
    """
    _check("--size", f"{width}x{height}", min(width, height) >= MIN_SIDE, f"at least {MIN_SIDE}x{MIN_SIDE}")
    _check("--views", views, 2 <= views <= MAX_VIEWS, f"2 to {MAX_VIEWS}")
    VIEW_PIXELS.check(width * height, f"--size {width}x{height}", "choose a smaller one")
    _check("--points", points, 1 <= points <= MAX_POINTS, f"1 to {MAX_POINTS}")
    _check("--seed", seed, seed >= 0, "0 or more")
    with fresh_scene(out, overwrite) as folder:
        world = build_world(seed)
        cameras = [orbit_camera(index, (width, height), seed) for index in range(views)]
        _write_images(folder / "images", world, cameras, progress)
        _write_model(folder / "sparse" / "0", cameras, sample_points(world, cameras, points, seed))


def _check(option: str, value: object, valid: bool, expected: str) -> None:
    if not valid:
        raise UserInputError(f"{option} {value}: expected {expected}")


def _name(view: int) -> str:
    return f"{view:04d}.png"


def _write_images(folder: Path, world: World, cameras: Sequence[Camera], progress: bool) -> None:
    """Render the views in parallel."""

    def write(view: int) -> None:
        image = torch.from_numpy(render(world, cameras[view]))  # (h, w, 3)
        write_image(folder / _name(view), image.permute(2, 0, 1))

    bar = item_progress("images") if progress else None
    task = bar.add_task("Rendering images", total=len(cameras)) if bar else None
    # One thread an image: each worker's own pool inside torch would only compete with the others.
    pool = ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,))
    with bar or nullcontext():
        try:
            for future in as_completed([pool.submit(write, view) for view in range(len(cameras))]):
                future.result()
                if bar and task is not None:
                    bar.advance(task)
        finally:
            pool.shutdown(cancel_futures=True)


def _write_model(folder: Path, cameras: Sequence[Camera], points: SparsePoints) -> None:
    model = pycolmap.Reconstruction()
    first = cameras[0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="PINHOLE",
            width=first.width,
            height=first.height,
            params=[first.fx, first.fy, first.cx, first.cy],
        )
    )
    tracks = [pycolmap.Track() for _ in points.observations]
    positions: list[list[NDArray[np.float64]]] = [[] for _ in cameras]
    for track, (views, pixels) in zip(tracks, points.observations, strict=True):
        for view, pixel in zip(views, pixels, strict=True):
            track.add_element(int(view) + 1, len(positions[view]))
            positions[view].append(pixel)
    for view, camera in enumerate(cameras):
        pose = pycolmap.Rigid3d(camera.world_to_camera[:3].numpy())
        observed = [pycolmap.Point2D(pixel) for pixel in positions[view]]
        image = pycolmap.Image(name=_name(view), points2D=observed, camera_id=1, image_id=view + 1)
        model.add_image_with_trivial_frame(image, pose)
    for position, color, track in zip(points.positions, points.colors, tracks, strict=True):
        model.add_point3D(position, track, color)
    model.update_point_3d_errors()
    write_model(model, folder)
