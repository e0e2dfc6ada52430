"""Compute the regularization of opacities and sizes in one kernel, and its gradients in another."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # type: ignore[untyped-decorator]  # no types
def _kernel(
    logits: tl.tensor, log_scales: tl.tensor, value: tl.tensor, by_opacity: float, by_scale: float, n: int,
    block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    total = tl.where(rows < n, by_opacity * opacity, 0.0)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        total += tl.where(places < 3 * n, by_scale * scale, 0.0)
    tl.atomic_add(value, tl.sum(total, 0), sem="relaxed")


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # type: ignore[untyped-decorator]  # no types
def _gradient_kernel(
    logits: tl.tensor, log_scales: tl.tensor, gradient: tl.tensor, by_logits: tl.tensor, by_log_scales: tl.tensor,
    by_opacity: float, by_scale: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    factor = tl.load(gradient)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    tl.store(by_logits + rows, factor * by_opacity * opacity * (1.0 - opacity), rows < n)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        tl.store(by_log_scales + places, factor * by_scale * scale, places < 3 * n)


class _Regularization(torch.autograd.Function):
    """Map logits (n,) and logarithms of sizes (n, 3), float32 on one CUDA device, to a number."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, log_scales: Tensor, by_opacity: float, by_scale: float) -> Tensor:
        logits, log_scales = logits.contiguous(), log_scales.contiguous()
        ctx.save_for_backward(logits, log_scales)
        ctx.weights = by_opacity, by_scale
        value = logits.new_zeros(())
        _launch(_kernel, (logits, log_scales, value), ctx.weights)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        logits, log_scales = ctx.saved_tensors
        found = torch.empty_like(logits), torch.empty_like(log_scales)
        _launch(_gradient_kernel, (logits, log_scales, gradient.contiguous(), *found), ctx.weights)
        return *found, None, None


def regularization_triton(
    opacity_logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float
) -> Tensor:
    """Do `regularization` for float32 tensors on one CUDA device, not empty."""
    n = len(opacity_logits)
    weights = opacity_weight / n, scale_weight / (3 * n)
    value: Tensor = _Regularization.apply(opacity_logits, log_scales, *weights)  # type: ignore[no-untyped-call]  # torch's
    return value


def _launch(kernel: Any, given: tuple[Tensor, ...], weights: tuple[float, float]) -> None:
    n = len(given[0])
    launch(kernel, (blocks(n, BLOCK),), *given, *weights, n, block=BLOCK)
