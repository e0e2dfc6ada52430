"""Undistort photos: resample them and their features from the recovered camera to pinhole cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.scenes.prepare.faces import (
    DOWN,
    Face,
    focal_at_center,
    focal_towards,
    panorama_faces,
    sees,
    wide_faces,
)
from lapgs_plugin.scenes.prepare.photos import target_name
from lapgs_plugin.scenes.source import ALL_AROUND

AROUND_PIXELS = 2
"""Pixels of the bicubic filter beyond the borders of a panorama, which go on at the other side."""
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
        face: the part of the photo that the pinhole image shows; None is all of it.
        tripod: radius in degrees, from straight down, of what a face ignores.
    """

    recovered: pycolmap.Camera
    resized: pycolmap.Camera
    pinhole: pycolmap.Camera
    turns: int
    face: Face | None = None
    tripod: float = 0.0

    @property
    def turned(self) -> pycolmap.Camera:
        """The pinhole camera of the turned image."""
        fx, fy, cx, cy = self.pinhole.params
        width, height = self.pinhole.width, self.pinhole.height
        for _ in range(self.turns):
            fx, fy, cx, cy, width, height = fy, fx, height - cy, cx, height, width
        return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx, cy])

    def name_of(self, photo: str) -> str:
        """Return the name of the scene's image of a photo of this name."""
        return target_name(photo) if self.face is None else self.face.name_of(target_name(photo))


def lenses_of(
    camera: pycolmap.Camera, photo: tuple[int, int], max_size: int | None, turns: int, tripod: float
) -> tuple[Lens, ...]:
    """Return the lens of a camera, or those of its faces if it sees all around or a wide part of it.

    Args:
        camera: of the model.
        photo: width and height of its photos, which may be smaller copies.
        max_size: longest side of the images of the scene; None keeps the photos' size, and no detail of panoramas is
            lost in the middle of their faces.
        turns, tripod: as in `Lens`; panoramas are not turned.
    """
    recovered = pycolmap.Camera(camera.todict())
    if camera.model.name == ALL_AROUND:
        faces = panorama_faces(tripod)
        pinholes = [face.camera(focal_at_center(photo[0])) for face in faces]
        longest = max(max(pinhole.width, pinhole.height) for pinhole in pinholes)
        resized = _resized(camera, photo, min(1.0, (max_size or math.inf) / longest))
        pinholes = [face.camera(focal_at_center(resized.width)) for face in faces]
        return tuple(Lens(recovered, resized, pin, 0, face, tripod) for face, pin in zip(faces, pinholes, strict=True))
    share = min(1.0, (max_size or math.inf) / max(photo))
    resized = _resized(camera, photo, share)
    if wide := wide_faces(resized):
        return tuple(Lens(recovered, resized, face.camera(focal_towards(resized, face)), 0, face) for face in wide)
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), resized)
    if max_size is not None and (longest := max(pinhole.width, pinhole.height)) > max_size:  # straightened barrels are
        resized = _resized(camera, photo, share * max_size / longest)
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(max_image_size=max_size), resized)
    return (Lens(recovered, resized, pinhole, turns),)


def _resized(camera: pycolmap.Camera, photo: tuple[int, int], share: float) -> pycolmap.Camera:
    """Return the camera at a share of the size of its photos."""
    resized = pycolmap.Camera(camera.todict())
    size = tuple(max(1, round(side * share)) for side in photo)
    if size != (camera.width, camera.height):
        resized.rescale(*size)
    return resized


def undistort(photo: Tensor, lens: Lens) -> Tensor:
    """Resample a photo (3, h, w) of the resized camera to the pinhole camera and turn it, (3, h', w')."""
    # pycolmap's own warp works in 8 bits and leaves border pixels black.
    straight = torch.nn.functional.grid_sample(
        _with_surroundings(photo, lens)[None], _grid(lens), "bicubic", "border", align_corners=False
    )[0]
    return torch.rot90(straight, -lens.turns, (1, 2))


@lru_cache(maxsize=64)
def inside(lens: Lens) -> Tensor:
    """Return where a face shows what the photo does, and not the tripod, (1, h', w') bool."""
    rays = _rays(lens)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if lens.resized.model.name == ALL_AROUND:
        used = np.degrees(np.arccos(np.clip(rays @ DOWN, -1.0, 1.0))) >= lens.tripod
    else:
        used = sees(lens.resized, rays)
    return torch.from_numpy(used).reshape(1, lens.pinhole.height, lens.pinhole.width)


