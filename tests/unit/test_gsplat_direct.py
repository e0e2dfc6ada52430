"""gsplat's kernels called directly, against `gsplat.rasterization`; on a GPU alone."""

from __future__ import annotations

import gc

import pytest
import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers import gsplat_direct
from lapgs_plugin.rasterizers.gsplat import GsplatRasterizer

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


def test_it_is_used() -> None:
    assert gsplat_direct.works()


def test_it_is_used_whatever_mode_it_is_first_asked_in() -> None:
    gsplat_direct.works.cache_clear()
    with torch.inference_mode():
        assert gsplat_direct.works()


@pytest.mark.parametrize("own_radii", [False, True])
@pytest.mark.parametrize(("degree", "active", "signed"), [(3, 3, False), (3, 1, True), (0, 0, False), (2, 2, True)])
def test_images_gradients_and_what_densification_sees(degree: int, active: int, signed: bool, own_radii: bool) -> None:
    background = torch.tensor([0.1, 0.2, 0.3], device="cuda")
    weights = torch.randn(3, CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(5)).cuda()
    found = []
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
        found.append([result.image.detach(), alone, *seen, *gradients])
    for one, other in zip(*found, strict=True):
        assert one is not None
        assert other is not None
        # Sums in another order, in both; an H200 stays within this.
        torch.testing.assert_close(one, other, rtol=0, atol=2e-4 * float(other.abs().max()) + 1e-9)


def test_parameters_may_lie_in_any_order() -> None:
    field = gaussians(2, True)
    turned = field.with_parameters(
        {name: value.movedim(0, -1).contiguous().movedim(-1, 0) for name, value in field.parameters.items()}
    )
    assert not turned.sh.is_contiguous()
    black = torch.zeros(3, device="cuda")
    with torch.no_grad():
        images = [GsplatRasterizer(direct=True).render_image(one, CAMERA, background=black) for one in (field, turned)]
    assert torch.equal(*images)


def test_a_training_view_is_sent_once_and_forgotten_with_its_camera() -> None:
    rasterizer, field, black = GsplatRasterizer(), gaussians(1, True), torch.zeros(3, device="cuda")
    camera = CAMERA.resized(40, 30)
    with torch.no_grad():
        for _ in range(3):
            rasterizer.render_image(field, camera, background=black)
    assert len(rasterizer._shots._sent) == 1
    del camera
    gc.collect()
    assert not rasterizer._shots._sent


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
