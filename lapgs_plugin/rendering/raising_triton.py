"""Up(coarse) + fine on a GPU in one kernel."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.pyramid import Pyramid

BLOCK_ROWS, BLOCK_COLUMNS = 8, 128
MOST_TAPS = 5

# Triton compiles a kernel anew, for a second, where an integer is 1 or a multiple of 16 and was not before: with
# these, at many a new size of an image. Distances between columns are 1 or 3, and to know that they are 1 helps.
OF_ANY_VALUE = (
    *("height", "width", "coarse_image", "coarse_plane", "coarse_row"),
    *("fine_image", "fine_plane", "fine_row", "out_image", "out_plane", "out_row"),
)


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _kernel(
    coarse: tl.tensor, fine: tl.tensor, out: tl.tensor,
    first_row: tl.tensor, row_weights: tl.tensor, first_column: tl.tensor, column_weights: tl.tensor,
    height: int, width: int,
    coarse_image: int, coarse_plane: int, coarse_row: int, coarse_column: int,
    fine_image: int, fine_plane: int, fine_row: int, fine_column: int,
    out_image: int, out_plane: int, out_row: int, out_column: int,
    planes: tl.constexpr, taps_down: tl.constexpr, taps_across: tl.constexpr,
    block_rows: tl.constexpr, block_columns: tl.constexpr,
) -> None:  # fmt: skip
    """A block of all planes of an image; *_image, *_plane, ... are distances between neighbours in memory."""
    rows = tl.program_id(1) * block_rows + tl.arange(0, block_rows)  # (r,)
    columns = tl.program_id(0) * block_columns + tl.arange(0, block_columns)  # (c,)
    in_rows, in_columns = rows < height, columns < width
    inside = in_rows[:, None] & in_columns[None, :]
    row, column = tl.load(first_row + rows, in_rows, 0), tl.load(first_column + columns, in_columns, 0)
    image = tl.program_id(2).to(tl.int64)
    for plane in tl.static_range(planes):  # colours beside each other in memory are read by one block
        there = fine + image * fine_image + plane * fine_plane
        there += rows[:, None] * fine_row + columns[None, :] * fine_column
        total = tl.load(there, inside, 0.0)  # (r, c)
        for down in tl.static_range(taps_down):
            by_row = tl.load(row_weights + rows * taps_down + down, in_rows, 0.0)
            across = tl.zeros_like(total)
            start = coarse + image * coarse_image + plane * coarse_plane + (row + down)[:, None] * coarse_row
            for tap in tl.static_range(taps_across):
                by_column = tl.load(column_weights + columns * taps_across + tap, in_columns, 0.0)
                across += by_column[None, :] * tl.load(start + (column + tap)[None, :] * coarse_column, inside, 0.0)
            total += by_row[:, None] * across
        there = out + image * out_image + plane * out_plane
        tl.store(there + rows[:, None] * out_row + columns[None, :] * out_column, total, inside)


def add_raised_triton(pyramid: Pyramid, coarse: Tensor, fine: Tensor) -> Tensor:
    """See `raising.add_raised`; float32 on a CUDA device, (c, h, w) or (b, c, h, w) in whatever order of memory."""
    height, width = fine.shape[-2:]
    first_row, row_weights = _device_taps(pyramid.grid, height, fine.device)
    first_column, column_weights = _device_taps(pyramid.grid, width, fine.device)
    out = torch.empty_like(fine)
    images = [image if image.ndim == 4 else image[None] for image in (coarse, fine, out)]  # (b, c, ..., ...) each
    blocks = triton.cdiv(width, BLOCK_COLUMNS), triton.cdiv(height, BLOCK_ROWS), len(images[1])
    launch: Any = _kernel[blocks]
    launch(
        *images, first_row, row_weights, first_column, column_weights, height, width,
        *(distance for image in images for distance in image.stride()),
        planes=images[1].shape[1], taps_down=row_weights.shape[1], taps_across=column_weights.shape[1],
        block_rows=BLOCK_ROWS, block_columns=BLOCK_COLUMNS,
    )  # fmt: skip
    return out


@lru_cache(maxsize=64)
def _device_taps(grid: str, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`Pyramid.up_taps`, as many taps for all sizes: their number is compiled into the kernel."""
    first, weights = Pyramid(grid).up_taps(size)
    coarse = (size + 1) // 2
    taps = min(MOST_TAPS, coarse)
    earlier = first.clamp_max(coarse - taps)
    places = (first - earlier)[:, None] + torch.arange(weights.shape[1])
    wide = weights.new_zeros(size, taps).scatter_(1, places, weights)
    return earlier.to(device, torch.int32), wide.to(device, torch.float32)
