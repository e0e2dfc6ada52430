"""Plant floaters before a wall of Gaussians, and test crops against NumPy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.cleaning import find_floaters, share_in_front, sums_of_weights
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.crop import Crop
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from tests.refusals import refuses
from tests.training_scene import blob_field, ring_camera

DISTANCE = 6.0
"""From the cameras to the wall."""


def row_of_cameras(count: int = 8) -> list[Camera]:
    """Cameras in a row, a unit apart, that look along z and see all of the wall's middle."""
    poses = []
    for i in range(count):
        pose = torch.eye(4)
        pose[0, 3] = -(i - (count - 1) / 2)
        poses.append(Camera(96, 64, 60.0, 60.0, 48.0, 32.0, pose))
    return poses


def gaussians(means: torch.Tensor, size: float) -> GaussianField:
    n = len(means)
    return GaussianField(
        means=means,
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(size)),
        opacity_logits=torch.full((n,), 4.0),
        sh=torch.linspace(-1, 1, 3 * n).view(n, 1, 3),
    )


def joined(*fields: GaussianField) -> GaussianField:
    names = fields[0].parameters
    return fields[0].with_parameters({name: torch.cat([one.parameters[name] for one in fields]) for name in names})


def wall() -> GaussianField:
    y, x = torch.meshgrid(torch.arange(-4, 4.01, 0.25), torch.arange(-9, 9.01, 0.25), indexing="ij")
    return gaussians(torch.stack([x, y, torch.full_like(x, DISTANCE)], -1).view(-1, 3), 0.15)


def before_cameras(cameras: list[Camera], which: list[int], depth: float = 0.5) -> GaussianField:
    """Small Gaussians near some cameras, outside of the others' images."""
    centres = [cameras[i].position + torch.tensor([0.05 * i, 0.1, depth]) for i in which]
    return gaussians(torch.stack(centres), 0.02)


def renderer(**fields: GaussianField) -> HierarchyRenderer:
    by_level = {int(name[-1]): field for name, field in fields.items()}
    return HierarchyRenderer(by_level, max(by_level) + 1, Pyramid(), CpuRasterizer())


def test_gaussians_near_single_cameras_go_and_the_wall_stays() -> None:
    cameras = row_of_cameras()
    floaters = before_cameras(cameras, [0, 2, 5])
    masks = find_floaters(renderer(level_0=joined(wall(), floaters)), cameras)
    assert masks.keys() == {0}
    assert masks[0].nonzero()[:, 0].tolist() == [len(wall()) + i for i in range(3)]


def test_what_three_views_see_is_no_floater() -> None:
    """A column in the middle of the room stands before the wall in all views."""
    column = gaussians(torch.tensor([[0.0, 0.2 * i, 4.0] for i in range(-3, 4)]), 0.1)
    assert not find_floaters(renderer(level_0=joined(wall(), column)), row_of_cameras())[0].any()


def test_without_a_surface_behind_it_nothing_is_a_floater() -> None:
    cameras = row_of_cameras()
    assert not find_floaters(renderer(level_0=before_cameras(cameras, [0, 2, 5])), cameras)[0].any()


def test_residuals_are_compared_with_the_surface_of_the_base() -> None:
    cameras = row_of_cameras()
    residual = joined(wall(), before_cameras(cameras, [1, 6]))
    base = joined(wall(), before_cameras(cameras, [3]))
    masks = find_floaters(renderer(level_1=base, level_0=replace(residual, signed=True)), cameras)
    assert masks[1].nonzero()[:, 0].tolist() == [len(wall())]
    assert masks[0].nonzero()[:, 0].tolist() == [len(wall()), len(wall()) + 1]


def test_nested_levels_have_their_own_surfaces() -> None:
    cameras = row_of_cameras()
    fine = joined(wall(), before_cameras(cameras, [1, 6]))
    masks = find_floaters(renderer(level_1=before_cameras(cameras, [1, 6]), level_0=fine), cameras)
    assert not masks[1].any(), "the coarse level has no wall"
    assert int(masks[0].sum()) == 2


