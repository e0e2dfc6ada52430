"""Say that the user waits for kernels to be compiled."""

from __future__ import annotations

import sys
from functools import lru_cache


@lru_cache
def say_compiling(processor: str) -> None:
    """Print a line once in a process for each kind of processor, "CPU" or "GPU"."""
    print(f"compiling {processor} kernels; later runs load them from a cache ...", file=sys.stderr, flush=True)
