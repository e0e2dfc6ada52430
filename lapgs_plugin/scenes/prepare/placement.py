"""Place the cameras, judge the result, and place them again with a simpler lens or more matches if it is doubtful."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import pycolmap

from lapgs_plugin.errors import SceneError, counted
from lapgs_plugin.scenes.prepare.colmap import HAS_GLOBAL, Attempt, map_photos, match_more
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.photos import listed, quarter_turns
from lapgs_plugin.scenes.prepare.settings import AUTO, GLOBAL, INCREMENTAL
from lapgs_plugin.scenes.prepare.view_graph import (
    ROLLED,
    Seam,
    find_seam,
    placed_images,
    remove_unlinked,
    rolled_images,
)

SIMPLE_MODEL = "SIMPLE_RADIAL"
"""Camera model that is fitted if the result with the first one is doubtful."""
FEW = 0.75
"""Share of placed photos below which another attempt may place more."""
SQUARE = 0.04
"""Largest plausible relative difference of the focal lengths along x and y, because pixels are square."""
EXACT = 0.1
"""Reprojection error in pixels with which features are found at best."""
INEXACT = 1.0
"""Reprojection error in pixels above which the lens is doubtful."""
SAME_ERROR = 1.02
"""Ratio of equal reprojection errors, because a lens with more parameters fits more of the noise."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Placement:
    """Hold the models of an attempt and their seams.

    Attributes:
        models: the one with most photos first, without unlinked photos.
        seams: a sentence for each cut of a model.
    """

    models: list[pycolmap.Reconstruction]
    seams: tuple[str, ...] = ()

    @property
    def photos(self) -> int:
        """Number of photos in the largest model."""
        return self.models[0].num_reg_images() if self.models else 0

    @property
    def error(self) -> float:
        """Mean reprojection error of the largest model in pixels, `EXACT` at least."""
        return max(self.models[0].compute_mean_reprojection_error() if self.models else 0.0, EXACT)

    def is_better_than(self, other: Placement) -> bool:
        """Return whether this attempt is to be kept: twice the photos outweigh four times the error."""
        if self.photos == other.photos:
            return self.error < other.error
        return self.photos**2 * other.error > other.photos**2 * self.error


def place_cameras(job: Job) -> list[pycolmap.Reconstruction]:
    """Recover the models and return them, the one with most photos first.

    If the default camera model places few photos, gives focal lengths that no lens has, or joins groups of photos
    wrongly, the cameras are placed again with a simpler model.

    Raises:
        SceneError: no photo could be placed.
    """
    placement = _placed(job, Attempt("Placing cameras", "models"))
    if (doubt := _doubt(job, placement)) is not None:
        if job.settings.camera_model != AUTO:
            logger.warning("%s; leave out --camera-model %s, or choose SIMPLE_RADIAL", doubt, job.settings.camera_model)
        else:
            placement = _placed_again(job, placement, doubt)
    if placement.photos < 2:
        raise SceneError(
            f"{job.source.clip or job.source.folder}: none of the {len(job.names)} photos could be placed; expected "
            "sharp photos of a static scene that overlap strongly, each taken a step aside from the last"
        )
    for seam in placement.seams:
        logger.warning("%s; only the larger group is kept", seam)
    best = placement.models[0]
    turns = _quarter_turns(job)
    if rolled := rolled_images(best, lambda name: turns[name] or 0):
        names = listed(sorted(best.images[key].name for key in rolled))
        logger.warning(
            f"{len(rolled)} of {placement.photos} photos are rolled by more than {ROLLED:.0f} degrees against the "
            f"others: {names}; if they were taken upright, their places are wrong: look at the result with care"
        )
    return placement.models


