"""Read scenes of transforms files: NeRF's Blender scenes, instant-ngp and nerfstudio.

Poses are camera-to-world matrices in OpenGL axes (x right, y up, z backwards). Two layouts exist: the pair
`transforms_train.json` and `transforms_test.json` with one horizontal field of view and PNGs named without extension
(https://github.com/bmild/nerf), and a single `transforms.json` with intrinsics in pixels for the whole file or for each
frame (https://docs.nerf.studio/quickstart/data_conventions.html).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError, counted, printable
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.aligned_points import aligned_points
from lapgs_plugin.scenes.colmap import find_model
from lapgs_plugin.scenes.images import find_image, image_size, where_else
from lapgs_plugin.scenes.lenses import lens_of
from lapgs_plugin.scenes.point_cloud import PointCloud, read_point_cloud
from lapgs_plugin.scenes.random_points import CAPTURE_RADIUS, OBJECT_RADIUS, random_points
from lapgs_plugin.scenes.source import (
    ALL_AROUND,
    LARGEST,
    PINHOLE_MODELS,
    SHORTEST_FOCAL,
    Frame,
    SceneSource,
    check_camera,
    hold_out,
    in_name_order,
    undistort_hint,
)
from lapgs_plugin.untrusted import read_json, shortened

SINGLE_FILE = "transforms.json"
TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""Files of views to hold out: the first that is there."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
TEST_FRAMES = "test_frames"
"""Frames to hold out in a file of ScanNet++."""
SPLITS = ("train", "val", "test")
"""Parts of a scene for which nerfstudio may list file names."""
LAST_ROW_ERROR = 1e-4
"""Largest error of the last row of a 4x4 pose."""
INTRINSICS = {"fl_x", "fl_y", "cx", "cy"}
"""Intrinsics in pixels."""
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
FISHEYE = "OPENCV_FISHEYE"
CAMERA_MODELS = {name.replace("_", ""): name for name in (*PINHOLE_MODELS, FISHEYE, ALL_AROUND)} | {
    "PERSPECTIVE": "PINHOLE",
    "SPHERICAL": ALL_AROUND,
    # COLMAP's others with some or none of the same terms
    "FISHEYE": FISHEYE,
    "SIMPLEFISHEYE": FISHEYE,
    "SIMPLERADIALFISHEYE": FISHEYE,
    "RADIALFISHEYE": FISHEYE,
}
"""COLMAP's camera models by the letters and digits of the names that programs write."""
OPENCV_TERMS = ("k1", "k2", "p1", "p2", "k3")
"""Distortion of perspective lenses in transforms files. Their k4 is nerfstudio's, not OpenCV's."""
FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
"""Distortion of fisheye lenses in transforms files."""
POINT_FILES = ("points3d.ply", "points3D.ply")

Values = dict[str, Any]
Lenses = dict[Path, tuple[str, Values]]
"""Camera model and distortion, as a transforms file names them and without zeros, by image."""


def has_transforms(path: Path) -> bool:
    """Return whether the folder holds a transforms layout."""
    return is_file(path / TRAIN_FILE) or is_file(path / SINGLE_FILE)


