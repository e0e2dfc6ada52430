"""Which speeds are measured, of what, and from when to when."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
import torch

from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.raster import RenderResult
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.rendering.speed import measure_speed
from tests.training_scene import blob_field, ring_camera

SECONDS = {False: 0.002, True: 0.006}


class Slow:
    """Takes a known time for a base and for a residual."""

    name = "slow"

    def __call__(self, field: Any, camera: Any, **options: Any) -> RenderResult:
        time.sleep(SECONDS[field.signed])
        return CpuRasterizer()(field, camera, **options)


def test_every_kind_is_measured_by_itself() -> None:
    fields = {1: blob_field(30), 0: replace(blob_field(50), signed=True)}
    renderer = HierarchyRenderer(fields, 2, Pyramid(), Slow())
    found = measure_speed(renderer, [ring_camera(0.0), ring_camera(1.0)], 0, rounds=2)
    described = [(speed.what, speed.size, speed.gaussians) for speed in found]
    assert described == [
        ("levels 1 to 0, one after the other", (56, 40), 80),
        ("base", (28, 20), 30),
        ("base as large as level 0", (56, 40), 30),
        ("residual 0 alone", (56, 40), 50),
    ]
    for speed, seconds in zip(found, (0.008, 0.002, 0.002, 0.006), strict=True):
        assert speed.milliseconds >= 1000 * seconds
        assert speed.fps == pytest.approx(1000 / speed.milliseconds)
    assert [speed.what for speed in measure_speed(renderer, [ring_camera(0.0)], 1, rounds=1)] == ["base"]


def test_one_level_is_a_field() -> None:
    renderer = HierarchyRenderer({0: blob_field(30)}, 1, Pyramid(), CpuRasterizer())
    (speed,) = measure_speed(renderer, [ring_camera(0.0)], 0, rounds=1)
    assert (speed.what, speed.gaussians) == ("field", 30)
    assert not torch.is_inference_mode_enabled()