def test_the_share_in_front_counts_views_by_weight() -> None:
    """A Gaussian before the wall in one view, and before nothing in another that shows as much of it."""
    cameras = row_of_cameras(2)
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    turned = replace(cameras[0], world_to_camera=away @ cameras[0].world_to_camera)
    one = before_cameras(cameras, [0])
    mirrored = replace(one, means=cameras[0].position + (one.means - cameras[0].position) * torch.tensor([-1.0, 1, -1]))
    share = share_in_front(CpuRasterizer(), joined(one, mirrored), wall(), [cameras[0], turned])
    torch.testing.assert_close(share, torch.tensor([1.0, 0.0]))
    both = share_in_front(CpuRasterizer(), one, wall(), [cameras[0], cameras[0]])
    torch.testing.assert_close(both, torch.tensor([1.0]))


def test_sums_of_weights_are_those_of_colours_that_are_rendered() -> None:
    """A field whose Gaussian i alone is white shows its blending weights."""
    field, camera = blob_field(count=12), ring_camera(0.4)
    pixels = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(0))
    sums = sums_of_weights(CpuRasterizer(), field, camera, pixels)
    for i in range(len(field)):
        sh = torch.zeros(len(field), 1, 3)
        sh[i] = math.sqrt(4 * math.pi)  # times the constant harmonic, 1
        shown = replace(field, sh=sh, signed=True)
        weights = OracleRasterizer()(shown, camera, background=torch.zeros(3)).image
        torch.testing.assert_close(sums[i], (weights * pixels).sum((1, 2)), rtol=1e-5, atol=5e-5)  # 6e-6 seen


@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4), st.integers(0, 100))
def test_a_sphere_keeps_what_is_within_its_radius(numbers: list[float], seed: int) -> None:
    x, y, z, radius = *numbers[:3], abs(numbers[3]) + 0.1
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(seed)) * 2
    inside = Crop.parse(f"{x},{y},{z},{radius}").contains(points).numpy()
    distance = np.linalg.norm(points.double().numpy() - [x, y, z], axis=1)
    clear = np.abs(distance - radius) > 1e-5
    assert (inside == (distance <= radius))[clear].all()


def test_a_box_keeps_what_is_between_its_corners() -> None:
    points = torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [0.5, -0.1, 0.5], [0.5, 0.5, 2.5], [1, 1, 2]])
    assert Crop.parse("0,0,0,1,1,2").contains(points).tolist() == [True, False, False, False, True]


def test_edges_lie_on_the_box_and_the_sphere() -> None:
    box = np.array(Crop.parse("-1,0,2,1,4,3").edges())
    assert box.shape == (12, 2, 3)
    assert sorted(np.linalg.norm(box[:, 1] - box[:, 0], axis=1)) == [1] * 4 + [2] * 4 + [4] * 4
    assert {tuple(corner) for corner in box.reshape(-1, 3)} == {
        (x, y, z) for x in (-1, 1) for y in (0, 4) for z in (2, 3)
    }
    sphere = np.array(Crop.parse("1,2,3,0.5").edges())
    np.testing.assert_allclose(np.linalg.norm(sphere - [1, 2, 3], axis=2), 0.5, rtol=1e-12)
    np.testing.assert_allclose(sphere.reshape(-1, 3).min(0), [0.5, 1.5, 2.5], rtol=1e-12)
    np.testing.assert_allclose(sphere.reshape(-1, 3).max(0), [1.5, 2.5, 3.5], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("1,2,3", "--crop 1,2,3: expected six numbers .* or four"),
        ("a,b,c,d", "expected six numbers"),
        ("0,0,0,nan", "expected six numbers"),
        ("0,0,0,1,inf,1", "expected six numbers"),
        ("0,0,0,0", "the radius is 0, expected a positive one"),
        ("0,0,0,1,-1,1", "y0 is 0 and y1 is -1, expected y0 < y1"),
    ],
)
def test_mistakes_in_a_crop_are_one_line(text: str, facts: str) -> None:
    refuses(UserInputError, facts, Crop.parse, text)
