"""Render one view, or several of one size, by calling gsplat's compiled kernels directly.

`gsplat.rasterization` is a chain of five differentiable functions with PyTorch operations between them. For small
images its launches take more time than its kernels. Here a render is one autograd node: gsplat's kernels for
projection, tiles and blending, and three of our own (`kernels`) for the rest. Several views take as many launches as
one.
"""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.rasterizers.gsplat import bindings
from lapgs_plugin.rasterizers.gsplat.blend_gradients import (
    Blended,
    ToBlend,
    blend,
    gradients,
    our_kernels_blend,
)
from lapgs_plugin.rasterizers.gsplat.cameras import DeviceCameras
from lapgs_plugin.rasterizers.gsplat.stock import is_differentiated, three_sigma_radii
from lapgs_plugin.reference_raster.layout import PIXEL_VARIANCE


class Intermediates(NamedTuple):
    """Hold the results that the backward pass of a render needs; n Gaussians, c cameras."""

    given: ToBlend
    blended: Blended
    radii: Tensor  # (c, n, 2)
    scales: Tensor  # (n, 3)
    visible_radii: Tensor  # (c, n) the larger of both, 0 where culled
    centres: Tensor  # (c, n, 2) as in `RenderResult.means2d`


GradientTargets = list[weakref.ref[Tensor]]
"""Tensors to which a backward pass writes its gradients by centres and their absolute values, (n, 2) or (c, n, 2) each.

References are weak, so that nothing is written for a result that was dropped, and no reference cycle arises.
"""


def render(
    field: GaussianField, cameras: DeviceCameras, background: Tensor, degree: int, *, absgrad: bool, own_radii: bool
) -> RenderResult:
    """Render a field of at least one Gaussian, float32 on the device.

    Args:
        field: on the cameras' device.
        cameras: one or several; for several, tensors of the result have a leading dimension.
        background: (3,).
        degree: highest SH degree to evaluate.
        absgrad: fill in `RenderResult.absgrad2d` in the backward pass.
        own_radii: as in `GsplatRasterizer`.
    """
    differentiated = is_differentiated(field)
    absgrad = absgrad and differentiated
    image, found, targets = _render(field, cameras, background, degree, describes=True, absgrad=absgrad)
    radii, means2d, conics = found.visible_radii, found.centres, found.given.conics
    if len(cameras.poses) == 1:
        radii, means2d, conics = radii[0], means2d[0], conics[0]
    with torch.no_grad():
        if not own_radii:
            radii = torch.where(radii > 0, three_sigma_radii(conics), 0).to(torch.int32)
    means2d.requires_grad_(differentiated)
    absgrad2d = means2d.new_zeros(means2d.shape) if absgrad else None
    targets += [weakref.ref(tensor) for tensor in (means2d, absgrad2d) if tensor is not None]
    return RenderResult(image, None, radii, means2d, absgrad2d)


def render_images(field: GaussianField, cameras: DeviceCameras, background: Tensor, degree: int) -> Tensor:
    """Render images alone, (3, h, w) or (c, 3, h, w) of several; arguments as `render` takes them."""
    return _render(field, cameras, background, degree, describes=False, absgrad=False)[0]


def _render(
    field: GaussianField, cameras: DeviceCameras, background: Tensor, degree: int, *, describes: bool, absgrad: bool
) -> tuple[Tensor, Intermediates, GradientTargets]:
    """Render, and return a list to which the tensors that take gradients can be added.

    Args:
        field, cameras, background, degree, absgrad: as `render` takes them.
        describes: fill in visible radii and centres, which are empty otherwise.
    """
    background = _for_each_camera(background.to(field.means), len(cameras.poses))
    parameters = field.means, field.quaternions, field.log_scales, field.opacity_logits, field.sh
    means, quaternions, log_scales, logits, sh = (value.contiguous() for value in parameters)  # kernels rely on it
    targets: GradientTargets = []
    with torch.cuda.device(means.device):  # Triton launches on the current device
        if is_differentiated(field):
            box: list[Intermediates] = []
            options = cameras, background, degree, field.signed, describes, absgrad, box, targets
            image: Tensor = _Render.apply(means, quaternions, log_scales, logits, sh, *options)  # type: ignore[no-untyped-call]  # torch's
            return image, box[0], targets
        ours = our_kernels_blend(means, len(cameras.poses) * cameras.width * cameras.height)
        found = forward(
            means, quaternions, log_scales, logits, sh, cameras, background, degree, field.signed, describes, ours
        )
    return _channels_first(found.blended.images), found, targets


