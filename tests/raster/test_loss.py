"""Check the fused photometric loss against PyTorch convolutions, finite differences, closed forms and kornia."""

from __future__ import annotations

import math
from collections.abc import Callable

import kornia
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.event import install_recorder
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.metrics import ssim
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch

Loss = Callable[[Tensor, Tensor, float], Tensor]
INTERIOR = (slice(None), slice(5, -5), slice(5, -5))
"""Pixels whose window lies inside the image."""


def conv_ssim_map(p: Tensor, t: Tensor) -> Tensor:
    """Compute SSIM by its definition: five moments, each a dense 11x11 convolution with zeros around the image."""
    offsets = torch.arange(-5, 6, dtype=p.dtype)
    squared_radius = offsets[:, None] ** 2 + offsets[None, :] ** 2  # (11, 11)
    window = torch.exp(-squared_radius / (2 * 1.5**2))
    window = (window / window.sum())[None, None]

    def mean(x: Tensor) -> Tensor:
        return F.conv2d(x[:, None], window, padding=5)[:, 0]

    mu_p, mu_t = mean(p), mean(t)
    var_p, var_t, cov = mean(p * p) - mu_p**2, mean(t * t) - mu_t**2, mean(p * t) - mu_p * mu_t
    luminance = (2 * mu_p * mu_t + 0.01**2) / (mu_p**2 + mu_t**2 + 0.01**2)
    return luminance * (2 * cov + 0.03**2) / (var_p + var_t + 0.03**2)


def conv_loss(p: Tensor, t: Tensor, weight: float) -> Tensor:
    return (1 - weight) * F.l1_loss(p, t) + weight * (1 - conv_ssim_map(p, t).mean())


