"""Write the scene: undistorted photos, or faces, and masks with a PINHOLE model, moved into place when whole."""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pycolmap
import torch

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.images import image_size, read_image, write_image
from lapgs_plugin.scenes.masks import MASKS, write_mask
from lapgs_plugin.scenes.output import write_model
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import check_targets, quarter_turns
from lapgs_plugin.scenes.prepare.undistort import (
    Lens,
    cut_into_faces,
    inside,
    lenses_of,
    move_observations,
    turn_pose,
    undistort,
)
from lapgs_plugin.scenes.source import ALL_AROUND

logger = logging.getLogger(__name__)


def write_scene(job: Job, model: pycolmap.Reconstruction) -> None:
    """Write undistorted photos and the model to the work folder. Images are renamed if their file type changes.

    All are turned upright by the most frequent EXIF orientation, so that images of one camera keep one size. Panoramas
    and photos of wide lenses become faces, which are not turned; one without a pixel inside of the mask is left out.

    Raises:
        SceneError: a photo has no other faces.
    """
    shutil.rmtree(job.scene, ignore_errors=True)
    model.tear_down()  # of cameras without photos
    images = [image for image in model.images.values() if image.has_pose]
    ((turns, count),) = Counter(quarter_turns(job.photo(image.name)) or 0 for image in images).most_common(1)
    sizes = {image.camera_id: image_size(job.photo(image.name)) for image in images}
    asked = (job.settings.max_size, turns, job.settings.tripod)
    lenses = {key: lenses_of(camera, sizes[key], *asked) for key, camera in model.cameras.items()}
    if turns and any(own[0].face is None for own in lenses.values()):
        logger.info("images are turned by %d degrees, as EXIF says of %d photos", 90 * turns, count)
    cut = any(lens.face and lens.resized.model.name != ALL_AROUND for own in lenses.values() for lens in own)
    masked = job.masks.is_dir() or job.settings.tripod > 0 or cut
    targets = [(lens.name_of(image.name), image.name) for image in images for lens in lenses[image.camera_id]]
    check_targets(job.source.folder, targets)

    def write(image: pycolmap.Image) -> list[Lens]:
        return _write_photo(job, image, lenses[image.camera_id], masked)

    written = job.each_photo("Undistorting", write, images)
    for image, shown in zip(images, written, strict=True):
        if shown[0].face is None:
            move_observations(image, shown[0])
            turn_pose(image, shown[0])
            image.name = shown[0].name_of(image.name)
    for key, (lens, *others) in lenses.items():
        if not others:
            camera, turned = model.cameras[key], lens.turned
            camera.model, camera.width, camera.height = turned.model, turned.width, turned.height
            camera.params = list(turned.params)
    cut_into_faces(model, [(image, shown) for image, shown in zip(images, written, strict=True) if shown[0].face])
    write_model(model, job.scene / "sparse" / "0")


def _write_photo(job: Job, image: pycolmap.Image, lenses: Sequence[Lens], masked: bool) -> list[Lens]:
    """Write a photo by each of its lenses, with masks if `masked`, and return those that show something."""
    size = (lenses[0].resized.width, lenses[0].resized.height)
    photo = read_image(job.photo(image.name), size=size, clamp=False)
    file, shown = job.masks / f"{image.name}.png", []
    mask = read_image(file, size=size) if job.masks.is_dir() else torch.ones(3, *photo.shape[1:])
    for lens in lenses:
        target = lens.name_of(image.name)
        if masked:
            used = undistort(mask, lens)[:1] > 0.5
            if lens.face is not None:
                used &= inside(lens)
                if not used.any():
                    continue
            write_mask(job.scene / MASKS / f"{target}.png", used)
        write_image(job.scene / "images" / target, undistort(photo, lens))
        shown.append(lens)
    if not shown:
        tripod = f" and --tripod {job.settings.tripod:g} hide" if job.settings.tripod else " hides"
        raise SceneError(
            f"{job.photo(image.name)}: its mask{tripod} all that it shows, expected a part to train on; correct the "
            "mask, or leave the photo out, and start over with --overwrite"
        )
    return shown


def move_into_place(work: Path, out: Path) -> None:
    """Move the scene to `out`, the model last: a folder without one is no scene."""
    replaced = work / "replaced"
    shutil.rmtree(replaced, ignore_errors=True)  # left by a call that was interrupted here
    replaced.mkdir()
    for name in ("sparse", "images", MASKS):
        if (out / name).exists():
            (out / name).rename(replaced / name)
    for name in (MASKS, "images", "sparse"):
        if name != MASKS or (work / "scene" / name).exists():
            (work / "scene" / name).rename(out / name)
    shutil.rmtree(work)
