"""Decides, on the machine itself, whether our own GPU kernels compile and agree with PyTorch; callers fall back to
PyTorch's operations where they do not."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

logger = logging.getLogger(__name__)


def matches_reference(otherwise: str, difference: Callable[[], float], limit: float) -> bool:
    """Whether kernels compile here, and give what the slower way gives.

    Args:
        otherwise: what is done where they don't, for the log.
        difference: runs both; how far they are apart.
        limit: how far still counts as rounding.
    """
    try:
        with torch.inference_mode(False), torch.enable_grad():
            found = difference()
    except Exception as error:  # Triton asks for a C compiler, and says what it lacks in errors of many classes
        logger.info("%s: %s", otherwise, str(error).strip().split("\n")[0])
        return False
    if not found <= limit:
        logger.warning("%s, because our kernels are off by %g here", otherwise, found)
        return False
    return True


def largest(values: Iterable[Tensor]) -> float:
    """The largest number in tensors, of which none is empty; NaN where there is one."""
    return float(torch.stack([value.detach().max() for value in values]).max())
