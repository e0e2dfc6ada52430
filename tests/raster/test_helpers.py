"""Check that the helpers of the raster tests fail when they should."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.raster import assertions, naive, scenes
from tests.raster.assertions import GradientBounds

BOUNDS = GradientBounds(element=1e-3, row=1e-2, row_floor=1e-6, relative_l2=1e-3)


@pytest.fixture
def gradient() -> Tensor:
    """(50, 3) whose rows have norms over four decades, with ten zero rows."""
    values = torch.randn(50, 3, dtype=torch.float64) * torch.logspace(-4, 0, 50, dtype=torch.float64)[:, None]
    values[::5] = 0
    return values


def test_all_pass_on_equal_values(gradient: Tensor) -> None:
    worst = assertions.assert_gradients_match({"g": gradient}, {"g": gradient.clone()}, BOUNDS)
    assert worst == {"g": 0.0}
    assertions.assert_gradients_match({"g": torch.zeros(0, 3)}, {"g": torch.zeros(0, 3)}, BOUNDS)
    assert assertions.assert_same_zero_rows(gradient, gradient.clone()) == 10


def test_elements_returns_the_worst_and_names_the_place(gradient: Tensor) -> None:
    wrong = gradient.clone()
    wrong[7, 1] += 0.01 * gradient.abs().max()
    assert assertions.assert_elements_close(wrong, gradient, 0.02) == pytest.approx(0.01)
    with pytest.raises(AssertionError, match=r"element \(7, 1\).*1\.00e-02 > 5e-03"):
        assertions.assert_elements_close(wrong, gradient, 5e-3)
    with pytest.raises(AssertionError, match="element"):
        assertions.assert_elements_close(torch.full((3,), 1e-9), torch.zeros(3), 1e-3)


def test_rows_catch_a_small_row_that_elements_forgive(gradient: Tensor) -> None:
    wrong = gradient.clone()
    wrong[1] *= -1
    assertions.assert_elements_close(wrong, gradient, 1e-3)
    with pytest.raises(AssertionError, match=r"row 1 is off by 2\.00e\+00"):
        assertions.assert_rows_close(wrong, gradient, 1e-2, floor=1e-6)


def test_rows_floor_forgives_rounding_of_rows_that_are_next_to_nothing() -> None:
    expected = torch.tensor([[1.0], [1e-9]])
    assertions.assert_rows_close(torch.tensor([[1.0], [2e-9]]), expected, 1e-2, floor=1e-6)
    with pytest.raises(AssertionError, match="row 1"):
        assertions.assert_rows_close(torch.tensor([[1.0], [2e-9]]), expected, 1e-2, floor=1e-12)


@pytest.mark.parametrize(("row", "value"), [(5, 1e-12), (6, 0.0)])
def test_zero_rows_catch_both_directions(gradient: Tensor, row: int, value: float) -> None:
    wrong = gradient.clone()
    wrong[row] = value
    with pytest.raises(AssertionError, match=f"the first is {row}"):
        assertions.assert_same_zero_rows(wrong, gradient)


def test_aligned_catches_a_small_error_everywhere() -> None:
    expected = torch.cat([torch.full((9999,), 1e-3), torch.ones(1)])
    wrong = expected + 5e-4
    assertions.assert_elements_close(wrong, expected, 1e-3)
    with pytest.raises(AssertionError, match="relative L2"):
        assertions.assert_aligned(wrong, expected, min_cosine=-1, max_relative_l2=1e-2)


def test_aligned_tells_direction_from_length() -> None:
    expected = torch.randn(100)
    assertions.assert_aligned(3 * expected, expected, min_cosine=0.999999, max_relative_l2=2.1)
    with pytest.raises(AssertionError, match="relative L2"):
        assertions.assert_aligned(3 * expected, expected, min_cosine=0.99, max_relative_l2=1.0)
    with pytest.raises(AssertionError, match="cosine"):
        assertions.assert_aligned(-expected, expected, min_cosine=0.99, max_relative_l2=10.0)
    with pytest.raises(AssertionError, match="expected zero"):
        assertions.assert_aligned(torch.ones(3), torch.zeros(3), min_cosine=0, max_relative_l2=1)


def test_outside_excuses_only_the_mask() -> None:
    expected, actual = torch.zeros(3, 4, 5), torch.zeros(3, 4, 5)
    actual[1, 2, 3] = 1.0
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[2, 3] = True
    assert assertions.assert_close_outside(actual, expected, mask, 1e-6) == 0.0
    actual[0, 0, 0] = 2e-6
    with pytest.raises(AssertionError, match="outside the mask"):
        assertions.assert_close_outside(actual, expected, mask, 1e-6)


def test_outside_takes_a_mask_of_rows_and_refuses_one_that_excuses_too_much() -> None:
    mask = torch.tensor([False, True, False])
    assertions.assert_close_outside(5.0 * mask[:, None].repeat(1, 2), torch.zeros(3, 2), mask, 1e-6)
    mask = torch.arange(20).reshape(4, 5) < 3
    with pytest.raises(AssertionError, match=r"excuses 15\.00%"):
        assertions.assert_close_outside(torch.zeros(4, 5), torch.zeros(4, 5), mask, 1.0, max_masked=0.1)


def test_radii_may_differ_by_a_pixel_or_a_cull_where_open() -> None:
    expected = torch.tensor([3, 4, 5, 0], dtype=torch.int32)
    actual = torch.tensor([3, 5, 0, 7], dtype=torch.int32)
    is_open = torch.tensor([False, True, True, True])
    assert assertions.assert_radii_close(actual, expected, is_open) == 3
    with pytest.raises(AssertionError, match="the first is 1: 5, expected 4"):
        assertions.assert_radii_close(actual, expected, torch.zeros(4, dtype=torch.bool))
    with pytest.raises(AssertionError, match="3 differ"):
        assertions.assert_radii_close(expected + 2, expected, torch.tensor([True, True, False, True]))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nothing_passes_on_values_that_are_not_finite(gradient: Tensor, value: float) -> None:
    wrong = gradient.clone()
    wrong[3, 0] = value
    with pytest.raises(AssertionError, match="not finite"):
        assertions.assert_gradients_match({"g": wrong}, {"g": gradient}, BOUNDS)
    with pytest.raises(AssertionError, match="not finite"):
        assertions.assert_close_outside(wrong, gradient, torch.ones(50, dtype=torch.bool), 1.0)
    with pytest.raises(AssertionError, match="shape"):
        assertions.assert_gradients_match({"g": gradient[:, :1]}, {"g": gradient}, BOUNDS)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda g: g * 1.002,
        lambda g: g + 1e-3 * g.abs().max(),
        lambda g: g.roll(1, 0),
        lambda g: g.roll(1, 1),
        lambda g: -g,
        torch.zeros_like,
        lambda g: torch.where(torch.arange(len(g))[:, None] == 2, 1.5 * g, g),
    ],
)
def test_match_catches_typical_mistakes(gradient: Tensor, spoil: object) -> None:
    assert callable(spoil)
    with pytest.raises(AssertionError):
        assertions.assert_gradients_match({"g": spoil(gradient)}, {"g": gradient}, BOUNDS)


def test_match_leaves_out_the_excused_and_no_others(gradient: Tensor) -> None:
    wrong = gradient.clone()
    wrong[6] = 9.0
    excused = torch.arange(50) == 6
    assertions.assert_gradients_match({"g": wrong}, {"g": gradient}, BOUNDS, excused=excused)
    with pytest.raises(AssertionError):
        assertions.assert_gradients_match({"g": wrong}, {"g": gradient}, BOUNDS, excused=~excused)
    with pytest.raises(KeyError):
        assertions.assert_gradients_match({}, {"g": gradient}, BOUNDS)


class _Painter(scenes.Rasterizer):
    """Rasterize without rendering, with known gradients: the image is the sum of all inputs."""

    name = "painter"

    def __call__(self, field, camera, *, background, sh_degree=None):  # type: ignore[no-untyped-def]  # a test double
        means2d = field.means[:, :2] * 1.0
        means2d.retain_grad()
        total = means2d.sum() + sum(value.sum() for value in field.parameters.values())
        image = total * torch.ones(3, camera.height, camera.width, dtype=field.means.dtype)
        return scenes.RenderResult(image, image[0], torch.ones(len(field)), means2d)


def test_gradients_collects_every_parameter_and_the_screen_position() -> None:
    case = scenes.one_gaussian()
    weights = scenes.pixel_weights(case)
    gradients = scenes.gradients(_Painter(), case, weights)
    assert set(gradients) == {"means", "quaternions", "log_scales", "opacity_logits", "sh", "means2d"}
    torch.testing.assert_close(gradients["quaternions"], weights.sum().expand(1, 4))
    torch.testing.assert_close(gradients["means"], weights.sum() * torch.tensor([[2.0, 2.0, 1.0]], dtype=torch.float64))


def test_gradients_refuses_a_rasterizer_that_forgets_one() -> None:
    class Forgetful(_Painter):
        def __call__(self, field, camera, **options):  # type: ignore[no-untyped-def]  # a test double
            return super().__call__(field.with_parameters({"sh": field.sh.detach()}), camera, **options)

    case = scenes.one_gaussian()
    with pytest.raises(AssertionError, match=r"no gradient for \['sh'\]"):
        scenes.gradients(Forgetful(), case, scenes.pixel_weights(case))


@pytest.mark.parametrize("name", scenes.ADVERSARIAL)
def test_scenes_are_the_same_every_time(name: str) -> None:
    first, second = scenes.ADVERSARIAL[name](), scenes.ADVERSARIAL[name]()
    assert first.name == name
    for key, value in first.field.parameters.items():
        assert torch.equal(value, second.field.parameters[key])
        assert torch.isfinite(value).all()


def test_scenes_do_what_their_names_say() -> None:
    """Check with the naive loop that the adversarial scenes reach their case."""
    built = {name: builder() for name, builder in scenes.ADVERSARIAL.items()}

    def splats(name: str) -> list[naive.Splat]:
        case = built[name]
        return [s for s in naive.project(case, [(None, None)] * len(case.field)) if s is not None]

    pins = naive.jacobian_pins(built["outside_frustum"])
    assert any(x is not None for x, _ in pins)
    assert any(y is not None for _, y in pins)
    assert 0 < len(splats("near_plane")) < len(built["near_plane"].field)
    assert all(s.opacity > 0.99 for s in splats("saturated"))
    assert len(splats("crowd")) == 3000
    assert float(naive.render(built["opaque_crowd"]).transmittance.min()) < 2e-4
    assert all(s.radius <= 3 for s in splats("specks"))
    assert all(s.radius > 100 for s in splats("giants"))
    assert all(s.covariance[0] + s.covariance[2] < 0.602 for s in splats("specks"))
    needles = built["needles"].field.log_scales
    assert float((needles.amax(1) - needles.amin(1)).exp().min()) == pytest.approx(1000, rel=1e-4)  # 2.3e-16 seen
    depths = [s.depth for s in splats("same_depths")]
    assert len(set(depths)) == 12
    assert {s.depth for s in splats("same_plane")} == {4.0}
    assert len({s.center for s in splats("same_plane")}) > 50
    assert torch.equal(built["same_plane"].camera.world_to_camera, torch.eye(4, dtype=torch.float64))
    assert any(min(s.color) == 0 for s in splats("clamped_colors"))
    assert any(min(s.color) > 0 for s in splats("clamped_colors"))
    assert any(min(s.color) < 0 for s in splats("signed_residual"))
    norms = built["large_quaternions"].field.quaternions.norm(dim=1)
    assert norms.min() < 1e-3
    assert norms.max() > 1e3
    assert torch.equal(naive.render(built["invisible"]).transmittance, torch.ones(20, 30, dtype=torch.float64))


def test_naive_harmonics_are_the_textbook_ones() -> None:
    """Degree 1 by hand: sqrt(3 / 4 pi) (-y, z, -x) for a unit direction."""
    x, y, z = 0.48, -0.6, 0.64
    factor = math.sqrt(3 / (4 * math.pi))
    expected = [math.sqrt(1 / (4 * math.pi)), -factor * y, factor * z, -factor * x]
    assert naive.harmonics([5 * x, 5 * y, 5 * z], 1) == pytest.approx(expected, rel=1e-14)  # 3.6e-16 seen


def test_naive_rotation_is_the_textbook_one() -> None:
    """Rotate x to y by a quarter turn about z, with a quaternion of any length."""
    half = math.sqrt(0.5)
    assert naive.rotate([3 * half, 0, 0, 3 * half], 0) == pytest.approx([0, 1, 0], abs=1e-15)  # 2.2e-16 seen


def test_naive_renders_one_round_gaussian_in_closed_form() -> None:
    """On the optical axis with the identity pose: variance (f s / z)^2 + 0.3, alpha = o exp(-d^2 / (2 variance))."""
    camera = scenes.make_camera(21, 21, focal=20.0)
    sh = torch.tensor([[[1.0, 0.0, -3.0]]], dtype=torch.float64)
    field = scenes.make_field(torch.tensor([[0.0, 0.0, 2.0]]), scales=0.2, opacities=0.8)
    case = scenes.Case("round", field.with_parameters({"sh": sh}), camera, (0.1, 0.2, 0.3))
    result = naive.render(case)
    variance = (20 * 0.2 / 2) ** 2 + 0.3
    for x, y in ((10, 10), (12, 9), (14, 11)):
        alpha = 0.8 * math.exp(-((x - 10) ** 2 + (y - 10) ** 2) / (2 * variance))
        color = [0.5 + math.sqrt(1 / (4 * math.pi)), 0.5, 0.0]
        expected = [alpha * c + (1 - alpha) * b for c, b in zip(color, case.background, strict=True)]
        assert result.image[:, y, x].tolist() == pytest.approx(expected, rel=1e-13)
        assert float(result.transmittance[y, x]) == pytest.approx(1 - alpha, rel=1e-13)
    assert result.radii.tolist() == [math.ceil(3 * math.sqrt(variance + math.sqrt(0.1)))]
