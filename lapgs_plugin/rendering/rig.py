"""Measure a scene's cameras together: the point they look at, the up direction, their distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera

Vector = NDArray[np.float64]  # (3,)

RIDGE = 1e-3
"""Weight of the initial guess, against 1 for each optical axis; it matters for nearly parallel axes."""
NO_LENGTH = 1e-9
"""Vectors up to this length have no direction."""


@dataclass(frozen=True)
class Rig:
    """Hold the cameras of a scene and their common geometry.

    Attributes:
        cameras: at least one.
        focus: (3,) point nearest to all optical axes, in world units.
        up: (3,) unit vector, the mean up direction of the images.
        distance: median distance of a camera from the focus, in world units.
    """

    cameras: tuple[Camera, ...]
    focus: Vector
    up: Vector
    distance: float

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Rig:
        """Measure a set of cameras."""
        assert cameras, "a rig has at least one camera"
        positions, forwards = camera_positions(cameras), np.stack([forward(camera) for camera in cameras])
        focus = _nearest_to_axes(positions, forwards)
        mean_up = np.mean([-_rotation(camera)[1] for camera in cameras], axis=0)
        up = unit(mean_up) if np.linalg.norm(mean_up) > NO_LENGTH else -_rotation(cameras[0])[1]
        distance = float(np.median(np.linalg.norm(positions - focus, axis=1)))
        return cls(tuple(cameras), focus, up, distance)

    @property
    def surrounds(self) -> bool:
        """Whether the cameras stand around the focus rather than on one side of it."""
        outwards = camera_positions(self.cameras) - self.focus
        flat = outwards - np.outer(outwards @ self.up, self.up)
        lengths = np.linalg.norm(flat, axis=1)
        directions = flat[lengths > NO_LENGTH] / lengths[lengths > NO_LENGTH, None]
        # Directions spread evenly over an angle of 180 degrees have a mean of length 2 / pi.
        return len(directions) > 2 and float(np.linalg.norm(directions.mean(axis=0))) < 2.0 / np.pi


def camera_positions(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return camera centres in world coordinates, (n, 3)."""
    return np.stack([camera.position.double().numpy() for camera in cameras])


def forward(camera: Camera) -> Vector:
    """Return the unit vector along the optical axis in world coordinates, (3,)."""
    return np.asarray(_rotation(camera)[2])


def unit(vector: Vector) -> Vector:
    """Normalize a vector that is not zero."""
    return vector / np.linalg.norm(vector)


def looking(lens: Camera, position: Vector, at: Vector, up: Vector) -> Camera:
    """Return a camera with this lens at `place`, looking at `at`, with `up` upwards in its image; all (3,)."""
    ahead = unit(at - position)
    right = unit(np.cross(ahead, up))
    return posed(lens, np.stack([right, np.cross(ahead, right), ahead], axis=1), position)


def posed(lens: Camera, rotation: NDArray[np.float64], position: Vector) -> Camera:
    """Return a camera with this lens and a pose: rotation camera to world, (3, 3), and centre, (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ position
    return replace(lens, world_to_camera=torch.from_numpy(pose).float())


def _rotation(camera: Camera) -> NDArray[np.float64]:
    """Return the rotation world to camera, (3, 3): its rows are right, down and forward in world coordinates."""
    return np.asarray(camera.world_to_camera[:3, :3].double().numpy())


def _nearest_to_axes(positions: NDArray[np.float64], forwards: NDArray[np.float64]) -> Vector:
    """Return the point with the least sum of squared distances to the lines positions + t * forwards, both (n, 3)."""
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    guess = positions.mean(axis=0) + (spread or 1.0) * forwards.mean(axis=0)
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # (n, 3, 3)
    left = across.sum(axis=0) + RIDGE * len(positions) * np.eye(3)
    right = np.einsum("nij,nj->i", across, positions) + RIDGE * len(positions) * guess
    return np.asarray(np.linalg.solve(left, right))
