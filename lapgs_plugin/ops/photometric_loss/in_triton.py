"""Compute the photometric loss on a GPU in two kernels, one for the loss and one for its gradient.

A program of 128 threads takes a strip of the image and walks down its rows; a thread has two neighbouring columns of a
colour. It filters a row across from its neighbours in memory, which the L1 cache holds, and down in registers: it adds
the row to the ten sums of output rows that are not complete. No filtered image is written. The loss's kernel writes
three maps, the derivatives of SSIM by the local means; the gradient's kernel filters them the same way.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, current_stream, launch, rows_of_program
from lapgs_plugin.ops.mixed_sizes import Sizes, sizes_on_device
from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_WINDOW

COLORS = 3
BLOCK = 128
LEAST_ROWS = 16
"""Fewest rows of a program, which reads ten more."""

PAIRS = 128
"""Pairs of zeros that are filled together."""
ZERO_STEP = 4
"""Numbers from one to the next: `launch` wants tensors that begin at multiples of 16 bytes."""
_zeros: dict[tuple[torch.device, int], list[tuple[Tensor, Tensor]]] = {}  # that are left, by device and stream

_Launch = tuple[tuple[int, int, int], tuple[float, ...], dict[str, int]]
"""Programs, numbers and constants of a launch."""

CONSTANTS: dict[str, Any] = {"window": SSIM_WINDOW, "radius": SSIM_RADIUS, "colors": COLORS, "block": BLOCK}
"""Arguments of both kernels that they are compiled for."""
SSIM_CONSTANTS: dict[str, Any] = {"c1": SSIM_C1, "c2": SSIM_C2}

# Triton would compile a kernel again for integers that are 1 or multiples of 16, so for many image sizes.
OF_ANY_VALUE = (
    *("height", "width", "rows", "map_size", "x_image", "x_plane", "x_row", "y_image", "y_plane", "y_row"),
    *("scale", "l1_weight", "ssim_weight"),
)


@triton.jit
def _place(width: int, colors: tl.constexpr, interleaved: tl.constexpr, block: tl.constexpr, beyond: tl.constexpr):  # type: ignore[no-untyped-def]
    """Return the first of two columns of each thread, and its colour; neighbouring threads are neighbours in memory."""
    places, pairs = tl.program_id(0) * block + tl.arange(0, block), (width + 1) // 2
    color = places % colors if interleaved else places // pairs
    column = 2 * (places // colors if interleaved else places % pairs)
    return tl.where(places < pairs * colors, column, width + beyond), color


@triton.jit
def _own_size(
    size: tl.tensor, width: int, height: int, l1_weight: float, ssim_weight: float, mixed: tl.constexpr
) -> tl.tensor:
    """Return an image's width and height, and the weights of one of its pixels."""
    if mixed:
        width, height = tl.load(size), tl.load(size + 1)
        pixels = 1.0 * width * height
        l1_weight, ssim_weight = l1_weight / pixels, ssim_weight / pixels
    return width, height, l1_weight, ssim_weight


@triton.jit
def _shifted(sums: tl.tuple, row: tl.tensor, window: tl.constexpr, radius: tl.constexpr) -> tl.tuple:
    """Add a row to the sums of output rows that are not complete: (the complete one, the others with a new one)."""
    after = ()
    for k in tl.static_range(2 * radius - 1):
        after = after + (sums[k + 1] + window[2 * radius - 1 - k] * row,)  # type: ignore[assignment]  # noqa: RUF005
    return sums[0] + window[2 * radius] * row, after + (window[0] * row,)  # noqa: RUF005  # Triton compiles no stars


@triton.jit
def _ssim(
    mean: tl.tensor, mean_y: tl.tensor, squares: tl.tensor, products: tl.tensor, c1: tl.constexpr, c2: tl.constexpr
) -> tl.tuple:  # fmt: skip
    """Return SSIM and its derivatives by the local means of x, x squared and x y; `squares` is that of x^2 + y^2."""
    means, both = mean * mean + mean_y * mean_y, mean * mean_y
    luminance, structure = 2.0 * both + c1, 2.0 * (products - both) + c2
    of_means, of_variances = 1.0 / (means + c1), 1.0 / (squares - means + c2)
    per = of_means * of_variances
    ssim = luminance * structure * per
    slope = 2.0 * (mean_y * (structure - luminance) * per + mean * ssim * (of_variances - of_means))
    return ssim, slope, -ssim * of_variances, 2.0 * luminance * per


