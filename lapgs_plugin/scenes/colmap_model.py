"""Read sparse models of COLMAP as codebases of 3DGS do: cameras, images and points are the truth.

Other files of a model may be outdated, because scripts that edit models do not know them. A warning names them.
"""

from __future__ import annotations

import struct
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError, counted
from lapgs_plugin.files import is_file
from lapgs_plugin.scenes import colmap_binary, colmap_text
from lapgs_plugin.scenes.colmap_frames import frame_poses
from lapgs_plugin.scenes.colmap_records import NO_FEATURES, Points, PosedImage
from lapgs_plugin.scenes.point_cloud import read_point_cloud

MODEL_FILES = ("cameras", "images", "points3D")

SAME = 1e-6
"""Largest difference of equal numbers in two files, as a share of the largest one."""

ADVICE = {
    **dict.fromkeys(
        ("frames.bin", "frames.txt"), "COLMAP uses the frames: remove them and the rigs if they are outdated"
    ),
    "points3D.ply": "codebases of 3DGS use the PLY: remove it if it is outdated",
}
"""Advice about contradicting files that other programs prefer, by their names."""

_Entries = Mapping[Hashable, NDArray[np.float64]]
"""Numbers of a file's cameras or images by id or name, to compare with another file."""


@dataclass(frozen=True, eq=False)
class Model:
    """A sparse model: its cameras and images by id, and its points.

    Attributes:
        folder: of its files.
        cameras: those of the images, and maybe others.
        images: in the order of the file.
        points: without tracks unless they were asked for.
        warnings: a line for each file that contradicts these.
    """

    folder: Path
    cameras: dict[int, pycolmap.Camera]
    images: dict[int, PosedImage]
    points: Points
    warnings: tuple[str, ...] = ()


def read_model(folder: Path, observations: bool = False) -> Model:
    """Read the COLMAP model in a folder, binary or text.

    Args:
        folder: of the files.
        observations: read features and tracks, too.

    Raises:
        SceneError: it is incomplete or unreadable.
    """
    suffix, points = _formats(folder)
    reader = colmap_binary if suffix == "bin" else colmap_text
    cameras = reader.read_cameras(folder / f"cameras.{suffix}")
    images = reader.read_images(folder / f"images.{suffix}", observations)
    for key, image in images.items():
        if image.camera_id not in cameras:
            raise SceneError(
                f"{folder}: image {key} ({image.name}) of images.{suffix} has camera {image.camera_id}, expected one "
                f"of cameras.{suffix}; copy or export the model again"
            )
    model = Model(folder, cameras, images, _read_points(points[0], observations))
    warnings = [model.points.warning] if model.points.warning else []
    return replace(model, warnings=(*warnings, *_contradictions(model, suffix, points)))


def model_of(folder: Path, photos: Sequence[tuple[str, pycolmap.Camera, NDArray[np.float64]]], points: Points) -> Model:
    """Return a model of posed photos, with one camera for all that have the same lens and size.

    Args:
        folder: names the model in messages.
        photos: name, lens, and world to camera (4, 4) of each.
        points: of the model.
    """
    cameras: dict[tuple[object, ...], pycolmap.Camera] = {}
    images: dict[int, PosedImage] = {}
    for number, (name, lens, pose) in enumerate(photos, start=1):
        key = (lens.model, lens.width, lens.height, *lens.params)
        if key not in cameras:
            own = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
            own.camera_id = len(cameras) + 1
            cameras[key] = own
        x, y, z, w = pycolmap.Rotation3d(pose[:3, :3]).quat
        numbers = np.array([w, x, y, z, *pose[:3, 3]])
        images[number] = PosedImage(name, cameras[key].camera_id, numbers, NO_FEATURES)
    return Model(folder, {camera.camera_id: camera for camera in cameras.values()}, images, points)


def count_images(folder: Path) -> int:
    """Return how many images a model has; 0 of other folders, and where the file of images is damaged."""
    with suppress(SceneError, OSError):
        suffix, _ = _formats(folder)
        images = folder / f"images.{suffix}"
        return colmap_binary.count_images(images) if suffix == "bin" else len(colmap_text.read_images(images))
    return 0


