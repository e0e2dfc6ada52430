"""Stand-ins against what the CUDA modules returned on an H200; see `fixtures/README.md` for how that was recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.family import BACKBONES, VARIANTS, stand_ins
from tests.raster.standin_cases import CASES, outputs, ssim_outputs

FIXTURES = Path(__file__).parent / "fixtures"

# Largest error of an element, relative to the largest of its tensor. Float32 sums in other orders; the worst seen over
# all variants and cases beside each.
OUTPUT_BOUND = 3e-6  # 7e-7: image of graphdeco, clamped; of Taming's sums 4e-7, of inverse depths 4e-7
GRADIENT_BOUND = 1e-5  # 3e-6: screen-space points of graphdeco, clamped; of the others means, 2e-6
DISTANCE_BOUND = 5e-7  # 4e-8
SSIM_BOUND = 1e-5  # 2e-6: its gradient; the values are the same bits


def load(name: str) -> dict[str, Tensor]:
    with np.load(FIXTURES / f"standin_{name}.npz") as stored:
        return {key: torch.from_numpy(stored[key]) for key in stored.files}


def assert_close(actual: Tensor, expected: Tensor, name: str, bound: float) -> None:
    """Every element is within `bound` of the largest; whole numbers are the same."""
    assert actual.shape == expected.shape, name
    assert actual.dtype == expected.dtype, name
    if expected.numel() == 0:
        return
    if not expected.is_floating_point():
        assert torch.equal(actual, expected), f"{name}: {int((actual != expected).sum())} differ"
        return
    error = ((actual - expected).abs().max() / expected.abs().max().clamp_min(1e-30)).item()
    assert error <= bound, f"{name}: off by {error:.2e} of the largest"


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("variant", BACKBONES)
def test_rasterizer_returns_what_its_cuda_module_does(variant: str, case: str) -> None:
    module = stand_ins(variant)[VARIANTS[variant].module]
    results = outputs(module, variant, case, load("inputs"), "cpu")
    recorded = {key.split("/")[1]: value for key, value in load(variant).items() if key.startswith(f"{case}/")}
    assert results.keys() == recorded.keys()
    for key, expected in recorded.items():
        assert_close(results[key], expected, key, GRADIENT_BOUND if key.startswith("grad_") else OUTPUT_BOUND)


def test_neighbours_and_ssim_return_what_their_cuda_modules_do() -> None:
    inputs, recorded = load("inputs"), load("others")
    modules = stand_ins("taming")
    distances = modules["simple_knn._C"].distCUDA2(inputs["means"])
    assert_close(distances, recorded["simple-knn/distances"], "distances", DISTANCE_BOUND)
    for key, value in ssim_outputs(modules["fused_ssim"].fused_ssim, inputs, "cpu").items():
        assert_close(value, recorded[f"fused-ssim/{key}"], key, SSIM_BOUND)
