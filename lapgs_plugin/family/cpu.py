"""Render on the CPU with the kernels of `reference_raster`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family.call import SUMS, Blending, Contributions, Inputs, Options, Output, Settings, depths_of
from lapgs_plugin.reference_raster import pipeline
from lapgs_plugin.reference_raster.blending import TiledBlending
from lapgs_plugin.reference_raster.contributions import sums_of
from lapgs_plugin.reference_raster.covariance import (
    antialiasing_factors,
    covariance_gradients,
    covariances_of,
    principal_axes,
)
from lapgs_plugin.reference_raster.layout import POSITION, SIGNED_COLOR_BIT
from lapgs_plugin.reference_raster.pipeline import Gaussians, Gradients, Rendering, View
from lapgs_plugin.reference_raster.snug_tiles import snug_tiles

FOCAL_TOLERANCE = 1e-3
"""Relative tolerance between the focal lengths in `projmatrix` and those of the fields of view."""


def rasterize(settings: Settings, inputs: Inputs, options: Options) -> Output:
    """Render differentiably by all tensors of `inputs`; see `engine.rasterize`.

    Raises:
        UserInputError: the projection does not fit the field of view.
    """
    view = view_of(settings, options.blur)
    if options.antialiasing:
        covariances = inputs.covariances
        if covariances is None:
            assert inputs.scales is not None
            assert inputs.quats is not None
            covariances = covariances_of(inputs.scales * settings.scale_modifier, inputs.quats)
        factors = antialiasing_factors(inputs.means, covariances, view, options.exact_antialiasing)
        inputs = inputs._replace(opacities=inputs.opacities * factors)
    call = _Call(
        settings, view, options, torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)
    )
    image, inverse_depths, radii, centres, depths = _Rasterize.apply(call, *inputs)  # type: ignore[no-untyped-call]  # torch's
    inverse_depths = inverse_depths if options.inverse_depth else None
    centres, depths = (centres, depths) if options.positions else (None, None)
    return Output(image, radii, inverse_depths, centres, depths, call.contributions, call.blending)


def view_of(settings: Settings, blur: float) -> View:
    """Return the camera from transposed matrices as the CUDA code takes them.

    Raises:
        UserInputError: the projection is not along z, or its focal lengths are not those of the fields of view.
    """
    width, height = int(settings.image_width), int(settings.image_height)
    world_to_camera = settings.viewmatrix.detach().to("cpu", torch.float64).T.numpy()
    full = settings.projmatrix.detach().to("cpu", torch.float64).T.numpy()
    projection = full[:, :3] @ np.linalg.inv(world_to_camera[:3, :3])  # (4, 3)
    focal = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    of_matrix = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    if not np.allclose(of_matrix, focal, rtol=FOCAL_TOLERANCE) or not np.allclose(projection[3], (0, 0, 1), atol=1e-3):
        raise UserInputError(
            f"projmatrix has focal lengths {of_matrix[0]:.6g}, {of_matrix[1]:.6g} px, but tanfovx and tanfovy say "
            f"{focal[0]:.6g}, {focal[1]:.6g}; pass the transposed projection times viewmatrix for this image size"
        )
    principal = (1 + projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    view = pipeline.make_view(width, height, world_to_camera.astype(np.float32), focal, principal, blur)
    view.camera[POSITION : POSITION + 3] = settings.campos.detach().cpu().numpy().ravel()
    return view


class _Call:
    """Hold the arguments of a call that are no tensors, and its results that are none."""

    def __init__(self, settings: Settings, view: View, options: Options, keep: bool) -> None:
        self.settings, self.view, self.options, self.keep = settings, view, options, keep
        self.background = settings.bg.detach().to("cpu", torch.float32).contiguous().numpy()
        self.contributions: Contributions | None = None
        self.blending: Blending | None = None

    def gaussians(self, tensors: Sequence[Tensor | None]) -> Gaussians:
        """Return the tensors of `Inputs` as the kernels take them."""
        detached = Inputs._make(None if t is None else t.detach().contiguous() for t in tensors)
        sh = detached.sh if detached.dc is None or detached.sh is None else torch.cat([detached.dc, detached.sh], 1)
        scales, quats = detached.scales, detached.quats
        if detached.covariances is not None:
            scales, quats = principal_axes(detached.covariances)
        elif scales is not None and self.settings.scale_modifier != 1:
            scales = scales * self.settings.scale_modifier
        assert scales is not None
        assert quats is not None
        degree = int(self.settings.sh_degree)
        return Gaussians(
            detached.means.numpy(), quats.numpy(), scales.numpy(), detached.opacities.reshape(-1).numpy(),
            None if sh is None else sh.numpy(), None if detached.colors is None else detached.colors.numpy(),
            raw=False, signed=degree < 0, sh_degree=degree & ~SIGNED_COLOR_BIT,
        )  # fmt: skip

    def render(self, gaussians: Gaussians, background: Any, keep: bool) -> Rendering:
        """Render with the tiles of the options."""
        assign = None
        if self.options.mult is not None:
            depths = depths_of(torch.from_numpy(gaussians.means), self.settings.viewmatrix).numpy()
            assign = snug_tiles(depths, self.options.mult, *self.view.tiles)
        return pipeline.render(gaussians, self.view, background, keep=keep, assign=assign)

    def shaded_by_depth(self, gaussians: Gaussians) -> Gaussians:
        """Return the same Gaussians with 1 / depth as their first colour channel."""
        depths = depths_of(torch.from_numpy(gaussians.means), self.settings.viewmatrix).numpy()
        colors = np.zeros((len(depths), 3), np.float32)
        np.divide(1, depths, out=colors[:, 0], where=depths > 0)
        return replace(gaussians, sh=None, colors=colors)


def _contributions(call: _Call, rendering: Rendering) -> Contributions:
    """Return the sums that the options ask for."""
    assert rendering.kept is not None
    weights = call.options.pixel_weights
    pixels = call.view.width * call.view.height
    flat = torch.ones(pixels) if weights is None else weights.detach().to("cpu", torch.float32).reshape(-1)
    sums = sums_of(len(rendering.radii), call.view, rendering.kept, flat.contiguous().numpy())
    contributions = {name: torch.from_numpy(values).float() for name, values in zip(SUMS, sums, strict=True)}
    contributions["counts"] = contributions["counts"].int()
    return Contributions(**{name: contributions[name] for name in call.options.sums})


class _Blending(Blending):
    """Answer in tensors what `TiledBlending` computes in NumPy."""

    def __init__(self, tiled: TiledBlending) -> None:
        self._tiled, self.n = tiled, tiled.n

    @property
    def transmittance(self) -> Tensor:
        return torch.from_numpy(self._tiled.rendering.transmittance)

    def leaders(self, ranks: int = 1) -> Tensor:
        return torch.from_numpy(self._tiled.leaders(ranks))

    def weighted_shares(self, weights: Tensor) -> Tensor:
        return torch.from_numpy(self._tiled.weighted_shares(weights.detach().numpy())).float()

    def squared_gradients(self, grad_image: Tensor) -> Tensor:
        return torch.from_numpy(self._tiled.squared_gradients(grad_image.detach().numpy())).float()


class _Rasterize(torch.autograd.Function):
    """Map (call, *tensors of Inputs) to image, inverse depths (empty if not asked for), radii, centres, depths."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        gaussians = call.gaussians(tensors)
        options = call.options
        n = len(gaussians.means)
        keep = call.keep or bool(options.sums) or options.blending
        rendering = call.render(gaussians, call.background, keep)
        image, radii, centres = (
            torch.from_numpy(array) for array in (rendering.image, rendering.radii, rendering.centres)
        )
        if n == 0:
            image = torch.zeros_like(image)
        depths = depths_of(torch.from_numpy(gaussians.means), call.settings.viewmatrix)
        depths = torch.where(radii > 0, depths, 0.0)
        if options.sums:
            call.contributions = _contributions(call, rendering)
        if options.blending:
            call.blending = _Blending(TiledBlending(call.view, rendering))
        inverse_depths = torch.empty(0)
        if options.inverse_depth:
            behind = call.render(call.shaded_by_depth(gaussians), np.zeros(3, np.float32), False)
            inverse_depths = torch.from_numpy(behind.image[:1].copy())
        if call.keep:
            ctx.call, ctx.rendering = call, rendering
            ctx.save_for_backward(*tensors)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, centres, depths)
        return image, inverse_depths, radii, centres, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_depth: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        call: _Call = ctx.call
        tensors = Inputs._make(ctx.saved_tensors)
        total: list[Tensor | None] = [None] * len(tensors)
        if grad_image is not None:
            total = _add(total, _gradients(call, tensors, call.gaussians(tensors), ctx.rendering, grad_image))
        if grad_depth is not None and call.options.inverse_depth:
            # The CUDA code blends 1 / depth like a colour channel; here it is one.
            shaded = call.shaded_by_depth(call.gaussians(tensors))
            rendering = call.render(shaded, np.zeros(3, np.float32), True)
            grad = torch.cat([grad_depth, torch.zeros(2, *grad_depth.shape[1:])])
            gradients = _gradients(call, tensors, shaded, rendering, grad)
            by_inverse, gradients[3:6] = gradients[5], [None, None, None]
            assert by_inverse is not None
            assert gradients[0] is not None
            axis = call.settings.viewmatrix.detach().cpu()[:3, 2]
            inverse = torch.from_numpy(shaded.colors)[:, :1]  # (n, 1)
            gradients[0] = gradients[0] - by_inverse[:, :1] * inverse**2 * axis
            total = _add(total, gradients)
        return (None, *total)


