"""Render on the GPU by our kernels from the arguments of the CUDA bindings, differentiably, as one autograd node.

The camera stays on the device: nothing waits for the GPU but for the number of pairs, see `gpu_raster.tiles`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family.call import SUMS, Blending, Contributions, Inputs, Options, Output, Settings
from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.records import RECORD, TILE, Blended, Parameters, aligned
from lapgs_plugin.gpu_raster.replay import take_frame
from lapgs_plugin.gpu_raster.rules import Numbers, Rules
from lapgs_plugin.gpu_raster.tiles import Pairs, blend_family_in_tiles
from lapgs_plugin.reference_raster.layout import SIGNED_COLOR_BIT

LONGEST_SIDE = TILE * (2**15 - 1)
"""Pixels of an image's side whose tiles can be numbered in 15 bits."""
MOST_NUMBERS = 2**31 - 1
"""Numbers of all Gaussians that the kernels can count."""


def rasterize(settings: Settings, inputs: Inputs, options: Options) -> Output:
    """Render differentiably by all tensors of `inputs`, which fit each other.

    Focal lengths are those of the fields of view; `projmatrix`, which is never read on the processor, says where the
    principal point is.

    Raises:
        UserInputError: the image is too large for the kernels, or there are too many Gaussians.
    """
    while True:
        call = _Call(settings, inputs, options)
        output = _attempt(call, inputs, options)
        pairs, call.pairs, call.blended = call.pairs, None, None  # the backward pass needs neither
        if pairs is None or pairs.fit():  # this waits for the GPU, which has all of the work by now
            return output
        del output  # which lacks some pairs; its memory is needed


def _attempt(call: _Call, inputs: Inputs, options: Options) -> Output:
    """Return the output if there is room for all pairs of Gaussians and tiles."""
    image, inverse_depths, radii, centres, depths = _Rasterize.apply(call, *inputs)  # type: ignore[no-untyped-call]  # torch's
    return Output(
        image,
        radii,
        inverse_depths if options.inverse_depth else None,
        centres,
        depths,
        _contributions(call, options) if options.sums else None,
        _Blending(call) if options.blending else None,
    )


