"""Render by our kernels from the arguments of `gsplat.rasterization`, and return what it returns.

A call is one autograd node, for all its cameras. `refusal` says what a call asks for that only gsplat's own can do.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.records import RECORD, TILE, Parameters, Projected, aligned
from lapgs_plugin.gpu_raster.rules import GSPLAT, Numbers
from lapgs_plugin.gpu_raster.tiles import blend_in_tiles
from lapgs_plugin.reference_raster.layout import PIXEL_VARIANCE

RULES = GSPLAT._replace(activated=True, alpha=True)
"""Rules of projection."""
WITH_ALPHAS = RULES._replace(depth=True)
"""Rules of blending's backward pass where the opacity of the image has a gradient."""

PLAIN = "RGB"
"""Mode of rendering colours only."""
DEPTH_ONLY = ("D", "ED")
"""Modes of rendering depths only."""
LEAST_ALPHA = 1e-10
"""Lower bound of the opacity by which "ED" divides, gsplat's."""
NEAREST = 0.01
"""Depth of gsplat's default near plane."""
FARTHEST = 1e10
"""Depth of gsplat's default far plane."""
MOST_COEFFICIENTS = 16
"""SH coefficients of a colour that the kernels can evaluate, those of degree 3."""
MOST_NUMBERS = 2**31 - 1
"""Numbers of all Gaussians that the kernels can count."""

TAKEN = {
    "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "sh_degree", "near_plane",
    "far_plane", "eps2d", "backgrounds", "render_mode", "absgrad", "channel_chunk", "packed",
}  # fmt: skip
"""Arguments of any value; `packed` may only be False, and is True where it is absent."""
ONLY = {
    "radius_clip": 0.0, "tile_size": TILE, "sparse_grad": False, "rasterize_mode": "classic", "camera_model": "pinhole",
    "segmented": False,
}  # fmt: skip
"""Those of one value. All others may be False or None."""
TENSORS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")


def refusal(inputs: Mapping[str, Any]) -> str:
    """Return what of a call our kernels cannot do, as a clause; empty if they can."""
    for name, value in inputs.items():
        if name not in TAKEN and (value != ONLY[name] if name in ONLY else value not in (None, False)):
            return f"{name}={value!r}"
    if inputs.get("packed", True):
        return "packed=True"
    tensors = {name: inputs[name] for name in TENSORS}
    for name, value in tensors.items():
        if value.dtype != torch.float32:
            return f"{name} of {value.dtype}"
    if torch.is_grad_enabled():
        if any(tensors[name].requires_grad for name in ("viewmats", "Ks")):
            return "gradients by cameras"
        if inputs.get("render_mode", PLAIN) != PLAIN and any(value.requires_grad for value in tensors.values()):
            return f"gradients by depths (render_mode={inputs['render_mode']!r})"
    return _refused_size(tensors, inputs.get("sh_degree"))


def _refused_size(tensors: dict[str, Tensor], degree: int | None) -> str:
    means, colors, cameras = tensors["means"], tensors["colors"], len(tensors["viewmats"])
    if means.ndim != 2 or len(means) == 0 or tensors["viewmats"].ndim != 3:
        return f"means {tuple(means.shape)} in views {tuple(tensors['viewmats'].shape)}"
    numbers = RECORD * cameras
    if degree is None:
        if cameras > 1 or colors.shape[-1] != 3:
            return f"colours {tuple(colors.shape)} in {cameras} views"
    elif colors.ndim != 3 or colors.shape[1] > MOST_COEFFICIENTS:
        return f"SH coefficients {tuple(colors.shape)}"
    else:
        numbers = max(numbers, 3 * colors.shape[1])
    return "" if len(means) * numbers <= MOST_NUMBERS else f"{len(means)} Gaussians in {cameras} views"


