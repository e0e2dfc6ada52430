"""Plan the stages of a run, and check its settings against the photos and the device."""

from __future__ import annotations

import torch

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.training.quality import require_views_to_set_aside
from lapgs_plugin.training.settings import BEST, TrainSettings


def make_plan(size: tuple[int, int], settings: TrainSettings, views: int | None = None) -> StagePlan:
    """Return the stages of a run on images of this size (width, height), which is `Scene.smallest_size`.

    Args:
        size: (width, height).
        settings: of the run.
        views: number of training views; None if unknown.

    Raises:
        UserInputError: levels, split and image size do not go together, or there are too few views for a step or for
            --keep best.
    """
    if views is not None and (asked := settings.asked_views or 1) > views:
        raise UserInputError(
            f"--views-per-step {asked}: the scene has {views} training views; give at most as many, or auto"
        )
    if views is not None and settings.keep == BEST:
        require_views_to_set_aside(views)
    return StagePlan.create(size, settings.scheduled, settings.levels, settings.shares, settings.kind)


def check_storage(settings: TrainSettings, device: torch.device) -> None:
    """Check that the device of a run has the place that the settings name for images.

    Raises:
        UserInputError: it has not.
    """
    if settings.images_on == "gpu" and device.type != "cuda":
        raise UserInputError("--images-on gpu: expected memory or disk, as a CPU trains this run")
