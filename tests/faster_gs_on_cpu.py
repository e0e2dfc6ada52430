"""Faster-GS's `diff_rasterize` on the CPU, in PyTorch by the rules of its kernels, each pixel with every Gaussian.

Gradients are autograd's. Like the kernels it cannot render an image without a Gaussian in any tile.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from torch import Tensor

from lapgs_plugin.family.forks import RasterizerSettings
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.reference_raster.oracle import world_covariances

FAINTEST, LEAST_LEFT, BLUR = 1 / 255, 1e-4, 0.3


def _limited(values: Tensor, size: int, centre: float, focal: float) -> Tensor:
    """Clamp x / z to the image and 15 % of its size beyond each border."""
    return values.clamp((-0.15 * size - centre) / focal, (1.15 * size - centre) / focal)


def _project(means: Tensor, covariances: Tensor, given: RasterizerSettings) -> tuple[Tensor, Tensor]:
    """Return centres (n, 2), at 0.5 in the first pixel, and inverse covariances (n, 2, 2)."""
    rotation, translation = given.w2c[:3, :3], given.w2c[:3, 3]
    x, y, depth = (means @ rotation.T + translation).unbind(-1)
    x, y = x / depth, y / depth
    across, down = given.focal_x / depth, given.focal_y / depth
    limited_x = _limited(x, given.width, given.center_x, given.focal_x)
    limited_y = _limited(y, given.height, given.center_y, given.focal_y)
    nothing = torch.zeros_like(depth)
    jacobian = torch.stack([across, nothing, -across * limited_x, nothing, down, -down * limited_y], -1)
    to_screen = jacobian.view(-1, 2, 3) @ rotation
    on_screen = to_screen @ covariances @ to_screen.mT + BLUR * torch.eye(2)
    return torch.stack(
        [x * given.focal_x + given.center_x, y * given.focal_y + given.center_y], -1
    ), on_screen.inverse()


def diff_rasterize(
    means: Tensor,
    scales: Tensor,
    rotations: Tensor,
    opacities: Tensor,
    sh_coefficients_0: Tensor,
    sh_coefficients_rest: Tensor,
    densification_info: Tensor,
    rasterizer_settings: RasterizerSettings,
) -> Tensor:
    settings = rasterizer_settings
    parameters = means, scales, rotations, opacities, sh_coefficients_0, sh_coefficients_rest
    assert all(each.is_contiguous() for each in parameters), "the kernels read memory as it lies"
    assert opacities.shape == (len(means), 1)
    assert not settings.proper_antialiasing
    with torch.no_grad():
        depths = means @ settings.w2c[2, :3] + settings.w2c[2, 3]
        seen = (
            (depths >= settings.near_plane) & (depths <= settings.far_plane) & (opacities[:, 0].sigmoid() >= FAINTEST)
        )
        ids = seen.nonzero()[:, 0]
        ids = ids[depths[ids].argsort(stable=True)]
    covariances = world_covariances(rotations[ids], scales[ids])
    centres, conics = _project(means[ids], covariances, settings)
    if len(densification_info) and centres.requires_grad:

        def note(gradient: Tensor) -> None:
            halves = torch.tensor([settings.width / 2, settings.height / 2])
            densification_info[0, ids] += 1
            densification_info[1, ids] += (gradient * halves).norm(dim=1)

        centres.register_hook(note)
    sh = torch.cat([sh_coefficients_0, sh_coefficients_rest], 1)[ids]
    directions = torch.nn.functional.normalize(means[ids] - settings.cam_position, dim=-1)
    colors = sh_to_color(sh, directions, math.isqrt(settings.active_sh_bases) - 1, signed=False)
    rows, columns = (torch.arange(side) + 0.5 for side in (settings.height, settings.width))
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 1, 2)  # (p, 1, 2)
    away = centres - pixels  # (p, m, 2)
    powers = (away[..., None, :] @ conics @ away[..., None])[..., 0, 0]  # (p, m)
    alphas = opacities[ids, 0].sigmoid() * torch.exp(-0.5 * powers.clamp_min(0))
    inside = (centres > 0).all(1) & (centres < torch.tensor([settings.width, settings.height])).all(1)
    assert bool(((alphas >= FAINTEST).any(0) | inside).any()), "invalid configuration argument: a grid of no blocks"
    alphas = torch.where(alphas >= FAINTEST, alphas, 0.0)
    with torch.no_grad():
        before = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas).cumprod(1)[:, :-1]], 1)
        blended = before >= LEAST_LEFT
    alphas = torch.where(blended, alphas, 0.0)
    left = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas).cumprod(1)], 1)
    image = (left[:, :-1] * alphas) @ colors + left[:, -1:] * settings.bg_color
    return image.T.reshape(3, settings.height, settings.width)


BACKEND = SimpleNamespace(diff_rasterize=diff_rasterize, RasterizerSettings=RasterizerSettings)
"""In the place of `FasterGSCudaBackend.torch_bindings`."""
