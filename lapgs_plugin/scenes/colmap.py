"""Read COLMAP scenes: `images/` and a sparse model in `sparse/0/` or `sparse/`, binary or text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from shlex import quote

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.colmap_model import MODEL_FILES, Model, count_images, points_files, read_model
from lapgs_plugin.scenes.colmap_records import PosedImage
from lapgs_plugin.scenes.images import find_image, where_else
from lapgs_plugin.scenes.lenses import lens_of
from lapgs_plugin.scenes.point_cloud import read_point_cloud
from lapgs_plugin.scenes.random_points import random_points
from lapgs_plugin.scenes.source import (
    ALL_AROUND,
    PINHOLE_MODELS,
    Frame,
    SceneSource,
    check_camera,
    hold_out,
    in_name_order,
    undistort_hint,
)

MODEL_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "distorted/sparse/0")
"""Where COLMAP, nerfstudio and the 3DGS repository's convert.py leave models of photos that are not undistorted."""

SHORT_TRACK = 3
"""Photos that see a point, of which some codebases of 3DGS leave out points with fewer."""


def find_model(path: Path, folders: Sequence[str] = MODEL_PLACES[:2]) -> Path | None:
    """Return the first of these folders in `path` that holds a file of a COLMAP model; None without one."""
    for folder in map(path.joinpath, folders):
        if any(is_file(folder / f"{name}.{suffix}") for name in MODEL_FILES for suffix in ("bin", "txt")):
            return folder
    return None


def largest_model(path: Path, model: Path) -> Path:
    """Return the model with most photos: `model`, or one of the numbered models in the scene `path`.

    COLMAP's mapper writes a model for each connected group of photos, not numbered by size.
    """
    numbered = [folder for name in MODEL_PLACES for folder in sorted((path / name).parent.glob("[0-9]*"))]
    others = [folder for folder in numbered if folder != model]
    return max([model, *others], key=count_images) if others else model


def read_colmap(path: Path, model: Path, images: str, evaluate: bool, distorted: bool = False) -> SceneSource:
    """Read the frames and points of a COLMAP scene.

    Args:
        path: the scene folder.
        model: folder of the sparse model, from `find_model`.
        images: name of the image folder in the scene: "images", or smaller copies such as "images_4".
        evaluate: hold out every eighth image.
        distorted: give cameras their lenses, instead of refusing distorted ones.

    Raises:
        SceneError: the model is incomplete, unreadable, empty or distorted, or the image folder is missing.
    """
    sparse = read_model(model)
    if not distorted:
        refuse_distorted(sparse, path)
    folder = path / images
    named = with_bare_names(sparse, folder)
    source = source_of(named, folder)
    source = with_lenses(source, named, path) if distorted else source
    if not is_folder(folder):
        first = next((frame.name for frame in source.train), "")
        raise SceneError(f"{folder}: no such folder of images; {where_else(path, first)}")
    train, test = hold_out(source.train, evaluate)
    return replace(source, train=train, test=test, warnings=source.warnings + larger_model(path, model))


def with_lenses(source: SceneSource, model: Model, path: Path) -> SceneSource:
    """Return the training frames of a model with their lenses.

    Raises:
        SceneError: one cannot be trained on as it is; the advice is about the scene folder `path`.
    """
    lenses = {
        camera.camera_id: lens_of(camera.model.name, _extra(camera), f"{model.folder}: camera {camera.camera_id}", path)
        for camera in _used_cameras(model)
    }
    by_name = {image.name: lenses[image.camera_id] for image in model.images.values()}
    frames = [replace(frame, camera=replace(frame.camera, lens=by_name[frame.name])) for frame in source.train]
    return replace(source, train=tuple(frames))


def refuse_distorted(model: Model, path: Path) -> None:
    """Raise a SceneError if an image of a model is distorted, with advice about the scene folder `path`."""
    for camera in _used_cameras(model):
        if distortion := _distortion(camera):
            hint = undistort_hint(path, camera.model.name)
            raise SceneError(f"{model.folder}: camera {camera.camera_id} is distorted ({distortion}); {hint}")


def larger_model(path: Path, model: Path) -> tuple[str, ...]:
    """Return a warning if another model in a scene folder has more photos than the one that is read."""
    if (larger := largest_model(path, model)) == model:
        return ()
    return (
        f"{model} places {count_images(model)} photos and {larger} {count_images(larger)}; make a scene of the latter "
        f"with `lapgs prepare {quote(str(path))} OUT --model {quote(str(larger))}`",
    )


def with_bare_names(model: Model, folder: Path) -> Model:
    """Return a model that names images without folders where no other name is that of a file in `folder`.

    Programs write the folder of the machine that they ran on, or that of the photos. Codebases of 3DGS ignore it.
    """
    images, names = dict(model.images), {image.name for image in model.images.values()}
    for key, image in model.images.items():
        written = PurePosixPath(image.name)
        inside = not written.is_absolute() and ".." not in written.parts
        if written.name in names or (inside and is_file(find_image(folder / written))):
            continue
        if is_file(find_image(folder / written.name)):
            images[key] = replace(image, name=written.name)
    return replace(model, images=images)


