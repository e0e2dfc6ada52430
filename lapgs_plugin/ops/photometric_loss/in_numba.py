"""Compute the photometric loss of 3DGS and its gradient on the CPU in one pass over the images.

SSIM is `in_torch.ssim`'s. The rows of a block stream through two buffers that stay in the cache, and only the gradient
is written to memory:

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
from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import WIDTH, Floats, Lanes, absolute, fetch_add, fma, load, select, splat, store
from lapgs_plugin.jit.threads import parallel
from lapgs_plugin.ops.photometric_loss.in_torch import DEFAULT_SSIM_WEIGHT, SSIM_WINDOW, check_arguments
from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_C1 as C1
from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_C2 as C2
from lapgs_plugin.ops.photometric_loss.in_torch import SSIM_RADIUS as RADIUS

Integers = NDArray[np.int64]

_MOMENTS = 4  # p, t, p^2 + t^2, p t: SSIM needs only the sum of the squares
_DERIVATIVES = 3  # with respect to the means of p, p^2 and p t
_GROUP = 4  # rows filtered down together: they read 14 rows, where one by one they would read 44
_BLOCK_COLUMNS = 400  # both buffers of a block fit a level-2 cache of 256 KiB in float32
_STRIP_ROWS = 192  # a strip computes 20 rows of its neighbours again


_W0, _W1, _W2, _W3, _W4, _W5 = SSIM_WINDOW[: RADIUS + 1]  # from its tail to its centre


@inline
def _window_sum(
    v0: Lanes, v1: Lanes, v2: Lanes, v3: Lanes, v4: Lanes, v5: Lanes,
    v6: Lanes, v7: Lanes, v8: Lanes, v9: Lanes, v10: Lanes,
) -> Lanes:  # fmt: skip
    """Return the sum of 11 values weighted by the window."""
    total = fma(_W1, v1 + v9, _W0 * (v0 + v10))
    total = fma(_W3, v3 + v7, fma(_W2, v2 + v8, total))
    return fma(_W5, v5, fma(_W4, v4 + v6, total))


@inline
def _filter_across(row: Floats, x: int) -> Lanes:
    """Filter the 11 columns from x on, for 16 neighbouring x."""
    return _window_sum(
        load(row, x), load(row, x + 1), load(row, x + 2), load(row, x + 3), load(row, x + 4), load(row, x + 5),
        load(row, x + 6), load(row, x + 7), load(row, x + 8), load(row, x + 9), load(row, x + 10),
    )  # fmt: skip


# A buffer holds the last 16 rows as a ring of four groups of four. A row holds its maps one after the other, `pitch`
# numbers each. Filtering a group makes the four rows whose windows end with the group's rows.


@inline
def _filter_down(rows: Floats, group: int, size: int, out: Floats) -> None:
    """Filter the 14 rows that end with a group into four, `size` elements each."""
    oldest, older = (group + 1) % 4 * _GROUP * size, (group + 2) % 4 * _GROUP * size
    newer, newest = (group + 3) % 4 * _GROUP * size, group % 4 * _GROUP * size
    for x in range(0, size, WIDTH):
        r0, r1 = load(rows, oldest + 2 * size + x), load(rows, oldest + 3 * size + x)
        r2, r3 = load(rows, older + x), load(rows, older + size + x)
        r4, r5 = load(rows, older + 2 * size + x), load(rows, older + 3 * size + x)
        r6, r7 = load(rows, newer + x), load(rows, newer + size + x)
        r8, r9 = load(rows, newer + 2 * size + x), load(rows, newer + 3 * size + x)
        r10, r11 = load(rows, newest + x), load(rows, newest + size + x)
        r12, r13 = load(rows, newest + 2 * size + x), load(rows, newest + 3 * size + x)
        store(out, x, _window_sum(r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10))
        store(out, size + x, _window_sum(r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11))
        store(out, 2 * size + x, _window_sum(r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, r12))
        store(out, 3 * size + x, _window_sum(r3, r4, r5, r6, r7, r8, r9, r10, r11, r12, r13))


@inline
def _store_moments(p_row: Floats, t_row: Floats, pitch: int, moments: Floats, start: int) -> None:
    for x in range(0, pitch, WIDTH):
        p, t = load(p_row, x), load(t_row, x)
        store(moments, start + x, p)
        store(moments, start + pitch + x, t)
        store(moments, start + 2 * pitch + x, fma(p, p, t * t))
        store(moments, start + 3 * pitch + x, p * t)


@inline
def _store_derivatives(
    filtered: Floats, row: int, inside: Floats, pitch: int, derivatives: Floats, start: int, ssim: Floats
) -> None:
    """Store SSIM of a row and its derivatives by the moments; zero where `inside` is.

    With A1 = 2 mu_p mu_t + C1, A2 = 2 cov + C2, B1 = mu_p^2 + mu_t^2 + C1, B2 = var_p + var_t + C2 it is
    S = A1 A2 / (B1 B2). The factor 2 that all terms of the gradient share is left to the gradient's weight.
    """
    for x in range(0, pitch, WIDTH):
        mean_p, mean_t = _filter_across(filtered, row + x), _filter_across(filtered, row + pitch + x)
        squares, product = _filter_across(filtered, row + 2 * pitch + x), _filter_across(filtered, row + 3 * pitch + x)
        mean_product, mean_squares = mean_p * mean_t, fma(mean_p, mean_p, mean_t * mean_t)
        a1, a2 = fma(2.0, mean_product, C1), fma(2.0, product - mean_product, C2)
        b1, b2 = mean_squares + C1, squares - mean_squares + C2
        inverse = load(inside, x) / (b1 * b2)
        by_product = a1 * inverse
        s = a2 * by_product
        store(ssim, x, s)
        store(derivatives, start + x, fma(mean_t, a2 - a1, mean_p * s * (b1 - b2)) * inverse)
        store(derivatives, start + pitch + x, -s * b1 * inverse)
        store(derivatives, start + 2 * pitch + x, by_product)


@inline
def _store_gradient(
    filtered: Floats, row: int, moments: Floats, start: int, pitch: int, weights: tuple[float, float], l1_sum: Floats,
    out: Floats,
) -> None:  # fmt: skip
    """Store one row of the gradient and add |p - t| to `l1_sum`."""
    l1_weight, ssim_weight = weights
    plus, minus = splat(out, l1_weight), splat(out, -l1_weight)
    for x in range(0, pitch - 2 * WIDTH + 1, WIDTH):
        p, t = load(moments, start + x), load(moments, start + pitch + x)
        by_mean, by_square = _filter_across(filtered, row + x), _filter_across(filtered, row + pitch + x)
        by_product = _filter_across(filtered, row + 2 * pitch + x)
        difference = p - t
        store(l1_sum, x, load(l1_sum, x) + absolute(difference))
        by_l1 = select(difference > 0.0, plus, select(difference < 0.0, minus, 0.0))
        store(out, x, fma(ssim_weight, fma(p, by_square, fma(t, by_product, by_mean)), by_l1))


@inline
def _copy_row(image: Floats, y: int, left: int, first: int, last: int, row: Floats) -> None:
    """Copy columns first to last of row `y`, with zeros around them; the row starts at column `left`."""
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
    """Store 1 where column left + x lies in the image, 0 elsewhere."""
    for x in range(len(inside)):
        inside[x] = 0 <= left + x < width


@jit
def _photometric_kernel(
    counter: Integers, blocks: Integers, pitch: int, prediction: Floats, target: Floats, weights: tuple[float, float],
    gradient: Floats, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Compute the gradient (c, h, w), and for each block the sums of |p - t| and of SSIM, (blocks, 2)."""
    _, height, width = prediction.shape
    dtype = prediction.dtype
    wide, narrow = _MOMENTS * pitch, _DERIVATIVES * pitch
    moments, derivatives = np.zeros(4 * _GROUP * wide, dtype), np.zeros(4 * _GROUP * narrow, dtype)
    filtered = np.zeros(_GROUP * wide + WIDTH, dtype)
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
        # Sums by column are vectors, have a fixed order, and are precise enough in float32.
        l1_sum[:] = 0
        ssim_sum[:] = 0
        for group, y in enumerate(range(top - 2 * RADIUS, bottom + 2 * RADIUS, _GROUP)):
            ring = group % 4 * _GROUP
            for i in range(_GROUP):
                _copy_row(prediction[channel], y + i, left, first, last, p_row)
                _copy_row(target[channel], y + i, left, first, last, t_row)
                _store_moments(p_row, t_row, pitch, moments, (ring + i) * wide)
            if y + _GROUP <= top:
                continue
            _filter_down(moments, group, wide, filtered)
            for i in range(_GROUP):
                centre = y - RADIUS + i
                visible = inside if 0 <= centre < height else nothing
                _store_derivatives(filtered, i * wide, visible, pitch, derivatives, (ring + i) * narrow, row)
                if top <= centre < bottom:
                    _add_row(ssim_sum, row, pitch)
            if y + _GROUP <= top + 2 * RADIUS:
                continue
            _filter_down(derivatives, group, narrow, filtered)
            for i in range(_GROUP):
                out = y - 2 * RADIUS + i
                if top <= out < bottom:
                    there = ((group * _GROUP + i - 2 * RADIUS) % (4 * _GROUP)) * wide + 2 * RADIUS
                    _store_gradient(filtered, i * narrow, moments, there, pitch, weights, l1_sum, row)
                    gradient[channel, out, start:stop] = row[: stop - start]
        sums[task, 0], sums[task, 1] = 0, 0
        for x in range(stop - start):
            sums[task, 0] += l1_sum[x]
            sums[task, 1] += ssim_sum[x + RADIUS]


