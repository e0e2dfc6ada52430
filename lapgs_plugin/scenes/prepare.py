"""Make a scene from photos or a video: structure from motion and undistortion with pycolmap.

OUT/images/            undistorted photos under their own names
OUT/masks/             undistorted masks, if there are any
OUT/sparse/0/          the model: PINHOLE cameras, poses, points with their tracks
OUT/.prepare/          while unfinished: COLMAP's database and models, to continue an interrupted run
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import pycolmap
import torch

from lapgs_plugin.errors import LapgsError, SceneError, UserInputError, printable
from lapgs_plugin.files import atomic_write
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.progress import item_progress
from lapgs_plugin.scenes.clip import pick_frames, write_frames
from lapgs_plugin.scenes.images import check_image, has_alpha, image_size, read_image, write_image
from lapgs_plugin.scenes.left_out import left_out_because
from lapgs_plugin.scenes.masks import MASKS, alpha_mask, find_masks, read_mask, write_mask
from lapgs_plugin.scenes.output import check_output, check_written, one_line_errors, write_model
from lapgs_plugin.scenes.parallel import in_threads
from lapgs_plugin.scenes.photos import HEIC, Photos, camera_of, convert_heic, find_photos, listed, target_name
from lapgs_plugin.scenes.undistort import lens_of, move_observations, undistort
from lapgs_plugin.untrusted import read_json

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

AUTO = "auto"
MATCHERS = (AUTO, "exhaustive", "sequential", "retrieval")
MOST_EXHAUSTIVE = 500
"""Most photos of which all pairs are compared, unless a matcher was chosen; of more, those that look alike."""
SIMILAR = 40
"""Photos that each photo is compared with by the matcher "retrieval"."""
HAS_GLOBAL = hasattr(pycolmap, "global_mapping")
HAS_VOCABULARY = hasattr(getattr(pycolmap, "VisualIndex", None), "build")
LOOP_FROM, LOOP_EVERY, LOOP_SIMILAR = 40, 10, 20
"""Sequential matching of so many photos or more also compares every tenth with those that look most like it, because
the camera may come back to a place."""
MAPPERS = ("incremental", "global")
DEFAULT_MODEL, SIMPLE_MODEL = "OPENCV", "SIMPLE_RADIAL"
"""Camera models to fit by default: first, and if the result is doubtful."""
FEW = 0.5
"""Share of photos below which so few are placed that the lens may be wrong."""
SQUARE = 0.04
"""Largest relative difference of the focal lengths along x and y that is believed: pixels are square."""
CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
)
MIN_SIDE = 64  # smallest --max-size; features need room

WORK = ".prepare"
POLL_SECONDS = 0.2
MAX_DECODERS = 4  # a decoded 50-megapixel photo takes 600 MB
WORKER = Path(__file__).with_name("colmap_worker")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PrepareResult:
    """The outcome of `prepare_scene`.

    Attributes:
        registered: names of the photos that have a pose, sorted.
        left_out: names of the other photos, sorted.
        parts: number of separate models; the scene is the largest one.
        points: number of sparse points.
        reprojection_error: mean reprojection error in pixels of the photos before undistortion.
        seconds: wall time of each step by name, without the steps that an interrupted run had finished.
    """

    registered: tuple[str, ...]
    left_out: tuple[str, ...]
    parts: int
    points: int
    reprojection_error: float
    seconds: dict[str, float]


def prepare_scene(
    photos: Path,
    out: Path,
    *,
    matcher: str = AUTO,
    mapper: str = "incremental",
    camera_model: str = AUTO,
    single_camera: bool | None = None,
    max_size: int | None = None,
    masks: Path | None = None,
    frames: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> PrepareResult:
    """Find features, match them, recover cameras and points, and write undistorted photos with a PINHOLE model.

    Call it again with the same photos and settings to continue an interrupted call. On one machine, photos with fewer
    than 25,000 features in total give the same scene each time. With more features, the timing of COLMAP's threads
    decides which photos it starts from and in which order it sums. COLMAP's GPU code is used if pycolmap has it.

    Args:
        photos: folder of at least 2 JPEG, PNG, TIFF, BMP, WebP or HEIC files, also in subfolders; or a video.
        out: the scene folder; new, empty, with unfinished work, or with `overwrite` a scene.
        matcher: "exhaustive" matches all pairs, "sequential" neighbours in name order (frames of a video), "retrieval"
            each photo with those that look most like it. "auto" chooses by the kind and number of photos.
        mapper: "incremental" places one photo after the other, "global" all at once.
        camera_model: COLMAP's name of the camera model to fit, one of `CAMERA_MODELS`. "auto" fits OPENCV, and
            SIMPLE_RADIAL if that places few photos or gives implausible focal lengths.
        single_camera: fit one camera to all photos. None: do so if they have the same size and EXIF camera.
        max_size: longest side in pixels of the scene's images and for feature extraction. None keeps the photos' size.
        masks: folder with a mask for each photo, see `masks.find_masks`. None takes those that transparent pixels of
            the photos make.
        frames: frames to pick from a video; None for two a second.
        overwrite: replace the scene in `out`, and discard unfinished work of other photos or settings.
        progress: show a bar for each step on stderr.

    Raises:
        SceneError: there are too few photos, one or its mask cannot be read, or none could be registered.
        UserInputError: an argument is out of range or `out` must not be written to.
        LapgsError: the disk is full, the folder cannot be written, or COLMAP failed.
        MissingExtraError: a package that reads videos or HEIC photos is missing.
    """
    _check_arguments(photos, out, matcher, mapper, camera_model, max_size)
    check_output(out, overwrite, WORK)
    if masks is not None and not masks.is_dir():
        raise UserInputError(f"--masks {masks}: no such folder of masks; leave it out to use the whole photos")
    found = find_photos(photos)
    if frames is not None and frames < 2:
        raise UserInputError(f"--frames {frames}: expected at least 2")
    if frames is not None and found.clip is None:
        raise UserInputError(f"--frames {frames}: it picks frames from a video, and {photos} is a folder; leave it out")
    settings = {
        "photos": _stats(found),
        "--matcher": matcher,
        "--mapper": mapper,
        "--camera-model": camera_model,
        "--single-camera": single_camera,
        "--max-size": max_size,
        "--masks": None if masks is None else str(masks.absolute()),
        "--frames": frames,
        "pycolmap": pycolmap.__version__,
    }
    with one_line_errors(out), _said_on_interruption(out):
        with _opened_work(out / WORK, settings, overwrite):
            job = _Job(out / WORK, found, matcher, mapper, camera_model, max_size, progress)
            _make_photos(job, frames)
            sizes = _read_sizes(job)
            single_camera = _one_camera(job, sizes, single_camera)
            _make_masks(job, masks)
        _find_features(job, single_camera)
        _match_pairs(job)
        models = _place_cameras(job)
        result = _describe(job, models)
        _write_scene(job, models[0])
        _move_into_place(job.work, out)
    return result


@dataclass(frozen=True)
class _Job:
    """Arguments and folders that all steps share."""

    work: Path
    found: Photos
    asked_matcher: str
    mapper: str
    asked_model: str
    max_size: int | None
    progress: bool
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def photos(self) -> Path:
        """Folder of the photos that COLMAP reads."""
        return self.work / "photos" if self.found.made else self.found.folder

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the photos, once those of a video are there."""
        if self.found.clip is None:
            return tuple(self.found.files)
        return tuple(sorted(file.name for file in self.photos.iterdir()))

    @property
    def matcher(self) -> str:
        if self.asked_matcher != AUTO:
            return self.asked_matcher
        if self.found.clip is not None:
            return "sequential"
        return "retrieval" if len(self.names) > MOST_EXHAUSTIVE and HAS_VOCABULARY else "exhaustive"

    @property
    def camera_model(self) -> str:
        return DEFAULT_MODEL if self.asked_model == AUTO else self.asked_model

    @property
    def masks(self) -> Path:
        """Folder of the masks, which is missing without any."""
        return self.work / MASKS

    @property
    def database(self) -> Path:
        return self.work / "database.db"

    @property
    def models(self) -> Path:
        return self.work / "models"

    @property
    def scene(self) -> Path:
        return self.work / "scene"


