"""Provide explicit 16-lane vectors for compiled kernels: `Lanes` of floats and `Mask` of booleans.

LLVM vectorises only loops that it fully understands, and skips others silently. These functions make vectors explicit:
a call is one LLVM vector instruction or a few. In float32 such an instruction becomes one AVX-512, two AVX2 or four SSE
or NEON instructions, in float64 twice as many.

The functions work in code compiled by `compiler.jit`; `lowering` registers them with Numba. In Python they only carry
types, and calling them is a bug. No fast-math flag is set, so equal expressions give equal bits in different kernels.

An index must be in range: nothing is checked, and a negative one does not count from the end.
"""

from __future__ import annotations

from typing import Any, Literal, NoReturn, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

WIDTH = 16
"""Lanes of a vector."""


class Mask(Protocol):
    """Hold one boolean for each lane."""

    def __and__(self, other: Mask) -> Mask: ...
    def __or__(self, other: Mask) -> Mask: ...


class Lanes(Protocol):
    """Hold one float for each lane; a float operand stands for all lanes."""

    def __add__(self, other: Lanes | float) -> Lanes: ...
    def __radd__(self, other: float) -> Lanes: ...
    def __sub__(self, other: Lanes | float) -> Lanes: ...
    def __rsub__(self, other: float) -> Lanes: ...
    def __mul__(self, other: Lanes | float) -> Lanes: ...
    def __rmul__(self, other: float) -> Lanes: ...
    def __truediv__(self, other: Lanes | float) -> Lanes: ...
    def __rtruediv__(self, other: float) -> Lanes: ...
    def __neg__(self) -> Lanes: ...
    def __ge__(self, other: Lanes | float) -> Mask: ...
    def __le__(self, other: Lanes | float) -> Mask: ...
    def __gt__(self, other: Lanes | float) -> Mask: ...
    def __lt__(self, other: Lanes | float) -> Mask: ...


Lanes3 = tuple[Lanes, Lanes, Lanes]
Lanes4 = tuple[Lanes, Lanes, Lanes, Lanes]
Floats = NDArray[np.floating[Any]]
_Array = TypeVar("_Array", bound=NDArray[Any])


def _compiled_only() -> NoReturn:
    raise AssertionError("lanes exist in compiled kernels only")


def borrowed(array: _Array) -> _Array:
    """Return the array as a bare pointer, for the functions of this module and for indexing: no bounds, no reference
    count, no negative indices.

    Numba counts references atomically. In an inner loop this can cost more than the arithmetic, most of all when
    several threads count references to the same array. Arguments of a kernel outlive it; an array that a kernel makes
    must be passed to `keep_alive` after the last use of the pointer.
    """
    _compiled_only()


def keep_alive(array: NDArray[Any]) -> None:
    """Keep an array alive until here."""
    _compiled_only()


def load(array: Floats, start: int) -> Lanes:
    """Load array[start : start + 16] of a contiguous array."""
    _compiled_only()


def prefetch(array: NDArray[Any], index: int) -> None:
    """Prefetch the cache line of array[index], which may be out of range."""
    _compiled_only()


def store(array: Floats, start: int, value: Lanes) -> None:
    """Store array[start : start + 16] = value."""
    _compiled_only()


def splat(like: Floats, value: float) -> Lanes:
    """Return the same value in each lane, of the type of the array's elements."""
    _compiled_only()


def fma(a: Lanes | float, b: Lanes | float, c: Lanes | float) -> Lanes:
    """Return a * b + c, rounded once where the machine can; at least one operand is a vector."""
    _compiled_only()


def minimum(a: Lanes | float, b: Lanes | float) -> Lanes:
    """Return the smaller of both, b where a is NaN."""
    _compiled_only()


def maximum(a: Lanes | float, b: Lanes | float) -> Lanes:
    """Return the larger of both, b where a is NaN."""
    _compiled_only()


def absolute(a: Lanes) -> Lanes:
    """Return |a|."""
    _compiled_only()


def sqrt(a: Lanes) -> Lanes:
    """Return the square root."""
    _compiled_only()


def floor(a: Lanes) -> Lanes:
    """Return the largest whole number not above a."""
    _compiled_only()


def ceil(a: Lanes) -> Lanes:
    """Return the smallest whole number not below a."""
    _compiled_only()


def log2(a: Lanes) -> Lanes:
    """Return the logarithm to base 2, lane by lane from the C library: not for inner loops."""
    _compiled_only()


def exp(a: Lanes) -> Lanes:
    """Return e^a as accurate as `exp2`, with a clamped to +-87 (float32) or +-708 (float64); NaN is the upper bound."""
    _compiled_only()


def select(mask: Mask, a: Lanes | float, b: Lanes | float) -> Lanes:
    """Return a where the mask is set, b elsewhere; one of the two is a vector."""
    _compiled_only()


def exp2(a: Lanes) -> Lanes:
    """Return 2^a to a relative error of 3e-7 (float32) or 2e-16 (float64); undefined outside of the type's range."""
    _compiled_only()


def bits(mask: Mask) -> int:
    """Return the mask as an integer, lane i in bit i."""
    _compiled_only()


def any_lane(mask: Mask) -> bool:
    """Return whether the mask is set in any lane."""
    _compiled_only()


def store_sums(array: Floats, start: int, *values: Lanes) -> None:
    """Set array[start + i] to the sum of the lanes of values[i], added in a fixed order, for up to 16 vectors.

    16 elements are written: those beyond the number of vectors become zero.
    """
    _compiled_only()


@overload
def load_columns(array: Floats, start: int, columns: Literal[3]) -> Lanes3: ...
@overload
def load_columns(array: Floats, start: int, columns: Literal[4]) -> Lanes4: ...
def load_columns(array: Floats, start: int, columns: Literal[3, 4]) -> tuple[Lanes, ...]:
    """Load the columns of 16 consecutive rows: vector c holds array[start + c + columns * lane]."""
    _compiled_only()


def store_columns(array: Floats, start: int, *values: Lanes) -> None:
    """Invert `load_columns`: store one vector for each of 2 to 4 columns."""
    _compiled_only()


def load_rows(array: Floats, start: int, stride: int) -> tuple[Lanes, ...]:
    """Load a 16x16 matrix, transposed: vector c holds array[start + c + stride * lane]."""
    _compiled_only()


def store_rows(array: Floats, start: int, stride: int, *values: Lanes) -> None:
    """Invert `load_rows` for up to 16 vectors; all 16 elements of a row are written, the others as zero."""
    _compiled_only()


def store_whole(array: NDArray[np.int32], start: int, *values: Lanes) -> None:
    """Store 1 to 4 vectors of whole numbers as integers, arranged as by `store_columns`."""
    _compiled_only()


def lowest_bit(value: int) -> int:
    """Return the position of the lowest set bit of a positive integer."""
    _compiled_only()


def fetch_add(counter: NDArray[np.int64], amount: int) -> int:
    """Add `amount` to counter[0] atomically and return its value before."""
    _compiled_only()
