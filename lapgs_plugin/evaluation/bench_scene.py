"""Make the random scene that rasterizers are timed on, of any size, as dense as a trained field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import layout, oracle


@dataclass(frozen=True)
class BenchScene:
    """A field, a camera that sees it, and a target image."""

    field: GaussianField
    camera: Camera
    target: Tensor  # (3, h, w)


def make_scene(width: int, height: int, gaussians: int, dtype: torch.dtype) -> BenchScene:
    """Make a random field that fills the view of a camera at the origin; each pixel blends about 40 Gaussians."""
    n = gaussians
    focal = max(width, height) * math.sqrt(3) / 2  # 60 degrees across the longer side
    camera = Camera(width, height, focal, focal, width / 2, height / 2, torch.eye(4, dtype=dtype))
    generator = torch.Generator().manual_seed(n)

    def uniform(columns: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, columns, generator=generator, dtype=torch.float64)

    depths = uniform(1, 1.0, 6.0)
    # A tenth of a side beyond each border, so that pixels there blend as many Gaussians.
    corners = torch.tensor([width, height]) * (uniform(2, -0.1, 1.1) - 0.5) / focal
    spacing = math.sqrt(1.44 * width * height / n)  # pixels between neighbours, were they in one plane
    sizes = torch.exp(uniform(3, math.log(0.43), math.log(2.86))) * spacing  # standard deviations in pixels
    scene = GaussianField(
        means=torch.cat([corners * depths, depths], dim=1),
        quaternions=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        log_scales=torch.log(sizes * depths / focal),
        opacity_logits=uniform(1, -4.0, 0.0)[:, 0],
        sh=0.3 * torch.randn(n, 16, 3, generator=generator, dtype=torch.float64),
    )
    target = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    return BenchScene(scene.to(dtype=dtype), camera, target.to(dtype))


@torch.no_grad()
def blended_per_pixel(scene: BenchScene, pixels: int = 256) -> float:
    """Return the number of Gaussians that a pixel blends, on average over a random sample of pixels."""
    seen = oracle.project(scene.field, scene.camera)
    order = torch.argsort(seen.depths)
    means2d, conics = seen.means2d[order], seen.conics[order]  # (v, 2), (v, 3)
    opacities = torch.sigmoid(scene.field.opacity_logits[seen.ids[order]])  # (v,)
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([scene.camera.width, scene.camera.height], dtype=means2d.dtype)
    points = torch.floor(torch.rand(pixels, 2, generator=generator, dtype=means2d.dtype) * size)  # (p, 2)
    count = 0
    for point in points:
        dx, dy = (means2d - point).unbind(-1)  # (v,) each
        power = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy  # (v,)
        alphas = (opacities * torch.exp(-power)).clamp(max=layout.MAX_ALPHA)  # (v,)
        visible = alphas >= layout.MIN_ALPHA
        behind = torch.cumprod(1 - alphas[visible], dim=0)
        count += int((behind >= layout.MIN_TRANSMITTANCE).sum())
    return count / pixels
