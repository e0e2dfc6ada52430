"""Make a scene from a folder of photos: structure from motion and undistortion with pycolmap.

OUT/images/            undistorted photos under their own names
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
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pycolmap

from lapgs_plugin.errors import LapgsError, SceneError, UserInputError, printable
from lapgs_plugin.files import atomic_write
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.progress import item_progress
from lapgs_plugin.scenes.images import check_image, read_image, write_image
from lapgs_plugin.scenes.output import check_output, check_written, one_line_errors, write_model
from lapgs_plugin.scenes.parallel import in_threads
from lapgs_plugin.scenes.undistort import lens_of, move_observations, undistort
from lapgs_plugin.untrusted import read_json

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

MATCHERS = ("exhaustive", "sequential")
CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
)
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
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
    matcher: str = "exhaustive",
    camera_model: str = "OPENCV",
    single_camera: bool | None = None,
    max_size: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> PrepareResult:
    """Find features, match them, recover cameras and points, and write undistorted photos with a PINHOLE model.

    Call it again with the same photos and settings to continue an interrupted call. On one machine, photos with fewer
    than 25,000 features in total give the same scene each time. With more features, the timing of COLMAP's threads
    decides which photos it starts from and in which order it sums. COLMAP's GPU code is used if pycolmap has it.

    Args:
        photos: folder of at least 2 JPEG, PNG, TIFF, BMP or WebP files, also in subfolders.
        out: the scene folder; new, empty, with unfinished work, or with `overwrite` a scene.
        matcher: "exhaustive" matches all pairs, "sequential" neighbours in name order (frames of a video).
        camera_model: COLMAP's name of the camera model to fit, one of `CAMERA_MODELS`.
        single_camera: fit one camera to all photos. None: do so if they have the same size.
        max_size: longest side in pixels of the scene's images and for feature extraction. None keeps the photos' size.
        overwrite: replace the scene in `out`, and discard unfinished work of other photos or settings.
        progress: show a bar for each step on stderr.

    Raises:
        SceneError: there are too few photos, one cannot be read, or none could be registered.
        UserInputError: an argument is out of range or `out` must not be written to.
        LapgsError: the disk is full, the folder cannot be written, or COLMAP failed.
    """
    _check_arguments(photos, out, matcher, camera_model, max_size)
    check_output(out, overwrite, WORK)
    job = _Job(out / WORK, photos, _find_photos(photos), matcher, camera_model, max_size, progress)
    sizes = _read_sizes(job)
    single_camera = _one_camera(photos, sizes, single_camera)
    with one_line_errors(out):
        _open_work(job, single_camera, overwrite)
        _find_features(job, single_camera)
        _match_pairs(job)
        models = _map(job)
        result = _describe(job, models)
        _write_scene(job, models[0])
        _move_into_place(job.work, out)
    return result


@dataclass(frozen=True)
class _Job:
    """Arguments and folders that all steps share."""

    work: Path
    photos: Path
    names: tuple[str, ...]
    matcher: str
    camera_model: str
    max_size: int | None
    progress: bool
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def database(self) -> Path:
        return self.work / "database.db"

    @property
    def models(self) -> Path:
        return self.work / "models"

    @property
    def scene(self) -> Path:
        return self.work / "scene"


def _check_arguments(photos: Path, out: Path, matcher: str, camera_model: str, max_size: int | None) -> None:
    if matcher not in MATCHERS:
        raise UserInputError(f"--matcher {matcher!r}: expected {' or '.join(MATCHERS)}")
    if camera_model not in CAMERA_MODELS:
        raise UserInputError(f"--camera-model {camera_model!r}: expected one of {', '.join(CAMERA_MODELS)}")
    if max_size is not None and max_size < MIN_SIDE:
        raise UserInputError(f"--max-size {max_size}: expected at least {MIN_SIDE} pixels")
    if not photos.is_dir():
        raise SceneError(f"{photos}: no such folder of photos")
    source, target = photos.resolve(), out.resolve()
    if source.is_relative_to(target) or target.is_relative_to(source):
        raise UserInputError(
            f"{out}: one of the folders {photos} and {out} lies in the other; write OUT somewhere else"
        )


def _find_photos(photos: Path) -> tuple[str, ...]:
    """Return the names of all photos relative to the folder, sorted.

    Raises:
        SceneError: there are fewer than two, or two would have the same name after undistortion.
    """
    files = [file for file in photos.rglob("*") if file.is_file() and not file.name.startswith(".")]
    names = sorted(file.relative_to(photos).as_posix() for file in files if file.suffix.lower() in SUFFIXES)
    if len(names) < 2:
        others = sorted({file.suffix.lower() for file in files} - set(SUFFIXES))
        found = f" (and files of type {', '.join(others)})" if others else ""
        raise SceneError(
            f"{photos}: {len(names)} photos{found}, expected at least 2, better 30, as JPEG, PNG, TIFF, BMP or WebP"
        )
    by_target: dict[str, str] = {}
    for name in names:
        if (other := by_target.setdefault(_target_name(name), name)) != name:
            raise SceneError(f"{photos}: {other} and {name} would both become {_target_name(name)}; rename one of them")
    return tuple(names)


def _target_name(name: str) -> str:
    """Return the name of the undistorted image: JPEG stays JPEG, all else becomes PNG."""
    path = Path(name)
    return name if path.suffix.lower() in (".jpg", ".jpeg") else path.with_suffix(".png").as_posix()


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


def _one_camera(photos: Path, sizes: dict[str, tuple[int, int]], asked: bool | None) -> bool:
    """Return whether all photos share a camera."""
    names = {size: name for name, size in sizes.items()}
    if asked and len(names) > 1:
        (first, one), (second, other) = list(names.items())[:2]
        raise UserInputError(
            f"--single-camera: {photos / one} has {first[0]}x{first[1]} pixels and {photos / other} "
            f"{second[0]}x{second[1]}, expected one size; leave the option out"
        )
    return len(names) == 1 if asked is None else asked


def _open_work(job: _Job, single_camera: bool, overwrite: bool) -> None:
    """Make the work folder, or reuse that of the same photos and settings."""
    stats = {name: (job.photos / name).stat() for name in job.names}
    settings = {
        "photos": {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()},
        "--matcher": job.matcher,
        "--camera-model": job.camera_model,
        "--single-camera": single_camera,
        "--max-size": job.max_size,
        "pycolmap": pycolmap.__version__,
    }
    file = job.work / "settings.json"
    if file.is_file():
        before = read_json(file, dict[str, Any], advice=f"delete {job.work} to start over")
        changed = [key for key in settings if before.get(key) != settings[key]]
        if not changed:
            return
        if not overwrite:
            raise UserInputError(
                f"{job.work}: unfinished work with other {', '.join(changed)}; repeat the command as it was to "
                "finish it, or start over with --overwrite"
            )
    if job.work.exists():
        shutil.rmtree(job.work)
    job.work.mkdir(parents=True)
    with atomic_write(file) as stream:
        stream.write(json.dumps(settings).encode())


def _find_features(job: _Job, single_camera: bool) -> None:
    options = {
        "photos": str(job.photos.absolute()),
        "names": job.names,
        "camera_model": job.camera_model,
        "single_camera": single_camera,
        "max_size": job.max_size,
    }
    _run_step(job, "Finding features", "photos", len(job.names), "features", options, lambda: _rows(job, "descriptors"))


def _match_pairs(job: _Job) -> None:
    count = len(job.names)
    total = count * (count - 1) // 2 if job.matcher == "exhaustive" else _neighbour_pairs(count)
    options = {"matcher": job.matcher}
    _run_step(job, "Matching pairs", "pairs", total, "pairs", options, lambda: _rows(job, "two_view_geometries"))


def _neighbour_pairs(count: int) -> int:
    """Return the number of pairs in sequential matching: each photo with those 1, 2, 4, 8, ... ahead."""
    return sum(max(0, count - 2**power) for power in range(pycolmap.SequentialPairingOptions().overlap))


def _map(job: _Job) -> list[pycolmap.Reconstruction]:
    """Recover the models and return them, the one with most photos first.

    Raises:
        SceneError: no photo could be placed.
    """
    if not job.models.is_dir():
        unfinished, placed = job.work / "models.partial", job.work / "placed"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        placed.write_bytes(b"")
        options = {"photos": str(job.photos.absolute()), "models": str(unfinished), "placed": str(placed)}
        _run_step(job, "Placing cameras", "photos", len(job.names), "map", options, lambda: placed.stat().st_size)
        for folder in unfinished.iterdir():
            check_written(folder)
        unfinished.rename(job.models)
    models = [pycolmap.Reconstruction(folder) for folder in sorted(job.models.iterdir())]
    models.sort(key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)
    if not models or models[0].num_reg_images() < 2:
        raise SceneError(
            f"{job.photos}: none of the {len(job.names)} photos could be placed; expected sharp photos of a static "
            "scene that overlap strongly, each taken a step aside from the last"
        )
    return models


def _describe(job: _Job, models: Sequence[pycolmap.Reconstruction]) -> PrepareResult:
    best = models[0]
    registered = sorted(image.name for image in best.images.values() if image.has_pose)
    left_out = sorted(set(job.names) - set(registered))
    if left_out:
        named = ", ".join(left_out[:10]) + (f" and {len(left_out) - 10} more" if len(left_out) > 10 else "")
        logger.warning("%d of %d photos could not be placed: %s", len(left_out), len(job.names), printable(named))
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

    def write(image: pycolmap.Image) -> None:
        lens = lenses[image.camera_id]
        photo = read_image(job.photos / image.name, size=(lens.resized.width, lens.resized.height), clamp=False)
        write_image(job.scene / "images" / _target_name(image.name), undistort(photo, lens))

    _each_photo(job, "Undistorting", write, images)
    for image in images:
        move_observations(image, lenses[image.camera_id])
        image.name = _target_name(image.name)
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
    for name in ("sparse", "images"):
        if (out / name).exists():
            (out / name).rename(replaced / name)
    for name in ("images", "sparse"):
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
    bar = item_progress(unit) if job.progress else None
    log = job.work / "colmap.log"
    with bar or nullcontext(), log.open("wb") as words:
        task = bar.add_task(title, total=total) if bar else None
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
                if bar and task is not None:
                    bar.update(task, completed=min(done(), total))
        finally:
            worker.kill()
            worker.wait()
            worker.stdin.close()
    if worker.returncode != 0:
        raise LapgsError(
            f"{job.work.parent}: COLMAP failed at {title.lower()} ({_last_words(log, worker.returncode)}); check free "
            f"space and memory, then repeat the command to continue, or remove {job.work} to start over"
        )
    job.seconds[title] = time.perf_counter() - start


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
