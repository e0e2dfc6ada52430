"""Step the tensors of a script's own `torch.optim.Adam` in one launch of our kernel.

PyTorch's fused Adam has one for each group of parameters, because it takes one rate. Its blocks take so many numbers
that a field's positions leave most of a GPU idle, and its Python takes as long as a small render.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import profiler
from torch.optim.adam import adam
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS, AdamSlot
from lapgs_plugin.ops.self_check import largest, matches_reference


class MultiTensorAdam(torch.optim.Adam):
    """Step as `torch.optim.Adam` does, with its groups, state and hooks; results differ by rounding.

    `fuse_steps` makes optimizers of this class. It supports none of the options of `torch.optim.Adam`.

    Where nobody looks on, it does not name its work in profiles, which takes PyTorch as long as some launches.
    """

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step all tensors that have a gradient, after `closure`, whose result is returned."""
        own = self._optimizer_step_pre_hooks or self._optimizer_step_post_hooks
        hooks = own or _global_optimizer_pre_hooks or _global_optimizer_post_hooks
        return self._watched_step(closure) if hooks or profiler._is_profiler_enabled else self._step(closure)

    step.hooked = True  # type: ignore[attr-defined]  # as PyTorch marks it, which else calls hooks twice

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget all gradients, or fill them with zeros."""
        if not set_to_none or profiler._is_profiler_enabled:
            super().zero_grad(set_to_none)
            return
        for group in self.param_groups:
            for values in group["params"]:
                values.grad = None

    @torch.no_grad()
    def _step(self, closure: Callable[[], Any] | None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        slots: dict[tuple[Any, ...], list[AdamSlot]] = {}  # of tensors that one launch can step
        for group in self.param_groups:
            for values in group["params"]:
                if values.grad is None:
                    continue
                slot = _slot(values, values.grad, self.state[values], group)
                if slot is not None:
                    slots.setdefault((*group["betas"], group["eps"], values.device), []).append(slot)
        for (beta1, beta2, eps, _), together in slots.items():
            _step_together(together, (beta1, beta2), eps)
        return loss

    _watched_step = torch.optim.Optimizer.profile_hook_step(_step)


def _slot(values: Tensor, gradient: Tensor, state: dict[str, Any], group: dict[str, Any]) -> AdamSlot | None:
    """Count a step of a tensor and return its inputs; None if it was stepped in PyTorch's operations."""
    if not state:  # on the processor, as PyTorch's own counts: a GPU does not have to be asked for it
        state["step"] = torch.tensor(0.0)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(values), torch.zeros_like(values)
    rate = float(group["lr"])  # some scripts set rates of NumPy's types
    mean, square = state["exp_avg"], state["exp_avg_sq"]
    # The kernel does not see shapes. PyTorch's operations say if a fork has pruned a tensor and not its moments.
    if _are_alike(values, gradient, mean, square) and values.numel() > 0 and triton_works(values):
        count = float(state["step"]) + 1.0
        state["step"].fill_(count)  # takes a quarter of the time of adding one
        return AdamSlot(values, gradient, mean, square, count, rate, rate)
    betas = group["betas"]
    adam(
        [values], [gradient], [mean], [square], [], [state["step"]], foreach=False, amsgrad=False, maximize=False,
        weight_decay=0.0, beta1=betas[0], beta2=betas[1], lr=rate, eps=group["eps"],
    )  # fmt: skip
    return None


def _step_together(slots: Sequence[AdamSlot], betas: tuple[float, float], eps: float) -> None:
    from lapgs_plugin.ops.adam.in_triton import MOST_TENSORS, step_tensors_triton

    for start in range(0, len(slots), MOST_TENSORS):
        step_tensors_triton(slots[start : start + MOST_TENSORS], betas, eps)


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


@matches_reference("PyTorch's fused Adam instead of ours", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare three steps of more tensors than a launch takes, relative to how far they moved."""
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(size, 3, generator=generator).to(device) for size in (700, 1, 171, 512, 170, 341, 700)]
    references = [torch.nn.Parameter(start.clone()) for start in starts]
    rates = [0.1 * i for i in range(1, len(starts) + 1)]
    groups = [{"params": [one], "lr": rate} for one, rate in zip(references, rates, strict=True)]
    optimizer = torch.optim.Adam(groups, eps=ADAM_EPS)
    states = [(start.clone(), torch.zeros_like(start), torch.zeros_like(start)) for start in starts]
    for count in range(1, 4):
        slots = []
        for reference, (values, mean, square), rate in zip(references, states, rates, strict=True):
            reference.grad = torch.randn(values.shape, generator=generator).to(device)
            slots.append(AdamSlot(values, reference.grad, mean, square, count, rate, rate))
        optimizer.step()
        _step_together(slots, BETAS, ADAM_EPS)
    return largest(
        (values - reference).abs() / (reference.detach() - start).abs().max()
        for (values, _, _), reference, start in zip(states, references, starts, strict=True)
    )