def _with_surroundings(photo: Tensor, lens: Lens) -> Tensor:
    """Return a panorama with some pixels beyond each border: those of the other side, and those beyond the poles."""
    if lens.resized.model.name != ALL_AROUND:
        return photo
    beyond = torch.roll(photo.flip(1), photo.shape[2] // 2, 2)
    high = torch.cat([beyond[:, -AROUND_PIXELS:], photo, beyond[:, :AROUND_PIXELS]], 1)
    return torch.cat([high[:, :, -AROUND_PIXELS:], high, high[:, :, :AROUND_PIXELS]], 2)


def _grid(lens: Lens) -> Tensor:
    """Return where the pixels of the pinhole camera are in the resized one's image, (1, h', w', 2) in [-1, 1].

    Most scenes have one camera, and a grid takes more memory than its photo. So one grid is kept, or all of a panorama.
    """
    return _new_grid(lens) if lens.face is None else _new_face_grid(lens)


def _make_grid(lens: Lens) -> Tensor:
    around = AROUND_PIXELS if lens.resized.model.name == ALL_AROUND else 0
    source = np.asarray(lens.resized.img_from_cam(_rays(lens))) + around  # (h' w', 2), NaN behind a lens
    size = (lens.resized.width + 2 * around, lens.resized.height + 2 * around)
    grid = torch.from_numpy(source / size * 2.0 - 1.0).float().nan_to_num(2.0).clamp(-2.0, 2.0)
    return grid.reshape(1, lens.pinhole.height, lens.pinhole.width, 2)


_new_grid = lru_cache(maxsize=1)(_make_grid)
_new_face_grid = lru_cache(maxsize=len(panorama_faces(0.0)))(_make_grid)


def _rays(lens: Lens) -> NDArray[np.float64]:
    """Return the directions of the pinhole image's pixels in the photo's axes, (h' w', 3)."""
    rows, columns = np.mgrid[: lens.pinhole.height, : lens.pinhole.width] + 0.5  # pixel centres
    plane = np.asarray(lens.pinhole.cam_from_img(np.stack([columns.ravel(), rows.ravel()], axis=1)))  # (h' w', 2)
    rays: NDArray[np.float64] = np.column_stack([plane, np.ones(len(plane))])
    return rays if lens.face is None else rays @ lens.face.turn


def turn_pose(image: pycolmap.Image, lens: Lens) -> None:
    """Turn the camera of an image with it."""
    turn = pycolmap.Rotation3d(np.linalg.matrix_power(QUARTER_TURN, lens.turns))
    assert image.frame is not None, "the image has a pose"
    image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, np.zeros(3)) * image.cam_from_world())


def move_observations(image: pycolmap.Image, lens: Lens) -> None:
    """Move the features of an image to their positions in the scene's image."""
    if image.num_points2D() == 0:
        return
    plane = np.asarray(lens.recovered.cam_from_img(np.array([point.xy for point in image.points2D])))  # (n, 2)
    moved = np.asarray(lens.pinhole.img_from_cam(np.column_stack([plane, np.ones(len(plane))])))
    width, height = lens.pinhole.width, lens.pinhole.height
    for _ in range(lens.turns):
        moved = np.column_stack([height - moved[:, 1], moved[:, 0]])
        width, height = height, width
    for point, xy in zip(image.points2D, moved, strict=True):
        point.xy = xy


def cut_into_faces(model: pycolmap.Reconstruction, photos: Sequence[tuple[pycolmap.Image, Sequence[Lens]]]) -> None:
    """Replace photos of a model by their faces, which keep the features that they show.

    Args:
        model: changed.
        photos: images of the model, each with the lenses of its faces.
    """
    cameras: dict[tuple[float, ...], int] = {}
    for image, lenses in photos:
        for lens in lenses:
            key = (image.camera_id, lens.pinhole.width, lens.pinhole.height, *lens.pinhole.params)
            if key not in cameras:
                cameras[key] = max(model.cameras) + 1
                pinhole = pycolmap.Camera(lens.pinhole.todict())
                pinhole.camera_id = cameras[key]
                model.add_camera_with_trivial_rig(pinhole)
            _add_face(model, image, lens, cameras[key])
    for image, _ in photos:  # the tracks that go have elements in faces now, and points stay
        model.deregister_frame(image.frame_id)
    model.tear_down()


def _add_face(model: pycolmap.Reconstruction, image: pycolmap.Image, lens: Lens, camera: int) -> None:
    assert lens.face is not None
    pixels, shown = _on_face(image, lens)
    number = max(model.images) + 1
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(lens.face.turn), np.zeros(3))
    face = pycolmap.Image(lens.name_of(image.name), keypoints=pixels, camera_id=camera, image_id=number)
    model.add_image_with_trivial_frame(face, turn * image.cam_from_world())
    for index, feature in enumerate(shown.tolist()):
        if (point := image.points2D[feature]).has_point3D():
            model.add_observation(point.point3D_id, pycolmap.TrackElement(number, index))


def _on_face(image: pycolmap.Image, lens: Lens) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the positions (m, 2) of a photo's features on a face that shows m of them, and which these are, (m,)."""
    assert lens.face is not None
    pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
    rays = np.asarray(lens.recovered.cam_ray_from_img(pixels)).reshape(-1, 3) @ lens.face.turn.T
    front = np.flatnonzero(rays[:, 2] > 0)
    moved = np.asarray(lens.pinhole.img_from_cam(rays[front])).reshape(-1, 2)
    shown = ((moved >= 0) & (moved <= (lens.pinhole.width, lens.pinhole.height))).all(axis=1)
    return moved[shown], front[shown]
