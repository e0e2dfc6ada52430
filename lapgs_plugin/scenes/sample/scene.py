"""Write the sample scene as a COLMAP folder: images, exact poses, noisy sparse points with tracks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.output import fresh_scene, write_model
from lapgs_plugin.scenes.parallel import in_threads
from lapgs_plugin.scenes.sample.points import SparsePoints, sample_points
from lapgs_plugin.scenes.sample.raycast import World, render
from lapgs_plugin.scenes.sample.world import build_world

MIN_SIDE = 16
MAX_SIDE = 8192
MAX_VIEWS = 9999  # names of four digits sort as numbers
MAX_POINTS = 1_000_000
MOST_THREADS = 4
"""Threads that render; patterns are painted by small NumPy operations, in which more threads wait for each other."""

TARGET = (0.0, 0.0, 0.85)
ELEVATIONS = (6.0, 36.0)  # degrees
DISTANCES = (4.2, 5.0)  # metres
SWAY = 0.15  # metres that the target moves either way
FOCAL_RATIO = 1.025  # focal length over the longer side of the image: 52 degrees

STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0])
"""Steps of azimuth, elevation, distance and target from view to view, in parts of their range, modulo 1.

Multiples of these irrational numbers fill the ranges evenly, both for the first n views and for every eighth view. The
golden ratio does not: eight of its steps are nearly a whole turn, so held-out views would stand side by side."""


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
    """Write a still life of test patterns in a round hall as a COLMAP scene.

    The folder holds images/0000.png ... and sparse/0/ with one PINHOLE camera. Lengths are metres, z is up. The same
    arguments give the same bytes on the same machine. Image i does not depend on `views`.

    Args:
        out: the scene folder; new, empty, or with `overwrite` a scene. It appears when it is complete.
        width, height: image size in pixels, 16 to 8192.
        views: number of images, 2 to 9999.
        points: number of sparse points, 1 to 1,000,000. At least two views see each. Coordinates have noise of
            `points.NOISE`; tracks hold the exact image positions.
        seed: chooses patterns and cameras.
        overwrite: replace the scene in `out`.
        progress: show a bar on stderr.

    Raises:
        UserInputError: an argument is out of range or `out` must not be written to.
        LapgsError: the disk is full or the folder cannot be written.
    """
    check_sample_scene(width, height, views, points, seed)
    with fresh_scene(out, overwrite) as folder:
        world = build_world(seed)
        cameras = [orbit_camera(index, (width, height), seed) for index in range(views)]
        _write_images(folder / "images", world, cameras, progress)
        _write_model(folder / "sparse" / "0", cameras, sample_points(world, cameras, points, seed))


def check_sample_scene(width: int, height: int, views: int, points: int, seed: int = 0) -> None:
    """Check the arguments of `make_sample_scene`.

    Raises:
        UserInputError: an argument is out of range.
    """
    sizes = min(width, height) >= MIN_SIDE, max(width, height) <= MAX_SIDE
    for option, value, valid, expected in (
        ("--size", f"{width}x{height}", sizes[0], f"at least {MIN_SIDE}x{MIN_SIDE}"),
        ("--size", f"{width}x{height}", sizes[1], f"at most {MAX_SIDE}x{MAX_SIDE}"),
        ("--views", views, 2 <= views <= MAX_VIEWS, f"2 to {MAX_VIEWS}"),
        ("--points", points, points >= 1, "at least 1"),
        ("--points", points, points <= MAX_POINTS, f"at most {MAX_POINTS}"),
        ("--seed", seed, seed >= 0, "0 or more"),
    ):
        if not valid:
            raise UserInputError(f"{option} {value}: expected {expected}")


def orbit_camera(index: int, size: tuple[int, int], seed: int) -> Camera:
    """Return camera number `index`, from 0. `size` is (width, height) in pixels; `seed` shifts all cameras alike."""
    start = np.random.default_rng([seed, 2]).random(len(STEPS))
    azimuth, elevation, distance, *sway = (start + index * STEPS) % 1.0
    angle = np.radians(np.interp(elevation, (0, 1), ELEVATIONS))
    target = np.array(TARGET) + SWAY * (2 * np.array(sway) - 1)
    outwards = np.array(
        [np.cos(2 * np.pi * azimuth) * np.cos(angle), np.sin(2 * np.pi * azimuth) * np.cos(angle), np.sin(angle)]
    )
    return _looking_at(target + np.interp(distance, (0, 1), DISTANCES) * outwards, target, size)


def _looking_at(centre: NDArray[np.float64], target: NDArray[np.float64], size: tuple[int, int]) -> Camera:
    """Return a camera without roll."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    width, height = size
    focal = FOCAL_RATIO * max(size)
    return Camera(width, height, focal, focal, width / 2, height / 2, torch.from_numpy(pose))


def _write_images(folder: Path, world: World, cameras: Sequence[Camera], progress: bool) -> None:
    """Render the views in parallel."""

    def write(view: int) -> None:
        image = torch.from_numpy(render(world, cameras[view]))  # (h, w, 3)
        write_image(folder / f"{view:04d}.png", image.permute(2, 0, 1))

    in_threads("Rendering images", "images", write, range(len(cameras)), most=MOST_THREADS, progress=progress)


def _write_model(folder: Path, cameras: Sequence[Camera], points: SparsePoints) -> None:
    model = pycolmap.Reconstruction()
    first = cameras[0]
    size, params = first.size, [first.fx, first.fy, first.cx, first.cy]
    lens = pycolmap.Camera(camera_id=1, model="PINHOLE", width=size[0], height=size[1], params=params)
    model.add_camera_with_trivial_rig(lens)
    tracks = [pycolmap.Track() for _ in points.positions]
    for view, camera in enumerate(cameras):
        observed = np.flatnonzero(points.seen[:, view])
        for index, point in enumerate(observed):
            tracks[point].add_element(view + 1, index)
        pixels = [pycolmap.Point2D(pixel) for pixel in points.pixels[observed, view]]
        image = pycolmap.Image(name=f"{view:04d}.png", points2D=pixels, camera_id=1, image_id=view + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.world_to_camera[:3].numpy()))
    colors = np.round(points.colors * 255).astype(np.uint8)
    for position, color, track in zip(points.positions, colors, tracks, strict=True):
        model.add_point3D(position, track, color)
    model.update_point_3d_errors()
    write_model(model, folder)
