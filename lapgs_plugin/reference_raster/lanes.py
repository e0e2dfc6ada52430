"""Explicit 16-lane vectors for compiled kernels: `Lanes` of floats and `Mask` of booleans.

Left to itself LLVM vectorises a loop only while nothing in it looks suspicious, and gives up in silence at three to four
times the cost. Kernels written with the functions below say what is a vector: each call is one LLVM vector instruction,
which becomes one AVX-512, two AVX2 or four SSE or NEON instructions, in float32 and, twice as wide, in float64.

The functions work in code compiled by `_jit.jit`. In Python they only carry the types, and calling them is a bug. No
fast-math flag is set anywhere, so equal expressions give equal bits in different kernels.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NoReturn, Protocol

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model, type_callable
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


Floats = NDArray[np.floating[Any]]


def _compiled_only() -> NoReturn:
    raise AssertionError("lanes exist in compiled kernels only")


def load(array: Floats, start: int) -> Lanes:
    """array[start : start + 16] of a contiguous array."""
    _compiled_only()


def broadcast(array: Floats, index: int) -> Lanes:
    """array[index] in each lane."""
    _compiled_only()


def at(array: NDArray[Any], index: int) -> Any:
    """array[index] for an index known to be in range: negative ones do not count from the end."""
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
    """2^a to a relative error of 1e-7 (float32) or 3e-16 (float64); any finite value where that leaves the type's range."""
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


def load_columns(array: Floats, start: int, columns: Literal[2, 3, 4]) -> tuple[Lanes, ...]:
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


def store_whole(array: NDArray[np.int32], start: int, value: Lanes) -> None:
    """array[start : start + 16] = value, which holds whole numbers."""
    _compiled_only()


def lowest_bit(value: int) -> int:
    """Position of the lowest set bit of a positive integer."""
    _compiled_only()


def fetch_add(counter: NDArray[np.int64], amount: int) -> int:
    """counter[0] before `amount` is added to it, as one atomic step."""
    _compiled_only()


# ------------------------------------------------------------------------------------------------- Numba types


class _LanesType(types.Type):  # type: ignore[misc]  # Numba leaves its types without annotations
    def __init__(self, element: types.Float) -> None:
        self.element = element
        super().__init__(name=f"Lanes({element})")


class _MaskType(types.Type):  # type: ignore[misc]  # as above
    def __init__(self) -> None:
        super().__init__(name="Mask")


_MASK = _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]  # as above
    def __init__(self, dmm: Any, fe_type: _LanesType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(dmm.lookup(fe_type.element).get_value_type(), WIDTH))


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]  # as above
    def __init__(self, dmm: Any, fe_type: _MaskType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), WIDTH))


def _element(args: tuple[types.Type, ...]) -> types.Float | None:
    """The float type of the vectors among the arguments; None if there is none, or a stranger beside them."""
    elements = {arg.element for arg in args if isinstance(arg, _LanesType)}
    if len(elements) != 1 or not all(isinstance(arg, (_LanesType, types.Number)) for arg in args):
        return None
    return next(iter(elements))


def _widen(context: Any, builder: Any, value: Any, source: types.Type, element: types.Float) -> Any:
    """The operand as a vector: unchanged, or a number in each lane."""
    if isinstance(source, _LanesType):
        return value
    vector = ir.VectorType(context.get_value_type(element), WIDTH)
    scalar = context.cast(builder, value, source, element)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), order)


def _call(builder: Any, name: str, vector: ir.VectorType, *operands: Any) -> Any:
    """An LLVM intrinsic that takes and returns one type of vector."""
    suffix = "f32" if isinstance(vector.element, ir.FloatType) else "f64"
    function_type = ir.FunctionType(vector, [vector] * len(operands))
    function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{WIDTH}{suffix}")
    return builder.call(function, operands)


def _constant(vector: ir.VectorType, value: float) -> ir.Constant:
    return ir.Constant(vector, [value] * WIDTH)


