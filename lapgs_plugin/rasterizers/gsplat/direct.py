"""Render one view, or several, by our kernels.

`gsplat.rasterization` is a chain of five differentiable functions with PyTorch operations between them. For small
images its launches take more time than its kernels. Here a render is one autograd node: our kernels project
(`kernels`), sort Gaussians into tiles (`tiles`) and blend (`blend_kernels`). Several views take as many launches as
one. Of gsplat only its sorting is called, and only where it is compiled already.
"""

from __future__ import annotations

import weakref
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.records import Parameters, Projected
from lapgs_plugin.gpu_raster.tiles import blend_in_tiles
from lapgs_plugin.rasterizers.gsplat.stock import is_differentiated, three_sigma_radii

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
    image, seen, targets = _render(field, cameras, background, degree, with_geometry=True, absgrad=absgrad)
    radii, means2d, conics = seen.visible_radii, seen.centres, seen.records[..., 2:5]
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
    return _render(field, cameras, background, degree, with_geometry=False, absgrad=False)[0]


def _render(
    field: GaussianField, cameras: DeviceCameras, background: Tensor, degree: int, *, with_geometry: bool, absgrad: bool
) -> tuple[Tensor, Projected, GradientTargets]:
    """Render, and return a list to which the tensors that take gradients can be added.

    Args:
        field, cameras, background, degree, absgrad: as `render` takes them.
        with_geometry: fill in visible radii and centres, which are empty otherwise.
    """
    background = background.to(field.means).contiguous()
    parameters = Parameters.of(field)
    targets: GradientTargets = []
    if is_differentiated(field):
        box: list[Projected] = []
        options = cameras, background, degree, field.signed, with_geometry, absgrad, box, targets
        image: Tensor = _Render.apply(*parameters, *options)  # type: ignore[no-untyped-call]  # torch's
        return image, box[0], targets
    seen, _, (images, *_) = forward(parameters, cameras, background, degree, field.signed, with_geometry)
    return _channels_first(images), seen, targets


def forward(
    parameters: Parameters, cameras: DeviceCameras, background: Tensor, degree: int, signed: bool, with_geometry: bool
) -> tuple[Projected, tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Return Gaussians as the cameras see them; their tiles, sorted; and what `blend_forward` makes of them.

    Args:
        background: (3,).
        parameters, cameras, degree, signed, with_geometry: as `kernels.project` takes them.
    """
    from lapgs_plugin.gpu_raster.kernels import project

    seen = project(parameters, cameras, degree, signed, with_geometry)
    size = cameras.width, cameras.height
    return seen, *blend_in_tiles(seen, background, size, len(cameras.poses))


def _channels_first(images: Tensor) -> Tensor:
    """View (c, h, w, 3) as (c, 3, h, w), or (3, h, w) for one camera."""
    return images[0].permute(2, 0, 1) if len(images) == 1 else images.permute(0, 3, 1, 2)


class _Render(torch.autograd.Function):
    """Map (field, cameras) to an image (3, h, w), or images (c, 3, h, w), with interleaved colours in memory."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor,
        cameras: DeviceCameras, background: Tensor, degree: int, signed: bool, with_geometry: bool, absgrad: bool,
        box: list[Projected], targets: GradientTargets,
    ) -> Tensor:  # fmt: skip
        parameters = Parameters(means, quaternions, log_scales, logits, sh)
        seen, tiles, blended = forward(parameters, cameras, background, degree, signed, with_geometry)
        ctx.save_for_backward(*parameters, *cameras[:3], seen.radii, seen.records, *tiles, *blended)
        ctx.sizes, ctx.degree, ctx.signed = cameras[3:], degree, signed
        ctx.absgrad, ctx.targets = absgrad, targets
        box.append(seen)
        return _channels_first(blended[0])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_image: Tensor) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.gpu_raster.blend_kernels import blend_backward
        from lapgs_plugin.gpu_raster.kernels import project_backward

        saved = ctx.saved_tensors
        parameters, cameras = Parameters(*saved[:5]), DeviceCameras(*saved[5:8], *ctx.sizes)
        radii, records, offsets, flat, images, counts, words = saved[8:]
        by_images = by_image.movedim(-3, -1).contiguous().view(images.shape)
        by_records, others = blend_backward(records, offsets, flat, images, counts, words, by_images, ctx.absgrad)
        by = project_backward(parameters, cameras, ctx.degree, ctx.signed, radii, records, by_records, others)
        _write_gradients(ctx.targets, by_records[..., 4:6], others[..., 1:])
        return *by, *[None] * 8


def _write_gradients(targets: GradientTargets, by_centre: Tensor, by_absolute: Tensor) -> None:
    """Write gradients by centres, (c, n, 2), to the tensors of a `RenderResult`, which has no c for one camera."""
    held = [target() for target in targets]
    if held and held[0] is not None:
        held[0].grad = by_centre.reshape(held[0].shape).contiguous()
    if len(held) > 1 and held[1] is not None:
        held[1].copy_(by_absolute.reshape(held[1].shape))
