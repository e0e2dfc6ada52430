"""Optimize the tensors of a field with Adam: each by itself on a CPU, all in one kernel on a GPU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, AdamSlot, PlainOptimizer, step_torch
from lapgs_plugin.ops.self_check import largest, matches_reference

__all__ = ["ADAM_EPS", "ONE_VIEW", "GpuFieldAdam", "StepScale", "step_together", "triton_works"]


@dataclass(frozen=True)
class StepScale:
    """Scale Adam's step for the summed gradients of several views.

    For v views this is the square-root scaling of Malladi et al. 2022, which Grendel-GS uses (Zhao et al. 2024): step
    sizes times sqrt(v), betas to the power of v, epsilon over sqrt(v), with the mean of the gradients. Here the sum
    over sqrt(v) replaces the mean, and epsilon stays. The step is the same, and its moments have the size of one
    view's, so v may change from step to step. Adam's count rises by v, so bias correction uses beta to the power of
    all views so far.

    Attributes:
        views: power of the betas, and by how much Adam's count rises.
        gradient: factor on the sum of the views' gradients.
        rate: factor on step sizes.
    """

    views: int = 1
    gradient: float = 1.0
    rate: float = 1.0

    @classmethod
    def of(cls, views: int) -> StepScale:
        """Scale the sum of so many views' gradients."""
        return cls(views, 1 / math.sqrt(views), math.sqrt(views))


ONE_VIEW = StepScale()


class GpuFieldAdam(PlainOptimizer):
    """Hold Adam's state of one tensor, which gsplat's strategies edit; `step_together` steps it with the others.

    'step' is a number: the processor knows it, and a GPU does not have to count.

    Args:
        param: (n, ...) float32, contiguous, on a CUDA device.
        lr: step size of the first three columns, or of all with a `rest_scale` of 1.
        rest_scale: factor on `lr` for all further columns.
    """

    def __init__(self, param: torch.nn.Parameter, lr: float, rest_scale: float = 1.0) -> None:
        super().__init__([param], {"lr": lr, "rest_scale": rest_scale})
        self.state[param] = {
            "step": 0.0,
            "exp_avg": torch.zeros_like(param),
            "exp_avg_sq": torch.zeros_like(param),
        }

    def next_step(self, scale: StepScale) -> AdamSlot:
        """Count a step and return its inputs; without a gradient the tensor moves by its momentum alone."""
        group = self.param_groups[0]
        param, rate = group["params"][0], group["lr"] * scale.rate
        gradient = torch.zeros_like(param) if param.grad is None else param.grad.contiguous()
        state = self.state[param]
        state["step"] += scale.views
        moments = state["exp_avg"], state["exp_avg_sq"], state["step"]
        return AdamSlot(param, gradient, *moments, rate, rate * group["rest_scale"])


def step_together(optimizers: Sequence[GpuFieldAdam], scale: StepScale = ONE_VIEW) -> None:
    """Step the five tensors of a field in one kernel; step sizes are those for a single view, which `scale` changes."""
    from lapgs_plugin.ops.adam.in_triton import step_triton

    slots = [optimizer.next_step(scale) for optimizer in optimizers]
    if slots[0].values.shape[0] > 0:
        step_triton(slots, scale.views, scale.gradient)


@matches_reference("Adam in a launch for each tensor", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare three steps of each kind of tensor, the last one for four views, relative to how far tensors moved."""
    generator = torch.Generator().manual_seed(0)
    shapes: list[tuple[int, ...]] = [(700, 3), (700, 4), (700, 3), (700,), (700, 16, 3)]
    starts = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
    stepped, expected = ([torch.nn.Parameter(start.clone()) for start in starts] for _ in range(2))
    optimizers, references = (
        [
            GpuFieldAdam(param, lr=i / 100, rest_scale=0.05 if param.ndim == 3 else 1.0)
            for i, param in enumerate(params, start=1)
        ]
        for params in (stepped, expected)
    )
    for scale in (ONE_VIEW, ONE_VIEW, StepScale.of(4)):
        for one, other in zip(stepped, expected, strict=True):
            one.grad = other.grad = torch.randn(one.shape, generator=generator).to(device)
        step_together(optimizers, scale)
        step_torch([reference.next_step(scale) for reference in references], scale.views, scale.gradient)
    return largest(
        (one - other).abs() / (other - start).abs().max()
        for one, other, start in zip(stepped, expected, starts, strict=True)
    )
