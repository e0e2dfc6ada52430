"""Choose between gsplat's kernel and ours for the gradients of blending."""

from __future__ import annotations

import os
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.self_check import largest, matches_reference

SWITCH = "LAPGS_BLEND_GRADIENTS"
TRITON, GSPLAT = "triton", "gsplat"
DEFAULT = GSPLAT
LARGEST_DIFFERENCE = 1e-3
"""Largest accepted difference from gsplat's gradients, relative to the largest; gsplat's own rounding makes most of it.

gsplat divides the transmittance behind the last Gaussian, 1e-4 or more with an error of 6e-8, by all factors before.
"""


class Blending(NamedTuple):
    """Arguments and results of blending that its gradients need; c cameras, n Gaussians, p pairs with tiles."""

    means2d: Tensor  # (c, n, 2)
    conics: Tensor  # (c, n, 3)
    colors: Tensor  # (c, n, 3)
    opacities: Tensor  # (c, n)
    background: Tensor  # (c, 3)
    offsets: Tensor  # (c, tiles down, tiles across) first pair of each tile
    flat: Tensor  # (p,) Gaussian of each pair
    alphas: Tensor  # (c, h, w, 1)
    last: Tensor  # (c, h, w) last pair that each pixel blends
    images: Tensor  # (c, 3, h, w), or (3, h, w) of one camera


Gradients = tuple[Tensor, ...]
"""Sums of absolute values of the gradient by centres, where asked for; gradients by the first four of `Blending`."""


def blend_backward(blending: Blending, by_images: Tensor, absolute: bool) -> Gradients:
    """Return the gradients of blending, from that by the images.

    Raises:
        UserInputError: the environment variable `SWITCH` has another value.
    """
    chosen = os.environ.get(SWITCH) or DEFAULT
    if chosen not in (TRITON, GSPLAT):
        raise UserInputError(f"{SWITCH}={chosen}: expected {TRITON} or {GSPLAT}")
    if chosen == TRITON and triton_works(blending.means2d):
        return by_our_kernel(blending, by_images, absolute)
    return by_gsplat(blending, by_images, absolute)


def by_gsplat(blending: Blending, by_images: Tensor, absolute: bool) -> Gradients:
    """Compute them by gsplat's kernel, a thread for each pixel."""
    from lapgs_plugin.rasterizers.gsplat.direct import TILE, compiled_functions, zeros

    count, height, width, _ = blending.alphas.shape
    by_images = by_images.movedim(-3, -1).contiguous().view(count, height, width, 3)
    by_alphas = zeros(blending.alphas.shape, by_images.device)
    found: Gradients = compiled_functions().rasterize_to_pixels_3dgs_bwd(
        *blending[:5], None, width, height, TILE, *blending[5:9], by_images, by_alphas, absolute
    )
    return found


def by_our_kernel(blending: Blending, by_images: Tensor, absolute: bool) -> Gradients:
    """Compute them by our kernel, a warp for each region of a tile."""
    from lapgs_plugin.rasterizers.gsplat import blend_kernels

    images = blending.images.contiguous(), by_images.contiguous()
    given = (*blending[:4], blending.offsets, blending.flat, blending.last, *images)
    return blend_kernels.blend_backward(*given, absolute)


@matches_reference("gradients of blending by gsplat's kernel, which takes longer", LARGEST_DIFFERENCE)
def triton_works(device: torch.device) -> float:
    """Compare the gradients by both kernels for two views of random Gaussians, dense enough to hide what is behind."""
    from lapgs_plugin.rasterizers.gsplat.direct import blend

    generator = torch.Generator().manual_seed(0)
    cameras, count, width, height = 2, 3000, 75, 53

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    centres = uniform(cameras, count, 2) * torch.tensor([width + 20.0, height + 20.0]) - 10.0
    factors = 4.0 * (uniform(cameras, count, 2, 2) - 0.5)
    covariances = factors @ factors.mT + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariances)
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    radii = (3.4 * covariances.diagonal(dim1=-2, dim2=-1).sqrt()).ceil().int()
    opacities = (1.1 * uniform(cameras, count)).clamp(0.01, 1.0)
    colors = torch.randn(cameras, count, 3, generator=generator)
    by_images = torch.randn(cameras, 3, height, width, generator=generator).to(device)
    projected = [value.to(device) for value in (radii, centres, uniform(cameras, count), conics)]
    _, centres, _, conics = projected
    colors, opacities, background = (value.to(device) for value in (colors, opacities, uniform(cameras, 3)))
    images, alphas, last, offsets, flat = blend(projected, colors, opacities, background, (width, height), cameras)
    images = images.permute(0, 3, 1, 2).contiguous()
    given = Blending(centres, conics, colors, opacities, background, offsets, flat, alphas, last, images)
    pairs = zip(by_our_kernel(given, by_images, True), by_gsplat(given, by_images, True), strict=True)
    return largest((one - other).abs() / other.abs().max() for one, other in pairs)
