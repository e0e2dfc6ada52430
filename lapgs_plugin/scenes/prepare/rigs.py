"""Place photos of a rig: cameras fixed to each other, a subfolder each, whose photos of one name are of one moment.

How the cameras stand to each other is not known. As COLMAP's documentation of rigs says, the photos are placed one by
one first. The mean of their poses is the rig, with which all are placed again; the rig is refined with them.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pycolmap

from lapgs_plugin.errors import SceneError, UserInputError, counted
from lapgs_plugin.scenes.prepare.colmap import Attempt, chosen_matcher, configure_rig, map_photos
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import listed
from lapgs_plugin.scenes.prepare.placement import place_cameras
from lapgs_plugin.scenes.prepare.settings import RIG, SEQUENTIAL

WORSE = 2.0
"""Ratio of reprojection errors, with the rig to without, above which the cameras are not fixed to each other."""
LEAST_KEPT = 0.85
"""Least share of the features with points that a rig keeps. Photos of other moments keep a quarter to two thirds."""
TOLERATED = 1.0
"""Reprojection error in pixels up to which the rig is kept in any case."""

logger = logging.getLogger(__name__)


def check_rig(job: Job) -> None:
    """Check that photos are in subfolders, and that those have photos of the same names.

    Raises:
        SceneError: the folders are not those of a rig.
        UserInputError: an option does not go with a rig.
    """
    folder = job.source.clip or job.source.folder
    if job.source.clip is not None:
        raise SceneError(f"--camera-per {RIG}: {folder} is a video, expected a folder with a subfolder for each camera")
    moments = _moments(job.names)
    sensors = sorted({sensor for names in moments.values() for sensor in names})
    if "" in sensors or len(sensors) < 2:
        present = f"photos beside them ({listed([names[''] for names in moments.values() if '' in names])})"
        if len(sensors) == 1:
            present = f"only {sensors[0]}" if sensors[0] else "photos without subfolders"
        raise SceneError(
            f"--camera-per {RIG}: {folder} has {present}, expected a subfolder for each of two or more cameras"
        )
    # COLMAP tells cameras apart by how names begin.
    if nested := [(one, other) for one in sensors for other in sensors if other.startswith(f"{one}/")]:
        outer, inner = nested[0]
        raise SceneError(
            f"--camera-per {RIG}: {folder} has photos in {outer} and in {inner}, expected folders of cameras beside "
            "each other; move one of them"
        )
    if chosen_matcher(job) == SEQUENTIAL:
        raise UserInputError(
            f"--matcher {SEQUENTIAL} with --camera-per {RIG}: compares neighbours by name, not the cameras of one "
            "moment; expected exhaustive or retrieval"
        )
    shared = sum(len(names) > 1 for names in moments.values())
    if not shared:
        raise SceneError(
            f"--camera-per {RIG}: no photo of {' and '.join(sensors[:2])} has the same name, such as "
            f"{sensors[0]}/{next(iter(moments))}; expected photos of one moment under one name, or give --camera-per "
            "folder if the cameras are not fixed to each other"
        )
    alone = [name for names in moments.values() if len(names) == 1 for name in names.values()]
    if alone:
        logger.warning("photos whose moment no other camera has: %s", listed(alone))
    logger.info(
        "rig of %d cameras (%s), %s of two or more", len(sensors), ", ".join(sensors), counted(shared, "moment")
    )


def place_rig(job: Job) -> list[pycolmap.Reconstruction]:
    """Recover models of the photos of a rig, and return them as `place_cameras` does.

    Where the photos do not fit a rig, their poses without it are kept, and a line says so.
    """
    models = place_cameras(job)
    sensors = _placed_sensors(models[0])
    missing = sorted({_sensor(name) for name in job.names} - set(sensors))
    if missing:
        logger.warning(
            "no photo of %s was placed at a moment at which one of %s was, so the rig is not known, and every photo "
            "keeps its own pose; take more photos in which the cameras see the same",
            " and ".join(missing),
            sensors[0],
        )
        return models
    database = configure_rig(job, [f"{sensor}/" for sensor in sensors], models[0])
    rigged = map_photos(job, Attempt("Placing the rig", "models_rig", database=database))
    rigged.sort(key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)
    if problem := _misfit(models[0], rigged):
        logger.warning(
            "the cameras do not fit a rig (%s), and every photo keeps its own pose; expected cameras that are fixed to "
            "each other and take photos of one name at one moment",
            problem,
        )
        return models
    logger.info("the rig places %d photos, %d without it", rigged[0].num_reg_images(), models[0].num_reg_images())
    return [_without_rig(model) for model in rigged]


def _sensor(name: str) -> str:
    """Return the folder of a photo's camera; empty for a photo without."""
    return name.rpartition("/")[0]


def _moments(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the photos of each moment by camera: their names are equal without the folder."""
    moments: dict[str, dict[str, str]] = {}
    for name in names:
        sensor, _, last = name.rpartition("/")
        moments.setdefault(last, {})[sensor] = name
    return moments


def _placed_sensors(model: pycolmap.Reconstruction) -> list[str]:
    """Return cameras with photos at moments at which one of the first was placed, too; the first has most of those."""
    moments = _moments([image.name for image in model.images.values() if image.has_pose])
    together: Counter[str] = Counter()
    for names in moments.values():
        together.update(dict.fromkeys(names, len(names) - 1))
    first = max(sorted(together), key=together.__getitem__)
    others = {sensor for names in moments.values() if first in names for sensor in names} - {first}
    return [first, *sorted(others)]


def _misfit(free: pycolmap.Reconstruction, rigged: Sequence[pycolmap.Reconstruction]) -> str:
    """Return why a placement with a rig is worse than the one without; empty if it is not."""
    if not rigged or rigged[0].num_reg_images() < free.num_reg_images():
        return f"it places {rigged[0].num_reg_images() if rigged else 0} photos, {free.num_reg_images()} without it"
    kept = rigged[0].compute_num_observations() / max(1, free.compute_num_observations())
    if kept < LEAST_KEPT:
        return f"{kept:.0%} of the features agree with it"
    with_rig, without = rigged[0].compute_mean_reprojection_error(), free.compute_mean_reprojection_error()
    if with_rig > max(TOLERATED, WORSE * without):
        return f"points miss their features by {with_rig:.1f} pixels, {without:.1f} without it"
    return ""


def _without_rig(rigged: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a model whose photos have poses of their own, because the scene's images are turned one by one."""
    model = pycolmap.Reconstruction()
    for camera in rigged.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    for key, image in sorted(rigged.images.items()):
        if image.has_pose:
            pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            own = pycolmap.Image(image.name, keypoints=pixels, camera_id=image.camera_id, image_id=key)
            model.add_image_with_trivial_frame(own, image.cam_from_world())
    for point in rigged.points3D.values():
        model.points3D[model.add_point3D(point.xyz, point.track, point.color)].error = point.error
    return model
