"""One view, or several of one size, by gsplat's kernels, called directly.

`gsplat.rasterization` is a chain of five differentiable functions with everything between them in PyTorch: some
seventy launches and twenty autograd nodes in a training iteration. Up to a megapixel that is what an iteration takes,
whatever is rendered. Here a render is one autograd node: gsplat's projection, tiles and blending as they are, and the
rest in three kernels of `gsplat_triton`. Several views take as many launches as one.
"""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.reference_raster.oracle import NEAR_DEPTH, PIXEL_VARIANCE

logger = logging.getLogger(__name__)

KNOWN_RELEASES = "1.5."
"""Releases of gsplat whose compiled functions take what is given to them here."""
TILE = 16
FAR_PLANE = 1e10
LARGEST_DIFFERENCE = 1e-3
"""From `gsplat.rasterization`, of image and gradients, relative to the largest value; atomics alone make 1e-6."""


class Shot(NamedTuple):
    """c cameras on the device that renders: poses (c, 4, 4), intrinsics (c, 3, 3), centres (c, 3), the images' size."""

    pose: Tensor
    intrinsics: Tensor
    centre: Tensor
    width: int
    height: int


class Seen(NamedTuple):
    """What gsplat found of a field's Gaussians on the way to images; n Gaussians, c cameras."""

    radii: Tensor  # (c, n, 2)
    means2d: Tensor  # (c, n, 2)
    depths: Tensor  # (c, n)
    conics: Tensor  # (c, n, 3)
    colors: Tensor  # (c, n, 3)
    scales: Tensor  # (n, 3)
    opacities: Tensor  # (c, n), the same for every camera
    offsets: Tensor  # (c, tiles down, tiles across)
    flat: Tensor  # Gaussians of pairs with tiles
    alphas: Tensor  # (c, h, w, 1)
    last: Tensor  # (c, h, w)
    shown_radii: Tensor  # (c, n) the larger of both, 0 where culled
    centres: Tensor  # (c, n, 2) as `RenderResult` has them


Listeners = list[weakref.ref[Tensor]]
"""Where a backward pass leaves its gradients by centres and their absolute values, (n, 2) or (c, n, 2) each.

Weakly: who has not kept the result of a render is told nothing, and nothing holds itself.
"""


def render(
    gaussians: GaussianField, shot: Shot, background: Tensor, degree: int, *, describes: bool, absgrad: bool = False
) -> tuple[Tensor, Seen, Listeners]:
    """A field of at least one Gaussian, float32 on the device.

    Args:
        gaussians: on the cameras' device.
        shot: one camera or several.
        background: (3,) on the device.
        degree: highest SH degree to evaluate.
        describes: fill in `Seen.shown_radii` and `Seen.centres`, which are empty otherwise.
        absgrad: work out absolute gradients of the centres in the backward pass.

    Returns:
        The image (3, h, w), or (c, 3, h, w) of several cameras, what was seen, and a list that takes the tensors to
        leave gradients in.
    """
    of, background = gaussians, _of_every(background, len(shot.pose))
    parameters = of.means, of.quaternions, of.log_scales, of.opacity_logits, of.sh
    means, quaternions, log_scales, logits, sh = (value.contiguous() for value in parameters)  # kernels count on it
    listeners: Listeners = []
    with torch.cuda.device(means.device):  # Triton launches on the current one
        if torch.is_grad_enabled() and any(value.requires_grad for value in parameters):
            box: list[Seen] = []
            options = shot, background, degree, of.signed, describes, absgrad, box, listeners
            image: Tensor = _View.apply(means, quaternions, log_scales, logits, sh, *options)  # type: ignore[no-untyped-call]  # torch's
            return image, box[0], listeners
        images, seen = _forward(
            means, quaternions, log_scales, logits, sh, shot, background, degree, of.signed, describes
        )
    return _planes(images), seen, listeners


def _planes(images: Tensor) -> Tensor:
    """(c, h, w, 3) as (c, 3, h, w), and of one camera as (3, h, w), without copying."""
    return images[0].permute(2, 0, 1) if len(images) == 1 else images.permute(0, 3, 1, 2)


