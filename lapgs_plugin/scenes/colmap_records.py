"""Hold the records of COLMAP's files, binary or text: https://colmap.github.io/format.html."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

OTHER_LENS = "calibrate with OPENCV, with OPENCV_FISHEYE a fisheye, or export undistorted photos with pinhole cameras"
"""Advice where the camera model is none of COLMAP's."""
LARGEST_ID = 2**32 - 2
"""Largest id of a camera or an image; the next number means none."""
UNIT_TOLERANCE = 1e-2
"""Largest difference of a quaternion's length from 1; COLMAP writes 17 digits."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a model.

    Attributes:
        name: relative to the image folder, with forward slashes.
        camera_id: of its camera.
        numbers: (7,) world to camera: a quaternion w, x, y, z, and a translation.
        features: (n, 2) pixels of its features; none unless they were asked for.
    """

    name: str
    camera_id: int
    numbers: NDArray[np.float64]  # (7,)
    features: NDArray[np.float64]  # (n, 2)

    @property
    def has_rotation(self) -> bool:
        """Whether the quaternion has about length 1."""
        return abs(math.hypot(*self.numbers[:4]) - 1.0) <= UNIT_TOLERANCE

    @property
    def pose(self) -> pycolmap.Rigid3d:
        """World to camera."""
        return rigid(self.numbers)


@dataclass(frozen=True, eq=False)
class Points:
    """The points of a model.

    Attributes:
        xyz: (n, 3) float64 positions in world units.
        rgb: (n, 3) colours from 0 to 255.
        errors: (n,) mean reprojection errors in pixels, NaN where there is none; empty unless asked for.
        tracks: for each point (k, 2) image ids and numbers of their features, which may not exist; empty unless asked
            for.
        warning: a line for the user who trains on the points, or "".
    """

    xyz: NDArray[np.float64]  # (n, 3)
    rgb: NDArray[np.float64]  # (n, 3)
    errors: Sequence[float] = ()
    tracks: Sequence[NDArray[np.int64]] = ()
    warning: str = ""


NO_FEATURES: NDArray[np.float64] = np.empty((0, 2))
NO_TRACK: NDArray[np.int64] = np.empty((0, 2), np.int64)


def file_name(name: str) -> str:
    """Return the name of an image with forward slashes."""
    return name.replace("\\", "/")


def rigid(numbers: NDArray[np.float64]) -> pycolmap.Rigid3d:
    """Return the pose of a quaternion w, x, y, z and a translation, (7,).

    Raises:
        ZeroDivisionError: the quaternion is 0.
    """
    length = math.hypot(*numbers[:4])
    w, x, y, z = (value / length for value in numbers[:4].tolist())
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), numbers[4:])