def read_transforms(
    path: Path, images: str, evaluate: bool, lenses: Lenses | None = None, distorted: bool = False
) -> SceneSource:
    """Read the frames and points of a transforms layout.

    With `evaluate`, a pair of files holds out the views of `transforms_test.json`, else `transforms_val.json`. A single
    file holds out its `test_frames` (ScanNet++) and those of its lists `test_filenames` and `val_filenames`
    (nerfstudio), or every eighth view. Without it all of these are trained on, as 3DGS does with both files of a pair.
    Frames marked `is_bad`, and frames in no list of a file that has `train_filenames`, are left out. If there is no PLY
    of points (`ply_file_path` or points3d.ply) and no COLMAP model that fits the frames, 100,000 random grey points
    fill a cube around the point that the cameras look at.

    Args:
        path: the scene folder.
        images: folder of the images, replacing the one in `file_path`; "images" keeps it if it is there.
        evaluate: hold out views.
        lenses: filled with the lenses of the frames, whose cameras may then be distorted. None refuses distorted ones,
            unless `distorted`.
        distorted: give cameras their lenses.

    Raises:
        SceneError: a file is unreadable or lacks something, a camera is distorted, or a pose is not rigid.
    """
    lenses = {} if distorted and lenses is None else lenses
    single = not is_file(path / TRAIN_FILE)
    file = path / (SINGLE_FILE if single else TRAIN_FILE)
    values, warnings = _read_json(file), list[str]()
    train, held_out = _read_frames(file, values, images, lenses, warnings), list[Frame]()
    if single:
        train, held_out = _split(file, values, train, warnings)
        if values.get(TEST_FRAMES):
            held_out += _read_frames(file, values, images, lenses, warnings, TEST_FRAMES)
    elif (other := next((path / name for name in TEST_FILES if is_file(path / name)), None)) is not None:
        held_out = _read_frames(other, _read_json(other), images, lenses, warnings)
    elif evaluate:
        raise SceneError(f"{path / TEST_FILES[0]}: no such file, expected the views to hold out; train without --eval")
    parted = _parted(file, train, held_out, evaluate, warnings)
    frames = [*parted[0], *parted[1]]
    if (cloud := _read_points(file, values, frames, warnings)) is not None:
        points, colors = cloud.xyz, cloud.rgb
    else:
        points, colors = random_points(frames, CAPTURE_RADIUS if single else OBJECT_RADIUS)
    train_frames, test_frames = (_with_lenses(part, lenses, path) if distorted else part for part in parted)
    return SceneSource("transforms", train_frames, test_frames, points, colors, tuple(warnings))


def _with_lenses(frames: Sequence[Frame], lenses: Lenses | None, path: Path) -> tuple[Frame, ...]:
    """Return frames with their lenses."""
    assert lenses is not None
    changed = []
    for frame in frames:
        subject = f"{path}: the camera of {frame.name}"
        kind, distortion = lenses[frame.path]
        model, terms = colmap_distortion(subject, kind, distortion, "trained on as it is")
        changed.append(replace(frame, camera=replace(frame.camera, lens=lens_of(model, terms, subject, path))))
    return tuple(changed)


def colmap_distortion(subject: str, kind: str, distortion: Mapping[str, object], use: str) -> tuple[str, list[float]]:
    """Return COLMAP's camera model for a lens of a transforms file, and its distortion.

    Args:
        subject: begins the message.
        kind, distortion: as `Lenses` has them.
        use: what the lens is needed for, such as "undistorted".

    Raises:
        SceneError: COLMAP has none.
    """
    if kind in PINHOLE_MODELS and not distortion:
        return "PINHOLE", []
    if kind == ALL_AROUND:
        return kind, []
    model, keys = (FISHEYE, FISHEYE_TERMS) if kind == FISHEYE else ("FULL_OPENCV", OPENCV_TERMS)
    values = [value for key in keys if isinstance(value := distortion.get(key, 0.0), int | float)]
    if kind not in (*PINHOLE_MODELS, FISHEYE) or set(distortion) - set(keys) or len(values) < len(keys):
        terms = "".join(f", {key} = {value}" for key, value in distortion.items())
        raise SceneError(
            f"{subject} in the transforms file ({kind}{terms}) cannot be {use}; expected numbers "
            f"{', '.join(OPENCV_TERMS)}, or {', '.join(FISHEYE_TERMS)} of {FISHEYE}"
        )
    return model, values if kind == FISHEYE else [*values, 0.0, 0.0, 0.0]


def count_frames(path: Path) -> int | None:
    """Return how many frames transforms.json lists; None if it is not there or cannot be read."""
    with suppress(SceneError):
        if is_file(path / SINGLE_FILE):
            values = _read_json(path / SINGLE_FILE)
            parts = values["frames"], values.get(TEST_FRAMES)
            return sum(len(part) for part in parts if isinstance(part, list))
    return None


