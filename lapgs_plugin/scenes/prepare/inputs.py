"""Make the photos and masks that COLMAP reads, and find out which of them a camera took."""

from __future__ import annotations

import logging
import math
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.errors import SceneError, UserInputError, printable
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.scenes.images import check_image, has_alpha, image_size, require_readable
from lapgs_plugin.scenes.masks import alpha_mask, find_masks, read_mask, refuse_photos, write_mask
from lapgs_plugin.scenes.prepare.clip import pick_frames, write_frames
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import camera_of, convert_photo, listed
from lapgs_plugin.scenes.prepare.settings import (
    AUTO,
    FOLDER,
    IMAGE,
    ONE,
    PER_FOLDER,
    PER_GROUP,
    PER_IMAGE,
    RIG,
    SINGLE,
)

logger = logging.getLogger(__name__)


def make_photos(job: Job) -> None:
    """Write frames of the video, or copies of the photos with HEIC and WebP as JPEG files, if COLMAP needs them."""
    source, folder = job.source, job.work / "photos"
    if not source.needs_copies or folder.is_dir():
        return
    partial = job.work / "photos.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    if source.clip is not None:
        with job.bar("Looking for sharp frames", "frames") as seen:
            numbers = pick_frames(source.clip, job.settings.frames, seen)
        with job.bar("Writing frames", "frames") as seen:
            write_frames(source.clip, numbers, partial, seen)
        logger.info("%s: %d sharp frames, evenly spread", source.clip, len(numbers))
    else:
        for name, file in source.files.items():
            (partial / name).parent.mkdir(parents=True, exist_ok=True)
            require_readable(file)
            if name not in source.converted:
                shutil.copy2(file, partial / name)
        job.each_photo(
            "Converting photos", lambda name: convert_photo(source.files[name], partial / name), source.converted
        )
    partial.rename(folder)


def make_masks(job: Job) -> None:
    """Write masks of the photos' sizes under COLMAP's names, if there are any.

    Photos without one get a white one, because COLMAP leaves out photos without a mask.
    """
    if job.masks.is_dir():
        return
    folder = job.settings.masks
    files = {} if folder is None else _user_masks(job, folder)
    if not files and not any(has_alpha(job.photo(name)) for name in job.names):
        return
    partial = job.work / "masks.partial"
    shutil.rmtree(partial, ignore_errors=True)

    def make(name: str) -> bool:
        photo = job.photo(name)
        width, height = image_size(photo)
        mask = read_mask(files[name], (width, height), (width, height)) if files else alpha_mask(photo, (width, height))
        write_mask(partial / f"{name}.png", torch.ones(1, height, width) if mask is None else mask)
        return mask is not None

    if any(job.each_photo("Reading masks", make, job.names)):
        partial.rename(job.masks)


def _user_masks(job: Job, folder: Path) -> dict[str, Path]:
    """Return the mask of each photo by COLMAP's name. The mask of a.heic is named after it, not after its JPEG."""
    source = job.source
    own = {name: name for name in job.names}
    own |= {name: source.files[name].relative_to(source.folder).as_posix() for name in source.converted}
    masks = find_masks(folder, list(own.values()))
    # The user's files: those beside HEIC and WebP photos are read from copies.
    refuse_photos(masks, {photo: source.files.get(name, job.photos / name) for name, photo in own.items()})
    return {name: masks[photo] for name, photo in own.items()}


def read_sizes(job: Job, decode: bool = True) -> dict[str, tuple[int, int]]:
    """Return width and height of each photo by name. `decode` finds damaged photos before long steps."""
    refused: dict[str, SceneError] = {}

    def size(name: str) -> tuple[int, int]:
        photo = job.photo(name)
        try:
            width, height = check_image(photo) if decode else image_size(photo)
            share = min(1.0, (job.settings.max_size or math.inf) / max(width, height))
            pixels = int(width * share) * int(height * share)
            subject = f"{photo}: the photo has {width}x{height} pixels"
            VIEW_PIXELS.check(pixels, subject, "choose a smaller --max-size", SceneError)
        except SceneError as error:
            refused[name] = error
            return 0, 0
        return width, height

    sizes = dict(zip(job.names, job.each_photo("Reading photos", size, job.names), strict=True))
    if not refused:
        return sizes
    names = [name for name in job.names if name in refused]
    first = refused[names[0]]
    if len(names) == 1:
        raise first
    raise SceneError(
        f"{len(names)} of {len(sizes)} photos cannot be used: {listed(names)}; the first: {first}"
    ) from first


def camera_mode(job: Job, sizes: dict[str, tuple[int, int]]) -> str:
    """Return COLMAP's name for which photos share a camera.

    Raises:
        UserInputError: photos that are said to share one differ in size.
    """
    asked = job.settings.camera_per
    if asked in (ONE, FOLDER, RIG):
        shared: dict[Path, str] = {}
        for name, size in sizes.items():
            other = shared.setdefault(Path() if asked == ONE else Path(name).parent, name)
            if size != sizes[other]:
                raise UserInputError(
                    f"--camera-per {asked}: {job.photos / other} has {sizes[other][0]}x{sizes[other][1]} pixels and "
                    f"{job.photos / name} {size[0]}x{size[1]}, expected one size; leave the option out"
                )
    if asked != AUTO:
        return {ONE: SINGLE, FOLDER: PER_FOLDER, RIG: PER_FOLDER, IMAGE: PER_IMAGE}[asked]
    cameras = Counter((*size, *camera_of(job.photos / name)) for name, size in sizes.items())
    if len(cameras) > 1:
        logger.info("photos of %d cameras or sizes: %s", len(cameras), "; ".join(map(_camera_words, cameras.items())))
    return SINGLE if len(cameras) == 1 else PER_GROUP


def _camera_words(counted: tuple[tuple[Any, ...], int]) -> str:
    (width, height, *exif), count = counted
    return printable(f"{count} of {' '.join(filter(None, [f'{width}x{height}', *exif[:2]]))}")
