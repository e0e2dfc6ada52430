"""Adam of a field's tensors on a GPU, all in one step; whether this machine can is found out on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from lapgs_plugin.ops.self_check import largest, matches_reference

ADAM_EPS = 1e-15
"""Epsilon of Adam, 3DGS's."""


ROOT_SCALING = True
"""Whether steps for several views are longer and remember less, see `StepScale`. False is for measurements: then
gradients are averaged, and rates and moments are those of one view."""


@dataclass(frozen=True)
class StepScale:
    """How Adam's step for the summed gradients of several views differs from a step for one.

    For v views this is the square-root scaling of Malladi et al. 2022, which Grendel-GS uses (Zhao et al. 2024): step
    sizes times sqrt(v), betas to the power of v, epsilon over sqrt(v), with the mean of the gradients. Here the sum
    over sqrt(v) takes the place of the mean, and epsilon stays as it is. That is the same step, and its moments have
    the size of one view's, so v may change from step to step. Adam's count rises by v, so its bias correction is that
    of beta to the power of all views so far.

    Attributes:
        views: how many views of progress the step is: the power of the betas, and by how much Adam's count rises.
        gradient: factor on the sum of the views' gradients.
        rate: factor on step sizes.
    """

    views: int = 1
    gradient: float = 1.0
    rate: float = 1.0

    @classmethod
    def of(cls, views: int) -> StepScale:
        """For the sum of so many views' gradients."""
        if not ROOT_SCALING:
            return cls(gradient=1 / views)
        return cls(views, 1 / math.sqrt(views), math.sqrt(views))


ONE_VIEW = StepScale()


class GpuFieldAdam(torch.optim.Optimizer):
    """Adam's state of one tensor, as gsplat's strategies edit it; stepped with its siblings by `step_together`.

    Args:
        param: (n, ...) float32, contiguous, on a CUDA device.
        lr: step size of the first three columns, or of all with a `rest_scale` of 1.
        rest_scale: of that, the step size of all further columns.
    """

    def __init__(self, param: torch.nn.Parameter, lr: float, rest_scale: float = 1.0) -> None:
        super().__init__([param], {"lr": lr, "rest_scale": rest_scale})
        self.state[param] = {
            "step": torch.zeros((), device=param.device),
            "exp_avg": torch.zeros_like(param),
            "exp_avg_sq": torch.zeros_like(param),
        }


@torch.no_grad()
def step_together(optimizers: Sequence[GpuFieldAdam], scale: StepScale = ONE_VIEW) -> None:
    """One step of the five tensors of a field; without a gradient one moves by its momentum alone.

    Args:
        optimizers: with their step sizes for this step.
        scale: how the step counts, and what becomes of gradients.
    """
    from lapgs_plugin.ops.adam.in_triton import AdamSlot, step_five

    tensors = []
    for optimizer in optimizers:
        group = optimizer.param_groups[0]
        param, rate = group["params"][0], group["lr"]
        state: dict[str, Any] = optimizer.state[param]
        gradient = torch.zeros_like(param) if param.grad is None else param.grad.contiguous()
        moments = state["exp_avg"], state["exp_avg_sq"], state["step"]
        tensors.append(AdamSlot(param, gradient, *moments, rate, rate * group["rest_scale"]))
    torch._foreach_add_([one.step for one in tensors], scale.views)
    if len(tensors[0].values) > 0:
        step_five(tensors, scale.views, scale.gradient)


@lru_cache(maxsize=1)
def adam_in_triton() -> bool:
    """Whether our kernel takes the steps that PyTorch's Adam takes."""
    return matches_reference("Adam in a launch a tensor", lambda: largest_difference(torch.device("cuda")), 1e-5)


def largest_difference(device: torch.device) -> float:
    """From PyTorch's Adam after three steps of each kind of tensor, relative to how far these moved.

    The last of them is one for four views.
    """
    generator = torch.Generator().manual_seed(0)
    shapes: list[tuple[int, ...]] = [(700, 3), (700, 4), (700, 3), (700,), (700, 16, 3)]
    starts = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
    ours = [torch.nn.Parameter(start.clone()) for start in starts]
    rates = [1e-2, 2e-2, 3e-2, 4e-2, 5e-2]
    scales = [1.0] * 4 + [0.05]
    optimizers = [GpuFieldAdam(param, rate, scale) for param, rate, scale in zip(ours, rates, scales, strict=True)]
    theirs = [torch.nn.Parameter(start.clone()) for start in starts[:4]]
    theirs += [torch.nn.Parameter(part.clone()) for part in (starts[4][:, :1], starts[4][:, 1:])]
    groups = [{"params": [param], "lr": rate} for param, rate in zip(theirs, [*rates, 0.05 * 5e-2], strict=True)]
    adam = torch.optim.Adam(groups, eps=ADAM_EPS)
    for scale in (ONE_VIEW, ONE_VIEW, StepScale(views=4, gradient=0.5)):
        gradients = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
        for param, gradient in zip(ours, gradients, strict=True):
            param.grad = gradient.clone()
        for param, gradient in zip(theirs, [*gradients[:4], gradients[4][:, :1], gradients[4][:, 1:]], strict=True):
            param.grad = scale.gradient * gradient.contiguous()
        if scale.views > 1:  # its betas to the power of a count of steps are to be ours to that of all views
            for group in adam.param_groups:
                group["betas"] = tuple(beta**scale.views for beta in group["betas"])
                adam.state[group["params"][0]]["step"] /= scale.views
        step_together(optimizers, scale)
        adam.step()
    expected = [param.detach() for param in theirs[:4]]
    expected.append(torch.cat([theirs[4].detach(), theirs[5].detach()], 1))
    return largest(
        (end - found.detach()).abs() / (end - start).abs().max()
        for end, found, start in zip(expected, ours, starts, strict=True)
    )
