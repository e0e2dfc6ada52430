"""Remove floaters and everything outside of a crop from a run's levels, and measure what that changes.

A floater is a Gaussian in front of the surface that other views see. A training view sees a Gaussian if its blending
weights alpha T there sum to `SEEN` of the sum in its best view or more. The surface is the depth of the Gaussians that
at least `FEWEST_VIEWS` views see. A Gaussian is a floater if fewer views see it, and if more than half of its blending
weights lie in pixels with an opaque surface that is clearly farther away.

Every nested level has a surface of its own. Residuals have no opacity of their own in the composed image, whose surface
is that of the base.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError, counted
from lapgs_plugin.evaluation.figures import level_psnrs, photo_looks
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.crop import Crop
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_depths
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS, rasterizer_for
from lapgs_plugin.rendering.field_renderer import FieldOffload
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import run_scene
from lapgs_plugin.runs.archive import RunArchive

FEWEST_VIEWS = 3
"""Views that have to see a Gaussian for it to belong to a surface."""

SEEN = 0.02
"""Share of a Gaussian's blending weight in its best view from which another view sees it: from seven times as far."""

OPAQUE = 0.9
"""Least opacity of a pixel that shows a surface."""

CLEARLY = 0.1
"""Share of the surface's depth by which a floater is nearer."""


@dataclass(frozen=True)
class CleanedLevel:
    """Hold a cleaned level.

    Attributes:
        field: what is left.
        floaters, outside: numbers of Gaussians that were removed as floaters, and outside of the crop.
        psnr: in dB of the training views before and after, at the level's size and with all coarser levels cleaned.
    """

    field: GaussianField
    floaters: int
    outside: int
    psnr: tuple[float, float]


def clean_levels(
    archive: RunArchive,
    fields: Mapping[int, GaussianField],
    moved_to: Path | None = None,
    *,
    floaters: bool,
    crop: Crop | None = None,
) -> tuple[dict[int, CleanedLevel], int]:
    """Remove floaters, and Gaussians with their centre outside of a crop.

    Args:
        archive: the run.
        fields: by level, contiguous from the coarsest one; or one field at level 0 that was merged.
        moved_to: the scene's folder now; None if it did not move.
        floaters: whether to look for them.
        crop: to stay inside of; None for no limit.

    Returns:
        The cleaned levels, and the number of training views.

    Raises:
        UserInputError: nothing is left of a level that had Gaussians.
        RunFolderError, SceneError: the scene cannot be read.
    """
    manifest = archive.manifest
    inside = {level: _inside(field, level, crop) for level, field in fields.items()}
    levels = max(fields) + 1  # one of a merged field
    if levels < manifest.levels:  # such a field is fitted without the settings of the run's rasterizer
        manifest = replace(manifest, settings={**manifest.settings, RASTER_SETTINGS: {}})
    placed = rasterizer_for(manifest)
    before = HierarchyRenderer.of(manifest, fields, placed.rasterizer, FieldOffload(placed.device), levels)
    with one_pool():
        scene = run_scene(archive, moved_to)
        cameras = [view.camera for view in scene.train]
        nothing = {level: torch.zeros_like(mask) for level, mask in inside.items()}
        floating = find_floaters(before, cameras) if floaters else nothing
        left = {level: fields[level].kept(inside[level] & ~floating[level]) for level in fields}
        for level, field in left.items():
            if len(fields[level]) and not len(field):
                raise UserInputError(_nothing_left(level, int(inside[level].sum()), crop))
        after = replace(before, fields=left, offload=FieldOffload(placed.device))
        looks = photo_looks(archive, [view.name for view in scene.train])
        both = []
        with item_progress("views") as progress:
            for view in progress.track(scene.train, description="Measuring training views"):
                both.append([level_psnrs(view, one, looks[view.name]) for one in (before, after)])
    cleaned = {}
    for level, field in left.items():
        psnrs = [fmean(pair[which][level] for pair in both) for which in (0, 1)]
        gone = int((floating[level] & inside[level]).sum())
        cleaned[level] = CleanedLevel(field, gone, int((~inside[level]).sum()), (psnrs[0], psnrs[1]))
    return cleaned, len(cameras)


