"""Test initial fields, from points and from the coarser level's field."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import field_from_points, inherit
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

FLOOR = math.sqrt(1e-7)


def base_field(n: int = 50, degree: int = 2, signed: bool = False) -> GaussianField:
    return GaussianField(
        means=torch.randn(n, 3) + torch.tensor([0.0, 0.0, 5.0]),
        quaternions=torch.randn(n, 4),
        log_scales=torch.randn(n, 3) - 2,
        opacity_logits=torch.randn(n),
        sh=torch.randn(n, (degree + 1) ** 2, 3),
        signed=signed,
    )


def spacing_by_brute_force(points: np.ndarray) -> np.ndarray:
    """Return the root mean squared distance to the three nearest other places, pair by pair in float64."""
    points = points.astype(np.float64)
    result = []
    for point in points:
        others = [float(((point - other) ** 2).sum()) for other in np.unique(points, axis=0)]
        squared = sorted(square for square in others if square > 0.0)[:3]
        result.append(math.sqrt(np.mean(squared)) if squared else FLOOR)
    return np.array(result)


def assert_fresh(field: GaussianField, points: np.ndarray) -> None:
    n = len(points)
    np.testing.assert_array_equal(field.means.numpy(), points)
    expected = np.repeat(spacing_by_brute_force(points)[:, None], 3, axis=1)
    np.testing.assert_allclose(np.exp(field.log_scales.numpy()), expected, rtol=1e-5)  # 5.3e-7 seen
    np.testing.assert_allclose(torch.sigmoid(field.opacity_logits).numpy(), np.full(n, 0.1), rtol=1e-6)  # 1.5e-8 seen
    np.testing.assert_array_equal(field.quaternions.numpy(), np.tile([1.0, 0, 0, 0], (n, 1)))


@settings(deadline=None, max_examples=40)
@given(
    n=st.integers(1, 12),
    copies=st.integers(0, 6),
    scale=st.sampled_from([1e-4, 1.0, 1e4]),
    seed=st.integers(0, 1000),
)
def test_a_fresh_field_is_as_large_as_its_spacing(n: int, copies: int, scale: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    points = (generator.standard_normal((n, 3)) * scale).astype(np.float32)
    points = np.concatenate([points, points[generator.integers(0, n, copies)]])  # points that coincide
    colors = generator.random((n + copies, 3)).astype(np.float32)
    field = field_from_points(torch.from_numpy(points), torch.from_numpy(colors), 3)
    assert (field.sh_degree, field.signed, field.means.dtype) == (3, False, torch.float32)
    assert_fresh(field, points)
    shown = field.sh[:, 0].numpy() * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(shown, colors, atol=2e-7)  # worst seen 6e-8
    assert not field.sh[:, 1:].any()


def test_clouds_of_few_places() -> None:
    field = field_from_points(torch.ones(9, 3), torch.rand(9, 3), 1)
    field.require_finite()
    torch.testing.assert_close(field.log_scales.exp(), torch.full((9, 3), FLOOR))
    line = torch.tensor([[0.0, 0, 0], [3, 0, 0], [3, 4, 0]])
    for n, expected in [(1, [FLOOR]), (2, [3.0, 3.0]), (3, [math.sqrt(17), math.sqrt(12.5), math.sqrt(20.5)])]:
        field = field_from_points(line[:n], torch.rand(n, 3), 0)
        torch.testing.assert_close(field.log_scales.exp()[:, 1], torch.tensor(expected))


@pytest.mark.parametrize("degree", [None, 0, 3])
@pytest.mark.parametrize("signed", [False, True])
def test_xyz_keeps_positions_and_starts_the_rest_afresh(degree: int | None, signed: bool) -> None:
    old = base_field(signed=signed)
    before = {name: tensor.clone() for name, tensor in old.parameters.items()}
    field, kept = inherit(old, "xyz", sh_degree=degree)
    assert torch.equal(kept, torch.arange(50))
    assert (field.signed, field.sh_degree) == (True, 2 if degree is None else degree)
    assert_fresh(field, old.means.numpy())
    assert not field.sh.any()
    field.means.zero_()
    assert all(torch.equal(old.parameters[name], tensor) for name, tensor in before.items())


@pytest.mark.parametrize("mode", ["geometry", "full"])
def test_geometry_keeps_all_but_colour_and_full_keeps_all(mode: str) -> None:
    old = base_field()
    field, kept = inherit(old, mode)
    assert torch.equal(kept, torch.arange(50))
    assert field.signed
    for name, tensor in old.parameters.items():
        expected = tensor if mode == "full" or name != "sh" else torch.zeros_like(tensor)
        assert torch.equal(field.parameters[name], expected)
        assert field.parameters[name].data_ptr() != tensor.data_ptr()


@pytest.mark.parametrize("mode", ["geometry", "xyz"])
def test_an_inherited_residual_renders_exactly_zero(mode: str) -> None:
    field, _ = inherit(base_field(), mode)
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, torch.eye(4))
    result = OracleRasterizer()(field, camera, background=torch.zeros(3))
    assert not result.image.any()
    assert result.transmittance.min() < 0.99  # the Gaussians are there


@pytest.mark.parametrize("mode", ["geometry", "xyz", "full"])
@settings(deadline=None, max_examples=40)
@given(n=st.integers(1, 200), ratio=st.floats(0, 1, exclude_min=True), seed=st.integers(0, 99))
def test_a_share_is_a_seeded_subset(mode: str, n: int, ratio: float, seed: int) -> None:
    old = base_field(n, 0)
    draws = [inherit(old, mode, ratio, torch.Generator().manual_seed(seed)) for _ in range(2)]
    field, kept = draws[0]
    assert torch.equal(kept, draws[1].kept)
    assert len(kept) == max(1, round(ratio * n)) == len(field)
    assert bool((kept[1:] > kept[:-1]).all())  # no Gaussian twice
    assert torch.equal(field.means, old.means[kept])
    if mode == "full":
        assert torch.equal(field.quaternions, old.quaternions[kept])


def test_every_gaussian_is_as_likely_and_seeds_differ() -> None:
    old, counts = base_field(40, 0), torch.zeros(40)
    for seed in range(400):
        counts[inherit(old, "full", 0.25, torch.Generator().manual_seed(seed)).kept] += 1
    # Binomial(400, 1/4) has mean 100 and deviation 8.7; five deviations keep 40 draws quiet.
    assert 100 - 44 < counts.min() <= counts.max() < 100 + 44


def test_scales_of_a_subset_follow_its_own_spacing() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(6.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    old = field_from_points(grid, torch.rand(216, 3), 0)
    field, kept = inherit(old, "xyz", 0.1, torch.Generator().manual_seed(0))
    assert_fresh(field, grid[kept].numpy())
    assert field.log_scales.exp().min() > 1.0 + 1e-3 > old.log_scales.exp().max()


def test_what_cannot_be_used() -> None:
    with pytest.raises(UserInputError, match="0 points"):
        field_from_points(torch.zeros(0, 3), torch.zeros(0, 3), 0)
    with pytest.raises(UserInputError, match="not all finite"):
        field_from_points(torch.tensor([[0.0, torch.nan, 0]]), torch.zeros(1, 3), 0)
    for ratio in (0.0, -0.5, 1.0001, math.nan, math.inf):
        with pytest.raises(UserInputError, match="expected a ratio above 0 and at most 1"):
            inherit(base_field(), "xyz", ratio)
    for mode in ("everything", "0.5", "geometry:0.5", ""):  # the command line's other forms would not be obeyed
        with pytest.raises(UserInputError, match=f"--inherit '{mode}': expected geometry, xyz, full; the ratio is"):
            inherit(base_field(), mode)
    with pytest.raises(UserInputError, match="no Gaussians left to inherit"):
        inherit(base_field(0))
    with pytest.raises(UserInputError, match="SH degree 2 cannot give degree 3"):
        inherit(base_field(), "full", sh_degree=3)


def test_gradients_do_not_flow_back() -> None:
    old = base_field()
    old = old.with_parameters({name: tensor.requires_grad_() for name, tensor in old.parameters.items()})
    for mode in ("geometry", "xyz", "full"):
        field, _ = inherit(old, mode)
        assert not any(tensor.requires_grad for tensor in field.parameters.values())