def _check_arguments(
    photos: Path, out: Path, matcher: str, mapper: str, camera_model: str, max_size: int | None
) -> None:
    if matcher not in MATCHERS:
        raise UserInputError(f"--matcher {matcher!r}: expected {', '.join(MATCHERS[:-1])} or {MATCHERS[-1]}")
    if matcher == "retrieval" and not HAS_VOCABULARY:
        raise UserInputError(
            f"--matcher retrieval: pycolmap {pycolmap.__version__} has none; upgrade it to 4.2 or newer"
        )
    if mapper not in MAPPERS:
        raise UserInputError(f"--mapper {mapper!r}: expected {' or '.join(MAPPERS)}")
    if mapper == "global" and not HAS_GLOBAL:
        raise UserInputError(
            f"--mapper global: pycolmap {pycolmap.__version__} has none; leave it out or upgrade pycolmap"
        )
    if camera_model not in (AUTO, *CAMERA_MODELS):
        raise UserInputError(f"--camera-model {camera_model!r}: expected auto or one of {', '.join(CAMERA_MODELS)}")
    if max_size is not None and max_size < MIN_SIDE:
        raise UserInputError(f"--max-size {max_size}: expected at least {MIN_SIDE} pixels")
    source, target = photos.resolve(), out.resolve()
    if source.is_relative_to(target) or target.is_relative_to(source):
        raise UserInputError(f"{out}: one of {photos} and {out} lies in the other; write OUT somewhere else")


