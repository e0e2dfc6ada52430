"""Read COLMAP scenes: `images/` and a sparse model in `sparse/0/` or `sparse/`, binary or text.

The formats are described at https://colmap.github.io/format.html; pycolmap reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError, joined
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.colmap_binary import check_whole, disagreement
from lapgs_plugin.scenes.colmap_text import check_text
from lapgs_plugin.scenes.images import find_image, where_else
from lapgs_plugin.scenes.random_points import random_points
from lapgs_plugin.scenes.source import (
    PINHOLE_MODELS,
    Frame,
    SceneSource,
    check_camera,
    hold_out,
    in_name_order,
    undistort_hint,
)

MODEL_FILES = ("cameras", "images", "points3D")

MODEL_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "distorted/sparse/0")
"""Where COLMAP, nerfstudio and the 3DGS repository's convert.py leave models of photos that are not undistorted."""

UNIT_TOLERANCE = 1e-2
"""Largest difference of a quaternion's length from 1; COLMAP writes 17 digits."""


def find_model(path: Path, places: Sequence[str] = MODEL_PLACES[:2]) -> Path | None:
    """Return the first of these places in `path` that holds files of a COLMAP model; None if there is none."""
    for folder in (path / place for place in places):
        if any(is_file(folder / f"{name}.{suffix}") for name in MODEL_FILES for suffix in ("bin", "txt")):
            return folder
    return None


def largest_model(path: Path, model: Path) -> Path:
    """Return `model`, or the one of the numbered models in the scene `path` that has most photos, if it has more.

    COLMAP's mapper numbers a model for each group of photos that nothing connects as it finds them, not by size.
    """
    beside = [each for place in MODEL_PLACES for each in sorted((path / place).parent.glob("[0-9]*"))]
    return max([model, *beside], key=count_images)


def count_images(model: Path) -> int:
    """Return how many images a binary model has; 0 of other folders."""
    if not all(is_file(model / f"{name}.bin") for name in MODEL_FILES):
        return 0
    with (model / "images.bin").open("rb") as stream:
        return int.from_bytes(stream.read(8), "little")


def read_colmap(path: Path, model: Path, images: str, evaluate: bool) -> SceneSource:
    """Read the frames and points of a COLMAP scene.

    Args:
        path: the scene folder.
        model: folder of the sparse model, from `find_model`.
        images: name of the image folder in the scene: "images", or smaller copies such as "images_4".
        evaluate: hold out every eighth image.

    Raises:
        SceneError: the model is incomplete, unreadable, empty or distorted, or the image folder is missing.
    """
    reconstruction = read_model(model)
    for key in sorted({image.camera_id for image in reconstruction.images.values() if image.has_pose}):
        _refuse_distortion(reconstruction.cameras[key], model, path)
    folder = path / images
    source = source_of(reconstruction, model, folder)
    if not is_folder(folder):
        first = next((frame.name for frame in source.train), "")
        raise SceneError(f"{folder}: no such folder of images; {where_else(path, first)}")
    train, test = hold_out(source.train, evaluate)
    warnings = source.warnings
    if (larger := largest_model(path, model)) != model:
        warnings += (
            f"{model} places {count_images(model)} photos and {larger} {count_images(larger)}; make a scene of the "
            f"latter with `lapgs prepare {quote(str(path))} OUT`",
        )
    return replace(source, train=train, test=test, warnings=warnings)


def source_of(reconstruction: pycolmap.Reconstruction, model: Path, folder: Path) -> SceneSource:
    """Return frames and points of a model, with pinhole cameras even where the model's are distorted.

    A model without points gets random ones.

    Args:
        reconstruction: the model, whose cameras are perspective or fisheye.
        model: its folder.
        folder: of the images, of which some may be missing.

    Raises:
        SceneError: a name, a pose or a camera cannot be used.
    """
    posed = [image for image in reconstruction.images.values() if image.has_pose]
    cameras = {key: _intrinsics(reconstruction.cameras[key]) for key in {image.camera_id for image in posed}}
    frames = [_frame(model, folder, cameras[image.camera_id], image) for image in posed]
    points = np.array([point.xyz for point in reconstruction.points3D.values()], np.float64)
    colors = np.array([point.color for point in reconstruction.points3D.values()], np.float64) / 255.0
    warnings: tuple[str, ...] = ()
    if not len(points) and frames:  # known cameras, of a phone or a renderer
        warnings = (f"{model}: the model has no 3D points; training starts from random ones",)
        points, colors = random_points(frames)
    return SceneSource("colmap", in_name_order(frames), (), points, colors, warnings)


def read_model(model: Path) -> pycolmap.Reconstruction:
    """Read the COLMAP model in a folder, binary or text.

    Raises:
        SceneError: it is incomplete or unreadable.
    """
    suffix = next(
        (s for s in ("bin", "txt") if all(is_file(model / f"{name}.{s}") for name in MODEL_FILES)),
        None,
    )
    if suffix is None:
        found = ", ".join(sorted(entry.name for entry in model.iterdir() if entry.stem in MODEL_FILES))
        raise SceneError(
            f"{model}: the sparse model is incomplete, it has only {found}; "
            "expected cameras, images and points3D, all as .bin or all as .txt"
        )
    names: dict[int, str] = {}
    if suffix == "bin":
        check_whole(model)
    else:
        names = check_text(model)
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except Exception as error:  # pycolmap raises ValueError, IndexError, RuntimeError or MemoryError on broken files
        reason = (disagreement(model) if suffix == "bin" else None) or f"its files do not agree: {joined(error)}"
        raise SceneError(f"{model}: the sparse model cannot be read ({reason}); copy or export it again") from error
    for key, name in names.items():
        reconstruction.images[key].name = name
    return reconstruction


def _refuse_distortion(camera: pycolmap.Camera, model: Path, scene: Path) -> None:
    kind = camera.model.name
    distortion = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    if kind not in PINHOLE_MODELS or any(distortion):
        values = f" with parameters {', '.join(f'{value:g}' for value in distortion)}" if distortion else ""
        hint = undistort_hint(scene, kind)
        raise SceneError(f"{model}: camera {camera.camera_id} is distorted ({kind}{values}); {hint}")


def _intrinsics(camera: pycolmap.Camera) -> Camera:
    """Return the camera without distortion and pose."""
    matrix = camera.calibration_matrix()  # (3, 3)
    return Camera(
        width=camera.width,
        height=camera.height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        world_to_camera=torch.eye(4, dtype=torch.float64),
    )


def _frame(model: Path, folder: Path, camera: Camera, image: pycolmap.Image) -> Frame:
    try:
        name = image.name
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{model}: the name of image {image.image_id} is {error.object!r}, expected UTF-8; rename it and "
            "reconstruct again"
        ) from error
    pose: NDArray[np.float64] = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()  # (3, 4)
    posed = replace(camera, world_to_camera=torch.from_numpy(pose))
    check_camera(f"{model}: the camera of {name}", posed)
    quaternion = image.cam_from_world().rotation.quat  # (4,) x, y, z, w
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > UNIT_TOLERANCE:
        numbers = ", ".join(f"{number:g}" for number in quaternion)
        raise SceneError(
            f"{model}: the rotation of {name} is the quaternion ({numbers}), expected one of length 1; copy or export "
            "the model again"
        )
    return Frame(name, find_image(folder / name), posed)
