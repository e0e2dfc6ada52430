"""Validate rendering by our kernels against `gsplat.rasterization` on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.rasterizers.gsplat.cameras import CameraCache
from lapgs_plugin.rasterizers.gsplat.stock import StockRasterization

KNOWN_RELEASES = "1.5."
"""Releases of gsplat whose compiled functions have the signatures that `direct` uses."""
LARGEST_DIFFERENCE = 1e-3
"""Largest accepted difference of images and gradients, relative to the largest value; atomics alone make 1e-6."""


@matches_reference("rendering by `gsplat.rasterization`, which takes longer", LARGEST_DIFFERENCE)
def direct_works(device: torch.device) -> float:
    """Return the largest relative difference of images, gradients and densification statistics.

    An ordinary field is rendered from one camera, a signed one from two cameras together. They are dense enough to hide
    what is behind.

    Raises:
        RuntimeError: another release of gsplat.
    """
    import gsplat

    if not gsplat.__version__.startswith(KNOWN_RELEASES):
        raise RuntimeError(f"gsplat {gsplat.__version__} is not {KNOWN_RELEASES}x")
    camera = Camera(70, 45, 60.0, 61.0, 34.0, 23.0, torch.eye(4))
    moved = torch.eye(4)
    moved[0, 3], moved[2, 3] = 0.4, 1.0
    other = replace(camera, world_to_camera=moved)
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    generator = torch.Generator().manual_seed(0)
    differences = []
    for signed, degree, cameras in ((False, 3, [camera]), (True, 2, [camera, other])):
        values = _random_parameters(1000, generator)
        weights = torch.randn(len(cameras), 3, camera.height, camera.width, generator=generator).to(device)
        expected: list[Tensor] = []
        for render in (_stock, _described, _alone):
            leaves = [value.to(device).requires_grad_() for value in values]
            field = GaussianField(leaves[0], leaves[1], leaves[2], leaves[3], leaves[4], signed)
            image, result = render(field, cameras, background, degree)
            (image * weights).sum().backward()  # type: ignore[no-untyped-call]  # torch's
            found = [image.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]
            if result is not None:
                assert result.absgrad2d is not None
                assert result.means2d.grad is not None
                visible = (result.radii > 0).float()
                found += [visible, result.means2d.detach(), result.means2d.grad, result.absgrad2d]
            expected = expected or found
            differences += [
                (one - theirs).abs() / theirs.abs().max() for theirs, one in zip(expected, found, strict=False)
            ]
    return largest(differences)


Rendered = tuple[Tensor, RenderResult | None]


def _stock(field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int) -> Rendered:
    result = StockRasterization(own_radii=True).render(field, cameras, background, degree, absgrad=True)
    return result.image, result


def _described(field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int) -> Rendered:
    on_device = CameraCache().get(cameras, field.means)
    result = direct.render(field, on_device, background, degree, absgrad=True, own_radii=True)
    return result.image, result


def _alone(field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int) -> Rendered:
    return direct.render_images(field, CameraCache().get(cameras, field.means), background, degree), None


def _random_parameters(count: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Return parameters of `count` Gaussians in front of the camera, in the order of a field's attributes."""
    return (
        torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0]),
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) * 0.3 - 2.5,
        torch.randn(count, generator=generator),
        torch.randn(count, 16, 3, generator=generator) * 0.3,
    )