def _stats(found: Photos) -> dict[str, list[int]]:
    """Return size and time of each file, to notice changes."""
    files = {found.clip.name: found.clip} if found.clip is not None else found.files
    stats = {name: path.stat() for name, path in files.items()}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


def _make_photos(job: _Job, frames: int | None) -> None:
    """Write frames of the video, or copies of the photos with JPEG files for those in HEIC, if COLMAP needs them."""
    found, folder = job.found, job.work / "photos"
    if not found.made or folder.is_dir():
        return
    partial = job.work / "photos.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    if found.clip is not None:
        with _bar(job, "Looking for sharp frames", "frames") as seen:
            numbers = pick_frames(found.clip, frames, seen)
        with _bar(job, "Writing frames", "frames") as seen:
            write_frames(found.clip, numbers, partial, seen)
        logger.info("%s: %d sharp frames, evenly spread", found.clip, len(numbers))
    else:

        def make(name: str) -> None:
            source, target = found.files[name], partial / name
            if source.suffix.lower() in HEIC:
                convert_heic(source, target)
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, target)

        _each_photo(job, "Reading HEIC photos", make, list(found.files))
    partial.rename(folder)


def _make_masks(job: _Job, given: Path | None) -> None:
    """Write masks of the photos' sizes under COLMAP's names, white where nothing is known of a photo."""
    if job.masks.is_dir():
        return
    files = {} if given is None else find_masks(given, job.names)
    names = job.names if files else [name for name in job.names if has_alpha(job.photos / name)]
    if not names:
        return
    partial = job.work / "masks.partial"
    shutil.rmtree(partial, ignore_errors=True)

    def make(name: str) -> bool:
        photo = job.photos / name
        size = image_size(photo)
        mask = read_mask(files[name], size, size) if files else alpha_mask(photo, size)
        if mask is not None:
            write_mask(partial / f"{name}.png", mask)
        return mask is not None

    if sum(_each_photo(job, "Reading masks", make, names)):
        partial.rename(job.masks)


def _read_sizes(job: _Job) -> dict[str, tuple[int, int]]:
    """Return width and height of each photo by name. Photos are decoded, to find damaged ones before the long steps."""

    def size(name: str) -> tuple[int, int]:
        width, height = check_image(job.photos / name)
        longest = max(width, height)
        share = min(1.0, (job.max_size or longest) / longest)
        subject = f"{job.photos / name}: the photo has {width}x{height} pixels"
        VIEW_PIXELS.check(int(width * share) * int(height * share), subject, "choose a smaller --max-size", SceneError)
        return width, height

    return dict(zip(job.names, _each_photo(job, "Reading photos", size, job.names), strict=True))


def _one_camera(job: _Job, sizes: dict[str, tuple[int, int]], asked: bool | None) -> bool:
    """Return whether all photos share a camera."""
    names = {size: name for name, size in sizes.items()}
    if asked and len(names) > 1:
        (first, one), (second, other) = list(names.items())[:2]
        raise UserInputError(
            f"--single-camera: {job.photos / one} has {first[0]}x{first[1]} pixels and {job.photos / other} "
            f"{second[0]}x{second[1]}, expected one size; leave the option out"
        )
    if asked is not None:
        return asked
    cameras = Counter((*size, *camera_of(job.photos / name)) for name, size in sizes.items())
    if len(cameras) > 1:
        logger.info("photos of %d cameras or sizes: %s", len(cameras), "; ".join(map(_camera_words, cameras.items())))
    return len(cameras) == 1


