"""Memory that is used again: with a million pixels, touching fresh memory costs as much as a kernel.

`empty` hands out arrays that find their way back by themselves, when the array, all its views and all tensors made of
it are gone: gradients that PyTorch owns as `.grad` come back when the optimizer drops them.
"""

from __future__ import annotations

import threading
import weakref
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

ALIGNMENT = 64
"""Bytes: a line of the cache, and the widest vector."""
SMALL = 2**20
"""Bytes: less than this, the system's allocator gets from what it has at hand, faster than is possible here."""
PATIENCE = 100
"""Blocks that were not taken during this many requests are given back to the system: some six iterations."""


class _Block:
    """Some bytes, and when they came back."""

    def __init__(self, size: int) -> None:
        self.size = size
        memory = np.empty(size + ALIGNMENT, np.uint8)
        self.start = -memory.ctypes.data % ALIGNMENT
        # A memoryview, so that views of an array made of it keep that array alive and not this one.
        self.memory = memory.data
        self.returned = 0


class _Store:
    """Free blocks."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # an array may be collected, and come back, while its thread is in `take`
        self._free: list[_Block] = []
        self._requests = 0

    def take(self, size: int) -> _Block:
        # Rounded up to one of four sizes between powers of two, since what is asked for varies from view to view.
        step = 2 ** (size.bit_length() - 3)
        size = -(-size // step) * step
        with self._lock:
            self._requests += 1
            self._free = [block for block in self._free if self._requests - block.returned < PATIENCE]
            for i in range(len(self._free) - 1, -1, -1):  # the latest first: it may still be in the cache
                if self._free[i].size == size:
                    return self._free.pop(i)
            return _Block(size)

    def give_back(self, block: _Block) -> None:
        with self._lock:
            block.returned = self._requests
            self._free.append(block)


_store = _Store()


def empty(size: int, dtype: DTypeLike) -> NDArray[Any]:
    """A writable array of `size` elements, aligned for vectors, with anything in it."""
    kind = np.dtype(dtype)
    needed = size * kind.itemsize
    if needed < SMALL:
        memory = np.empty(needed + ALIGNMENT, np.uint8)
        return np.frombuffer(memory, kind, size, -memory.ctypes.data % ALIGNMENT)
    block = _store.take(needed)
    array = np.frombuffer(block.memory, kind, size, block.start)
    weakref.finalize(array, _store.give_back, block).atexit = False
    return array
