"""A checkout's scaled rotations, made by our kernel only where it makes the same."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.ops.scaled_rotations import scaled_rotations
from lapgs_plugin.ops.scaled_rotations.in_torch import scaled_rotations_torch
from lapgs_plugin.reference_raster.oracle import rotation_matrices
from lapgs_plugin.runner.checkout_rotations import in_our_kernel


def _gaussians(device: str, n: int = 50) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(n, 3, generator=generator).to(device), torch.randn(n, 4, generator=generator).to(device)


def test_a_sphere_becomes_the_gaussian() -> None:
    scales, quaternions = _gaussians("cpu")
    units = torch.nn.functional.normalize(quaternions)
    expected = rotation_matrices(units) @ torch.diag_embed(scales)
    torch.testing.assert_close(scaled_rotations(scales, quaternions), expected, rtol=1e-5, atol=1e-6)  # worst 2e-7


def test_without_a_gpu_the_checkouts_function_is_called() -> None:
    called: list[int] = []

    def build(scales: Any, quaternions: Any) -> Any:
        called.append(len(scales))
        return scaled_rotations_torch(scales, quaternions)

    arguments = _gaussians("cpu")
    assert torch.equal(in_our_kernel(build)(*arguments), scaled_rotations_torch(*arguments))
    assert called == [50]


@pytest.mark.gpu
def test_ours_takes_its_place_where_it_agrees() -> None:
    called: list[int] = []

    def build(scales: Tensor, quaternions: Tensor) -> Tensor:
        called.append(len(scales))
        return scaled_rotations_torch(scales, quaternions)

    def other(scales: Tensor, quaternions: Tensor) -> Tensor:
        return 2.0 * build(scales, quaternions)

    arguments, expected = _gaussians("cuda"), scaled_rotations_torch(*_gaussians("cuda"))
    ours = in_our_kernel(build)
    for _ in range(2):
        torch.testing.assert_close(ours(*arguments), expected, rtol=1e-5, atol=1e-6)
    assert called == [300]  # to compare
    assert torch.equal(in_our_kernel(other)(*arguments), 2.0 * expected)
    scales = arguments[0].clone().requires_grad_()
    assert ours(scales, arguments[1]).requires_grad
    assert len(ours(*(tensor[:0] for tensor in arguments))) == 0
