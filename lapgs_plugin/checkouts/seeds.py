"""Let the seed of a run decide the random choices of a script that sets seeds of its own."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any

import numpy as np
import torch

from lapgs_plugin.checkouts.attachment import replaced

SEEDED: tuple[tuple[Any, str], ...] = (
    *((random, "seed"), (np.random, "seed"), (torch, "manual_seed")),
    *((torch.cuda, "manual_seed"), (torch.cuda, "manual_seed_all")),
)
"""Functions that scripts seed generators with. PyTorch's own calls the last one for those of CUDA devices."""


@contextmanager
def moved_seeds(by: int) -> Iterator[None]:
    """Add a number to the seeds that are set meanwhile. 3DGS and its forks set 0, whatever run it is.

    Args:
        by: from 0, which leaves seeds as they are, to below 2^32.
    """
    seeding = threading.local()
    with ExitStack() as stack:
        for owner, name in SEEDED if by else ():
            stack.enter_context(replaced(vars(owner), {name: _moved(getattr(owner, name), by, seeding)}))
        yield


def _moved(seed: Callable[..., Any], by: int, seeding: threading.local) -> Callable[..., Any]:
    """Return a function that moves a seed, unless it is called by another such function, which has moved it."""

    def sum_of(value: Any) -> Any:
        return (value + by) % 2**32 if isinstance(value, int) else value

    @wraps(seed)
    def moved(*values: Any, **named: Any) -> Any:
        if getattr(seeding, "now", False):
            return seed(*values, **named)
        seeding.now = True
        try:
            return seed(*map(sum_of, values), **{name: sum_of(value) for name, value in named.items()})
        finally:
            seeding.now = False

    return moved
