"""Take the cameras of an existing COLMAP model or transforms file, so that photos are only undistorted."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from itertools import repeat
from pathlib import Path
from shlex import quote

import numpy as np
import pycolmap

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.options import option_name
from lapgs_plugin.scenes.blender import SINGLE_FILE, Lenses, colmap_distortion, has_transforms, read_transforms
from lapgs_plugin.scenes.colmap import (
    MODEL_PLACES,
    find_model,
    is_straight,
    larger_model,
    largest_model,
    source_of,
    with_bare_names,
)
from lapgs_plugin.scenes.colmap_model import Model, count_images, model_of, read_model
from lapgs_plugin.scenes.colmap_records import NO_TRACK, Points
from lapgs_plugin.scenes.exports.registry import find_export
from lapgs_plugin.scenes.images import image_size
from lapgs_plugin.scenes.masks import AUTO, NONE, common_folder, resolve_masks
from lapgs_plugin.scenes.panorama import panorama_lens
from lapgs_plugin.scenes.prepare.photos import Photos, check_targets, listed
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.scene import check_shape, check_source
from lapgs_plugin.scenes.source import ALL_AROUND, Frame, SceneSource

FOLDERS = (".", "images", "input")
"""Folders in which the photos of a model may be."""
USED = ("max_size", "masks", "tripod", "model")
"""Settings that concern undistortion."""
STRAIGHT = {"PINHOLE", "SIMPLE_PINHOLE"}
"""Camera models without distortion."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class KnownCameras:
    """Hold a model and its photos.

    Attributes:
        model: with poses of the present photos.
        frames: of the present photos, with pinhole cameras of the model's size.
        photos: the present files.
        left_out: names of the model's missing photos, sorted.
        settings: the user's, completed by the model and the masks.
    """

    model: pycolmap.Reconstruction
    frames: tuple[Frame, ...]
    photos: Photos
    left_out: tuple[str, ...]
    settings: PrepareSettings

    def check_sizes(self, sizes: Mapping[str, tuple[int, int]]) -> None:
        """Raise a SceneError if photos, of these widths and heights by name, are not those of their cameras."""
        first: dict[int, tuple[int, int]] = {}
        cameras = {image.name: image.camera_id for image in self.model.images.values()}
        for frame in self.frames:
            size = sizes[frame.name]
            check_shape(frame, size)
            if (other := first.setdefault(cameras[frame.name], size)) != size:
                raise SceneError(
                    f"{frame.path}: {size[0]}x{size[1]} pixels, and other photos of its camera {other[0]}x{other[1]}; "
                    "expected one size, make these copies again"
                )


def find_known_cameras(photos: Path, settings: PrepareSettings) -> Path | None:
    """Return the folder of the model of photos, their transforms file or their export; None if there are only photos.

    An undistorted model is the one that `lapgs train` reads. Of several distorted models the largest is taken.

    Raises:
        UserInputError: --model names none.
        SceneError: the model cannot be read.
    """
    if settings.model is not None:
        if (named := find_model(settings.model, (".", "0", *MODEL_PLACES))) is not None:
            return largest_model(settings.model, named)
        if not is_folder(settings.model) or find_export(settings.model) is None:
            raise UserInputError(
                f"--model {settings.model}: no model of COLMAP in it, expected a folder with cameras, images and "
                "points3D, or with another program's export of cameras"
            )
        return settings.model
    trained = find_model(photos)
    if trained is None and has_transforms(photos):
        return photos
    if trained is not None and is_straight(read_model(trained)):
        for line in larger_model(photos, trained):
            logger.warning(line)
        return trained
    distorted = trained or find_model(photos, MODEL_PLACES)
    if distorted is not None:
        return largest_model(photos, distorted)
    return photos if is_folder(photos) and find_export(photos) is not None else None


def read_known_cameras(cameras: Path, photos: Path, settings: PrepareSettings) -> KnownCameras:
    """Read a model and find its photos.

    Args:
        cameras: from `find_known_cameras`.
        photos: folder of the photos, or of the whole scene.
        settings: of the user.

    Raises:
        SceneError: the model cannot be read or undistorted, or its photos are not there.
        UserInputError: no camera is distorted, or an option is about the search for cameras.
    """
    for field in fields(settings):
        if field.name not in USED and getattr(settings, field.name) != field.default:
            raise UserInputError(
                f"{option_name(field)}: {cameras} has the cameras already; leave the option out, or give a folder of "
                "photos without a model"
            )
    colmap = find_model(cameras, (".",)) is not None
    transforms = not colmap and cameras == photos and has_transforms(cameras)
    read = _from_model if colmap else _from_transforms if transforms else _from_export
    model, source, folder = read(cameras, photos)
    frames = source.train
    present = tuple(frame for frame in frames if is_file(frame.path))
    left_out = sorted({frame.name for frame in frames} - {frame.name for frame in present})
    if frames and not present:
        advice = "give the folder of the photos, and the model with --model" if colmap else "put them there"
        first = min(frame.path for frame in frames)
        raise SceneError(f"{first}: no such image, nor any other of the {len(frames)} of {cameras}; {advice}")
    straight = {model.cameras[image.camera_id].model.name for image in model.images.values()} <= STRAIGHT
    if settings.max_size is None and straight and not left_out and (transforms or cameras == find_model(photos)):
        raise UserInputError(
            f"{cameras}: its cameras have no distortion, so that its photos can be trained on as they are; to find the "
            "cameras again, give a folder of photos without a model"
        )
    kinds = {camera.model.name for camera in model.cameras.values()}
    if settings.tripod and ALL_AROUND not in kinds:
        raise UserInputError(
            f"--tripod {settings.tripod:g}: {cameras} has no panoramas, of which it hides what is below; leave it out"
        )
    check_source(photos, replace(source, train=present))
    check_targets(photos, [(frame.name, frame.name) for frame in present])
    for warning in source.warnings:
        logger.warning(warning)
    if left_out:
        logger.warning("%d of %d photos are not there, left out: %s", len(left_out), len(frames), listed(left_out))
    logger.info("%s: the cameras are taken from it", cameras)
    masks = settings.masks
    if masks is None and (masks_setting := resolve_masks(photos, AUTO)) != NONE:
        masks = photos / masks_setting
    files = {frame.name: frame.path for frame in present}
    settings = replace(settings, masks=masks, model=cameras)
    return KnownCameras(_reconstruction(model, files), present, Photos(folder, files), tuple(left_out), settings)


