"""Slice bilateral grids in one kernel, and compute both gradients in two, the same bits in every run.

A program takes pixels between the same four columns of nodes. The gradients of these nodes are then a product of
matrices: of the pixels' weights of the nodes, (4 l, pixels), and the gradients of the pixels' transforms, (pixels, 12).
A second kernel sums them over programs. Adding to nodes atomically would serialize: thousands of pixels share each.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.bilateral_grid.in_torch import LUMA
from lapgs_plugin.ops.launch import blocks, launch
from lapgs_plugin.ops.mixed_sizes import Sizes, sizes_on_device

BLOCK = 128
"""Pixels that a program takes at once."""
PIXELS = 512
"""Pixels of a program, about."""
MOST_SLICES = 16
"""Most programs of a cell of nodes."""
VARIED = 512
"""Numbers of a program of the total variation."""
RED, GREEN, BLUE = (tl.constexpr(weight) for weight in LUMA)


@triton.jit
def _start_of(cell: tl.tensor, pixels: tl.tensor, cells: tl.tensor) -> tl.tensor:
    """Return the first of so many pixels along a side whose centre is not before a cell."""
    return (2 * cell * pixels + cells - 1) // (2 * cells)


@triton.jit
def _part(
    sizes: tl.tensor, view: tl.tensor, rows: tl.tensor, slices: tl.tensor, across: tl.tensor, down: tl.tensor
) -> Any:
    """Return the cell of a program, its size in an image, and the pixels that the program takes of it.

    Returns:
        Column and row of the cell; pixels of a cell along both sides; first column and row of the program's pixels,
        their width, and their number.
    """
    column = tl.program_id(0) // slices % across
    row = tl.program_id(0) // slices // across
    width, height = tl.load(sizes + 2 * view), tl.load(sizes + 2 * view + 1)
    left, right = _start_of(column, width, across), _start_of(column + 1, width, across)
    top = _start_of(row, height, down) + tl.program_id(0) % slices * rows
    bottom = tl.minimum(top + rows, _start_of(row + 1, height, down))
    count = tl.maximum(bottom - top, 0) * (right - left)
    wide, high = width.to(tl.float32) / across.to(tl.float32), height.to(tl.float32) / down.to(tl.float32)
    return column, row, wide, high, left, top, tl.maximum(right - left, 1), count


@triton.jit
def _pixels(
    image: tl.tensor, start: int, cell: tl.tuple, line: int, by_channel: int, by_pixel: tl.constexpr,
    tones: tl.constexpr, block: tl.constexpr,
) -> Any:  # fmt: skip
    """Return some pixels of a program.

    Args:
        image: of the view.
        start: the first pixel.
        cell: result of `_part`.
        line: pixels of a line of the whole image.

    Returns:
        Where pixels are in the image, (block,); whether they are the program's, (block, 1); their colours and 1,
        (block, 4); how far they are along the cell to the right and down, (block,); and their brightness in tones, as
        it is and within the grid, (block,).
    """
    column, row, wide, high, left, top, width, count = cell
    number = start + tl.arange(0, block)
    here = (number < count)[:, None]
    x, y = left + number % width, top + number // width
    place = y * line + x
    channel = tl.arange(0, 4)[None, :]
    colors = tl.load(image + channel * by_channel + place[:, None] * by_pixel, here & (channel < 3), 0.0)
    colors = tl.where(channel == 3, 1.0, colors)
    over = tl.minimum(tl.maximum((x + 0.5) / wide - column, 0.0), 1.0)
    below = tl.minimum(tl.maximum((y + 0.5) / high - row, 0.0), 1.0)
    tone = tl.sum(colors * _luma(), axis=1) * (tones - 1)
    return place, here, colors, over, below, tone, tl.minimum(tl.maximum(tone, 0.0), tones - 1.0)


@triton.jit
def _luma() -> tl.tensor:
    """Return the weights of a pixel's colours, and of 1, in its brightness, (1, 4)."""
    channel = tl.arange(0, 4)[None, :]
    return tl.where(channel == 0, RED, tl.where(channel == 1, GREEN, tl.where(channel == 2, BLUE, 0.0)))


