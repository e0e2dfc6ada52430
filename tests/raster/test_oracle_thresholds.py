"""Check that the mask covers decisions that rounding can change, of every kind, and hardly anything else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.reference_raster.thresholds import ThresholdMask, threshold_mask
from tests.raster import naive, scenes
from tests.raster.assertions import assert_close_outside
from tests.raster.scenes import Case

ORACLE = OracleRasterizer()
TOLERANCE = 1e-7


def mask_of(case: Case, tolerance: float | None = TOLERANCE) -> ThresholdMask:
    return threshold_mask(case.field, case.camera, sh_degree=case.sh_degree, tolerance=tolerance)


def round_gaussians(means: list[list[float]], sigma: float, opacities: list[float], **options: object) -> Case:
    """Round, unrotated Gaussians given in pixels and depth before a camera with a focal length of 100.

    Args:
        means: x and y in pixels and depth, for each.
        sigma: standard deviation in pixels at depth 2, on the axis.
        opacities: for each.
        options: of `make_camera`.
    """
    camera = scenes.make_camera(32, 20, focal=100.0, **options)  # type: ignore[arg-type]  # passed through
    points = torch.tensor(means, dtype=torch.float64)
    depth = points[:, 2:]
    points[:, :2] = (points[:, :2] + 0.5 - torch.tensor([camera.cx, camera.cy])) * depth / 100
    identity = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(means), 4)
    field = scenes.make_field(
        scenes.to_world(points, camera),
        scales=sigma * 2 / 100,
        opacities=torch.tensor(opacities, dtype=torch.float64),
        quaternions=identity,
        signed=True,
    )
    return Case("round", field, camera)


def with_logits(case: Case, logits: list[float]) -> Case:
    return replace(
        case, field=case.field.with_parameters({"opacity_logits": torch.tensor(logits, dtype=torch.float64)})
    )


def exponent_at(case: Case, x: int, y: int) -> float:
    """q of the first Gaussian at a pixel, by the naive loop."""
    splat = naive.project(case, [(None, None)] * len(case.field))[0]
    assert splat is not None
    dx, dy = x - splat.center[0], y - splat.center[1]
    xx, xy, yy = splat.covariance
    return (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (2 * splat.determinant)


# ------------------------------------------------------------------------------------------ kinds of decisions


@pytest.mark.parametrize(("alpha", "pixel"), [(1 / 255, (13, 9)), (0.99, (8, 8))])
def test_alpha_at_a_threshold_masks_that_pixel(alpha: float, pixel: tuple[int, int]) -> None:
    case = round_gaussians([[8.1, 8.2, 2.0]], 2.0, [0.5])
    opacity = alpha * math.exp(exponent_at(case, *pixel))
    assert opacity < 1
    case = with_logits(case, [math.log(opacity / (1 - opacity))])
    pixels = mask_of(case).pixels
    assert pixels[pixel[1], pixel[0]]
    assert pixels.sum() == 1
    assert not mask_of(with_logits(case, [math.log(opacity / (1 - opacity)) - 1e-2])).pixels.any()


def test_transmittance_at_its_limit_masks_the_pixel() -> None:
    """Two capped Gaussians leave 0.01^2 = 1e-4: float32 and float64 round it to different sides."""
    case = round_gaussians([[8.0, 8.0, 2.0], [8.0, 8.0, 2.5]], 3.0, [0.9999, 0.9999])
    pixels = mask_of(case).pixels
    assert pixels[8, 8]
    with torch.no_grad():
        single, double = (case.to(dtype).render(ORACLE).transmittance[8, 8] for dtype in (torch.float32, torch.float64))
    assert single == pytest.approx(1e-2)
    assert double == pytest.approx(1e-4)


def test_near_ties_in_depth_mask_the_pixels_of_both() -> None:
    """Masked are pixels that both contribute to, not those of one alone, and not when the gap exceeds rounding."""
    means = [[8.0, 9.0, 2.0], [15.0, 9.0, 2.0 + 1e-9]]
    case = round_gaussians(means, 2.0, [0.5, 0.5], pose_seed=1)
    pixels = mask_of(case).pixels
    assert pixels[9, 11]
    assert not pixels[9, 2]
    assert not pixels[9, 20]
    means[1][2] += 1e-4
    assert not mask_of(round_gaussians(means, 2.0, [0.5, 0.5], pose_seed=1)).pixels.any()


def test_ties_that_every_implementation_decides_alike_are_not_masked() -> None:
    """Equal centres have equal depths, and before an unrotated camera so have all in a plane: the index decides."""
    assert not mask_of(round_gaussians([[8.0, 9.0, 2.0]] * 2, 2.0, [0.5, 0.5], pose_seed=1)).pixels.any()
    assert not mask_of(round_gaussians([[8.0, 9.0, 2.0], [15.0, 9.0, 2.0]], 2.0, [0.5, 0.5])).pixels.any()


@pytest.mark.parametrize("shift", [1e-9, -1e-9])
def test_a_rectangle_at_a_border_masks_what_it_gains_there(shift: float) -> None:
    """Radius 12, so a centre at 5 reaches 17, where the second column of tiles begins to count."""
    case = round_gaussians([[5.0 + shift, 8.0, 2.0]], 3.8, [0.9])
    assert case.render(ORACLE).radii.tolist() == [12]
    pixels = mask_of(case).pixels
    assert pixels[8, 16]
    assert not pixels[:, :16].any()
    assert not mask_of(round_gaussians([[5.1, 8.0, 2.0]], 3.8, [0.9])).pixels.any()


def test_a_radius_at_a_whole_number_is_open() -> None:
    """sigma^2 + 0.3 + sqrt(0.1) = 16 px^2 makes a radius of 12 exactly, or 13."""
    sigma = math.sqrt(16 - 0.3 - math.sqrt(0.1))
    case = round_gaussians([[15.5, 9.5, 2.0]], sigma, [0.9])
    mask = mask_of(case)
    assert mask.radii.tolist() == [True]
    assert mask.kinks.tolist() == [False]
    assert mask_of(round_gaussians([[15.5, 9.5, 2.0]], sigma + 1e-3, [0.9])).radii.tolist() == [False]


@pytest.mark.parametrize("shift", [1e-9, 0.0, -1e-9])
def test_a_centre_at_the_culling_depth_masks_its_pixels(shift: float) -> None:
    case = round_gaussians([[8.0, 8.0, 0.2 + shift], [24.0, 8.0, 2.0]], 0.3, [0.5, 0.5])
    mask = mask_of(case)
    assert mask.pixels[8, 8]
    assert not mask.pixels[8, 24]
    assert mask.radii.tolist() == [True, False]


def test_a_channel_at_the_clamp_is_a_kink_of_unsigned_fields_only() -> None:
    case = round_gaussians([[8.0, 8.0, 2.0], [20.0, 8.0, 2.0]], 2.0, [0.5, 0.5])
    sh = torch.full((2, 1, 3), 0.3, dtype=torch.float64)
    sh[0, 0, 1] = -0.5 * math.sqrt(4 * math.pi)
    for signed, expected in ((False, [True, False]), (True, [False, False])):
        mask = mask_of(replace(case, field=replace(case.field, sh=sh, signed=signed)))
        assert mask.kinks.tolist() == expected
        assert not mask.pixels.any()


def test_a_centre_at_the_limit_of_the_jacobian_is_a_kink() -> None:
    """1.3 half widths from the axis: 1.3 * 16 pixels right of the middle."""
    case = round_gaussians([[15.5 + 1.3 * 16, 9.5, 2.0], [15.5, 9.5 - 1.3 * 10, 2.0], [5.0, 5.0, 2.0]], 8.0, [0.5] * 3)
    assert mask_of(case).kinks.tolist() == [True, True, False]


def needle_at_45_degrees(length: float) -> Case:
    """Make a needle across the image with a standard deviation of `length` pixels, and almost none across."""
    case = round_gaussians([[15.5, 9.5, 2.0]], 1.0, [0.5])
    turn = torch.tensor([[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]], dtype=torch.float64)
    log_scales = torch.tensor([[length * 2 / 100, 1e-9, 1e-9]], dtype=torch.float64).log()
    return replace(case, field=case.field.with_parameters({"quaternions": turn, "log_scales": log_scales}))


@pytest.mark.parametrize("length", [1.5e4, 1.50003e4, 1.50007e4])
def test_a_determinant_that_may_be_zero_leaves_the_gaussian_open(length: float) -> None:
    """Also where its radius is certain, as it is for one of these at least."""
    mask = mask_of(needle_at_45_degrees(length))
    assert mask.radii.tolist() == [True]
    assert mask.pixels[9, 15]
    assert not mask_of(needle_at_45_degrees(10.3)).radii.any()


@pytest.mark.parametrize(("length", "is_open"), [(1.0, False), (30.0, True)])
def test_a_needles_alpha_is_known_less_well(length: float, is_open: bool) -> None:
    """Five parts in 10,000 from 1/255: beyond rounding of a nearly round Gaussian, within that of a needle."""
    case = needle_at_45_degrees(length)
    opacity = (1 + 5e-4) / 255 * math.exp(exponent_at(case, 16, 8))
    assert opacity < 1
    case = with_logits(case, [math.log(opacity / (1 - opacity))])
    assert bool(mask_of(case).pixels[8, 16]) == is_open


@pytest.mark.parametrize(("x", "is_open"), [(8.3, False), (3900.3, True)])
def test_a_centre_is_known_less_well_far_from_pixel_zero(x: float, is_open: bool) -> None:
    """Floats are coarser there: in float32 a pixel's four-thousandth at 3900, a millionth at 8."""
    camera = scenes.make_camera(4000, 16, focal=4000.0, principal_offset=(-1990.0, 0.0))
    means = torch.tensor([[(x + 0.5 - 10) * 2 / 4000, -0.1 * 2 / 4000, 2.0]], dtype=torch.float64)
    case = Case("far", scenes.make_field(means, scales=0.001, opacities=0.5), camera)
    pixel = (int(x) + 4, 9)
    opacity = (1 + 3e-4) / 255 * math.exp(exponent_at(case, *pixel))
    assert opacity < 1
    case = with_logits(case, [math.log(opacity / (1 - opacity))])
    assert bool(mask_of(case, tolerance=1e-7).pixels[pixel[1], pixel[0]]) == is_open