@lru_cache(maxsize=64)
def _blocks(channels: int, height: int, width: int) -> tuple[Integers, int]:
    """Cut an image into blocks, (blocks, 5): channel, first and last row, first and last column; and a row's pitch.

    They depend on the size alone, so that sums over blocks have the same bits for any number of threads.
    """
    # An even number, so that two threads share the work equally.
    strips, columns = 2 * -(-height // (2 * _STRIP_ROWS)), -(-width // _BLOCK_COLUMNS)
    blocks = [
        (channel, i * height // strips, (i + 1) * height // strips, j * width // columns, (j + 1) * width // columns)
        for channel in range(channels)
        for i in range(strips)
        for j in range(columns)
    ]
    pitch = -(-(-(-width // columns) + 4 * RADIUS) // WIDTH) * WIDTH
    return np.array(blocks, dtype=np.int64), pitch


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        # SSIM is computed channel by channel: several images are one of more channels.
        images = [image.detach().flatten(0, -3).contiguous().numpy() for image in (prediction, target)]
        count = prediction.numel()
        gradient = empty(count, images[0].dtype).reshape(images[0].shape)
        blocks, pitch = _blocks(*images[0].shape)
        sums = np.empty((len(blocks), 2))
        # The weight of SSIM has the factor 2 that the stored derivatives lack.
        weights = (1 - ssim_weight) / count, -2 * ssim_weight / count
        parallel(_photometric_kernel, blocks, pitch, *images, weights, gradient, sums)
        l1, ssim = sums.sum(axis=0) / count
        # In the shape that is returned: a view would be a leaf's gradient, which may be changed in place.
        ctx.save_for_backward(torch.from_numpy(gradient).view(prediction.shape))
        return prediction.new_tensor((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        # Multiplying by 1 would be another pass over the image.
        return (gradient if grad_loss.item() == 1 else gradient * grad_loss), None, None


def photometric_loss_cpu(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """Return (1 - w) mean |p - t| + w (1 - mean SSIM), differentiable once by the prediction.

    Args:
        prediction: (c, h, w) or (b, c, h, w) of any size and any value range, float32 or float64, on the CPU.
        target: of the same shape and type, a constant.
        ssim_weight: w, in [0, 1]; 3DGS trains with 0.2.

    Returns:
        A scalar of the images' type, the same bits for any number of threads.

    Raises:
        UserInputError: as `check_arguments`; or images are on a GPU, or one is of another type than the other.
    """
    check_arguments(prediction, target, ssim_weight)
    if prediction.dtype != target.dtype or prediction.dtype not in (torch.float32, torch.float64):
        raise UserInputError(
            f"prediction of {prediction.dtype} and target of {target.dtype}: expected float32 or float64 for both; "
            "convert one with .to(dtype)"
        )
    if prediction.device.type != "cpu":
        raise UserInputError(f"images on {prediction.device}: expected the CPU; move them with .cpu()")
    loss: Tensor = _PhotometricLoss.apply(prediction, target, ssim_weight)  # type: ignore[no-untyped-call]  # torch's
    return loss
