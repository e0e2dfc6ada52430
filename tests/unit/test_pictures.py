"""Test pictures of views: cut-outs lie on edges, and whole pictures are aligned."""

from __future__ import annotations

import base64
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.evaluation.figures import AS_RENDERED, PhotoLook
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.images import view_images
from lapgs_plugin.reports.pictures import edge_squares, make_strip
from lapgs_plugin.scenes.scene import View
from tests.training_scene import blob_field, ring_camera


def test_squares_lie_on_the_strongest_edges_first() -> None:
    photo = torch.full((3, 120, 200), 0.5)
    photo[:, 20:40, 20:40:2] = 0.9  # the finer pattern, and the stronger
    photo[:, 80:100, 150:170:2] = 0.7
    strong, weak = edge_squares(photo, 2)
    for (left, top, side), (x, y) in ((strong, (30, 30)), (weak, (160, 90))):
        assert side == 20
        assert abs(left + side / 2 - x) < 4
        assert abs(top + side / 2 - y) < 4


@settings(deadline=None, max_examples=40)
@given(height=st.integers(5, 90), width=st.integers(5, 90), count=st.integers(0, 5), seed=st.integers(0, 99))
def test_squares_are_inside_and_apart(height: int, width: int, count: int, seed: int) -> None:
    photo = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    squares = edge_squares(photo, count)
    assert min(count, 1) <= len(squares) <= count
    covered = np.zeros((height, width), int)
    for left, top, side in squares:
        assert 0 <= left <= width - side
        assert 0 <= top <= height - side
        covered[top : top + side, left : left + side] += 1
    assert covered.max(initial=0) <= 1


def pixels(data: str) -> np.ndarray:
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    return decoded[:, :, ::-1].astype(float) / 255


def test_base_and_residual_add_up_to_the_composition_pixel_by_pixel() -> None:
    camera = ring_camera(0.3)
    residual = blob_field(seed=1)
    fields = {1: blob_field(), 0: replace(residual, sh=0.1 * residual.sh, signed=True)}
    renderer = HierarchyRenderer(fields, 2, Pyramid(), CpuRasterizer(), background=(0.3, 0.3, 0.3))
    composed = renderer.render(camera).composed[0].clamp(0, 1)
    looks = [AS_RENDERED, AS_RENDERED]
    strip = make_strip(View("a.png", camera, composed), "why", "figures", [renderer, renderer], looks)
    assert [picture.caption for picture in strip.pictures] == ["Photo", "Base", "Residual", "Composition", "Baseline"]
    assert strip.compared == (4, 3)
    for cutout in strip.cutouts:
        photo, base, residual, composition, baseline = (pixels(picture.data) for picture in cutout.pictures)
        added = np.clip(base + 2 * (residual - 128 / 255), 0, 1)
        assert np.abs(added - composition).max() < 0.02  # three roundings to 8 bits; 0.012 seen
        assert (photo == composition).all()
        assert (baseline == composition).all()
        left, top = (round(share * size / 100) for share, size in ((cutout.left, 56), (cutout.top, 40)))
        whole = composed[:, top : top + cutout.side, left : left + cutout.side].permute(1, 2, 0).numpy()
        assert composition == pytest.approx(whole, abs=0.5001 / 255)


def test_renders_have_the_look_with_which_they_were_measured() -> None:
    """Base, residual and composition of the run get its exposure and falloff; the baseline learned neither."""
    camera, residual = ring_camera(0.3), blob_field(seed=1)
    fields = {1: blob_field(), 0: replace(residual, sh=0.1 * residual.sh, signed=True)}
    renderer = HierarchyRenderer(fields, 2, Pyramid(), CpuRasterizer(), background=(0.3, 0.3, 0.3))
    plain = renderer.render(camera).composed[0]
    exposure = torch.tensor([[0.7, 0.1, 0.0, 0.05], [0.0, 0.8, 0.0, 0.0], [0.1, 0.0, 0.6, 0.1]])
    looks = [PhotoLook(-1.5, exposure), AS_RENDERED]
    strip = make_strip(View("a.png", camera, plain.clamp(0, 1)), "why", "figures", [renderer, renderer], looks)
    assert (
        strip.pictures[3].detail
        == "rendered by the run, with the photo's exposure and falloff of the corners as measured"
    )
    assert strip.pictures[4].detail == "rendered by the baseline"
    y, x = np.mgrid[:40, :56] + 0.5
    distance = ((x - 28) ** 2 + (y - 20) ** 2) / (28**2 + 20**2)
    darkened = plain.permute(1, 2, 0).double().numpy() * 2.0 ** (-1.5 * distance)[..., None]
    matrix = exposure.double().numpy()
    photographed = np.clip(darkened @ matrix[:, :3].T + matrix[:, 3], 0, 1)
    for cutout in strip.cutouts:
        _, base, residual, composition, baseline = (pixels(picture.data) for picture in cutout.pictures)
        left, top = (round(share * size / 100) for share, size in ((cutout.left, 56), (cutout.top, 40)))
        part = np.s_[top : top + cutout.side, left : left + cutout.side]
        assert composition == pytest.approx(photographed[part], abs=0.501 / 255)
        assert baseline == pytest.approx(plain.clamp(0, 1).permute(1, 2, 0).numpy()[part], abs=0.501 / 255)
        added = np.clip(base + 2 * (residual - 128 / 255), 0, 1)
        assert np.abs(added - composition).max() < 0.02  # three roundings to 8 bits


def test_nested_levels_have_differences_and_no_residuals() -> None:
    camera, fields = ring_camera(0.3), {1: blob_field(), 0: blob_field(seed=1)}
    renderer = HierarchyRenderer(fields, 2, Pyramid(), CpuRasterizer(), background=(0.3, 0.3, 0.3))
    composition = renderer.render(camera)
    strip = make_strip(View("a.png", camera, composition.composed[0]), "why", "figures", [renderer], [AS_RENDERED])
    assert [picture.caption for picture in strip.pictures] == ["Photo", "Base", "Difference", "Composition"]
    assert set(view_images(composition, None, raw=True, nested=renderer.nested)) == {"base", "difference_0", "composed"}
