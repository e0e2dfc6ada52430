"""The one way kernels are compiled: Numba's njit with types kept, a cache on disk, and a word to who waits for it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba.core.caching
import numba.core.event

from lapgs_plugin.jit import lowering as _lowering  # noqa: F401  # teaches Numba the functions of `lanes`

# Versions of Numba differ in how much of this is annotated, so nothing is taken to be.
njit: Any = numba.njit
caching: Any = numba.core.caching
event: Any = numba.core.event

_F = TypeVar("_F", bound=Callable[..., Any])

_HERE = Path(__file__).parent
_SHARED = (
    *(_HERE / f"{name}.py" for name in ("_jit", "_lowering", "lanes", "layout")),
    *sorted(_HERE.glob("*_kernels.py")),
)
_SHARED_STAMP = hashlib.sha256(b"".join(path.read_bytes() for path in _SHARED)).hexdigest()


def jit(function: _F) -> _F:
    """Compile a module-level function, once for each combination of argument types.

    The GIL is released while it runs. Division by zero gives inf or nan as in NumPy.

    The machine code is cached on disk: beside the module, where that folder is read-only in the user's cache folder, or
    not at all where neither can be written. It is kept until the module's own file, `lanes`, `layout` or any of the
    `*_kernels` modules changes, so helpers that kernels call must live in one of these.
    """
    compiled: Any = njit(nogil=True, error_model="numpy")(function)
    with suppress(RuntimeError):  # Numba found no folder to write to
        compiled._cache = _Cache(function)
    result: _F = compiled
    return result


def inline(function: _F) -> _F:
    """Compile a helper that is always merged into the kernels that call it; it has no cache of its own."""
    compiled: _F = njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return compiled


class _Cache(caching.FunctionCache):  # type: ignore[misc]  # see above
    """Numba's cache, which looks at the file of the function alone, made to notice changes of the helpers it calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _SHARED_STAMP)
        self._cache_file = caching.IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code; on a full disk the next process compiles again, and this one goes on."""
        with suppress(OSError):
            super().save_overload(sig, data)


class _Announcement(event.Listener):  # type: ignore[misc]  # see above
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
