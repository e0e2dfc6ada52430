"""Make camera paths: around the focus of a scene's cameras, through the cameras, or from a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.limits import FRAMES, VIEW_PIXELS
from lapgs_plugin.rendering.rig import Rig, camera_positions, looking, posed, unit
from lapgs_plugin.scenes.blender import read_camera
from lapgs_plugin.scenes.source import check_camera
from lapgs_plugin.untrusted import read_json, shortened

MAX_KEYS = 24
"""Most cameras that a spline passes; handheld photos are too shaky to pass all of many."""

JUMPING = 2.0
"""Path length in the given order, relative to a short tour, above which the order is not that of capture."""

FACING_SHARE = 0.5
"""Radius of an orbit, as a share of the cameras' spread, if all cameras are on one side."""

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


def orbit(rig: Rig, frames: int) -> list[Camera]:
    """Make a closed circle that looks at the rig's focus.

    If the cameras surround the focus, the circle is around it at their mean height and median distance. Otherwise it is
    a small circle around their mean position, so that nothing is shown from where no photo was taken.

    Args:
        rig: the scene's cameras; the path has the size and lens of the median one.
        frames: number of frames; the next would be the first again.
    """
    positions = camera_positions(rig.cameras)
    middle = positions.mean(axis=0)
    if rig.surrounds:
        height = float((middle - rig.focus) @ rig.up)
        centre, axis = rig.focus + height * rig.up, rig.up
        radius = float(np.median(np.linalg.norm(np.cross(positions - rig.focus, rig.up), axis=1)))
        start = positions[0] - centre
    else:
        centre, axis = middle, unit(rig.focus - middle)
        radius = FACING_SHARE * float(np.sqrt(np.mean(np.sum((positions - middle) ** 2, axis=1))))
        start = rig.up
    first = unit(start - (start @ axis) * axis)
    second = np.cross(axis, first)
    lens = _median_lens(rig.cameras)
    angles = 2.0 * math.pi * np.arange(frames) / frames
    places = [centre + radius * (math.cos(angle) * first + math.sin(angle) * second) for angle in angles]
    return [looking(lens, position, rig.focus, rig.up) for position in places]