def images(shape: tuple[int, int, int], seed: int = 0, low: float = 0.0, high: float = 1.0) -> tuple[Tensor, Tensor]:
    """Make two related images of values in [low, high], float64."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    noise = torch.rand(shape, generator=generator, dtype=torch.float64)
    prediction = 0.7 * target + 0.3 * noise
    return (prediction * (high - low) + low).requires_grad_(), target * (high - low) + low


def loss_and_gradient(
    p: Tensor, t: Tensor, weight: float, version: Loss = photometric_loss_cpu
) -> tuple[Tensor, Tensor]:
    p = p.detach().clone().requires_grad_()
    loss = version(p, t, weight)
    loss.backward()
    assert p.grad is not None
    return loss.detach(), p.grad


def assert_matches_convolutions(p: Tensor, t: Tensor, weight: float, version: Loss = photometric_loss_cpu) -> None:
    loss, gradient = loss_and_gradient(p, t, weight, version)
    expected = conv_loss(p, t, weight)
    (expected_gradient,) = torch.autograd.grad(expected, p)
    # Worst seen in 500 random cases: 4e-16, 7e-14 (the gradient in units of one pixel's share of the loss), 1.3e-14.
    torch.testing.assert_close(loss, expected.detach(), rtol=0, atol=1e-14)
    torch.testing.assert_close(gradient * p.numel(), expected_gradient * p.numel(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "shape",
    [
        (1, 1, 1),
        (3, 1, 40),
        (3, 40, 1),
        (3, 5, 7),
        (3, 11, 11),
        (3, 10, 12),
        (3, 63, 65),
        (2, 400, 9),  # four strips of rows
        (1, 9, 803),  # three blocks of columns
        (1, 131, 411),
    ],
    ids=lambda shape: "x".join(map(str, shape)),
)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("version", [photometric_loss_cpu, photometric_loss_torch])
def test_equals_convolutions_at_any_size(shape: tuple[int, int, int], weight: float, version: Loss) -> None:
    assert_matches_convolutions(*images(shape), weight, version)


@settings(deadline=None, max_examples=40)
@given(
    shape=st.tuples(st.integers(1, 4), st.integers(1, 26), st.integers(1, 40)),
    low=st.floats(-2, 0),
    high=st.floats(0.5, 3),
    weight=st.floats(0, 1),
    seed=st.integers(0, 1000),
)
def test_equals_convolutions_for_values_below_zero_and_above_one(
    shape: tuple[int, int, int], low: float, high: float, weight: float, seed: int
) -> None:
    assert_matches_convolutions(*images(shape, seed, low, high), weight)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 4, 3), (1, 13, 6)])
def test_gradient_equals_finite_differences(shape: tuple[int, int, int]) -> None:
    p, t = images(shape)
    assert torch.autograd.gradcheck(lambda x: photometric_loss_cpu(x, t, 0.2), p, eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("version", [photometric_loss_cpu, photometric_loss_torch])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.5, 0.5), (-1.0, 2.0)])
def test_float32_stays_close_to_float64(low: float, high: float, version: Loss) -> None:
    p, t = images((3, 131, 411), low=low, high=high)
    loss, gradient = loss_and_gradient(p.float(), t.float(), 0.2, version)
    exact, exact_gradient = loss_and_gradient(p.float().double(), t.float().double(), 0.2)
    assert loss.dtype == gradient.dtype == torch.float32
    assert abs(loss.double() - exact) < 1e-7  # worst seen: 1.1e-8
    # In units of one pixel's share of the loss, whose gradients are about 1; worst seen: 5.6e-6.
    assert (gradient.double() - exact_gradient).abs().max() * p.numel() < 5e-5


def test_loss_and_gradient_vanish_for_equal_images() -> None:
    _, t = images((3, 30, 50))
    loss, gradient = loss_and_gradient(t, t, 0.2)
    assert abs(loss) < 1e-14  # worst seen: 0
    assert gradient.abs().max() * t.numel() < 1e-12  # worst seen: 9e-16


def test_ssim_of_constant_images_is_its_luminance_term() -> None:
    a, b = 0.3, 0.8
    p, t = torch.full((1, 30, 30), a, dtype=torch.float64), torch.full((1, 30, 30), b, dtype=torch.float64)
    interior = conv_ssim_map(p, t)[INTERIOR]
    torch.testing.assert_close(interior, torch.full_like(interior, (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)))


def test_ssim_equals_kornia_away_from_the_border() -> None:
    p, t = images((3, 40, 60))
    expected = kornia.metrics.ssim(p.detach()[None], t[None], window_size=11)[0]  # reflects at the border; we pad zeros
    # Worst seen: 4e-11, from the 1e-12 that kornia adds to the denominator.
    torch.testing.assert_close(conv_ssim_map(p, t).detach()[INTERIOR], expected[INTERIOR], rtol=0, atol=1e-9)


def test_ssim_is_that_of_the_shown_image_and_compiles_nothing_that_training_has_not_compiled() -> None:
    p, t = (image.detach().float() for image in images((3, 40, 60), low=-0.2, high=1.2))
    photometric_loss_cpu(p.clone().requires_grad_(), t).backward()
    expected = float(conv_ssim_map(p.double().clamp(0, 1), t.double().clamp(0, 1)).mean())
    with install_recorder("numba:compile") as compiled:
        assert ssim(p, t) == pytest.approx(expected, abs=1e-6)  # 6.2e-9 seen
    assert not compiled.buffer


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_same_bits_for_any_number_of_threads_and_from_run_to_run(dtype: torch.dtype) -> None:
    p, t = images((3, 300, 450))
    results = []
    for threads in (1, 2, 3, 2):
        torch.set_num_threads(threads)
        results.append(loss_and_gradient(p.to(dtype), t.to(dtype), 0.2))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_gradient_scales_with_what_comes_back() -> None:
    p, t = images((3, 20, 20))
    _, gradient = loss_and_gradient(p, t, 0.2)
    (scaled,) = torch.autograd.grad(3 * photometric_loss_cpu(p, t), p)
    torch.testing.assert_close(scaled, 3 * gradient)


@pytest.mark.parametrize("views", [(), (2,)])
def test_a_loss_is_differentiated_again_after_its_gradient_was_changed_in_place(views: tuple[int, ...]) -> None:
    prediction, target = torch.rand(2, *views, 3, 20, 23, generator=torch.Generator().manual_seed(0))
    prediction.requires_grad_()
    loss = photometric_loss(prediction, target)
    (expected,) = torch.autograd.grad(loss, prediction, retain_graph=True)
    expected = expected.clone()
    for times in (1, 2, 3):
        loss.backward(retain_graph=True)  # type: ignore[no-untyped-call]  # torch's
        assert prediction.grad is not None
        torch.testing.assert_close(prediction.grad, times * expected)


def test_images_need_not_be_contiguous() -> None:
    p, t = images((3, 20, 30))
    loss, gradient = loss_and_gradient(p, t, 0.2)
    rows_last = p.detach().permute(2, 1, 0).contiguous().permute(2, 1, 0).requires_grad_()
    strided = photometric_loss_cpu(rows_last, t.permute(1, 2, 0).contiguous().permute(2, 0, 1))
    assert torch.equal(strided, loss)
    assert torch.equal(torch.autograd.grad(strided, rows_last)[0], gradient)


def test_nan_in_the_prediction_reaches_the_loss() -> None:
    p, t = images((3, 200, 30))
    p = p.detach()
    p[1, 150, 7] = torch.nan
    assert photometric_loss_cpu(p, t).isnan()


@pytest.mark.parametrize(
    ("p", "t", "weight", "message"),
    [
        (torch.zeros(3, 4, 5), torch.zeros(3, 5, 4), 0.2, r"prediction \(3, 4, 5\) and target \(3, 5, 4\)"),
        (torch.zeros(4, 5), torch.zeros(4, 5), 0.2, r"expected two images of one shape \(channels, height, width\)"),
        (torch.zeros(3, 0, 5), torch.zeros(3, 0, 5), 0.2, r"prediction \(3, 0, 5\)"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5).double(), 0.2, "torch.float32 and target of torch.float64"),
        (torch.zeros(3, 4, 5).half(), torch.zeros(3, 4, 5).half(), 0.2, "expected float32 or float64"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5, requires_grad=True), 0.2, "pass target.detach()"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5), 1.5, "ssim_weight 1.5: expected a number from 0 to 1"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5, device="meta"), 0.2, "target on meta: expected one device"),
    ],
)
def test_refuses_what_it_cannot_compare(p: Tensor, t: Tensor, weight: float, message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        photometric_loss_cpu(p, t, weight)


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_the_same_is_refused_on_every_device(device: str) -> None:
    """PyTorch would broadcast images of two shapes, and a kernel read beyond the smaller one."""
    p, t = torch.zeros(3, 8, 8, device=device), torch.zeros(1, 8, 8, device=device)
    for pair in ((p, t), (p[None], p), (p[None], torch.stack([p, p]))):
        with pytest.raises(UserInputError, match="expected two images of one shape"):
            photometric_loss(*pair)
    with pytest.raises(UserInputError, match=r"pass target.detach\(\)"):
        photometric_loss(p, p.clone().requires_grad_())
    with pytest.raises(UserInputError, match="ssim_weight nan: expected a number from 0 to 1"):
        photometric_loss(p, p, math.nan)
    elsewhere = torch.zeros(3, 8, 8, device="cpu" if device == "meta" else "meta")
    with pytest.raises(UserInputError, match=f"prediction on {device} and target on .*: expected one device"):
        photometric_loss(p, elsewhere)


def test_images_of_one_channel_are_not_for_the_kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.ops.photometric_loss.triton_works", lambda *tensors: True)
    p, t = torch.rand(2, 1, 12, 14, generator=torch.Generator().manual_seed(0))
    expected = photometric_loss_torch(p, t)
    torch.testing.assert_close(photometric_loss(p, t), expected, rtol=0, atol=1e-6)  # worst seen: 3e-8
