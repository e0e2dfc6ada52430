"""Keep PyTorch's unused GPU memory while a checkout controls density, where there is room.

Methods of the family call `torch.cuda.empty_cache()` each time. CUDA then takes back every unused block, waits for the
GPU to do so, and the next iteration asks for most of them again, one by one. Out of memory PyTorch frees them itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from lapgs_plugin.checkouts.attachment import replaced

LARGEST_SHARE = 1 / 8
"""Share of a GPU's memory up to which unused memory is kept."""


@contextmanager
def keeping_memory() -> Iterator[None]:
    """Let `torch.cuda.empty_cache()` do nothing inside, as long as little memory is unused."""
    if not torch.cuda.is_available():
        yield
        return
    empty_cache = torch.cuda.empty_cache

    def empty_if_large() -> None:
        device = torch.cuda.current_device()
        unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        if unused > LARGEST_SHARE * torch.cuda.get_device_properties(device).total_memory:
            empty_cache()

    with replaced(vars(torch.cuda), {"empty_cache": empty_if_large}):
        yield