def spline(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Make a smooth path through cameras in the given order, from the first to the last.

    Positions follow a cubic spline, orientations a spline of constant angular acceleration between two cameras. The
    time between two cameras grows with their distance, so that the speed is nearly constant. Of many cameras every n-th
    is passed. The path has the size and lens of the median camera.
    """
    from scipy.interpolate import CubicSpline  # a third of a second, which commands without such a path need not wait
    from scipy.spatial.transform import Rotation, RotationSpline

    keys = [cameras[i] for i in np.unique(np.linspace(0, len(cameras) - 1, MAX_KEYS).round().astype(int))]
    lens = _median_lens(cameras)
    positions = camera_positions(keys)
    rotations = np.stack([key.world_to_camera[:3, :3].double().numpy().T for key in keys])  # (k, 3, 3) camera to world
    times = _passing_times(positions, rotations)
    kept = np.concatenate([[True], np.diff(times) > 0])  # without cameras of the same pose
    times, positions, rotations = times[kept], positions[kept], rotations[kept]
    if len(times) == 1:
        return [posed(lens, rotations[0], positions[0])] * frames
    when = np.linspace(0.0, times[-1], frames)
    places = CubicSpline(times, positions)(when)
    turned = RotationSpline(times, Rotation.from_matrix(rotations))(when).as_matrix()
    return [posed(lens, rotation, position) for rotation, position in zip(turned, places, strict=True)]


def walking_order(cameras: Sequence[Camera]) -> list[Camera]:
    """Return cameras in an order for a walk: the given order, or a short tour if that jumps back and forth.

    The order of a video, and usually of photos, is how somebody walked.
    """
    from scipy.spatial.distance import cdist  # as for `spline`

    positions = camera_positions(cameras)
    distances = cdist(positions, positions)  # (n, n)
    tour = _short_tour(distances)
    as_given = float(np.diagonal(distances, 1).sum())
    jumps = as_given > JUMPING * float(distances[tour[:-1], tour[1:]].sum())
    return [cameras[i] for i in tour] if jumps else list(cameras)


def read_trajectory(path: Path) -> list[Camera]:
    """Read the cameras of a file in the format of a Blender-style transforms.json, without images.

    {"w": 1280, "h": 720, "fl_x": 1100, "frames": [{"transform_matrix": [[...], [...], [...], [...]]}, ...]}

    Each matrix is camera to world with OpenGL's axes (x right, y up, z back). "fl_y" defaults to "fl_x", "cx" and "cy"
    to the image centre, and "camera_angle_x" in radians may replace "fl_x". A frame may override any of these, but
    not the size. Distortion is ignored.

    Raises:
        UserInputError: the file or one of its cameras cannot be used; names the frame.
    """
    advice = "give orbit, spline or a JSON file of cameras as in transforms.json"
    values = read_json(path, advice=advice, finite=False)
    frames = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserInputError(f'--trajectory {path}: no cameras in it, expected a list "frames" as in transforms.json')
    FRAMES.check(len(frames), f"--trajectory {path} has {len(frames)} frames")
    cameras = []
    for index, frame in enumerate(frames):
        where = f"--trajectory {path}: frame {index}"
        if not isinstance(frame, dict):
            raise UserInputError(f"{where} is {shortened(frame)}, expected a table with transform_matrix")
        camera = read_camera({**values, **frame}, where)
        check_camera(where, camera)
        subject = f"{where} has {camera.width}x{camera.height} pixels"
        VIEW_PIXELS.check(camera.width * camera.height, subject, "write a smaller w and h")
        cameras.append(camera.to(dtype=torch.float32))
    return cameras


def trajectory_json(cameras: Sequence[Camera]) -> dict[str, Any]:
    """Return cameras in the format of `read_trajectory`, all with the size of the first."""
    first = cameras[0]
    frames = [
        {
            "transform_matrix": (np.linalg.inv(camera.world_to_camera.double().numpy()) @ OPENGL_AXES).tolist(),
            **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        }
        for camera in cameras
    ]
    return {"w": first.width, "h": first.height, "frames": frames}


def with_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera with another size and the same vertical field of view."""
    width, height = size
    scale = height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=width / 2 + (camera.cx - camera.width / 2) * scale,
        cy=camera.cy * scale,
    )


def _short_tour(distances: NDArray[np.float64]) -> list[int]:
    """Return indices of all points in the order of a short tour from the first: nearest neighbour, then 2-opt."""
    tour, passed = [0], np.zeros(len(distances), bool)
    for _ in range(1, len(distances)):
        passed[tour[-1]] = True
        tour.append(int(np.where(passed, np.inf, distances[tour[-1]]).argmin()))
    least_gain, improved = 1e-9 * distances.max(), True
    while improved:
        improved = False
        for i in range(len(tour) - 2):
            here, after = distances[tour[i]], distances[tour[i + 1]]
            ends = np.array(tour[i + 2 :])
            beyond = np.array([*tour[i + 3 :], -1])  # nothing follows the last
            gain = here[tour[i + 1]] - here[ends]
            gain[:-1] += distances[ends[:-1], beyond[:-1]] - after[beyond[:-1]]
            best = int(gain.argmax())
            if gain[best] > least_gain:
                tour[i + 1 : i + 3 + best] = tour[i + 1 : i + 3 + best][::-1]
                improved = True
    return tour


def _passing_times(positions: NDArray[np.float64], rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return when each key is passed, (k,): by path length, with half the usual length added for a usual turn."""
    ways = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    turns = np.linalg.norm(np.diff(rotations[:, :, 2], axis=0), axis=1)
    usual_way, usual_turn = (float(np.median(steps)) if len(steps) else 0.0 for steps in (ways, turns))
    way_of_turn = usual_way / usual_turn if min(usual_way, usual_turn) > 0 else 1.0
    return np.concatenate([[0.0], np.cumsum(ways + 0.5 * way_of_turn * turns)])


def _median_lens(cameras: Sequence[Camera]) -> Camera:
    """Return the camera with the median field of view as a pinhole; its pose is not used."""
    return sorted(cameras, key=lambda camera: camera.tan_half_fov[1])[len(cameras) // 2].straight()