def _inside(field: GaussianField, level: int, crop: Crop | None) -> Tensor:
    """Return which Gaussians a crop keeps, (n,) bool; refuse one that keeps none."""
    if crop is None:
        return torch.ones(len(field), dtype=torch.bool)
    inside = crop.contains(field.means)
    if len(field) and not bool(inside.any()):
        low, high = np.quantile(field.means.numpy(), (0.1, 0.9), axis=0).tolist()
        raise UserInputError(
            f"--crop {crop.text}: none of the {len(field):,} Gaussians of level {level} is inside; expected some of "
            f"them, most are in the box {','.join(f'{value:.3g}' for value in (*low, *high))}; see `lapgs view --crop`"
        )
    return inside


def _nothing_left(level: int, inside: int, crop: Crop | None) -> str:
    """Describe a level of which all Gaussians inside of the crop are floaters; an empty file would show nothing."""
    where = "" if crop is None else f" inside of --crop {crop.text}"
    larger = "" if crop is None else ", or choose a larger --crop"
    return (
        f"--clean: all {counted(inside, 'Gaussian')} of level {level}{where} are floaters, expected some that are not; "
        f"export it without --clean{larger}"
    )


def find_floaters(renderer: HierarchyRenderer, cameras: Sequence[Camera]) -> dict[int, Tensor]:
    """Return which Gaussians are floaters, as the module's docstring defines them: (n,) bool on the CPU by level.

    One view is rendered at a time, so that memory does not grow with their number.
    """
    floaters, surface = {}, None
    for level in sorted(renderer.fields, reverse=True):
        field, at_level = renderer.field(level).detach(), [level_camera(camera, level) for camera in cameras]
        with item_progress("views") as progress:
            few = seen_by_few(
                renderer.rasterizer, field, progress.track(at_level, description=f"Level {level}: seen Gaussians")
            )
            if surface is None or not field.signed:
                surface = field.kept(~few)
            tracked = progress.track(at_level, description=f"Level {level}: floaters")
            share = share_in_front(renderer.rasterizer, field, surface, tracked)
        floaters[level] = (few & (share > 0.5)).cpu()
    return floaters


def seen_by_few(rasterizer: Rasterizer, field: GaussianField, cameras: Iterable[Camera]) -> Tensor:
    """Return which Gaussians fewer than `FEWEST_VIEWS` views see, (n,) bool."""
    most = field.means.new_zeros(len(field), FEWEST_VIEWS)
    for camera in cameras:
        ones = field.means.new_ones(3, camera.height, camera.width)
        weight = sums_of_weights(rasterizer, field, camera, ones)[:, :1]
        most = torch.cat([most, weight], dim=1).topk(FEWEST_VIEWS, dim=1).values
    return most[:, -1] <= SEEN * most[:, 0]


def share_in_front(
    rasterizer: Rasterizer, field: GaussianField, surface: GaussianField, cameras: Iterable[Camera]
) -> Tensor:
    """Return the share of each Gaussian's blending weights that is clearly in front of a surface, (n,) in [0, 1].

    In each view the depth of its centre is compared with the harmonic mean of the surface's depths behind it.
    """
    total, front = torch.zeros_like(field.opacity_logits), torch.zeros_like(field.opacity_logits)
    for camera in cameras:
        with torch.no_grad():
            blended, opacity = render_depths(rasterizer, surface, camera)
            opaque = (opacity > OPAQUE).to(opacity)
            weights = torch.stack([torch.ones_like(opaque), opaque, opaque * opacity / blended.clamp(min=1e-30)])
        everything, before_surface, by_depth = sums_of_weights(rasterizer, field, camera, weights).unbind(dim=1)
        nearer = camera.local(field.means)[:, 2] * by_depth < (1.0 - CLEARLY) * before_surface
        total += everything
        front += torch.where(nearer, before_surface, 0.0)
    return front / total.clamp(min=torch.finfo(total.dtype).tiny)


def sums_of_weights(rasterizer: Rasterizer, field: GaussianField, camera: Camera, pixels: Tensor) -> Tensor:
    """Return the sums over pixels of each Gaussian's blending weight alpha T times three weights of the pixel.

    A blending weight is the derivative of a pixel by the Gaussian's colour, so one backward pass gives all sums.

    Args:
        pixels: (3, h, w) weights of the pixels.

    Returns:
        (n, 3).
    """
    with torch.enable_grad():
        colors = field.sh.new_zeros(len(field), 1, 3).requires_grad_()
        black = field.means.new_zeros(3)
        grey = replace(field, sh=colors, signed=True)
        image = rasterizer.render_image(grey, camera, background=black, sh_degree=0)
        (by_colors,) = torch.autograd.grad((image * pixels).sum(), colors)
    return by_colors[:, 0] / SH_C0
