"""Filter Gaussians in one kernel each, with kernels of the gradients, and find their depths in all cameras in one."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, launch
from lapgs_plugin.ops.smoothing_filter.in_torch import FARTHEST, MARGIN, NEAREST

BLOCK = 256


@triton.jit
def _squares(log_scales: tl.tensor, rows: tl.tensor, here: tl.tensor) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Return the variances along the three axes."""
    places = log_scales + 3 * rows.to(tl.int64)
    a, b, c = tl.load(places, here, 0.0), tl.load(places + 1, here, 0.0), tl.load(places + 2, here, 0.0)
    a, b, c = tl.exp(a), tl.exp(b), tl.exp(c)
    return a * a, b * b, c * c


@triton.jit
def _store(values: tl.tensor, rows: tl.tensor, here: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor) -> None:
    places = values + 3 * rows.to(tl.int64)
    tl.store(places, a, here)
    tl.store(places + 1, b, here)
    tl.store(places + 2, c, here)


@triton.jit(do_not_specialize=("n",))  # no types
def _scales_kernel(log_scales: tl.tensor, filters: tl.tensor, scales: tl.tensor, n: int, block: tl.constexpr) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    a, b, c = _squares(log_scales, rows, here)
    filtered = tl.load(filters + rows, here, 1.0)
    filtered *= filtered
    _store(scales, rows, here, tl.sqrt(a + filtered), tl.sqrt(b + filtered), tl.sqrt(c + filtered))


@triton.jit(do_not_specialize=("n",))  # no types
def _scales_gradient_kernel(
    log_scales: tl.tensor, filters: tl.tensor, by_scales: tl.tensor, by_log_scales: tl.tensor,
    n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    a, b, c = _squares(log_scales, rows, here)
    filtered = tl.load(filters + rows, here, 1.0)
    filtered *= filtered
    places = by_scales + 3 * rows.to(tl.int64)
    by_a, by_b, by_c = tl.load(places, here, 0.0), tl.load(places + 1, here, 0.0), tl.load(places + 2, here, 0.0)
    by_a, by_b = by_a * a / tl.sqrt(a + filtered), by_b * b / tl.sqrt(b + filtered)
    _store(by_log_scales, rows, here, by_a, by_b, by_c * c / tl.sqrt(c + filtered))


@triton.jit
def _dimmed(
    logits: tl.tensor, log_scales: tl.tensor, filters: tl.tensor, rows: tl.tensor, here: tl.tensor
) -> tuple[tl.tensor, ...]:
    """Return squared scales and filters, the square of the share that is left of opacities, and these."""
    a, b, c = _squares(log_scales, rows, here)
    filtered = tl.load(filters + rows, here, 1.0)
    filtered *= filtered
    shrunk = a * b * c / ((a + filtered) * (b + filtered) * (c + filtered))
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, here, 0.0)))
    return a, b, c, filtered, shrunk, opacity


@triton.jit(do_not_specialize=("n",))  # no types
def _opacities_kernel(
    logits: tl.tensor, log_scales: tl.tensor, filters: tl.tensor, opacities: tl.tensor, n: int, block: tl.constexpr
) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    _, _, _, _, shrunk, opacity = _dimmed(logits, log_scales, filters, rows, here)
    tl.store(opacities + rows, opacity * tl.sqrt(shrunk), here)


