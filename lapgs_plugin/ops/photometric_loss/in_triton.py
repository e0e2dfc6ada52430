"""Compute the L1 term of the photometric loss with its gradient in one kernel."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 2048


@triton.jit(do_not_specialize=("weight", "n"))  # type: ignore[untyped-decorator]  # Triton ships no types
def _kernel(
    prediction: tl.tensor, target: tl.tensor, gradient: tl.tensor, total: tl.tensor,
    weight: float, n: int, block: tl.constexpr,
) -> None:  # fmt: skip
    places = tl.program_id(0) * block + tl.arange(0, block)
    here = places < n
    difference = tl.load(prediction + places, here, 0.0) - tl.load(target + places, here, 0.0)
    sign = tl.where(difference > 0.0, weight, 0.0) - tl.where(difference < 0.0, weight, 0.0)
    tl.store(gradient + places, sign, here)
    tl.atomic_add(total, tl.sum(difference * sign))  # NaN stays NaN, which stops a diverged run


class _WeightedL1(torch.autograd.Function):
    """Map (prediction, target, weight, constant) to constant + weight * mean |prediction - target|."""

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, target: Tensor, weight: float, constant: float) -> Tensor:
        n = prediction.numel()
        gradient = torch.empty_like(prediction)
        total = torch.full((), constant, device=prediction.device)
        launch: Any = _kernel[(triton.cdiv(n, BLOCK),)]
        launch(prediction, target, gradient, total, weight / n, n, block=BLOCK)
        ctx.save_for_backward(gradient)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_loss: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * by_loss, None, None, None


def weighted_l1(prediction: Tensor, target: Tensor, weight: float, constant: float) -> Tensor:
    """Return constant + weight * mean |prediction - target|, differentiable by the prediction.

    Args:
        prediction, target: of one shape, contiguous float32 on a CUDA device.
    """
    loss: Tensor = _WeightedL1.apply(prediction, target, weight, constant)  # type: ignore[no-untyped-call]  # torch's
    return loss