def _parted(
    file: Path, train: list[Frame], held_out: list[Frame], evaluate: bool, warnings: list[str]
) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Return training and held-out frames in name order, each image once."""
    tests = {frame.path for frame in held_out}
    unseen = [frame for frame in train if frame.path not in tests]
    if not evaluate:
        return in_name_order([*unseen, *held_out]), ()
    if repeated := len(train) - len(unseen):
        outcome = f"{repeated} of {counted(len(train), 'training view')} are test views too: held out, not trained on"
        if not unseen:  # 3DGS trains on the views that it measures
            unseen, held_out = held_out, []
            outcome = f"all {repeated} training views are test views too: every eighth view is held out instead"
        warnings.append(f"{file}: {outcome}")
    return (in_name_order(unseen), in_name_order(held_out)) if held_out else hold_out(unseen, evaluate)


def _split(file: Path, values: Values, frames: list[Frame], warnings: list[str]) -> tuple[list[Frame], list[Frame]]:
    """Return the frames to train on and those to hold out by nerfstudio's lists of file names, if there are any."""
    names = [_portable(frame["file_path"]) for frame in values["frames"] if not _is_bad(frame)]
    train, val, test = (_listed(file, f"{part}_filenames", values, names, warnings) for part in SPLITS)
    chosen = train or set(range(len(frames))) - val - test
    if unlisted := len(frames) - len(chosen | val | test):
        warnings.append(f"{file}: {counted(unlisted, 'frame')} in none of its lists of file names: left out")
    return [frames[i] for i in sorted(chosen)], [frames[i] for i in sorted(val | test)]


def _listed(file: Path, key: str, values: Values, names: Sequence[str], warnings: list[str]) -> set[int]:
    """Return which of the frames, by their names, a list of file names holds.

    Lists are written by other programs than frames: names may lack folders or their suffix, or be absolute.
    """
    entries = values.get(key) or []
    if not isinstance(entries, list) or not all(isinstance(entry, str) for entry in entries):
        raise SceneError(
            f"{file}: {key} is {shortened(entries)}, expected a list of file names; export the scene again"
        )
    if not entries:
        return set()
    by_whole: dict[tuple[str, ...], list[int]] = {}
    by_end: dict[tuple[str, ...], list[int]] = {}
    for i, parts in enumerate(map(_name_parts, names)):
        by_whole.setdefault(parts, []).append(i)
        for first in range(len(parts)):
            by_end.setdefault(parts[first:], []).append(i)
    chosen, unknown = set[int](), list[str]()
    for entry in entries:
        parts = _name_parts(_portable(entry))
        ends = (parts[first:] for first in range(1, len(parts)))
        alike = by_end.get(parts) or next((by_whole[end] for end in ends if end in by_whole), [])
        alike = [i for i in alike if PurePosixPath(names[i]) == PurePosixPath(_portable(entry))] or alike
        if len(several := sorted({names[i] for i in alike})) > 1:
            raise SceneError(
                f"{file}: {entry} of {key} may be {several[0]} or {several[1]}, expected the name of one frame; write "
                "it as its file_path"
            )
        chosen.update(alike)
        unknown += [] if alike else [entry]
    if unknown and not chosen:
        raise SceneError(
            f"{file}: {key} names no frame, the first is {unknown[0]}, expected names as in file_path; correct or "
            "remove the list"
        )
    if unknown:
        warnings.append(
            f"{file}: {len(unknown)} of {len(entries)} names of {key} are of no frame and ignored, the first is "
            f"{printable(unknown[0])}"
        )
    return chosen


def _name_parts(name: str) -> tuple[str, ...]:
    """Return the folders and the stem of an image's name, as they are compared with those of another program."""
    parts = [part.casefold() for part in name.split("/") if part not in ("", ".", "..")] or [""]
    stem, suffix = os.path.splitext(parts[-1])  # noqa: PTH122
    return (*parts[:-1], stem if suffix in IMAGE_SUFFIXES else parts[-1])


def _portable(name: str) -> str:
    """Return a file name with the slashes of all systems; programs on Windows write backslashes."""
    return name.replace("\\", "/")


def _is_bad(frame: Any) -> bool:
    """Return whether a frame is marked as blurred, as in ScanNet++."""
    return isinstance(frame, dict) and bool(frame.get("is_bad"))


def _good_frames(file: Path, values: Values, part: str, warnings: list[str]) -> list[tuple[int, Any]]:
    """Return the frames that are not marked as blurred, with their numbers in the file."""
    entries = values[part]
    if not isinstance(entries, list):
        raise SceneError(f"{file}: {part} is {shortened(entries)}, expected a list of frames; export the scene again")
    good = [(index, frame) for index, frame in enumerate(entries) if not _is_bad(frame)]
    if not good:
        raise SceneError(f"{file}: all of its {part} are marked is_bad, expected at least one that is not")
    if bad := len(entries) - len(good):
        warnings.append(f"{file}: {bad} of {counted(len(entries), 'frame')} marked is_bad: left out")
    return good