def _gradients(
    call: _Call, inputs: Inputs, gaussians: Gaussians, rendering: Rendering, grad_image: Tensor
) -> list[Tensor | None]:
    """Return gradients in the order of `Inputs`; that by colours whenever `gaussians` has colours."""
    gradients = pipeline.gradients(gaussians, call.view, rendering, grad_image.contiguous().numpy(), None)
    by_covariances = None
    if inputs.covariances is not None:
        assert rendering.kept is not None
        by_covariances = covariance_gradients(
            inputs.means, inputs.covariances, call.view, rendering.kept, gradients.slots
        )
    by_sh = None if gradients.sh is None else torch.from_numpy(gradients.sh)
    by_dc = None if by_sh is None or inputs.dc is None else by_sh[:, :1]
    return [
        torch.from_numpy(gradients.means),
        _screen_gradient(call.view, gradients, inputs.means2d),
        torch.from_numpy(gradients.opacities)[:, None],
        by_dc,
        by_sh if by_sh is None or by_dc is None else by_sh[:, 1:],
        None if gradients.colors is None else torch.from_numpy(gradients.colors),
        None if inputs.covariances is not None else torch.from_numpy(gradients.scales),
        None if inputs.covariances is not None else torch.from_numpy(gradients.quats),
        by_covariances,
    ]


def _screen_gradient(view: View, gradients: Gradients, means2d: Tensor) -> Tensor:
    """Return the gradient by the centres in units of half the image; of four columns the last two are absolute sums."""
    half = np.array([view.width / 2, view.height / 2], np.float32)
    gradient = torch.zeros_like(means2d)
    gradient[:, :2] = torch.from_numpy(gradients.centres * half)
    if means2d.shape[1] == 4:
        gradient[:, 2:] = torch.from_numpy(gradients.absolute_centres * half)
    return gradient


def _add(a: list[Tensor | None], b: list[Tensor | None]) -> list[Tensor | None]:
    return [y if x is None else x if y is None else x + y for x, y in zip(a, b, strict=True)]
