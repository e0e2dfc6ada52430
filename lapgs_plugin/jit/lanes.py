"""Explicit 16-lane vectors for compiled kernels: `Lanes` of floats and `Mask` of booleans.

Left to itself LLVM vectorises a loop only while nothing in it looks suspicious, and gives up in silence at three to
four times the cost. Kernels written with the functions below say what is a vector: each call is one LLVM vector
instruction or a few, and each of these becomes one AVX-512, two AVX2 or four SSE or NEON instructions in float32, twice
as many in float64.

The functions work in code compiled by `_jit.jit`, which `_lowering` teaches Numba. In Python they only carry the types,
and calling them is a bug. No fast-math flag is set anywhere, so equal expressions give equal bits in different kernels.

Where an index is asked for, it must be in range: nothing is checked, and negative ones do not count from the end.
"""

from __future__ import annotations

from typing import Any, Literal, NoReturn, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

WIDTH = 16
"""Lanes of a vector."""


class Mask(Protocol):
    """One boolean for each lane."""

    def __and__(self, other: Mask) -> Mask: ...
    def __or__(self, other: Mask) -> Mask: ...


class Lanes(Protocol):
    """One float for each lane; a float beside it is taken for every lane."""

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
    """The array as a bare pointer, for the functions of this module: without bounds, indexing or a reference count.

    Numba counts references atomically, and where it fails to see that it need not, that costs more in an inner loop
    than the arithmetic, most of all when several threads count the same array. Arguments of a kernel outlive it; an
    array that a kernel makes must be named in `keep_alive` after the last use of the pointer.
    """
    _compiled_only()


def keep_alive(array: NDArray[Any]) -> None:
    """Keep an array until here."""
    _compiled_only()


def load(array: Floats, start: int) -> Lanes:
    """array[start : start + 16] of a contiguous array."""
    _compiled_only()


def broadcast(array: Floats, index: int) -> Lanes:
    """array[index] in each lane."""
    _compiled_only()


def at(array: NDArray[Any], index: int) -> Any:
    """array[index]; integers are widened to 64 bits."""
    _compiled_only()


def put(array: NDArray[Any], index: int, value: Any) -> None:
    """array[index] = value."""
    _compiled_only()


def prefetch(array: NDArray[Any], index: int) -> None:
    """Ask the cache for the line of array[index], which may be out of range."""
    _compiled_only()


def store(array: Floats, start: int, value: Lanes) -> None:
    """array[start : start + 16] = value."""
    _compiled_only()


def splat(like: Floats, value: float) -> Lanes:
    """The same value in each lane, of the type of the array's elements."""
    _compiled_only()


def fma(a: Lanes | float, b: Lanes | float, c: Lanes | float) -> Lanes:
    """a * b + c, rounded once where the machine can; at least one operand is a vector."""
    _compiled_only()


def minimum(a: Lanes | float, b: Lanes | float) -> Lanes:
    """The smaller of both, b where a is NaN."""
    _compiled_only()


def maximum(a: Lanes | float, b: Lanes | float) -> Lanes:
    """The larger of both, b where a is NaN."""
    _compiled_only()


def absolute(a: Lanes) -> Lanes:
    """|a|."""
    _compiled_only()


def sqrt(a: Lanes) -> Lanes:
    """Square root."""
    _compiled_only()


def floor(a: Lanes) -> Lanes:
    """Largest whole number not above a."""
    _compiled_only()


def ceil(a: Lanes) -> Lanes:
    """Smallest whole number not below a."""
    _compiled_only()


def log2(a: Lanes) -> Lanes:
    """Logarithm to base 2, lane by lane from the C library: not for inner loops."""
    _compiled_only()


def exp(a: Lanes) -> Lanes:
    """e^a as accurate as `exp2`; outside of +-87 (float32) or +-708 (float64), and for NaN, that of the upper bound."""
    _compiled_only()


def select(mask: Mask, a: Lanes | float, b: Lanes | float) -> Lanes:
    """a where the mask is set, b elsewhere; one of the two is a vector."""
    _compiled_only()


def exp2(a: Lanes) -> Lanes:
    """2^a to a relative error of 3e-7 (float32) or 2e-16 (float64); garbage where that leaves the type's range."""
    _compiled_only()


def bits(mask: Mask) -> int:
    """The mask as an integer, lane i in bit i."""
    _compiled_only()


def any_lane(mask: Mask) -> bool:
    """Whether the mask is set in any lane."""
    _compiled_only()


def store_sums(array: Floats, start: int, *values: Lanes) -> None:
    """array[start + i] = sum of the lanes of values[i], for up to 16 vectors, always added in the same order.

    16 elements are written: those beyond the number of vectors become zero.
    """
    _compiled_only()


@overload
def load_columns(array: Floats, start: int, columns: Literal[3]) -> Lanes3: ...
@overload
def load_columns(array: Floats, start: int, columns: Literal[4]) -> Lanes4: ...
def load_columns(array: Floats, start: int, columns: Literal[3, 4]) -> tuple[Lanes, ...]:
    """The columns of 16 rows that follow each other: vector c holds array[start + c + columns * lane]."""
    _compiled_only()


def store_columns(array: Floats, start: int, *values: Lanes) -> None:
    """The inverse of `load_columns`: one vector for each of 2 to 4 columns."""
    _compiled_only()


def load_rows(array: Floats, start: int, stride: int) -> tuple[Lanes, ...]:
    """A 16x16 matrix, transposed: vector c holds array[start + c + stride * lane]."""
    _compiled_only()


def store_rows(array: Floats, start: int, stride: int, *values: Lanes) -> None:
    """The inverse of `load_rows` for up to 16 vectors. 16 elements a row are written: the others become zero."""
    _compiled_only()


def store_whole(array: NDArray[np.int32], start: int, *values: Lanes) -> None:
    """`store_columns` of 1 to 4 vectors of whole numbers into integers."""
    _compiled_only()


def lowest_bit(value: int) -> int:
    """Position of the lowest set bit of a positive integer."""
    _compiled_only()


def fetch_add(counter: NDArray[np.int64], amount: int) -> int:
    """counter[0] before `amount` is added to it, as one atomic step."""
    _compiled_only()