def _address(context: Any, builder: Any, array_type: types.Array, array: Any, index: Any) -> Any:
    """Pointer to an element of a contiguous array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


# ----------------------------------------------------------------------------------------- operators and mathematics

_Emit = Callable[..., Any]  # (builder, vector type, *operands) -> result


def _register(function: Any, arity: int, emit: _Emit, result: _MaskType | None = None) -> None:
    """Make `function` work on vectors and numbers, one at least a vector, and return a vector (or `result`)."""

    @infer_global(function)
    class _Typing(AbstractTemplate):  # type: ignore[misc]  # as above
        def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
            element = _element(args) if len(args) == arity else None
            return None if element is None else signature(result or _LanesType(element), *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = _element(sig.args)
        operands = [_widen(context, builder, v, t, element) for v, t in zip(args, sig.args, strict=True)]
        return emit(builder, operands[0].type, *operands)

    for lanes_at in range(1, 2**arity):
        shape = [_LanesType if lanes_at >> i & 1 else types.Number for i in range(arity)]
        lower_builtin(function, *shape)(lower)


def _compare(predicate: str) -> _Emit:
    return lambda builder, vector, a, b: builder.fcmp_ordered(predicate, a, b)


for _names, _emitted in (
    ("add iadd", lambda builder, vector, a, b: builder.fadd(a, b)),
    ("sub isub", lambda builder, vector, a, b: builder.fsub(a, b)),
    ("mul imul", lambda builder, vector, a, b: builder.fmul(a, b)),
    ("truediv itruediv", lambda builder, vector, a, b: builder.fdiv(a, b)),
):
    for _name in _names.split():
        _register(getattr(operator, _name), 2, _emitted)
_register(operator.neg, 1, lambda builder, vector, a: builder.fneg(a))
_register(operator.ge, 2, _compare(">="), _MASK)
_register(operator.le, 2, _compare("<="), _MASK)
_register(operator.gt, 2, _compare(">"), _MASK)
_register(operator.lt, 2, _compare("<"), _MASK)
_register(fma, 3, lambda builder, vector, a, b, c: _call(builder, "fmuladd", vector, a, b, c))
_register(minimum, 2, lambda builder, vector, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
_register(maximum, 2, lambda builder, vector, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
_register(sqrt, 1, lambda builder, vector, a: _call(builder, "sqrt", vector, a))
_register(floor, 1, lambda builder, vector, a: _call(builder, "floor", vector, a))
_register(ceil, 1, lambda builder, vector, a: _call(builder, "ceil", vector, a))
_register(log2, 1, lambda builder, vector, a: _call(builder, "log2", vector, a))
_register(absolute, 1, lambda builder, vector, a: _call(builder, "fabs", vector, a))

# Minimax polynomials of 2^r on [-1/2, 1/2] in the relative error: 7.5e-8 and 3e-18 before rounding.
_EXP2_FLOAT32 = (
    1.0000000716546416,
    0.69314696706526493,
    0.24022119723969178,
    0.055507132728753912,
    0.0096755413310213911,
    0.0013276472167819943,
)
_EXP2_FLOAT64 = (
    1.0,
    0.69314718055994533,
    0.24022650695910156,
    0.055504108664819921,
    0.0096181291075883351,
    0.0013333558146789950,
    0.00015403530462514613,
    0.000015252733490960847,
    1.3215433089594630e-6,
    1.0178198033328528e-7,
    7.0741056262456594e-9,
    4.4352809446103361e-10,
)


def _is_single(vector: ir.VectorType) -> bool:
    return isinstance(vector.element, ir.FloatType)


def _rounder(vector: ir.VectorType) -> ir.Constant:
    """1.5 * 2^mantissa bits. Adding it rounds to a whole number and leaves that in the low bits of the sum.

    Conversion to an integer would do too, but is undefined for what does not fit, and far outside of a Gaussian
    nothing fits.
    """
    return _constant(vector, 1.5 * 2.0 ** (23 if _is_single(vector) else 52))


def _scaled_power(builder: Any, vector: ir.VectorType, fraction: Any, shifted: Any) -> Any:
    """2^fraction, for a fraction in [-1/2, 1/2], times 2 to the whole number in the low bits of `shifted`."""
    mantissa_bits, coefficients = (23, _EXP2_FLOAT32) if _is_single(vector) else (52, _EXP2_FLOAT64)
    integers = ir.VectorType(ir.IntType(32 if _is_single(vector) else 64), WIDTH)
    value = _constant(vector, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = _call(builder, "fmuladd", vector, value, fraction, _constant(vector, coefficient))
    exponent = builder.shl(builder.bitcast(shifted, integers), ir.Constant(integers, [mantissa_bits] * WIDTH))
    return builder.bitcast(builder.add(builder.bitcast(value, integers), exponent), vector)


def _emit_exp2(builder: Any, vector: ir.VectorType, a: Any) -> Any:
    shifted = builder.fadd(a, _rounder(vector))
    return _scaled_power(builder, vector, builder.fsub(a, builder.fsub(shifted, _rounder(vector))), shifted)


def _emit_exp(builder: Any, vector: ir.VectorType, a: Any) -> Any:
    limit = _constant(vector, 87.0 if _is_single(vector) else 708.0)
    a = builder.select(builder.fcmp_ordered("<", a, limit), a, limit)
    a = builder.select(builder.fcmp_ordered(">", a, builder.fneg(limit)), a, builder.fneg(limit))
    per_e = _constant(vector, math.log2(math.e))
    shifted = _call(builder, "fmuladd", vector, a, per_e, _rounder(vector))
    whole = builder.fneg(builder.fsub(shifted, _rounder(vector)))
    # ln 2 in two parts, the first with so few bits that its product with `whole` is exact.
    high = 0.693359375 if _is_single(vector) else 0.6931471803691238
    rest = _call(builder, "fmuladd", vector, whole, _constant(vector, high), a)
    rest = _call(builder, "fmuladd", vector, whole, _constant(vector, _LN2_LOW[_is_single(vector)]), rest)
    return _scaled_power(builder, vector, builder.fmul(rest, per_e), shifted)


_LN2_LOW = {True: -2.1219444005469057e-4, False: 1.9082149292705877e-10}
_register(exp2, 1, _emit_exp2)
_register(exp, 1, _emit_exp)

# ------------------------------------------------------------------------------------------------ masks


@infer_global(operator.and_)
@infer_global(operator.or_)
class _MaskTyping(AbstractTemplate):  # type: ignore[misc]  # as above
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        return signature(_MASK, *args) if all(isinstance(arg, _MaskType) for arg in args) else None


@lower_builtin(operator.and_, _MaskType, _MaskType)
def _lower_and(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


@lower_builtin(operator.or_, _MaskType, _MaskType)
def _lower_or(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.or_(*args)


@type_callable(select)
def _type_select(context: Any) -> Any:
    def typer(mask: types.Type, a: types.Type, b: types.Type) -> Any:
        element = _element((a, b))
        return None if element is None or not isinstance(mask, _MaskType) else _LanesType(element)

    return typer


@lower_builtin(select, _MaskType, _LanesType, _LanesType)
@lower_builtin(select, _MaskType, _LanesType, types.Number)
@lower_builtin(select, _MaskType, types.Number, _LanesType)
def _lower_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    element = sig.return_type.element
    a, b = (_widen(context, builder, args[i], sig.args[i], element) for i in (1, 2))
    return builder.select(args[0], a, b)


@type_callable(bits)
def _type_bits(context: Any) -> Any:
    return lambda mask: types.int64 if isinstance(mask, _MaskType) else None


@lower_builtin(bits, _MaskType)
def _lower_bits(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.zext(builder.bitcast(args[0], ir.IntType(WIDTH)), ir.IntType(64))


@type_callable(any_lane)
def _type_any_lane(context: Any) -> Any:
    return lambda mask: types.boolean if isinstance(mask, _MaskType) else None


@lower_builtin(any_lane, _MaskType)
def _lower_any_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    packed = builder.bitcast(args[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", packed, ir.Constant(packed.type, 0))


# ------------------------------------------------------------------------------------------------ memory


def _is_buffer(array: types.Type) -> bool:
    return isinstance(array, types.Array) and array.layout == "C" and isinstance(array.dtype, types.Float)


@type_callable(load)
def _type_load(context: Any) -> Any:
    return lambda array, start: _LanesType(array.dtype) if _is_buffer(array) else None


@lower_builtin(load, types.Array, types.Integer)
def _lower_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    pointer = _address(context, builder, sig.args[0], args[0], index)
    vector = ir.VectorType(context.get_value_type(sig.args[0].dtype), WIDTH)
    return builder.load(builder.bitcast(pointer, vector.as_pointer()), align=sig.args[0].dtype.bitwidth // 8)


@type_callable(store)
def _type_store(context: Any) -> Any:
    return lambda array, start, value: types.void if _is_buffer(array) and value == _LanesType(array.dtype) else None


@lower_builtin(store, types.Array, types.Integer, _LanesType)
def _lower_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    pointer = _address(context, builder, sig.args[0], args[0], index)
    pointer = builder.bitcast(pointer, args[2].type.as_pointer())
    builder.store(args[2], pointer, align=sig.args[0].dtype.bitwidth // 8)
    return context.get_dummy_value()


@type_callable(broadcast)
def _type_broadcast(context: Any) -> Any:
    return lambda array, index: _LanesType(array.dtype) if _is_buffer(array) else None


@type_callable(at)
def _type_at(context: Any) -> Any:
    return lambda array, index: array.dtype if isinstance(array, types.Array) and array.layout == "C" else None


@lower_builtin(at, types.Array, types.Integer)
def _lower_at(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.load(_address(context, builder, sig.args[0], args[0], index))


@lower_builtin(broadcast, types.Array, types.Integer)
def _lower_broadcast(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value = _lower_at(context, builder, sig, args)
    return _widen(context, builder, value, sig.args[0].dtype, sig.args[0].dtype)


@type_callable(splat)
def _type_splat(context: Any) -> Any:
    return lambda like, value: _LanesType(like.dtype) if _is_buffer(like) else None


@lower_builtin(splat, types.Array, types.Number)
def _lower_splat(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _widen(context, builder, args[1], sig.args[1], sig.return_type.element)


@infer_global(store_sums)
class _StoreSumsTyping(AbstractTemplate):  # type: ignore[misc]  # as above
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        array, _, *values = args
        fits = _is_buffer(array) and 0 < len(values) <= WIDTH and set(values) == {_LanesType(array.dtype)}
        return signature(types.void, *args) if fits else None


@lower_builtin(store_sums, types.Array, types.Integer, types.VarArg(_LanesType))
def _lower_store_sums(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    # A tree in which each step halves the lanes of two vectors and packs them into one: 15 steps for 16 sums, where
    # 16 separate sums would take 64. Padding with zeros lets LLVM drop the branches that nothing was given for.
    vectors = list(args[2:])
    zero = ir.Constant(vectors[0].type, None)
    vectors += [zero] * (WIDTH - len(vectors))
    half = 1
    while half < WIDTH:
        vectors = [_packed_halves(builder, a, b, half) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
        half *= 2
    return _lower_store(context, builder, signature(types.void, *sig.args[:3]), (*args[:2], vectors[0]))


def _packed_halves(builder: Any, a: Any, b: Any, step: int) -> Any:
    """Add neighbouring groups of `step` lanes, those of `a` into groups of even number and those of `b` into odd."""
    if all(isinstance(v, ir.Constant) for v in (a, b)):
        return a
    groups = range(0, WIDTH, 2 * step)
    first = [lane + side for g in groups for side in (0, WIDTH) for lane in range(g, g + step)]
    second = [lane + step for lane in first]

    def shuffle(order: list[int]) -> Any:
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order))

    return builder.fadd(shuffle(first), shuffle(second))


@type_callable(load_columns)
def _type_load_columns(context: Any) -> Any:
    def typer(array: types.Type, start: types.Type, columns: types.Type) -> Any:
        fits = _is_buffer(array) and isinstance(columns, types.IntegerLiteral)
        return types.UniTuple(_LanesType(array.dtype), columns.literal_value) if fits else None

    return typer


@lower_builtin(load_columns, types.Array, types.Integer, types.IntegerLiteral)
def _lower_load_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    columns = sig.args[2].literal_value
    parts = _load_parts(context, builder, sig, args, range(0, columns * WIDTH, WIDTH))
    picked = [_pick(builder, parts, range(c, columns * WIDTH, columns)) for c in range(columns)]
    return context.make_tuple(builder, sig.return_type, picked)


@infer_global(store_columns)
class _StoreColumnsTyping(AbstractTemplate):  # type: ignore[misc]  # as above
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        array, _, *values = args
        return signature(types.void, *args) if set(values) == {_LanesType(array.dtype)} else None


@lower_builtin(store_columns, types.Array, types.Integer, types.VarArg(_LanesType))
def _lower_store_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    values = args[2:]
    columns = len(values)
    for part in range(columns):
        lanes = [(WIDTH * part + lane) % columns * WIDTH + (WIDTH * part + lane) // columns for lane in range(WIDTH)]
        _store_part(context, builder, sig, args, part * WIDTH, _pick(builder, values, lanes))
    return context.get_dummy_value()


@type_callable(load_rows)
def _type_load_rows(context: Any) -> Any:
    return lambda array, start, stride: types.UniTuple(_LanesType(array.dtype), WIDTH) if _is_buffer(array) else None


@lower_builtin(load_rows, types.Array, types.Integer, types.Integer)
def _lower_load_rows(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    stride = context.cast(builder, args[2], sig.args[2], types.intp)
    rows = _load_parts(context, builder, sig, args, [builder.mul(stride, stride.type(i)) for i in range(WIDTH)])
    return context.make_tuple(builder, sig.return_type, _transposed(builder, rows))


@infer_global(store_rows)
class _StoreRowsTyping(AbstractTemplate):  # type: ignore[misc]  # as above
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        array, _, _, *values = args
        fits = 0 < len(values) <= WIDTH and set(values) == {_LanesType(array.dtype)}
        return signature(types.void, *args) if fits else None


@lower_builtin(store_rows, types.Array, types.Integer, types.Integer, types.VarArg(_LanesType))
def _lower_store_rows(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    stride = context.cast(builder, args[2], sig.args[2], types.intp)
    zero = ir.Constant(args[3].type, None)
    for i, row in enumerate(_transposed(builder, [*args[3:], *[zero] * (WIDTH - len(args) + 3)])):
        _store_part(context, builder, sig, args, builder.mul(stride, stride.type(i)), row)
    return context.get_dummy_value()


def _load_parts(context: Any, builder: Any, sig: Any, args: Any, offsets: Iterable[Any]) -> list[Any]:
    """The vectors at array[start + offset] for each offset; sig and args begin with array and start."""
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    vector = ir.VectorType(context.get_value_type(sig.args[0].dtype), WIDTH)
    parts = []
    for offset in offsets:
        place = builder.add(index, index.type(offset) if isinstance(offset, int) else offset)
        pointer = builder.bitcast(_address(context, builder, sig.args[0], args[0], place), vector.as_pointer())
        parts.append(builder.load(pointer, align=sig.args[0].dtype.bitwidth // 8))
    return parts


def _store_part(context: Any, builder: Any, sig: Any, args: Any, offset: Any, value: Any) -> None:
    """array[start + offset : ... + 16] = value; sig and args begin with array and start."""
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    place = builder.add(index, index.type(offset) if isinstance(offset, int) else offset)
    pointer = builder.bitcast(_address(context, builder, sig.args[0], args[0], place), value.type.as_pointer())
    builder.store(value, pointer, align=sig.args[0].dtype.bitwidth // 8)


def _shuffle(builder: Any, a: Any, b: Any, order: Iterable[int]) -> Any:
    """Lanes of a (0 to 15) and b (16 to 31) in any order."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), list(order)))


