"""Say that the user waits for kernels to be compiled."""

from __future__ import annotations

import sys
from functools import lru_cache


@lru_cache
def say_compiling(processor: str) -> None:
    """Print a line once in a process for each kind of processor, "CPU" or "GPU": above a script's progress bar."""
    line = f"compiling {processor} kernels, which may take a minute; later runs load them from a cache ..."
    if (tqdm := sys.modules.get("tqdm")) is not None:
        tqdm.tqdm.write(line, file=sys.stderr)
    else:
        print(line, file=sys.stderr)
    sys.stderr.flush()
