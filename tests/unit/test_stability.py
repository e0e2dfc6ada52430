"""Test flicker on scenes with known pixels: textured planes seen by a moving camera, traced ray by ray."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lapgs_plugin.evaluation.stability import (
    COMPOSITION,
    SINGLE,
    DepthImage,
    Flicker,
    Frame,
    measure_flicker,
    path_frames,
    render_depth,
)
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from tests.training_scene import blob_field, ring_camera

SIZE = (96, 72)


def camera_at(frame: int) -> Camera:
    """Return a camera that moves to the right, turns and rolls a little with each frame."""
    turn, roll = 0.01 * frame, 0.004 * frame
    cos, sin = math.cos(turn), math.sin(turn)
    about_y = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    about_z = torch.tensor([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = about_z @ about_y
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0.05 * frame, 0.01 * frame, 0.0])
    return Camera(*SIZE, 90.0, 88.0, 47.0, 36.5, pose)


def rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the origin (3,) and directions (h, w, 3) of rays in world units, each of depth 1 in the camera."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    along = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=-1)
    return camera.position.double(), along.double() @ camera.world_to_camera[:3, :3].double()


def texture(point: Tensor) -> Tensor:
    """Colour (h, w, 3) points smoothly: (3, h, w)."""
    x, y = point[..., 0], point[..., 1]
    waves = [torch.sin(2 * x + 3 * y), torch.cos(3 * x - y), torch.sin(4 * y)]
    return torch.stack([0.5 + 0.2 * wave for wave in waves])


def plane(camera: Camera, slope: float = 0.3) -> tuple[Tensor, Tensor]:
    """Trace the plane z = 4 + slope x: its colours (3, h, w) and depth (h, w)."""
    origin, along = rays(camera)
    depth = (4 + slope * origin[0] - origin[2]) / (along[..., 2] - slope * along[..., 0])
    return texture(origin + depth[..., None] * along).float(), depth.float()


def frame(number: int, change: Callable[[Tensor], Tensor] = lambda image: image) -> Frame:
    camera = camera_at(number)
    image, depth = plane(camera)
    return Frame(camera, DepthImage(depth, torch.ones_like(depth)), {"image": change(image)})


def test_a_plane_that_stands_still_does_not_flicker() -> None:
    flicker, compared = measure_flicker(frame(number) for number in range(6))
    assert flicker["image"].mean < 1e-4  # 4.0e-5 seen: interpolation between pixels
    assert flicker["image"].psnr > 70.0  # 73 seen
    assert 0.9 < compared < 1.0  # what has come into view has no past


def test_a_wrong_depth_shows_as_flicker() -> None:
    """Following the same images with a depth that ignores the slope gives the flicker of a wrong correspondence."""
    frames = [frame(number) for number in range(6)]
    flat = [replace(one, depth=DepthImage(torch.full_like(one.depth.depth, 4.0), one.depth.cover)) for one in frames]
    assert measure_flicker(flat)[0]["image"].mean > 20 * measure_flicker(frames)[0]["image"].mean


def test_brightness_that_changes_by_a_known_amount_is_measured() -> None:
    steps = [0.0, 0.03, -0.02, 0.05, 0.05]
    flicker, _ = measure_flicker(frame(i, lambda image, step=step: image + step) for i, step in enumerate(steps))  # type: ignore[misc]  # mypy's lambda
    changes = [b - a for a, b in itertools.pairwise(steps)]
    assert flicker["image"].mean == pytest.approx(sum(map(abs, changes)) / 4, abs=1e-4)  # 1.8e-5 seen
    mse = sum(change * change for change in changes) / 4
    assert flicker["image"].psnr == pytest.approx(-10 * math.log10(mse), abs=0.05)  # 9.2e-4 seen


def test_occluded_pixels_are_not_compared() -> None:
    """Without the test of depths, the edges of a bar in front of a plane would count as flicker."""

    def with_bar(number: int) -> Frame:
        camera = camera_at(number)
        image, depth = plane(camera)
        origin, along = rays(camera)
        at = origin + (2.0 - origin[2]) / along[..., 2:] * along  # on the plane z = 2
        bar = (at[..., 0] - 0.2).abs() < 0.15
        near = ((2.0 - origin[2]) / along[..., 2]).float()
        colors = torch.where(bar, torch.full_like(image, 0.9), image)
        return Frame(camera, DepthImage(torch.where(bar, near, depth), torch.ones_like(depth)), {"image": colors})

    flicker, compared = measure_flicker(with_bar(number) for number in range(6))
    # Bicubic sampling reads two pixels around, so that one or two columns at the bar's edges see both colours.
    assert flicker["image"].mean < 3e-3  # 1.1e-3 seen; a column that was hidden differs by 0.4
    assert 0.85 < compared < 0.98  # 0.973 seen


def test_frames_with_nothing_in_common_have_a_share_of_zero() -> None:
    away = replace(frame(0), camera=camera_at(400))
    flicker, compared = measure_flicker([frame(0), away])
    assert compared == 0.0
    assert (flicker["image"].mean, flicker["image"].values) == (0.0, 0)


def test_flicker_adds_up_over_frames() -> None:
    flicker = Flicker()
    flicker.add(torch.tensor([0.1, -0.3]))
    flicker.add(torch.tensor([[0.2]]))
    assert flicker.mean == pytest.approx(0.2)
    assert flicker.psnr == pytest.approx(-10 * math.log10((0.01 + 0.09 + 0.04) / 3))


def test_depth_is_the_weighted_mean_of_the_gaussians_over_a_pixel() -> None:
    """Compare two Gaussians, one behind the other, with the blending formula."""
    camera = Camera(32, 32, 40.0, 40.0, 16.5, 16.5, torch.eye(4))
    field = GaussianField(
        means=torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 6.0]]),
        quaternions=torch.tensor([[1.0, 0, 0, 0]] * 2),
        log_scales=torch.full((2, 3), -2.0),
        opacity_logits=torch.logit(torch.tensor([0.6, 0.8])),
        sh=torch.zeros(2, 4, 3),
    )
    for rasterizer in (CpuRasterizer(), OracleRasterizer()):
        image = render_depth(rasterizer, field, camera)
        front, back = 0.6, 0.4 * 0.8
        assert float(image.cover[16, 16]) == pytest.approx(front + back, abs=1e-5)  # 4.3e-8 seen
        # 3.8e-7 seen.
        assert float(image.depth[16, 16]) == pytest.approx((2 * front + 6 * back) / (front + back), abs=1e-4)
        assert float(image.cover[0, 0]) == 0.0


def test_frames_of_a_hierarchy_and_of_a_single_field() -> None:
    base, fine = blob_field(seed=1), blob_field(seed=2)
    hierarchy = HierarchyRenderer(
        {1: base, 0: replace(fine, sh=0.3 * fine.sh, signed=True)}, 2, Pyramid("camera"), CpuRasterizer()
    )
    single = HierarchyRenderer({0: base}, 1, Pyramid("camera"), CpuRasterizer())
    cameras = [ring_camera(0.01 * i) for i in range(3)]
    frames = list(path_frames(hierarchy, single, cameras))
    assert list(frames[0].images) == [COMPOSITION, "band 1", "band 0", SINGLE]
    composed = hierarchy.render(cameras[2]).composed[0]
    torch.testing.assert_close(frames[2].images[COMPOSITION], composed.clamp(0, 1))
    # 1.2e-7 seen.
    torch.testing.assert_close(frames[2].images["band 1"] + frames[2].images["band 0"], composed, atol=1e-6, rtol=0)
    torch.testing.assert_close(frames[2].depth.depth, render_depth(CpuRasterizer(), base, cameras[2]).depth)
    flicker, compared = measure_flicker(frames)
    assert flicker.keys() == frames[0].images.keys()
    assert compared > 0.01
