"""Compare our Triton kernels with PyTorch on this machine before their first use."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

Difference = Callable[[torch.device], float]


class SelfCheck:
    """Decide whether Triton kernels are used here: they have to compile and to agree with PyTorch's operations.

    The comparison runs when it is first asked for, and its answer is kept. The log says when kernels fail it.

    Args:
        difference: runs both versions on a device and returns the largest difference between them.
        fallback: operations used instead of the kernels, for the log.
        limit: largest difference that counts as rounding.
    """

    def __init__(self, difference: Difference, fallback: str, limit: float) -> None:
        self.difference, self._fallback, self._limit = difference, fallback, limit
        self._passed: bool | None = None

    def __call__(self, *tensors: Tensor) -> bool:
        """Return whether the kernels can be used, and for these tensors: float32 on a CUDA device."""
        for tensor in tensors:  # several times an iteration, where `any` and `device.type` take longer
            if not tensor.is_cuda or tensor.dtype is not torch.float32:
                return False
        if self._passed is None:
            self._passed = self.passes_on(torch.device("cuda"))
        return self._passed

    def passes_on(self, device: torch.device) -> bool:
        """Run the comparison now."""
        try:
            # Whatever mode the caller is in, and whichever device it lets new tensors be on.
            with torch.inference_mode(False), torch.enable_grad(), torch.device("cpu"):
                difference = self.difference(device)
        except ImportError as error:  # Triton comes with PyTorch for CUDA on Linux only
            logger.info("%s: %s", self._fallback, _in_one_line(error))
            return False
        except Exception as error:  # Triton reports a missing C compiler and the like in errors of many classes
            logger.warning("%s: %s", self._fallback, _in_one_line(error))
            return False
        if not difference <= self._limit:
            logger.warning("%s, because our kernels are off by %g here", self._fallback, difference)
            return False
        return True


def _in_one_line(error: BaseException) -> str:
    """Return the first cause of an error; Triton's errors show source code before they name it."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = str(getattr(error, "error_message", None) or error).strip()
    return text.split("\n")[0] or type(error).__name__


def matches_reference(fallback: str, limit: float) -> Callable[[Difference], SelfCheck]:
    """Make a `SelfCheck` of a function that returns the largest difference between kernels and PyTorch."""
    return lambda difference: SelfCheck(difference, fallback, limit)


def is_rows(value: Any, columns: int) -> bool:
    """Return whether a value is a tensor that kernels read: contiguous rows of float32, not empty."""
    is_float = isinstance(value, Tensor) and value.dtype == torch.float32 and value.ndim == 2
    return is_float and value.shape[1] == columns and value.is_contiguous() and len(value) > 0


def largest(values: Iterable[Tensor]) -> float:
    """Return the largest number in tensors, none of them empty; NaN if they hold one."""
    return float(torch.stack([value.detach().max() for value in values]).max())
