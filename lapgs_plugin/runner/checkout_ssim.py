"""Compute a checkout's SSIM in our kernels, where these return what its own function returns.

The first 3DGS computes SSIM by ten convolutions of the image, and many more operations in the backward pass. Most forks
still do.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.ops import photometric_loss
from lapgs_plugin.ops.self_check import SelfCheck, largest

NAME = "ssim"
"""The function's name in the family: of two images, the mean over their pixels."""

DEFAULTS = {"window_size": 11, "size_average": True}
"""Values of further arguments for which our kernels return the same."""

LARGEST_DIFFERENCE = 1e-3
"""Largest difference, of SSIM and relative of its gradient, that counts as rounding."""


def in_our_kernels(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return the replacement of a function that computes SSIM. Where it differs from ours, it is called itself."""
    names, name = tuple(inspect.signature(original).parameters), f"{original.__module__}.{original.__qualname__}"
    check = SelfCheck(partial(_difference, original), f"{name} of the checkout", LARGEST_DIFFERENCE)
    agrees = cache(check.passes_on)

    @wraps(original)
    def ssim(*args: Any, **kwargs: Any) -> Any:
        # `Signature.bind` takes longer; a call that does not fit gets its error from the checkout's function.
        images = _images({**dict(zip(names, args, strict=False)), **kwargs}) if len(args) <= len(names) else None
        if images is None or not _has_kernels(images[0]):
            return original(*args, **kwargs)
        return _our_ssim(*images) if agrees(images[0].device) else original(*args, **kwargs)

    return ssim


def _images(arguments: dict[str, Any]) -> tuple[Tensor, Tensor] | None:
    """Return the image that gradients are for, and the other one; None if our kernels do not suit the arguments."""
    images, others = list(arguments.values())[:2], list(arguments.items())[2:]
    if len(images) < 2 or any(name not in DEFAULTS or value != DEFAULTS[name] for name, value in others):
        return None
    if not all(isinstance(image, Tensor) and _fits(image) for image in images):
        return None
    first, second = sorted(images, key=lambda image: not image.requires_grad)
    alike = first.shape == second.shape and first.device == second.device
    return (first, second) if alike and not second.requires_grad else None


def _fits(image: Tensor) -> bool:
    return image.ndim in (3, 4) and image.shape[-3] == 3 and image.numel() > 0 and image.dtype == torch.float32


def _has_kernels(image: Tensor) -> bool:
    on_gpu = image.device.type != "cpu"
    return not on_gpu or photometric_loss.triton_works(image) or photometric_loss.fused_ssim() is not None


def _our_ssim(image: Tensor, other: Tensor) -> Tensor:
    return 1.0 - photometric_loss.photometric_loss(image, other, ssim_weight=1.0)


def _difference(original: Callable[..., Any], device: torch.device) -> float:
    """Return how far a function is from our SSIM and gradient of two images; its own are computed in float64."""
    generator = torch.Generator().manual_seed(0)
    other = torch.rand(3, 29, 43, generator=generator)
    image = (other + 0.2 * torch.rand(3, 29, 43, generator=generator)).to(device).requires_grad_()
    other = other.to(device)
    results = []
    for value in (_our_ssim(image, other), original(image.double(), other.double())):
        (gradient,) = torch.autograd.grad(value, image)
        results.append((value.detach(), gradient))
    (ours, our_gradient), (theirs, their_gradient) = results
    return largest([(ours - theirs).abs(), (our_gradient - their_gradient).abs() / their_gradient.abs().max()])
