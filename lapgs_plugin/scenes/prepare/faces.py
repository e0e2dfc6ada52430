"""Choose the pinhole images, called faces, that photos which see all around are cut into."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]

AROUND = 8
"""Faces around the horizon. With those up and down, every eighth view in name order is not always the same face."""
AROUND_ANGLES = (60.0, 100.0)
"""Width and height of these faces in degrees; neighbours overlap by 15."""
POLE_ANGLES = (100.0, 100.0)
"""Width and height of the faces up and down."""
DOWN = np.array([0.0, 1.0, 0.0])
"""Direction of the tripod in a panorama's axes: x right, y down, z towards its middle."""


@dataclass(frozen=True, eq=False)
class Face:
    """A pinhole image of a part of what a photo sees.

    Attributes:
        name: ends the names of its images.
        turn: (3, 3) rotation from the photo's axes to its own.
        angles: its width and height in degrees.
    """

    name: str
    turn: Array  # (3, 3)
    angles: tuple[float, float]

    def camera(self, focal: float) -> pycolmap.Camera:
        """Return its camera of this focal length in pixels, whose size is rounded up."""
        width, height = (math.ceil(2.0 * focal * math.tan(math.radians(angle / 2.0))) for angle in self.angles)
        params = [focal, focal, width / 2.0, height / 2.0]
        return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)

    def name_of(self, image: str) -> str:
        """Return the name of its image of a photo.

        >>> Face("f0", np.eye(3), (60.0, 100.0)).name_of("walk/a.jpg")
        'walk/a_f0.jpg'
        """
        path = PurePosixPath(image)
        return path.with_name(f"{path.stem}_{self.name}{path.suffix}").as_posix()


def panorama_faces(tripod: float) -> tuple[Face, ...]:
    """Return the faces of an equirectangular photo: around the horizon, up, and down.

    Args:
        tripod: radius in degrees, from straight down, of what is ignored. The face down is left out if others show the
            rest.
    """
    turns = [_turn(azimuth, 0.0) for azimuth in np.arange(AROUND) * (360.0 / AROUND)]
    faces = [(turn, AROUND_ANGLES) for turn in turns]
    faces += [(_turn(0.0, elevation), POLE_ANGLES) for elevation in (90.0, -90.0)]
    lowest = math.tan(math.radians(AROUND_ANGLES[1] / 2.0)) * math.cos(math.pi / AROUND)  # between neighbours
    count = len(faces) - (tripod >= 90.0 - math.degrees(math.atan(lowest)))
    return tuple(Face(f"f{index}", *face) for index, face in enumerate(faces[:count]))


def focal_at_center(width: int) -> float:
    """Return the focal length of faces with as many pixels a degree as an equirectangular photo of this width."""
    return width / (2.0 * math.pi)


def _turn(azimuth: float, elevation: float) -> Array:
    """Return the rotation (3, 3) to a camera that looks so many degrees to the right and up."""
    a, e = math.radians(azimuth), math.radians(elevation)
    right = np.array([math.cos(a), 0.0, -math.sin(a)])
    forward = np.array([math.sin(a) * math.cos(e), -math.sin(e), math.cos(a) * math.cos(e)])
    return np.stack([right, np.cross(forward, right), forward])
