"""Shake a checkout's positions in one kernel, where its own statements do the same.

Two of them multiply a matrix of three rows for each Gaussian, for which PyTorch has no fast way, and there are 16
launches more. Noise is drawn by PyTorch, as in the checkout, so that its generators stay as they would be.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import FunctionType
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.noise_statements import SHAKE, NoiseStatements
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.ops import position_noise
from lapgs_plugin.ops.position_noise.in_torch import FAINT, SHARPNESS
from lapgs_plugin.ops.scaled_rotations import examples
from lapgs_plugin.ops.scaled_rotations.in_torch import scaled_rotations_torch
from lapgs_plugin.ops.self_check import SelfCheck, is_rows, largest

LARGEST_DIFFERENCE = 1e-4
"""Largest difference of scaled rotations, for scales below 4, and of the noise's share that counts as rounding."""

_agreeing: dict[tuple[Any, ...], bool] = {}


def in_one_kernel(training: Callable[..., Any]) -> Callable[..., Any]:
    """Return a script's training function, changed so that one kernel shakes positions."""
    if getattr(training, "__globals__", {}).get("torch") is not torch:
        return training
    return rewritten(training, NoiseStatements, {SHAKE: _shake})


def _shake(build: Any, fading: Any, model: Any, *factors: Any) -> bool:
    """Shake the positions of a model; return False, and change nothing, if the checkout's statements have to.

    Args:
        build: makes scaled rotations.
        fading: of one minus opacities, the share of the noise.
        model: the checkout's.
        factors: numbers.
    """
    means: Any = getattr(model, "_xyz", None)
    if torch.is_grad_enabled() or not is_rows(means, 3) or not _has_kernels(means):
        return False
    if not all(isinstance(factor, (int, float)) for factor in factors) or not _agree(build, fading, means.device):
        return False
    tensors = model.get_scaling, model.get_rotation, model.get_opacity
    n, device = len(means), means.device
    if not all(
        is_rows(tensor, columns) and len(tensor) == n and tensor.device == device
        for tensor, columns in zip(tensors, (3, 4, 1), strict=True)
    ):
        return False
    amount = 1.0
    for factor in factors:
        amount *= float(factor)
    position_noise.shake(means, torch.randn_like(means), *tensors, amount)
    return True


def _has_kernels(means: Tensor) -> bool:
    """Return whether a kernel shakes positions; on a CPU the checkout's own statements do."""
    return position_noise.given_noise_works(means)


def _agree(build: Any, fading: Any, device: torch.device) -> bool:
    """Return whether two functions of a checkout are those of our kernel; one may be defined in each iteration."""
    if not isinstance(build, FunctionType) or not isinstance(fading, FunctionType) or fading.__closure__ is not None:
        return False
    code, defaults = fading.__code__, fading.__defaults__ or ()
    if fading.__kwdefaults__ or not all(isinstance(default, (int, float)) for default in defaults):
        return False
    if any(name != "torch" and name in fading.__globals__ for name in code.co_names):  # which may change
        return False
    key = build, code, defaults, device
    if key not in _agreeing:
        check = SelfCheck(
            partial(_difference, build, fading), "noise of positions as in the checkout", LARGEST_DIFFERENCE
        )
        _agreeing[key] = check.passes_on(device)
    return _agreeing[key]


def _difference(build: Callable[..., Tensor], fading: Callable[..., Tensor], device: torch.device) -> float:
    """Return how far the functions are from ours for some Gaussians."""
    scales, quaternions = examples(device)
    left = torch.linspace(0.0, 1.0, 3000, device=device)
    share = torch.sigmoid(SHARPNESS * (left - (1.0 - FAINT)))
    matrices = build(scales, quaternions) - scaled_rotations_torch(scales, quaternions)
    return largest([matrices.abs(), (fading(left) - share).abs()])
