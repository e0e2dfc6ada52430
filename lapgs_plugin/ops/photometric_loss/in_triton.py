"""Compute the photometric loss on a GPU in two kernels, one for the loss and one for its gradient.

A program of 128 threads takes a strip of an image row, 128 values of interleaved colours, and walks down the rows. Each
thread filters a row across from its neighbours in memory, which the L1 cache holds, and down in registers: it adds the
row to the ten sums of output rows that are not complete. No filtered image is written. The loss's kernel writes three
maps, the derivatives of SSIM by the local means; the gradient's kernel filters them the same way.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_SIGMA, as_batch

COLORS = 3
BLOCK = 128
MOST_ROWS, LEAST_ROWS, ENOUGH_PROGRAMS = 64, 16, 1500
"""Rows of a program, which reads ten more. It takes fewer where an image would make less than so many programs."""

TAPS = 2 * SSIM_RADIUS + 1
_gauss = [math.exp(-((tap - SSIM_RADIUS) ** 2) / (2 * SSIM_SIGMA**2)) for tap in range(TAPS)]
WINDOW = tuple(each / math.fsum(_gauss) for each in _gauss)
"""The window of SSIM along one side."""

CONSTANTS: dict[str, Any] = {"window": WINDOW, "radius": SSIM_RADIUS, "colors": COLORS, "block": BLOCK}
"""Arguments of both kernels that they are compiled for."""

# Triton would compile a kernel again for integers that are 1 or multiples of 16, so for many image sizes.
OF_ANY_VALUE = (
    *("height", "width", "rows", "x_image", "x_plane", "x_row", "y_image", "y_plane", "y_row"),
    *("scale", "l1_weight", "ssim_weight"),
)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _shifted(sums: tl.tuple, row: tl.tensor, window: tl.constexpr, radius: tl.constexpr) -> tl.tuple:
    """Add a row to the sums of output rows that are not complete: (the complete one, the others with a new one)."""
    after = ()
    for k in tl.static_range(2 * radius - 1):
        after = after + (sums[k + 1] + window[2 * radius - 1 - k] * row,)  # type: ignore[assignment]  # noqa: RUF005
    return sums[0] + window[2 * radius] * row, after + (window[0] * row,)  # noqa: RUF005  # Triton compiles no stars


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _loss_kernel(
    x: tl.tensor, y: tl.tensor, by_mean: tl.tensor, by_square: tl.tensor, by_product: tl.tensor, total: tl.tensor,
    height: int, width: int, rows: int, scale: float, l1_weight: float, ssim_weight: float,
    x_image: int, x_plane: int, x_row: int, x_column: tl.constexpr,
    y_image: int, y_plane: int, y_row: int, y_column: tl.constexpr,
    c1: tl.constexpr, c2: tl.constexpr,
    window: tl.constexpr, radius: tl.constexpr, colors: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write the derivatives of SSIM by the local means of x, x squared and x y, and add to the loss.

    Args:
        x, y: prediction and target; *_image, *_plane, *_row, *_column are strides.
        by_mean, by_square, by_product: (images, height, width * colors).
        total: the loss.
        scale: of y.
    """
    places = tl.program_id(0) * block + tl.arange(0, block)  # in a row of interleaved colours
    column, color = places // colors, places % colors
    image = tl.program_id(2).to(tl.int64)
    first = tl.program_id(1) * rows
    last = tl.minimum(first + rows, height)
    of_x = x + image * x_image + color * x_plane + column * x_column
    of_y = y + image * y_image + color * y_plane + column * y_column
    out = image * height * width * colors + places
    zero = tl.zeros((block,), tl.float32)
    sums_x = (zero,) * (2 * radius)
    sums_y, sums_square, sums_product, loss = sums_x, sums_x, sums_x, zero
    row = first - radius
    while row < last + radius:  # `range` of a tensor cannot be interpreted
        limit = tl.where((row >= 0) & (row < height), width, 0)  # of the columns; none outside of the image
        own = tl.where((row >= first) & (row < last), l1_weight, 0.0)
        row_x, row_y, square, product = zero, zero, zero, zero
        for tap in tl.static_range(2 * radius + 1):
            there = (column + (tap - radius)).to(tl.uint32) < limit.to(tl.uint32)
            one = tl.load(of_x + row.to(tl.int64) * x_row + (tap - radius) * x_column, there, 0.0)
            other = tl.load(of_y + row.to(tl.int64) * y_row + (tap - radius) * y_column, there, 0)
            other = other.to(tl.float32) * scale
            weighted, weighted_other = window[tap] * one, window[tap] * other
            row_x += weighted
            row_y += weighted_other
            square += weighted * one + weighted_other * other
            product += weighted * other
            if tap == radius:
                loss += own * tl.abs(one - other)
        mean, sums_x = _shifted(sums_x, row_x, window, radius)
        mean_y, sums_y = _shifted(sums_y, row_y, window, radius)
        squares, sums_square = _shifted(sums_square, square, window, radius)
        products, sums_product = _shifted(sums_product, product, window, radius)
        if row >= first + radius:
            inside = column < width
            means, both = mean * mean + mean_y * mean_y, mean * mean_y
            luminance, structure = 2.0 * both + c1, 2.0 * (products - both) + c2
            of_means, of_variances = 1.0 / (means + c1), 1.0 / (squares - means + c2)
            per = of_means * of_variances
            ssim = luminance * structure * per
            loss -= tl.where(inside, ssim_weight * ssim, 0.0)
            here = out + (row - radius).to(tl.int64) * (width * colors)
            slope = 2.0 * (mean_y * (structure - luminance) * per + mean * ssim * (of_variances - of_means))
            tl.store(by_mean + here, slope, inside)
            tl.store(by_square + here, -ssim * of_variances, inside)
            tl.store(by_product + here, 2.0 * luminance * per, inside)
        row += 1
    tl.atomic_add(total, tl.sum(loss))  # NaN stays NaN, which stops a diverged run


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _gradient_kernel(
    x: tl.tensor, y: tl.tensor, by_mean: tl.tensor, by_square: tl.tensor, by_product: tl.tensor,
    by_loss: tl.tensor, gradient: tl.tensor,
    height: int, width: int, rows: int, scale: float, l1_weight: float, ssim_weight: float,
    x_image: int, x_plane: int, x_row: int, x_column: tl.constexpr,
    y_image: int, y_plane: int, y_row: int, y_column: tl.constexpr,
    window: tl.constexpr, radius: tl.constexpr, colors: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    """Write the gradient by x, with the strides of x; arguments as `_loss_kernel` takes them."""
    places = tl.program_id(0) * block + tl.arange(0, block)
    column, color = places // colors, places % colors
    image = tl.program_id(2).to(tl.int64)
    first = tl.program_id(1) * rows
    last = tl.minimum(first + rows, height)
    of_x = image * x_image + color * x_plane + column * x_column
    of_y = image * y_image + color * y_plane + column * y_column
    of_maps = image * height * width * colors + places
    factor = tl.load(by_loss)
    l1_weight, ssim_weight = l1_weight * factor, ssim_weight * factor
    zero = tl.zeros((block,), tl.float32)
    sums_mean = (zero,) * (2 * radius)
    sums_square, sums_product = sums_mean, sums_mean
    row = first - radius
    while row < last + radius:  # `range` of a tensor cannot be interpreted
        limit = tl.where((row >= 0) & (row < height), width, 0)
        here = of_maps + row.to(tl.int64) * (width * colors)
        mean, square, product = zero, zero, zero
        for tap in tl.static_range(2 * radius + 1):
            there = (column + (tap - radius)).to(tl.uint32) < limit.to(tl.uint32)
            near = here + (tap - radius) * colors
            mean += window[tap] * tl.load(by_mean + near, there, 0.0)
            square += window[tap] * tl.load(by_square + near, there, 0.0)
            product += window[tap] * tl.load(by_product + near, there, 0.0)
        means, sums_mean = _shifted(sums_mean, mean, window, radius)
        squares, sums_square = _shifted(sums_square, square, window, radius)
        products, sums_product = _shifted(sums_product, product, window, radius)
        if row >= first + radius:
            inside = column < width
            at = of_x + (row - radius).to(tl.int64) * x_row
            one = tl.load(x + at, inside, 0.0)
            other = tl.load(y + of_y + (row - radius).to(tl.int64) * y_row, inside, 0).to(tl.float32) * scale
            sign = tl.where(one > other, l1_weight, 0.0) - tl.where(one < other, l1_weight, 0.0)
            ssim = means + 2.0 * one * squares + other * products
            tl.store(gradient + at, sign - ssim_weight * ssim, inside)
        row += 1


class _PhotometricLoss(torch.autograd.Function):
    """Map (prediction, target, ssim_weight), images (b, 3, h, w), to the loss."""

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        total = torch.full((), ssim_weight, device=prediction.device)
        b, colors, h, w = prediction.shape
        assert colors == COLORS, f"{colors} colours"
        maps = [torch.empty(b, h, w * COLORS, device=prediction.device) for _ in range(3)]
        grid, sizes = _grid(prediction, target, ssim_weight)
        constants = {"c1": SSIM_C1, "c2": SSIM_C2, **CONSTANTS}
        launch: Any = _loss_kernel[grid]
        launch(prediction, target, *maps, total, *sizes, **constants)
        ctx.save_for_backward(prediction, target, *maps)
        ctx.ssim_weight = ssim_weight
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_loss: Tensor) -> tuple[Tensor, None, None]:
        prediction, target, *maps = ctx.saved_tensors
        gradient = torch.empty_like(prediction)
        assert gradient.stride() == prediction.stride(), "a prediction without gaps"
        grid, sizes = _grid(prediction, target, ctx.ssim_weight)
        launch: Any = _gradient_kernel[grid]
        launch(prediction, target, *maps, by_loss, gradient, *sizes, **CONSTANTS)
        return gradient, None, None


