"""Quaternions normalised as PyTorch does, where a checkout's model does no more."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import normalize

from lapgs_plugin.ops.unit_quaternions import unit_quaternions
from lapgs_plugin.runner.stage_model import fuse_rotations
from tests.devices import DEVICES


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(7, 4), (0, 4), (7, 3), (2, 7, 4)])
def test_as_pytorch_does(device: str, shape: tuple[int, ...]) -> None:
    values = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device)
    units, gradients = [], []
    for operation in (unit_quaternions, normalize):
        leaf = values.clone().requires_grad_()
        units.append(operation(leaf))
        gradients += torch.autograd.grad((units[-1] * values.cos()).sum(), leaf)
    torch.testing.assert_close(*units, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-5)
    strided = values.mT.contiguous().mT
    assert torch.equal(unit_quaternions(strided), normalize(strided))


def test_models_with_another_activation_are_left() -> None:
    for activation in (torch.sigmoid, None, lambda rotation: 2.0 * normalize(rotation)):
        model = SimpleNamespace(rotation_activation=activation)
        fuse_rotations(model)
        assert model.rotation_activation is activation
    model = SimpleNamespace(rotation_activation=normalize)
    fuse_rotations(model)
    assert model.rotation_activation is unit_quaternions
    fuse_rotations(SimpleNamespace())
