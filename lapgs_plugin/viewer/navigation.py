"""Between viser's cameras and ours. Both have OpenCV's axes; viser keeps the pose of the camera, we its inverse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from viser.transforms import SO3

from lapgs_plugin.camera import Camera
from lapgs_plugin.field import GaussianField
from lapgs_plugin.rendering.rig import Rig, Vector, forward

Quaternion = NDArray[np.float64]  # (4,) w, x, y, z


@dataclass(frozen=True)
class Pose:
    """Where a camera stands and what it looks at.

    Attributes:
        wxyz: (4,) unit quaternion, camera to world.
        position: (3,) centre in world units.
        fov: vertical field of view in radians.
    """

    wxyz: Quaternion
    position: Vector
    fov: float

    @classmethod
    def of(cls, camera: Camera) -> Pose:
        """The pose of a camera; where its principal point lies is lost."""
        return cls(
            np.asarray(SO3.from_matrix(camera.world_to_camera[:3, :3].double().numpy().T).wxyz, dtype=np.float64),
            np.asarray(camera.position.double().numpy()),
            2.0 * math.atan(camera.tan_half_fov[1]),
        )

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a picture of that size, with square pixels and a centred principal point."""
        to_camera = SO3(self.wxyz / np.linalg.norm(self.wxyz)).as_matrix().T
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = to_camera, -to_camera @ self.position
        focal = height / (2.0 * math.tan(0.5 * self.fov))
        return Camera(width, height, focal, focal, width / 2.0, height / 2.0, torch.from_numpy(world_to_camera).float())


@dataclass(frozen=True)
class Start:
    """Where a client begins.

    Attributes:
        position, look_at, up: (3,) in world units.
        fov: vertical, in radians.
    """

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


def start_at(camera: Camera, rig: Rig) -> Start:
    """Begin where a camera of the scene stands, turning about what it looks at."""
    pose = Pose.of(camera)
    return Start(
        pose.position, pose.position + turning_distance(pose.position, rig) * forward(camera), rig.up, pose.fov
    )


def start_outside(field: GaussianField) -> Start:
    """Begin in front of a field whose cameras are not known, with the up direction of COLMAP's images."""
    means = field.means.detach().cpu().double().numpy()
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.8))
    return Start(centre - np.array([0.0, 0.0, 2.5 * radius]), centre, np.array([0.0, -1.0, 0.0]), math.radians(50.0))


def turning_distance(position: Vector, rig: Rig) -> float:
    """How far ahead of a camera the point lies that it is to orbit about."""
    return max(float(np.linalg.norm(rig.focus - position)), 1e-3 * rig.distance)
