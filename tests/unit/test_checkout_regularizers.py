"""Regularizers of opacities and scales in a checkout's loss, by our kernels where its statements do the same."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.ops import regularization
from lapgs_plugin.runner import checkout_regularizers

LOOP = """
import torch

class Model:
    def __init__(self, n):
        self._opacity, self._scaling = (torch.nn.Parameter(torch.randn(n, columns)) for columns in (1, 3))
        self.opacity_activation, self.scaling_activation = torch.sigmoid, torch.exp
        self.faint = 0.0

    @property
    def get_opacity(self):
        return self.opacity_activation(self._opacity)

    @property
    def get_scaling(self):
        scales = self.scaling_activation(self._scaling)
        return scales

def training(model, args):
    losses = []
    for step in range(3):
        total = (model._opacity * model._scaling).mean()
        total = total + args.opacities * torch.abs(model.get_opacity).mean()
        total = total + args.scales * torch.abs(model.get_scaling).mean()
        total.backward()
        losses.append(total.detach())
    return losses
"""


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Replace on a CPU, too, and list the weights with which our operation is called."""
    weights: list[tuple[float, float]] = []
    original = regularization.regularized

    def regularized(*arguments: Any) -> Tensor:
        weights.append(arguments[-2:])
        return original(*arguments)

    monkeypatch.setattr(regularization, "regularized", regularized)
    monkeypatch.setattr(checkout_regularizers, "_has_kernels", lambda *tensors: True)
    return weights


def _trained(module: ModuleType, training: Callable[..., Any]) -> list[Tensor]:
    torch.manual_seed(0)
    model = module.Model(70)
    losses = training(model, SimpleNamespace(opacities=0.3, scales=0.2))
    return [*losses, model._opacity.grad, model._scaling.grad]


@pytest.mark.parametrize("turned", [False, True])
def test_ours_do_the_same(
    load_module: Callable[[str], ModuleType], done: list[tuple[float, float]], turned: bool
) -> None:
    text = LOOP
    if turned:
        lines = text.split("\n")
        index = next(i for i, line in enumerate(lines) if "args.opacities" in line)
        lines[index], lines[index + 1] = lines[index + 1], lines[index]
        text = "\n".join(lines)
    module = load_module(text)
    expected = _trained(module, module.training)
    assert done == []
    ours = _trained(module, checkout_regularizers.in_one_kernel(module.training))
    assert done == 3 * [(0.3, 0.2)]
    for one, other in zip(ours, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)  # worst seen 1e-7


@pytest.mark.parametrize(
    ("written", "instead"),
    [
        ("torch.abs(model.get_opacity).mean()", "torch.abs(model.get_opacity).sum()"),
        ("torch.abs(model.get_opacity).mean()", "torch.abs(model.get_opacity).mean(0).sum()"),
        ("torch.abs(model.get_opacity)", "torch.square(model.get_opacity)"),
        ("torch.abs(model.get_opacity)", "torch.abs(model.get_scaling)"),
        ("total + args.opacities", "total - args.opacities"),
        ("total + args.opacities", "0.0 + args.opacities"),
        ("args.scales *", "torch.tensor(args.scales) *"),
        ("args.scales *", "(total + args.scales) *"),
        ("args.scales *", "total *"),
        ("        total = total + args.scales", "        kept = total\n        total = total + args.scales"),
        ("self.opacity_activation(self._opacity)", "self.opacity_activation(self._opacity - 1)"),
        ("self.opacity_activation(self._opacity)", "self.opacity_activation(self._opacity) + self.faint"),
        ("torch.sigmoid, torch.exp", "torch.sigmoid, torch.nn.functional.softplus"),
        ("return scales", "return scales.clamp(max=2.0)"),
    ],
)
def test_what_differs_stays(
    load_module: Callable[[str], ModuleType], done: list[tuple[float, float]], written: str, instead: str
) -> None:
    assert written in LOOP
    module = load_module(LOOP.replace(written, instead, 1))
    training = checkout_regularizers.in_one_kernel(module.training)
    assert all(map(torch.equal, _trained(module, training), _trained(module, module.training)))
    assert done == []


def test_on_a_cpu_the_statements_are_executed(load_module: Callable[[str], ModuleType]) -> None:
    module = load_module(LOOP)
    training = checkout_regularizers.in_one_kernel(module.training)
    assert training is not module.training
    assert all(map(torch.equal, _trained(module, training), _trained(module, module.training)))
