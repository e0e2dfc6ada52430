"""Choose the pinhole images, called faces, that photos of panoramas and wide lenses are cut into."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
import pycolmap
from numpy.typing import NDArray

from lapgs_plugin.scenes.source import PINHOLE_MODELS

Array = NDArray[np.float64]

AROUND = 8
"""Faces around the horizon. With those up and down, every eighth view in name order is not always the same face."""
AROUND_ANGLES = (60.0, 100.0)
"""Width and height of these faces in degrees; neighbours overlap by 15."""
POLE_ANGLES = (100.0, 100.0)
"""Width and height of the faces up and down."""
WIDE = 110.0
"""Width or height in degrees above which a distorted lens has faces: a pinhole image would lose its borders."""
WIDEST_FACE = 65.0
"""Largest width and height of the faces of a wide lens in degrees, without their overlap."""
OVERLAP = 15.0
"""Degrees by which faces of a wide lens overlap. Borders of pinhole images, too, bend away from their neighbours."""
ANGLE_STEP = 0.25
"""Degrees between the directions by which it is found out what a lens sees."""
FARTHEST = 89.75
"""Largest angle from its axis in degrees at which COLMAP knows what a lens sees."""
UNFOLDED = np.cos(np.radians(0.1))
"""Least cosine between a direction and that of its pixel. Polynomials of lenses fold back beyond what they see."""
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


def wide_faces(camera: pycolmap.Camera) -> tuple[Face, ...]:
    """Return the faces of a distorted lens that sees more than `WIDE` degrees; none of others.

    They are in rows and columns of equal angles, and show all that the lens sees within 90 degrees of its axis.
    """
    if camera.model.name in PINHOLE_MODELS and camera.is_undistorted():
        return ()
    polar = np.radians(np.arange(ANGLE_STEP, FARTHEST, ANGLE_STEP))
    around = np.radians(np.arange(0.0, 360.0, 2.0))
    away, turn = np.meshgrid(polar, around)
    rays = np.stack([np.sin(away) * np.cos(turn), np.sin(away) * np.sin(turn), np.cos(away)], axis=-1)
    seen = np.logical_and.accumulate(sees(camera, rays.reshape(-1, 3)).reshape(away.shape), axis=1)
    reach = np.degrees(np.where(seen, away, 0.0).max(axis=1)).reshape(4, -1)[:, 0]  # right, down, left, up
    if max(reach[0] + reach[2], reach[1] + reach[3]) <= WIDE:
        return ()
    x, y, z = np.moveaxis(rays[seen], -1, 0)
    columns, width = _parts(np.degrees(np.arctan2(x, z)))
    rows, height = _parts(np.degrees(np.arcsin(-y)))
    turns = [_turn(azimuth, elevation) for elevation in rows[::-1] for azimuth in columns]
    return tuple(Face(f"f{index}", turn, (width, height)) for index, turn in enumerate(turns))


def _parts(angles: Array) -> tuple[Array, float]:
    """Return the middles of equal parts of a range of angles in degrees, and their size with overlap."""
    lowest, highest = float(angles.min()), float(angles.max())
    count = math.ceil((highest - lowest) / WIDEST_FACE)
    size = (highest - lowest) / count
    middles: Array = lowest + (np.arange(count, dtype=np.float64) + 0.5) * size
    return middles, size + OVERLAP


def sees(camera: pycolmap.Camera, rays: Array) -> NDArray[np.bool_]:
    """Return which unit directions (n, 3) a lens shows in its image."""
    front = rays[:, 2] > 0
    pixels = np.asarray(camera.img_from_cam(np.where(front[:, None], rays, (0.0, 0.0, 1.0))))
    with np.errstate(invalid="ignore"):
        front &= ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        back = np.asarray(camera.cam_ray_from_img(np.where(front[:, None], pixels, 0.0)))
        front &= (back * rays).sum(axis=1) >= UNFOLDED
    return front


def focal_towards(camera: pycolmap.Camera, face: Face) -> float:
    """Return the focal length of a face with as many pixels a degree, in its middle, as the photo has there."""
    step = np.radians(ANGLE_STEP)
    pixels = np.asarray(camera.img_from_cam(np.array([[0, 0, 1], [step, 0, 1], [0, step, 1]]) @ face.turn))
    across, down = np.linalg.norm(pixels[1:] - pixels[0], axis=1) / step
    focal = max(across, down)
    return float(focal) if math.isfinite(focal) else float(camera.mean_focal_length())


def focal_at_center(width: int) -> float:
    """Return the focal length of faces with as many pixels a degree as an equirectangular photo of this width."""
    return width / (2.0 * math.pi)


def _turn(azimuth: float, elevation: float) -> Array:
    """Return the rotation (3, 3) to a camera that looks so many degrees to the right and up."""
    a, e = math.radians(azimuth), math.radians(elevation)
    right = np.array([math.cos(a), 0.0, -math.sin(a)])
    forward = np.array([math.sin(a) * math.cos(e), -math.sin(e), math.cos(a) * math.cos(e)])
    return np.stack([right, np.cross(forward, right), forward])
