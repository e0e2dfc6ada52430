"""The one way kernels are compiled: Numba's njit with types kept, a cache on disk, and a word to who waits for it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile

_F = TypeVar("_F", bound=Callable[..., Any])

_HERE = Path(__file__).parent
_COMPILER_STAMP = hashlib.sha256(b"".join((_HERE / name).read_bytes() for name in ("_jit.py", "lanes.py", "layout.py"))).hexdigest()


def jit(function: _F) -> _F:
    """Compile a module-level function, once for each combination of argument types.

    The GIL is released while it runs. Division by zero gives inf or nan as in NumPy. The machine code is cached on disk,
    beside the module or, where that folder is read-only, in the user's cache folder, or not at all where neither can be
    written. It is kept until the module's own file, `lanes` or `layout` changes, so a kernel lives in the same module
    as the helpers it calls.
    """
    compiled: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        compiled._cache = _Cache(function)
    except RuntimeError:  # Numba found no folder to write to; every process compiles then
        pass
    result: _F = compiled
    return result


def inline(function: _F) -> _F:
    """Compile a helper that is always merged into the kernels that call it; it has no cache of its own."""
    compiled: _F = numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return compiled


class _Cache(FunctionCache):  # type: ignore[misc]  # Numba leaves its classes without annotations
    """Numba's cache, which looks at the file of the function alone, made to notice a change of what all kernels share too."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _COMPILER_STAMP)
        self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)


class _Announcement(event.Listener):  # type: ignore[misc]  # as above
    """Says once in a process that kernels are being compiled. Loading them from the cache is silent."""

    def __init__(self) -> None:
        self.made = False

    def on_start(self, event: Any) -> None:
        ours = event.data["dispatcher"].py_func.__module__.startswith(__package__)
        if ours and not self.made:
            self.made = True
            print("compiling the CPU rasterizer, once, for half a minute ...", file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Announcement())