@triton.jit
def _with_l1(
    loss: tl.tensor, distance: tl.tensor, difference: tl.tensor, counted: tl.tensor, l1_weight: float,
    apart: tl.constexpr,
) -> tl.tuple:  # fmt: skip
    """Add a row's L1 to the loss, and to the sum of L1 alone if that is `apart`."""
    if apart:
        distance += tl.where(counted, 1.0, 0.0) * difference
    return loss + tl.where(counted, l1_weight, 0.0) * difference, distance


@triton.jit
def _add(
    total: tl.tensor, l1: tl.tensor, loss: tl.tensor, distance: tl.tensor, count: float, apart: tl.constexpr
) -> None:
    """Add a program's part to the loss, and to L1 of `count` values if that is `apart`."""
    tl.atomic_add(total, tl.sum(loss))  # NaN stays NaN, which stops a diverged run
    if apart:
        tl.atomic_add(l1, tl.sum(distance) / count)


@triton.jit(do_not_specialize=OF_ANY_VALUE)
def _loss_kernel(
    x: tl.tensor, y: tl.tensor, maps: tl.tensor, total: tl.tensor, l1: tl.tensor, values: tl.tensor, sizes: tl.tensor,
    height: int, width: int, rows: int, map_size: int, scale: float, l1_weight: float, ssim_weight: float,
    x_image: int, x_plane: int, x_row: int, y_image: int, y_plane: int, y_row: int,
    x_column: tl.constexpr, y_column: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, mapped: tl.constexpr,
    apart: tl.constexpr, interleaved: tl.constexpr, mixed: tl.constexpr, window: tl.constexpr, radius: tl.constexpr,
    colors: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write the derivatives of SSIM by the local means of x, x squared and x y, and add to the loss.

    Args:
        x, y: prediction and target; *_image, *_plane, *_row, *_column are strides.
        maps: these three, each with the strides of x, and `map_size` numbers from one to the next.
        total: the loss, where lambda is there before, or 0 if `apart` is 1; unused if `mapped`.
        l1: L1 alone; unused unless `apart` is 1, for sizes that are not `mixed`.
        values: SSIM itself, with the strides of x; unused unless `mapped`.
        sizes: (b, 2) of the images' own parts if they are `mixed`; weights are then divided by their pixels here.
        scale: of y.
    """
    image, first = tl.program_id(2).to(tl.int64), tl.program_id(1) * rows
    width, height, l1_weight, ssim_weight = _own_size(sizes + 2 * image, width, height, l1_weight, ssim_weight, mixed)
    column, color = _place(width, colors, interleaved, block, 2 * radius)
    last = tl.minimum(first + rows, height)
    at_x = image * x_image + color * x_plane + column * x_column
    of_y = y + image * y_image + color * y_plane + column * y_column
    out, inside = tl.join(at_x, at_x + x_column), tl.join(column < width, column + 1 < width)  # (block, 2)
    zero, zeros = tl.zeros((block,), tl.float32), tl.zeros((block, 2), tl.float32)
    sums_x = (zeros,) * (2 * radius)
    sums_y, sums_square, sums_product, loss, distance, row = sums_x, sums_x, sums_x, zeros, zeros, first - radius
    while row < last + radius:  # `range` of a tensor cannot be interpreted
        limit = tl.where((row >= 0) & (row < height), width, 0)  # of the columns; none outside of the image
        x0, x1, y0, y1, square0, square1, product0, product1 = zero, zero, zero, zero, zero, zero, zero, zero
        difference0, difference1 = zero, zero
        for near in tl.static_range(2 * radius + 2):
            there = (column + (near - radius)).to(tl.uint32) < limit.to(tl.uint32)
            one = tl.load(x + at_x + row.to(tl.int64) * x_row + (near - radius) * x_column, there, 0.0)
            other = (
                tl.load(of_y + row.to(tl.int64) * y_row + (near - radius) * y_column, there, 0).to(tl.float32) * scale
            )
            square, product = one * one + other * other, one * other
            if near <= 2 * radius:
                x0 += window[near] * one
                y0 += window[near] * other
                square0 += window[near] * square
                product0 += window[near] * product
            if near > 0:
                x1 += window[near - 1] * one
                y1 += window[near - 1] * other
                square1 += window[near - 1] * square
                product1 += window[near - 1] * product
            if near == radius:
                difference0 = tl.abs(one - other)
            if near == radius + 1:
                difference1 = tl.abs(one - other)
        loss, distance = _with_l1(
            loss, distance, tl.join(difference0, difference1), (row >= first) & (row < last), l1_weight, apart
        )
        mean, sums_x = _shifted(sums_x, tl.join(x0, x1), window, radius)
        mean_y, sums_y = _shifted(sums_y, tl.join(y0, y1), window, radius)
        squares, sums_square = _shifted(sums_square, tl.join(square0, square1), window, radius)
        products, sums_product = _shifted(sums_product, tl.join(product0, product1), window, radius)
        if row >= first + radius:
            ssim, slope, curvature, share = _ssim(mean, mean_y, squares, products, c1, c2)
            loss -= tl.where(inside, ssim_weight * (ssim - apart), 0.0)
            here = out + (row - radius).to(tl.int64) * x_row
            tl.store(maps + here, slope, inside)
            tl.store(maps + map_size + here, curvature, inside)
            tl.store(maps + map_size + map_size + here, share, inside)
            if mapped:
                tl.store(values + here, ssim, inside)
        row += 1
    if not mapped:
        _add(total, l1, loss, distance, 1.0 * width * height * colors * tl.num_programs(2), apart)


@triton.jit(do_not_specialize=OF_ANY_VALUE)
def _gradient_kernel(
    x: tl.tensor, y: tl.tensor, maps: tl.tensor, by_loss: tl.tensor, gradient: tl.tensor, sizes: tl.tensor,
    height: int, width: int, rows: int, map_size: int, scale: float, l1_weight: float, ssim_weight: float,
    x_image: int, x_plane: int, x_row: int, y_image: int, y_plane: int, y_row: int,
    x_column: tl.constexpr, y_column: tl.constexpr, interleaved: tl.constexpr, mixed: tl.constexpr,
    window: tl.constexpr, radius: tl.constexpr, colors: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write the gradient by x, with the strides of x; arguments as `_loss_kernel` takes them."""
    by_square, by_product = maps + map_size, maps + map_size + map_size
    image = tl.program_id(2).to(tl.int64)
    width, height, l1_weight, ssim_weight = _own_size(sizes + 2 * image, width, height, l1_weight, ssim_weight, mixed)
    column, color = _place(width, colors, interleaved, block, 2 * radius)
    first = tl.program_id(1) * rows
    last = tl.minimum(first + rows, height)
    at_x = image * x_image + color * x_plane + column * x_column
    at_y = image * y_image + color * y_plane + column * y_column
    # (block, 2) each
    of_x, of_y = tl.join(at_x, at_x + x_column), tl.join(at_y, at_y + y_column)
    inside = tl.join(column < width, column + 1 < width)
    factor = tl.load(by_loss)
    l1_weight, ssim_weight = l1_weight * factor, ssim_weight * factor
    zero = tl.zeros((block,), tl.float32)
    sums_mean = (tl.zeros((block, 2), tl.float32),) * (2 * radius)
    sums_square, sums_product = sums_mean, sums_mean
    row = first - radius
    while row < last + radius:
        limit = tl.where((row >= 0) & (row < height), width, 0)
        mean0, mean1, square0, square1, product0, product1 = zero, zero, zero, zero, zero, zero
        for near in tl.static_range(2 * radius + 2):
            there = (column + (near - radius)).to(tl.uint32) < limit.to(tl.uint32)
            here = at_x + row.to(tl.int64) * x_row + (near - radius) * x_column
            mean, square = tl.load(maps + here, there, 0.0), tl.load(by_square + here, there, 0.0)
            product = tl.load(by_product + here, there, 0.0)
            if near <= 2 * radius:
                mean0 += window[near] * mean
                square0 += window[near] * square
                product0 += window[near] * product
            if near > 0:
                mean1 += window[near - 1] * mean
                square1 += window[near - 1] * square
                product1 += window[near - 1] * product
        means, sums_mean = _shifted(sums_mean, tl.join(mean0, mean1), window, radius)
        squares, sums_square = _shifted(sums_square, tl.join(square0, square1), window, radius)
        products, sums_product = _shifted(sums_product, tl.join(product0, product1), window, radius)
        if row >= first + radius:
            at = of_x + (row - radius).to(tl.int64) * x_row
            one = tl.load(x + at, inside, 0.0)
            other = tl.load(y + of_y + (row - radius).to(tl.int64) * y_row, inside, 0).to(tl.float32) * scale
            sign = tl.where(one > other, l1_weight, 0.0) - tl.where(one < other, l1_weight, 0.0)
            ssim = means + 2.0 * one * squares + other * products
            tl.store(gradient + at, sign - ssim_weight * ssim, inside)
        row += 1


class _PhotometricLoss(torch.autograd.Function):
    """Map (prediction, target, ssim_weight, sizes or None, apart) to the loss; to (loss, L1) if `apart`, without sizes.

    Images are (3, h, w) or (b, 3, h, w), the prediction's as `_without_gaps` returns it.
    """

    @staticmethod
    def forward(
        ctx: Any, prediction: Tensor, target: Tensor, ssim_weight: float, sizes: Sizes | None, apart: bool
    ) -> Tensor | tuple[Tensor, Tensor]:
        if apart:
            total, l1 = _two_zeros(prediction.device)
        else:
            total = l1 = torch.full((), ssim_weight, device=prediction.device)
        maps = _empty_maps(prediction)
        own = prediction if sizes is None else sizes_on_device(sizes, prediction.device)
        programs, numbers, constants = _launch_of(prediction, target, ssim_weight, mixed=sizes is not None)
        launch(
            _loss_kernel, programs, prediction, target, maps, total, l1, total, own, *numbers, **constants,
            **SSIM_CONSTANTS, mapped=False, apart=int(apart), **CONSTANTS,
        )  # fmt: skip
        ctx.save_for_backward(prediction, target, maps)
        ctx.ssim_weight, ctx.own = ssim_weight, None if sizes is None else own
        ctx.set_materialize_grads(False)
        return (total, l1) if apart else total

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_loss: Tensor | None, by_l1: Tensor | None = None
    ) -> tuple[Tensor | None, None, None, None, None]:
        prediction, target, maps = ctx.saved_tensors
        by_distance = None
        if by_l1 is not None:  # seldom: loops of the family only log it
            by_distance = by_l1 / prediction.numel() * (prediction - target).sign()
        if by_loss is None:
            return by_distance, None, None, None, None
        mixed = ctx.own is not None
        gradient = torch.zeros_like(prediction) if mixed else torch.empty_like(prediction)
        programs, numbers, constants = _launch_of(prediction, target, ctx.ssim_weight, mixed=mixed)
        launch(
            _gradient_kernel, programs, prediction, target, maps, by_loss, gradient, ctx.own if mixed else gradient,
            *numbers, **constants, **CONSTANTS,
        )  # fmt: skip
        return gradient if by_distance is None else gradient + by_distance, None, None, None, None


