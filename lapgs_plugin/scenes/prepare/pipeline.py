"""Make a scene, one step after the other; steps that an interrupted call had finished are not repeated."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import option_values
from lapgs_plugin.scenes.output import check_output, writing_explained
from lapgs_plugin.scenes.prepare.colmap import chosen_matcher, find_features, match_pairs, require_colmap_for
from lapgs_plugin.scenes.prepare.inputs import camera_mode, make_masks, make_photos, read_sizes
from lapgs_plugin.scenes.prepare.job import WORK, Job, opened_work
from lapgs_plugin.scenes.prepare.known_cameras import KnownCameras, find_known_cameras, read_known_cameras
from lapgs_plugin.scenes.prepare.left_out import few_points, left_out_because
from lapgs_plugin.scenes.prepare.panoramas import are_panoramas, place_panoramas
from lapgs_plugin.scenes.prepare.photos import Photos, find_photos, listed
from lapgs_plugin.scenes.prepare.placement import place_cameras
from lapgs_plugin.scenes.prepare.rigs import check_rig, place_rig
from lapgs_plugin.scenes.prepare.settings import RIG, SEQUENTIAL, PrepareSettings
from lapgs_plugin.scenes.prepare.writing import move_into_place, write_scene

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PrepareResult:
    """Hold the outcome of `prepare_scene`.

    Attributes:
        registered: names of the photos that have a pose, sorted.
        left_out: names of the other photos, sorted.
        parts: number of separate models; the scene is the largest one.
        points: number of sparse points.
        reprojection_error: mean in pixels of the photos before undistortion; 0 for an existing model without errors.
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
    settings: PrepareSettings | None = None,
    *,
    overwrite: bool = False,
    progress: bool = True,
) -> PrepareResult:
    """Find features, match them, recover cameras and points, and write undistorted photos with a PINHOLE model.

    Photos with a model, of COLMAP or in a transforms file, are only undistorted.

    Call it again with the same photos and settings to continue an interrupted call. On one machine, photos with fewer
    than 25,000 features in total give the same scene each time. With more features, the timing of COLMAP's threads
    decides which photos it starts from and in which order it sums. COLMAP's GPU code is used if pycolmap has it.

    Args:
        photos: folder of at least 2 JPEG, PNG, TIFF, BMP, WebP or HEIC files, also in subfolders; or a video; or the
            folder of a model and its photos.
        out: the scene folder; new, empty, with unfinished work, or with `overwrite` a scene.
        settings: of the user; None takes the defaults.
        overwrite: replace the scene in `out`, and discard unfinished work of other photos or settings.
        progress: show a bar for each step on stderr.

    Raises:
        SceneError: there are too few photos, one or its mask cannot be read, or none could be registered.
        UserInputError: a setting does not fit the photos or pycolmap, or `out` must not be written to.
        LapgsError: the disk is full, the folder cannot be written, or COLMAP failed.
        MissingExtraError: a package that reads videos or HEIC photos is missing.
    """
    pycolmap.logging.logtostderr = True  # and not to files in /tmp as well
    settings = settings or PrepareSettings()
    _check_folders(photos, out, settings, overwrite)
    if (folder := find_known_cameras(photos, settings)) is not None:
        return _undistort(read_known_cameras(folder, photos, settings), out, overwrite, progress)
    require_colmap_for(settings)
    source = find_photos(photos, settings.masks)
    if settings.frames is not None and source.clip is None:
        raise UserInputError(
            f"--frames {settings.frames}: it picks frames from a video, and {photos} is a folder; leave it out"
        )
    with writing_explained(out):
        job = Job(out / WORK, source, settings, progress)
        with opened_work(job.work, _identity(source, settings), overwrite):
            make_photos(job)
            sizes = read_sizes(job)
            panoramas = are_panoramas(job, sizes)
            mode = camera_mode(job, sizes)
            if settings.camera_per == RIG:
                check_rig(job)
            make_masks(job)
        if panoramas:
            model, parts = place_panoramas(job, sizes[job.names[0]])
            result = _describe_panoramas(job, model, parts)
        else:
            find_features(job, mode)
            match_pairs(job)
            models = place_rig(job) if settings.camera_per == RIG else place_cameras(job)
            model, result = models[0], _describe(job, models)
        write_scene(job, model)
        move_into_place(job.work, out)
    return result