class _View(torch.autograd.Function):
    """(field, cameras) -> image (3, h, w), or images (c, 3, h, w) of several; contiguous."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor,
        shot: Shot, background: Tensor, degree: int, signed: bool, describes: bool, absgrad: bool,
        box: list[Seen], listeners: Listeners,
    ) -> Tensor:  # fmt: skip
        images, seen = _forward(means, quaternions, log_scales, logits, sh, shot, background, degree, signed, describes)
        ctx.save_for_backward(means, quaternions, sh, background, *shot[:3], *seen)
        ctx.size, ctx.degree, ctx.signed, ctx.absgrad = shot[3:], degree, signed, absgrad
        ctx.listeners = listeners
        box.append(seen)
        return _planes(images).contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_image: Tensor) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.rasterizers.gsplat_triton import finish_gradients

        means, quaternions, sh, background, pose, intrinsics, centre, *rest = ctx.saved_tensors
        seen, (width, height), compiled = Seen(*rest), ctx.size, compiled_functions()
        several = len(pose) > 1
        by_images = by_image.movedim(-3, -1).contiguous().view(*seen.alphas.shape[:-1], 3)
        by_absolute, by_means2d, by_conics, by_colors, by_opacities = compiled.rasterize_to_pixels_3dgs_bwd(
            seen.means2d, seen.conics, seen.colors, seen.opacities, background, None,
            width, height, TILE, seen.offsets, seen.flat, seen.alphas, seen.last,
            by_images, _zeros(seen.alphas.shape, means.device), ctx.absgrad,
        )  # fmt: skip
        by_means, _, by_quaternions, by_scales, _ = compiled.projection_ewa_3dgs_fused_bwd(
            means, None, quaternions, seen.scales, pose, intrinsics, width, height, PIXEL_VARIANCE,
            compiled.CameraModelType.PINHOLE, seen.radii, seen.conics, None,
            by_means2d, _zeros(seen.depths.shape, means.device), by_conics, None, False,
        )  # fmt: skip
        by_sh = finish_gradients(
            means, centre, sh, ctx.degree, ctx.signed, seen.radii, seen.colors, seen.scales, seen.opacities,
            by_colors, by_means, by_scales, by_opacities,
        )  # fmt: skip
        if not several:
            by_means2d, by_absolute = by_means2d[0], by_absolute[0] if ctx.absgrad else None
        _tell(ctx.listeners, by_means2d, by_absolute if ctx.absgrad else None)
        return by_means, by_quaternions, by_scales, by_opacities[0], by_sh, *[None] * 8


def _forward(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor,
    shot: Shot, background: Tensor, degree: int, signed: bool, describes: bool,
) -> tuple[Tensor, Seen]:  # fmt: skip
    """Images (c, h, w, 3), and what is known of the Gaussians; the background is that of every camera, (c, 3)."""
    from lapgs_plugin.rasterizers.gsplat_triton import activated, colors_of_shown

    size, count = (shot.width, shot.height), len(shot.pose)
    scales, opacities = activated(log_scales, logits)
    radii, means2d, depths, conics = project(means, quaternions, scales, opacities, shot.pose, shot.intrinsics, size)
    colors, shown_radii, centres = colors_of_shown(
        means, shot.centre, sh, degree, signed, radii, means2d if describes else None
    )
    projected, opacities = (radii, means2d, depths, conics), _of_every(opacities, count)
    images, alphas, last, offsets, flat = blend(projected, colors, opacities, background, size, count)
    seen = Seen(
        radii, means2d, depths, conics, colors, scales, opacities, offsets, flat, alphas, last, shown_radii, centres
    )
    return images, seen


def _of_every(values: Tensor, cameras: int) -> Tensor:
    """(k,) of each camera, (c, k) as kernels read them."""
    return values.expand(cameras, -1).contiguous()  # nothing is copied for one


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, pose: Tensor, intrinsics: Tensor,
    size: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Radii (c, n, 2), centres (c, n, 2), depths (c, n) and conics (c, n, 3) of activated Gaussians, at least one.

    Args:
        pose, intrinsics: (c, 4, 4) and (c, 3, 3).
        size: (width, height) of the image.
    """
    compiled = compiled_functions()
    radii, means2d, depths, conics, _ = compiled.projection_ewa_3dgs_fused_fwd(
        means, None, quaternions, scales, opacities, pose, intrinsics, *size,
        PIXEL_VARIANCE, NEAR_DEPTH, FAR_PLANE, 0.0, False, compiled.CameraModelType.PINHOLE,
    )  # fmt: skip
    return radii, means2d, depths, conics


