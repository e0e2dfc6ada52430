"""The oracle's gradients against finite differences of the naive loop, and the CUDA code's departures from them."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from lapgs_plugin.reference_raster import oracle
from lapgs_plugin.reference_raster.oracle import OracleRasterizer, projection_jacobians
from lapgs_plugin.reference_raster.thresholds import ThresholdMask, threshold_mask
from tests.raster import naive, scenes
from tests.raster.assertions import GradientBounds, assert_elements_close, assert_gradients_match
from tests.raster.scenes import ADVERSARIAL, Case

ORACLE = OracleRasterizer()

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
COLOR_CASES = ("one_gaussian", "random", "clamped_colors", "signed_residual", "lower_degree")

STEP = 1e-5
"""Central differences with this step are off by about 1e-10 by truncation and 1e-10 by rounding."""
DIFFERENCE_NOISE = 2e-9
"""Differences of losses of about 10 are rounded by this."""
STEP_TOLERANCE = 4e-5
"""Relative bound on the change of quantities compared with thresholds in one step."""

# Worst seen: element 6.4e-8, row 2.4e-7, L2 5.4e-8, all of them errors of the differences.
DIFFERENCE_BOUNDS = GradientBounds(element=5e-7, row=3e-6, row_floor=1e-5, relative_l2=5e-7)
# Worst seen in 3600 random scenes: element 7.3e-4, row 2.9e-2, L2 6.1e-4, by needles; medians are below 1e-5.
FLOAT32_BOUNDS = GradientBounds(element=5e-3, row=0.1, row_floor=1e-3, relative_l2=5e-3)


def small(case: Case) -> Case:
    """Shrink a case and keep its first six Gaussians, so that finite differences are fast."""
    camera = case.camera.resized(min(case.camera.width, 18), min(case.camera.height, 13))
    field = case.field.with_parameters({name: value[:6] for name, value in case.field.parameters.items()})
    return replace(case, field=field, camera=camera)


def opaque_stack() -> Case:
    """Opacities of 0.95: most pixels end before the last Gaussian, none reaches the cap."""
    case = scenes.random_case(12, 17, 15, seed=41, sh_degree=1, pixels=(2.0, 6.0), name="opaque_stack")
    logits = torch.full((12,), math.log(19.0), dtype=torch.float64)
    return replace(case, field=case.field.with_parameters({"opacity_logits": logits}))


SMALL_CASES = {
    case.name: case
    for case in (
        small(scenes.random_case(10, 18, 14, seed=40, sh_degree=2, name="random")),
        opaque_stack(),
        scenes.one_gaussian(),
        *(
            small(ADVERSARIAL[name]())
            for name in (
                "outside_frustum", "needles", "pancakes", "giants", "same_depths", "off_centre", "non_square_pixels",
                "wide_angle", "clamped_colors", "signed_residual", "lower_degree", "specks", "one_pixel",
            )
        ),
    )
}  # fmt: skip


def masked_weights(case: Case, tolerance: float | None = None) -> tuple[Tensor, ThresholdMask]:
    """(3, h, w) random weights that vanish where a decision is open, and the mask itself."""
    mask = threshold_mask(case.field, case.camera, sh_degree=case.sh_degree, tolerance=tolerance)
    return scenes.pixel_weights(case) * ~mask.pixels, mask


def finite_differences(
    case: Case, weights: Tensor, pins: list[naive.Pin] | None, *, names: Iterable[str] = PARAMETERS
) -> dict[str, Tensor]:
    """Central differences of sum(weights * naive image) with respect to the parameters `names`."""

    def loss(name: str, value: Tensor) -> float:
        moved = replace(case, field=case.field.with_parameters({name: value}))
        return float((naive.render(moved, pins=pins).image * weights).sum())

    gradients = {}
    for name in names:
        value = case.field.parameters[name]
        gradient = torch.zeros(value.numel(), dtype=torch.float64)
        for i in range(value.numel()):
            step = torch.zeros(value.numel(), dtype=torch.float64)
            step[i] = STEP
            step = step.reshape(value.shape)
            gradient[i] = (loss(name, value + step) - loss(name, value - step)) / (2 * STEP)
        gradients[name] = gradient.reshape(value.shape)
    return gradients


def without_noise(actual: Tensor, expected: Tensor) -> Tensor:
    """Replace expected differences by the actual values where they differ only by the rounding of the loss."""
    return torch.where((actual - expected).abs() <= DIFFERENCE_NOISE, actual, expected)


@pytest.mark.parametrize("name", SMALL_CASES)
def test_equals_finite_differences(name: str) -> None:
    """Differentiate by every parameter, with the clamped Jacobians held constant as in the CUDA code."""
    case = SMALL_CASES[name]
    weights, mask = masked_weights(case, STEP_TOLERANCE)
    assert mask.pixels.double().mean() < 0.3
    assert not mask.kinks.any()
    actual = scenes.gradients(ORACLE, case, weights)
    # The harmonics are most of the parameters and enter linearly; the cases that do something to them suffice.
    names = PARAMETERS if name in COLOR_CASES else [key for key in PARAMETERS if key != "sh"]
    expected = finite_differences(case, weights, naive.jacobian_pins(case), names=names)
    expected = {key: without_noise(actual[key], value) for key, value in expected.items()}
    assert_gradients_match(actual, expected, DIFFERENCE_BOUNDS)


# ------------------------------------------------------------------------------------------ screen position


@pytest.mark.parametrize("name", ["random", "opaque_stack", "outside_frustum", "off_centre"])
def test_screen_gradients_equal_differences_of_shifted_centres(name: str) -> None:
    """means2d.grad, and its absolute sum over pixels, which no difference of the whole loss can show."""
    case = SMALL_CASES[name]
    weights, _ = masked_weights(case, STEP_TOLERANCE)
    n = len(case.field)
    signed, absolute = torch.zeros(n, 2, dtype=torch.float64), torch.zeros(n, 2, dtype=torch.float64)
    for i in range(n):
        for axis in range(2):
            images = []
            for step in (STEP, -STEP):
                shifts = [[0.0, 0.0] for _ in range(n)]
                shifts[i][axis] = step
                images.append(naive.render(case, shifts=shifts).image)
            by_pixel = (weights * (images[0] - images[1])).sum(0) / (2 * STEP)  # (h, w)
            signed[i, axis], absolute[i, axis] = by_pixel.sum(), by_pixel.abs().sum()
    actual = scenes.gradients(ORACLE, case, weights)
    expected = {
        "means2d": without_noise(actual["means2d"], signed),
        "absgrad2d": without_noise(actual["absgrad2d"], absolute),
    }
    assert_gradients_match(actual, expected, DIFFERENCE_BOUNDS)


def test_screen_gradient_equals_differences_of_the_principal_point() -> None:
    """Move the principal point, which moves the one centre alone; in pixels, not in the unit of clip space."""
    case = scenes.one_gaussian()
    weights, _ = masked_weights(case, STEP_TOLERANCE)
    actual = scenes.gradients(ORACLE, case, weights)["means2d"]
    for axis, name in enumerate(("cx", "cy")):
        at = getattr(case.camera, name)
        images = [
            naive.render(replace(case, camera=replace(case.camera, **{name: at + step}))).image
            for step in (STEP, -STEP)
        ]
        expected = float((weights * (images[0] - images[1])).sum()) / (2 * STEP)
        assert float(actual[0, axis]) == pytest.approx(expected, rel=1e-7)  # worst seen 1.1e-9


def test_absolute_gradient_is_at_least_the_gradient() -> None:
    case = scenes.random_case(60, 40, 30, seed=42)
    gradients = scenes.gradients(ORACLE, case, scenes.pixel_weights(case))
    assert (gradients["absgrad2d"] >= gradients["means2d"].abs() * (1 - 1e-12)).all()
    assert (gradients["absgrad2d"] > 1.5 * gradients["means2d"].abs()).any()


@pytest.mark.parametrize("name", ["near_plane", "no_gaussians", "invisible"])
def test_culled_gaussians_receive_nothing(name: str) -> None:
    case = ADVERSARIAL[name]()
    radii = case.render(ORACLE).radii
    assert name == "no_gaussians" or (radii == 0).any()
    for key, value in scenes.gradients(ORACLE, case, scenes.pixel_weights(case)).items():
        assert (value[radii == 0] == 0).all(), key
        assert name != "near_plane" or (value[radii > 0] != 0).any(), key


@pytest.mark.parametrize(
    "changes",
    [
        {"log_scales": torch.tensor([1e3, 1e-9, 1e-9]).log().expand(300, 3)},
        *({"opacity_logits": torch.full((300,), logit)} for logit in (-100.0, 100.0)),
    ],
    ids=["needles", "transparent", "opaque"],
)
def test_extremes_leave_no_trace_of_nan(changes: dict[str, Tensor]) -> None:
    """In float32 the determinant of a long enough needle is rounding alone: negative, huge or exactly 0."""
    case = scenes.random_case(300, 20, 20, seed=43)
    case = replace(case, field=case.field.with_parameters(changes)).to(torch.float32)
    result = case.render(ORACLE)
    assert "opacity_logits" in changes or (result.radii == 0).any()
    assert torch.isfinite(result.image).all()
    for name, value in scenes.gradients(ORACLE, case, scenes.pixel_weights(case)).items():
        assert torch.isfinite(value).all(), name
        assert (value[result.radii == 0] == 0).all(), name


# ----------------------------------------------------------------- where the CUDA code leaves the textbook


def test_jacobian_limit_holds_the_clamped_coordinate_constant() -> None:
    """Beyond the limit dJ/dx = 0, and dJ/dz = 2 f t / z^3 with t = limit * z held: twice what the image's own
    derivative of -f limit / z says."""
    camera = scenes.make_camera(40, 30)
    limit = 1.3 * camera.tan_half_fov[0]
    depth = 2.0
    point = torch.tensor([[5.0, 0.1, depth]], dtype=torch.float64, requires_grad=True)
    entry = projection_jacobians(point, (camera.fx, camera.fy), camera.tan_half_fov)[0, 0, 2]
    assert entry.item() == pytest.approx(-camera.fx * limit / depth)
    (gradient,) = torch.autograd.grad(entry, point)
    assert gradient[0].tolist() == pytest.approx([0.0, 0.0, 2 * camera.fx * limit / depth**2])


def test_jacobian_limit_departs_from_the_textbook_by_a_visible_amount() -> None:
    """The derivative of the image itself differs, so the test against pinned differences can fail."""
    case = SMALL_CASES["outside_frustum"]
    weights, _ = masked_weights(case, STEP_TOLERANCE)
    actual = scenes.gradients(ORACLE, case, weights)
    textbook = finite_differences(case, weights, pins=None, names=["means", "log_scales"])
    assert_elements_close(actual["log_scales"], textbook["log_scales"], 1e-6)
    difference = (actual["means"] - textbook["means"]).norm() / textbook["means"].norm()
    assert difference > 0.01


def test_cap_passes_the_gradient_straight_through() -> None:
    """One pixel, a capped Gaussian before one that is not: dL/dalpha at the capped alpha, times d(o G)/dtheta.

    With c the colours, b the background and w the weights, L = w . (a1 c1 + (1 - a1) (a2 c2 + (1 - a2) b)).
    """
    camera = scenes.make_camera(1, 1, focal=3.0)
    means = torch.tensor([[0.03, -0.02, 1.5], [-0.1, 0.2, 2.0]])
    scales = torch.tensor([[0.5, 0.9, 0.7], [0.4, 0.5, 0.9]])
    field = scenes.make_field(means, scales=scales, opacities=torch.tensor([0.9995, 0.6]), sh_degree=1)
    case = Case("capped", field, camera, scenes.COLORED)

    def raw_alphas(changed: Case) -> list[float]:
        values = []
        for splat in naive.project(changed, [(None, None)] * 2):
            assert splat is not None
            (dx, dy), (xx, xy, yy) = splat.center, splat.covariance
            q = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (2 * splat.determinant)
            values.append(splat.opacity * math.exp(-q))
        return values

    first, second = naive.project(case, [(None, None)] * 2)
    assert first is not None
    assert second is not None
    raw = raw_alphas(case)
    assert raw[0] > 0.99
    assert raw[1] < 0.9
    c1, c2 = (torch.tensor(splat.color, dtype=torch.float64) for splat in (first, second))
    weights, b = scenes.pixel_weights(case), case.background_tensor
    w = weights[:, 0, 0]
    slopes = [float(w @ (c1 - (raw[1] * c2 + (1 - raw[1]) * b))), 0.01 * float(w @ (c2 - b))]
    actual = scenes.gradients(ORACLE, case, weights)
    for name in ("quaternions", "log_scales", "opacity_logits"):
        value = field.parameters[name]
        expected = torch.zeros(value.numel(), dtype=torch.float64)
        for i in range(value.numel()):
            step = torch.zeros(value.numel(), dtype=torch.float64)
            step[i] = STEP
            sides = [
                raw_alphas(replace(case, field=field.with_parameters({name: value + sign * step.reshape(value.shape)})))
                for sign in (1, -1)
            ]
            expected[i] = sum(s * (up - down) / (2 * STEP) for s, up, down in zip(slopes, *sides, strict=True))
        assert_elements_close(actual[name], expected.reshape(value.shape), 1e-7, name=name)  # worst seen 4.5e-9
        assert (actual[name][0] != 0).all(), "the textbook's gradient of a capped Gaussian is zero"


# --------------------------------------------------------------------------------------------------- float32


@pytest.mark.parametrize("name", ADVERSARIAL)
def test_float32_equals_float64(name: str) -> None:
    assert_float32_equals_float64(ADVERSARIAL[name]())


@given(scenes.random_cases())
@settings(deadline=None, max_examples=25)
def test_float32_equals_float64_on_random_scenes(case: Case) -> None:
    assert_float32_equals_float64(case)


def assert_float32_equals_float64(case: Case) -> None:
    rounded = case.to(torch.float32)
    weights, mask = masked_weights(rounded)
    actual = scenes.gradients(ORACLE, rounded, weights)
    expected = scenes.gradients(ORACLE, rounded.to(torch.float64), weights.double())
    assert all(value.dtype == torch.float32 for value in actual.values())
    assert_gradients_match(actual, expected, FLOAT32_BOUNDS, excused=mask.kinks)


def test_tiles_that_are_computed_again_have_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    case = scenes.random_case(40, 33, 18, seed=42, sh_degree=1, name="both_ways")
    weights = torch.randn(3, 18, 33, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    kept = scenes.gradients(ORACLE, case, weights)
    monkeypatch.setattr(oracle, "KEPT_ALPHAS", 0)
    again = scenes.gradients(ORACLE, case, weights)
    assert all(torch.equal(again[name], gradient) for name, gradient in kept.items())


def test_small_images_do_without_pytorchs_compiler() -> None:
    lines = (
        "import sys, torch",
        "from lapgs_plugin.reference_raster.oracle import OracleRasterizer",
        "from tests.raster import scenes",
        "case = scenes.random_case(150, 40, 28, seed=0, sh_degree=1, name='small')",
        "scenes.gradients(OracleRasterizer(), case, torch.ones(3, 28, 40, dtype=torch.float64))",
        "assert 'torch._dynamo' not in sys.modules",
    )
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, cwd=Path(__file__).parents[2])
