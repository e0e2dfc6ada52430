"""Add regularization, or its gradients alone, in one kernel each."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 512


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # no types
def _kernel(
    logits: tl.tensor, log_scales: tl.tensor, by_logits: tl.tensor, by_log_scales: tl.tensor,
    by_opacity: float, by_scale: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    before = tl.load(by_logits + rows, rows < n, 0.0)
    tl.store(by_logits + rows, before + by_opacity * opacity * (1.0 - opacity), rows < n)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        before = tl.load(by_log_scales + places, places < 3 * n, 0.0)
        tl.store(by_log_scales + places, before + by_scale * scale, places < 3 * n)


def add_regularization_triton(
    opacity_logits: Tensor, log_scales: Tensor, by_logits: Tensor, by_log_scales: Tensor,
    opacity_weight: float, scale_weight: float,
) -> None:  # fmt: skip
    """Do `add_regularization_torch` for contiguous float32 tensors on one CUDA device, not empty."""
    n = len(opacity_logits)
    tensors = opacity_logits, log_scales, by_logits, by_log_scales
    launch(_kernel, (blocks(n, BLOCK),), *tensors, opacity_weight / n, scale_weight / (3 * n), n, block=BLOCK)


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # no types
def _sums_kernel(
    logits: tl.tensor, log_scales: tl.tensor, sums: tl.tensor, by_opacity: float, by_scale: float, n: int,
    block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    total = tl.where(rows < n, by_opacity * opacity, 0.0)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        total += tl.where(places < 3 * n, by_scale * scale, 0.0)
    tl.store(sums + tl.program_id(0), tl.sum(total, axis=0))


@triton.jit(do_not_specialize=("by_opacity", "by_scale", "n"))  # no types
def _gradient_kernel(
    logits: tl.tensor, log_scales: tl.tensor, by_loss: tl.tensor, by_logits: tl.tensor, by_log_scales: tl.tensor,
    by_opacity: float, by_scale: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    gradient = tl.load(by_loss)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, rows < n, 0.0)))
    tl.store(by_logits + rows, gradient * by_opacity * opacity * (1.0 - opacity), rows < n)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        scale = tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0))
        tl.store(by_log_scales + places, gradient * by_scale * scale, places < 3 * n)


class _Regularized(torch.autograd.Function):
    """Add terms to a loss; the gradients of the parameters are those of the terms alone."""

    @staticmethod
    def forward(
        ctx: Any, loss: Tensor, logits: Tensor, log_scales: Tensor, by_opacity: float, by_scale: float
    ) -> Tensor:
        n, programs = len(logits), blocks(len(logits), BLOCK)
        sums = torch.empty(programs, device=loss.device)
        launch(_sums_kernel, (programs,), logits, log_scales, sums, by_opacity, by_scale, n, block=BLOCK)
        ctx.save_for_backward(logits, log_scales)
        ctx.factors = by_opacity, by_scale
        return loss + sums.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_loss: Tensor) -> tuple[Tensor | None, ...]:
        logits, log_scales = ctx.saved_tensors
        gradients, n = (torch.empty_like(logits), torch.empty_like(log_scales)), len(logits)
        tensors = logits, log_scales, by_loss.contiguous(), *gradients
        launch(_gradient_kernel, (blocks(n, BLOCK),), *tensors, *ctx.factors, n, block=BLOCK)
        return by_loss, *gradients, None, None


def regularized_triton(
    loss: Tensor, opacity_logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float
) -> Tensor:
    """Do `regularized_torch` for contiguous float32 tensors on one CUDA device, not empty."""
    factors = opacity_weight / opacity_logits.numel(), scale_weight / log_scales.numel()
    value: Tensor = _Regularized.apply(loss, opacity_logits, log_scales, *factors)  # type: ignore[no-untyped-call]  # torch's
    return value