def _placed_again(job: Job, first: Placement, doubt: str) -> Placement:
    """Return the best of a doubtful placement, one with a simpler lens, and further ones if few photos are placed."""
    logger.info("%s; placing the cameras again with a simpler lens", doubt)
    again = _placed(job, Attempt("Placing again", "models_simple", SIMPLE_MODEL))
    simpler = again.photos == first.photos and again.error <= SAME_ERROR * first.error
    best = again if simpler or again.is_better_than(first) else first
    if _few(job, best) and job.settings.mapper == INCREMENTAL:
        return _with_more_matches(job, best)
    if best is not again:
        logger.warning(
            f"a simpler lens places {again.photos} of {len(job.names)} photos with an error of {again.error:.2f} "
            f"pixels, not {first.photos} with {first.error:.2f}; {doubt}: look at the result with care, or take more "
            "photos from other heights and distances"
        )
    return best


def _with_more_matches(job: Job, best: Placement) -> Placement:
    """Return the best of this placement and those with more matches, by the incremental and then the global mapper."""
    logger.info("only %d photos could be placed; looking for more matches", best.photos)
    database = match_more(job)
    for mapper, possible in ((INCREMENTAL, database is not None), (GLOBAL, HAS_GLOBAL)):
        if possible and _few(job, best):
            attempt = _placed(job, Attempt(f"Placing ({mapper})", f"models_{mapper}", SIMPLE_MODEL, mapper, database))
            best = attempt if attempt.is_better_than(best) else best
    return best


def _placed(job: Job, attempt: Attempt) -> Placement:
    """Return the placement of an attempt, cut where groups of photos are wrongly joined."""
    models, seams, turns = map_photos(job, attempt), [], _quarter_turns(job)
    held_upright = None not in turns.values()
    for model in models:  # and the parts that are cut off
        remove_unlinked(model)
        while (seam := find_seam(model, lambda name: turns[name] or 0, held_upright)) is not None:
            part = pycolmap.Reconstruction(model)
            models.append(part)
            for kept, gone in ((part, set(placed_images(model)) - set(seam.apart)), (model, seam.apart)):
                for key in gone:
                    kept.deregister_frame(kept.images[key].frame_id)
            seams.append(_seam_words(part, model, seam))
            remove_unlinked(model)
    models.sort(key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)
    return Placement(models, tuple(seams))


def _seam_words(part: pycolmap.Reconstruction, rest: pycolmap.Reconstruction, seam: Seam) -> str:
    """Return a sentence about the groups at a seam."""
    names = listed(sorted(part.images[key].name for key in seam.apart))
    common, others = counted(seam.points, "point"), f"{rest.num_reg_images()} others"
    if seam.angle is None:
        return f"{len(seam.apart)} photos ({names}) share only {common} with {others}"
    return f"{len(seam.apart)} photos ({names}) are turned by {seam.angle:.0f} degrees against {others}, on {common}"


def _quarter_turns(job: Job) -> dict[str, int | None]:
    """Return the quarter turns that make each photo upright by EXIF."""
    return {name: quarter_turns(job.photo(name)) for name in job.names}


def _few(job: Job, placement: Placement) -> bool:
    """Return whether less than a share `FEW` of the photos is placed."""
    return placement.photos < FEW * len(job.names)


def _doubt(job: Job, placement: Placement) -> str | None:
    """Return the evidence of a wrong lens; None without any."""
    if placement.seams:
        return placement.seams[0]
    if _few(job, placement):
        return f"only {placement.photos} of {len(job.names)} photos could be placed"
    if (apart := _focal_difference(placement.models[0])) > SQUARE:
        return f"the focal lengths along x and y differ by {apart:.0%}, which no usual lens does"
    if placement.error > INEXACT:
        return f"the points miss their features by {placement.error:.1f} pixels"
    return None


def _focal_difference(model: pycolmap.Reconstruction) -> float:
    """Return the largest relative difference of a used camera's focal lengths along x and y."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    cameras = [model.cameras[key] for key in used]
    return max(abs(camera.focal_length_x / camera.focal_length_y - 1.0) for camera in cameras)