def _pick(builder: Any, parts: Sequence[Any], lanes: Iterable[int]) -> Any:
    """The given lanes of the vectors put end to end."""
    lanes = list(lanes)
    result = parts[0]
    for part in range(1, len(parts)):
        known = [lane if part == 1 else i for i, lane in enumerate(lanes)]
        order = [
            lane % WIDTH + WIDTH if lane // WIDTH == part else (known[i] if lane // WIDTH < part else 0)
            for i, lane in enumerate(lanes)
        ]
        result = _shuffle(builder, result, parts[part], order)
    return result


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """The transpose of 16 vectors of 16 lanes, in four rounds of exchanges between pairs of rows."""
    step = 1
    while step < WIDTH:
        low = [lane if not lane & step else lane - step + WIDTH for lane in range(WIDTH)]
        high = [lane + step if not lane & step else lane + WIDTH for lane in range(WIDTH)]
        exchanged = list(rows)
        for i in range(WIDTH):
            if not i & step:
                exchanged[i] = _shuffle(builder, rows[i], rows[i + step], low)
                exchanged[i + step] = _shuffle(builder, rows[i], rows[i + step], high)
        rows = exchanged
        step *= 2
    return rows


@type_callable(store_whole)
def _type_store_whole(context: Any) -> Any:
    return lambda array, start, value: types.void if array.dtype == types.int32 else None


@lower_builtin(store_whole, types.Array, types.Integer, _LanesType)
def _lower_store_whole(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    _store_part(context, builder, sig, args, 0, builder.fptosi(args[2], ir.VectorType(ir.IntType(32), WIDTH)))
    return context.get_dummy_value()


# ------------------------------------------------------------------------------------------------ integers


@type_callable(lowest_bit)
def _type_lowest_bit(context: Any) -> Any:
    return lambda value: types.int64 if isinstance(value, types.Integer) else None


@lower_builtin(lowest_bit, types.Integer)
def _lower_lowest_bit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value = context.cast(builder, args[0], sig.args[0], types.int64)
    return builder.cttz(value, ir.Constant(ir.IntType(1), 1))


@type_callable(fetch_add)
def _type_fetch_add(context: Any) -> Any:
    return lambda counter, amount: types.int64 if counter.dtype == types.int64 else None


@lower_builtin(fetch_add, types.Array, types.Integer)
def _lower_fetch_add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer = _address(context, builder, sig.args[0], args[0], ir.Constant(ir.IntType(64), 0))
    amount = context.cast(builder, args[1], sig.args[1], types.int64)
    return builder.atomic_rmw("add", pointer, amount, "monotonic")
