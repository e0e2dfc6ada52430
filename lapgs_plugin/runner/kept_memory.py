"""Keep PyTorch's unused GPU memory while a checkout's model densifies, where there is room.

Models of the family call `torch.cuda.empty_cache()` each time. CUDA then takes back every unused block, waits for the
GPU to do so, and the next iteration asks for most of them again, one by one. Out of memory PyTorch frees them itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch

from lapgs_plugin.checkouts.attachment import replaced

LARGEST_SHARE = 1 / 8
"""Share of a GPU's memory up to which unused memory is kept."""


def keeping_memory(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method in which `torch.cuda.empty_cache()` does nothing, as long as little memory is unused."""

    @wraps(method)
    def keeping(*args: Any, **kwargs: Any) -> Any:
        empty_cache = torch.cuda.empty_cache

        def empty_if_large() -> None:
            if not torch.cuda.is_available() or _unused_share() > LARGEST_SHARE:
                empty_cache()

        with replaced(vars(torch.cuda), {"empty_cache": empty_if_large}):
            return method(*args, **kwargs)

    return keeping


def _unused_share() -> float:
    """Return how much of the GPU's memory PyTorch has and does not use."""
    device = torch.cuda.current_device()
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return unused / torch.cuda.get_device_properties(device).total_memory
