"""The three supervisions and the photometric loss, against SciPy filters in float64 and the CPU kernel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate1d

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch, ssim


def ssim_with_scipy(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004, equation 13, from SciPy's correlation in float64; (3, h, w)."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(image: np.ndarray) -> np.ndarray:
        rows = correlate1d(image.astype(np.float64), window, axis=1, mode="constant")
        return correlate1d(rows, window, axis=2, mode="constant")

    x, y = x.astype(np.float64), y.astype(np.float64)
    ux, uy = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - ux**2, mean(y * y) - uy**2, mean(x * y) - ux * uy
    c1, c2 = 0.01**2, 0.03**2
    return float((((2 * ux * uy + c1) * (2 * vxy + c2)) / ((ux**2 + uy**2 + c1) * (vx + vy + c2))).mean())


def images(height: int, width: int, signed: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    generator = np.random.default_rng(height * 1000 + width)
    target = generator.random((3, height, width))
    prediction = np.clip(target + 0.2 * generator.standard_normal(target.shape), -0.5, 1.5)
    shift = 0.5 if signed else 0.0
    return torch.from_numpy(prediction - shift), torch.from_numpy(target - shift)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("size", [(40, 57), (11, 11), (16, 5), (1, 1), (3, 200)])
def test_ssim_is_3dgs_own(size: tuple[int, int], signed: bool) -> None:
    prediction, target = images(*size, signed=signed)
    expected = ssim_with_scipy(prediction.numpy(), target.numpy())
    assert ssim(prediction, target).item() == pytest.approx(expected, abs=1e-12)  # worst seen 6e-17
    single = ssim(prediction.float(), target.float()).item()
    assert single == pytest.approx(expected, abs=2e-6)  # worst seen 1.2e-7: variances cancel in float32


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_loss_mixes_l1_and_ssim(weight: float) -> None:
    prediction, target = images(24, 31)
    l1 = np.abs(prediction.numpy() - target.numpy()).mean()
    expected = (1 - weight) * l1 + weight * (1 - ssim_with_scipy(prediction.numpy(), target.numpy()))
    # 2.8e-17 seen.
    assert photometric_loss_torch(prediction, target, weight).item() == pytest.approx(expected, abs=1e-12)


@settings(deadline=None, max_examples=25)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    weight=st.floats(0, 1),
    signed=st.booleans(),
    double=st.booleans(),
)
def test_the_cpu_kernel_and_pytorch_agree(height: int, width: int, weight: float, signed: bool, double: bool) -> None:
    losses, gradients = [], []
    dtype = torch.float64 if double else torch.float32
    for loss in (photometric_loss, photometric_loss_torch):
        prediction, target = (image.to(dtype) for image in images(height, width, signed))
        prediction.requires_grad_()
        value = loss(prediction, target, weight)
        value.backward()
        assert prediction.grad is not None
        losses.append(value.detach())
        gradients.append(prediction.grad * prediction.numel())
    # Worst seen in 400 draws: 9e-8 and 2.1e-5 (gradient of the sum over pixels) in float32, 3e-16 and 6e-14 in float64.
    torch.testing.assert_close(losses[0], losses[1], rtol=0, atol=1e-14 if double else 1e-6)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=1e-12 if double else 1e-4)


def test_pairs_follow_the_papers_table() -> None:
    image, target, accumulated, coarse = torch.rand(4, 3, 6, 8, dtype=torch.float64)
    residual = image - accumulated
    for supervision, expected in [
        ("reconstructed", (image, target)),
        ("online_residual", (residual, target - accumulated)),
        ("gt_laplacian", (residual, target - coarse)),
    ]:
        torch.testing.assert_close(SUPERVISIONS[supervision].pair(image, target, accumulated, coarse), expected)


def test_supervisions_by_name() -> None:
    assert list(SUPERVISIONS) == ["reconstructed", "online_residual", "gt_laplacian"]
    assert [SUPERVISIONS[name].needs_coarse for name in SUPERVISIONS] == [False, False, True]
    assert [SUPERVISIONS[name].composes for name in SUPERVISIONS] == [True, False, False]
    with pytest.raises(UserInputError, match="--supervision laplace: expected reconstructed, online_residual, gt_lap"):
        SUPERVISIONS["laplace"]


def test_a_gpu_takes_the_fused_ssim_that_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check only which function is called; the stand-in of the package computes SSIM on the CPU."""
    from lapgs_plugin.family.fused_ssim import fused_ssim
    from lapgs_plugin.ops import photometric_loss as chosen

    prediction = torch.rand(3, 20, 30, requires_grad=True)
    target = torch.rand(3, 20, 30)
    expected = photometric_loss_torch(prediction, target)

    class Elsewhere:
        type = "cuda"

    class OnGpu(torch.Tensor):
        device = Elsewhere()

    calls = []

    def counted(*images: torch.Tensor) -> torch.Tensor:
        calls.append([image.shape for image in images])
        return fused_ssim(*(image.as_subclass(torch.Tensor) for image in images))

    monkeypatch.setattr(chosen, "fused_ssim", lambda: counted)
    found = photometric_loss(prediction.as_subclass(OnGpu), target)
    assert calls == [[(1, 3, 20, 30)] * 2]
    torch.testing.assert_close(found.as_subclass(torch.Tensor), expected)
