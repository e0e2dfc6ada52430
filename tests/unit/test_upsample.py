"""Check upsampling in one pass against PyTorch's operations."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import ModuleType
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.pyramid import Pyramid, transposed_taps
from lapgs_plugin.hierarchy.settings import GRIDS
from lapgs_plugin.ops.upsample import triton_works, upsample, upsample_add


def images(grid: str, shape: tuple[int, ...], dtype: torch.dtype, device: str = "cpu") -> tuple[torch.Tensor, ...]:
    """Return coarse, fine, and their expected sum."""
    height, width = shape[-2:]
    coarse = torch.randn(*shape[:-2], (height + 1) // 2, (width + 1) // 2, dtype=dtype, device=device)
    fine = torch.randn(shape, dtype=dtype, device=device)
    return coarse, fine, Pyramid(grid).up(coarse, (height, width)) + fine


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(GRIDS),
    st.tuples(st.integers(1, 3), st.integers(1, 70), st.integers(1, 40)),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_on_a_cpu_it_is_up_and_the_sum(grid: str, shape: tuple[int, int, int], dtype: torch.dtype) -> None:
    coarse, fine, expected = images(grid, shape, dtype)
    # Sums in another order; worst seen 9e-7 and 2e-15.
    tolerance = 5e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(upsample_add(Pyramid(grid), coarse, fine), expected, rtol=0, atol=tolerance)
    up = upsample(Pyramid(grid), coarse, (shape[1], shape[2]))
    torch.testing.assert_close(up, expected - fine, rtol=0, atol=tolerance)


def test_batches_and_images_that_lie_otherwise_in_memory() -> None:
    coarse, fine, expected = images("camera", (2, 3, 33, 50), torch.float32)
    turned = [image.movedim(1, -1).contiguous().movedim(-1, 1) for image in (coarse, fine)]
    torch.testing.assert_close(upsample_add(Pyramid(), *turned), expected, rtol=0, atol=5e-6)  # 4.8e-7 seen
    # 3.6e-7 seen.
    torch.testing.assert_close(upsample(Pyramid(), turned[0], (33, 50)), expected - fine, rtol=0, atol=5e-6)


@pytest.mark.parametrize("differentiated", [True, False])
def test_half_precision_is_upsampled_in_float32(differentiated: bool) -> None:
    coarse = torch.randn(3, 17, 25).half()
    expected = upsample(Pyramid(), coarse.float().requires_grad_(differentiated), (33, 50))
    up = upsample(Pyramid(), coarse.requires_grad_(differentiated), (33, 50))
    assert up.dtype == torch.float32
    assert torch.equal(up, expected)


def test_an_image_that_is_not_half_of_the_size_is_refused() -> None:
    with pytest.raises(UserInputError, match=r"Up to 33x50 .* needs an image of 17x25, got 16x25"):
        upsample(Pyramid(), torch.zeros(3, 16, 25), (33, 50))


@pytest.mark.parametrize("shape", [(1, 2, 3), (4, 3, 2, 3)])
def test_images_of_other_channels_are_refused_and_not_read_out_of_bounds(shape: tuple[int, ...]) -> None:
    with pytest.raises(UserInputError, match="expected images of as many channels"):
        upsample_add(Pyramid(), torch.zeros(shape), torch.zeros(3, 4, 6))


def test_images_on_two_devices_are_refused() -> None:
    with pytest.raises(UserInputError, match="on cpu and meta: expected images on one device"):
        upsample_add(Pyramid(), torch.zeros(3, 5, 5), torch.zeros(3, 10, 10, device="meta"))


def test_gradients_go_through() -> None:
    coarse, fine, _ = images("camera", (3, 8, 9), torch.float32)
    coarse.requires_grad_()
    upsample_add(Pyramid(), coarse, fine).sum().backward()
    assert coarse.grad is not None
    # Every fine pixel is an average of coarse ones: their gradients add up to the number of fine pixels.
    assert coarse.grad.sum().item() == pytest.approx(3 * 8 * 9, rel=1e-5)  # 7.1e-8 seen


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(GRIDS), st.integers(1, 400))
def test_taps_are_few_and_averages(grid: str, size: int) -> None:
    first, weights = Pyramid(grid).up_taps(size)
    assert weights.shape[1] <= 5
    assert int(first.min()) >= 0
    assert int(first.max()) + weights.shape[1] <= (size + 1) // 2
    assert float(weights.min()) >= 0.0
    assert float((weights.sum(1) - 1).abs().max()) < 1e-14


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(GRIDS), st.integers(1, 400))
def test_transposed_taps_are_the_gradient(grid: str, size: int) -> None:
    first, weights = transposed_taps(*Pyramid(grid).up_taps(size), (size + 1) // 2)
    assert weights.shape[1] <= 12
    leaf, fine = torch.randn((size + 1) // 2, 1, dtype=torch.float64, requires_grad=True), torch.randn(size).double()
    (Pyramid(grid).up(leaf, (size, 1))[:, 0] * fine).sum().backward()
    taken = (weights * fine[first[:, None] + torch.arange(weights.shape[1])]).sum(1)
    torch.testing.assert_close(taken, leaf.grad[:, 0], rtol=0, atol=1e-14)  # 8.9e-16 seen


def put_in_place(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Replace the kernels by PyTorch's operations, with Up times `factor` in the sum."""
    kernels = ModuleType("kernels")
    vars(kernels).update(
        upsample_triton=lambda pyramid, coarse, size: pyramid.up(coarse, size),
        upsample_add_triton=lambda pyramid, coarse, fine: factor * pyramid.up(coarse, fine.shape[-2:]) + fine,
    )
    monkeypatch.setitem(sys.modules, "lapgs_plugin.ops.upsample.in_triton", kernels)


def is_used() -> bool:
    return triton_works.passes_on(torch.device("cpu"))


@pytest.mark.parametrize(("factor", "right"), [(1.0, True), (1.001, False), (math.nan, False)])
def test_a_kernel_that_is_off_is_not_used(
    factor: float, right: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    put_in_place(monkeypatch, factor)
    assert is_used() == right
    assert ("many small operations instead of one kernel, because our kernels are off by" in caplog.text) != right


class _Asking(torch.autograd.Function):
    """Run the check inside a forward pass, where gradients are off."""

    @staticmethod
    def forward(ctx: Any, answer: torch.Tensor) -> torch.Tensor:
        return answer + is_used()


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_kernel_is_checked_whatever_the_caller_is_doing(
    mode: Callable[[], AbstractContextManager[None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    put_in_place(monkeypatch, 1.0)
    with mode():
        assert is_used()
    assert _Asking.apply(torch.zeros((), requires_grad=True)) == 1.0  # type: ignore[no-untyped-call]  # torch's


@pytest.mark.gpu
@pytest.mark.parametrize("shape", [(3, 7, 8), (3, 533, 800), (4, 3, 33, 150), (3, 2312, 3093)])
def test_on_a_gpu_it_is_up_and_the_sum(shape: tuple[int, ...]) -> None:
    assert triton_works()
    coarse, fine, expected = images("camera", shape, torch.float32, "cuda")
    torch.testing.assert_close(upsample_add(Pyramid(), coarse, fine), expected, rtol=0, atol=5e-6)
    gradients = []
    for up in (upsample, Pyramid.up):
        leaf = coarse.clone().requires_grad_()
        (up(Pyramid(), leaf, (shape[-2], shape[-1])) * fine).sum().backward()
        assert leaf.grad is not None
        gradients.append(leaf.grad)
    torch.testing.assert_close(*gradients, rtol=0, atol=2e-5)
