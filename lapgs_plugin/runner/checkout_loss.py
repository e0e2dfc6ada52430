"""Compute a checkout's SSIM, or its whole photometric loss, in our kernels, where these return what its functions do.

The first 3DGS computes SSIM by ten convolutions of the image, and many more operations in the backward pass. Most forks
still do. L1 and the sum of both are 18 more launches, with their gradients.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.loss_statements import BACKWARD, LOSSES, LossStatements
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.ops import photometric_loss
from lapgs_plugin.ops.backward import backward
from lapgs_plugin.ops.self_check import SelfCheck, largest

NAME = "ssim"
"""The function's name in the family: of two images, the mean over their pixels."""

DEFAULTS = {"window_size": 11, "size_average": True}
"""Values of further arguments for which our kernels return the same."""

LARGEST_DIFFERENCE = 1e-3
"""Largest difference, of SSIM and relative of its gradient, that counts as rounding."""
L1_PRECISION = 1e-3
"""The same of L1, as a factor on it: nothing is filtered there."""

TORCH_BACKWARD = Tensor.backward
"""PyTorch's own method."""


def in_our_kernels(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return the replacement of a function that computes SSIM. Where it differs from ours, it is called itself."""
    names = tuple(inspect.signature(original).parameters)

    @wraps(original)
    def ssim(*args: Any, **kwargs: Any) -> Any:
        # `Signature.bind` takes longer; a call that does not fit gets its error from the checkout's function.
        images = _images({**dict(zip(names, args, strict=False)), **kwargs}) if len(args) <= len(names) else None
        if images is None or not _has_kernels(images[0]):
            return original(*args, **kwargs)
        ours = _agrees(_difference, original, images[0].device)
        return _our_ssim(*images) if ours else original(*args, **kwargs)

    return ssim


def in_one_kernel(training: Callable[..., Any]) -> Callable[..., Any]:
    """Return a script's training function, changed so that L1 and SSIM of its loss come from one kernel."""
    return rewritten(training, LossStatements, {LOSSES: _losses, BACKWARD: _backward})


def _backward(loss: Any) -> None:
    """Do `loss.backward()`, by PyTorch's method if something has taken its place, such as `--breakdown`."""
    if type(loss) is Tensor and loss.ndim == 0 and Tensor.backward is TORCH_BACKWARD:
        backward(loss)
    else:
        loss.backward()


def _losses(l1: Any, ssim: Any, batched: bool, image: Any, target: Any, weight: Any) -> tuple[Tensor, Tensor] | None:
    """Return L1 and the loss of an image; None if our kernels do not suit it or differ from the checkout's functions.

    Args:
        l1, ssim: functions of two images.
        batched: whether `ssim` gets batches of one image.
        image, target: (3, h, w), or else None is returned.
        weight: lambda.
    """
    if not (_are_image_and_target(image, target) and type(weight) is float and 0 <= weight <= 1):
        return None
    device, of_ssim = image.device, _batch_difference if batched else _loss_difference
    if not (_has_one_kernel(image) and _agrees(_l1_difference, l1, device) and _agrees(of_ssim, ssim, device)):
        return None
    loss, distance = photometric_loss.loss_and_l1(image, target, weight)
    return distance, loss


def _are_image_and_target(image: Any, target: Any) -> bool:
    """Return whether values are images (3, h, w) that our kernels suit, without gradients by the target."""
    if not (isinstance(image, Tensor) and isinstance(target, Tensor)) or target.requires_grad or image.ndim != 3:
        return False
    return _fits(image) and _are_alike(image, target)


@cache
def _agrees(difference: Callable[..., float], function: Callable[..., Any], device: torch.device) -> bool:
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', function)}"
    return SelfCheck(partial(difference, function), f"{name} of the checkout", LARGEST_DIFFERENCE).passes_on(device)


def _images(arguments: dict[str, Any]) -> tuple[Tensor, Tensor] | None:
    """Return the image that gradients are for, and the other one; None if our kernels do not suit the arguments."""
    images, others = list(arguments.values())[:2], list(arguments.items())[2:]
    if len(images) < 2 or any(name not in DEFAULTS or value != DEFAULTS[name] for name, value in others):
        return None
    if not all(isinstance(image, Tensor) and _fits(image) for image in images):
        return None
    first, second = sorted(images, key=lambda image: not image.requires_grad)
    return (first, second) if _are_alike(first, second) and not second.requires_grad else None


def _are_alike(image: Tensor, other: Tensor) -> bool:
    return image.shape == other.shape and image.device == other.device and image.dtype == other.dtype


def _fits(image: Tensor) -> bool:
    return image.ndim in (3, 4) and image.shape[-3] == 3 and image.numel() > 0 and image.dtype == torch.float32


def _has_kernels(image: Tensor) -> bool:
    on_gpu = image.device.type != "cpu"
    return not on_gpu or photometric_loss.triton_works(image) or photometric_loss.fused_ssim() is not None


def _has_one_kernel(image: Tensor) -> bool:
    """Return whether one kernel computes L1 and SSIM of an image; on a CPU nothing would be gained."""
    return photometric_loss.triton_works(image)


def _our_ssim(image: Tensor, other: Tensor) -> Tensor:
    return 1.0 - photometric_loss.photometric_loss(image, other, ssim_weight=1.0)


def _ssim_of_loss(image: Tensor, other: Tensor) -> Tensor:
    return 1.0 - photometric_loss.loss_and_l1(image, other, 1.0)[0]


def _l1_of_loss(image: Tensor, other: Tensor) -> Tensor:
    return photometric_loss.loss_and_l1(image, other, 0.2)[1]


def _difference(
    original: Callable[..., Any], device: torch.device, ours: Callable[[Tensor, Tensor], Tensor] = _our_ssim
) -> float:
    """Return how far a function is from our SSIM and gradient of two images; its own are computed in float64."""
    return _apart(ours, lambda image, other: original(image.double(), other.double()), device)


def _loss_difference(original: Callable[..., Any], device: torch.device) -> float:
    """Return how far a function of images is from SSIM in our loss."""
    return _difference(original, device, _ssim_of_loss)


def _batch_difference(original: Callable[..., Any], device: torch.device) -> float:
    """Return how far a function of batches is from SSIM in our loss; compiled ones take nothing but float32."""
    return _apart(_ssim_of_loss, lambda image, other: original(image[None], other[None]), device)


def _l1_difference(original: Callable[..., Any], device: torch.device) -> float:
    """Return how far a function is from L1 in our loss, in units in which as much is allowed as for SSIM."""
    return _apart(_l1_of_loss, original, device) / L1_PRECISION


def _apart(ours: Callable[..., Tensor], theirs: Callable[..., Tensor], device: torch.device) -> float:
    """Return the larger of the differences of two functions' values and, relative, of their gradients."""
    generator = torch.Generator().manual_seed(0)
    other = torch.rand(3, 29, 43, generator=generator)
    image = (other + 0.2 * torch.randn(3, 29, 43, generator=generator)).to(device).requires_grad_()
    other = other.to(device)
    results = []
    for function in (ours, theirs):
        value = function(image, other)
        (gradient,) = torch.autograd.grad(value, image)
        results.append((value.detach(), gradient))
    (our_value, our_gradient), (their_value, their_gradient) = results
    differences = (our_value - their_value).abs(), (our_gradient - their_gradient).abs() / their_gradient.abs().max()
    return largest(differences)