def _camera_words(counted: tuple[tuple[Any, ...], int]) -> str:
    (width, height, *exif), count = counted
    return printable(f"{count} of {' '.join(filter(None, [f'{width}x{height}', *exif[:2]]))}")


@contextmanager
def _said_on_interruption(out: Path) -> Iterator[None]:
    """Tell that the same command continues."""
    try:
        yield
    except KeyboardInterrupt:
        logger.info("%s: the finished steps are kept; repeat the command to continue", out)
        raise


@contextmanager
def _opened_work(work: Path, settings: dict[str, Any], overwrite: bool) -> Iterator[None]:
    """Make the work folder, or reuse that of the same photos and settings. A new one is removed if the block fails."""
    file = work / "settings.json"
    if file.is_file():
        before = read_json(file, dict[str, Any], advice=f"delete {work} to start over")
        changed = [key for key in settings if before.get(key) != settings[key]]
        if not changed:
            yield
            return
        if not overwrite:
            raise UserInputError(
                f"{work}: unfinished work with other {', '.join(changed)}; repeat the command as it was to "
                "finish it, or start over with --overwrite"
            )
    if work.exists():
        shutil.rmtree(work)
    work.mkdir(parents=True)
    with atomic_write(file) as stream:
        stream.write(json.dumps(settings).encode())
    try:
        yield
    except LapgsError:
        shutil.rmtree(work)
        with suppress(OSError):  # it held something before
            work.parent.rmdir()
        raise


def _find_features(job: _Job, single_camera: bool) -> None:
    options = {
        "photos": str(job.photos.absolute()),
        "names": job.names,
        "camera_model": job.camera_model,
        "single_camera": single_camera,
        "max_size": job.max_size,
        "masks": str(job.masks.absolute()) if job.masks.is_dir() else None,
    }
    _run_step(job, "Finding features", "photos", len(job.names), "features", options, lambda: _rows(job, "descriptors"))


