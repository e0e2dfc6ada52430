"""Blend by gsplat's kernels or by ours, with gradients."""

from __future__ import annotations

import os
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.rasterizers.gsplat import bindings
from lapgs_plugin.rasterizers.gsplat.bindings import TILE

SWITCH = "LAPGS_BLEND_GRADIENTS"
TRITON, GSPLAT = "triton", "gsplat"
FEWEST_PIXELS = 400_000
"""Of all images together; of fewer pixels launching our kernels takes longer than gsplat's take to run."""
LARGEST_DIFFERENCE = 1e-3
"""Largest accepted difference from gsplat's gradients, relative to the largest; gsplat's own rounding makes most of it.

gsplat divides the transmittance behind the last Gaussian, 1e-4 or more with an error of 6e-8, by all factors before.
"""
RECORD, COLOR_IN_RECORD = 12, 8
"""Numbers of a Gaussian's record, which lies together in memory, and where its colour begins.

They are x, y, conic (a, b, c), opacity, two without meaning, red, green, blue, and one more without meaning.
"""


class ToBlend(NamedTuple):
    """Hold sorted Gaussians of c cameras, n for each, with p pairs of a Gaussian and a tile.

    gsplat's kernels take the first four, which are contiguous then; ours take records instead.
    """

    means2d: Tensor  # (c, n, 2)
    conics: Tensor  # (c, n, 3)
    colors: Tensor  # (c, n, 3)
    opacities: Tensor  # (c, n), or (1, n) beside records
    background: Tensor  # (c, 3)
    offsets: Tensor  # (c, tiles down, tiles across) first pair of each tile
    flat: Tensor  # (p,) Gaussian of each pair
    records: Tensor  # (c, n, RECORD), empty if gsplat's kernels blend


class Blended(NamedTuple):
    """Hold images, and what their gradients need."""

    images: Tensor  # (c, h, w, 3)
    alphas: Tensor  # (c, h, w, 1), empty if our kernels blended
    last: Tensor  # (c, h, w) the last pair of each pixel by gsplat, or the counts of `blend_forward`
    words: Tensor  # of `blend_forward`, empty if gsplat's kernels blended


Gradients = tuple[Tensor, ...]
"""Sums of absolute values of the gradient by centres, where asked for; gradients by the first four of `ToBlend`.

Those by centres and conics are contiguous; the others of our kernels are views with other numbers between rows.
"""


def our_kernels_blend(means: Tensor, pixels: int = FEWEST_PIXELS) -> bool:
    """Return whether our kernels blend.

    Args:
        means: float32 on the device.
        pixels: of all images together; by default enough.

    Raises:
        UserInputError: the environment variable `SWITCH` has another value.
    """
    chosen = os.environ.get(SWITCH) or TRITON
    if chosen not in (TRITON, GSPLAT):
        raise UserInputError(f"{SWITCH}={chosen}: expected {TRITON} or {GSPLAT}")
    # Asked for small images too: then the render that warms up before training compiles the kernels.
    return chosen == TRITON and triton_works(means) and pixels >= FEWEST_PIXELS


def records_of(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor) -> Tensor:
    """Return the records (c, n, RECORD) of Gaussians, (c, n, 2), (c, n, 3), (c, n, 3) and (c, n).

    Training and frames have them from `kernels.visible_colors` and `kernels.write_to_stack`.
    """
    two = torch.zeros_like(means2d)
    return torch.cat([means2d, conics, opacities[..., None], two, colors, two[..., :1]], -1)


def blend(given: ToBlend, size: tuple[int, int]) -> Blended:
    """Blend images of a size (width, height); by our kernels if there are records, otherwise by gsplat's."""
    if len(given.records):
        from lapgs_plugin.rasterizers.gsplat.blend_kernels import blend_forward

        images, *rest = blend_forward(given.records, given.background, given.offsets, given.flat, size)
        return Blended(images, images.new_empty(0), *rest)
    forward = bindings.compiled_functions().rasterize_to_pixels_3dgs_fwd
    images, alphas, last = forward(*given[:5], None, *size, TILE, given.offsets, given.flat)
    return Blended(images, alphas, last, given.flat.new_empty(0))


def gradients(given: ToBlend, blended: Blended, by_images: Tensor, absolute: bool) -> Gradients:
    """Return the gradients of blending by the kernels that blended.

    Args:
        given, blended: arguments and results of `blend`.
        by_images: (c, h, w, 3) gradient by its images.
        absolute: also sum absolute values.
    """
    by_images = by_images.contiguous()
    if len(given.records):
        from lapgs_plugin.rasterizers.gsplat.blend_kernels import blend_backward

        rest = blended.images, blended.last, blended.words, by_images
        return blend_backward(given.records, given.offsets, given.flat, *rest, absolute)
    _, height, width, _ = by_images.shape
    found: Gradients = bindings.compiled_functions().rasterize_to_pixels_3dgs_bwd(
        *given[:5], None, width, height, TILE, given.offsets, given.flat, blended.alphas, blended.last,
        by_images, bindings.zeros(blended.alphas.shape, by_images.device), absolute,
    )  # fmt: skip
    return found


@matches_reference("blending by gsplat's kernels, which take longer", LARGEST_DIFFERENCE)
def triton_works(device: torch.device) -> float:
    """Compare images and gradients by both for two views of random Gaussians, dense enough to hide what is behind."""
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
    by_images = torch.randn(cameras, height, width, 3, generator=generator).to(device)
    projected = [value.to(device) for value in (radii, centres, uniform(cameras, count), conics)]
    offsets, flat = bindings.sort_into_tiles(projected, (width, height), cameras)
    centres, conics, colors, opacities = (each.to(device) for each in (centres, conics, colors, opacities))
    background = uniform(cameras, 3).to(device)
    found = []
    for records in (records_of(centres, conics, colors, opacities), background.new_empty(0)):
        given = ToBlend(centres, conics, colors, opacities, background, offsets, flat, records)
        blended = blend(given, (width, height))
        # Each is a kernel of its own; `absolute` or not, training uses one of them.
        plain, whole = (gradients(given, blended, by_images, absolute) for absolute in (False, True))
        found.append((blended.images, *plain[1:], *whole))
    return largest((one - other).abs() / other.abs().max() for one, other in zip(*found, strict=True))