def _empty_maps(prediction: Tensor) -> Tensor:
    """Return room for the three maps that the loss's kernel writes."""
    return prediction.new_empty(3 * prediction.numel())


def _two_zeros(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return two new scalars 0 of the current stream; many are filled in one launch."""
    pairs = _zeros.setdefault((device, current_stream(device)), [])
    if not pairs:
        with torch.inference_mode(False):
            block = torch.zeros(2 * PAIRS, ZERO_STEP, device=device)
            # Their data, which are no views: scripts may change a loss in place.
            scalars = [scalar.data for scalar in block[:, 0].unbind()]
        pairs += zip(scalars[::2], scalars[1::2], strict=True)
    return pairs.pop()


class _SsimMap(torch.autograd.Function):
    """Map (prediction, target), images (b, 3, h, w), to SSIM of each pixel and colour."""

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor) -> Tensor:
        values, maps = torch.empty_like(prediction), _empty_maps(prediction)
        programs, numbers, constants = _launch_of(prediction, target, 1.0)
        launch(
            _loss_kernel, programs, prediction, target, maps, values, values, values, values, *numbers, **constants,
            **SSIM_CONSTANTS, mapped=True, apart=0, **CONSTANTS,
        )  # fmt: skip
        ctx.save_for_backward(prediction, target, maps)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_values: Tensor) -> tuple[Tensor, None]:
        prediction, target, maps = ctx.saved_tensors
        gradient = torch.empty_like(prediction)
        # The kernel takes the derivative of a loss that has -1 / numel of each value, times a factor.
        maps = (maps.view(3, -1) * by_values.reshape(-1)).view(-1)
        factor = prediction.new_full((), -prediction.numel())
        programs, numbers, constants = _launch_of(prediction, target, 1.0)
        launch(
            _gradient_kernel, programs, prediction, target, maps, factor, gradient, gradient, *numbers, **constants,
            **CONSTANTS,
        )  # fmt: skip
        return gradient, None


def _launch_of(prediction: Tensor, target: Tensor, ssim_weight: float, *, mixed: bool = False) -> _Launch:
    """Return the programs of a launch, and the numbers and constants that both kernels share.

    Weights are those of a pixel and colour, or if sizes are `mixed` of a view and colour.
    """
    strides = prediction.stride(), target.stride()
    return _launch_of_images(prediction.shape, *strides, target.dtype == torch.uint8, ssim_weight, mixed)


@lru_cache(maxsize=256)
def _launch_of_images(
    shape: torch.Size, x_strides: tuple[int, ...], y_strides: tuple[int, ...], eight_bit: bool, ssim_weight: float,
    mixed: bool,
) -> _Launch:  # fmt: skip
    # One image (3, h, w) is a batch of one.
    b, colors, h, w = (1, *shape)[-4:]
    *x_others, x_column = (0, *x_strides)[-4:]
    *y_others, y_column = (0, *y_strides)[-4:]
    assert colors == COLORS, f"{colors} colours"
    strips = blocks(blocks(w, 2) * COLORS, BLOCK)
    rows = rows_of_program(h, strips * b, LEAST_ROWS)
    per_value = 1 / (b * COLORS if mixed else shape.numel())
    weights = (1 - ssim_weight) * per_value, ssim_weight * per_value
    numbers = h, w, rows, shape.numel(), 1 / 255 if eight_bit else 1.0, *weights, *x_others, *y_others
    constants = {"x_column": x_column, "y_column": y_column, "interleaved": x_others[1] == 1, "mixed": mixed}
    return (strips, blocks(h, rows), b), numbers, constants


def photometric_loss_triton(
    prediction: Tensor, target: Tensor, ssim_weight: float, sizes: Sizes | None = None
) -> Tensor:
    """Do `photometric_loss` for float32 predictions on a CUDA device, of any strides; float16 and uint8 targets too."""
    options = target, ssim_weight, sizes, False
    loss: Tensor = _PhotometricLoss.apply(_without_gaps(prediction), *options)  # type: ignore[no-untyped-call]  # torch's
    return loss


def loss_and_l1_triton(prediction: Tensor, target: Tensor, ssim_weight: float) -> tuple[Tensor, Tensor]:
    """Do `loss_and_l1` for float32 images on a CUDA device, of any strides."""
    # As a batch of one an image would take a node of the backward pass, and more operations.
    options = target, ssim_weight, None, True
    values: tuple[Tensor, Tensor] = _PhotometricLoss.apply(_without_gaps(prediction), *options)  # type: ignore[no-untyped-call]
    return values


def ssim_map_triton(prediction: Tensor, target: Tensor) -> Tensor:
    """Do `ssim_map` for float32 images (b, 3, h, w) on a CUDA device, of any strides."""
    values: Tensor = _SsimMap.apply(prediction.contiguous(), target)  # type: ignore[no-untyped-call]  # torch's
    return values


def _without_gaps(image: Tensor) -> Tensor:
    """Return an image whose maps and gradient can have its strides."""
    return image if image.is_contiguous() or image.movedim(-3, -1).is_contiguous() else image.contiguous()