def test_pixels_that_are_finished_before_the_open_decision_are_not_masked() -> None:
    wall = [[15.5, 9.5, 1.0 + 0.1 * i] for i in range(4)]
    tie = [[8.0, 9.0, 2.0], [15.0, 9.0, 2.0 + 1e-9]]
    opacities = [0.97] * 4 + [0.5, 0.5]
    case = round_gaussians(wall + tie, 60.0, opacities, pose_seed=1)
    assert not mask_of(case).pixels.any()
    alone = round_gaussians(tie, 60.0, opacities[4:], pose_seed=1)
    assert mask_of(alone).pixels.double().mean() > 0.9


# --------------------------------------------------------------------------------------- size and soundness


@pytest.mark.parametrize("seed", range(4))
def test_mask_is_small_on_ordinary_scenes(seed: int) -> None:
    case = scenes.random_case(300, 100, 80, seed=seed)
    rounded = mask_of(case.to(torch.float32), tolerance=None)
    assert rounded.pixels.double().mean() < 0.005  # worst seen 0.0019
    assert rounded.radii.double().mean() < 0.03  # worst seen 0.01
    assert rounded.kinks.double().mean() < 0.01  # worst seen 0
    exact = mask_of(case, tolerance=None)
    assert exact.pixels.sum() + exact.radii.sum() + exact.kinks.sum() == 0