def source_of(model: Model, folder: Path) -> SceneSource:
    """Return frames and points of a model, with pinhole cameras even where the model's are distorted.

    A model without points gets random ones.

    Args:
        model: its cameras are perspective, fisheye or equirectangular.
        folder: of the images, of which some may be missing.

    Raises:
        SceneError: a pose or a camera cannot be used.
    """
    cameras = {key: _intrinsics(model.cameras[key]) for key in {image.camera_id for image in model.images.values()}}
    frames = [_frame(model.folder, folder, cameras[image.camera_id], image) for image in model.images.values()]
    points, colors, warnings = model.points.xyz, model.points.rgb / 255.0, model.warnings
    if not len(points) and frames:  # known cameras, of a phone or a renderer
        file = next(iter(points_files(model.folder)), model.folder)
        warnings += (f"{file}: the model has no 3D points; training starts from random ones",)
        points, colors = random_points(frames)
    return SceneSource("colmap", in_name_order(frames), (), points, colors, warnings)


def why_no_points(path: Path) -> str:
    """Return the reason why a codebase of 3DGS finds no points in a scene folder, with advice, in one line."""
    model, train = find_model(path), f"`lapgs train {quote(str(path))}`"
    try:
        in_model, photos = (0, 0) if model is None else _points_of_model(model)
    except SceneError as error:
        return str(error)
    folder = model or path
    ply, in_ply = folder / f"points3{'D' if model else 'd'}.ply", 0
    with suppress(SceneError):
        in_ply = len(read_point_cloud(ply, "").xyz)
    file = ply if is_file(ply) else next(iter(points_files(folder)), folder)
    problem = f"{file}: " + (f"its {in_ply} points are not readable for this codebase" if in_ply else "no points in it")
    if in_ply and not in_model:
        return f"{problem}, expected x, y, z, nx, ny, nz, red, green and blue of each point; export it again"
    if not in_model:
        expected = "expected some to start from; triangulate points with COLMAP and write the file again"
        return f"{problem}, {expected}, or train with {train}, which makes random ones"
    if file != ply:
        problem = f"{file}: this codebase takes none of its points"
    if photos < SHORT_TRACK:
        return (
            f"{problem}, expected the {in_model} of the model; none of these has {SHORT_TRACK} photos in its track, "
            f"and some codebases leave such points out: triangulate them again with COLMAP and remove {ply.name}, or "
            f"train with {train}, which needs no tracks"
        )
    again = f"remove {ply.name}, so that this codebase writes it again, or " if file == ply else ""
    return f"{problem}, expected the {in_model} of the model; {again}train with {train}"


def _points_of_model(folder: Path) -> tuple[int, int]:
    """Return how many points a COLMAP model has beside its PLY, and the most photos that see one of them.

    Raises:
        SceneError: the model is incomplete or unreadable.
    """
    points = read_model(folder, observations=True).points
    own = points_files(folder)[0].suffix != ".ply"
    return (len(points.xyz), max(map(len, points.tracks), default=0)) if own else (0, 0)


def is_straight(model: Model) -> bool:
    """Return whether no image of a model is distorted."""
    return not any(map(_distortion, _used_cameras(model)))


def _used_cameras(model: Model) -> list[pycolmap.Camera]:
    return [model.cameras[key] for key in sorted({image.camera_id for image in model.images.values()})]


def _extra(camera: pycolmap.Camera) -> list[float]:
    """Return the parameters besides focal lengths and principal point."""
    return [float(camera.params[index]) for index in camera.extra_params_idxs()]


def _distortion(camera: pycolmap.Camera) -> str:
    """Return the model of a distorted camera and its parameters, or ""."""
    kind = camera.model.name
    distortion = _extra(camera)
    if kind in PINHOLE_MODELS and not any(distortion):
        return ""
    return kind + (f" with parameters {', '.join(f'{value:g}' for value in distortion)}" if distortion else "")


def _intrinsics(camera: pycolmap.Camera) -> Camera:
    """Return the camera without distortion and pose; of one that sees all around that of its faces."""
    if camera.model.name == ALL_AROUND:
        focal, (width, height) = camera.width / (2.0 * math.pi), (camera.width, camera.height)
        return Camera(width, height, focal, focal, width / 2.0, height / 2.0, torch.eye(4, dtype=torch.float64))
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


def _frame(model: Path, folder: Path, camera: Camera, image: PosedImage) -> Frame:
    if not image.has_rotation:
        numbers = ", ".join(f"{number:g}" for number in image.numbers[:4])
        raise SceneError(
            f"{model}: the rotation of {image.name} is the quaternion ({numbers}), expected one of length 1; copy or "
            "export the model again"
        )
    pose: NDArray[np.float64] = np.eye(4)
    pose[:3] = image.pose.matrix()  # (3, 4)
    posed = replace(camera, world_to_camera=torch.from_numpy(pose))
    check_camera(f"{model}: the camera of {image.name}", posed)
    return Frame(image.name, find_image(folder / image.name), posed)
