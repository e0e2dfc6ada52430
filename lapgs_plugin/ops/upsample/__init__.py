"""Upsample an image to the next finer level and add that level's image: Up(coarse) + fine.

Along one side Up is linear and short: a fine sample is a sum of at most five neighbouring coarse samples, whose weights
are `Pyramid.up_taps`. Our versions apply them in one pass over the images; PyTorch's operations take many.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid, require_half
from lapgs_plugin.ops.mixed_sizes import Sizes, own_parts, stack_padded
from lapgs_plugin.ops.self_check import largest, matches_reference

LARGEST_DIFFERENCE = 1e-4
"""Largest difference from PyTorch's operations, of values of about 1, that counts as rounding."""


def upsample_add(
    pyramid: Pyramid, coarse: Tensor, fine: Tensor, *, clamped: bool = False, sizes: Sizes | None = None
) -> Tensor:
    """Return Up(coarse) + fine, equal to `pyramid.up(coarse) + fine` up to rounding, with its gradient.

    Args:
        coarse: (c, ceil(h / 2), ceil(w / 2)), or (b, c, ...) for several images; float16 is taken, too.
        fine: (c, h, w) or (b, c, h, w), on the same device.
        clamped: clamp the sum to [0, 1], to show it; without gradient.
        sizes: (width, height) of several fine images, each in the top left of its own; None if they are whole.

    Raises:
        UserInputError: `coarse` is not half of `fine`, has other channels, or is on another device.
    """
    size = fine.shape[-2], fine.shape[-1]
    require_half(coarse, size)
    if coarse.shape[:-2] != fine.shape[:-2]:
        raise UserInputError(f"{tuple(coarse.shape)} and {tuple(fine.shape)}: expected images of as many channels")
    if coarse.device != fine.device:
        raise UserInputError(f"images on {coarse.device} and {fine.device}: expected images on one device")
    if triton_works(fine):
        from lapgs_plugin.ops.upsample.in_triton import upsample_add_triton

        return upsample_add_triton(pyramid, coarse, fine, clamped, sizes)
    if sizes is not None:
        pairs = zip(_halves(coarse, sizes), own_parts(fine, sizes), strict=True)
        return stack_padded([upsample_add(pyramid, one, other, clamped=clamped) for one, other in pairs])
    if clamped:
        return upsample_add(pyramid, coarse, fine).clamp_(0.0, 1.0)
    coarse = coarse.to(fine.dtype)
    if are_differentiated(coarse, fine):
        return upsample(pyramid, coarse, size) + fine
    if _fits_numba(fine):
        from lapgs_plugin.ops.upsample.in_numba import upsample_cpu

        return upsample_cpu(pyramid, coarse, size, fine)
    return pyramid.up(coarse, size) + fine


def upsample(pyramid: Pyramid, coarse: Tensor, size: tuple[int, int], sizes: Sizes | None = None) -> Tensor:
    """Return Up(coarse) of size (h, w), equal to `pyramid.up(coarse, size)` up to rounding, with its gradient.

    Args:
        coarse: as `upsample_add` takes it; the result is float32 for float16.
        size: (h, w) of the result.
        sizes: as `upsample_add` takes them.

    Raises:
        UserInputError: the image is not half of `size`.
    """
    require_half(coarse, size)
    if sizes is not None:
        pairs = zip(_halves(coarse, sizes), sizes, strict=True)
        return stack_padded([upsample(pyramid, image, (height, width)) for image, (width, height) in pairs])
    if coarse.dtype == torch.float16 and not _is_read_in_half(coarse):
        coarse = coarse.float()
    if _fits_numba(coarse) and not are_differentiated(coarse):
        from lapgs_plugin.ops.upsample.in_numba import upsample_cpu

        return upsample_cpu(pyramid, coarse, size)
    if not (coarse.dtype == torch.float16 or triton_works(coarse)):
        return pyramid.up(coarse, size)
    from lapgs_plugin.ops.upsample.in_triton import upsample_triton

    return upsample_triton(pyramid, coarse, size)


def _halves(coarse: Tensor, sizes: Sizes) -> list[Tensor]:
    """Return the own part of each coarse image, half of that of fine ones."""
    return own_parts(coarse, [level_size(size, 1) for size in sizes])


def are_differentiated(*images: Tensor) -> bool:
    """Return whether gradients by one of the images are recorded."""
    return torch.is_grad_enabled() and any(image.requires_grad for image in images)


def _is_read_in_half(coarse: Tensor) -> bool:
    """Return whether our kernel reads a float16 image as it is, which takes an operation less."""
    return coarse.is_cuda and not are_differentiated(coarse) and triton_works()


def _fits_numba(image: Tensor) -> bool:
    return image.device.type == "cpu" and image.dtype in (torch.float32, torch.float64)


@matches_reference("upsampling in many small operations instead of one kernel", LARGEST_DIFFERENCE)
def triton_works(device: torch.device) -> float:
    """Compare images and gradients; values are about 1."""
    from lapgs_plugin.ops.upsample.in_triton import upsample_add_triton, upsample_triton

    pyramid = Pyramid()
    # Channels last in memory, as gsplat returns images: the kernel compiled here is then the one used later.
    coarse, fine = (
        torch.linspace(-1, 1, 3 * side * side, device=device).square().view(side, side, 3).permute(2, 0, 1)
        for side in (5, 10)
    )
    results = []
    for up in (pyramid.up, lambda image, size: upsample_triton(pyramid, image, size)):
        leaf = coarse.clone().requires_grad_()
        image = up(leaf, (10, 10))
        (gradient,) = torch.autograd.grad((image * fine).sum(), leaf)
        results.append((image.detach(), gradient))
    (image, gradient), (in_triton, gradient_in_triton) = results
    pairs = (
        (in_triton, image),
        (gradient_in_triton, gradient),
        (upsample_add_triton(pyramid, coarse, fine), image + fine),
    )
    return largest((one - other).abs() for one, other in pairs)
