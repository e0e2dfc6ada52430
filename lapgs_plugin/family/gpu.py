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
from lapgs_plugin.gpu_raster.cameras import MatrixCameras
from lapgs_plugin.gpu_raster.records import RECORD, TILE, Blended, Parameters, Projected, aligned
from lapgs_plugin.gpu_raster.replay import take_frame
from lapgs_plugin.gpu_raster.rules import Numbers, Rules
from lapgs_plugin.gpu_raster.tiles import Pairs, blend_family_in_tiles
from lapgs_plugin.ops.launch import current_stream
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
        fits = call.pairs is None or call.pairs.fit()  # this waits for the GPU, which has all of the work by now
        call.forget()
        if fits:
            return output
        del output  # which lacks some pairs; its memory is needed


def _attempt(call: _Call, inputs: Inputs, options: Options) -> Output:
    """Return the output if there is room for all pairs of Gaussians and tiles."""
    image, inverse_depths, radii, centres, depths = _Rasterize.apply(call, *inputs)  # type: ignore[no-untyped-call]  # torch's
    sums = _contributions(call, options, inputs.means) if options.sums else None
    return Output(
        image, radii, inverse_depths, centres, depths, sums, _Blending(call, image) if options.blending else None
    )


class _Call:
    """Hold the arguments of a call that need no gradients, for both passes.

    Attributes:
        is_empty: whether there are no Gaussians.
        size: (width, height).
        columns: of the gradient by the centres.
        summed: whether to add up over pixels while the image is made: all but the sums of weights.
        keeps: whether to keep what was blended for other sums over pixels.
        positions: whether to return centres and depths.
        background: as given.
        stream: number of the current one.
        seen: the projected Gaussians until the number of pairs is read, or None.
        sums: those over pixels, as `tiles.blend_and_sum` returns them, or None.
        blended: what was blended, or None before, or if there are no Gaussians.
        pairs: of Gaussians and tiles, or None before, or if there are no Gaussians.
        zeros: memory for the first backward pass, see `replay.Frame.by_records`, or None.
    """

    def __init__(self, settings: Settings, inputs: Inputs, options: Options) -> None:
        like = inputs.means
        n = like.shape[0]
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
        weighted = "weights" in options.sums
        self.summed, self.keeps = bool(options.sums) and not weighted, weighted or options.blending
        self.positions = options.positions
        self.seen: Projected | None = None
        self.sums: Tensor | None = None
        self.blended: Blended | None = None
        self.pairs: Pairs | None = None
        self.zeros: Tensor | None = None
        self.numbers = Numbers(float(settings.scale_modifier), float(options.blur), mult)
        degree = int(settings.sh_degree)
        self.degree, self.signed, self.columns = degree & ~SIGNED_COLOR_BIT, degree < 0, inputs.means2d.shape[1]
        self.background, self.stream = settings.bg, current_stream(like.device)
        tangents = float(settings.tanfovx), float(settings.tanfovy)
        self.camera = _cameras.get(
            settings.viewmatrix, settings.projmatrix, settings.campos, tangents, self.size, like, self.stream
        )

    def forget(self) -> None:
        """Drop what the backward pass does not need."""
        self.seen = self.sums = self.blended = self.pairs = None


_cameras = MatrixCameras()


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


def _outputs(
    ctx: Any, image: Tensor, by_depth: Tensor | None, radii: Tensor, centres: Tensor | None = None,
    depths: Tensor | None = None,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Return the outputs of `_Rasterize`, of which the first two are differentiable."""
    ctx.mark_non_differentiable(*(part for part in (radii, centres, depths) if part is not None))
    return image, by_depth, radii, centres, depths


def _of_nothing(ctx: Any, call: _Call, like: Tensor) -> tuple[Tensor | None, ...]:
    """Return the outputs of a call without Gaussians: as in the CUDA code, the image is black."""
    width, height = call.size
    by_depth = like.new_zeros(1, height, width) if call.rules.depth else None
    positions = (like.new_zeros(0, 2), like.new_zeros(0)) if call.positions else ()
    return _outputs(ctx, like.new_zeros(3, height, width), by_depth, like.new_zeros(0, dtype=torch.int32), *positions)


class _Rasterize(torch.autograd.Function):
    """Map (call, *tensors of Inputs) to image, inverse depths, radii, centres, depths, or None if not asked for."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        from lapgs_plugin.gpu_raster.kernels import project

        inputs = Inputs._make(tensors)
        ctx.call = call
        ctx.set_materialize_grads(False)
        if call.is_empty:
            ctx.save_for_backward(*tensors)
            return _of_nothing(ctx, call, inputs.means)
        parameters, first = _parameters(inputs)
        rules, mult = call.rules, call.numbers.mult
        n = parameters.means.shape[0]
        frame, into = take_frame(parameters.means, n, call.size, rules, mult, call.summed, call.stream) or (None, None)
        seen = project(
            parameters, call.camera, call.degree, call.signed, True, rules, call.numbers, first, into, call.positions
        )
        call.seen = seen  # while it lives, no other view takes the frame
        tiles, (image, inverse_depths, counts, words), call.sums, call.pairs = blend_family_in_tiles(
            seen, call.background, call.size, rules, mult, call.summed, frame
        )
        call.zeros = None if frame is None else frame.by_records
        ctx.save_for_backward(
            *parameters, first, *tiles, seen.radii, seen.records, image, inverse_depths, counts, words
        )
        if call.keeps:
            call.blended = Blended(seen.records, *tiles, image, counts, words)
        # Copies, which checkouts may change in place as they may those of the CUDA code. A frame's next view is written
        # to the same memory.
        by_depth = inverse_depths.clone() if rules.depth else None
        positions = (seen.centres[0], seen.depths[0].clone()) if call.positions else ()
        return _outputs(ctx, image[0].clone(), by_depth, seen.visible_radii[0], *positions)

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
        by_image = torch.zeros_like(image) if by_image is None else by_image.contiguous()
        # Most losses do not use depths, which take a third of the time of blending's backward pass.
        rules = call.rules._replace(depth=call.rules.depth and by_depths is not None)
        depths = (inverse_depths, by_depths.contiguous()) if rules.depth and by_depths is not None else None
        zeros, call.zeros = call.zeros, None
        by_records, others = blend_backward(
            records, offsets, flat, image, counts, words, by_image, call.columns == 4, rules=rules,
            inverse_depths=depths, zeros=zeros,
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
def _contributions(call: _Call, options: Options, like: Tensor) -> Contributions:
    """Return the sums that the options ask for, beside a tensor."""
    from lapgs_plugin.gpu_raster.sum_kernels import sums_over_pixels

    sums, n = call.sums, like.shape[0]
    if call.is_empty:
        sums = like.new_zeros(0, len(SUMS))
    elif sums is None:
        assert call.blended is not None
        assert options.pixel_weights is not None, "sums of weights without weights"
        sums = sums_over_pixels(call.blended, options.pixel_weights.detach().to(like).contiguous().view(-1))
    columns = {name: sums[:n, i] for i, name in enumerate(SUMS) if name in options.sums}
    copies = {name: sum_.int() if name == "counts" else sum_.clone() for name, sum_ in columns.items()}
    return Contributions(**copies)


class _Blending(Blending):
    """Go through the blended Gaussians once more for each question."""

    def __init__(self, call: _Call, image: Tensor) -> None:
        self._seen, self._size, self._like = call.blended, call.size, image.detach()
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
