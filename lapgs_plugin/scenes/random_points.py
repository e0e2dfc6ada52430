"""Make random points for scenes without any, for training to start from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.scenes.source import Frame

RANDOM_POINTS = 100_000
"""Number of random points where a scene has none."""
OBJECT_RADIUS = 1.3 / 4.03
"""Half the side of the cube of random points for a Blender scene, in mean distances of the cameras from its centre.
3DGS uses 1.3 for NeRF's objects, whose cameras are 4.03 away."""
CAPTURE_RADIUS = 1.0
"""Half the side of the cube, in the same unit, for photos that also show the surroundings."""


def random_points(
    frames: Sequence[Frame], radius: float = CAPTURE_RADIUS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return grey points in a cube around the point that the cameras look at.

    Args:
        frames: with the cameras, at least one.
        radius: half the side of the cube, in mean distances of the cameras from its centre.

    Returns:
        Positions in world units and colours in [0, 1], (n, 3) each.
    """
    poses = np.stack([frame.camera.world_to_camera.numpy() for frame in frames])  # (v, 4, 4)
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])  # (v, 3)
    axes = poses[:, 2, :3]  # (v, 3) viewing directions in world coordinates
    # The least-squares point closest to all optical axes, relative to the mean centre: parallel axes, which do not
    # determine its depth, put it among the cameras.
    projectors = np.eye(3) - np.einsum("vi,vj->vij", axes, axes)  # (v, 3, 3)
    middle = centers.mean(axis=0)
    offsets = np.einsum("vij,vj->i", projectors, centers - middle)
    focus = middle + np.linalg.lstsq(projectors.sum(axis=0), offsets, rcond=1e-6)[0]
    half_side = radius * np.linalg.norm(centers - focus, axis=1).mean()
    cube = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_POINTS, 3))
    return focus + half_side * cube, np.full((RANDOM_POINTS, 3), 0.5)
