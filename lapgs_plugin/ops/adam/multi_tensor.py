"""Step the tensors of a script's own `torch.optim.Adam` in one launch of our kernel.

PyTorch's fused Adam has one for each group of parameters, because it takes one rate. Its blocks take so many numbers
that a field's positions leave most of a GPU idle, and its Python takes as long as a small render.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import torch
from torch import Tensor
from torch.autograd import profiler
from torch.optim.adam import adam
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS, AdamSlot, PlainOptimizer
from lapgs_plugin.ops.self_check import largest, matches_reference

_Stepped = tuple[Tensor, Tensor, dict[str, Any], dict[str, Any]]
"""A tensor that has a gradient, this gradient, its state and its group of parameters."""


class MultiTensorAdam(PlainOptimizer, torch.optim.Adam):
    """Step as `torch.optim.Adam` does, with its groups, state and hooks; results differ by rounding.

    It supports none of the options of `torch.optim.Adam`. Tensors that our kernel cannot step, such as those on a CPU,
    it steps in PyTorch's operations.

    Where nobody looks on, it does not name its work in profiles, which takes PyTorch as long as some launches. It does
    not import PyTorch's compiler, which takes seconds.
    """

    _plan: _Plan | None = None  # of the last step; a copy of an optimizer makes its own

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step all tensors that have a gradient, after `closure`, whose result is returned."""
        if profiler._is_profiler_enabled or self._optimizer_step_pre_hooks or _global_optimizer_pre_hooks:
            return self._watched_step(closure)
        loss = self._step(closure)
        for hook in chain(self._optimizer_step_post_hooks.values(), _global_optimizer_post_hooks.values()):
            hook(self, (self, closure), {})
        return loss

    step.hooked = True  # type: ignore[attr-defined]  # as PyTorch marks it, which else calls hooks twice

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget all gradients, or fill them with zeros."""
        if not set_to_none or profiler._is_profiler_enabled:
            super().zero_grad(set_to_none)
            return
        for group in self.param_groups:
            for values in group["params"]:
                values.grad = None

    def _step(self, closure: Callable[[], Any] | None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        state = self.state
        tensors = [
            (values, gradient, state[values], group)
            for group in self.param_groups
            for values in group["params"]
            if (gradient := values.grad) is not None
        ]
        if self._plan is None or not self._plan.fits(tensors):
            tensors = _left_by_pytorch(tensors)
            self._plan = _Plan(tensors)
        self._plan.step(tensors)
        return loss

    _watched_step = torch.optim.Optimizer.profile_hook_step(_step)


class _Plan:
    """Hold how our kernel steps tensors, which is decided again only when one of them looks different.

    Their counts of steps become numbers of one tensor, which a single operation counts. Each remains a tensor on the
    processor, as PyTorch has it: a script may read, change, replace and save it.

    Args:
        tensors: those that our kernel can step.
    """

    def __init__(self, tensors: Sequence[_Stepped]) -> None:
        counts = torch.tensor([float(state["step"]) for _, _, state, _ in tensors], device="cpu")
        self._counts = counts.numpy()  # NumPy's operations on a few numbers take a third of the time
        self._looks = []
        self._together: dict[tuple[Any, ...], list[int]] = {}  # tensors of a launch, by its settings
        for index, (values, _, state, group) in enumerate(tensors):
            state["step"] = counts[index]
            device, betas, eps = values.get_device(), tuple(group["betas"]), group["eps"]
            self._looks.append((values.nbytes, device, state["step"], betas, eps))
            self._together.setdefault((device, betas, eps), []).append(index)

    def fits(self, tensors: Sequence[_Stepped]) -> bool:
        """Return whether tensors are those of the plan, or others of the same sizes in their places."""
        if len(tensors) != len(self._looks):
            return False
        for (values, gradient, state, group), look in zip(tensors, self._looks, strict=True):
            nbytes, device, count, betas, eps = look
            if state.get("step") is not count or group["betas"] != betas or group["eps"] != eps:
                return False
            for tensor in (values, gradient, state["exp_avg"], state["exp_avg_sq"]):
                if tensor.nbytes != nbytes or tensor.get_device() != device or not tensor.is_contiguous():
                    return False
        return True

    def step(self, tensors: Sequence[_Stepped]) -> None:
        """Step tensors that fit."""
        self._counts += 1.0
        counts = self._counts.tolist()
        for (_, betas, eps), together in self._together.items():
            slots = []
            for index in together:
                values, gradient, state, group = tensors[index]
                rate = float(group["lr"])  # some scripts set rates of NumPy's types
                moments = state["exp_avg"], state["exp_avg_sq"]
                slots.append(AdamSlot(values, gradient, *moments, counts[index], rate, rate))
            _step_in_triton(slots, betas, eps)


def _left_by_pytorch(tensors: Sequence[_Stepped]) -> list[_Stepped]:
    """Step tensors that our kernel cannot step in PyTorch's operations, and return the others."""
    left = []
    for tensor in tensors:
        values, gradient, state, group = tensor
        if not state:  # the count on the processor, as PyTorch's own: a GPU does not have to be asked for it
            state["step"] = torch.tensor(0.0)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(values), torch.zeros_like(values)
        moments = state["exp_avg"], state["exp_avg_sq"]
        # The kernel does not see shapes. PyTorch's operations say if a fork has pruned a tensor and not its moments.
        if _are_alike(values, gradient, *moments) and triton_works(values):
            left.append(tensor)
            continue
        _step_in_pytorch(values, gradient, *moments, state["step"], float(group["lr"]), group["betas"], group["eps"])
    return left


