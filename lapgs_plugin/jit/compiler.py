"""Compile kernels with Numba, keep their machine code on disk, and print a line when the user waits for that."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numba.core.caching
import numba.core.event

from lapgs_plugin.jit import lowering as _lowering  # noqa: F401  # registers the functions of `lanes` with Numba
from lapgs_plugin.jit.notice import say_compiling

# Versions of Numba differ in how much they annotate.
njit: Any = numba.njit
caching: Any = numba.core.caching
event: Any = numba.core.event

_F = TypeVar("_F", bound=Callable[..., Any])

_HERE = Path(__file__).parent
_SHARED = tuple(_HERE / f"{name}.py" for name in ("compiler", "lowering", "lanes"))


def jit(function: _F) -> _F:
    """Compile a module-level function, once for each combination of argument types.

    The GIL is released while it runs. Division by zero gives inf or nan as in NumPy.

    The machine code is cached on disk beside the module, else in the user's cache folder, unless neither can be
    written. The cache is valid until one of these files changes: the function's own, those of `_SHARED`, and `layout`,
    `in_torch` and `*_kernels` modules in the same folder or the one above. Helpers and constants of kernels must live
    in one of these.
    """
    compiled: Any = njit(nogil=True, error_model="numpy")(function)
    with suppress(RuntimeError):  # Numba found no folder to write to
        compiled._cache = _Cache(function)
    result: _F = compiled
    return result


def inline(function: _F) -> _F:
    """Compile a helper that is always inlined into the kernels that call it; it has no cache of its own."""
    compiled: _F = njit(nogil=True, error_model="numpy", forceinline=True)(function)
    return compiled


class _Cache(caching.FunctionCache):  # type: ignore[misc]  # see above
    """Invalidate cached code when the file of a helper changes, too. Numba checks the function's file alone."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = (self._impl.locator.get_source_stamp(), _helpers_stamp(Path(inspect.getfile(function)).parent))
        self._cache_file = caching.IndexDataCacheFile(self._cache_path, self._impl.filename_base, stamp)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code; on a full disk this process continues and the next one compiles again."""
        with suppress(OSError):
            super().save_overload(sig, data)


@lru_cache(maxsize=16)
def _helpers_stamp(folder: Path) -> str:
    """Hash the files whose functions and constants kernels in `folder` may use."""
    names = "layout.py", "in_torch.py", "*_kernels.py"
    nearby = [path for searched in (folder, folder.parent) for name in names for path in sorted(searched.glob(name))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in (*_SHARED, *nearby))).hexdigest()


class _CompilationNotice(event.Listener):  # type: ignore[misc]  # see above
    """Tell the user that kernels are being compiled; loading them from the cache is silent."""

    def on_start(self, event: Any) -> None:
        if event.data["dispatcher"].py_func.__module__.startswith("lapgs_plugin."):
            say_compiling("CPU")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompilationNotice())