def _from_model(cameras: Path, photos: Path) -> tuple[Model, SceneSource, Path]:
    """Return a COLMAP model, its frames and points, and the folder that most of its photos are in."""
    model = read_model(cameras, observations=True)
    _check_lenses(model)
    choices = [(with_bare_names(model, photos / name), photos / name) for name in FOLDERS]
    model, folder = max(choices, key=lambda choice: _fit(source_of(*choice)))
    return model, source_of(model, folder), folder


def _from_transforms(cameras: Path, photos: Path) -> tuple[Model, SceneSource, Path]:
    """Return a model of a transforms file, its frames and points, and the folder of its photos."""
    lenses: Lenses = {}
    source = read_transforms(photos, "images", False, lenses)
    source = _without_top(source)
    frames = source.train
    posed = [
        (frame.name, _colmap_lens(frame, *lenses[frame.path]), frame.camera.world_to_camera.numpy()) for frame in frames
    ]
    model = model_of(cameras, posed, Points(source.points, 255.0 * source.colors))
    other = find_model(photos, MODEL_PLACES)
    if other is not None and (count := count_images(other)) != len(frames):
        logger.warning(
            f"{photos / SINGLE_FILE} lists {len(frames)} photos and {other} {count}; those of the former are used, as "
            f"by `lapgs train`; --model {quote(str(other))} takes the latter"
        )
    _check_lenses(model)
    return model, source, photos


def _from_export(cameras: Path, photos: Path) -> tuple[Model, SceneSource, Path]:
    """Return a model of another program's export, its frames and points, and the folder of its photos."""
    export = find_export(cameras)
    assert export is not None  # `find_known_cameras` has found it
    model, source = export.read(photos)
    _check_lenses(model)
    short = _without_top(source)
    names = {long.name: frame.name for long, frame in zip(source.train, short.train, strict=True)}
    images = {key: replace(image, name=names[image.name]) for key, image in model.images.items()}
    points = Points(source.points, 255.0 * source.colors)  # random ones, too, which checkouts need
    return replace(model, images=images, points=points), short, photos


def _without_top(source: SceneSource) -> SceneSource:
    """Return the source with names of photos without the folder that all are in."""
    top = common_folder([frame.name for frame in source.train])
    return replace(source, train=tuple(replace(frame, name=frame.name.removeprefix(top)) for frame in source.train))


def _fit(source: SceneSource) -> tuple[int, bool]:
    """Return how many photos of a model are in their folder, and whether the first of them has its camera's size.

    3DGS's convert.py leaves photos in `input` and undistorted ones, which may have the same shape, in `images`.
    """
    present = [frame for frame in source.train if is_file(frame.path)]
    return len(present), any(image_size(frame.path) == frame.camera.size for frame in present[:1])


def _check_lenses(model: Model) -> None:
    for key in sorted({image.camera_id for image in model.images.values()}):
        camera = model.cameras[key]
        subject = f"{model.folder}: camera {key} ({camera.model.name})"
        if camera.model.name == ALL_AROUND:
            panorama_lens((camera.width, camera.height), subject)
        if not np.isfinite(camera.params).all():
            raise SceneError(f"{subject} has NaN or inf in its parameters; reconstruct or export it again")


def _reconstruction(model: Model, names: Collection[str]) -> pycolmap.Reconstruction:
    """Return the images of these names and all points, with the observations that tracks and features agree on.

    Each image has a pose of its own: those of a rig could neither be left out nor turned alone.
    """
    result = pycolmap.Reconstruction()
    images = {key: image for key, image in model.images.items() if image.name in names}
    for key in sorted({image.camera_id for image in images.values()}):
        result.add_camera_with_trivial_rig(model.cameras[key])
    for key, image in images.items():
        observed = pycolmap.Image(image.name, keypoints=image.features, camera_id=image.camera_id, image_id=key)
        result.add_image_with_trivial_frame(observed, image.pose)
    free = {key: np.ones(len(image.features), bool) for key, image in images.items()}
    points, colors = model.points, np.rint(model.points.rgb.clip(0, 255)).astype(np.uint8)
    errors = points.errors or repeat(math.nan, len(colors))
    tracks = points.tracks or repeat(NO_TRACK, len(colors))
    for xyz, color, error, track in zip(points.xyz, colors, errors, tracks, strict=True):
        elements = pycolmap.Track()
        for key, feature in track:
            if key in free and 0 <= feature < len(free[key]) and free[key][feature]:
                free[key][feature] = False
                elements.add_element(key, feature)
        key = result.add_point3D(xyz, elements, color)
        if error >= 0:
            result.points3D[key].error = error
    return result


def _colmap_lens(frame: Frame, kind: str, distortion: Mapping[str, object]) -> pycolmap.Camera:
    """Return COLMAP's camera for a lens of a transforms file and its distortion."""
    camera = frame.camera
    if kind == ALL_AROUND:
        return panorama_lens(camera.size, str(frame.path))
    subject = f"{frame.path}: its camera"
    model, terms = colmap_distortion(subject, kind, distortion, "undistorted")
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *terms]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params)