def mask_folder(path: Path) -> str | None:
    """Return the folder of the masks that a transforms file names by `mask_path`, relative to the scene, or None.

    An unreadable file beside a COLMAP model, which is read in its place, names none.

    Raises:
        SceneError: the file is unreadable, or the masks are not in a folder of their own.
    """
    file = next((path / name for name in (TRAIN_FILE, SINGLE_FILE) if is_file(path / name)), None)
    try:
        entries = [] if file is None else _read_json(file)["frames"]
    except SceneError:
        if find_model(path) is None:
            raise
        entries = []
    frames = [frame for frame in entries if isinstance(frame, dict)]
    masks, photos = (
        {PurePosixPath(_portable(frame[key])).parent for frame in frames if isinstance(frame.get(key), str)}
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


def depth_files(path: Path, images: str = "images") -> dict[str, Path]:
    """Return the depth maps that transforms files name by `depth_file_path`, by the names of their photos.

    Args:
        path: the scene folder.
        images: folder of the images, as `read_transforms` takes it.

    Raises:
        SceneError: a file is unreadable.
    """
    inside, maps = os.path.normpath(path), dict[str, Path]()
    for file in (path / name for name in (SINGLE_FILE, TRAIN_FILE, *TEST_FILES) if is_file(path / name)):
        for frame in _read_json(file)["frames"]:
            photo, depth = (
                (frame.get(f"{of}file_path") for of in ("", "depth_")) if isinstance(frame, dict) else ("", "")
            )
            if isinstance(photo, str) and isinstance(depth, str) and depth:
                image = _image_path(path, _portable(photo), images)
                name = image.relative_to(inside).as_posix() if image.is_relative_to(inside) else image.name
                maps[name] = path / _portable(depth)
    return maps


def _read_json(file: Path) -> Values:
    values = read_json(file, error=SceneError, advice="export the scene again", finite=False)
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list) or not values["frames"]:
        raise SceneError(f"{file}: no list of frames in it, expected the transforms of NeRF, instant-ngp or nerfstudio")
    return values


def _read_frames(
    file: Path, values: Values, images: str, lenses: Lenses | None, warnings: list[str], part: str = "frames"
) -> list[Frame]:
    """Return those of the frames that are not marked as bad."""
    path, frames = file.parent, []
    for index, frame in _good_frames(file, values, part, warnings):
        where = f"{file}: {part.removesuffix('s')} {index}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise SceneError(f"{where} has no file_path, expected the name of its image")
        image = _image_path(path, _portable(frame["file_path"]), images)
        where = f"{where} ({frame['file_path']})"
        if image.name in ("", "..") or image == Path(os.path.normpath(path)):
            raise SceneError(f"{where} names a folder, expected the name of its image; export the scene again")
        inside = os.path.normpath(path)
        if image.is_relative_to(inside):
            name = image.relative_to(inside).as_posix()
        elif is_file(image):
            name = image.name
        else:
            raise SceneError(f"{where} names {image}: no such image; {where_else(path, image.name)}")
        posed = {**values, **frame}
        lens = _lens(posed, where)
        if lenses is not None:
            lenses[image] = lens
        elif lens[0] not in PINHOLE_MODELS or lens[1]:
            terms = "".join(f", {key} = {value}" for key, value in lens[1].items())
            raise SceneError(f"{where} has a distorted camera ({lens[0]}{terms}); {undistort_hint(path, lens[0])}")
        if not ("w" in posed and "h" in posed):
            # Pixels in the file are those of the photos that it names, also where smaller copies are read.
            named = _image_path(path, _portable(frame["file_path"]), "images") if INTRINSICS & posed.keys() else image
            posed["w"], posed["h"] = image_size(named if is_file(named) else image)
        if lens[0] == ALL_AROUND:  # programs write focal lengths of several meanings
            with suppress(TypeError, ValueError):  # `read_camera` refuses them
                across, down = float(posed["w"]), float(posed["h"])
                posed |= {"fl_x": across, "fl_y": across, "cx": across / 2, "cy": down / 2}
        camera = read_camera(posed, where)
        check_camera(f"{file}: the camera of {name}", camera)
        frames.append(Frame(name, image, camera))
    return frames


