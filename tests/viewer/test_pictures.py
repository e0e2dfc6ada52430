"""Test pictures against composition written out, and levels of detail against geometry by hand."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.field_renderer import FieldOffload
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.scenes.images import as_bytes
from lapgs_plugin.viewer.pictures import Picture, PictureSettings, ShownRun, draw, side_by_side
from lapgs_plugin.viewer.poses import InitialView, Pose
from tests.training_scene import blob_field, ring_camera

CAMERA = ring_camera(0.4, 64, 48)


def residual(seed: int) -> HierarchyRenderer:
    base, finer = blob_field(seed=seed), blob_field(seed=seed + 1)
    fields = {1: base, 0: replace(finer, sh=0.3 * finer.sh, signed=True)}
    return HierarchyRenderer(fields, 2, Pyramid("camera"), CpuRasterizer(), (0.1, 0.2, 0.3))


@pytest.fixture
def run() -> ShownRun:
    return ShownRun("run", residual(0), pixels_per_angle=CAMERA.fy, distance=4.0)


def picture(run: ShownRun, settings: PictureSettings, camera: Camera = CAMERA, **how: float) -> Picture:
    return draw(run, None, camera, settings, **{"distance": 4.0, "zoom": 1.0, **how})


def field_image(run: ShownRun, level: int, size: tuple[int, int], background: Tensor) -> Tensor:
    with torch.no_grad():
        field = run.renderer.fields[level]
        return CpuRasterizer()(field, CAMERA.resized(*size), background=background).image


def test_gains_and_switched_off_levels(run: ShownRun) -> None:
    base = field_image(run, 1, (32, 24), torch.tensor([0.1, 0.2, 0.3]))
    detail = field_image(run, 0, (64, 48), torch.zeros(3))
    up = Pyramid("camera").up(base, (48, 64))
    shown = picture(run, PictureSettings({1: 1.0, 0: 2.5}))
    torch.testing.assert_close(shown.image, (up + 2.5 * detail).clamp(0, 1))
    assert shown.milliseconds.keys() == {1, 0}
    blurred = picture(run, PictureSettings({1: 1.0, 0: 0.0}))
    torch.testing.assert_close(blurred.image, up.clamp(0, 1))
    assert blurred.milliseconds.keys() == {1}
    only_base = picture(run, PictureSettings(level=1))
    torch.testing.assert_close(only_base.image, up.clamp(0, 1))
    assert only_base.level == 1


@dataclass
class Elsewhere(FieldOffload):
    """Offload that returns new objects each time."""

    def bring(self, level: int, wanted: GaussianField) -> GaussianField:
        return wanted.with_parameters({name: value.clone() for name, value in wanted.parameters.items()})


def test_each_band_has_its_own_time_wherever_its_field_waits(run: ShownRun) -> None:
    class SlowDetail(CpuRasterizer):
        def render_images(self, field: GaussianField, *args: Any, **kwargs: Any) -> Tensor:
            time.sleep(0.05 if field.signed else 0.0)
            return super().render_images(field, *args, **kwargs)

    away = replace(run.renderer, rasterizer=SlowDetail(), offload=Elsewhere(torch.device("cpu")))
    times = picture(replace(run, renderer=away), PictureSettings()).milliseconds
    assert times.keys() == {1, 0}
    assert times[0] >= 50.0
    assert picture(replace(run, renderer=away), PictureSettings(band=0)).milliseconds[0] >= 50.0
    assert picture(replace(run, renderer=away), PictureSettings({0: 0.0})).milliseconds.keys() == {1}


def test_one_band_alone_lies_around_grey(run: ShownRun) -> None:
    detail = field_image(run, 0, (64, 48), torch.zeros(3))
    shown = picture(run, PictureSettings({0: 2.0}, band=0))
    torch.testing.assert_close(shown.image, (0.5 + detail).clamp(0, 1))
    assert shown.milliseconds.keys() == {0}
    base = picture(run, PictureSettings(band=1)).image
    torch.testing.assert_close(base, picture(run, PictureSettings({0: 0.0})).image)


def test_nested_levels_show_one_field_and_bands_that_are_differences() -> None:
    background = torch.tensor([0.1, 0.2, 0.3])
    fields = {1: blob_field(seed=0), 0: blob_field(seed=1)}
    renderer = HierarchyRenderer(fields, 2, Pyramid("camera"), CpuRasterizer(), (0.1, 0.2, 0.3))
    run = ShownRun("run", renderer, pixels_per_angle=CAMERA.fy, distance=4.0)
    base, whole = field_image(run, 1, (32, 24), background), field_image(run, 0, (64, 48), background)
    up = Pyramid("camera").up(base, (48, 64))
    plain = picture(run, PictureSettings())
    torch.testing.assert_close(plain.image, whole.clamp(0, 1))
    assert plain.milliseconds.keys() == {0}
    sharper = picture(run, PictureSettings({0: 2.0}))
    torch.testing.assert_close(sharper.image, (up + 2.0 * (whole - up)).clamp(0, 1))
    assert sharper.milliseconds.keys() == {1, 0}
    blurred = picture(run, PictureSettings({0: 0.0}))
    torch.testing.assert_close(blurred.image, up.clamp(0, 1))
    band = picture(run, PictureSettings({0: 3.0}, band=0))
    torch.testing.assert_close(band.image, (0.5 + 3.0 * (whole - up) / 2).clamp(0, 1))
    assert band.milliseconds.keys() == {1, 0}


@pytest.mark.parametrize(
    ("size", "distance", "level"),
    [
        ((64, 48), 4.0, 0),  # as trained
        ((64, 48), 7.9, 0),  # not yet half the pixels on the thing that is looked at
        ((64, 48), 8.1, 1),  # less than half
        ((64, 48), 100.0, 1),  # there is nothing coarser
        ((64, 48), 0.5, 0),  # nor finer
        ((30, 24), 4.0, 1),  # a window of half the height
        ((34, 26), 4.0, 0),
    ],
)
def test_detail_by_distance_and_window(run: ShownRun, size: tuple[int, int], distance: float, level: int) -> None:
    camera = Pose.of(CAMERA).camera(*size)
    assert picture(run, PictureSettings(level=None), camera, distance=distance).level == level


def test_detail_counts_the_window_not_the_small_picture_of_a_moving_camera(run: ShownRun) -> None:
    small = Pose.of(CAMERA).camera(16, 12)
    assert picture(run, PictureSettings(level=None), small, zoom=4.0).level == 0
    assert picture(run, PictureSettings(level=None), small).level == 1


def test_a_coarser_level_that_fits_is_the_picture_itself(run: ShownRun) -> None:
    camera = CAMERA.resized(32, 24)
    shown = picture(run, PictureSettings(level=None), camera, distance=9.0)
    base = field_image(run, 1, (32, 24), torch.tensor([0.1, 0.2, 0.3]))
    assert shown.level == 1
    torch.testing.assert_close(shown.image, base.clamp(0, 1))


def test_split_view_takes_each_side_from_its_run(run: ShownRun) -> None:
    other = ShownRun("other", residual(7), pixels_per_angle=CAMERA.fy, distance=4.0)
    settings = PictureSettings({0: 0.0}, divider=0.25)
    split = draw(run, other, CAMERA, settings, distance=4.0, zoom=1.0).image
    left = picture(run, PictureSettings({0: 0.0})).image
    right = picture(other, PictureSettings()).image  # gains apply to the run, not to the one beside it
    torch.testing.assert_close(split[:, :, :15], left[:, :, :15])
    torch.testing.assert_close(split[:, :, 17:], right[:, :, 17:])
    assert (split[:, :, 15:17] == 1).all()


@pytest.mark.parametrize(("divider", "value"), [(0.0, 0.75), (1.0, 0.25)])
def test_a_divider_at_the_edge_leaves_one_image(divider: float, value: float) -> None:
    image = side_by_side(torch.full((3, 4, 9), 0.25), torch.full((3, 4, 9), 0.75), divider)
    assert (image == value).all()


def test_poses_and_cameras_are_inverse() -> None:
    camera = Pose.of(CAMERA).camera(64, 48)
    torch.testing.assert_close(camera.world_to_camera, CAMERA.world_to_camera, atol=1e-5, rtol=0)
    assert camera.fy == pytest.approx(CAMERA.fy)
    assert camera.fx == camera.fy
    assert Pose.of(CAMERA).fov == pytest.approx(2 * math.atan(24 / CAMERA.fy))


def test_bytes_are_rounded() -> None:
    pixels = as_bytes(torch.tensor([0.0, 0.5, 1.0]).view(3, 1, 1))
    np.testing.assert_array_equal(pixels, [[[0, 128, 255]]])


def test_a_view_of_a_field_whose_cameras_are_unknown() -> None:
    means = torch.tensor([[1.0, 2.0, 3.0]]).repeat(5, 1)
    field = GaussianField(means, torch.eye(4)[:1].expand(5, 4), means, torch.zeros(5), torch.zeros(5, 1, 3))
    for spread in (0.0, 0.5):  # all at one place, or not
        shown = field.with_parameters({"means": means + spread * torch.randn(5, 3)})
        camera = InitialView.of_field(shown).camera(32, 16)
        x, y, z = (
            camera.world_to_camera[:3, :3] @ means.new_tensor(np.median(shown.means, 0)) + camera.world_to_camera[:3, 3]
        )
        assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-5)  # worst seen: 5e-7
        assert z > 0
    empty = InitialView.of_field(field.kept(torch.zeros(5, dtype=torch.bool)))
    np.testing.assert_array_equal(empty.look_at, np.zeros(3))
