"""Tell what a scene's views see of a tile: by the base, so that what hides it counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.scenes.scene import View

LEAST_SHARE = 0.1
"""Share of a pixel's opacity from which on the tile trains it. Less is rounding of the tile's edge, or hardly seen."""
LEAST_PIXELS = 0.01
"""Share of a view's pixels from which on the view sees a tile."""
COVERED = 0.02
"""Opacity of a pixel in which the base shows anything."""


@dataclass(frozen=True)
class TileViews:
    """Hold what views see of a tile.

    Attributes:
        masks: (h, w) bool of those that see it, by name: the tile's pixels, at half the view's size.
        seen: (n,) bool, Gaussians of the base that one of them shows.
    """

    masks: Mapping[str, Tensor]
    seen: Tensor  # (n,)

    @property
    def share(self) -> float:
        """Mean share of the tile in the pixels of the views that see it."""
        return fmean(float(mask.float().mean()) for mask in self.masks.values())

    def of(self, views: Sequence[View]) -> tuple[View, ...]:
        """Return those of some views that see the tile, with masks that leave other tiles' pixels out."""
        return tuple(view.within(partial(self._mask, view)) for view in views if view.name in self.masks)

    def _mask(self, view: View) -> Tensor:
        """Return the mask (1, H, W) of a view at its full size."""
        width, height = view.camera.size
        mask = self.masks[view.name][None, None].float()
        return interpolate(mask, (height, width), mode="nearest")[0] > 0.5


@torch.no_grad()
def views_of_tile(
    cameras: Mapping[str, Camera], base: GaussianField, inside: Tensor, rasterizer: Rasterizer, device: torch.device
) -> TileViews:
    """Return which views see a tile, and what else they see.

    Args:
        cameras: of the views at full size, by name.
        base: finished level 1.
        inside: (n,) bool, which of its Gaussians are in the tile.
        rasterizer, device: of the run.
    """
    sh = torch.zeros(len(base), 1, 3)
    sh[:, 0, 0], sh[:, 0, 1] = inside.float() / SH_C0, 1.0 / SH_C0  # images of the tile's opacity and of all opacity
    field = replace(base, sh=sh, signed=True).to(device)
    masks: dict[str, Tensor] = {}
    seen = torch.zeros(len(base), dtype=torch.bool)
    for name, camera in cameras.items():
        half = camera.resized(*level_size(camera.size, 1))
        result = rasterizer(field, half, background=torch.zeros(3, device=device), sh_degree=0)
        part, whole, _ = result.image.cpu()
        mask = (part > LEAST_SHARE * whole) & (whole > COVERED)
        if float(mask.float().mean()) >= LEAST_PIXELS:
            masks[name] = mask
            seen |= result.radii.cpu() > 0
    return TileViews(masks, seen)
