"""Test which speeds are measured, of which fields, and for how long."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
import torch

from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering import speed
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.speed import measure_speed
from tests.training_scene import blob_field, ring_camera

SECONDS = {False: 0.002, True: 0.006}


class Slow(Rasterizer):
    """Takes a known time for a base and for a residual."""

    name = "slow"

    def __call__(self, field: Any, camera: Any, **options: Any) -> RenderResult:
        time.sleep(SECONDS[field.signed])
        return CpuRasterizer()(field, camera, **options)


def test_every_kind_is_measured_by_itself() -> None:
    fields = {1: blob_field(30), 0: replace(blob_field(50), signed=True)}
    renderer = HierarchyRenderer(fields, 2, Pyramid(), Slow())
    speeds = measure_speed(renderer, [ring_camera(0.0), ring_camera(1.0)], 0, rounds=2)
    assert [(kind.what, kind.size, kind.gaussians) for kind in speeds] == [
        ("levels 1 to 0, one after the other", (56, 40), 80),
        ("base", (28, 20), 30),
        ("base as large as level 0", (56, 40), 30),
        ("residual 0 alone", (56, 40), 50),
    ]
    for kind, seconds in zip(speeds, (0.008, 0.002, 0.002, 0.006), strict=True):
        assert kind.milliseconds >= 1000 * seconds
        assert kind.fps == pytest.approx(1000 / kind.milliseconds)
    assert [kind.what for kind in measure_speed(renderer, [ring_camera(0.0)], 1, rounds=1)] == ["base"]


def test_of_nested_levels_each_is_a_field() -> None:
    renderer = HierarchyRenderer({1: blob_field(30), 0: blob_field(50)}, 2, Pyramid(), CpuRasterizer())
    speeds = measure_speed(renderer, [ring_camera(0.0), ring_camera(1.0)], 0, rounds=1)
    assert [(kind.what, kind.size, kind.gaussians) for kind in speeds] == [
        ("level 0", (56, 40), 50),
        ("base", (28, 20), 30),
        ("base as large as level 0", (56, 40), 30),
    ]
    assert speed.composed_speed(renderer, [ring_camera(0.0)], 1).gaussians == 50


def test_one_level_is_a_field() -> None:
    renderer = HierarchyRenderer({0: blob_field(30)}, 1, Pyramid(), CpuRasterizer())
    (only,) = measure_speed(renderer, [ring_camera(0.0)], 0, rounds=1)
    assert (only.what, only.gaussians) == ("field", 30)
    assert not torch.is_inference_mode_enabled()


def test_a_batch_counts_by_its_share() -> None:
    renderer = HierarchyRenderer({1: blob_field(30), 0: replace(blob_field(50), signed=True)}, 2, Pyramid(), Slow())
    (kind,) = (kind for kind in speed._kinds(renderer, 0, batches=True) if kind.views > 1)
    assert kind.what == f"all, {speed.BATCH} views at once"
    cameras = [ring_camera(0.1 * i) for i in range(speed.BATCH + 3)]  # three too many for a second batch
    measured = speed._measured(renderer, kind, cameras, rounds=1)
    assert 8.0 <= measured.milliseconds < 8.0 * 4, "two fields of 2 and 6 ms a view, and what the machine adds"
    assert measured.size == (56, 40)
