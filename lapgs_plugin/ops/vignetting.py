"""Darken images towards their corners, as a camera's lens does."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from lapgs_plugin.ops.mixed_sizes import Sizes


def vignette(image: Tensor, falloffs: Sequence[float], sizes: Sizes | None = None) -> Tensor:
    """Multiply each pixel by 2^(f r^2), where r is its distance from the middle, 1 at the corners; differentiable.

    Args:
        image: (3, h, w), or (b, 3, h, w) of several views.
        falloffs: f of each view, the brightness of its corners in stops.
        sizes: of views whose sizes differ, see `mixed_sizes`; None if images are whole.
    """
    if not any(falloffs):
        return image
    height, width = image.shape[-2:]
    own = sizes or [(width, height)] * len(falloffs)
    factors = [
        _sides(size, (width, height), f, image.dtype, image.device) for size, f in zip(own, falloffs, strict=True)
    ]
    rows, columns = (torch.stack(sides) if image.ndim == 4 else sides[0] for sides in zip(*factors, strict=True))
    return image * (rows[..., :, None] * columns[..., None, :]).unsqueeze(-3)


@lru_cache(maxsize=256)  # few cameras and sizes; a factor is a product of one by row and one by column
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _sides(
    size: tuple[int, int], whole: tuple[int, int], falloff: float, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return the factors (H,) of rows and (W,) of columns, of an image of a size at the top left of a larger one."""
    diagonal = size[0] ** 2 + size[1] ** 2
    columns, rows = (
        torch.exp2(falloff * (2 * torch.arange(count, dtype=torch.float64) + 1 - side) ** 2 / diagonal)
        for side, count in zip(size, whole, strict=True)
    )
    return rows.to(device, dtype), columns.to(device, dtype)
