"""Make the random scene that rasterizers are timed on, of any size, as dense as a trained field."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lapgs_plugin.evaluation.cases import make_camera, random_case
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import layout, oracle


@dataclass(frozen=True)
class BenchScene:
    """Hold a field, a camera that sees it, and a target image."""

    field: GaussianField
    camera: Camera
    target: Tensor  # (3, h, w)


def make_scene(width: int, height: int, gaussians: int, dtype: torch.dtype) -> BenchScene:
    """Make a random field that fills the view of a camera at the origin; each pixel blends about 40 Gaussians."""
    spacing = math.sqrt(1.44 * width * height / gaussians)  # pixels between neighbours, were they in one plane
    sizes = 0.43 * spacing, 2.86 * spacing
    case = random_case(gaussians, width, height, seed=gaussians, camera=make_camera(width, height), pixels=sizes)
    generator = torch.Generator().manual_seed(gaussians)
    logits = -4.0 * torch.rand(gaussians, generator=generator, dtype=torch.float64)
    case = replace(case, field=case.field.with_parameters({"opacity_logits": logits})).to(dtype)
    target = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    return BenchScene(case.field, case.camera, target.to(dtype))


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
