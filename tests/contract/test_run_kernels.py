"""`lapgs run` computes what a checkout's loop spends its time on in our kernels, and ends with the same image."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch

from lapgs_plugin.runner import checkout_ssim
from tests.contract.stub_runs import FORKS, SHORT, composed_psnr, run_hierarchy


@pytest.mark.parametrize("kind", ["nested", "laplacian"])
def test_ssim(scene: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[torch.Size] = []
    ours = checkout_ssim._our_ssim

    def counted(image: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        called.append(image.shape)
        return ours(image, other)

    monkeypatch.setattr(checkout_ssim, "_our_ssim", counted)
    found = []
    for on in (True, False):
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(0)
        called.clear()
        archive, _ = run_hierarchy(
            FORKS["dash"], scene, tmp_path / str(on), *SHORT, hierarchy=kind, fused_ssim=on, joint=0.0
        )
        # Once for each iteration, and once to compare, before the first of them.
        assert len(called) == (31 if on else 0)
        found.append(composed_psnr(archive))
    assert found[0] == pytest.approx(found[1], abs=0.2)  # dB; worst seen 2e-4
