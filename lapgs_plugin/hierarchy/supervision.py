"""What a stage's prediction is compared with, and the photometric loss that compares them."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from functools import lru_cache
from importlib import import_module

import torch
import torch.nn.functional as F
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.ops.self_check import largest, matches_reference

DEFAULT_SSIM_WEIGHT = 0.2
"""Lambda of 3DGS's loss (1 - lambda) L1 + lambda (1 - SSIM)."""

SSIM_RADIUS, SSIM_SIGMA = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""SSIM as 3DGS trains with it: an 11x11 Gaussian window, and the stabilisers for a dynamic range of 1."""


class Supervision(str, Enum):
    """How a residual stage is supervised (the paper's section on loss design). The base has only one way.

    Notation: I^l is level l of the ground truth's Gaussian pyramid, I_hat^l the composed prediction, R_hat^l the
    rendered residual, I_hat^l = Up(I_hat^(l+1)) + R_hat^l.
    """

    RECONSTRUCTED = "reconstructed"
    """I_hat^l against I^l: the default. Later levels mend the errors of earlier ones."""
    ONLINE_RESIDUAL = "online_residual"
    """R_hat^l against I^l - Up(I_hat^(l+1)), the residual of what was predicted so far."""
    GT_LAPLACIAN = "gt_laplacian"
    """R_hat^l against I^l - Up(I^(l+1)), the ground truth's own Laplacian."""


def parse_supervision(name: str) -> Supervision:
    """The supervision called `name`.

    Raises:
        UserInputError: there is none of that name.
    """
    try:
        return Supervision(name)
    except ValueError as error:
        known = ", ".join(supervision.value for supervision in Supervision)
        raise UserInputError(f"--supervision {name}: expected {known}") from error


def supervised_pair(
    supervision: Supervision,
    image: Tensor,
    target: Tensor,
    accumulated: Tensor | None = None,
    coarse_target: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The two images that the photometric loss compares.

    Args:
        supervision: which of the three.
        image: (3, h, w) composed prediction I_hat^l; all of several views have one more dimension, (b, 3, h, w).
        target: (3, h, w) ground truth I^l.
        accumulated: (3, h, w) Up(I_hat^(l+1)), None for the base field, which is always compared with its target.
        coarse_target: (3, h, w) Up(I^(l+1)), looked at by GT_LAPLACIAN alone.

    Returns:
        Prediction and target, shaped as given; for the residual supervisions both are signed.
    """
    if accumulated is None or supervision is Supervision.RECONSTRUCTED:
        return image, target
    if supervision is Supervision.ONLINE_RESIDUAL:
        return image - accumulated, target - accumulated
    assert coarse_target is not None, "gt_laplacian needs Up of the coarser target"
    return image - accumulated, target - coarse_target


def photometric_loss(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """3DGS's loss, (1 - ssim_weight) L1 + ssim_weight (1 - SSIM), differentiable with respect to the prediction.

    On the CPU a fused kernel computes it together with its gradient. On a GPU SSIM comes from the package `fused_ssim`
    where that is installed, else from plain PyTorch.

    Args:
        prediction, target: (3, h, w), or (b, 3, h, w) of several views; the target without gradient.
        ssim_weight: lambda, in [0, 1].

    Returns:
        The loss, a scalar: of several views the mean of theirs.
    """
    if prediction.device.type == "cpu":
        from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu

        if prediction.ndim == 4:
            each = zip(prediction.unbind(), target.unbind(), strict=True)
            return torch.stack([photometric_loss_cpu(*pair, ssim_weight) for pair in each]).mean()
        return photometric_loss_cpu(prediction, target, ssim_weight)
    fused = fused_ssim()
    if fused is None or prediction.dtype != torch.float32:
        return photometric_loss_torch(prediction, target, ssim_weight)
    if _l1_in_triton():
        from lapgs_plugin.ops.photometric_loss.in_triton import weighted_l1

        # Numbers that only scale others cost a launch each, and another on the way back.
        rest = weighted_l1(prediction.contiguous(), target.contiguous(), 1.0 - ssim_weight, ssim_weight)
        return torch.sub(rest, fused(*_batches(prediction, target)), alpha=ssim_weight)
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - fused(*_batches(prediction, target)))


def _batches(*images: Tensor) -> tuple[Tensor, ...]:
    """Each (3, h, w) or (b, 3, h, w) as (b, 3, h, w)."""
    return tuple(image if image.ndim == 4 else image[None] for image in images)


@lru_cache(maxsize=1)
def _l1_in_triton() -> bool:
    def difference() -> float:
        from lapgs_plugin.ops.photometric_loss.in_triton import weighted_l1

        target = torch.linspace(0, 1, 3000, device="cuda")
        prediction = (2 * target.square()).requires_grad_()
        losses = weighted_l1(prediction, target, 0.8, 0.2), 0.2 + 0.8 * (prediction - target).abs().mean()
        gradients = [torch.autograd.grad(3.0 * loss, prediction)[0] * len(target) for loss in losses]
        pairs = (losses, gradients)
        return largest((one - other).abs() for one, other in pairs)

    return matches_reference("L1 in several operations instead of one kernel", difference, 1e-4)


@lru_cache(maxsize=1)
def fused_ssim() -> Callable[[Tensor, Tensor], Tensor] | None:
    """The function of that name from the package `fused_ssim`, mean SSIM of (b, c, h, w) images; None without it."""
    try:
        found: Callable[[Tensor, Tensor], Tensor] = import_module("fused_ssim").fused_ssim
    except ImportError:
        return None
    return found


def photometric_loss_torch(prediction: Tensor, target: Tensor, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> Tensor:
    """`photometric_loss` in plain PyTorch, on any device."""
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(prediction, target))


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of two images as 3DGS computes it, a differentiable scalar, 1 for equal images.

    An 11x11 Gaussian window of sigma 1.5, zeros outside the image, averaged over all pixels and channels, nothing
    clamped (Wang et al. 2004, equation 13).

    Args:
        prediction, target: (3, h, w), any float type; or (b, 3, h, w), whose mean is that of all images.
    """
    prediction, target = (image.reshape(-1, *image.shape[-2:]) for image in (prediction, target))  # (3 b, h, w)
    products = torch.stack(
        [prediction, target, prediction * prediction, target * target, prediction * target]
    )  # (5, 3 b, h, w)
    mean_p, mean_t, mean_pp, mean_tt, mean_pt = _window_mean(products)
    var_p, var_t, covariance = mean_pp - mean_p**2, mean_tt - mean_t**2, mean_pt - mean_p * mean_t
    luminance = (2 * mean_p * mean_t + SSIM_C1) / (mean_p**2 + mean_t**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (var_p + var_t + SSIM_C2)
    similarity: Tensor = (luminance * structure).mean()
    return similarity


def _window_mean(images: Tensor) -> Tensor:
    """Gaussian-weighted mean around each pixel of (n, c, h, w), separably, zeros outside."""
    n, c, h, w = images.shape
    window = _window(images.dtype, images.device)  # (11,)
    flat = images.reshape(n * c, 1, h, w)
    flat = F.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, SSIM_RADIUS))
    flat = F.conv2d(flat, window.view(1, 1, -1, 1), padding=(SSIM_RADIUS, 0))
    return flat.reshape(n, c, h, w)


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # kept for others, who may need gradients
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(device, dtype)


def joint_from(stage: Stage, share: float, supervision: Supervision) -> int | None:
    """The first iteration of a stage's last `share`, in which the finished fields are trained along; counted from 1.

    None when there is none: in the base's stage, where the share is less than an iteration, and where residuals are
    supervised alone, since nothing is composed there.

    >>> joint_from(Stage(0, (800, 533), 20_000, signed=True), 0.25, Supervision.RECONSTRUCTED)
    15001
    """
    if not stage.signed or supervision is not Supervision.RECONSTRUCTED:
        return None
    first = stage.iterations - round(stage.iterations * share) + 1
    return first if first <= stage.iterations else None
