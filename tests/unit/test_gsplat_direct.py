"""Compare direct calls of gsplat's kernels with `gsplat.rasterization`, on a GPU."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.ops.mixed_sizes import own_parts, stack_padded
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.rasterizers.gsplat.self_check import direct_works
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.training.backend import training_rasterizer
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.trainer import Trainer
from tests.training_scene import ring_scene

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]

CAMERA = Camera(83, 61, 70.0, 72.0, 40.0, 31.0, torch.eye(4))


def gaussians(degree: int, signed: bool, count: int = 2000) -> GaussianField:
    generator = torch.Generator().manual_seed(degree)
    field = GaussianField(
        torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0]),
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) * 0.3 - 3.0,
        torch.randn(count, generator=generator),
        torch.randn(count, (degree + 1) ** 2, 3, generator=generator) * 0.3,
        signed,
    )
    return field.to("cuda")


def moved(by: float) -> Camera:
    pose = torch.eye(4)
    pose[0, 3] = by
    return replace(CAMERA, world_to_camera=pose)


def test_it_is_used() -> None:
    assert direct_works()


def test_it_is_used_whatever_mode_it_is_first_asked_in() -> None:
    with torch.inference_mode():
        assert direct_works.passes_on(torch.device("cuda"))


@pytest.mark.parametrize("own_radii", [False, True])
@pytest.mark.parametrize(("degree", "active", "signed"), [(3, 3, False), (3, 1, True), (0, 0, False), (2, 2, True)])
def test_images_gradients_and_what_densification_sees(degree: int, active: int, signed: bool, own_radii: bool) -> None:
    background = torch.tensor([0.1, 0.2, 0.3], device="cuda")
    weights = torch.randn(3, CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(5)).cuda()
    results = []
    for direct in (True, False):
        field = gaussians(degree, signed)
        for value in field.parameters.values():
            value.requires_grad_()
        rasterizer = GsplatRasterizer(direct=direct, own_radii=own_radii)
        result = rasterizer(field, CAMERA, background=background, sh_degree=active)
        (result.image * weights).sum().backward()
        gradients = [value.grad for value in field.parameters.values()]
        seen = [result.radii.float(), result.means2d.detach(), result.means2d.grad, result.absgrad2d]
        alone = rasterizer.render_image(field.detach(), CAMERA, background=background, sh_degree=active)
        results.append([result.image.detach(), alone, *seen, *gradients])
    for one, other in zip(*results, strict=True):
        assert one is not None
        assert other is not None
        # Sums in another order, in both; an H200 stays within this.
        torch.testing.assert_close(one, other, rtol=0, atol=2e-4 * float(other.abs().max()) + 1e-9)


def test_parameters_may_lie_in_any_order_and_anywhere() -> None:
    field = gaussians(2, True)
    turned = field.with_parameters(
        {name: value.movedim(0, -1).contiguous().movedim(-1, 0) for name, value in field.parameters.items()}
    )
    longer = {name: torch.cat([value.flatten()[:1], value.flatten()]) for name, value in field.parameters.items()}
    beside = field.with_parameters(
        {name: longer[name][1:].view(value.shape) for name, value in field.parameters.items()}
    )
    assert not turned.sh.is_contiguous()
    assert beside.sh.data_ptr() % 16 == 4
    black, rasterizer = torch.zeros(3, device="cuda"), GsplatRasterizer(direct=True)
    with torch.no_grad():
        images = [rasterizer.render_image(one, CAMERA, background=black) for one in (field, turned, beside)]
    assert torch.equal(images[0], images[1])
    assert torch.equal(images[0], images[2])


def test_a_training_view_is_sent_once_and_forgotten_with_its_camera() -> None:
    rasterizer, field, black = GsplatRasterizer(), gaussians(1, True), torch.zeros(3, device="cuda")
    camera = CAMERA.resized(40, 30)
    with torch.no_grad():
        for _ in range(3):
            rasterizer.render_image(field, camera, background=black)
    assert len(rasterizer._cameras._copied) == 1
    del camera
    gc.collect()
    assert not rasterizer._cameras._copied


def test_nothing_is_kept_of_renders_that_nobody_differentiates() -> None:
    rasterizer, field, black = GsplatRasterizer(), gaussians(3, True, 100_000), torch.zeros(3, device="cuda")
    field.means.requires_grad_()
    rasterizer(field, CAMERA, background=black)  # what is cached by size
    torch.cuda.synchronize()
    gc.disable()
    try:
        before = torch.cuda.memory_allocated()
        for _ in range(5):
            rasterizer(field, CAMERA, background=black)
        torch.cuda.synchronize()
        assert torch.cuda.memory_allocated() <= before
    finally:
        gc.enable()


@pytest.mark.parametrize(("views", "less"), [(2, 0), (5, 0), (8, 0), (2, 3), (8, 3)])
@pytest.mark.parametrize(("degree", "active", "signed"), [(3, 3, False), (3, 1, True), (0, 0, False)])
def test_several_views_are_those_of_single_calls(views: int, less: int, degree: int, active: int, signed: bool) -> None:
    """Of one size, and of sizes with up to `less` columns and rows less."""
    background = torch.tensor([0.1, 0.2, 0.3], device="cuda")
    weights = torch.randn(views, 3, CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(5)).cuda()
    cameras = [
        replace(moved(0.1 * index), width=CAMERA.width - min(index, less), height=CAMERA.height - min(index // 2, less))
        for index in range(views)
    ]
    inside = stack_padded([torch.ones(1, camera.height, camera.width, device="cuda") for camera in cameras])
    weights *= inside
    rasterizer = GsplatRasterizer(direct=True, own_radii=True)
    together, alone = gaussians(degree, signed), gaussians(degree, signed)
    for value in (*together.parameters.values(), *alone.parameters.values()):
        value.requires_grad_()
    batch = rasterizer.render_batch(together, cameras, background=background, sh_degree=active)
    (batch.image * weights).sum().backward()
    singles = [rasterizer(alone, camera, background=background, sh_degree=active) for camera in cameras]
    own = own_parts(weights, [camera.size for camera in cameras])
    torch.stack([(one.image * weight).sum() for one, weight in zip(singles, own, strict=True)]).sum().backward()
    pairs = {
        "image": (batch.image.detach() * inside, stack_padded([one.image.detach() for one in singles])),
        "radii": (batch.radii.float(), torch.stack([one.radii for one in singles]).float()),
        "means2d": (batch.means2d.detach(), torch.stack([one.means2d.detach() for one in singles])),
        "by means2d": (batch.means2d.grad, torch.stack([one.means2d.grad for one in singles])),
        "absgrad2d": (batch.absgrad2d, torch.stack([one.absgrad2d for one in singles])),
        **{name: (value.grad, alone.parameters[name].grad) for name, value in together.parameters.items()},
    }
    worst = {}
    for name, (one, other) in pairs.items():
        worst[name] = float((one - other).abs().max() / other.abs().max())
    print(views, degree, active, signed, {name: f"{value:.1e}" for name, value in worst.items()})
    assert worst["radii"] == 0
    assert max(worst.values()) < 2e-4, worst  # as for one view: sums in another order, in both
    plain = rasterizer.render_batch(together, cameras, background=background, sh_degree=active, with_geometry=False)
    torch.testing.assert_close(plain.image, batch.image, rtol=0, atol=1e-5)
    plain.image.sum().backward()


def test_several_views_take_less_time_than_single_calls() -> None:
    """Printed; what is asserted is that a batch is no slower than its views one by one."""
    field = gaussians(3, False, 100_000)
    for value in field.parameters.values():
        value.requires_grad_()
    background, rasterizer = torch.zeros(3, device="cuda"), GsplatRasterizer(direct=True, own_radii=True)
    cameras = [moved(0.05 * index).resized(400, 267) for index in range(8)]

    def milliseconds(views: int, once: Callable[[], Tensor]) -> float:
        for count in (5, 30):  # warm, then measured
            torch.cuda.synchronize()
            start = time.perf_counter()
            for _ in range(count):
                once().sum().backward()
            torch.cuda.synchronize()
        return (time.perf_counter() - start) * 1e3 / 30 / views

    alone = milliseconds(1, lambda: rasterizer(field, cameras[0], background=background).image)
    seconds = {
        views: milliseconds(
            views, lambda n=views: rasterizer.render_batch(field, cameras[:n], background=background).image
        )
        for views in (2, 4, 8)
    }
    print(f"1 view {alone:.3f} ms", {views: f"{took:.3f} ms a view" for views, took in seconds.items()})
    assert seconds[8] < 1.1 * alone


def test_a_run_for_several_views_a_step(tmp_path: Path) -> None:
    """On the GPU, base and residual, base trained along and views gathered: as good as single views, and resumable."""
    scene = ring_scene(train=8, size=(112, 80))
    calm = Densification(start=20, until=600, every=50, reset_every=100_000)
    found = {}
    for views in (1, 4):
        settings = TrainSettings(
            iterations=1200,
            hierarchy="laplacian",
            sh_degree=2,
            joint=0.2,
            views_per_step=str(views),
            densification=calm,
        )
        reference = SceneReference("ring", "full", True, (0.0, 0.0, 0.0), "colmap")
        manifest = Manifest(scene=reference, rasterizer="gsplat", **settings.for_manifest())
        placed = training_rasterizer("gsplat", settings)
        start = time.perf_counter()
        with RunArchive.create(tmp_path / str(views), manifest) as archive:
            Trainer(PreparedRun.of(scene, settings, archive, placed)).run()
        found[views] = archive.history()[-1]["psnr"]
        counts = [record.num_gaussians for record in archive.manifest.records]
        print(f"{views} a step: {found[views]:.2f} dB, {counts} Gaussians, {time.perf_counter() - start:.1f} s")
    assert abs(found[4] - found[1]) < 1.5