def _undistort(known: KnownCameras, out: Path, overwrite: bool, progress: bool) -> PrepareResult:
    """Write the scene of an existing model."""
    model, registered = known.model, tuple(frame.name for frame in known.frames)
    points, error = model.num_points3D(), model.compute_mean_reprojection_error()
    with writing_explained(out):
        job = Job(out / WORK, known.photos, known.settings, progress)
        with opened_work(job.work, _identity(known.photos, known.settings), overwrite):
            known.check_sizes(read_sizes(job, decode=False))
            make_masks(job)
            write_scene(job, model)
        move_into_place(job.work, out)
    return PrepareResult(registered, known.left_out, 1, points, error, job.seconds)


def _check_folders(photos: Path, out: Path, settings: PrepareSettings, overwrite: bool) -> None:
    # Path.resolve raises for a link to itself.
    source, target = (Path(os.path.realpath(path)) for path in (photos, out))
    if source.is_relative_to(target) or target.is_relative_to(source):
        raise UserInputError(f"{out}: one of {photos} and {out} lies in the other; write OUT somewhere else")
    check_output(out, overwrite, WORK)
    if settings.masks is not None and not settings.masks.is_dir():
        raise UserInputError(f"--masks {settings.masks}: no such folder of masks; leave it out to use the whole photos")


def _identity(source: Photos, settings: PrepareSettings) -> dict[str, Any]:
    """Return files, options and version, as JSON, which must be equal for unfinished work to be continued."""
    files = {source.clip.name: source.clip} if source.clip is not None else source.files
    stats = {name: path.stat() for name, path in files.items()}
    options = {
        f"--{name.replace('_', '-')}": str(value.absolute()) if isinstance(value, Path) else value
        for name, value in option_values(settings).items()
    }
    return {
        "photos": {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()},
        **options,
        "pycolmap": pycolmap.__version__,
    }


def _describe_panoramas(job: Job, model: pycolmap.Reconstruction, parts: int) -> PrepareResult:
    registered = sorted(image.name for image in model.images.values())
    left_out = sorted(set(job.names) - set(registered))
    if left_out:
        logger.warning(
            "%d of %d panoramas could not be placed: %s; take more in between, each a step aside from the last",
            len(left_out),
            len(job.names),
            listed(left_out),
        )
    return _result(job, model, registered, left_out, parts)


def _describe(job: Job, models: Sequence[pycolmap.Reconstruction]) -> PrepareResult:
    best = models[0]
    registered = sorted(image.name for image in best.images.values() if image.has_pose)
    left_out = sorted(set(job.names) - set(registered))
    if left_out:
        logger.warning("%d of %d photos could not be placed: %s", len(left_out), len(job.names), listed(left_out))
        for reason, names in left_out_because(job.database, models, left_out).items():
            logger.warning("%s: %s", listed(names), reason)
        if chosen_matcher(job) == SEQUENTIAL and job.source.clip is None:
            logger.warning("--matcher sequential compares neighbours by name; try --matcher exhaustive")
    return _result(job, best, registered, left_out, len(models))


def _result(
    job: Job, model: pycolmap.Reconstruction, registered: Sequence[str], left_out: Sequence[str], parts: int
) -> PrepareResult:
    if warning := few_points(model.num_points3D(), len(registered)):
        logger.warning(warning)
    return PrepareResult(
        registered=tuple(registered),
        left_out=tuple(left_out),
        parts=parts,
        points=model.num_points3D(),
        reprojection_error=model.compute_mean_reprojection_error(),
        seconds=job.seconds,
    )
