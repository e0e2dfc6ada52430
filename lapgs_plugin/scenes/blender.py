"""Read scenes of transforms files: NeRF's Blender scenes, instant-ngp and nerfstudio.

Poses are camera-to-world matrices in OpenGL axes (x right, y up, z backwards). Two layouts exist: the pair
`transforms_train.json` and `transforms_test.json` with one horizontal field of view and PNGs named without extension
(https://github.com/bmild/nerf), and a single `transforms.json` with intrinsics in pixels for the whole file or for each
frame (https://docs.nerf.studio/quickstart/data_conventions.html).
"""

from __future__ import annotations

import math
import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.ply import read_ply, scalar_names
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.images import find_image, image_size
from lapgs_plugin.scenes.random_points import CAPTURE_RADIUS, OBJECT_RADIUS, random_points
from lapgs_plugin.scenes.source import (
    LARGEST,
    PINHOLE_MODELS,
    Frame,
    SceneSource,
    check_camera,
    hold_out,
    in_name_order,
    undistort_hint,
)
from lapgs_plugin.untrusted import read_json

SINGLE_FILE = "transforms.json"
TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""Files of views to hold out: the first that is there."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
SHORTEST_FOCAL = 1e-3
"""Shortest focal length in sides of the image."""
LAST_ROW_ERROR = 1e-4
"""Largest error of the last row of a 4x4 pose."""
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
POINT_COLORS = ("red", "green", "blue")
POINT_FILES = ("points3d.ply", "points3D.ply")

Values = dict[str, Any]
Lenses = dict[Path, tuple[str, Values]]
"""Camera model and distortion, as a transforms file names them and without zeros, by image."""


def has_transforms(path: Path) -> bool:
    """Return whether the folder holds a transforms layout."""
    return is_file(path / TRAIN_FILE) or is_file(path / SINGLE_FILE)


def read_transforms(path: Path, images: str, evaluate: bool, lenses: Lenses | None = None) -> SceneSource:
    """Read the frames and points of a transforms layout.

    With `evaluate`, a pair of files holds out the views of `transforms_test.json`, else `transforms_val.json`, and a
    single file those of its lists `test_filenames` and `val_filenames`, or every eighth view.
    Without it, both files of a pair are trained on, as in 3DGS. If there is no PLY of points (`ply_file_path` or
    points3d.ply), 100,000 random grey points fill a cube around the point that the cameras look at.

    Args:
        path: the scene folder.
        images: folder of the images, replacing the one in `file_path`; "images" keeps it.
        evaluate: hold out views.
        lenses: receives those of the frames, whose cameras may be distorted then.

    Raises:
        SceneError: a file is unreadable or lacks something, a camera is distorted, or a pose is not rigid.
    """
    if is_file(path / TRAIN_FILE):
        file, values = TRAIN_FILE, _read_json(path / TRAIN_FILE)
        train, test = _read_pair(path, values, images, evaluate, lenses)
        radius = OBJECT_RADIUS
    else:
        file, values = SINGLE_FILE, _read_json(path / SINGLE_FILE)
        frames = _read_frames(path, SINGLE_FILE, values, images, lenses)
        train, test = hold_out(frames, evaluate, _chosen_for_tests(frames, values))
        radius = CAPTURE_RADIUS
    given = _read_points(path, file, values)
    warnings: tuple[str, ...] = ()
    if given is None and (named := values.get("ply_file_path")):  # nerfstudio, too, takes random points then
        warnings = (f"{path / file} names {named}: no such file; training starts from random points",)
    points, colors = given or random_points([*train, *test], radius)
    return SceneSource("transforms", train, test, points, colors, warnings)


def _read_pair(
    path: Path, train_values: Values, images: str, evaluate: bool, lenses: Lenses | None
) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    train = _read_frames(path, TRAIN_FILE, train_values, images, lenses)
    test: list[Frame] = []
    if (file := next((name for name in TEST_FILES if is_file(path / name)), None)) is not None:
        test = _read_frames(path, file, _read_json(path / file), images, lenses)
    elif evaluate:
        raise SceneError(f"{path / TEST_FILES[0]}: no such file, expected the views to hold out; train without --eval")
    return (in_name_order(train), in_name_order(test)) if evaluate else (in_name_order([*train, *test]), ())


def _chosen_for_tests(frames: list[Frame], values: Values) -> set[str]:
    """Return the names of the frames that nerfstudio's lists of file names keep from training."""
    lists = (values.get(f"{part}_filenames") for part in ("test", "val"))
    chosen = {PurePosixPath(name) for each in lists if isinstance(each, list) for name in each if isinstance(name, str)}
    pairs = zip(frames, values["frames"], strict=True)
    return {frame.name for frame, each in pairs if PurePosixPath(each["file_path"]) in chosen}


