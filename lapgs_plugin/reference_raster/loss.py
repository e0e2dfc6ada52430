"""L1 + SSIM on the CPU, fused with its gradient: the photometric loss of 3DGS in one pass over the images.

SSIM is the one 3DGS trains with: an 11x11 Gaussian window of sigma 1.5, zeros outside the image, nothing clamped, the
mean over all pixels and channels. As PyTorch convolutions it costs more than rasterizing the image on a CPU. Here the
rows of a block stream through two buffers that stay in the cache, and only the gradient is written to memory:

    prediction, target -> moments -> filtered down, then across -> SSIM and its derivatives with respect to the moments
    -> filtered down, then across -> gradient

The window is separable and symmetric and everything outside the image is zero, so the filter is its own adjoint.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.reference_raster._jit import inline, jit
from lapgs_plugin.reference_raster.lanes import (
    WIDTH,
    Floats,
    Lanes,
    absolute,
    fetch_add,
    fma,
    load,
    select,
    splat,
    store,
)
from lapgs_plugin.reference_raster.threads import parallel
from lapgs_plugin.supervision import DEFAULT_SSIM_WEIGHT, SSIM_SIGMA
from lapgs_plugin.supervision import SSIM_C1 as C1
from lapgs_plugin.supervision import SSIM_C2 as C2
from lapgs_plugin.supervision import SSIM_RADIUS as RADIUS

Integers = NDArray[np.int64]

_TAPS = 2 * RADIUS + 1
_MOMENTS = 4  # p, t, p^2 + t^2, p t: SSIM needs the squares in their sum only
_DERIVATIVES = 3  # with respect to the means of p, p^2 and p t
_BLOCK_COLUMNS = 400  # both buffers of a block fit a level-2 cache of 512 KiB in float32
_STRIP_ROWS = 128  # each strip computes 20 rows of its neighbours again


def _half_window() -> tuple[float, ...]:
    gaussian = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * SSIM_SIGMA**2))
    return tuple((gaussian / gaussian.sum())[: RADIUS + 1].tolist())


_W0, _W1, _W2, _W3, _W4, _W5 = _half_window()
"""The normalised window from its tail to its centre."""


@inline
def _weighted(array: Floats, start: int, step: int) -> Lanes:
    """The window over 11 vectors that lie `step` elements apart."""
    total = _W0 * (load(array, start) + load(array, start + 10 * step))
    total = fma(_W1, load(array, start + step) + load(array, start + 9 * step), total)
    total = fma(_W2, load(array, start + 2 * step) + load(array, start + 8 * step), total)
    total = fma(_W3, load(array, start + 3 * step) + load(array, start + 7 * step), total)
    total = fma(_W4, load(array, start + 4 * step) + load(array, start + 6 * step), total)
    return fma(_W5, load(array, start + 5 * step), total)


# The buffers hold each row twice, 11 slots apart, in slots y % 11 and y % 11 + 11. So the 11 rows that end with y are
# contiguous, from slot (y + 1) % 11 on, and nothing is ever moved.


@inline
def _store_row(rows: Floats, y: int, maps: int, pitch: int, index: int, x: int, value: Lanes) -> None:
    at = (y % _TAPS * maps + index) * pitch + x
    store(rows, at, value)
    store(rows, at + _TAPS * maps * pitch, value)


@inline
def _store_moments(p_row: Floats, t_row: Floats, y: int, pitch: int, moments: Floats) -> None:
    for x in range(0, pitch, WIDTH):
        p, t = load(p_row, x), load(t_row, x)
        _store_row(moments, y, _MOMENTS, pitch, 0, x, p)
        _store_row(moments, y, _MOMENTS, pitch, 1, x, t)
        _store_row(moments, y, _MOMENTS, pitch, 2, x, fma(p, p, t * t))
        _store_row(moments, y, _MOMENTS, pitch, 3, x, p * t)


@inline
def _filter_down(rows: Floats, y: int, maps: int, pitch: int, out: Floats) -> None:
    """Filter the 11 rows that end with `y` into one."""
    start = (y + 1) % _TAPS * maps * pitch
    for x in range(0, maps * pitch, WIDTH):
        store(out, x, _weighted(rows, start + x, maps * pitch))


@inline
def _store_derivatives(filtered: Floats, inside: Floats, y: int, pitch: int, derivatives: Floats, ssim: Floats) -> None:
    """SSIM of row `y` and its derivatives with respect to the moments; zero where `inside` is.

    With A1 = 2 mu_p mu_t + C1, A2 = 2 cov + C2, B1 = mu_p^2 + mu_t^2 + C1, B2 = var_p + var_t + C2 it is
    S = A1 A2 / (B1 B2). What is stored lacks the factor 2 that all terms of the gradient share: its weight has it.
    """
    for x in range(0, pitch, WIDTH):
        mean_p, mean_t = _weighted(filtered, x, 1), _weighted(filtered, x + pitch, 1)
        squares, product = _weighted(filtered, x + 2 * pitch, 1), _weighted(filtered, x + 3 * pitch, 1)
        mean_product, mean_squares = mean_p * mean_t, fma(mean_p, mean_p, mean_t * mean_t)
        a1, a2 = fma(2.0, mean_product, C1), fma(2.0, product - mean_product, C2)
        b1, b2 = mean_squares + C1, squares - mean_squares + C2
        inverse = load(inside, x) / (b1 * b2)
        by_product = a1 * inverse
        s = a2 * by_product
        store(ssim, x, s)
        _store_row(derivatives, y, _DERIVATIVES, pitch, 0, x, fma(mean_t, a2 - a1, mean_p * s * (b1 - b2)) * inverse)
        _store_row(derivatives, y, _DERIVATIVES, pitch, 1, x, -s * b1 * inverse)
        _store_row(derivatives, y, _DERIVATIVES, pitch, 2, x, by_product)


@inline
def _store_gradient(
    filtered: Floats, moments: Floats, y: int, pitch: int, weights: tuple[float, float], l1_sum: Floats, row: Floats
) -> None:
    """One row of the gradient; p and t are those of the first of the 11 rows of moments that end with `y`."""
    l1_weight, ssim_weight = weights
    plus, minus = splat(row, l1_weight), splat(row, -l1_weight)
    start = (y + 1) % _TAPS * _MOMENTS * pitch + 2 * RADIUS
    for x in range(0, pitch - 2 * WIDTH + 1, WIDTH):
        p, t = load(moments, start + x), load(moments, start + pitch + x)
        by_mean = _weighted(filtered, x, 1)
        by_square, by_product = _weighted(filtered, x + pitch, 1), _weighted(filtered, x + 2 * pitch, 1)
        difference = p - t
        store(l1_sum, x, load(l1_sum, x) + absolute(difference))
        by_l1 = select(difference > 0.0, plus, select(difference < 0.0, minus, 0.0))
        store(row, x, fma(ssim_weight, fma(p, by_square, fma(t, by_product, by_mean)), by_l1))


@inline
def _copy_row(image: Floats, y: int, left: int, first: int, last: int, row: Floats) -> None:
    """Columns first to last of row `y` with zeros around them; column `left` goes to the start of the row."""
    if 0 <= y < image.shape[0]:
        row[: first - left] = 0
        row[first - left : last - left] = image[y, first:last]
        row[last - left :] = 0
    else:
        row[:] = 0


@inline
def _add_row(total: Floats, row: Floats, pitch: int) -> None:
    for x in range(0, pitch, WIDTH):
        store(total, x, load(total, x) + load(row, x))


@inline
def _mark_inside(left: int, width: int, inside: Floats) -> None:
    """One where column left + x lies in the image, zero elsewhere."""
    for x in range(len(inside)):
        inside[x] = 0 <= left + x < width


@jit
def _photometric_kernel(
    counter: Integers,
    blocks: Integers,
    pitch: int,
    prediction: Floats,
    target: Floats,
    weights: tuple[float, float],
    gradient: Floats,
    sums: NDArray[np.float64],
) -> None:
    """Gradient (c, h, w), and for each block the sums of |p - t| and of SSIM, (blocks, 2)."""
    _, height, width = prediction.shape
    dtype = prediction.dtype
    moments = np.empty(2 * _TAPS * _MOMENTS * pitch, dtype)
    derivatives = np.empty(2 * _TAPS * _DERIVATIVES * pitch, dtype)
    filtered = np.zeros(_MOMENTS * pitch + WIDTH, dtype)
    p_row, t_row, row = np.empty(pitch, dtype), np.empty(pitch, dtype), np.empty(pitch, dtype)
    inside, nothing = np.empty(pitch, dtype), np.zeros(pitch, dtype)
    l1_sum, ssim_sum = np.empty(pitch, dtype), np.empty(pitch, dtype)
    while True:
        task = fetch_add(counter, 1)
        if task >= len(blocks):
            return
        channel, top, bottom, start, stop = blocks[task]
        left, first, last = start - 2 * RADIUS, max(start - 2 * RADIUS, 0), min(stop + 2 * RADIUS, width)
        _mark_inside(start - RADIUS, width, inside)
        # Summed by column first: vectors, in a fixed order, and precise enough in float32.
        l1_sum[:] = 0
        ssim_sum[:] = 0
        for y in range(top - 2 * RADIUS, bottom + 2 * RADIUS):
            _copy_row(prediction[channel], y, left, first, last, p_row)
            _copy_row(target[channel], y, left, first, last, t_row)
            _store_moments(p_row, t_row, y, pitch, moments)
            if y < top:
                continue
            centre, out = y - RADIUS, y - 2 * RADIUS
            _filter_down(moments, y, _MOMENTS, pitch, filtered)
            visible = inside if 0 <= centre < height else nothing
            _store_derivatives(filtered, visible, centre, pitch, derivatives, row)
            if top <= centre < bottom:
                _add_row(ssim_sum, row, pitch)
            if out >= top:
                _filter_down(derivatives, centre, _DERIVATIVES, pitch, filtered)
                _store_gradient(filtered, moments, y, pitch, weights, l1_sum, row)
                gradient[channel, out, start:stop] = row[: stop - start]
        sums[task, 0], sums[task, 1] = 0, 0
        for x in range(stop - start):
            sums[task, 0] += l1_sum[x]
            sums[task, 1] += ssim_sum[x + RADIUS]


@jit
def _ssim_kernel(
    counter: Integers, blocks: Integers, pitch: int, prediction: Floats, target: Floats, ssim: Floats
) -> None:
    """SSIM of each pixel, (c, h, w)."""
    width, dtype = prediction.shape[2], prediction.dtype
    moments = np.empty(2 * _TAPS * _MOMENTS * pitch, dtype)
    unused = np.empty(2 * _TAPS * _DERIVATIVES * pitch, dtype)
    filtered = np.zeros(_MOMENTS * pitch + WIDTH, dtype)
    p_row, t_row, row, inside = (
        np.empty(pitch, dtype),
        np.empty(pitch, dtype),
        np.empty(pitch, dtype),
        np.empty(pitch, dtype),
    )
    while True:
        task = fetch_add(counter, 1)
        if task >= len(blocks):
            return
        channel, top, bottom, start, stop = blocks[task]
        left, first, last = start - 2 * RADIUS, max(start - 2 * RADIUS, 0), min(stop + 2 * RADIUS, width)
        _mark_inside(start - RADIUS, width, inside)
        for y in range(top - RADIUS, bottom + RADIUS):
            _copy_row(prediction[channel], y, left, first, last, p_row)
            _copy_row(target[channel], y, left, first, last, t_row)
            _store_moments(p_row, t_row, y, pitch, moments)
            centre = y - RADIUS
            if centre >= top:
                _filter_down(moments, y, _MOMENTS, pitch, filtered)
                _store_derivatives(filtered, inside, centre, pitch, unused, row)
                ssim[channel, centre, start:stop] = row[RADIUS : RADIUS + stop - start]


@lru_cache(maxsize=64)
def _blocks(channels: int, height: int, width: int) -> tuple[Integers, int]:
    """How an image is cut, (blocks, 5): channel, rows and columns; and the length of a buffered row.

    It depends on nothing but the size, so that sums over blocks have the same bits for any number of threads.
    """
    strips, columns = -(-height // _STRIP_ROWS), -(-width // _BLOCK_COLUMNS)
    blocks = [
        (channel, i * height // strips, (i + 1) * height // strips, j * width // columns, (j + 1) * width // columns)
        for channel in range(channels)
        for i in range(strips)
        for j in range(columns)
    ]
    pitch = -(-(-(-width // columns) + 4 * RADIUS) // WIDTH) * WIDTH
    return np.array(blocks, dtype=np.int64), pitch


def _check(prediction: Tensor, target: Tensor) -> None:
    if prediction.ndim != 3 or prediction.shape != target.shape or prediction.numel() == 0:
        raise UserInputError(
            f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)}: expected two images of one shape "
            "(channels, height, width); resize the target to the level that is rendered"
        )
    if prediction.dtype != target.dtype or prediction.dtype not in (torch.float32, torch.float64):
        raise UserInputError(
            f"prediction of {prediction.dtype} and target of {target.dtype}: expected float32 or float64 for both; "
            "convert one with .to(dtype)"
        )
    if prediction.device.type != "cpu" or target.device.type != "cpu":
        raise UserInputError(
            f"prediction on {prediction.device} and target on {target.device}: expected the CPU; move them with .cpu()"
        )


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        images = prediction.detach().contiguous(), target.contiguous()
        count = prediction.numel()
        gradient = torch.empty_like(images[0])
        blocks, pitch = _blocks(*prediction.shape)
        sums = np.empty((len(blocks), 2))
        # The mean of 1 - SSIM, and the factor 2 that the stored derivatives lack.
        weights = (1 - ssim_weight) / count, -2 * ssim_weight / count
        parallel(
            _photometric_kernel, blocks, pitch, images[0].numpy(), images[1].numpy(), weights, gradient.numpy(), sums
        )
        l1, ssim = sums.sum(axis=0) / count
        ctx.save_for_backward(gradient)
        return prediction.new_tensor((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        # A pass over the image that multiplies by one costs a tenth of the loss.
        return (gradient if grad_loss.item() == 1 else gradient * grad_loss), None, None


def photometric_loss_cpu(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """(1 - w) mean |p - t| + w (1 - mean SSIM), differentiable once with respect to the prediction.

    Args:
        prediction: (c, h, w) image of any size and any value range, float32 or float64, on the CPU.
        target: (c, h, w) image of the same type, a constant.
        ssim_weight: w, in [0, 1]; 3DGS trains with 0.2.

    Returns:
        A scalar of the images' type, the same bits for any number of threads.

    Raises:
        UserInputError: the images do not match, the target requires a gradient, or the weight leaves [0, 1].
    """
    _check(prediction, target)
    if target.requires_grad:
        raise UserInputError("the target requires a gradient, expected a constant image; pass target.detach()")
    if not 0 <= ssim_weight <= 1:
        raise UserInputError(f"ssim_weight {ssim_weight}: expected a number from 0 to 1, such as 0.2")
    loss: Tensor = _PhotometricLoss.apply(prediction, target, ssim_weight)  # type: ignore[no-untyped-call]  # torch's
    return loss


def ssim_map_cpu(prediction: Tensor, target: Tensor) -> Tensor:
    """SSIM of each pixel and channel, (c, h, w); not differentiable.

    Raises:
        UserInputError: the images differ in shape or type, or are not float32 or float64 on the CPU.
    """
    _check(prediction, target)
    images = prediction.detach().contiguous(), target.detach().contiguous()
    ssim = torch.empty_like(images[0])
    parallel(_ssim_kernel, *_blocks(*prediction.shape), images[0].numpy(), images[1].numpy(), ssim.numpy())
    return ssim


def ssim_cpu(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean of `ssim_map_cpu`, a scalar: the SSIM that papers on 3DGS report."""
    return ssim_map_cpu(prediction, target).mean()