def points_files(folder: Path) -> list[Path]:
    """Return the files of a model's points, the one that is read first."""
    return [file for suffix in ("bin", "txt", "ply") if is_file(file := folder / f"points3D.{suffix}")]


def _formats(folder: Path) -> tuple[str, list[Path]]:
    """Return the suffix of a model's cameras and images, and the files of its points, the one to read first.

    Raises:
        SceneError: one is missing.
    """
    points = points_files(folder)
    for suffix in ("bin", "txt"):
        if points and all(is_file(folder / f"{name}.{suffix}") for name in MODEL_FILES[:2]):
            return suffix, points
    present = ", ".join(
        sorted(entry.name for entry in folder.iterdir() if entry.stem in MODEL_FILES and is_file(entry))
    )
    raise SceneError(
        f"{folder}: the sparse model is incomplete, it has only {present}; "
        "expected cameras, images and points3D, all as .bin or all as .txt"
    )


def _read_points(file: Path, observations: bool = False) -> Points:
    if file.suffix == ".ply":
        cloud = read_point_cloud(file, f"{file}")
        return Points(cloud.xyz, 255.0 * cloud.rgb, warning=cloud.warning)
    if file.suffix == ".bin":
        return colmap_binary.read_points(file, observations)
    return colmap_text.read_points(file, observations)


def _contradictions(model: Model, suffix: str, points: list[Path]) -> Iterator[str]:
    """Yield a line for each other file of a model that contradicts it."""
    folder = model.folder
    others = [(folder / f"frames.{suffix}", f"images.{suffix}"), *((file, points[0].name) for file in points[1:])]
    if suffix == "bin":  # text was exported to be read, or to be edited
        others += [(folder / f"{name}.txt", f"{name}.bin") for name in MODEL_FILES[:2]]
    for file, used in others:
        if not is_file(file):
            continue
        try:
            difference = _difference(model, file, suffix)
        except (SceneError, ValueError, LookupError, ArithmeticError, OSError, struct.error):
            difference = "damaged"
        if difference:
            advice = ADVICE.get(file.name, "remove this one if it is outdated")
            yield f"{file}: {difference}; {used} is used, {advice}"


def _difference(model: Model, file: Path, suffix: str) -> str:
    """Describe how a file differs from a model; "" if it does not."""
    if file.stem == "points3D":
        count, own = len(_read_points(file).xyz), len(model.points.xyz)
        return "" if count == own else f"{counted(count, 'point')} in place of {own}"
    if file.stem == "cameras":
        return _differing(_lenses(model.cameras), _lenses(colmap_text.read_cameras(file)))
    if file.stem == "images":
        return _differing(_poses(model.images), _poses(colmap_text.read_images(file)))
    poses, images = frame_poses(model.folder, suffix), model.images
    return _differing(
        _poses(images), {images[key].name if key in images else str(key): pose.matrix() for key, pose in poses.items()}
    )


def _differing(own: _Entries, others: _Entries) -> str:
    total = max(len(own), len(others))
    same = sum(_same(entry, others.get(name)) for name, entry in own.items())
    return f"{total - same} of {total} entries differ" if same < total else ""


def _same(one: NDArray[np.float64], other: NDArray[np.float64] | None) -> bool:
    if other is None or one.shape != other.shape:
        return False
    with np.errstate(invalid="ignore"):  # inf - inf
        return bool(np.abs(one - other).max() <= SAME * np.abs(one).max())


def _poses(images: Mapping[int, PosedImage]) -> _Entries:
    return {image.name: image.pose.matrix() for image in images.values() if image.has_rotation}


def _lenses(cameras: Mapping[int, pycolmap.Camera]) -> _Entries:
    return {
        key: np.array([camera.model.value, camera.width, camera.height, *camera.params], np.float64)
        for key, camera in cameras.items()
    }
