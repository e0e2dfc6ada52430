"""Test PSNR against closed forms, means over images, and which views are far worse than the rest."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from lapgs_plugin.cli.evaluate import print_views
from lapgs_plugin.evaluation.metrics import far_worse_below, mean_quality, psnr, ssim


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
def test_views_that_are_far_worse_than_the_rest(psnrs: list[float], far: list[int]) -> None:
    assert [index for index, value in enumerate(psnrs) if value < far_worse_below(psnrs)] == far


def test_a_view_that_is_far_worse_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    names, figures = [f"view {index}[b]\x1b.png" for index in range(3)], {"fitted_psnr": 20.0, "ssim": 0.5}
    views = [{"name": name, "psnr": value, **figures} for name, value in zip(names, (22.1, 11.0, 23.0), strict=True)]
    print_views(Console(width=100), {"views": views, "lpips_missing": {}})
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "far worse than the rest" in line]
    assert "1 of 3 views are far worse than the rest" in line
    assert [rf"view {index}[b]\x1b.png" in line for index in range(3)] == [False, True, False]
