"""Where a client begins to look at a run. Without viser: trainings without a viewer keep the picture from there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rendering.rig import Rig, Vector, forward, looking


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

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a client that begins there, in a window of that size."""
        return looking(centred_lens(width, height, self.fov), self.position, self.look_at, self.up)


def start_at(camera: Camera, rig: Rig) -> Start:
    """Begin where a camera of the scene stands, turning about what it looks at."""
    position = np.asarray(camera.position.double().numpy())
    ahead = turning_distance(position, rig) * forward(camera)
    return Start(position, position + ahead, rig.up, vertical_fov(camera))


def start_outside(field: GaussianField) -> Start:
    """Begin in front of a field whose cameras are not known, with the up direction of COLMAP's images."""
    means = field.means.detach().cpu().double().numpy()
    centre = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.8))
    return Start(centre - np.array([0.0, 0.0, 2.5 * radius]), centre, np.array([0.0, -1.0, 0.0]), math.radians(50.0))


def turning_distance(position: Vector, rig: Rig) -> float:
    """How far ahead of a camera the point lies that it is to orbit about."""
    return max(float(np.linalg.norm(rig.focus - position)), 1e-3 * rig.distance)


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view in radians, as if the principal point were in the middle."""
    return 2.0 * math.atan(camera.tan_half_fov[1])


def centred_lens(width: int, height: int, fov: float) -> Camera:
    """A camera at the origin with square pixels, a centred principal point and a vertical field of view in radians."""
    focal = height / (2.0 * math.tan(0.5 * fov))
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, torch.eye(4))
