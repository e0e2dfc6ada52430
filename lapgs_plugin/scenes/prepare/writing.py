"""Write the scene: undistorted photos and masks with a PINHOLE model, moved into place when they are whole."""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from pathlib import Path

import pycolmap

from lapgs_plugin.scenes.images import image_size, read_image, write_image
from lapgs_plugin.scenes.masks import MASKS, write_mask
from lapgs_plugin.scenes.output import write_model
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import quarter_turns, target_name
from lapgs_plugin.scenes.prepare.undistort import lens_of, move_observations, turn_pose, undistort

logger = logging.getLogger(__name__)


def write_scene(job: Job, model: pycolmap.Reconstruction) -> None:
    """Write undistorted photos and the model to the work folder. Images are renamed if their file type changes.

    All are turned upright by the most frequent EXIF orientation, so that images of one camera keep one size.
    """
    shutil.rmtree(job.scene, ignore_errors=True)
    model.tear_down()  # of cameras without photos
    images = [image for image in model.images.values() if image.has_pose]
    ((turns, count),) = Counter(quarter_turns(job.photo(image.name)) or 0 for image in images).most_common(1)
    if turns:
        logger.info("images are turned by %d degrees, as EXIF says of %d photos", 90 * turns, count)
    sizes = {image.camera_id: image_size(job.photo(image.name)) for image in images}
    lenses = {key: lens_of(camera, sizes[key], job.settings.max_size, turns) for key, camera in model.cameras.items()}
    masked = job.masks.is_dir()

    def write(image: pycolmap.Image) -> None:
        lens = lenses[image.camera_id]
        size, target = (lens.resized.width, lens.resized.height), target_name(image.name)
        photo = read_image(job.photo(image.name), size=size, clamp=False)
        write_image(job.scene / "images" / target, undistort(photo, lens))
        if not masked:
            return
        mask = read_image(job.masks / f"{image.name}.png", size=size)
        write_mask(job.scene / MASKS / f"{target}.png", undistort(mask, lens)[:1] > 0.5)

    job.each_photo("Undistorting", write, images)
    for image in images:
        lens = lenses[image.camera_id]
        move_observations(image, lens)
        turn_pose(image, lens)
        image.name = target_name(image.name)
    for key, lens in lenses.items():
        camera, turned = model.cameras[key], lens.turned
        camera.model, camera.width, camera.height = turned.model, turned.width, turned.height
        camera.params = list(turned.params)
    write_model(model, job.scene / "sparse" / "0")


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
