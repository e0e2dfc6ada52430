"""Undistort photos: resample them and their features from the recovered camera to a pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of a camera that turns its image clockwise."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Hold the cameras of a photo from its recovery to the scene.

    Attributes:
        recovered: of the photo, as in the model.
        resized: the same at the size of the scene's images.
        pinhole: without distortion.
        turns: quarter turns clockwise by which the scene's images are turned then.
    """

    recovered: pycolmap.Camera
    resized: pycolmap.Camera
    pinhole: pycolmap.Camera
    turns: int

    @property
    def turned(self) -> pycolmap.Camera:
        """The pinhole camera of the turned image."""
        fx, fy, cx, cy = self.pinhole.params
        width, height = self.pinhole.width, self.pinhole.height
        for _ in range(self.turns):
            fx, fy, cx, cy, width, height = fy, fx, height - cy, cx, height, width
        return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx, cy])


def lens_of(camera: pycolmap.Camera, photo: tuple[int, int], max_size: int | None, turns: int) -> Lens:
    """Return the lens of a camera.

    Args:
        camera: of the model.
        photo: width and height of its photos, which may be smaller copies.
        max_size: longest side of the images of the scene; None keeps the photos' size.
        turns: as in `Lens`.
    """
    resized = pycolmap.Camera(camera.todict())
    share = min(1.0, (max_size or math.inf) / max(photo))
    size = tuple(max(1, round(side * share)) for side in photo)
    if size != (camera.width, camera.height):
        resized.rescale(*size)
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), resized)
    return Lens(pycolmap.Camera(camera.todict()), resized, pinhole, turns)


def undistort(photo: Tensor, lens: Lens) -> Tensor:
    """Resample a photo (3, h, w) of the resized camera to the pinhole camera and turn it, (3, h', w')."""
    # pycolmap's own warp works in 8 bits and leaves border pixels black.
    straight = torch.nn.functional.grid_sample(photo[None], _grid(lens), "bicubic", "border", align_corners=False)[0]
    return torch.rot90(straight, -lens.turns, (1, 2))


@lru_cache(maxsize=1)  # most scenes have one camera, and a grid takes more memory than its photo
def _grid(lens: Lens) -> Tensor:
    """Return where the pixels of the pinhole camera are in the resized one's image, (1, h', w', 2) in [-1, 1]."""
    width, height = lens.pinhole.width, lens.pinhole.height
    rows, columns = np.mgrid[:height, :width] + 0.5  # pixel centres
    source = _through(lens.pinhole, lens.resized, np.stack([columns.ravel(), rows.ravel()], axis=1))  # (h' w', 2)
    grid = torch.from_numpy(source / (lens.resized.width, lens.resized.height) * 2.0 - 1.0).float()
    return grid.reshape(1, height, width, 2)


def _through(seen_by: pycolmap.Camera, other: pycolmap.Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map pixels (n, 2) of one camera to those of another at the same place, (n, 2)."""
    plane = np.asarray(seen_by.cam_from_img(pixels))  # (n, 2)
    return np.asarray(other.img_from_cam(np.column_stack([plane, np.ones(len(plane))])))


def turn_pose(image: pycolmap.Image, lens: Lens) -> None:
    """Turn the camera of an image with it."""
    turn = pycolmap.Rotation3d(np.linalg.matrix_power(QUARTER_TURN, lens.turns))
    assert image.frame is not None, "the image has a pose"
    image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, np.zeros(3)) * image.cam_from_world())


def move_observations(image: pycolmap.Image, lens: Lens) -> None:
    """Move the features of an image to their positions in the scene's image."""
    if image.num_points2D() == 0:
        return
    moved = _through(lens.recovered, lens.pinhole, np.array([point.xy for point in image.points2D]))
    width, height = lens.pinhole.width, lens.pinhole.height
    for _ in range(lens.turns):
        moved = np.column_stack([height - moved[:, 1], moved[:, 0]])
        width, height = height, width
    for point, xy in zip(image.points2D, moved, strict=True):
        point.xy = xy
