"""Place the cameras, judge the result, and place them again with a simpler lens or more matches if it is doubtful."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.prepare.colmap import HAS_GLOBAL, Attempt, map_photos, match_more
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.settings import AUTO, GLOBAL, INCREMENTAL

SIMPLE_MODEL = "SIMPLE_RADIAL"
"""Camera model that is fitted if the result with the first one is doubtful."""
FEW = 0.75
"""Share of photos below which so few are placed that another attempt may place more."""
LINKED = 15
"""Fewest points that two photos share if one's place says where the other is, as in COLMAP's mapper."""
SQUARE = 0.04
"""Largest relative difference of the focal lengths along x and y that is believed: pixels are square."""

logger = logging.getLogger(__name__)


def place_cameras(job: Job) -> list[pycolmap.Reconstruction]:
    """Recover the models and return them, the one with most photos first.

    If the default camera model places few photos or gives focal lengths that no lens has, place the cameras again with
    a simpler one.

    Raises:
        SceneError: no photo could be placed.
    """
    models = _mapped(job, Attempt("Placing cameras", "models"))
    if (doubt := _doubt(job, models)) is not None:
        if job.settings.camera_model != AUTO:
            logger.warning("%s; leave out --camera-model %s, or choose SIMPLE_RADIAL", doubt, job.settings.camera_model)
        else:
            models = _placed_again(job, models, doubt)
    if _placed(models) < 2:
        raise SceneError(
            f"{job.found.clip or job.found.folder}: none of the {len(job.names)} photos could be placed; expected "
            "sharp photos of a static scene that overlap strongly, each taken a step aside from the last"
        )
    return models


def _placed_again(job: Job, models: list[pycolmap.Reconstruction], doubt: str) -> list[pycolmap.Reconstruction]:
    """Return the best of doubtful models, those of a simpler lens, and if few are placed, of further attempts."""
    logger.info("%s; placing the cameras again with a simpler lens", doubt)
    again = _mapped(job, Attempt("Placing again", "models_simple", SIMPLE_MODEL))
    if _placed(again) >= _placed(models):
        models = again
    if _few(job, models) and job.settings.mapper == INCREMENTAL:
        return _with_more_matches(job, models)
    if models is not again:
        logger.warning(
            "with a simpler lens only %d of %d photos could be placed; %s: look at the result with care, or take more "
            "photos from other heights and distances",
            *(_placed(again), _placed(models), doubt),
        )
    return models


def _with_more_matches(job: Job, models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Return the best of these models and those with more matches, by the incremental and then the global mapper."""
    logger.info("only %d photos could be placed; looking for more matches", _placed(models))
    database = match_more(job)
    for mapper, possible in ((INCREMENTAL, database is not None), (GLOBAL, HAS_GLOBAL)):
        if possible and _few(job, models):
            attempt = Attempt(f"Placing ({mapper})", f"models_{mapper}", SIMPLE_MODEL, mapper, database)
            models = max(models, _mapped(job, attempt), key=_placed)  # the earlier ones if both place as many
    return models


def _mapped(job: Job, attempt: Attempt) -> list[pycolmap.Reconstruction]:
    """Return the models of an attempt, the one with most photos first, without photos whose place is arbitrary."""
    models = map_photos(job, attempt)
    for model in models:
        remove_unlinked(model)
    return sorted(models, key=lambda each: (each.num_reg_images(), each.num_points3D()), reverse=True)


def remove_unlinked(model: pycolmap.Reconstruction) -> None:
    """Leave only the largest group of photos that are linked by shared points.

    COLMAP's global mapper places photos by their rotations even if no points confirm it, and its incremental mapper
    places some by a few wrong points.
    """
    placed = sorted(key for key, image in model.images.items() if image.has_pose)
    seen = [
        (row, np.searchsorted(placed, each.image_id))
        for row, point in enumerate(model.points3D.values())
        for each in point.track.elements
    ]
    rows, columns = np.array(seen, dtype=np.int64).reshape(-1, 2).T  # (n), (n)
    sees = coo_array((np.ones(len(rows), np.int64), (rows, columns)), (model.num_points3D(), len(placed))).tocsr()
    shared = (sees.T @ sees).tocoo()  # (photos, photos)
    links = coo_array(((shared.data >= LINKED), (shared.row, shared.col)), shared.shape).tocsr()
    links.eliminate_zeros()
    _, groups = connected_components(links, directed=False)
    largest = np.bincount(groups, minlength=1).argmax()
    for key, group in zip(placed, groups, strict=True):
        if group != largest:
            model.deregister_frame(model.images[key].frame_id)


def _few(job: Job, models: Sequence[pycolmap.Reconstruction]) -> bool:
    """Return whether so few photos are placed that another attempt may place more."""
    return _placed(models) < FEW * len(job.names)


def _placed(models: Sequence[pycolmap.Reconstruction]) -> int:
    """Return the number of photos in the largest model."""
    return models[0].num_reg_images() if models else 0


def _doubt(job: Job, models: Sequence[pycolmap.Reconstruction]) -> str | None:
    """Return why the models may be wrong because the lens was not found; None if nothing says so."""
    if _few(job, models):
        return f"only {_placed(models)} of {len(job.names)} photos could be placed"
    if (apart := _focal_difference(models[0])) > SQUARE:
        return f"the focal lengths along x and y differ by {apart:.0%}, which no usual lens does"
    return None


def _focal_difference(model: pycolmap.Reconstruction) -> float:
    """Return the largest relative difference of a used camera's focal lengths along x and y."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    cameras = [model.cameras[key] for key in used]
    return max(abs(camera.focal_length_x / camera.focal_length_y - 1.0) for camera in cameras)
