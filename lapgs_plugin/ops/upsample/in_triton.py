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
from lapgs_plugin.ops.launch import blocks, launch, rows_of_program
from lapgs_plugin.ops.mixed_sizes import Sizes
from lapgs_plugin.ops.upsample import are_differentiated

BLOCK = 128
LEAST_ROWS = 8
"""Fewest rows of a program."""
MOST_TAPS = 5
"""Most coarse samples in the sum of a fine one."""
MOST_TRANSPOSED = 12
"""Most fine samples whose sums a coarse one is in."""

# Triton compiles a kernel again for integers that are 1 or multiples of 16. Without this it would do so for many image
# sizes.
OF_ANY_VALUE = (
    *("height", "width", "rows", "first_image", "source_image", "source_plane", "source_row"),
    *("added_image", "added_plane", "added_row", "out_image", "out_plane", "out_row"),
)


@triton.jit
def _across(row: tl.tensor, stride: int, weights: tl.tuple, inside: tl.tensor, taps: tl.constexpr) -> tl.tensor:
    """Return sums over neighbours in a row."""
    total = weights[0] * tl.load(row, inside, 0.0)
    for tap in tl.static_range(1, taps):
        total += weights[tap] * tl.load(row + tap * stride, inside, 0.0)
    return total


@triton.jit(do_not_specialize=OF_ANY_VALUE)
def _kernel(
    source: tl.tensor, added: tl.tensor, out: tl.tensor,
    first_row: tl.tensor, row_weights: tl.tensor, first_column: tl.tensor, column_weights: tl.tensor,
    height: int, width: int, rows: int, first_image: int,
    source_image: int, source_plane: int, source_row: int, added_image: int, added_plane: int, added_row: int,
    out_image: int, out_plane: int, out_row: int,
    source_column: tl.constexpr, added_column: tl.constexpr, out_column: tl.constexpr,
    adds: tl.constexpr, clamps: tl.constexpr, planes: tl.constexpr, interleaved: tl.constexpr,
    taps_down: tl.constexpr, taps_across: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Filter some rows of a strip of `block` columns and colours; *_image, *_plane, *_row, *_column are strides.

    The rows of the source that a row of the result is summed over are kept, filtered across, while they are needed.
    """
    places = tl.program_id(0) * block + tl.arange(0, block)
    inside = places < width * planes
    # Neighbouring threads write neighbouring values.
    column = places // planes if interleaved else places % width
    plane = places % planes if interleaved else places // width
    image = (tl.program_id(2) + first_image).to(tl.int64)
    row = tl.program_id(1) * rows
    end = tl.minimum(row + rows, height)
    weights = ()
    for tap in tl.static_range(taps_across):
        weights = weights + (tl.load(column_weights + column * taps_across + tap, inside, 0.0),)  # type: ignore[assignment]  # noqa: RUF005
    start = tl.load(first_column + column, inside, 0)
    start = source + image * source_image + plane * source_plane + start * source_column
    added += image * added_image + plane * added_plane + column * added_column
    out += image * out_image + plane * out_plane + column * out_column
    first = tl.load(first_row + row)
    kept = ()
    for tap in tl.static_range(taps_down):
        there = start + (first + tap).to(tl.int64) * source_row
        kept = kept + (_across(there, source_column, weights, inside, taps_across),)  # type: ignore[assignment]  # noqa: RUF005
    while row < end:
        wanted = tl.load(first_row + row)
        while first < wanted:
            there = start + (first + taps_down).to(tl.int64) * source_row
            kept = kept[1:] + (_across(there, source_column, weights, inside, taps_across),)  # type: ignore[assignment]  # noqa: RUF005
            first += 1
        total = tl.zeros((block,), tl.float32)
        if adds:
            total += tl.load(added + row.to(tl.int64) * added_row, inside, 0.0)
        for tap in tl.static_range(taps_down):
            total += tl.load(row_weights + row * taps_down + tap) * kept[tap]
        if clamps:  # NaN stays
            total = tl.where(total < 0.0, 0.0, tl.where(total > 1.0, 1.0, total))
        tl.store(out + row.to(tl.int64) * out_row, total, inside)
        row += 1


class _Taps(NamedTuple):
    """Hold `Pyramid.up_taps` of a side on a device: first (n,) int32, weights (n, k) float32."""

    first: Tensor
    weights: Tensor


def upsample_add_triton(
    pyramid: Pyramid, coarse: Tensor, fine: Tensor, clamped: bool = False, sizes: Sizes | None = None
) -> Tensor:
    """Do `upsample_add` for images on a CUDA device, with any strides: float32, or a float16 `coarse`."""
    size = fine.shape[-2], fine.shape[-1]
    if clamped or not are_differentiated(coarse, fine):
        return _upsampled(pyramid.grid, size, coarse, fine, clamps=clamped, sizes=sizes)
    options = pyramid.grid, size, sizes
    out: Tensor = _Upsampled.apply(coarse, fine, *options)  # type: ignore[no-untyped-call]  # torch's
    return out


def upsample_triton(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int]) -> Tensor:
    """Do `upsample` for an image on a CUDA device, with any strides: float32, or float16 without gradient."""
    if not are_differentiated(coarse):
        return _upsampled(pyramid.grid, size, coarse)
    options = pyramid.grid, size, None
    out: Tensor = _Upsampled.apply(coarse, None, *options)  # type: ignore[no-untyped-call]  # torch's
    return out


class _Upsampled(torch.autograd.Function):
    """Map (coarse, fine or None, grid, size, sizes or None) to Up(coarse) + fine.

    The gradient applies the transpose of Up.
    """

    @staticmethod
    def forward(
        ctx: Any, coarse: Tensor, fine: Tensor | None, grid: str, size: tuple[int, int], sizes: Sizes | None
    ) -> Tensor:
        ctx.grid, ctx.size, ctx.sizes, ctx.shape = grid, size, sizes, coarse.shape
        return _upsampled(grid, size, coarse, fine, sizes=sizes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        by_fine = gradient if ctx.needs_input_grad[1] else None
        if not ctx.needs_input_grad[0]:
            return None, by_fine, None, None, None
        if ctx.sizes is None:
            out = gradient.new_empty(ctx.shape)
            _filter(gradient, ctx.grid, ctx.size, out, transposed=True)
        else:
            out = gradient.new_zeros(ctx.shape)
            for index, (width, height) in enumerate(ctx.sizes):
                _filter(gradient, ctx.grid, (height, width), out, transposed=True, only=index)
        return out, by_fine, None, None, None


def _upsampled(
    grid: str, size: tuple[int, int], coarse: Tensor, fine: Tensor | None = None, *, clamps: bool = False,
    sizes: Sizes | None = None,
) -> Tensor:  # fmt: skip
    """Return Up(coarse) + fine of this size, without a gradient."""
    shape = *coarse.shape[:-2], *size
    out = coarse.new_empty(shape, dtype=torch.float32) if fine is None else torch.empty_like(fine)
    if sizes is None:
        _filter(coarse, grid, size, out, fine, clamps=clamps)
        return out
    out.zero_()  # numbers beyond the images are finite, so that zero times them is zero
    for index, (width, height) in enumerate(sizes):
        _filter(coarse, grid, (height, width), out, fine, clamps=clamps, only=index)
    return out


def _filter(
    source: Tensor, grid: str, size: tuple[int, int], out: Tensor, added: Tensor | None = None, *,
    clamps: bool = False, transposed: bool = False, only: int | None = None,
) -> None:  # fmt: skip
    """Write weighted sums of `source`, plus `added` if given, to `out`; clamped to [0, 1] if asked for.

    Args:
        size: (h, w) of fine images; with `transposed` these are the source.
        transposed: the sums are those of the gradient.
        only: number of the image to filter, in its top left part; None filters all. Taps depend on the size.
    """
    images = source, out if added is None else added, out
    strides = images[0].stride(), images[1].stride(), images[2].stride()
    options = added is not None, clamps, transposed, only
    programs, taps, numbers, constants = _launch_of(grid, size, source.device, out.shape, strides, *options)
    launch(_kernel, programs, *images, *taps, *numbers, **constants)


@lru_cache(maxsize=256)
def _launch_of(
    grid: str, size: tuple[int, int], device: torch.device, shape: torch.Size, strides: tuple[tuple[int, ...], ...],
    adds: bool, clamps: bool, transposed: bool, only: int | None,
) -> tuple[tuple[int, int, int], tuple[Tensor, ...], tuple[int, ...], dict[str, Any]]:  # fmt: skip
    """Return the programs of a launch, its taps, numbers and constants.

    Args:
        shape: of the result.
        strides: of source, added image and result.
        grid, size, device, adds, clamps, transposed, only: as of `_filter`.
    """
    taps = _up_transposed if transposed else _up
    rows, columns = (taps(grid, side, device) for side in size)
    # One image (c, h, w) is a batch of one.
    b, planes, _, _ = (1, *shape)[-4:]
    b = b if only is None else 1
    height, width = len(rows.first), len(columns.first)
    strips = blocks(planes * width, BLOCK)
    count = rows_of_program(height, strips * b, LEAST_ROWS)
    of_source, of_added, of_out = ((0, *stride)[-4:] for stride in strides)
    numbers = height, width, count, only or 0, *of_source[:3], *of_added[:3], *of_out[:3]
    constants = {
        "source_column": of_source[3], "added_column": of_added[3], "out_column": of_out[3],
        "adds": adds, "clamps": clamps, "planes": planes, "interleaved": of_out[1] == 1,
        "taps_down": rows.weights.shape[1], "taps_across": columns.weights.shape[1], "block": BLOCK,
    }  # fmt: skip
    return (strips, blocks(height, count), b), (*rows, *columns), numbers, constants


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _up(grid: str, size: int, device: torch.device) -> _Taps:
    return _to_device(*Pyramid(grid).up_taps(size), (size + 1) // 2, MOST_TAPS, device)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _up_transposed(grid: str, size: int, device: torch.device) -> _Taps:
    return _to_device(*transposed_taps(*Pyramid(grid).up_taps(size), (size + 1) // 2), size, MOST_TRANSPOSED, device)


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
