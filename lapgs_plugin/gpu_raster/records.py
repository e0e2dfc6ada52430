"""How Gaussians lie in memory between our kernels."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField

TILE = 16
"""Pixels of a tile's side."""
RECORD = 12
"""Numbers of a Gaussian's record, which lies together in memory: x, y, conic (a, b, c), opacity, two without meaning,
red, green, blue, and 1 / depth."""
COLOR_IN_RECORD = 8
"""Index in a record at which its colour begins."""
GRADIENT = 8
"""Numbers of its first gradients: by red, green, blue, opacity, x, y, a and b. That by c lies elsewhere."""
OTHERS = {(False, False): 1, (True, False): 3, (False, True): 3, (True, True): 5}
"""Numbers of a Gaussian's other gradients, by whether there are absolute sums, and 1 / depth.

They are that by c; two absolute sums, or one without meaning; that by 1 / depth. The number is odd, so that addresses
of several lanes have no order in which Triton would spread them over threads, see `blend_kernels._backward_kernel`.
"""
MOST_OTHERS = max(OTHERS.values())
ALIGNMENT = 16
"""Bytes that our kernels read at once."""


def grid_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return how many tiles an image of (width, height) has across and down."""
    return -(-size[0] // TILE), -(-size[1] // TILE)


class Parameters(NamedTuple):
    """Hold a field's parameters, contiguous float32 on one device, each from a multiple of 16 bytes on.

    By the family's rules they are activated: opacities for logits, standard deviations or covariances (n, 6) for their
    logarithms, and colours (n, 3) may come for SH.
    """

    means: Tensor  # (n, 3)
    quaternions: Tensor  # (n, 4)
    log_scales: Tensor  # (n, 3)
    logits: Tensor  # (n,)
    sh: Tensor  # (n, k, 3)

    @classmethod
    def of(cls, field: GaussianField) -> Parameters:
        """Return those of a field, copied where they lie in memory in another way."""
        parts = field.means, field.quaternions, field.log_scales, field.opacity_logits, field.sh
        return cls(*map(aligned, parts))


def aligned(part: Tensor) -> Tensor:
    """Return a tensor as kernels read it, copied where it lies in memory in another way."""
    part = part.contiguous()
    return part if part.data_ptr() % ALIGNMENT == 0 else part.clone()


def state_of(tensor: Tensor) -> tuple[int, int]:
    """Return numbers that change when PyTorch knows that a tensor's values do.

    It does not know of changes in place through `.data`. Tensors of inference mode have no state.
    """
    return tensor._version, tensor.data_ptr()


class Projected(NamedTuple):
    """Hold n Gaussians as c cameras see them. Where culled, radii are 0, and only what is visible has a meaning.

    By the family's rules a footprint is in tiles. In the place of its half sides are, of columns and of rows, the first
    tile and one past the last in 16 bits each. Depths are 0 where culled, and `means2d` is empty.
    """

    radii: Tensor  # (c, n, 2) int32, half sides of a footprint in pixels
    means2d: Tensor  # (c, n, 2) in pixels
    depths: Tensor  # (c, n)
    records: Tensor  # (c, n, RECORD)
    visible_radii: Tensor  # (c, n) int32 the larger of both, the family's of three sigma, 0 where culled; may be empty
    centres: Tensor  # (c, n, 2) as in `RenderResult`; empty unless described


class Blended(NamedTuple):
    """Hold what blending by the family's rules read and made of n Gaussians; see `blend_kernels.blend_family`."""

    records: Tensor
    offsets: Tensor
    flat: Tensor
    image: Tensor  # (1, 3, h, w)
    counts: Tensor
    words: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height)."""
        return self.image.shape[3], self.image.shape[2]
