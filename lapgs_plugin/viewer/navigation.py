"""Between viser's cameras and ours. Both have OpenCV's axes; viser keeps the pose of the camera, we its inverse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from viser.transforms import SO3

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.rendering.rig import Vector, posed
from lapgs_plugin.viewer.start import centred_lens, vertical_fov

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
            vertical_fov(camera),
        )

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a picture of that size, with square pixels and a centred principal point."""
        rotation = np.asarray(SO3(self.wxyz / np.linalg.norm(self.wxyz)).as_matrix(), dtype=np.float64)
        return posed(centred_lens(width, height, self.fov), rotation, self.position)
