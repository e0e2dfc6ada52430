"""Prune the least visible Gaussians of a checkout's model when a stage's densification ends."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.pruning import blended_pixels, least_blended
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.stage_views import StageViews

DENSIFICATION = ("densify_from_iter", "densify_until_iter")
"""Options of the family for the iterations between which its scripts densify."""


def pruning_iteration(call: TrainingCall) -> int | None:
    """Return the first iteration of a stage after densification; None if densification does not end in the stage."""
    first, until = (getattr(call.opt, name, 0) for name in DENSIFICATION)
    return until if first < until < call.opt.iterations else None


def require_pruning(call: TrainingCall, share: float, model: type) -> None:
    """Check that densification ends within a run that is to be pruned then, by a method of its model.

    Raises:
        UserInputError: it does not, so that --prune would change nothing; or the method needs more than a mask.
    """
    if not share:
        return
    try:
        inspect.signature(getattr(model, "prune_points", None)).bind(None, None)  # type: ignore[arg-type]  # is refused
    except TypeError as error:
        raise UserInputError(
            f"--prune {share}: {model.__name__} of the checkout has no prune_points() that takes a mask alone "
            f"({error}); leave --prune out"
        ) from error
    if pruning_iteration(call) is None:
        options = ", ".join(f"--{name} {getattr(call.opt, name, 'missing')}" for name in (*DENSIFICATION, "iterations"))
        raise UserInputError(
            f"--prune {share}: prunes when densification ends, which it does not in this run ({options}); expected an "
            "end between its start and the last iteration: leave --prune out, or change these options of the script"
        )


def prune_least_visible(views: StageViews, gaussians: Any, share: float, path: ColorPath) -> None:
    """Prune the least visible Gaussians, together `share` of total visibility, by the checkout's own method."""
    pixels = _visibility(views, gaussians, path)
    gaussians.tmp_radii = gaussians.max_radii2D  # some checkouts prune it, too, and set it only while they densify
    with torch.no_grad():
        gaussians.prune_points(least_blended(pixels, share))
    gaussians.tmp_radii = None


def _visibility(views: StageViews, gaussians: Any, path: ColorPath) -> Tensor:
    """Return `pruning.blended_pixels` (n,) of the model over the training views."""
    alone = StageRendering(signed=False, path=path, views={}, capture=True)
    colors, degree = gaussians._features_dc, gaussians.active_sh_degree
    grey = torch.nn.Parameter(torch.zeros_like(colors))
    images = (views.render_alone(alone, gaussians, key).image for key in views.train)
    try:
        gaussians._features_dc, gaussians.active_sh_degree = grey, 0
        return blended_pixels(images, grey)
    finally:
        gaussians._features_dc, gaussians.active_sh_degree = colors, degree
