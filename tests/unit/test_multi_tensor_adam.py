"""A script's plain Adam, stepped by our kernel, against PyTorch's own."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lapgs_plugin.ops.adam import multi_tensor
from lapgs_plugin.ops.adam.multi_tensor import MultiTensorAdam, fuse_steps
from tests.devices import DEVICES


@pytest.fixture
def works(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the kernel pass its check without a GPU; tensors on a CPU are stepped in PyTorch's operations anyway."""
    if not torch.cuda.is_available():
        monkeypatch.setattr(multi_tensor, "triton_works", lambda *tensors: not tensors)


def new_adam(device: str, **options: Any) -> tuple[list[torch.nn.Parameter], torch.optim.Adam]:
    """Return parameters as a 3DGS model has them, and its optimizer."""
    generator = torch.Generator().manual_seed(0)
    shapes = (700, 3), (700, 1, 3), (700, 15, 3), (700, 1), (0, 3)
    tensors = [torch.randn(shape, generator=generator).to(device) for shape in shapes]
    tensors.append(torch.randn(3, 700, generator=generator).to(device).T)  # not contiguous
    parameters = [torch.nn.Parameter(tensor) for tensor in tensors]
    groups = [{"params": [one], "lr": 0.1 * (index + 1), "name": str(index)} for index, one in enumerate(parameters)]
    return parameters, torch.optim.Adam(groups, lr=0.0, eps=1e-15, **options)


def step(parameters: list[torch.nn.Parameter], optimizer: torch.optim.Optimizer, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for index, one in enumerate(parameters):
        gradient = torch.randn(one.shape, generator=generator).to(one.device)
        # Of the parameter's strides, as autograd makes it.
        one.grad = None if (index, seed) == (1, 1) else torch.empty_like(one).copy_(gradient)
    optimizer.param_groups[0]["lr"] = np.float64(0.1 / (1 + seed))  # as 3DGS's schedule of positions
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)


def assert_same(stepped: list[torch.nn.Parameter], expected: list[torch.nn.Parameter]) -> None:
    for one, other in zip(stepped, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)  # numbers to 5, moved by 1; worst seen 5e-7


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.5, 0.9)])
def test_steps_are_those_of_pytorch(device: str, betas: tuple[float, float], works: None) -> None:
    (stepped, ours), (expected, theirs) = new_adam(device, betas=betas), new_adam(device, betas=betas)
    step(stepped, ours, 0), step(expected, theirs, 0)  # so that there is state to take over
    fuse_steps(ours)
    assert type(ours) is MultiTensorAdam
    assert all(tensor.is_contiguous() for one in stepped for tensor in (one, *ours.state[one].values()))
    for seed in range(1, 5):
        step(stepped, ours, seed)
        step(expected, theirs, seed)
    assert_same(stepped, expected)
    assert [int(ours.state[one]["step"]) for one in stepped] == [5, 4, 5, 5, 5, 5], "one had no gradient once"

    # A checkout's own checkpoint, read by a script without us, and back.
    other, plain = new_adam(device, betas=betas)
    other = [one.requires_grad_() for one in other]
    with torch.no_grad():
        for one, trained in zip(other, stepped, strict=True):
            one.copy_(trained)
    plain.load_state_dict(copy.deepcopy(ours.state_dict()))
    step(stepped, ours, 5), step(other, plain, 5), step(expected, theirs, 5)
    assert_same(stepped, expected)
    assert_same(other, expected)


@pytest.mark.parametrize("device", DEVICES)
def test_an_optimizer_fused_by_its_script(device: str, works: None) -> None:
    (stepped, ours), (expected, theirs) = new_adam(device, fused=True), new_adam(device)
    for seed in range(3):
        step(stepped, ours, seed)
        step(expected, theirs, seed)
        fuse_steps(ours)
    assert ours.state[stepped[0]]["step"].device.type == "cpu"
    assert [ours.param_groups[0][name] for name in ("fused", "foreach")] == [None, None], "PyTorch's defaults"
    assert_same(stepped, expected)


def test_hooks_and_closures_are_called_once(works: None) -> None:
    parameters, optimizer = new_adam("cpu")
    fuse_steps(optimizer)
    called: list[str] = []
    optimizer.register_step_pre_hook(lambda *_: called.append("before"))
    optimizer.register_step_post_hook(lambda *_: called.append("after"))

    def closure() -> Tensor:
        called.append("closure")
        optimizer.zero_grad()
        loss = parameters[0].square().sum()
        loss.backward()
        return loss

    before = parameters[0].detach().square().sum()
    assert optimizer.step(closure) == before
    assert called == ["before", "closure", "after"]
    restored: torch.optim.Optimizer = copy.deepcopy(optimizer)
    restored.step()
    assert called == ["before", "closure", "after"], "hooks are not copied, as of any optimizer"
    optimizer.step()
    assert called == ["before", "closure", "after", "before", "after"]