def _grid(prediction: Tensor, target: Tensor, ssim_weight: float) -> tuple[tuple[int, int, int], tuple[Any, ...]]:
    """Return the programs of a launch, and the arguments that both kernels share."""
    b, _, h, w = prediction.shape
    strips = triton.cdiv(w * COLORS, BLOCK)
    rows = MOST_ROWS
    while rows > LEAST_ROWS and strips * triton.cdiv(h, rows) * b < ENOUGH_PROGRAMS:
        rows //= 2
    each = 1 / prediction.numel()
    scale = 1 / 255 if target.dtype == torch.uint8 else 1.0
    weights = (1 - ssim_weight) * each, ssim_weight * each
    return (strips, triton.cdiv(h, rows), b), (
        *(h, w, rows, scale, *weights), *prediction.stride(), *target.stride(),
    )  # fmt: skip


def photometric_loss_triton(prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Do `photometric_loss` for images on a CUDA device, of any strides.

    Args:
        prediction: (3, h, w) or (b, 3, h, w), float32.
        target: of that shape; float32, float16, or uint8 levels k of k / 255.
        ssim_weight: lambda.
    """
    images = as_batch(prediction), as_batch(target)
    loss: Tensor = _PhotometricLoss.apply(*images, ssim_weight)  # type: ignore[no-untyped-call]  # torch's
    return loss