def rasterization(*, signed: bool = False, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render n Gaussians from c cameras.

    Args:
        signed: whether colours are the raw SH values.
        inputs: arguments of gsplat's function, for which `refusal` is empty.

    Returns:
        Images (c, h, w, channels) as `render_mode` says, opacities (c, h, w, 1), and intermediate results. Of them
        "means2d" (c, n, 2), in pixels, has a gradient after the backward pass, and with `absgrad` also `absgrad`.
    """
    mode = inputs.get("render_mode", PLAIN)
    image, alphas, info = _colors(_Call(inputs, signed), inputs)
    if mode == PLAIN:
        return image, alphas, info
    depths = _depths(inputs)
    if mode.endswith("ED"):
        depths = depths / alphas.clamp_min(LEAST_ALPHA)
    return (depths if mode in DEPTH_ONLY else torch.cat([image, depths], -1)), alphas, info


@torch.no_grad()
def _depths(inputs: dict[str, Any]) -> Tensor:
    """Return blended depths (c, h, w, 1): a render of each camera, with them as colours."""
    images = []
    for view, intrinsics in zip(inputs["viewmats"].split(1), inputs["Ks"].split(1), strict=True):
        depths = inputs["means"] @ view[0, 2, :3] + view[0, 2, 3]  # (n,)
        own = {**inputs, "viewmats": view, "Ks": intrinsics, "colors": depths[:, None].expand(-1, 3)}
        own |= {"sh_degree": None, "backgrounds": None}
        images.append(_colors(_Call(own, signed=False), own)[0][..., :1])
    return torch.cat(images)


class _Sizes(NamedTuple):
    """Hold numbers of a call, and how its colours are made."""

    degree: int
    signed: bool
    absgrad: bool
    numbers: Numbers


class _Call:
    """Hold the arguments of a call that have no gradients.

    Attributes:
        seen: Gaussians as the cameras see them, after the forward pass.
        centres: those that get gradients. The reference is weak, so that no cycle arises.
    """

    def __init__(self, inputs: dict[str, Any], signed: bool) -> None:
        poses, like = inputs["viewmats"].detach(), inputs["means"]
        centres = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]  # (c, 3)
        matrices = aligned(poses), aligned(inputs["Ks"].detach()), aligned(centres)
        self.cameras = DeviceCameras(*matrices, int(inputs["width"]), int(inputs["height"]))
        background, degree = inputs.get("backgrounds"), inputs.get("sh_degree")
        self.background = like.new_zeros(3) if background is None else background.detach().to(like).contiguous()
        near, far = float(inputs.get("near_plane", NEAREST)), float(inputs.get("far_plane", FARTHEST))
        blur = float(inputs.get("eps2d", PIXEL_VARIANCE))
        numbers = Numbers(blur=blur, near=near, far=far)
        self.sizes = _Sizes(degree or 0, signed or degree is None, bool(inputs.get("absgrad", False)), numbers)
        self.seen: Projected | None = None
        self.centres: weakref.ref[Tensor] | None = None


def _colors(call: _Call, inputs: dict[str, Any]) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Return images (c, h, w, 3), opacities (c, h, w, 1) and intermediate results."""
    colors = inputs["colors"]
    if inputs.get("sh_degree") is None:
        colors = colors.reshape(-1, 3)
    parameters = inputs["means"], inputs["quats"], inputs["scales"], inputs["opacities"], colors
    images, alphas = _Rasterize.apply(call, *parameters)  # type: ignore[no-untyped-call]  # torch's
    seen = call.seen
    assert seen is not None
    call.seen = None  # the backward pass has what it needs
    means2d = seen.means2d.requires_grad_(images.requires_grad)
    call.centres = weakref.ref(means2d)
    width, height = call.cameras.width, call.cameras.height
    info = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": seen.radii,
        "means2d": means2d,
        "depths": seen.depths,
        "conics": seen.records[..., 2:5],
        "opacities": seen.records[..., 5],
        "width": width,
        "height": height,
        "tile_size": TILE,
        "tile_width": math.ceil(width / TILE),
        "tile_height": math.ceil(height / TILE),
        "n_batches": 1,
        "n_cameras": len(call.cameras.poses),
    }
    return images, alphas, info


class _Rasterize(torch.autograd.Function):
    """Map (call, means, quaternions, scales, opacities, colours) to images and opacities."""

    @staticmethod
    def forward(
        ctx: Any, call: _Call, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
    ) -> tuple[Tensor, Tensor]:
        from lapgs_plugin.gpu_raster.kernels import project

        parts = means, quats, scales, opacities, colors
        parameters = Parameters(*(aligned(part.detach()) for part in parts))
        cameras, sizes = call.cameras, call.sizes
        seen = project(parameters, cameras, sizes.degree, sizes.signed, rules=RULES, numbers=sizes.numbers)
        size, count = (cameras.width, cameras.height), len(cameras.poses)
        alphas = means.new_empty(count, size[1], size[0])
        tiles, (images, *others) = blend_in_tiles(seen, call.background, size, count, alphas=alphas)
        ctx.call, call.seen = call, seen
        ctx.save_for_backward(*parameters, seen.radii, seen.records, *tiles, images, alphas, *others)
        ctx.set_materialize_grads(False)
        # Copies, which scripts may change in place: simple_trainer blackens masked pixels.
        return images.clone(), alphas[..., None].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_images: Tensor | None, by_alphas: Tensor | None) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.gpu_raster.blend_kernels import blend_backward
        from lapgs_plugin.gpu_raster.kernels import project_backward

        call: _Call = ctx.call
        *parts, radii, records, offsets, flat, images, alphas, counts, words = ctx.saved_tensors
        parameters, sizes = Parameters(*parts), call.sizes
        by_images = torch.zeros_like(images) if by_images is None else by_images.contiguous()
        beside: dict[str, Any] = {}
        if by_alphas is not None:  # most losses do not use opacities
            beside = {"rules": WITH_ALPHAS, "inverse_depths": (alphas, by_alphas.contiguous())}
        by_records, others = blend_backward(
            records, offsets, flat, images, counts, words, by_images, sizes.absgrad, **beside
        )
        by = project_backward(
            parameters, call.cameras, sizes.degree, sizes.signed, radii, records, by_records, others, RULES,
            sizes.numbers,
        )  # fmt: skip
        centres: Any = None if call.centres is None else call.centres()
        if centres is not None:
            centres.grad = by_records[..., 4:6].contiguous()
            if sizes.absgrad:
                centres.absgrad = others[..., 1:3].contiguous()
        return None, *by