@triton.jit
def _row(
    nodes: tl.tensor, index: tl.constexpr, first: tl.tensor, over: tl.tensor, below: tl.tensor, down: tl.tensor,
    tones: tl.constexpr,
) -> Any:  # fmt: skip
    """Interpolate a row of the pixels' transforms between the columns of a cell.

    Args:
        nodes: of the cell's first column.
        index: of the row.
        first: the tone before each pixel, (block,).
        over, below: see `_pixels`.
        down: numbers from a column to that of the next row of the grid.

    Returns:
        The row at the tones before and after each pixel, (block, 4) each.
    """
    places = nodes + (first * 12 + 4 * index)[:, None] + tl.arange(0, 4)[None, :]
    before, after = tl.zeros((first.shape[0], 4), tl.float32), tl.zeros((first.shape[0], 4), tl.float32)
    for corner in tl.static_range(4):
        weight = (over if corner % 2 == 1 else 1.0 - over) * (below if corner // 2 == 1 else 1.0 - below)
        there = places + corner % 2 * tones * 12 + corner // 2 * down
        before += weight[:, None] * tl.load(there)
        after += weight[:, None] * tl.load(there + (12 if tones > 1 else 0))
    return before, after


SIZES = ("line", "rows", "slices", "x_nodes", "y_nodes", "by_view", "by_channel", "out_view", "out_channel")
"""Arguments that differ between image sizes: one compiled kernel serves all."""


@triton.jit(do_not_specialize=SIZES[:7])
def _apply(
    image: tl.tensor, grids: tl.tensor, sizes: tl.tensor, out: tl.tensor, line: int, rows: int, slices: int,
    x_nodes: int, y_nodes: int, by_view: int, by_channel: int,
    by_pixel: tl.constexpr, tones: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    view = tl.program_id(1)
    cell = _part(sizes, view, rows, slices, x_nodes - 1, y_nodes - 1)
    nodes = grids + ((view * y_nodes + cell[1]) * x_nodes + cell[0]).to(tl.int64) * (tones * 12)
    image += view.to(tl.int64) * by_view
    out += view.to(tl.int64) * by_view
    start = 0
    while start < cell[7]:  # `range` of a tensor cannot be interpreted with NumPy 2.4
        place, here, colors, over, below, _, tone = _pixels(
            image, start, cell, line, by_channel, by_pixel, tones, block
        )
        first = tl.minimum(tone.to(tl.int32), tl.maximum(tones - 2, 0))
        for index in tl.static_range(3):
            before, after = _row(nodes, index, first, over, below, x_nodes * (tones * 12), tones)
            row = before + (tone - first)[:, None] * (after - before)
            value = tl.sum(row * colors, axis=1)[:, None]
            tl.store(out + index * by_channel + place[:, None] * by_pixel, value, here)
        start += block


@triton.jit(do_not_specialize=SIZES)
def _gradients(
    image: tl.tensor, grids: tl.tensor, sizes: tl.tensor, by_out: tl.tensor, by_image: tl.tensor, sums: tl.tensor,
    line: int, rows: int, slices: int, x_nodes: int, y_nodes: int,
    by_view: int, by_channel: int, out_view: int, out_channel: int,
    by_pixel: tl.constexpr, out_pixel: tl.constexpr, tones: tl.constexpr, padded: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write gradients of pixels, and each program's sum of those of the nodes around its cell, (4 padded, 16)."""
    view = tl.program_id(1)
    cell = _part(sizes, view, rows, slices, x_nodes - 1, y_nodes - 1)
    nodes = grids + ((view * y_nodes + cell[1]) * x_nodes + cell[0]).to(tl.int64) * (tones * 12)
    image += view.to(tl.int64) * by_view
    by_image += view.to(tl.int64) * by_view
    by_out += view.to(tl.int64) * out_view
    channel = tl.arange(0, 4)[None, :]
    by_nodes = tl.zeros((4 * padded, 16), tl.float32)
    start = 0
    while start < cell[7]:
        place, here, colors, over, below, unbounded, tone = _pixels(
            image, start, cell, line, by_channel, by_pixel, tones, block
        )
        first = tl.minimum(tone.to(tl.int32), tl.maximum(tones - 2, 0))
        by_colors, by_tone = tl.zeros((block, 4), tl.float32), tl.zeros((block, 4), tl.float32)
        for index in tl.static_range(3):
            before, after = _row(nodes, index, first, over, below, x_nodes * (tones * 12), tones)
            slope = after - before
            by_value = tl.load(by_out + index * out_channel + place[:, None] * out_pixel, here, 0.0)
            by_colors += by_value * (before + (tone - first)[:, None] * slope)
            by_tone += by_value * slope
        inside = (unbounded > 0.0) & (unbounded < tones - 1)
        by_brightness = tl.where(inside, tl.sum(by_tone * colors, axis=1) * (tones - 1), 0.0)
        by_colors += _luma() * by_brightness[:, None]
        tl.store(by_image + channel * by_channel + place[:, None] * by_pixel, by_colors, here & (channel < 3))
        by_nodes = _add_to_nodes(
            by_nodes, image, by_out, place, (start + tl.arange(0, block) < cell[7])[None, :], over, below, tone,
            by_channel, out_channel, by_pixel, out_pixel,
        )  # fmt: skip
        start += block
    own = (view * tl.num_programs(0) + tl.program_id(0)).to(tl.int64) * (64 * padded)
    inner = tl.arange(0, 4 * padded)[:, None] * 16 + tl.arange(0, 16)[None, :]
    tl.store(sums + own + inner, by_nodes)


@triton.jit
def _add_to_nodes(
    by_nodes: tl.tensor, image: tl.tensor, by_out: tl.tensor, place: tl.tensor, here: tl.tensor, over: tl.tensor,
    below: tl.tensor, tone: tl.tensor, by_channel: int, out_channel: int, by_pixel: tl.constexpr,
    out_pixel: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return gradients of a cell's nodes, by corner and tone in rows, with those of some pixels added.

    Factors are rounded to TF32, by less than a thousandth.
    """
    padded: tl.constexpr = by_nodes.shape[0] // 4
    block: tl.constexpr = tone.shape[0]
    corner = tl.arange(0, 4)[:, None]  # pixels come last, so that threads lie along them
    corners = tl.where(corner % 2 == 1, over[None, :], 1.0 - over[None, :])
    corners *= tl.where(corner // 2 == 1, below[None, :], 1.0 - below[None, :])
    tones = tl.maximum(1.0 - tl.abs(tl.arange(0, padded)[:, None] - tone[None, :]), 0.0)
    weights = tl.reshape(corners[:, None, :] * tones[None, :, :], (4 * padded, block))
    shown = here & (corner < 3)
    by_values = tl.load(by_out + corner * out_channel + place[None, :] * out_pixel, shown, 0.0)
    colors = tl.load(image + corner * by_channel + place[None, :] * by_pixel, shown, 0.0)
    colors = tl.where(corner == 3, 1.0, colors)
    by_transforms = tl.reshape(by_values[:, None, :] * colors[None, :, :], (16, block))
    return tl.dot(weights, tl.trans(by_transforms), by_nodes, input_precision="tf32")


@triton.jit(do_not_specialize=("slices", "x_nodes", "y_nodes"))
def _sum(
    sums: tl.tensor, by_grids: tl.tensor, slices: int, x_nodes: int, y_nodes: int,
    tones: tl.constexpr, padded: tl.constexpr, most_slices: tl.constexpr,
) -> None:  # fmt: skip
    """Sum the gradients of the nodes of one column, which up to four cells have, over programs."""
    view = tl.program_id(1)
    x, y = tl.program_id(0) % x_nodes, tl.program_id(0) // x_nodes
    across, down = x_nodes - 1, y_nodes - 1
    inner = tl.arange(0, 16 * padded)
    part = tl.arange(0, most_slices)[:, None]
    total = tl.zeros((16 * padded,), tl.float32)
    for corner in tl.static_range(4):
        column, row = x - corner % 2, y - corner // 2
        beside = (column >= 0) & (column < across) & (row >= 0) & (row < down)
        program = ((view * down + row) * across + column) * slices + part
        place = program.to(tl.int64) * (64 * padded) + corner * (16 * padded) + inner[None, :]
        total += tl.sum(tl.load(sums + place, beside & (part < slices), 0.0), axis=0)
    number, tone = inner % 16, inner // 16
    place = (view * tl.num_programs(0) + tl.program_id(0)).to(tl.int64) * (tones * 12) + tone * 12 + number
    tl.store(by_grids + place, total, (number < 12) & (tone < tones))


@triton.jit(do_not_specialize=("n", "x_nodes", "y_nodes", "by_tone", "by_row", "by_column"))
def _variation(
    grids: tl.tensor, by_grids: tl.tensor, n: tl.tensor, x_nodes: int, y_nodes: int,
    by_tone: float, by_row: float, by_column: float, tones: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Add weighted differences from both neighbours along each axis."""
    place = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    here = place < n
    tone = place // 12 % tones
    x, y = place // (12 * tones) % x_nodes, place // (12 * tones) // x_nodes % y_nodes
    value = tl.load(grids + place, here, 0.0)
    slope = _bend(grids, place, value, x, x_nodes, 12 * tones, here) * by_column
    slope += _bend(grids, place, value, y, y_nodes, 12 * tones * x_nodes, here) * by_row
    slope += _bend(grids, place, value, tone, tones, 12, here) * by_tone
    tl.store(by_grids + place, tl.load(by_grids + place, here, 0.0) + slope, here)


@triton.jit
def _bend(
    grids: tl.tensor, place: tl.tensor, value: tl.tensor, index: tl.tensor, count: tl.tensor, step: tl.tensor,
    here: tl.tensor,
) -> tl.tensor:  # fmt: skip
    """Return the sum of a node's differences from its neighbours along one axis, which has `count` nodes."""
    before = value - tl.load(grids + place - step, here & (index > 0), 0.0)
    after = value - tl.load(grids + place + step, here & (index < count - 1), 0.0)
    return tl.where(index > 0, before, 0.0) + tl.where(index < count - 1, after, 0.0)


class _Sliced(torch.autograd.Function):
    """Map images (b, 3, h * w) without gaps and contiguous grids (b, y, x, l, 12) to images with their strides."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, grids: Tensor, size: tuple[int, int], sizes: Sizes | None) -> Tensor:
        own = sizes_on_device(sizes or [size] * len(image), image.device)
        ctx.save_for_backward(image, grids, own)
        ctx.size, ctx.mixed = size, sizes is not None
        out = torch.empty_like(image)
        assert out.stride() == image.stride(), "images without gaps"
        programs, numbers, constants = _shape(grids, size)
        *strides, by_pixel = image.stride()
        launch(_apply, programs, image, grids, own, out, *numbers, *strides, by_pixel=by_pixel, **constants)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_out: Tensor) -> tuple[Tensor, Tensor, None, None]:
        image, grids, own = ctx.saved_tensors
        by_image = torch.zeros_like(image) if ctx.mixed else torch.empty_like(image)
        programs, numbers, constants = _shape(grids, ctx.size)
        tones, padded = constants["tones"], max(4, triton.next_power_of_2(constants["tones"]))
        sums = torch.empty(*reversed(programs), 64 * padded, device=grids.device)
        (*strides, by_pixel), (*out_strides, out_pixel) = image.stride(), by_out.stride()
        launch(
            _gradients, programs,
            image, grids, own, by_out, by_image, sums, *numbers, *strides, *out_strides,
            by_pixel=by_pixel, out_pixel=out_pixel, padded=padded, **constants,
        )  # fmt: skip
        by_grids = torch.empty_like(grids)
        _, _, slices, x_nodes, y_nodes = numbers
        launch(
            _sum, (x_nodes * y_nodes, len(grids)), sums, by_grids, slices, x_nodes, y_nodes,
            tones=tones, padded=padded, most_slices=triton.next_power_of_2(slices),
        )  # fmt: skip
        return by_image, by_grids, None, None


def _shape(grids: Tensor, size: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, ...], dict[str, int]]:
    """Return the programs of the kernels of pixels, their numbers from `line` to `y_nodes`, and their constants."""
    views, y_nodes, x_nodes, tones, _ = grids.shape
    (width, height), across, down = size, x_nodes - 1, y_nodes - 1
    wide, high = blocks(width, across), blocks(height, down)  # most pixels of a cell
    rows = max(1, PIXELS // wide, blocks(high, MOST_SLICES))
    slices = blocks(high, rows)
    numbers = width, rows, slices, x_nodes, y_nodes
    return (across * down * slices, views), numbers, {"tones": tones, "block": BLOCK}


def slice_grids_triton(image: Tensor, grids: Tensor, sizes: Sizes | None = None) -> Tensor:
    """Do `slice_grids` for float32 images on a CUDA device, whose strides the result has."""
    height, width = image.shape[-2:]
    pixels = image.flatten(-2).reshape(-1, 3, height * width)
    if not (pixels.is_contiguous() or pixels.mT.is_contiguous()):
        pixels = pixels.contiguous()
    each = grids.reshape(-1, *grids.shape[-4:]).contiguous()
    out: Tensor = _Sliced.apply(pixels, each, (width, height), sizes)  # type: ignore[no-untyped-call]  # torch's
    return out.view(image.shape)


def add_variation_triton(grids: Tensor, by_grids: Tensor, weight: float) -> None:
    """Do `add_variation` for float32 grids on a CUDA device."""
    _, y_nodes, x_nodes, tones, _ = grids.shape
    # Of the mean over all pairs of neighbours, whose number along an axis of n nodes is (n - 1) / n of that of nodes.
    mean = 2 * weight / (12 * tones * y_nodes * x_nodes)
    factors = [mean * count * (count - 1) for count in (tones, y_nodes, x_nodes)]
    n = grids.numel()
    launch(_variation, (blocks(n, VARIED),), grids, by_grids, n, x_nodes, y_nodes, *factors, tones=tones, block=VARIED)
