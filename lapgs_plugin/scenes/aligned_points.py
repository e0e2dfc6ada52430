"""Take the points of a COLMAP model for a transforms file that names none, as nerfstudio's before version 1."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.colmap import MODEL_PLACES, find_model
from lapgs_plugin.scenes.colmap_model import read_model
from lapgs_plugin.scenes.point_cloud import PointCloud
from lapgs_plugin.scenes.source import Frame

FEWEST = 3
"""Fewest common cameras from which a similarity transform between two worlds is computed."""
FIT = 1e-2
"""Largest error of a camera's rotation, and of its position as a share of the cameras' extent."""


def aligned_points(path: Path, frames: Sequence[Frame]) -> PointCloud | None:
    """Return the points of the COLMAP model in a scene folder, in the world of the frames of its transforms file.

    Photos are recognised by the last part of their names. None without such a model, or if no similarity transform maps
    its cameras to those of the frames.
    """
    model = None
    with suppress(SceneError):
        model = None if (folder := find_model(path, MODEL_PLACES)) is None else read_model(folder)
    if model is None or not len(model.points.xyz):
        return None
    poses = {PurePosixPath(frame.name).name: frame.camera.world_to_camera.numpy()[:3] for frame in frames}
    others = {
        PurePosixPath(image.name).name: image.pose.matrix() for image in model.images.values() if image.has_rotation
    }
    names = sorted(poses.keys() & others.keys())
    if len(names) < FEWEST:
        return None
    turns, centers = _turns_and_centers([poses[name] for name in names])
    other_turns, other_centers = _turns_and_centers([others[name] for name in names])
    middle, other_middle = centers.mean(axis=0), other_centers.mean(axis=0)
    extent, other_extent = (float(np.linalg.norm(part - part.mean(axis=0))) for part in (centers, other_centers))
    if not other_extent:
        return None
    scale, turn = extent / other_extent, turns[0] @ other_turns[0].T

    points, fitted = (middle + scale * (part - other_middle) @ turn.T for part in (model.points.xyz, other_centers))
    if np.abs(turn @ other_turns - turns).max() > FIT or np.abs(fitted - centers).max() > FIT * extent:
        return None
    warning = f"{path}: its transforms file names no PLY of points that is there; those of {model.folder} are used"
    return PointCloud(points, model.points.rgb / 255.0, warning)


def _turns_and_centers(poses: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (v, 3, 3) from cameras to the world and positions (v, 3) of poses (3, 4), world to camera."""
    stacked = np.stack(poses)
    turns = stacked[:, :, :3].transpose(0, 2, 1)
    return turns, -np.einsum("vij,vj->vi", turns, stacked[:, :, 3])