def mask_folder(path: Path) -> str | None:
    """Return the folder of the masks that a transforms file names by `mask_path`, relative to the scene, or None.

    Raises:
        SceneError: the file is unreadable, or the masks are not in a folder of their own.
    """
    file = next((path / name for name in (TRAIN_FILE, SINGLE_FILE) if is_file(path / name)), None)
    frames = [] if file is None else [frame for frame in _read_json(file)["frames"] if isinstance(frame, dict)]
    masks, photos = (
        {PurePosixPath(frame[key].replace("\\", "/")).parent for frame in frames if isinstance(frame.get(key), str)}
        for key in ("mask_path", "file_path")
    )
    if not masks:
        return None
    folder = min(masks)
    if len(masks) > 1 or folder in photos or not is_folder(path / folder):
        raise SceneError(
            f"{file}: its masks (mask_path) are named in {folder}, expected one folder of masks alone; give it with "
            "--masks FOLDER, or use no masks (--masks none)"
        )
    return folder.as_posix()


def _read_json(file: Path) -> Values:
    values = read_json(file, error=SceneError, advice="export the scene again", finite=False)
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list) or not values["frames"]:
        raise SceneError(f"{file}: no list of frames in it, expected the transforms of NeRF, instant-ngp or nerfstudio")
    return values


def _read_frames(path: Path, file: str, values: Values, images: str, lenses: Lenses | None) -> list[Frame]:
    frames = []
    for index, frame in enumerate(values["frames"]):
        where = f"{path / file}: frame {index}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise SceneError(f"{where} has no file_path, expected the name of its image")
        image = _image_path(path, frame["file_path"], images)
        where = f"{where} ({frame['file_path']})"
        if image.name in ("", "..") or image == Path(os.path.normpath(path)):
            raise SceneError(f"{where} names a folder, expected the name of its image; export the scene again")
        inside = os.path.normpath(path)
        if image.is_relative_to(inside):
            name = image.relative_to(inside).as_posix()
        elif is_file(image):
            name = image.name
        else:
            raise SceneError(
                f"{where} names {image}: no such image; put it there or choose another folder with --images"
            )
        posed = {**values, **frame}
        lens = _lens(posed)
        if lenses is not None:
            lenses[image] = lens
        elif lens[0] not in PINHOLE_MODELS or lens[1]:
            terms = "".join(f", {key} = {value}" for key, value in lens[1].items())
            raise SceneError(f"{where} has a distorted camera ({lens[0]}{terms}); {undistort_hint(path, lens[0])}")
        if not ("w" in posed and "h" in posed):
            posed["w"], posed["h"] = image_size(image)
        camera = read_camera(posed, where)
        check_camera(f"{path / file}: the camera of {name}", camera)
        frames.append(Frame(name, image, camera))
    return frames


def _lens(values: Values) -> tuple[str, Values]:
    """Return the camera model of a frame and its distortion, without zeros."""
    distortion = {key: values[key] for key in DISTORTION_KEYS if values.get(key)}
    if np.any(values.get("distortion_params") or 0.0):
        distortion["distortion_params"] = values["distortion_params"]
    return "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get("camera_model") or "OPENCV", distortion


def _image_path(path: Path, file_path: str, images: str) -> Path:
    # instant-ngp writes backslashes on Windows, and ".." where its photos lie beside the scene.
    image = Path(os.path.normpath(path / file_path.replace("\\", "/")))
    if images != "images":
        image = path / images / image.name
    if not image.name:
        return image
    candidates = [find_image(image.with_name(image.name + suffix)) for suffix in ("", *IMAGE_SUFFIXES)]
    return next((candidate for candidate in candidates if is_file(candidate)), image)