def test_hooks_of_all_optimizers_are_called(works: None) -> None:
    parameters, optimizer = new_adam("cpu")
    fuse_steps(optimizer)
    called: list[str] = []
    handles = (
        register_optimizer_step_pre_hook(lambda *_: called.append("before")),
        register_optimizer_step_post_hook(lambda *_: called.append("after")),
    )
    step(parameters, optimizer, 0)
    for handle in handles:
        handle.remove()
    step(parameters, optimizer, 1)
    assert called == ["before", "after"]


def test_gradients_are_forgotten_or_filled_with_zeros(works: None) -> None:
    (parameter, *_), optimizer = new_adam("cpu")
    fuse_steps(optimizer)
    parameter.grad = torch.ones_like(parameter)
    optimizer.zero_grad(set_to_none=False)
    assert not parameter.grad.any()
    optimizer.zero_grad()
    assert parameter.grad is None


def test_profiles_name_a_step(works: None) -> None:
    parameters, optimizer = new_adam("cpu")
    fuse_steps(optimizer)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        step(parameters, optimizer, 0)
    names = [event.key.partition("#")[0] for event in profile.key_averages()]
    assert {"Optimizer.step", "Optimizer.zero_grad"} <= set(names)


@pytest.mark.parametrize("device", DEVICES)
def test_moments_of_other_gaussians_are_an_error(device: str, works: None) -> None:
    parameters, optimizer = new_adam(device)
    fuse_steps(optimizer)
    step(parameters, optimizer, 0)
    state = optimizer.state[parameters[0]]
    state["exp_avg"] = state["exp_avg"][:600]
    with pytest.raises(RuntimeError, match="size"):
        step(parameters, optimizer, 1)


class Own(torch.optim.Adam):
    """A fork's own optimizer."""


@pytest.mark.parametrize(
    "make",
    [
        lambda values: Own([values]),
        lambda values: torch.optim.SGD([values], lr=0.1),
        lambda values: torch.optim.AdamW([values]),
        *(
            lambda values, name=name: torch.optim.Adam([values], **{name: True})
            for name in ("amsgrad", "maximize", "differentiable")
        ),
        lambda values: torch.optim.Adam([values], weight_decay=0.1),
        lambda values: torch.optim.Adam([values], lr=torch.tensor(0.1), foreach=False),
    ],
)
def test_what_is_left_alone(make: Callable[[Tensor], torch.optim.Optimizer], works: None) -> None:
    optimizer = make(torch.nn.Parameter(torch.ones(3)))
    group, kind = dict(optimizer.param_groups[0]), type(optimizer)
    fuse_steps(optimizer)
    assert type(optimizer) is kind
    assert all(optimizer.param_groups[0][name] is value for name, value in group.items())


def test_without_the_kernel_it_is_pytorchs_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multi_tensor, "triton_works", lambda *tensors: False)
    (stepped, ours), (expected, theirs) = new_adam("cpu"), new_adam("cpu")
    for seed in range(3):
        step(stepped, ours, seed)
        step(expected, theirs, seed)
        fuse_steps(ours)
    assert type(ours) is torch.optim.Adam
    assert ours.param_groups[0]["fused"] is True
    assert_same(stepped, expected)


@pytest.mark.parametrize(
    "made",
    [
        "GpuFieldAdam(values, 0.1)",
        "FieldAdam([values], 0.1)",
        "MultiTensorAdam([values], 0.1)",
    ],
)
def test_no_optimizer_of_ours_imports_pytorchs_compiler(made: str) -> None:
    """Importing it takes two seconds, more than some levels."""
    lines = [
        "import sys, torch",
        "from lapgs_plugin.ops.adam import GpuFieldAdam",
        "from lapgs_plugin.ops.adam.on_cpu import FieldAdam",
        "from lapgs_plugin.ops.adam.multi_tensor import MultiTensorAdam",
        "values = torch.nn.Parameter(torch.ones(5, 3))",
        "values.grad = torch.ones(5, 3)",
        f"optimizer = {made}",
        "if not isinstance(optimizer, GpuFieldAdam): optimizer.step()",  # which `step_together` steps
        "assert 'torch._dynamo' not in sys.modules",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)
