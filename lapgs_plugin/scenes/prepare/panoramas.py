"""Find the cameras of panoramas: COLMAP places their faces as a rig of pinhole cameras with one centre."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError, UserInputError, counted
from lapgs_plugin.scenes.images import read_image, write_image
from lapgs_plugin.scenes.masks import MASKS, write_mask
from lapgs_plugin.scenes.panorama import is_panorama, may_be_panorama, panorama_lens
from lapgs_plugin.scenes.prepare.colmap import Attempt, chosen_matcher, find_features, map_photos, match_pairs
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import Photos, camera_of, listed, says_all_around, target_name
from lapgs_plugin.scenes.prepare.settings import AUTO, PER_FOLDER, SEQUENTIAL
from lapgs_plugin.scenes.prepare.undistort import Lens, inside, lenses_of, undistort
from lapgs_plugin.scenes.source import ALL_AROUND

FACES = "faces"
"""Folder of the faces and of COLMAP's work on them, in that of unfinished work."""

logger = logging.getLogger(__name__)


def are_panoramas(job: Job, sizes: Mapping[str, tuple[int, int]]) -> bool:
    """Return whether the photos are panoramas, of these widths and heights by name.

    Those are that say so, and those twice as wide as high without a focal length, unless a camera model is asked for.

    Raises:
        SceneError: some are and others are not, one does not show all around, they differ in size, or all are almost
            twice as wide as high, so that they may be.
        UserInputError: an option does not concern such photos.
    """
    asked = job.settings.camera_model
    around = [name for name, size in sizes.items() if asked == ALL_AROUND or _is_around(job.photo(name), size)]
    if asked == AUTO and not around:
        _require_decided(job, sizes)
    if asked not in (AUTO, ALL_AROUND) or not around:
        if job.settings.tripod:
            raise UserInputError(
                f"--tripod {job.settings.tripod:g}: {job.source.folder} has no panoramas, of which it hides what is "
                "below; leave it out, or say --camera-model EQUIRECTANGULAR"
            )
        return False
    for name in around:
        panorama_lens(sizes[name], str(job.photo(name)))
    if len(around) < len(sizes):
        others = sorted(set(sizes) - set(around))
        raise SceneError(
            f"{job.source.folder}: {counted(len(around), 'panorama')} ({listed(around)}) mixed with "
            f"{counted(len(others), 'other photo')} ({listed(others)}), expected one kind; move either elsewhere, or "
            "give --camera-model OPENCV if all are ordinary photos"
        )
    if len(kinds := sorted(set(sizes.values()))) > 1:
        (first, second), names = kinds[:2], {size: name for name, size in sizes.items()}
        raise SceneError(
            f"{job.source.folder}: panoramas of {first[0]}x{first[1]} pixels ({names[first]}) and of {second[0]}x"
            f"{second[1]} ({names[second]}), expected one size; make scenes of them apart"
        )
    if job.settings.camera_per != AUTO:
        raise UserInputError(f"--camera-per {job.settings.camera_per}: panoramas need no calibration; leave it out")
    logger.info(
        "%s: panoramas, which are cut into pinhole images; give --camera-model OPENCV if they are ordinary photos",
        job.source.clip or job.source.folder,
    )
    return True


def _is_around(photo: Path, size: tuple[int, int]) -> bool:
    return says_all_around(photo) or (is_panorama(size) and not _has_focal_length(photo))


