"""Stand in for `gsplat.rasterization` and `gsplat.spherical_harmonics` on the CPU, in loops written against gsplat.

It renders plain colours or SH, no depths, and differentiates one camera a call. Images are those of `CpuRasterizer`:
alpha is capped at 0.99 instead of 0.999, and footprints end at three sigma.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0, sh_to_color
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from lapgs_plugin.reference_raster.layout import TILE

__all__ = ["rasterization", "spherical_harmonics"]

HIGHEST_OPACITY = 1 - 1e-6
"""Opacities are passed on as logits; that of 1 would be infinite."""
CONVENTIONS = {
    "near_plane": (0.01, 0.2),
    "far_plane": (1e10,),
    "radius_clip": (0.0,),
    "eps2d": (0.3,),
    "render_mode": ("RGB",),
    "rasterize_mode": ("classic",),
    "camera_model": ("pinhole",),
    "sparse_grad": (False,),
    "packed": (False,),
}
"""The only values accepted of these arguments. Everything nearer than 0.2 is culled."""


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Return raw SH values, (n, 3), without offset or clamping, zero where `masks` (n,) is False.

    Args:
        degrees_to_use: highest degree, 0 to 3.
        dirs: (n, 3), of any length.
        coeffs: (n, k, 3).
    """
    values = sh_to_color(coeffs, torch.nn.functional.normalize(dirs, dim=-1), degrees_to_use, signed=True)  # (n, 3)
    return values if masks is None else torch.where(masks[:, None], values, 0.0)


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    absgrad: bool = False,
    tile_size: int = TILE,
    **conventions: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render n Gaussians from b cameras.

    Args:
        means: (n, 3).
        quats: (n, 4), wxyz.
        scales: (n, 3), not logarithms.
        opacities: (n,) in [0, 1], not logits.
        colors: (n, 3), or (b, n, 3) of each camera, used as they are; or, with `sh_degree`, SH coefficients (n, k, 3)
            for max(SH + 0.5, 0).
        viewmats: (b, 4, 4) world to camera.
        Ks: (b, 3, 3) intrinsics.
        sh_degree: highest degree to evaluate.
        backgrounds: (b, 3), zero when None.
        absgrad: store absolute gradients of the centres in `info["means2d"].absgrad`.
        conventions: the other arguments of gsplat, with the values in `CONVENTIONS`.

    Returns:
        (b, h, w, 3) colours, (b, h, w, 1) opacities, and for one camera the inputs of densification: "means2d"
        (1, n, 2), which has a gradient after `backward()`, "radii" (1, n, 2), "gaussian_ids", "width", "height",
        "n_cameras".

    Raises:
        UserInputError: an argument has a value that is not supported.
    """
    if len(viewmats) > 1:
        options = {"sh_degree": sh_degree, "absgrad": absgrad, "tile_size": tile_size, **conventions}
        renders = [
            rasterization(
                means, quats, scales, opacities, colors if colors.ndim == 2 or sh_degree is not None else colors[i],
                viewmats[i : i + 1], Ks[i : i + 1], width, height,
                backgrounds=None if backgrounds is None else backgrounds[i : i + 1], **options,
            )
            for i in range(len(viewmats))
        ]  # fmt: skip
        return torch.cat([images for images, _, _ in renders]), torch.cat([alphas for _, alphas, _ in renders]), {}
    for name, value in conventions.items():
        if value not in CONVENTIONS.get(name, ()):
            raise UserInputError(f"{name}={value!r}: expected {CONVENTIONS.get(name, 'no such argument')} on the CPU")
    field = GaussianField(
        means,
        quats,
        scales.log(),
        torch.logit(opacities.clamp_max(HIGHEST_OPACITY)),
        colors.reshape(-1, 1, 3) / SH_C0 if sh_degree is None else colors,
        signed=sh_degree is None,
    )
    k = Ks[0].tolist()
    camera = Camera(width, height, k[0][0], k[1][1], k[0][2], k[1][2], viewmats[0])
    background = means.new_zeros(3) if backgrounds is None else backgrounds[0]
    result = CpuRasterizer()(field, camera, background=background, sh_degree=0 if sh_degree is None else sh_degree)
    assert result.transmittance is not None
    info = {
        "means2d": _with_gradient(result.means2d, result.absgrad2d if absgrad else None),
        "radii": result.radii[None, :, None].expand(1, -1, 2),
        "gaussian_ids": None,
        "width": width,
        "height": height,
        "n_cameras": 1,
        "tile_size": tile_size,
    }
    return result.image.permute(1, 2, 0)[None], 1 - result.transmittance[None, :, :, None], info


def _with_gradient(means2d: Tensor, absgrad2d: Tensor | None) -> Tensor:
    """Return centres (1, n, 2) that get the gradient by `means2d` (n, 2) in the backward pass."""
    centres: Any = means2d.detach()[None].requires_grad_(means2d.requires_grad)
    if means2d.requires_grad:

        def hand_over(source: Tensor) -> None:
            assert source.grad is not None
            centres.grad = source.grad[None]
            if absgrad2d is not None:
                centres.absgrad = absgrad2d[None]

        means2d.register_post_accumulate_grad_hook(hand_over)  # type: ignore[no-untyped-call]  # torch leaves it without types
    screen_means: Tensor = centres
    return screen_means