@torch.no_grad()
def _step_in_pytorch(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, count: Tensor,
    rate: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    adam(
        [values], [gradient], [mean], [square], [], [count], foreach=False, amsgrad=False, maximize=False,
        weight_decay=0.0, beta1=betas[0], beta2=betas[1], lr=rate, eps=eps,
    )  # fmt: skip


def _step_in_triton(slots: Sequence[AdamSlot], betas: tuple[float, float], eps: float) -> None:
    from lapgs_plugin.ops.adam.in_triton import step_tensors_triton

    step_tensors_triton(slots, betas, eps)


def _are_alike(first: Tensor, *others: Tensor) -> bool:
    """Return whether tensors are contiguous and of one shape, type and device."""
    shape, dtype, device = first.shape, first.dtype, first.device
    for tensor in others:
        if tensor.shape != shape or tensor.dtype is not dtype or tensor.device != device:
            return False
        if not tensor.is_contiguous():
            return False
    return first.is_contiguous()


def fuse_steps(optimizer: torch.optim.Optimizer) -> None:
    """Let a plain Adam on a CUDA device step all tensors in one kernel instead of a dozen each; other optimizers stay.

    Tensors are stored by rows for it. Readers of the family return points that are stored by columns, and so are
    positions until the first densification.
    """
    if type(optimizer) is not torch.optim.Adam or not all(map(_is_plain, optimizer.param_groups)):
        return
    ours = triton_works()
    for group in optimizer.param_groups:
        if ours:  # as PyTorch's default has it, because a checkpoint tells the next optimizer what it was
            group["fused"] = None
        else:
            group["fused"], group["foreach"] = True, False
        for parameter in group["params"]:
            if ours:
                parameter.data = parameter.data.contiguous()
            if "step" in (state := optimizer.state.get(parameter, {})):
                state["step"] = torch.as_tensor(state["step"]).to("cpu" if ours else parameter.device)
                state.update({name: state[name].contiguous() for name in ("exp_avg", "exp_avg_sq") if ours})
    if ours:
        optimizer.__class__ = MultiTensorAdam


def _is_plain(group: dict[str, Any]) -> bool:
    """Return whether a group has none of the options that change what Adam computes."""
    changes = "amsgrad", "maximize", "weight_decay", "capturable", "differentiable"
    return not any(group.get(name) for name in changes) and not isinstance(group["lr"], Tensor)


@matches_reference("PyTorch's Adam instead of ours", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare three steps of more tensors than a launch takes, relative to how far they moved."""
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(size, 3, generator=generator).to(device) for size in (700, 1, 171, 512, 170, 341, 700)]
    rates = [0.1 * i for i in range(1, len(starts) + 1)]
    ours, pytorchs = (
        [(start.clone(), torch.zeros_like(start), torch.zeros_like(start)) for start in starts] for _ in range(2)
    )
    counts = torch.zeros(len(starts), device="cpu")
    for step in range(1, 4):
        slots = []
        for own, reference, count, rate in zip(ours, pytorchs, counts, rates, strict=True):
            gradient = torch.randn(own[0].shape, generator=generator).to(device)
            slots.append(AdamSlot(own[0], gradient, *own[1:], step, rate, rate))
            _step_in_pytorch(reference[0], gradient, *reference[1:], count, rate, BETAS, ADAM_EPS)
        _step_in_triton(slots, BETAS, ADAM_EPS)
    return largest(
        (own[0] - reference[0]).abs() / (reference[0] - start).abs().max()
        for own, reference, start in zip(ours, pytorchs, starts, strict=True)
    )
