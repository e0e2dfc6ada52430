"""Apply colour transforms in one kernel, and compute both gradients in another.

A product of matrices as narrow as three rows leaves most of a GPU idle, most of all that of the transform's gradient,
which sums over all pixels.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.ops.launch import blocks, launch

BLOCK = 1024
SIZES = ("n", "by_view", "by_channel", "out_view", "out_channel")
"""Arguments that differ between image sizes: one compiled kernel serves all."""


@triton.jit(do_not_specialize=SIZES[:3])
def _apply(
    image: tl.tensor, transform: tl.tensor, out: tl.tensor, n: int, by_view: int, by_channel: int,
    by_pixel: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    view = tl.program_id(1)
    places = tl.program_id(0) * block + tl.arange(0, block)
    here = places < n
    pixel = image + view * by_view + places * by_pixel
    red = tl.load(pixel, here, 0.0)
    green = tl.load(pixel + by_channel, here, 0.0)
    blue = tl.load(pixel + 2 * by_channel, here, 0.0)
    for channel in tl.static_range(3):
        row = transform + view * 12 + channel * 4
        value = tl.load(row) * red + tl.load(row + 1) * green + tl.load(row + 2) * blue + tl.load(row + 3)
        tl.store(out + view * by_view + channel * by_channel + places * by_pixel, value, here)


@triton.jit(do_not_specialize=SIZES)
def _gradients(
    image: tl.tensor, transform: tl.tensor, by_out: tl.tensor, by_image: tl.tensor, by_transform: tl.tensor, n: int,
    by_view: int, by_channel: int, out_view: int, out_channel: int,
    by_pixel: tl.constexpr, out_pixel: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    view = tl.program_id(1)
    places = tl.program_id(0) * block + tl.arange(0, block)
    here = places < n
    pixel = image + view * by_view + places * by_pixel
    red = tl.load(pixel, here, 0.0)
    green = tl.load(pixel + by_channel, here, 0.0)
    blue = tl.load(pixel + 2 * by_channel, here, 0.0)
    by_red, by_green, by_blue = red * 0.0, red * 0.0, red * 0.0
    for channel in tl.static_range(3):
        gradient = tl.load(by_out + view * out_view + channel * out_channel + places * out_pixel, here, 0.0)
        row = view * 12 + channel * 4
        by_red += gradient * tl.load(transform + row)
        by_green += gradient * tl.load(transform + row + 1)
        by_blue += gradient * tl.load(transform + row + 2)
        tl.atomic_add(by_transform + row, tl.sum(gradient * red))
        tl.atomic_add(by_transform + row + 1, tl.sum(gradient * green))
        tl.atomic_add(by_transform + row + 2, tl.sum(gradient * blue))
        tl.atomic_add(by_transform + row + 3, tl.sum(gradient))
    to = by_image + view * by_view + places * by_pixel
    tl.store(to, by_red, here)
    tl.store(to + by_channel, by_green, here)
    tl.store(to + 2 * by_channel, by_blue, here)


class _Transformed(torch.autograd.Function):
    """Map images (b, 3, n) without gaps and contiguous transforms (b, 3, 4) to images (b, 3, n) with their strides."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, transform: Tensor) -> Tensor:
        ctx.save_for_backward(image, transform)
        views, _, n = image.shape
        out = torch.empty_like(image)
        assert out.stride() == image.stride(), "images without gaps"
        *strides, by_pixel = image.stride()
        programs = blocks(n, BLOCK), views
        launch(_apply, programs, image, transform, out, n, *strides, by_pixel=by_pixel, block=BLOCK)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_out: Tensor) -> tuple[Tensor, Tensor]:
        image, transform = ctx.saved_tensors
        views, _, n = image.shape
        by_image, by_transform = torch.empty_like(image), torch.zeros_like(transform)
        (*strides, by_pixel), (*out_strides, out_pixel) = image.stride(), by_out.stride()
        launch(
            _gradients, (blocks(n, BLOCK), views),
            image, transform, by_out, by_image, by_transform, n, *strides, *out_strides,
            by_pixel=by_pixel, out_pixel=out_pixel, block=BLOCK,
        )  # fmt: skip
        return by_image, by_transform


def transform_colors_triton(image: Tensor, transform: Tensor) -> Tensor:
    """Do `transform_colors` for float32 images on a CUDA device, whose strides the result has."""
    pixels = image.flatten(-2).reshape(-1, 3, image.shape[-2] * image.shape[-1])
    if not (pixels.is_contiguous() or pixels.mT.is_contiguous()):
        pixels = pixels.contiguous()
    out: Tensor = _Transformed.apply(pixels, transform.reshape(-1, 3, 4).contiguous())  # type: ignore[no-untyped-call]  # torch's
    return out.view(image.shape)