def _require_decided(job: Job, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Refuse photos of which nothing says whether they are panoramas: placing them as the wrong kind takes long.

    Raises:
        SceneError: all are almost twice as wide as high, and none has a focal length.
    """
    if not all(may_be_panorama(size) and not _has_focal_length(job.photo(name)) for name, size in sizes.items()):
        return
    width, height = next(iter(sizes.values()))
    raise SceneError(
        f"{job.source.clip or job.source.folder}: photos of {width}x{height} pixels, almost twice as wide as high and "
        "without a focal length, expected to know whether they are panoramas; give --camera-model OPENCV if they are "
        "ordinary photos, else export whole panoramas of 360x180 degrees, twice as wide as high"
    )


def _has_focal_length(photo: Path) -> bool:
    _, _, *focal = camera_of(photo)
    return any(focal)


def place_panoramas(job: Job, size: tuple[int, int]) -> tuple[pycolmap.Reconstruction, int]:
    """Recover the cameras of panoramas of one size.

    Returns:
        The model of the panoramas, with tracks of points; the number of separate models.

    Raises:
        SceneError: none could be placed.
    """
    camera = panorama_lens(size, str(job.source.folder))
    lenses = {lens.face.name: lens for lens in lenses_of(camera, size, None, 0, job.settings.tripod) if lens.face}
    faces = _cut(job, lenses)
    find_features(faces, PER_FOLDER, [_sensor(lens) for lens in lenses.values()])
    match_pairs(faces, rig=True)
    models = map_photos(faces, Attempt("Placing cameras", "models", rig=True))
    models.sort(key=lambda model: (model.num_reg_frames(), model.num_points3D()), reverse=True)
    job.seconds.update(faces.seconds)
    if not models or models[0].num_reg_frames() < 2:
        raise SceneError(
            f"{job.source.clip or job.source.folder}: none of the {len(job.names)} panoramas could be placed; expected "
            "sharp panoramas of a static scene, each taken a step aside from the last; if they are ordinary photos, "
            "give --camera-model OPENCV"
        )
    return _joined(models[0], camera, lenses, job.names), len(models)


def _sensor(lens: Lens) -> dict[str, Any]:
    """Return a camera of the rig for COLMAP's step."""
    assert lens.face is not None
    pinhole = lens.pinhole
    params, size = pinhole.params.tolist(), [pinhole.width, pinhole.height]
    return {"prefix": f"{lens.face.name}/", "turn": lens.face.turn.tolist(), "params": params, "size": size}


def _cut(job: Job, lenses: Mapping[str, Lens]) -> Job:
    """Write the faces and their masks, f0/a.jpg and so on, unless they are there; return the job of placing them."""
    work = job.work / FACES
    matcher = SEQUENTIAL if chosen_matcher(job) == SEQUENTIAL else job.settings.matcher
    settings = replace(job.settings, camera_model="PINHOLE", max_size=None, matcher=matcher)
    if not work.is_dir():
        partial = job.work / f"{FACES}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        masked = job.masks.is_dir() or job.settings.tripod > 0

        def cut(name: str) -> None:
            photo = read_image(job.photo(name))
            file = job.masks / f"{name}.png"
            mask = read_image(file) if file.is_file() else torch.ones(3, *photo.shape[1:])
            for face, lens in lenses.items():
                used = (undistort(mask, lens)[:1] > 0.5) & inside(lens) if masked else torch.ones(1, 1, 1)
                if used.any():
                    write_image(partial / "photos" / face / target_name(name), undistort(photo, lens))
                    if masked:
                        write_mask(partial / MASKS / face / f"{target_name(name)}.png", used)

        job.each_photo("Cutting panoramas", cut, job.names)
        partial.rename(work)
    photos = work / "photos"
    files = {file.relative_to(photos).as_posix(): file for file in sorted(photos.rglob("*")) if file.is_file()}
    return Job(work, Photos(photos, files), settings, job.progress)


def _joined(
    placed: pycolmap.Reconstruction, camera: pycolmap.Camera, lenses: Mapping[str, Lens], names: tuple[str, ...]
) -> pycolmap.Reconstruction:
    """Return the model of the panoramas whose faces were placed; a panorama's features are those of all its faces."""
    model = pycolmap.Reconstruction()
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    numbers = {target_name(name): number for number, name in enumerate(names, start=1)}
    features: dict[int, list[NDArray[np.float64]]] = {}
    poses: dict[int, pycolmap.Rigid3d] = {}
    tracks: dict[int, dict[int, int]] = {key: {} for key in placed.points3D}  # point -> panorama -> feature
    for image in placed.images.values():
        if not image.has_pose:
            continue
        face, _, name = image.name.partition("/")
        lens, number = lenses[face], numbers[name]
        assert lens.face is not None
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(lens.face.turn), np.zeros(3))
        poses.setdefault(number, turn.inverse() * image.cam_from_world())
        own = features.setdefault(number, [])
        for point in image.points2D:
            if point.has_point3D() and number not in tracks[point.point3D_id]:  # neighbours overlap
                ray = np.append(lens.pinhole.cam_from_img(point.xy), 1.0) @ lens.face.turn
                tracks[point.point3D_id][number] = len(own)
                own.append(np.asarray(camera.img_from_cam(ray)))
    for name, number in ((name, numbers[target_name(name)]) for name in names):
        if number in poses:
            pixels = np.array(features[number]).reshape(-1, 2)
            image = pycolmap.Image(name, keypoints=pixels, camera_id=1, image_id=number)
            model.add_image_with_trivial_frame(image, poses[number])
    for key, point in placed.points3D.items():
        track = pycolmap.Track()
        for number, feature in tracks[key].items():
            track.add_element(number, feature)
        added = model.add_point3D(point.xyz, track, point.color)
        model.points3D[added].error = point.error
    return model