def _match_pairs(job: _Job) -> None:
    count = len(job.names)
    loops = -(-count // LOOP_EVERY) if count >= LOOP_FROM and HAS_VOCABULARY else 0
    total = {
        "exhaustive": count * (count - 1) // 2,
        "sequential": _neighbour_pairs(count) + loops * LOOP_SIMILAR,  # at most
        "retrieval": count * min(SIMILAR, count - 1),  # at most: many pairs are found from both sides
    }[job.matcher]
    options = {
        "matcher": job.matcher,
        "similar": SIMILAR if job.matcher == "retrieval" else LOOP_SIMILAR,
        "every": LOOP_EVERY if loops else 0,
        "tree": str((job.work / "tree.bin").absolute()),
    }
    _run_step(job, "Matching pairs", "pairs", total, "pairs", options, lambda: _rows(job, "two_view_geometries"))


def _neighbour_pairs(count: int) -> int:
    """Return the number of pairs in sequential matching: each photo with those 1, 2, 4, 8, ... ahead."""
    return sum(max(0, count - 2**power) for power in range(pycolmap.SequentialPairingOptions().overlap))


def _place_cameras(job: _Job) -> list[pycolmap.Reconstruction]:
    """Recover the models and return them, the one with most photos first.

    If the default camera model places few photos or gives focal lengths that no lens has, place the cameras again with
    a simpler one.

    Raises:
        SceneError: no photo could be placed.
    """
    models = _map(job, "Placing cameras", job.models)
    if (doubt := _doubt(job, models)) is not None:
        if job.asked_model != AUTO:
            logger.warning("%s; leave out --camera-model %s, or choose SIMPLE_RADIAL", doubt, job.asked_model)
        else:
            models = _placed_again(job, models, doubt)
    if _placed(models) < 2:
        raise SceneError(
            f"{job.photos}: none of the {len(job.names)} photos could be placed; expected sharp photos of a static "
            "scene that overlap strongly, each taken a step aside from the last"
        )
    return models


def _placed_again(job: _Job, models: list[pycolmap.Reconstruction], doubt: str) -> list[pycolmap.Reconstruction]:
    """Return the best models of doubtful ones, those of a simpler lens, and if few are placed, of the other mapper."""
    logger.info("%s; placing the cameras again with a simpler lens", doubt)
    again = _map(job, "Placing again", job.work / "models_simple", SIMPLE_MODEL)
    if _placed(again) >= _placed(models):
        models = again
    if _placed(models) < FEW * len(job.names) and job.mapper == "incremental" and HAS_GLOBAL:
        logger.info("only %d photos could be placed; placing all at once (--mapper global)", _placed(models))
        whole = _map(job, "Placing all", job.work / "models_global", SIMPLE_MODEL, mapper="global")
        return whole if _placed(whole) > _placed(models) else models
    if models is not again:
        logger.warning(
            "with a simpler lens only %d of %d photos could be placed; %s: look at the result with care, or take more "
            "photos from other heights and distances",
            *(_placed(again), _placed(models), doubt),
        )
    return models


def _placed(models: Sequence[pycolmap.Reconstruction]) -> int:
    """Return the number of photos in the largest model."""
    return models[0].num_reg_images() if models else 0


def _doubt(job: _Job, models: Sequence[pycolmap.Reconstruction]) -> str | None:
    """Return why the models may be wrong because the lens was not found; None if nothing says so."""
    if _placed(models) < FEW * len(job.names):
        return f"only {_placed(models)} of {len(job.names)} photos could be placed"
    if (apart := _focal_difference(models[0])) > SQUARE:
        return f"the focal lengths along x and y differ by {apart:.0%}, which no usual lens does"
    return None


def _focal_difference(model: pycolmap.Reconstruction) -> float:
    """Return the largest relative difference of a used camera's focal lengths along x and y."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    cameras = [model.cameras[key] for key in used]
    return max(abs(camera.focal_length_x / camera.focal_length_y - 1.0) for camera in cameras)


def _map(
    job: _Job, title: str, folder: Path, model: str | None = None, mapper: str | None = None
) -> list[pycolmap.Reconstruction]:
    """Recover models into a folder, unless it is there, and return them.

    Args:
        job: the job.
        title: of the progress bar.
        folder: of the models.
        model, mapper: replace the job's.
    """
    if not folder.is_dir():
        unfinished, placed = folder.with_suffix(".partial"), job.work / "placed"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        placed.write_bytes(b"")
        options = {
            "photos": str(job.photos.absolute()),
            "models": str(unfinished),
            "placed": str(placed),
            "mapper": mapper or job.mapper,
        }
        if model is not None:
            other = job.work / "simple.db"
            shutil.copyfile(job.database, other)
            options |= {"database": str(other.absolute()), "camera_model": model}
        _run_step(job, title, "photos", len(job.names), "map", options, lambda: placed.stat().st_size)
        for written in unfinished.iterdir():
            check_written(written)
        unfinished.rename(folder)
    models = [pycolmap.Reconstruction(each) for each in sorted(folder.iterdir())]
    models.sort(key=lambda each: (each.num_reg_images(), each.num_points3D()), reverse=True)
    return models


def _describe(job: _Job, models: Sequence[pycolmap.Reconstruction]) -> PrepareResult:
    best = models[0]
    registered = sorted(image.name for image in best.images.values() if image.has_pose)
    left_out = sorted(set(job.names) - set(registered))
    if left_out:
        logger.warning("%d of %d photos could not be placed: %s", len(left_out), len(job.names), listed(left_out))
        for reason, names in left_out_because(job.database, models, left_out).items():
            logger.warning("%s: %s", listed(names), reason)
        if job.matcher == "sequential" and job.found.clip is None:
            logger.warning("--matcher sequential compares neighbours by name; try --matcher exhaustive")
    return PrepareResult(
        registered=tuple(registered),
        left_out=tuple(left_out),
        parts=len(models),
        points=best.num_points3D(),
        reprojection_error=best.compute_mean_reprojection_error(),
        seconds=job.seconds,
    )


def _write_scene(job: _Job, model: pycolmap.Reconstruction) -> None:
    """Write undistorted photos and the model to the work folder. Images are renamed if their file type changes."""
    shutil.rmtree(job.scene, ignore_errors=True)
    lenses = {key: lens_of(camera, job.max_size) for key, camera in model.cameras.items()}
    images = [image for image in model.images.values() if image.has_pose]
    masked = job.masks.is_dir()

    def write(image: pycolmap.Image) -> None:
        lens = lenses[image.camera_id]
        size, target = (lens.resized.width, lens.resized.height), target_name(image.name)
        photo = read_image(job.photos / image.name, size=size, clamp=False)
        write_image(job.scene / "images" / target, undistort(photo, lens))
        if not masked:
            return
        file = job.masks / f"{image.name}.png"
        mask = read_image(file, size=size) if file.is_file() else torch.ones(3, size[1], size[0])
        write_mask(job.scene / MASKS / f"{target}.png", undistort(mask, lens)[:1] > 0.5)

    _each_photo(job, "Undistorting", write, images)
    for image in images:
        move_observations(image, lenses[image.camera_id])
        image.name = target_name(image.name)
    for key, lens in lenses.items():
        camera = model.cameras[key]
        camera.model, camera.width, camera.height = lens.pinhole.model, lens.pinhole.width, lens.pinhole.height
        camera.params = list(lens.pinhole.params)
    write_model(model, job.scene / "sparse" / "0")


def _move_into_place(work: Path, out: Path) -> None:
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


def _rows(job: _Job, table: str) -> int:
    """Return the number of rows in a table of COLMAP's database, also while COLMAP writes it; 0 before it exists."""
    try:
        connection = sqlite3.connect(f"{job.database.absolute().as_uri()}?mode=ro", uri=True, timeout=POLL_SECONDS)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        finally:
            connection.close()
    except sqlite3.Error:  # locked, or still being made
        return 0


def _run_step(
    job: _Job, title: str, unit: str, total: int, step: str, options: dict[str, Any], done: Callable[[], int]
) -> None:
    """Run a step of `colmap_worker` with a progress bar. An interruption stops it at once.

    Raises:
        LapgsError: it failed, with COLMAP's last error.
    """
    start = time.perf_counter()
    order = json.dumps({"step": step, "database": str(job.database.absolute()), **options})
    log = job.work / "colmap.log"
    with _bar(job, title, unit) as seen, log.open("wb") as words:
        seen(0, total)
        command = [sys.executable, str(WORKER)]
        worker = subprocess.Popen(
            command, bufsize=0, stdin=subprocess.PIPE, stdout=words, stderr=words, start_new_session=True
        )
        assert worker.stdin is not None
        try:
            with suppress(BrokenPipeError):  # reported by its exit code
                worker.stdin.write(order.encode() + b"\n")
            running = True
            while running:
                running = not _ended(worker)
                seen(min(done(), total), total)
        finally:
            worker.kill()
            worker.wait()
            worker.stdin.close()
        if worker.returncode == 0:
            seen(total, total)
    if worker.returncode != 0:
        raise LapgsError(
            f"{job.work.parent}: COLMAP failed at {title.lower()} ({_last_words(log, worker.returncode)}); check free "
            f"space and memory, then repeat the command to continue, or remove {job.work} to start over"
        )
    job.seconds[title] = time.perf_counter() - start


@contextmanager
def _bar(job: _Job, title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar if wanted; the function takes the number of finished items and their total."""
    if not job.progress:
        yield lambda done, total: None
        return
    with item_progress(unit) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _ended(worker: subprocess.Popen[bytes]) -> bool:
    try:
        worker.wait(POLL_SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return True


def _last_words(log: Path, code: int) -> str:
    """Return the reason for a failure: an exception of the worker, COLMAP's last error, or the exit code."""
    lines = log.read_text(errors="replace").splitlines()
    reasons = [line for line in lines if re.match(r"[EF][0-9]{8} |(\w+\.)*\w*(Error|Exception): ", line)]
    return reasons[-1].strip() if reasons else f"exit code {code}"


def _each_photo(job: _Job, title: str, work: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Apply `work` to all items in threads and record the time."""
    start = time.perf_counter()
    threads = min(MAX_DECODERS, os.cpu_count() or 1)
    results = in_threads(title, "photos", work, items, threads=threads, progress=job.progress)
    job.seconds[title] = time.perf_counter() - start
    return results
