"""Test PSNR against closed forms, and SSIM against an implementation with OpenCV's filters."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from lapgs_plugin.cli.evaluate import _print_views
from lapgs_plugin.evaluation.metrics import mean_quality, psnr, ssim


@given(offset=st.floats(1e-3, 0.4), low=st.floats(0.0, 0.6))
@settings(max_examples=30, deadline=None)
def test_psnr_of_a_constant_offset(offset: float, low: float) -> None:
    target = torch.full((3, 7, 5), low, dtype=torch.float64)
    assert psnr(target + offset, target) == pytest.approx(-20 * math.log10(offset), abs=1e-9)  # 7.1e-15 seen


def test_psnr_is_over_all_channels_at_once() -> None:
    target = torch.zeros(3, 4, 4)
    image = target.clone()
    image[0] = 0.3  # a mean over channels of each channel's own PSNR would be infinite
    assert psnr(image, target) == pytest.approx(-10 * math.log10(0.3**2 / 3), abs=1e-5)  # 3.5e-7 seen


def test_psnr_looks_at_what_is_shown() -> None:
    target = torch.zeros(3, 4, 4)
    target[:, :2] = 1.0
    beyond = torch.where(target > 0.5, 1.7, -0.4)
    assert psnr(beyond, target) == 100.0
    assert psnr(target, target) == 100.0


def reference_ssim(image: np.ndarray, target: np.ndarray) -> float:
    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)

    mean_a, mean_b = mean(image), mean(target)
    var_a, var_b = mean(image**2) - mean_a**2, mean(target**2) - mean_b**2
    covariance = mean(image * target) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
    return float(similarity.mean())


def test_ssim_agrees_with_opencv() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand((3, 37, 52), generator=generator, dtype=torch.float64)
    image = target + 0.2 * torch.randn((3, 37, 52), generator=generator, dtype=torch.float64)
    expected = reference_ssim(image.clamp(0, 1).permute(1, 2, 0).numpy(), target.permute(1, 2, 0).numpy())
    assert ssim(image.float(), target.float()) == pytest.approx(
        expected, abs=1e-6
    )  # float32; worst seen of 20 seeds 7e-08


def test_ssim_of_an_image_with_itself_is_one() -> None:
    image = torch.rand(3, 20, 30)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-6)


def test_means_over_images_are_of_each_images_own_figures() -> None:
    generator = torch.Generator().manual_seed(2)
    pairs = [(torch.rand(3, 20, 30, generator=generator), torch.rand(3, 20, 30, generator=generator)) for _ in range(3)]
    means = mean_quality(iter(pairs))
    assert means["psnr"] == pytest.approx(sum(psnr(*pair) for pair in pairs) / 3)
    assert means["ssim"] == pytest.approx(sum(ssim(*pair) for pair in pairs) / 3)
    assert mean_quality([]) == {}


@pytest.mark.parametrize(
    ("psnrs", "far"),
    [
        ([22.1, 21.5, 11.0, 23.0, 22.4, 20.9], [2]),
        ([22.1, 11.5, 11.0, 23.0, 22.4], [1, 2]),  # two of five photos were placed wrongly
        ([30.0, 24.1, 29.0, 31.0, 28.0, 33.0], []),  # scenes differ from view to view
        ([22.0, 22.0, 22.0, 16.1], []),
        ([22.0, 22.0, 22.0, 15.9], [3]),
        ([30.0, 11.0], []),
        ([20.0], []),
    ],
)
def test_views_that_are_far_worse_than_the_rest_are_named(
    psnrs: list[float], far: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    views = [
        {"name": f"view {index}[b]\x1b.png", "psnr": value, "fitted_psnr": 20.0, "ssim": 0.5}
        for index, value in enumerate(psnrs)
    ]
    _print_views(Console(width=100), {"views": views, "lpips_missing": {}})
    lines = [line for line in capsys.readouterr().out.splitlines() if "far worse than the rest" in line]
    assert len(lines) == bool(far)
    if far:
        assert f"{len(far)} of {len(psnrs)} views are far worse than the rest" in lines[0]
        named = {index for index in range(len(psnrs)) if rf"view {index}[b]\x1b.png" in lines[0]}
        assert named == set(far)
