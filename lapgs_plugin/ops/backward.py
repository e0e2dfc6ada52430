"""Propagate a loss back with less of PyTorch's Python."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.autograd import Variable


def backward(loss: Tensor, scale: float = 1.0) -> None:
    """Do `(scale * loss).backward()`; `loss` is a plain tensor of one number, (), on any device.

    `Tensor.backward` would fill a tensor in each call. For a gradient that it is given it imports SymPy at the first
    one, which takes a second or two.
    """
    gradient = _number(scale, loss.dtype, loss.device)
    Variable._execution_engine.run_backward(
        (loss,), (gradient,), False, False, (), allow_unreachable=True, accumulate_grad=True
    )


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _number(value: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a number as a cached tensor, which must not be written to."""
    return torch.full((), value, dtype=dtype, device=device)
