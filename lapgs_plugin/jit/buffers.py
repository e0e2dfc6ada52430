"""Reuse the memory of large arrays, because the first write to fresh memory costs as much as a kernel.

The memory of an array from `empty` is free again when the array, all its views and all tensors made of it are gone. If
PyTorch holds the array as a `.grad`, this is when the optimizer drops it.
"""

from __future__ import annotations

import threading
import weakref
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

ALIGNMENT = 64
"""Bytes of a cache line, and of the widest vector."""

SMALL = 2**20
"""Size in bytes below which arrays come from the system's allocator, which reuses such memory itself."""

PATIENCE = 100
"""Number of requests, those of some six iterations, after which an unused block is returned to the system."""


class _Block:
    """Hold aligned memory.

    Attributes:
        size: in bytes.
        memory: the bytes, a few more than `size`.
        start: index of the first aligned byte.
        returned: number of requests to the store before the block was returned to it.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        memory = np.empty(size + ALIGNMENT, np.uint8)
        self.start = -memory.ctypes.data % ALIGNMENT
        # A memoryview, because views of an array made of it keep that array alive, and not this one.
        self.memory = memory.data
        self.returned = 0


class _Store:
    """Keep free blocks."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # an array may be collected while its own thread is in `take`
        self._free: list[_Block] = []
        self._requests = 0

    def take(self, size: int) -> _Block:
        # Rounded up to one of four sizes between powers of two, since sizes vary from view to view.
        step = 2 ** (size.bit_length() - 3)
        size = -(-size // step) * step
        with self._lock:
            self._requests += 1
            self._free = [block for block in self._free if self._requests - block.returned < PATIENCE]
            for i in range(len(self._free) - 1, -1, -1):  # the latest may still be in the cache
                if self._free[i].size == size:
                    return self._free.pop(i)
            return _Block(size)

    def give_back(self, block: _Block) -> None:
        with self._lock:
            block.returned = self._requests
            self._free.append(block)


_store = _Store()


def empty(size: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return a writable array of `size` uninitialised elements, aligned for vectors."""
    kind = np.dtype(dtype)
    needed = size * kind.itemsize
    if needed < SMALL:
        memory = np.empty(needed + ALIGNMENT, np.uint8)
        return np.frombuffer(memory, kind, size, -memory.ctypes.data % ALIGNMENT)
    block = _store.take(needed)
    array = np.frombuffer(block.memory, kind, size, block.start)
    weakref.finalize(array, _store.give_back, block).atexit = False
    return array