class _Call:
    """Hold the arguments of a call that need no gradients, for both passes.

    Attributes:
        is_empty: whether there are no Gaussians.
        size: (width, height).
        columns: of the gradient by the centres.
        keeps: whether to keep what was blended for sums over pixels.
        blended: that, or None before, or if there are no Gaussians.
        pairs: of Gaussians and tiles, or None before, or if there are no Gaussians.
    """

    def __init__(self, settings: Settings, inputs: Inputs, options: Options) -> None:
        n = inputs.means.shape[0]
        self.is_empty = n == 0
        self.size = int(settings.image_width), int(settings.image_height)
        if max(self.size) > LONGEST_SIDE:
            width, height = self.size
            raise UserInputError(f"an image of {width}x{height} pixels: expected {LONGEST_SIDE} a side at most")
        coefficients = 0 if inputs.sh is None else 3 * (inputs.sh.shape[1] + 1)
        if (most := MOST_NUMBERS // max(coefficients, RECORD)) < n:
            raise UserInputError(f"{n} Gaussians: expected {most} at most with as many coefficients")
        self.rules = Rules(
            family=True,
            covariances=inputs.covariances is not None,
            apart=inputs.dc is not None,
            dimmed=options.antialiasing,
            exact=options.exact_antialiasing,
            snug=options.mult is not None,
            depth=options.inverse_depth,
        )
        mult = 1.0 if options.mult is None else float(options.mult)
        self.keeps = bool(options.sums) or options.blending
        self.blended: Blended | None = None
        self.pairs: Pairs | None = None
        self.numbers = Numbers(float(settings.scale_modifier), float(options.blur), mult)
        degree = int(settings.sh_degree)
        self.degree, self.signed, self.columns = degree & ~SIGNED_COLOR_BIT, degree < 0, inputs.means2d.shape[1]
        like = inputs.means
        self.background = _beside(settings.bg, like).contiguous()
        view, full, centre = settings.viewmatrix, settings.projmatrix, settings.campos
        # Scripts cut the centre out of an inverse: where it lies, only Triton's own launch would start the kernel.
        self._matrices = _beside(view, like), _beside(full, like), aligned(_beside(centre, like))
        self._tangents = settings.tanfovx, settings.tanfovy

    @cached_property
    def camera(self) -> DeviceCameras:
        """Return the camera, on the device."""
        from lapgs_plugin.gpu_raster.kernels import camera_of

        return camera_of(*self._matrices, self._tangents, self.size)


def _beside(tensor: Tensor, like: Tensor) -> Tensor:
    """Return a tensor without gradients, of the type and on the device of another."""
    tensor = tensor.detach()
    return tensor if tensor.dtype == like.dtype and tensor.device == like.device else tensor.to(like)


def _parameters(inputs: Inputs) -> tuple[Parameters, Tensor | None]:
    """Return tensors as the kernels take them, and the first coefficients that are apart; no gradients pass."""
    scales = inputs.covariances if inputs.scales is None else inputs.scales
    colors = inputs.colors if inputs.sh is None else inputs.sh
    assert scales is not None
    assert colors is not None
    means = aligned(inputs.means)
    quats = means if inputs.quats is None else aligned(inputs.quats)  # any tensor that is not read
    parts = means, quats, aligned(scales), aligned(inputs.opacities), aligned(colors)
    return Parameters(*parts), None if inputs.dc is None else aligned(inputs.dc)


class _Rasterize(torch.autograd.Function):
    """Map (call, *tensors of Inputs) to image, inverse depths (empty if not asked for), radii, centres, depths."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        from lapgs_plugin.gpu_raster.kernels import project

        inputs = Inputs._make(tensors)
        width, height = call.size
        ctx.call = call
        ctx.set_materialize_grads(False)
        if call.is_empty:  # as in the CUDA code, the image is black
            ctx.save_for_backward(*tensors)
            image = inputs.means.new_zeros(3, height, width)
            radii, depths = inputs.means.new_zeros(0, dtype=torch.int32), inputs.means.new_zeros(0)
            centres = inputs.means.new_zeros(0, 2)
            ctx.mark_non_differentiable(radii, centres, depths)
            return image, image[:1].clone(), radii, centres, depths
        parameters, first = _parameters(inputs)
        rules, mult = call.rules, call.numbers.mult
        frame, into = take_frame(parameters.means, parameters.means.shape[0], call.size, rules, mult) or (None, None)
        seen = project(parameters, call.camera, call.degree, call.signed, True, rules, call.numbers, first, into)
        tiles, (image, inverse_depths, counts, words), call.pairs = blend_family_in_tiles(
            seen, call.background, call.size, rules, mult, frame
        )
        ctx.save_for_backward(
            *parameters, first, *tiles, seen.radii, seen.records, image, inverse_depths, counts, words
        )
        if call.keeps:
            call.blended = Blended(seen.records, *tiles, image, counts, words)
        radii, centres, depths = seen.visible_radii[0], seen.centres[0], seen.depths[0]
        if frame is not None:  # the next view is written there
            depths = depths.clone()
        ctx.mark_non_differentiable(radii, centres, depths)
        # Copies, which checkouts may change in place as they may those of the CUDA code.
        return image[0].clone(), inverse_depths.clone(), radii, centres, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_image: Tensor | None, by_depths: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.gpu_raster.blend_kernels import blend_backward
        from lapgs_plugin.gpu_raster.kernels import project_family_backward

        call: _Call = ctx.call
        if call.is_empty:
            return None, *(None if part is None else torch.zeros_like(part) for part in ctx.saved_tensors)
        *saved, radii, records, image, inverse_depths, counts, words = ctx.saved_tensors
        parameters, first, (offsets, flat) = Parameters(*saved[:5]), saved[5], saved[6:]
        by_image = torch.zeros_like(image) if by_image is None else by_image.contiguous().view(image.shape)
        # Most losses do not use depths, which take a third of the time of blending's backward pass.
        rules = call.rules._replace(depth=call.rules.depth and by_depths is not None)
        depths = (inverse_depths, by_depths.contiguous()) if rules.depth and by_depths is not None else None
        by_records, others = blend_backward(
            records, offsets, flat, image, counts, words, by_image, call.columns == 4, rules=rules,
            inverse_depths=depths,
        )  # fmt: skip
        by, by_first, by_screen = project_family_backward(
            parameters, first, call.camera, call.degree, call.signed, radii, records, by_records, others, rules,
            call.numbers, call.columns,
        )  # fmt: skip
        from_axes, colored = not call.rules.covariances, parameters.sh.ndim == 2
        return None, *Inputs(
            means=by.means,
            means2d=by_screen,
            opacities=by.logits,
            dc=by_first,
            sh=None if colored else by.sh,
            colors=by.sh if colored else None,
            scales=by.log_scales if from_axes else None,
            quats=by.quaternions if from_axes else None,
            covariances=None if from_axes else by.log_scales,
        )


@torch.no_grad()
def _contributions(call: _Call, options: Options) -> Contributions:
    """Return the sums that the options ask for."""
    from lapgs_plugin.gpu_raster.sum_kernels import sums_over_pixels

    seen, like = call.blended, call.background
    if seen is None:
        sums = like.new_zeros(0, len(SUMS))
    elif "weights" in options.sums:
        assert options.pixel_weights is not None, "sums of weights without weights"
        sums = sums_over_pixels(seen, options.pixel_weights.detach().to(like).contiguous().view(-1))
    else:
        sums = sums_over_pixels(seen, seen.image)  # any numbers
    by_name = {name: sums[:, i].contiguous() for i, name in enumerate(SUMS) if name in options.sums}
    if "counts" in by_name:
        by_name["counts"] = by_name["counts"].int()
    return Contributions(**by_name)


class _Blending(Blending):
    """Go through the blended Gaussians once more for each question."""

    def __init__(self, call: _Call) -> None:
        self._seen, self._size, self._like = call.blended, call.size, call.background
        self.n = 0 if self._seen is None else self._seen.records.shape[1]

    @cached_property
    def transmittance(self) -> Tensor:
        width, height = self._size
        if self._seen is None:
            return self._like.new_ones(height, width)
        return self._leaders(1)[1].view(height, width)

    def leaders(self, ranks: int = 1) -> Tensor:
        if self._seen is None:
            return self._like.new_full((ranks, self._size[0] * self._size[1]), -1, dtype=torch.int64)
        return self._leaders(ranks)[0].long()

    def _leaders(self, ranks: int) -> tuple[Tensor, Tensor]:
        from lapgs_plugin.gpu_raster.sum_kernels import leaders

        assert self._seen is not None
        return leaders(self._seen, ranks)

    @torch.no_grad()
    def weighted_shares(self, weights: Tensor) -> Tensor:
        from lapgs_plugin.gpu_raster.sum_kernels import remainders

        if self._seen is None:
            return self._like.new_zeros(0)
        return remainders(self._seen, weights.detach().to(self._like).contiguous().view(-1))

    @torch.no_grad()
    def squared_gradients(self, grad_image: Tensor) -> Tensor:
        from lapgs_plugin.gpu_raster.sum_kernels import squared_gradients

        if self._seen is None:
            return self._like.new_zeros(0)
        return squared_gradients(self._seen, grad_image.detach().to(self._like).contiguous())
