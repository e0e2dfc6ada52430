"""Render with compiled kernels behind `fields.rasterizer.Rasterizer`, with their own backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, degree_to_evaluate, require_color
from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.reference_raster import pipeline
from lapgs_plugin.reference_raster.pipeline import Gaussians, Rendering, View
from lapgs_plugin.reference_raster.rays import render_along_rays


class CpuRasterizer(Rasterizer):
    """Render and differentiate on the CPU, fast enough to train with.

    The semantics are those of `oracle`, gradients included. It runs on `torch.get_num_threads()` threads (see
    `jit.threads`), gives the same bits for any number of them, and may be called from several Python threads at once.
    The first call on a machine compiles.

    Gaussians whose position or covariance on the image is not finite are culled: they get radius 0 and no gradient.

    Args:
        rays: evaluate Gaussians along rays, which a lens may bend; see `reference_raster.rays`. That is slow.
    """

    name = "cpu"
    devices = ("cpu",)

    def __init__(self, *, rays: bool = False) -> None:
        self._rays = rays

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`.

        Args:
            field: float32 or float64, on the CPU.
            camera: of any precision; its pose gets no gradient.
            background: (3,) colour; may require a gradient.
            sh_degree: highest SH degree to evaluate; None means all.

        Raises:
            UserInputError: the field has no such `sh_degree`, `background` is not a colour, or a tensor is not on the
                CPU or not of the field's precision.
        """
        degree = degree_to_evaluate(field, sh_degree)
        _check(field, background)
        if self._rays:
            return render_along_rays(field, camera, background, degree)
        kind = field.means.dtype
        view = _view(camera, kind)
        background = background.to(kind)

        n = len(field)
        parameters = list(field.parameters.values())
        differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in (*parameters, background))
        # NumPy, because PyTorch fills large tensors on several threads, which then spin; see `jit.threads`.
        means2d, absgrad2d = (_zeros(n, 2, view.camera.dtype) for _ in range(2))
        call = _Call(view, field.signed, degree, differentiable, means2d.detach(), absgrad2d)
        means2d.requires_grad_(differentiable)
        image, transmittance, radii = _Rasterize.apply(  # type: ignore[no-untyped-call]  # torch leaves it without types
            call, background, means2d, *parameters
        )
        return RenderResult(image, transmittance, radii, means2d, absgrad2d)

    @torch.no_grad()
    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Render images without anything else; see `fields.rasterizer.Rasterizer`.

        Raises:
            UserInputError: as `__call__`.
        """
        if self._rays:
            return super().render_images(field, cameras, background=background)
        _check(field, background)
        kind = field.means.dtype
        gaussians = _gaussians(list(field.parameters.values()), field.signed, field.sh_degree)
        color = background.to(kind).contiguous().numpy()
        images = [pipeline.render(gaussians, _view(camera, kind), color, keep=False).image for camera in cameras]
        return torch.from_numpy(images[0][None] if len(images) == 1 else np.stack(images))


@dataclass(frozen=True)
class _Call:
    """Hold the arguments of a call that are not differentiated.

    Attributes:
        keep: whether a backward pass is possible.
        means2d, absgrad2d: (n, 2) filled in the forward and in the backward pass.
    """

    view: View
    signed: bool
    sh_degree: int
    keep: bool
    means2d: Tensor
    absgrad2d: Tensor


class _Rasterize(torch.autograd.Function):
    """Map (call, background, means2d, *parameters of the field) to image, transmittance, radii."""

    @staticmethod
    def forward(
        ctx: Any, call: _Call, background: Tensor, means2d: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        color = background.detach().contiguous().numpy()
        gaussians = _gaussians(parameters, call.signed, call.sh_degree)
        rendering = pipeline.render(gaussians, call.view, color, keep=call.keep)
        np.copyto(call.means2d.numpy(), rendering.centres)
        image, transmittance, radii = (
            torch.from_numpy(array) for array in (rendering.image, rendering.transmittance, rendering.radii)
        )
        if call.keep:
            ctx.call, ctx.rendering = call, rendering
            ctx.save_for_backward(*parameters)
            ctx.set_materialize_grads(False)
            ctx.mark_non_differentiable(radii)
        return image, transmittance, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *from_above: Tensor | None) -> tuple[Tensor | None, ...]:
        call: _Call = ctx.call
        rendering: Rendering = ctx.rendering
        grad_image, grad_transmittance = (None if g is None else g.contiguous().numpy() for g in from_above[:2])
        if grad_image is None:
            grad_image = np.zeros_like(rendering.image)
        gaussians = _gaussians(ctx.saved_tensors, call.signed, call.sh_degree)
        gradients = pipeline.gradients(gaussians, call.view, rendering, grad_image, grad_transmittance)
        np.copyto(call.absgrad2d.numpy(), gradients.absolute_centres)
        by_background = None
        if ctx.needs_input_grad[1]:
            weights = rendering.transmittance.reshape(-1)
            by_background = torch.from_numpy(grad_image.reshape(3, -1) @ weights)
        arrays = (
            gradients.centres,
            gradients.means,
            gradients.quats,
            gradients.scales,
            gradients.opacities,
            gradients.sh,
        )
        return None, by_background, *(None if a is None else torch.from_numpy(a) for a in arrays)


def _view(camera: Camera, kind: torch.dtype) -> View:
    pose = camera.world_to_camera.detach().to("cpu", kind).numpy()
    return pipeline.make_view(camera.width, camera.height, pose, (camera.fx, camera.fy), (camera.cx, camera.cy))


def _gaussians(parameters: Sequence[Tensor], signed: bool, sh_degree: int) -> Gaussians:
    """Return a field's parameters, in its order, as arrays."""
    means, quats, log_scales, logits, sh = (p.detach().contiguous().numpy() for p in parameters)
    return Gaussians(means, quats, log_scales, logits, sh, None, True, signed, sh_degree)


def _zeros(rows: int, columns: int, kind: np.dtype[Any]) -> Tensor:
    array = empty(rows * columns, kind).reshape(rows, columns)
    array.fill(0)
    return torch.from_numpy(array)


def _check(field: GaussianField, background: Tensor) -> None:
    kind = field.means.dtype
    require_color(background)
    if kind not in (torch.float32, torch.float64):
        raise UserInputError(f"the field's tensors are {kind}, expected float32 or float64; convert with field.to()")
    for name, tensor in {**field.parameters, "background": background}.items():
        if tensor.device.type != "cpu":
            raise UserInputError(f"{name} is on {tensor.device}, expected the CPU; convert with .to('cpu')")
        if tensor.dtype != kind and name != "background":
            raise UserInputError(f"{name} is {tensor.dtype} and means are {kind}, expected one type; use field.to()")
