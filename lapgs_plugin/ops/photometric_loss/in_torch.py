"""Compute the photometric loss of 3DGS with kornia's SSIM: the version that the others are checked against."""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor
from torch.nn.functional import pad

from lapgs_plugin.errors import UserInputError

DEFAULT_SSIM_WEIGHT = 0.2
"""Lambda of 3DGS's loss (1 - lambda) L1 + lambda (1 - SSIM)."""

# SSIM of 3DGS: an 11x11 Gaussian window, and the stabilisers for a dynamic range of 1.
SSIM_RADIUS, SSIM_SIGMA = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
_gauss = [math.exp(-(tap**2) / (2 * SSIM_SIGMA**2)) for tap in range(-SSIM_RADIUS, SSIM_RADIUS + 1)]
SSIM_WINDOW = tuple(weight / math.fsum(_gauss) for weight in _gauss)
"""Weights of the window along one side."""


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the mean structural similarity of images (3, h, w) or (b, 3, h, w) as 3DGS computes it, differentiable."""
    return ssim_map_torch(as_batch(prediction), as_batch(target)).mean()


def photometric_loss_torch(
    prediction: Tensor,
    target: Tensor,
    ssim_weight: float = DEFAULT_SSIM_WEIGHT,
    mean_ssim: Callable[[Tensor, Tensor], Tensor] = ssim,
) -> Tensor:
    """Do `photometric_loss` on any device, with a function of the mean SSIM of two images (b, c, h, w)."""
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - mean_ssim(as_batch(prediction), as_batch(target)))


def ssim_map_torch(prediction: Tensor, target: Tensor) -> Tensor:
    """Return SSIM (Wang et al. 2004, equation 13) of each pixel and channel of images (b, c, h, w), in that shape.

    The window is an 11x11 Gaussian of sigma 1.5. Outside of the images are zeros, and nothing is clamped.
    """
    from kornia.metrics import ssim as kornia_ssim  # here, because its import takes longer than one loss

    # kornia mirrors images at their borders; 3DGS pads them with zeros.
    border, width = (SSIM_RADIUS,) * 4, 2 * SSIM_RADIUS + 1
    return kornia_ssim(pad(prediction, border), pad(target, border), width, eps=0.0, padding="valid")


def check_arguments(prediction: Tensor, target: Tensor, ssim_weight: float) -> None:
    """Check the arguments of `photometric_loss`, on any device.

    Raises:
        UserInputError: the images differ in shape or device, their channels come last, the target requires a gradient,
            or the weight leaves [0, 1].
    """
    if prediction.ndim not in (3, 4) or prediction.shape != target.shape or prediction.numel() == 0:
        raise UserInputError(
            f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)}: expected two images of one shape "
            "(channels, height, width); resize the target to the level that is rendered"
        )
    if prediction.device != target.device:
        raise UserInputError(
            f"prediction on {prediction.device} and target on {target.device}: expected one device; move one with "
            ".to(device)"
        )
    if prediction.shape[-1] <= 4 < prediction.shape[-3]:
        raise UserInputError(
            f"images of shape {tuple(prediction.shape)}: expected channels first, (3, h, w); permute them"
        )
    if target.requires_grad:
        raise UserInputError("the target requires a gradient, expected a constant image; pass target.detach()")
    if not 0 <= ssim_weight <= 1:
        raise UserInputError(f"ssim_weight {ssim_weight}: expected a number from 0 to 1, such as 0.2")


def as_batch(image: Tensor) -> Tensor:
    """Return (c, h, w) or (b, c, h, w) as (b, c, h, w)."""
    return image if image.ndim == 4 else image[None]
