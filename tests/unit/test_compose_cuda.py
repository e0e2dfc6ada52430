"""Composition on a GPU with gsplat: streams, batches and streamed fields give the same images, and nothing waits."""

from __future__ import annotations

import gc
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from lapgs_plugin.adapters.gsplat import GsplatRasterizer, missing
from lapgs_plugin.camera import Camera
from lapgs_plugin.field import GaussianField
from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.rendering.residence import Residence
from tests.training_scene import blob_field, ring_camera

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(bool(missing()), reason=f"needs gsplat on a GPU: {missing()}")]
SIZE = 701, 467  # odd at every level
CAMERAS = [ring_camera(2 * math.pi * i / 5, *SIZE) for i in range(5)]


def fields(device: str) -> dict[int, GaussianField]:
    kinds = {2: (2_000, False), 1: (4_000, True), 0: (20_000, True)}
    return {level: replace(blob_field(n), signed=signed).to(device) for level, (n, signed) in kinds.items()}


@pytest.fixture
def renderer() -> HierarchyRenderer:
    return HierarchyRenderer(fields("cuda"), 3, Pyramid(), GsplatRasterizer(), (0.1, 0.2, 0.3))


@pytest.fixture
def waits() -> Iterator[list[warnings.WarningMessage]]:
    """What PyTorch says of waits for the GPU."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield caught
    torch.cuda.set_sync_debug_mode("default")


def images(renderer: HierarchyRenderer, cameras: list[Camera]) -> list[torch.Tensor]:
    return [renderer.render(camera).composed[0] for camera in cameras]


def test_beside_each_other_is_one_after_the_other(renderer: HierarchyRenderer) -> None:
    together = images(renderer, CAMERAS * 10)
    in_turn = images(replace(renderer, concurrent=False), CAMERAS)
    for i, image in enumerate(together):
        torch.testing.assert_close(image, in_turn[i % len(CAMERAS)], rtol=0, atol=1e-6)


def test_it_is_the_cpus_image(renderer: HierarchyRenderer) -> None:
    expected = HierarchyRenderer(fields("cpu"), 3, Pyramid(), CpuRasterizer(), renderer.background).render(CAMERAS[0])
    # gsplat's footprints end where alpha is 1/255, ours at three sigma, of thousands of Gaussians in a row: wide enough
    # for that, and far from what a level missed or shifted would do.
    difference = (renderer.render(CAMERAS[0]).composed[0].cpu() - expected.composed[0]).abs()
    assert float(difference.mean()) < 5e-3
    assert float(difference.max()) < 0.2


def test_batches(renderer: HierarchyRenderer) -> None:
    for found, expected in zip(renderer.render_batch(CAMERAS).composed[0], images(renderer, CAMERAS), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("keep", [True, False])
def test_fields_come_when_they_are_needed(renderer: HierarchyRenderer, keep: bool) -> None:
    expected = images(renderer, CAMERAS)
    waiting = fields("cpu")
    far = HierarchyRenderer(
        waiting, 3, Pyramid(), GsplatRasterizer(), renderer.background, residence=Residence(torch.device("cuda"), keep)
    )
    gc.collect()
    before = torch.cuda.memory_allocated()
    for found, image in zip(images(far, CAMERAS), expected, strict=True):
        torch.testing.assert_close(found, image, rtol=0, atol=1e-6)
    del found  # an image has 2.7 times as many bytes as all fields
    torch.cuda.synchronize()
    size = sum(value.nbytes for field in waiting.values() for value in field.parameters.values())
    taken = torch.cuda.memory_allocated() - before
    # Besides the fields: two colours and what the rasterizer keeps of cameras, each tensor rounded up to 512 bytes.
    assert abs(taken - (size if keep else 0)) < size / 20


@pytest.mark.parametrize("concurrent", [True, False])
def test_a_frame_waits_once_a_field_inside_of_gsplat(
    renderer: HierarchyRenderer, concurrent: bool, waits: list[warnings.WarningMessage]
) -> None:
    renderer = replace(renderer, concurrent=concurrent)
    images(renderer, CAMERAS)
    torch.cuda.synchronize()
    waits.clear()
    torch.cuda.set_sync_debug_mode("warn")
    renderer.render(CAMERAS[0])
    assert len(waits) <= len(renderer.fields), [f"{wait.filename}:{wait.lineno}" for wait in waits]
