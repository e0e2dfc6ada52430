"""Find the points that training starts from: of a PLY beside an export, or of its depth maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file
from lapgs_plugin.scenes.exports.base import Array, Shot
from lapgs_plugin.scenes.images import read_depth, read_image
from lapgs_plugin.scenes.point_cloud import PointCloud, read_point_cloud
from lapgs_plugin.scenes.source import ALL_AROUND

TRIED_POINTS = 2_000
"""Most points that are compared."""
TRIED_SHOTS = 50
"""About how many cameras they are compared with."""
SEEN = 0.1
"""Share of points that cameras see at least if both are in the same coordinates."""
AROUND = 100.0
"""Farthest points that a panorama sees, in extents of the points and of the cameras together."""
DEPTH_SHOTS = 40
"""Most depth maps that points are made of."""
DEPTH_POINTS = 2_500
"""Most points of a depth map."""
MILLIMETRES = 1e-3


def points_beside(source: Path, *more: Path) -> PointCloud | None:
    """Return the points of the only PLY beside a file, or else in another folder; None without one.

    Raises:
        SceneError: there are several, or it is unreadable.
    """
    for folder in (source.parent, *more):
        files = [file for file in sorted(folder.glob("*")) if file.suffix.lower() == ".ply" and is_file(file)]
        if len(files) > 1:
            raise SceneError(
                f"{folder}: {files[0].name} and {files[1].name} are beside {source.name}, expected one PLY of the "
                "points to start from; move the other elsewhere"
            )
        if files:
            return read_point_cloud(files[0], str(files[0]))
    return None


def seen_share(points: Array, shots: Sequence[Shot]) -> float:
    """Return the share of points (n, 3) that at least one camera sees, were none hidden and no lens distorted.

    A panorama sees all that is not too far away to be of its scene.
    """
    some, tried = points[:: len(points) // TRIED_POINTS + 1], shots[:: len(shots) // TRIED_SHOTS + 1]
    seen = np.zeros(len(some), bool)
    farthest = AROUND * (_extent(some) + _extent(np.stack([_center(shot) for shot in tried])))
    for shot in tried:
        if shot.camera.model.name == ALL_AROUND:  # pycolmap has no calibration matrix of it
            seen |= np.linalg.norm(some - _center(shot), axis=1) <= farthest
            continue
        local = some @ shot.world_to_camera[:3, :3].T + shot.world_to_camera[:3, 3]
        matrix, (width, height) = shot.camera.calibration_matrix(), (shot.camera.width, shot.camera.height)
        front = local[:, 2] > 0
        pixels = local[front, :2] / local[front, 2:] * matrix.diagonal()[:2] + matrix[:2, 2]
        seen[front] |= ((pixels >= 0) & (pixels <= (width, height))).all(axis=1)
    return float(seen.mean()) if len(seen) else 0.0


def _center(shot: Shot) -> Array:
    """Return the position of a camera in the world, (3,)."""
    center: Array = -shot.world_to_camera[:3, :3].T @ shot.world_to_camera[:3, 3]
    return center


def _extent(positions: Array) -> float:
    """Return the median distance of positions (n, 3) from their middle; 0 of none."""
    if not len(positions):
        return 0.0
    return float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))


def depth_points(shots: Sequence[Shot], maps: Mapping[Path, Path], unit: float) -> PointCloud | None:
    """Return points of depth maps with the colours of their photos; None without any.

    Args:
        shots: with pinhole cameras.
        maps: depth maps of the photos that have one, along the optical axis, 0 where it is unknown.
        unit: metres for a step of an integer map; floating-point maps are in metres.
    """
    with_map = [shot for shot in shots if is_file(shot.photo) and shot.photo in maps]
    positions, colors = list[Array](), list[Array]()
    for shot in with_map[:: len(with_map) // DEPTH_SHOTS + 1]:
        depth = read_depth(maps[shot.photo], unit)  # (h, w)
        rows, columns = _some(np.isfinite(depth) & (depth > 0))
        height, width = depth.shape
        pixels = np.stack([columns + 0.5, rows + 0.5], 1) * (shot.camera.width / width, shot.camera.height / height)
        matrix, pose = shot.camera.calibration_matrix(), shot.world_to_camera
        rays = np.c_[(pixels - matrix[:2, 2]) / matrix.diagonal()[:2], np.ones(len(pixels))]
        local = rays * depth[rows, columns, None]
        positions.append((local - pose[:3, 3]) @ pose[:3, :3])
        photo = read_image(shot.photo, size=(width, height)).numpy()  # (3, h, w)
        colors.append(photo[:, rows, columns].T.astype(np.float64))
    if not sum(map(len, positions)):
        return None
    return PointCloud(np.concatenate(positions), np.concatenate(colors), "")


def _some(known: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of some known pixels, evenly spread over the map."""
    rows, columns = np.nonzero(known)
    chosen = np.random.default_rng(0).permutation(len(rows))[:DEPTH_POINTS]  # a step would make stripes
    return rows[chosen], columns[chosen]
