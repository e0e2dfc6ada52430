"""Validate direct calls of gsplat's kernels against `gsplat.rasterization` on this machine."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.rasterizers.gsplat.blend_gradients import records_of
from lapgs_plugin.rasterizers.gsplat.cameras import CameraCache
from lapgs_plugin.rasterizers.gsplat.stock import StockRasterization

KNOWN_RELEASES = "1.5."
"""Releases of gsplat whose compiled functions have the signatures that `direct` uses."""
LARGEST_DIFFERENCE = 1e-3
"""Largest accepted difference of images and gradients, relative to the largest value; atomics alone make 1e-6."""


@matches_reference("rendering by `gsplat.rasterization`, which takes more launches", LARGEST_DIFFERENCE)
def direct_works(device: torch.device) -> float:
    """Return the largest relative difference of images, gradients and densification statistics.

    An ordinary field is rendered from one camera, a signed one from two cameras together.

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
    background, stock = torch.tensor([0.1, 0.2, 0.3], device=device), StockRasterization(own_radii=True)
    generator = torch.Generator().manual_seed(0)
    differences = []
    for signed, degree, cameras in ((False, 3, [camera]), (True, 2, [camera, other])):
        values = _random_parameters(500, generator)
        weights = torch.randn(len(cameras), 3, camera.height, camera.width, generator=generator).to(device)
        found = []
        for is_direct in (False, True):
            leaves = [value.to(device).requires_grad_() for value in values]
            field = GaussianField(leaves[0], leaves[1], leaves[2], leaves[3], leaves[4], signed)
            if is_direct:
                on_device = CameraCache().get(cameras, field.means)
                result = direct.render(field, on_device, background, degree, absgrad=True, own_radii=True)
            else:
                result = stock.render(field, cameras, background, degree, absgrad=True)
            (result.image * weights).sum().backward()  # type: ignore[no-untyped-call]  # torch's
            assert result.absgrad2d is not None
            assert result.means2d.grad is not None
            visible = (result.radii > 0).float()
            by_screen = [result.means2d, result.means2d.grad, result.absgrad2d]
            found.append([result.image, visible, *by_screen, *(leaf.grad for leaf in leaves)])
        differences += [(one - theirs).abs() / theirs.abs().max() for theirs, one in zip(*found, strict=True)]
    return largest(differences)


@matches_reference("rendering the fields of a view together with gsplat's functions, which takes longer", 1e-4)
def stacking_works(device: torch.device) -> float:
    """Return the largest difference of the numbers that one field writes to a stack; values are about 1."""
    from lapgs_plugin.rasterizers.gsplat.kernels import write_to_stack

    means, rotations, scales, depths, sh = (
        value.to(device) for value in _random_parameters(300, torch.Generator().manual_seed(0))
    )
    centre, radii = torch.tensor([0.3, -0.2, 0.5], device=device), torch.ones(300, 2, dtype=torch.int32, device=device)
    projected = radii, rotations[:, :2].contiguous(), depths, scales
    opacities, degree = depths.sigmoid(), math.isqrt(sh.shape[1]) - 1
    colors = sh_to_color(sh, torch.nn.functional.normalize(means - centre, dim=-1), degree, signed=False)
    records = records_of(projected[1], scales, colors, opacities)
    stacked = [torch.zeros_like(part) for part in (*projected[:3], records)]
    write_to_stack(means, centre, sh, opacities, False, projected, stacked, 0)
    expected = *projected[:3], records
    return largest((one - other).abs().float() for one, other in zip(stacked, expected, strict=True))


def _random_parameters(count: int, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """Return parameters of `count` Gaussians in front of the camera, in the order of a field's attributes."""
    return (
        torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0]),
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) * 0.3 - 2.5,
        torch.randn(count, generator=generator),
        torch.randn(count, 16, 3, generator=generator) * 0.3,
    )