def training_case(width: int, height: int, n: int, *, seed: int = 0) -> Case:
    """Make a scene like those of training: SH degree 3, about 40 Gaussians blended a pixel, in float32."""
    camera = scenes.make_camera(width, height)
    spread = math.sqrt(width * height / n)  # distance in pixels of neighbours, were they in one plane
    case = scenes.random_case(
        n, width, height, seed=seed, camera=camera, pixels=(0.5 * spread, 3.4 * spread), name="training"
    )
    logits = torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 2.0
    return replace(case, field=case.field.with_parameters({"opacity_logits": logits})).to(torch.float32)


def test_mask_is_small_in_training_and_needed() -> None:
    """It excuses less than one pixel in fifty, and some of those really are decided differently in float32."""
    case = training_case(200, 150, 2000)
    mask = mask_of(case, tolerance=None)
    assert mask.pixels.double().mean() < 0.02  # seen 0.0118
    with torch.no_grad():
        difference = (case.render(ORACLE).image - case.to(torch.float64).render(ORACLE).image).abs().amax(0)  # (h, w)
    assert difference[~mask.pixels].max() < 1e-5  # seen 5.4e-7
    assert difference[mask.pixels].max() > 1e-4


@given(scenes.random_cases(), st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_outside_the_mask_small_changes_of_the_input_stay_small(case: Case, seed: int) -> None:
    """Every parameter moved by a relative 1e-9 changes no decision outside the mask of tolerance 1e-7.

    A decision changes a pixel by up to 1/255 of a colour of about 1, a continuous change by far less.
    """
    mask = mask_of(case)
    assume(mask.pixels.double().mean() < 0.9)
    generator = torch.Generator().manual_seed(seed)

    def moved(value: Tensor) -> Tensor:
        return value * (1 + 1e-9 * (2 * torch.rand(value.shape, generator=generator, dtype=torch.float64) - 1))

    other = replace(
        case, field=case.field.with_parameters({name: moved(value) for name, value in case.field.parameters.items()})
    )
    with torch.no_grad():
        before, after = case.render(ORACLE), other.render(ORACLE)
    assert_close_outside(after.image, before.image, mask.pixels, 1e-5)  # worst seen 4.7e-8
    assert torch.equal(after.radii[~mask.radii], before.radii[~mask.radii])


@given(scenes.random_cases(), st.floats(1e-12, 1e-6), st.floats(1.0, 1e4))
@settings(deadline=None, max_examples=20)
def test_a_larger_tolerance_masks_more(case: Case, tolerance: float, factor: float) -> None:
    small, large = mask_of(case, tolerance), mask_of(case, tolerance * factor)
    for fine, coarse in zip(vars(small).values(), vars(large).values(), strict=True):
        assert (coarse | ~fine).all()


def test_nothing_to_mask() -> None:
    mask = mask_of(scenes.no_gaussians())
    assert torch.equal(mask.pixels, torch.zeros(17, 20, dtype=torch.bool))
    assert mask.radii.shape == mask.kinks.shape == (0,)