def blend(
    projected: Sequence[Tensor], colors: Tensor, opacities: Tensor, background: Tensor | None, size: tuple[int, int],
    count: int = 1, of_image: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Sort Gaussians into tiles and blend them. Waits for the GPU, to learn how many pairs with tiles there are.

    Args:
        projected: what `project` gives; or of several images in one list, without the leading dimension.
        colors, opacities: (count, n, 3) and (count, n), or (n, 3) and (n,) in such a list.
        background: (count, 3), None for black.
        size: (width, height) of all images.
        count, of_image: how many images there are, and in a list the number (n,) of each Gaussian's.

    Returns:
        Images (count, h, w, 3), opacities (count, h, w, 1), the last Gaussian of each pixel, the first pair of each
        tile, and the Gaussians of pairs.
    """
    compiled = compiled_functions()
    radii, means2d, depths, conics = projected
    across, down = (math.ceil(side / TILE) for side in size)
    # gsplat asks for the number of each Gaussian, too, and makes no use of it.
    _, pairs, flat = compiled.intersect_tile(
        means2d, radii, depths, of_image, of_image, count, TILE, across, down, True, False
    )
    offsets = compiled.intersect_offset(pairs, count, across, down)
    images, alphas, last = compiled.rasterize_to_pixels_3dgs_fwd(
        means2d, conics, colors, opacities, background, None, *size, TILE, offsets, flat
    )
    return images, alphas, last, offsets, flat


def _tell(listeners: Listeners, by_centre: Tensor, by_absolute: Tensor | None) -> None:
    """Leave the gradients by centres, (n, 2) or (c, n, 2), where a `RenderResult` has them."""
    held = [listener() for listener in listeners]
    if held and held[0] is not None:
        held[0].grad = by_centre
    if by_absolute is not None and len(held) > 1 and held[1] is not None:
        held[1].copy_(by_absolute)


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # kept for others, who may need gradients
def _zeros(shape: torch.Size, device: torch.device) -> Tensor:
    """Gradients of what no loss looks at; nobody writes to them."""
    return torch.zeros(shape, device=device)


@lru_cache(maxsize=1)
def compiled_functions() -> Any:
    """gsplat's compiled functions."""
    from gsplat.cuda._backend import _C

    return _C


@lru_cache(maxsize=1)
def works() -> bool:
    """Whether gsplat and Triton on this machine are such that this gives what `gsplat.rasterization` gives."""
    import gsplat

    if not gsplat.__version__.startswith(KNOWN_RELEASES):
        logger.info("gsplat %s: rendering by its own `rasterization`, which takes more launches", gsplat.__version__)
        return False
    return matches_reference(
        "rendering by `gsplat.rasterization`", lambda: _largest_difference(torch.device("cuda")), LARGEST_DIFFERENCE
    )


def _largest_difference(device: torch.device) -> float:
    """From gsplat's way to render, relative to the largest value, of images, gradients and what densification sees.

    Of one camera, and of two at once.
    """
    from lapgs_plugin.fields.camera import Camera
    from lapgs_plugin.rasterizers.gsplat import GsplatRasterizer

    generator = torch.Generator().manual_seed(0)
    count = 500
    camera = Camera(70, 45, 60.0, 61.0, 34.0, 23.0, torch.eye(4))
    aside = torch.eye(4)
    aside[0, 3], aside[2, 3] = 0.4, 1.0
    other = replace(camera, world_to_camera=aside)
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    differences = []
    for signed, degree in ((False, 3), (True, 2)):
        means = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0])
        values = (
            means,
            torch.randn(count, 4, generator=generator),
            torch.randn(count, 3, generator=generator) * 0.3 - 2.5,
            torch.randn(count, generator=generator),
            torch.randn(count, 16, 3, generator=generator) * 0.3,
        )
        weights = torch.randn(2, 3, camera.height, camera.width, generator=generator).to(device)
        found = []
        for direct in (False, True):
            leaves = [value.to(device).requires_grad_() for value in values]
            gaussians = GaussianField(leaves[0], leaves[1], leaves[2], leaves[3], leaves[4], signed)
            rasterizer = GsplatRasterizer(device, own_radii=True, direct=direct)
            if signed:
                result = rasterizer.render_batch(gaussians, [camera, other], background=background, sh_degree=degree)
            else:
                result = rasterizer(gaussians, camera, background=background, sh_degree=degree)
            (result.image * weights[: len(weights) if signed else 1]).sum().backward()  # type: ignore[no-untyped-call]  # torch's
            assert result.absgrad2d is not None
            assert result.means2d.grad is not None
            shown = (result.radii > 0).float()
            found.append(
                [result.image, shown, result.means2d, result.means2d.grad, result.absgrad2d, *(x.grad for x in leaves)]
            )
        differences += [(one - theirs).abs() / theirs.abs().max() for theirs, one in zip(*found, strict=True)]
    return largest(differences)
