"""Describe camera poses of clients, and convert between viser's cameras and ours.

Both have OpenCV's axes; viser keeps the camera's pose, we keep its inverse. viser is imported in functions, because a
training without it also saves a preview.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rendering.rig import Rig, Vector, forward, looking, posed
from lapgs_plugin.runs.archive import RunArchive

Quaternion = NDArray[np.float64]  # (4,) w, x, y, z


@dataclass(frozen=True)
class Pose:
    """The pose and field of view of a camera.

    Attributes:
        wxyz: (4,) quaternion, camera to world.
        position: (3,) centre in world units.
        fov: vertical field of view in radians.
    """

    wxyz: Quaternion
    position: Vector
    fov: float

    @classmethod
    def of(cls, camera: Camera) -> Pose:
        """Return the pose of a camera; its principal point is lost."""
        from viser.transforms import SO3

        rotation = camera.world_to_camera[:3, :3].double().numpy().T
        wxyz = np.asarray(SO3.from_matrix(rotation).wxyz, dtype=np.float64)
        return cls(wxyz, np.asarray(camera.position.double().numpy()), vertical_fov(camera))

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) camera to world."""
        from viser.transforms import SO3

        return np.asarray(SO3(self.wxyz / np.linalg.norm(self.wxyz)).as_matrix(), dtype=np.float64)

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of a picture of that size, with square pixels and a centred principal point."""
        return posed(centred_lens(width, height, self.fov), self.rotation, self.position)


@dataclass(frozen=True)
class InitialView:
    """The view that clients begin with.

    Attributes:
        position, look_at, up: (3,) in world units.
        fov: vertical field of view in radians.
    """

    position: Vector
    look_at: Vector
    up: Vector
    fov: float

    @classmethod
    def of_camera(cls, camera: Camera, rig: Rig) -> InitialView:
        """Begin at a camera of the scene, orbiting around the point that it looks at."""
        position = np.asarray(camera.position.double().numpy())
        ahead = orbit_distance(position, rig) * forward(camera)
        return cls(position, position + ahead, rig.up, vertical_fov(camera))

    @classmethod
    def of_field(cls, field: GaussianField) -> InitialView:
        """Begin in front of a field with unknown cameras, with the up direction of COLMAP's images."""
        means = field.means.detach().cpu().double().numpy()
        if len(means) == 0:
            means = np.zeros((1, 3))
        centre = np.median(means, axis=0)
        radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.8)) or 1.0  # all at one place
        position = centre - np.array([0.0, 0.0, 2.5 * radius])
        return cls(position, centre, np.array([0.0, -1.0, 0.0]), math.radians(50.0))

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of a client that begins here, in a window of that size."""
        return looking(centred_lens(width, height, self.fov), self.position, self.look_at, self.up)


@dataclass(frozen=True)
class SceneCameras:
    """The cameras of a run's scene.

    Attributes:
        by_view: by view name, held-out ones first.
        rig: of the training cameras.
    """

    by_view: Mapping[str, Camera]
    rig: Rig

    @classmethod
    def of(cls, archive: RunArchive, moved_to: Path | None = None) -> SceneCameras:
        """Read the cameras of a run; arguments and errors as `rendering.run.run_cameras`."""
        from lapgs_plugin.rendering.run import (
            run_cameras,
        )  # a backbone's environment may lack packages that read scenes

        train, test = run_cameras(archive, moved_to)
        return cls({**test, **train}, Rig.of(list(train.values())))

    @property
    def start(self) -> InitialView:
        """The view from the first camera."""
        return InitialView.of_camera(next(iter(self.by_view.values())), self.rig)

    def begins_as(self, other: SceneCameras | None) -> bool:
        """Return whether clients of another scene begin at the same place, looking at the same point."""
        if other is None:
            return False
        ours, theirs = self.start, other.start
        places = np.stack([ours.position, ours.look_at]), np.stack([theirs.position, theirs.look_at])
        return bool(np.allclose(*places, rtol=0.0, atol=1e-4 * self.rig.distance))


def orbit_distance(position: Vector, rig: Rig) -> float:
    """Return the distance from a camera to the point that it orbits around."""
    return max(float(np.linalg.norm(rig.focus - position)), 1e-3 * rig.distance)


def vertical_fov(camera: Camera) -> float:
    """Return the vertical field of view in radians, as if the principal point were centred."""
    return 2.0 * math.atan(camera.tan_half_fov[1])


def centred_lens(width: int, height: int, fov: float) -> Camera:
    """Make a camera at the origin with square pixels, a centred principal point and a vertical fov in radians."""
    focal = height / (2.0 * math.tan(0.5 * fov))
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, torch.eye(4))