@triton.jit(do_not_specialize=("n",))  # no types
def _opacities_gradient_kernel(
    logits: tl.tensor, log_scales: tl.tensor, filters: tl.tensor, by_opacities: tl.tensor,
    by_logits: tl.tensor, by_log_scales: tl.tensor, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    a, b, c, filtered, shrunk, opacity = _dimmed(logits, log_scales, filters, rows, here)
    gradient = tl.load(by_opacities + rows, here, 0.0) * opacity * tl.sqrt(shrunk)
    tl.store(by_logits + rows, gradient * (1.0 - opacity), here)
    # The logarithm of s / sqrt(s^2 + f^2) by that of s is f^2 / (s^2 + f^2).
    gradient *= filtered
    by_a, by_b = gradient / (a + filtered), gradient / (b + filtered)
    _store(by_log_scales, rows, here, by_a, by_b, gradient / (c + filtered))


@triton.jit(do_not_specialize=("n", "count"))  # no types
def _depths_kernel(
    means: tl.tensor, cameras: tl.tensor, depths: tl.tensor, n: int, count: int,
    nearest: tl.constexpr, farthest: tl.constexpr, margin: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    places = means + 3 * rows.to(tl.int64)
    x, y, z = tl.load(places, here, 0.0), tl.load(places + 1, here, 0.0), tl.load(places + 2, here, 0.0)
    least = tl.full(rows.shape, float("inf"), tl.float32)
    index = 0
    while index < count:  # `range` of a tensor cannot be interpreted with NumPy 2.4
        camera = cameras + 16 * index
        depth = x * tl.load(camera + 2) + y * tl.load(camera + 5) + z * tl.load(camera + 8) + tl.load(camera + 11)
        across = x * tl.load(camera) + y * tl.load(camera + 3) + z * tl.load(camera + 6) + tl.load(camera + 9)
        down = x * tl.load(camera + 1) + y * tl.load(camera + 4) + z * tl.load(camera + 7) + tl.load(camera + 10)
        divisor = tl.maximum(depth, 0.001)
        width, height = tl.load(camera + 14), tl.load(camera + 15)
        across = across / divisor * tl.load(camera + 12) + 0.5 * width
        down = down / divisor * tl.load(camera + 13) + 0.5 * height
        inside = (across >= -margin * width) & (across <= (1.0 + margin) * width)
        inside = inside & (down >= -margin * height) & (down <= (1.0 + margin) * height)
        inside = inside & (depth > nearest)
        least = tl.where(inside, tl.minimum(least, tl.minimum(depth, farthest)), least)
        index += 1
    tl.store(depths + rows, least, here)


class _Scales(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, filters: Tensor) -> Tensor:
        scales, n = torch.empty_like(log_scales), len(log_scales)
        launch(_scales_kernel, (blocks(n, BLOCK),), log_scales, filters, scales, n, block=BLOCK)
        ctx.save_for_backward(log_scales, filters)
        return scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_scales: Tensor) -> tuple[Tensor | None, ...]:
        log_scales, filters = ctx.saved_tensors
        gradient, n = torch.empty_like(log_scales), len(log_scales)
        tensors = log_scales, filters, by_scales.contiguous(), gradient
        launch(_scales_gradient_kernel, (blocks(n, BLOCK),), *tensors, n, block=BLOCK)
        return gradient, None


class _Opacities(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, log_scales: Tensor, filters: Tensor) -> Tensor:
        opacities, n = torch.empty_like(logits), len(logits)
        launch(_opacities_kernel, (blocks(n, BLOCK),), logits, log_scales, filters, opacities, n, block=BLOCK)
        ctx.save_for_backward(logits, log_scales, filters)
        return opacities

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_opacities: Tensor) -> tuple[Tensor | None, ...]:
        logits, log_scales, filters = ctx.saved_tensors
        gradients, n = (torch.empty_like(logits), torch.empty_like(log_scales)), len(logits)
        tensors = logits, log_scales, filters, by_opacities.contiguous(), *gradients
        launch(_opacities_gradient_kernel, (blocks(n, BLOCK),), *tensors, n, block=BLOCK)
        return (*gradients, None)


def filtered_scales_triton(log_scales: Tensor, filters: Tensor) -> Tensor:
    """Do `filtered_scales_torch` for contiguous float32 tensors on one CUDA device, n above 0."""
    scales: Tensor = _Scales.apply(log_scales, filters)  # type: ignore[no-untyped-call]  # torch's
    return scales


def filtered_opacities_triton(logits: Tensor, log_scales: Tensor, filters: Tensor) -> Tensor:
    """Do `filtered_opacities_torch` for contiguous float32 tensors on one CUDA device, n above 0."""
    opacities: Tensor = _Opacities.apply(logits, log_scales, filters)  # type: ignore[no-untyped-call]  # torch's
    return opacities


def nearest_depths_triton(means: Tensor, cameras: Tensor) -> Tensor:
    """Do `nearest_depths_torch` for contiguous float32 tensors on one CUDA device, n above 0."""
    n, depths = len(means), means.new_empty(len(means))
    bounds = {"nearest": NEAREST, "farthest": FARTHEST, "margin": MARGIN}
    launch(_depths_kernel, (blocks(n, BLOCK),), means, cameras, depths, n, len(cameras), **bounds, block=BLOCK)
    return depths