def _lens(values: Values, where: str) -> tuple[str, Values]:
    """Return the camera model of a frame, by COLMAP's name, and its distortion, without zeros."""
    distortion = {key: values[key] for key in DISTORTION_KEYS if values.get(key)}
    if not _is_zero(values.get("distortion_params")):
        distortion["distortion_params"] = values["distortion_params"]
    written = values.get("camera_model") or (FISHEYE if values.get("is_fisheye") else "OPENCV")
    model = CAMERA_MODELS.get(re.sub(r"[\W_]", "", str(written)).upper())
    if model is None:
        raise SceneError(
            f"{where} has the camera_model {shortened(written)}, expected {', '.join(PINHOLE_MODELS)} or {FISHEYE}; "
            "undistort the photos with the program that wrote it, and export pinhole cameras"
        )
    return FISHEYE if values.get("is_fisheye") else model, distortion


def _is_zero(terms: Any) -> bool:
    """Return whether all terms of a list are zero, or there are none."""
    with suppress(TypeError, ValueError):
        return not np.any(terms or 0.0)
    return False  # lists of several lengths


def _image_path(path: Path, file_path: str, images: str) -> Path:
    """Return the image of a frame, or its expected path if it is missing."""
    written, folder = PurePosixPath(file_path), PurePosixPath(images)
    choices = [written]
    if images != "images":
        choices = [folder.joinpath(*written.parts[1:] or written.parts), folder / written.name]
    elif written.parent == PurePosixPath() or not is_folder(path / written.parent):
        # Programs write names without their folder, or with that of another machine.
        choices += [folder / written, folder / written.name]
    # instant-ngp writes ".." where its photos lie beside the scene.
    paths = [Path(os.path.normpath(path / choice)) for choice in choices]
    spellings = (
        image.with_name(image.name + suffix) for image in paths if image.name for suffix in ("", *IMAGE_SUFFIXES)
    )
    return next((image for image in map(find_image, spellings) if is_file(image)), paths[0])


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
    for axis in "xy":
        angle = None if f"fl_{axis}" in values else values.get(f"camera_angle_{axis}")
        if angle is not None and float(angle) > math.pi:
            raise SceneError(
                f"{where} has camera_angle_{axis} {float(angle):g}, expected radians, less than 3.14; export it again"
            )
    least_x, least_y = SHORTEST_FOCAL * width, SHORTEST_FOCAL * height
    in_corner = abs(cx) <= min(1.0, least_x) and abs(cy) <= min(1.0, least_y)
    if 0.0 < fx < least_x or 0.0 < fy < least_y or in_corner:
        raise SceneError(
            f"{where} has focal lengths {fx:g} and {fy:g} and a principal point ({cx:g}, {cy:g}) for {width:.6g}x"
            f"{height:.6g}, expected pixels; of shares of the size multiply fl_x and cx by w, fl_y and cy by h"
        )
    return Camera(width, height, fx, fy, cx, cy, torch.from_numpy(world_to_camera))


def _focal(values: Values, axis: str, side: int) -> float | None:
    """Return the focal length in pixels along an axis, from pixels or a field of view in radians; None without both."""
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        return side / (2.0 * math.tan(float(values[f"camera_angle_{axis}"]) / 2.0))
    return None


def _read_points(transforms: Path, values: Values, frames: Sequence[Frame], warnings: list[str]) -> PointCloud | None:
    """Return the points of the scene's PLY, or else of a COLMAP model that fits the frames; None if there are none."""
    path, named = transforms.parent, values.get("ply_file_path") or ""
    if not isinstance(named, str):
        raise SceneError(
            f"{transforms}: ply_file_path is {named!r}, expected the name of a file; export the scene again"
        )
    name = PurePosixPath(_portable(named))
    candidates = [find_image(path / spelling) for spelling in (name, name.name, *POINT_FILES)]
    file = next(filter(is_file, candidates), None)
    if file is None:
        cloud = aligned_points(path, frames)
    else:
        cloud = read_point_cloud(file, f"{transforms} names {file}" if file in candidates[:2] else f"{file}")
    if named and file not in candidates[:2] and (file or not cloud):  # nerfstudio, too, takes random points then
        warnings.append(f"{transforms} names {named}: no such file; training starts from {file or 'random points'}")
    if cloud and not len(cloud.xyz):
        warnings.append(f"{file}: no points in it; training starts from random points")
        return None
    warnings += [cloud.warning] if cloud and cloud.warning else []
    return cloud
