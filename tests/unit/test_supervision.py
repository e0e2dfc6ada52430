"""The three supervisions, and the package that computes SSIM on a GPU."""

from __future__ import annotations

import pytest
import torch

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch


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
    loss = photometric_loss(prediction.as_subclass(OnGpu), target.as_subclass(OnGpu))
    assert calls == [[(1, 3, 20, 30)] * 2]
    torch.testing.assert_close(loss.as_subclass(torch.Tensor), expected)
