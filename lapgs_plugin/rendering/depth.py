"""Render depth with any rasterizer, by rendering depths as colours."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_depths

SMALLEST_COVER = 1e-6


@dataclass(frozen=True)
class DepthImage:
    """Depth of a view.

    Attributes:
        depth: (h, w) along the optical axis, in world units: the mean depth of the Gaussians with their blending
            weights. Meaningless where nothing covers a pixel.
        cover: (h, w) sum of these weights, in [0, 1].
    """

    depth: Tensor
    cover: Tensor

    def to(self, device: torch.device) -> DepthImage:
        """Return the depth image on a device."""
        return DepthImage(self.depth.to(device), self.cover.to(device))


@torch.no_grad()
def render_depth(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> DepthImage:
    """Render the depth of a field from a camera.

    Args:
        rasterizer: any.
        field: ordinary or a base; a residual has no depth.
        camera: on the field's device or the CPU.
    """
    weighted, cover = render_depths(rasterizer, field, camera)
    return DepthImage(weighted / cover.clamp(min=SMALLEST_COVER), cover)
