"""Validate rendering by our kernels against the oracle on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.gpu_raster.cameras import CameraCache
from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

LARGEST_DIFFERENCE = 1e-3
"""Largest accepted difference of images and gradients, relative to the largest value; atomics alone make 1e-6."""
MOST_OPAQUE = 4.0
"""Largest opacity logit of the fields: the oracle limits alpha elsewhere than our kernels, which is above this."""


@matches_reference("rendering by `gsplat.rasterization`, which takes longer", LARGEST_DIFFERENCE)
def direct_works(device: torch.device) -> float:
    """Return the largest relative difference of images, gradients and densification statistics.

    An ordinary field is rendered from one camera, a signed one from two cameras together. They are dense enough to hide
    what is behind. All Gaussians are where both rasterizers take the same Jacobian.
    """
    camera = Camera(40, 28, 34.0, 35.0, 20.0, 14.0, torch.eye(4))
    moved = torch.eye(4)
    moved[0, 3], moved[2, 3] = 0.4, 1.0
    other = replace(camera, world_to_camera=moved)
    background = torch.tensor([0.1, 0.2, 0.3])
    generator = torch.Generator().manual_seed(0)
    differences = []
    for signed, degree, cameras in ((False, 3, [camera]), (True, 2, [camera, other])):
        values = _random_parameters(150, generator)
        weights = torch.randn(len(cameras), 3, camera.height, camera.width, generator=generator)
        exact = [value.double().requires_grad_() for value in values]
        expected = _oracles(_field(exact, signed), cameras, background, degree, weights, exact)
        for with_geometry in (True, False):
            leaves = [value.to(device, copy=True).requires_grad_() for value in values]
            on_device = CameraCache().get(cameras, leaves[0])
            arguments = _field(leaves, signed), on_device, background.to(device), degree
            if with_geometry:
                result = direct.render(*arguments, absgrad=True, own_radii=True)
                image = result.image
            else:
                image = direct.render_images(*arguments)
            (image * weights.to(device)).sum().backward()  # type: ignore[no-untyped-call]  # torch's
            results = [image.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]
            if with_geometry:
                assert result.absgrad2d is not None
                assert result.means2d.grad is not None
                results += [result.means2d.grad, result.absgrad2d]
            differences += [
                (one.cpu().view_as(exactly) - exactly).abs() / exactly.abs().max()
                for one, exactly in zip(results, expected, strict=False)
            ]
    return largest(differences)


def _oracles(
    field: GaussianField, cameras: Sequence[Camera], background: Tensor, degree: int, weights: Tensor,
    leaves: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Return images, gradients by leaves and by centres, and sums of absolute ones."""
    oracle = OracleRasterizer(three_sigma_cut=False)
    results = [oracle(field, camera, background=background, sh_degree=degree) for camera in cameras]
    images = torch.stack([result.image for result in results])
    (images * weights).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    by_centres = torch.stack([result.means2d.grad for result in results if result.means2d.grad is not None])
    absolute = torch.stack([result.absgrad2d for result in results if result.absgrad2d is not None])
    return [images.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None), by_centres, absolute]


def _field(parameters: Sequence[Tensor], signed: bool) -> GaussianField:
    means, quaternions, log_scales, logits, sh = parameters
    return GaussianField(means, quaternions, log_scales, logits, sh, signed)


def _random_parameters(count: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Return parameters of `count` Gaussians in front of the camera, in the order of a field's attributes."""
    depths = 3 + 2 * torch.rand(count, 1, generator=generator)
    aside = torch.tensor([0.5, 0.35]) * (2 * torch.rand(count, 2, generator=generator) - 1)
    return (
        torch.cat([aside * depths, depths], 1),
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) * 0.3 - 1.7,
        (torch.randn(count, generator=generator) + 1).clamp_max(MOST_OPAQUE),
        torch.randn(count, 16, 3, generator=generator) * 0.3,
    )
