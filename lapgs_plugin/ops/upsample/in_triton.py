"""Upsample on a GPU in one kernel, with or without adding an image; the gradient takes two."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.hierarchy.pyramid import Pyramid, transposed_taps

BLOCK_ROWS, BLOCK_COLUMNS = 8, 128
MOST_TAPS, MOST_TRANSPOSED = 5, 12
"""Upper bounds: coarse samples in the sum of a fine one, and fine samples whose sums a coarse one is in."""

# Triton compiles a kernel again for integers that are 1 or multiples of 16. Without this it would do so for many image
# sizes. Column strides stay specialized: they are 1 or 3, and a known 1 makes faster code.
OF_ANY_VALUE = (
    *("height", "width", "source_image", "source_plane", "source_row"),
    *("added_image", "added_plane", "added_row", "out_image", "out_plane", "out_row"),
)


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _kernel(
    source: tl.tensor, added: tl.tensor, out: tl.tensor,
    first_row: tl.tensor, row_weights: tl.tensor, first_column: tl.tensor, column_weights: tl.tensor,
    height: int, width: int,
    source_image: int, source_plane: int, source_row: int, source_column: int,
    added_image: int, added_plane: int, added_row: int, added_column: int,
    out_image: int, out_plane: int, out_row: int, out_column: int,
    adds: tl.constexpr, planes: tl.constexpr, taps_down: tl.constexpr, taps_across: tl.constexpr,
    block_rows: tl.constexpr, block_columns: tl.constexpr,
) -> None:  # fmt: skip
    """Filter a block of all planes of an image; *_image, *_plane, *_row, *_column are strides."""
    rows = tl.program_id(1) * block_rows + tl.arange(0, block_rows)  # (r,)
    columns = tl.program_id(0) * block_columns + tl.arange(0, block_columns)  # (c,)
    in_rows, in_columns = rows < height, columns < width
    inside = in_rows[:, None] & in_columns[None, :]
    row, column = tl.load(first_row + rows, in_rows, 0), tl.load(first_column + columns, in_columns, 0)
    image = tl.program_id(2).to(tl.int64)
    for plane in tl.static_range(planes):  # one block reads all colours, which may be interleaved in memory
        total = tl.zeros((block_rows, block_columns), tl.float32)
        if adds:
            there = added + image * added_image + plane * added_plane
            total += tl.load(there + rows[:, None] * added_row + columns[None, :] * added_column, inside, 0.0)
        for down in tl.static_range(taps_down):
            by_row = tl.load(row_weights + rows * taps_down + down, in_rows, 0.0)
            across = tl.zeros_like(total)
            start = source + image * source_image + plane * source_plane + (row + down)[:, None] * source_row
            for tap in tl.static_range(taps_across):
                by_column = tl.load(column_weights + columns * taps_across + tap, in_columns, 0.0)
                across += by_column[None, :] * tl.load(start + (column + tap)[None, :] * source_column, inside, 0.0)
            total += by_row[:, None] * across
        there = out + image * out_image + plane * out_plane
        tl.store(there + rows[:, None] * out_row + columns[None, :] * out_column, total, inside)


class _Taps(NamedTuple):
    """Hold `Pyramid.up_taps` of a side on a device: first (n,) int32, weights (n, k) float32."""

    first: Tensor
    weights: Tensor


def upsample_add_triton(pyramid: Pyramid, coarse: Tensor, fine: Tensor) -> Tensor:
    """Do `upsample_add` for float32 images on a CUDA device, with any strides."""
    rows, columns = (_up(pyramid.grid, side, fine.device) for side in fine.shape[-2:])
    out = torch.empty_like(fine)
    _filter(coarse, rows, columns, out, fine)
    return out


def upsample_triton(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int]) -> Tensor:
    """Do `upsample` for a float32 image on a CUDA device, with any strides."""
    out: Tensor = _Upsampled.apply(coarse, pyramid.grid, size)  # type: ignore[no-untyped-call]  # torch's
    return out


class _Upsampled(torch.autograd.Function):
    """Map (coarse, grid, size) to Up(coarse); the gradient applies the transpose of Up, one side after the other."""

    @staticmethod
    def forward(ctx: Any, coarse: Tensor, grid: str, size: tuple[int, int]) -> Tensor:
        ctx.grid, ctx.size, ctx.shape = grid, size, coarse.shape
        out = coarse.new_empty(*coarse.shape[:-2], *size)
        rows, columns = (_up(grid, side, coarse.device) for side in size)
        _filter(coarse, rows, columns, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (height, width), device = ctx.size, gradient.device
        lower = gradient.new_empty(*ctx.shape[:-1], width)  # half as many rows
        _filter(gradient, _up_transposed(ctx.grid, height, device), _identity(width, device), lower)
        out = gradient.new_empty(ctx.shape)
        _filter(lower, _identity(ctx.shape[-2], device), _up_transposed(ctx.grid, width, device), out)
        return out, None, None


def _filter(source: Tensor, rows: _Taps, columns: _Taps, out: Tensor, added: Tensor | None = None) -> None:
    """Write weighted sums of `source`, plus `added` if given, to `out`."""
    given = (source, out if added is None else added, out)
    images = [image if image.ndim == 4 else image[None] for image in given]  # (b, c, ..., ...) each
    height, width = out.shape[-2:]
    blocks = triton.cdiv(width, BLOCK_COLUMNS), triton.cdiv(height, BLOCK_ROWS), len(images[2])
    launch: Any = _kernel[blocks]
    launch(
        *images, *rows, *columns, height, width,
        *(stride for image in images for stride in image.stride()),
        adds=added is not None, planes=images[2].shape[1],
        taps_down=rows.weights.shape[1], taps_across=columns.weights.shape[1],
        block_rows=BLOCK_ROWS, block_columns=BLOCK_COLUMNS,
    )  # fmt: skip


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _up(grid: str, size: int, device: torch.device) -> _Taps:
    return _to_device(*Pyramid(grid).up_taps(size), (size + 1) // 2, MOST_TAPS, device)


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _up_transposed(grid: str, size: int, device: torch.device) -> _Taps:
    return _to_device(*transposed_taps(*Pyramid(grid).up_taps(size), (size + 1) // 2), size, MOST_TRANSPOSED, device)


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _identity(size: int, device: torch.device) -> _Taps:
    return _Taps(torch.arange(size, dtype=torch.int32, device=device), torch.ones(size, 1, device=device))


def _to_device(first: Tensor, weights: Tensor, samples: int, most: int, device: torch.device) -> _Taps:
    """Pad taps to the same number for all sizes, which the kernel is compiled for, and copy them to the device.

    Args:
        first, weights: as `Pyramid.up_taps` returns them.
        samples: number of samples on the side that is summed over.
        most: number of taps to pad to.
    """
    taps = min(most, samples)
    earlier = first.clamp_max(samples - taps)
    places = (first - earlier)[:, None] + torch.arange(weights.shape[1])
    wide = weights.new_zeros(len(first), taps).scatter_(1, places, weights)
    return _Taps(earlier.to(device, torch.int32), wide.to(device, torch.float32))