def _channels_first(images: Tensor) -> Tensor:
    """View (c, h, w, 3) as (c, 3, h, w), or (3, h, w) for one camera."""
    return images[0].permute(2, 0, 1) if len(images) == 1 else images.permute(0, 3, 1, 2)


class _Render(torch.autograd.Function):
    """Map (field, cameras) to an image (3, h, w), or images (c, 3, h, w), with interleaved colours in memory."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor,
        cameras: DeviceCameras, background: Tensor, degree: int, signed: bool, describes: bool, absgrad: bool,
        box: list[Intermediates], targets: GradientTargets,
    ) -> Tensor:  # fmt: skip
        ours = our_kernels_blend(means, len(cameras.poses) * cameras.width * cameras.height)
        found = forward(
            means, quaternions, log_scales, logits, sh, cameras, background, degree, signed, describes, ours
        )
        ctx.save_for_backward(means, quaternions, sh, *cameras[:3], *found.given, *found.blended, *found[2:])
        ctx.size, ctx.degree, ctx.signed, ctx.absgrad = cameras[3:], degree, signed, absgrad
        ctx.targets = targets
        box.append(found)
        return _channels_first(found.blended.images)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_image: Tensor) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.rasterizers.gsplat.kernels import finish_gradients

        means, quaternions, sh, poses, intrinsics, centres, *rest = ctx.saved_tensors
        given, blended = ToBlend(*rest[:8]), Blended(*rest[8:12])
        found, (width, height) = Intermediates(given, blended, *rest[12:]), ctx.size
        by_images = by_image.movedim(-3, -1).view(blended.images.shape)
        by_absolute: Tensor | None
        by_absolute, by_means2d, by_conics, by_colors, by_opacities = gradients(given, blended, by_images, ctx.absgrad)
        compiled = bindings.compiled_functions()
        by_means, _, by_quaternions, by_scales, _ = compiled.projection_ewa_3dgs_fused_bwd(
            means, None, quaternions, found.scales, poses, intrinsics, width, height, PIXEL_VARIANCE,
            compiled.CameraModelType.PINHOLE, found.radii, given.conics, None,
            by_means2d, bindings.zeros(found.radii.shape[:2], means.device), by_conics, None, False,
        )  # fmt: skip
        by_sh, by_logits = finish_gradients(
            means, centres, sh, ctx.degree, ctx.signed, found.radii, given.colors, found.scales, given.opacities[0],
            by_colors, by_means, by_scales, by_opacities,
        )  # fmt: skip
        by_absolute = by_absolute if ctx.absgrad else None
        if len(poses) == 1:
            by_means2d, by_absolute = by_means2d[0], None if by_absolute is None else by_absolute[0]
        _write_gradients(ctx.targets, by_means2d, by_absolute)
        return by_means, by_quaternions, by_scales, by_logits, by_sh, *[None] * 8


def forward(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor,
    cameras: DeviceCameras, background: Tensor, degree: int, signed: bool, describes: bool, ours: bool,
) -> Intermediates:  # fmt: skip
    """Render; `background` is (c, 3), and `ours` says whether our kernels blend."""
    from lapgs_plugin.rasterizers.gsplat.kernels import activate, visible_colors

    size, count = (cameras.width, cameras.height), len(cameras.poses)
    scales, opacities = activate(log_scales, logits)
    projected = bindings.project(means, quaternions, scales, opacities, cameras.poses, cameras.intrinsics, size)
    radii, means2d, _, conics = projected
    colors, visible_radii, centres, records = visible_colors(
        means, cameras.centres, sh, degree, signed, radii, describes, (means2d, conics, opacities), ours
    )
    opacities = _for_each_camera(opacities, 1 if ours else count)
    tiles = bindings.sort_into_tiles(projected, size, count)
    means2d = records[..., :2] if ours else means2d  # whatever is kept for the backward pass takes memory
    given = ToBlend(means2d, conics, colors, opacities, background, *tiles, records)
    return Intermediates(given, blend(given, size), radii, scales, visible_radii, centres)


def _for_each_camera(values: Tensor, cameras: int) -> Tensor:
    """Repeat (k,) to contiguous (c, k), without a copy for one camera."""
    return values.expand(cameras, -1).contiguous()


def _write_gradients(targets: GradientTargets, by_centre: Tensor, by_absolute: Tensor | None) -> None:
    """Write the gradients by centres, (n, 2) or (c, n, 2), to the tensors of a `RenderResult`."""
    held = [target() for target in targets]
    if held and held[0] is not None:
        held[0].grad = by_centre
    if by_absolute is not None and len(held) > 1 and held[1] is not None:
        held[1].copy_(by_absolute)
