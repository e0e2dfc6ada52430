"""Make a checkout's scaled rotations in one kernel, where its own function returns the same.

Loops with MCMC's noise make them of all Gaussians in every iteration, in some 65 launches.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.ops.scaled_rotations import examples, scaled_rotations
from lapgs_plugin.ops.self_check import SelfCheck, largest

NAME = "build_scaling_rotation"
"""The function's name in the family: of scales (n, 3) and quaternions (n, 4)."""

LARGEST_DIFFERENCE = 1e-5
"""Largest difference, for scales below 4, that counts as rounding."""


def in_our_kernel(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return the replacement of a function that makes scaled rotations. Where it differs from ours, it is called."""
    name = f"{original.__module__}.{original.__qualname__} of the checkout"
    agrees = SelfCheck(partial(_difference, original), name, LARGEST_DIFFERENCE)

    @wraps(original)
    def build(*args: Any, **kwargs: Any) -> Any:
        suits = not kwargs and _fit(args) and agrees(*args)
        return scaled_rotations(*args) if suits else original(*args, **kwargs)

    return build


def _fit(arguments: tuple[Any, ...]) -> bool:
    if len(arguments) != 2 or not all(isinstance(argument, Tensor) for argument in arguments):
        return False
    scales, quaternions = arguments
    n, recorded = len(scales), torch.is_grad_enabled() and (scales.requires_grad or quaternions.requires_grad)
    alike = scales.shape == (n, 3) and quaternions.shape == (n, 4) and scales.device == quaternions.device
    return n > 0 and alike and not recorded and scales.is_contiguous() and quaternions.is_contiguous()


def _difference(original: Callable[..., Any], device: torch.device) -> float:
    """Return how far a function is from ours for some Gaussians."""
    arguments = examples(device)
    return largest([(scaled_rotations(*arguments) - original(*arguments)).abs()])
