"""Compose on a GPU with gsplat: streams, batches, offloaded and stacked fields give the same images without waiting."""

from __future__ import annotations

import gc
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import Composition
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer, missing
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.field_renderer import FieldOffload
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
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
    """Collect PyTorch's warnings about waits for the GPU."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield caught
    torch.cuda.set_sync_debug_mode("default")


def images(renderer: HierarchyRenderer, cameras: list[Camera]) -> list[torch.Tensor]:
    return [renderer.render(camera).composed[0] for camera in cameras]


def allocated() -> int:
    """Return the bytes of all tensors on the GPU: without cuBLAS's workspaces, one for each stream that multiplied."""
    gc.collect()
    torch.cuda.synchronize()
    torch._C._cuda_clearCublasWorkspaces()
    return torch.cuda.memory_allocated()


def assert_alike(actual: torch.Tensor, expected: torch.Tensor) -> None:
    """Compare up to rounding, by which a Gaussian of alpha 1/255 may be skipped or blending may stop one earlier."""
    apart = (actual - expected).abs()
    assert float((apart > 2e-5).float().mean()) < 1e-4, float(apart.max())  # worst seen: 3 of 246,402
    assert float(apart.max()) < 1e-2  # worst seen 1.7e-3


def test_beside_each_other_is_one_after_the_other(renderer: HierarchyRenderer) -> None:
    together = images(renderer, CAMERAS * 10)
    in_turn = images(replace(renderer, concurrent=False), CAMERAS)
    for i, image in enumerate(together):
        assert_alike(image, in_turn[i % len(CAMERAS)])


def test_it_is_the_cpus_image(renderer: HierarchyRenderer) -> None:
    expected = HierarchyRenderer(fields("cpu"), 3, Pyramid(), CpuRasterizer(), renderer.background).render(CAMERAS[0])
    # gsplat's footprints end where alpha is 1/255, ours at three sigma, of thousands of Gaussians in a row: wide enough
    # for that, and far from what a level missed or shifted would do.
    difference = (renderer.render(CAMERAS[0]).composed[0].cpu() - expected.composed[0]).abs()
    assert float(difference.mean()) < 5e-3
    assert float(difference.max()) < 0.2


def test_batches(renderer: HierarchyRenderer) -> None:
    for actual, expected in zip(renderer.render_batch(CAMERAS).composed[0], images(renderer, CAMERAS), strict=True):
        assert_alike(actual, expected)


@pytest.mark.parametrize("keep", [True, False])
def test_fields_come_when_they_are_needed(renderer: HierarchyRenderer, keep: bool) -> None:
    expected = images(renderer, CAMERAS)
    waiting = fields("cpu")
    far = HierarchyRenderer(
        waiting,
        3,
        Pyramid(),
        GsplatRasterizer(),
        renderer.background,
        offload=FieldOffload(torch.device("cuda"), keep),
    )
    before = allocated()
    for actual, image in zip(images(far, CAMERAS), expected, strict=True):
        assert_alike(actual, image)
    del actual  # an image has 2.7 times as many bytes as all fields
    size = sum(value.nbytes for field in waiting.values() for value in field.parameters.values())
    taken = allocated() - before
    if keep:
        size += 8 * sum(len(field) for field in waiting.values())  # all at once: the number of each Gaussian's image
    # Besides: two colours and what the rasterizer keeps of cameras, each tensor rounded up to 512 bytes.
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


def at_once(renderer: HierarchyRenderer) -> HierarchyRenderer:
    """Return the renderer with a stack of its fields, for images of any size."""
    together = replace(renderer, offload=FieldOffload(torch.device("cuda")), stack_pixels=10**9)
    assert together.can_stack
    return together


def assert_same(actual: Composition, expected: Composition) -> None:
    assert actual.composed.keys() == expected.composed.keys()
    for level, image in expected.composed.items():
        # The same kernels; the background alone is blended by other operations.
        assert_alike(actual.composed[level], image)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.1, 0.2, 0.3)])
@pytest.mark.parametrize("antialiasing", [False, True])
def test_all_at_once_is_one_after_the_other(
    renderer: HierarchyRenderer, antialiasing: bool, background: tuple[float, float, float]
) -> None:
    renderer = replace(renderer, rasterizer=GsplatRasterizer(antialiasing=antialiasing), background=background)
    together, in_turn = at_once(renderer), replace(renderer, concurrent=False)
    for camera in CAMERAS * 4:
        assert_same(together.render(camera), in_turn.render(camera))
    for level in (2, 1, 0):
        gains = {shown: 0.5 + shown for shown in range(level, 3)}
        assert_same(together.render(CAMERAS[0], level, gains), in_turn.render(CAMERAS[0], level, gains))


@pytest.mark.parametrize(
    "counts", [(5_000,), (10, 50_000), (50_000, 10), (3_000, 0, 2_000), (0, 0), (4, 5, 6, 7)], ids=str
)
def test_all_at_once_whatever_the_sizes_of_fields(counts: tuple[int, ...]) -> None:
    top = len(counts) - 1
    some = {i: replace(blob_field(n, seed=i), signed=i < top).to("cuda") for i, n in enumerate(counts)}
    # Out of the view, too, and near: where gsplat's projection depends on the size of the image.
    some = {i: field.with_parameters({"means": 3 * field.means}) for i, field in some.items()}
    renderer = HierarchyRenderer(some, len(counts), Pyramid(), GsplatRasterizer(), (0.1, 0.2, 0.3))
    for camera in CAMERAS:
        assert_same(at_once(renderer).render(camera), replace(renderer, concurrent=False).render(camera))


def test_a_frame_of_all_at_once_waits_once(renderer: HierarchyRenderer, waits: list[warnings.WarningMessage]) -> None:
    together = at_once(renderer)
    images(together, CAMERAS)
    torch.cuda.synchronize()
    waits.clear()
    torch.cuda.set_sync_debug_mode("warn")
    together.render(CAMERAS[0])
    assert len(waits) <= 1, [f"{wait.filename}:{wait.lineno}" for wait in waits]


def test_all_at_once_takes_the_place_of_the_fields(renderer: HierarchyRenderer) -> None:
    waiting = {level: replace(blob_field(200_000), signed=level < 1) for level in (0, 1)}
    size = sum(value.nbytes for field in waiting.values() for value in field.parameters.values())
    far = HierarchyRenderer(waiting, 2, Pyramid(), GsplatRasterizer(), offload=FieldOffload(torch.device("cuda")))
    small = ring_camera(0.0, 64, 48)
    before = torch.cuda.memory_allocated()
    far.render(small)
    torch.cuda.synchronize()
    # And 8 bytes a Gaussian that say which image it is in: 1.15 of these, which have one coefficient a colour.
    assert size <= torch.cuda.memory_allocated() - before < 1.3 * size
