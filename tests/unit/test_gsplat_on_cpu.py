"""gsplat's functions on the CPU, against gsplat's own PyTorch code and the rasterizer that they are made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gsplat
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.reference_raster import gsplat as on_cpu
from tests.unit.test_rasterizers import WithoutCuda, faint


def render(module: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any], dict[str, Tensor]]:
    """Render the faint scene with `module`'s functions: image, alpha, info and gradients by name."""
    case = faint(False).with_leaves()
    field, camera = case.field, case.camera
    colors = module.spherical_harmonics(field.sh_degree, field.means - camera.position, field.sh)
    image, alpha, info = module.rasterization(
        field.means, field.quaternions, field.log_scales.exp(), field.opacity_logits.sigmoid(),
        (colors + 0.5).clamp_min(0) if "sh_degree" not in options else field.sh,
        camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height, **options,
    )  # fmt: skip
    info["means2d"].retain_grad()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
    (image * weights + 0.3 * alpha).sum().backward()
    return image, alpha, info, {**{k: v.grad for k, v in field.parameters.items()}, "means2d": info["means2d"].grad}


def test_the_stand_in_is_gsplat_where_their_semantics_agree() -> None:
    options = {"near_plane": 0.2, "eps2d": 0.3, "backgrounds": torch.tensor([[0.1, 0.2, 0.3]]), "absgrad": True}
    image, alpha, info, gradients = render(on_cpu, **options)
    their_image, their_alpha, their_info, their_gradients = render(WithoutCuda(), **options)
    # Rounding alone; worst seen 1e-6 for images, 4e-6 of the norm for gradients.
    torch.testing.assert_close(image, their_image, rtol=0, atol=1e-5)
    torch.testing.assert_close(alpha, their_alpha, rtol=0, atol=1e-5)
    for name, gradient in gradients.items():
        assert (gradient - their_gradients[name].nan_to_num()).norm() < 1e-4 * gradient.norm(), name
    assert info["radii"].shape == their_info["radii"].shape
    assert info["means2d"].absgrad.shape == their_info["means2d"].absgrad.shape
    assert (info["means2d"].absgrad >= info["means2d"].grad.abs() - 1e-4).all()


def test_sh_and_signed_colours_are_those_of_the_rasterizer_beneath() -> None:
    case = faint(False)
    image, *_ = render(on_cpu, sh_degree=1, packed=False)
    expected = CpuRasterizer()(case.field, case.camera, background=torch.zeros(3), sh_degree=1).image
    # Scales and opacities pass through exp and log; worst seen 2e-7.
    torch.testing.assert_close(image[0].permute(2, 0, 1), expected, rtol=0, atol=1e-5)
    field = replace(case.field, signed=True)
    raw = on_cpu.spherical_harmonics(2, field.means - case.camera.position, field.sh)
    camera = case.camera
    expected = CpuRasterizer()(field, camera, background=torch.zeros(3), sh_degree=2).image
    assert expected.min() < -0.1
    for colors in (raw, raw[None]):  # of all cameras, of each camera
        image, *_ = on_cpu.rasterization(
            field.means, field.quaternions, field.log_scales.exp(), field.opacity_logits.sigmoid(), colors,
            camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
        )  # fmt: skip
        torch.testing.assert_close(image[0].permute(2, 0, 1), expected, rtol=0, atol=1e-5)  # 4.5e-8 seen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"packed": True}, "packed=True"),
        ({"render_mode": "RGB+D"}, r"render_mode='RGB\+D': expected \('RGB',\)"),
        ({"with_ut": True}, "no such argument"),
    ],
)
def test_what_it_does_not_do_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        render(on_cpu, **options)


def harmonics_of_cameras(degrees_to_use: int, means: Tensor, viewmats: Tensor, coeffs: Tensor) -> Tensor:
    """As gsplat's are called from 1.6.0 on."""
    positions = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]  # (b, 3)
    return torch.stack([on_cpu.spherical_harmonics(degrees_to_use, means - each, coeffs) for each in positions])


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("harmonics", [on_cpu.spherical_harmonics, harmonics_of_cameras])
def test_several_cameras_at_once(harmonics: Any, signed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As gsplat's rasterizer behind our interface asks for them; the images are those of one camera after the other."""
    monkeypatch.setattr(gsplat, "rasterization", on_cpu.rasterization)
    monkeypatch.setattr(gsplat, "spherical_harmonics", harmonics)
    case, background = faint(signed), torch.tensor([0.2, 0.4, 0.6])
    aside = torch.eye(4)
    aside[0, 3] = 0.1
    cameras = [
        case.camera,
        replace(case.camera, world_to_camera=aside.to(case.camera.world_to_camera) @ case.camera.world_to_camera),
    ]
    images = GsplatRasterizer("cpu").render_images(case.field, cameras, background=background)
    assert images.shape == (2, 3, case.camera.height, case.camera.width)
    for image, camera in zip(images, cameras, strict=True):
        expected = CpuRasterizer()(case.field, camera, background=background).image
        torch.testing.assert_close(image, expected, rtol=0, atol=1e-5)  # through exp and log; worst seen 3e-7
    assert (images[0] - images[1]).abs().max() > 0.01
    nobody = case.field.with_parameters({name: value[:0] for name, value in case.field.parameters.items()})
    empty = GsplatRasterizer("cpu").render_images(nobody, cameras, background=background)
    assert torch.equal(empty, background[:, None, None].expand_as(images))


@pytest.mark.parametrize("signed", [False, True])
def test_an_image_alone_has_the_pixels_and_gradients_of_a_call(signed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat, "rasterization", on_cpu.rasterization)
    monkeypatch.setattr(gsplat, "spherical_harmonics", on_cpu.spherical_harmonics)
    rasterizer = GsplatRasterizer("cpu", absgrad=False, own_radii=True)
    background = torch.tensor([0.2, 0.4, 0.6])
    whole, plain = faint(signed).with_leaves(), faint(signed).with_leaves()
    expected = rasterizer(whole.field, whole.camera, background=background, sh_degree=1).image
    image = rasterizer.render_image(plain.field, plain.camera, background=background, sh_degree=1)
    assert torch.equal(image, expected)
    for each in (expected, image):
        each.square().sum().backward()
    for name, value in plain.field.parameters.items():
        assert torch.equal(value.grad, whole.field.parameters[name].grad), name
    nobody = plain.field.with_parameters({name: value[:0] for name, value in plain.field.parameters.items()})
    empty = rasterizer.render_image(nobody, plain.camera, background=background)
    assert torch.equal(empty, background[:, None, None].expand_as(image))


def test_masked_harmonics_are_zero() -> None:
    masks = torch.tensor([True, False])
    values = on_cpu.spherical_harmonics(0, torch.ones(2, 3), torch.ones(2, 1, 3), masks)
    assert (values[0] > 0).all()
    assert (values[1] == 0).all()