def _world_to_camera(matrix: Any, where: str) -> NDArray[np.float64]:
    """Return world-to-camera (4, 4) in OpenCV axes from camera-to-world in OpenGL axes, 4x4 or 3x4."""
    try:
        camera_to_world = np.array(matrix, np.float64)
    except (TypeError, ValueError, ArithmeticError):
        camera_to_world = np.empty(0)
    if camera_to_world.shape not in ((4, 4), (3, 4)) or not np.isfinite(camera_to_world).all():
        raise SceneError(f"{where} has no transform_matrix of 4x4 finite numbers; export it again")
    if (largest := float(np.abs(camera_to_world).max())) > LARGEST:
        raise SceneError(
            f"{where} has {largest:g} in its transform_matrix, expected at most {LARGEST:g}; export it again"
        )
    rotation, position = camera_to_world[:3, :3] * (1.0, -1.0, -1.0), camera_to_world[:3, 3]
    u, _, vt = np.linalg.svd(rotation)
    rigid = u @ vt  # the nearest rotation: JSON files round to few digits
    if np.abs(rigid - rotation).max() > 1e-2 or np.linalg.det(rigid) < 0:
        raise SceneError(f"{where} has a transform_matrix that is no rotation and translation; export without scaling")
    if np.abs(camera_to_world[3:] - (0.0, 0.0, 0.0, 1.0)).max(initial=0.0) > LAST_ROW_ERROR:
        last = " ".join(f"{value:g}" for value in camera_to_world[3])
        raise SceneError(
            f"{where} has {last} in the last row of its transform_matrix, expected 0 0 0 1; export the matrix by rows, "
            "with the camera's position in the last column"
        )
    result: NDArray[np.float64] = np.eye(4)
    result[:3, :3] = rigid.T
    result[:3, 3] = -rigid.T @ position
    return result


def read_camera(values: Values, where: str) -> Camera:
    """Return the pinhole camera of a frame in float64, whatever its distortion; `check_camera` checks its numbers.

    Args:
        values: of the file and, before these, of the frame.
        where: file and number of the frame, the subject of messages.

    Raises:
        SceneError: it has no rigid pose, no size or no focal length, or these are no numbers.
    """
    world_to_camera = _world_to_camera(values.get("transform_matrix"), where)
    try:
        width, height = int(values["w"]), int(values["h"])
        fx = _focal(values, "x", width)
        fy = _focal(values, "y", height) or fx
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    except KeyError as error:
        raise SceneError(f"{where} has no {error.args[0]}, expected w and h in pixels; export it again") from error
    except (TypeError, ValueError, ArithmeticError) as error:
        raise SceneError(f"{where} has intrinsics that are no numbers ({error}); export it again") from error
    if fx is None or fy is None:
        raise SceneError(f"{where} has neither fl_x nor camera_angle_x, expected one of them; export it again")
    for axis, focal, side in (("x", fx, width), ("y", fy, height)):
        angle = None if f"fl_{axis}" in values else values.get(f"camera_angle_{axis}")
        if angle is not None and float(angle) > math.pi:
            raise SceneError(
                f"{where} has camera_angle_{axis} {float(angle):g}, expected radians, less than 3.14; export it again"
            )
        if 0.0 < focal < SHORTEST_FOCAL * side:
            raise SceneError(
                f"{where} has a focal length of {focal:g} pixels for {side:.6g} of the image, expected more than a "
                "thousandth of them; export it again"
            )
    return Camera(width, height, fx, fy, cx, cy, torch.from_numpy(world_to_camera))


def _focal(values: Values, axis: str, side: int) -> float | None:
    """Return the focal length in pixels along an axis, from pixels or a field of view in radians; None without both."""
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        return side / (2.0 * math.tan(float(values[f"camera_angle_{axis}"]) / 2.0))
    return None


def _read_points(path: Path, transforms: str, values: Values) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return positions and colours (n, 3) of the scene's PLY; None if it has none, or one that is not there."""
    named = values.get("ply_file_path")
    if named is not None and not isinstance(named, str):
        raise SceneError(
            f"{path / transforms}: ply_file_path is {named!r}, expected the name of a file; export the scene again"
        )
    file = path / named if named else next((path / name for name in POINT_FILES if is_file(path / name)), None)
    if file is None or not is_file(file):
        return None
    subject = f"{path / transforms} names {file}" if named else f"{file}"
    try:
        element = read_ply(file)["vertex"]
    except (OSError, KeyError, ValueError) as error:
        raise SceneError(f"{subject}: not readable as a PLY of points ({error}); export or remove it") from error
    vertices, channels = element.data, POINT_COLORS
    lists = {prop.name for prop in element.properties} - scalar_names(element)
    if unusable := sorted(set("xyz") - scalar_names(element) | lists.intersection(channels)):
        raise SceneError(
            f"{subject}: not readable as a PLY of points ({', '.join(unusable)} missing or a list, expected a number "
            "of each point); export or remove it"
        )
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not set(channels) <= scalar_names(element):
        return points, np.full_like(points, 0.5)
    colors = np.stack([vertices[channel] for channel in channels], axis=1)
    return points, colors / 255.0 if colors.dtype == np.uint8 else colors.astype(np.float64)
