"""Register the functions of `lanes` with Numba: their types and the LLVM instructions that they become.

`numba.extending.intrinsic` does the same for single functions, but not for operators, and type checkers cannot read
the functions that it makes.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import llvmlite.ir  # type: ignore[import-untyped]  # it has no annotations
import numba.core.cgutils
import numba.core.types
import numba.core.typing.templates
import numba.extending

from lapgs_plugin.jit import lanes
from lapgs_plugin.jit.lanes import WIDTH

# Versions of Numba differ in how much they annotate.
ir: Any = llvmlite.ir
types: Any = numba.core.types
cgutils: Any = numba.core.cgutils
templates: Any = numba.core.typing.templates
extending: Any = numba.extending


class LanesType(types.Type):  # type: ignore[misc]  # see above
    """Type a vector of floats."""

    def __init__(self, element: Any) -> None:
        self.element = element
        super().__init__(name=f"Lanes({element})")


class MaskType(types.Type):  # type: ignore[misc]  # see above
    """Type a vector of booleans."""

    def __init__(self) -> None:
        super().__init__(name="Mask")


class LanesModel(extending.models.PrimitiveModel):  # type: ignore[misc]  # see above
    def __init__(self, dmm: Any, fe_type: LanesType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(dmm.lookup(fe_type.element).get_value_type(), WIDTH))


class MaskModel(extending.models.PrimitiveModel):  # type: ignore[misc]  # see above
    def __init__(self, dmm: Any, fe_type: MaskType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), WIDTH))


extending.register_model(LanesType)(LanesModel)
extending.register_model(MaskType)(MaskModel)

_MASK = MaskType()
_INDEX = types.intp
_INT32 = ir.IntType(32)

_Typing = Callable[..., Any]  # argument types -> type of the result, or None if they do not fit
_Lowering = Callable[[Any, Any, Any, Any], Any]  # (context, builder, signature, arguments) -> value


def _register(function: Any, typing: _Typing, lowering: _Lowering, *shapes: tuple[Any, ...]) -> None:
    """Register a function with Numba.

    Args:
        shapes: classes of the argument types that `lowering` takes, one tuple for each combination; none for a function
            of `lanes`, which has no other implementation.
    """

    def generic(self: Any, args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
        result = typing(*args)
        return None if result is None else templates.signature(result, *args)

    template = type(f"Typing_{function.__name__}", (templates.AbstractTemplate,), {"generic": generic})
    templates.infer_global(function)(template)
    for shape in shapes or ((types.VarArg(types.Any),),):
        extending.lower_builtin(function, *shape)(lowering)


# ------------------------------------------------------------------------------------- vectors and numbers mixed


def _element(*args: Any) -> Any:
    """Return the float type of the vectors among the arguments; None without one, or with other than numbers beside."""
    elements = {arg.element for arg in args if isinstance(arg, LanesType)}
    if len(elements) != 1 or not all(isinstance(arg, (LanesType, types.Number)) for arg in args):
        return None
    return next(iter(elements))


def _widen(context: Any, builder: Any, value: Any, source: Any, element: Any) -> Any:
    """Return the operand as a vector: a number goes into each lane."""
    if isinstance(source, LanesType):
        return value
    vector = ir.VectorType(context.get_value_type(element), WIDTH)
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, context.cast(builder, value, source, element), _INT32(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INT32, WIDTH), [0] * WIDTH))


def _register_elementwise(function: Any, arity: int, emit: Callable[..., Any], result: Any = None) -> None:
    """Register a function of vectors and numbers, at least one a vector, that returns a vector (or `result`).

    Args:
        emit: (builder, LLVM type of the vectors, *operands) -> value.
    """

    def typing(*args: Any) -> Any:
        element = _element(*args) if len(args) == arity else None
        return None if element is None else result or LanesType(element)

    def lowering(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = _element(*sig.args)
        operands = [_widen(context, builder, v, t, element) for v, t in zip(args, sig.args, strict=True)]
        return emit(builder, operands[0].type, *operands)

    # A bit for each operand, set where it is a vector.
    shapes = [tuple(LanesType if bit >> i & 1 else types.Number for i in range(arity)) for bit in range(1, 2**arity)]
    _register(function, typing, lowering, *shapes)


def _is_single(vector: Any) -> bool:
    return isinstance(vector.element, ir.FloatType)


def _constant(vector: Any, value: float) -> Any:
    return ir.Constant(vector, [value] * WIDTH)


def _call(builder: Any, name: str, vector: Any, *operands: Any) -> Any:
    """Call an LLVM intrinsic that takes and returns one type of vector."""
    function_type = ir.FunctionType(vector, [vector] * len(operands))
    suffix = f"v{WIDTH}f{32 if _is_single(vector) else 64}"
    return builder.call(
        cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.{suffix}"), operands
    )


def _intrinsic(name: str) -> Callable[..., Any]:
    """Return a function that emits a call of one of LLVM's intrinsics."""
    return lambda builder, vector, *operands: _call(builder, name, vector, *operands)


def _comparison(predicate: str) -> Callable[..., Any]:
    """Return a function that emits an ordered comparison of two vectors."""
    return lambda builder, vector, a, b: builder.fcmp_ordered(predicate, a, b)


def _select_by(predicate: str) -> Callable[..., Any]:
    """Select a where the comparison with b holds, else b, as the machine's minimum and maximum do."""
    return lambda builder, vector, a, b: builder.select(builder.fcmp_ordered(predicate, a, b), a, b)


for _operator, _emit in (
    (operator.add, lambda builder, vector, a, b: builder.fadd(a, b)),
    (operator.sub, lambda builder, vector, a, b: builder.fsub(a, b)),
    (operator.mul, lambda builder, vector, a, b: builder.fmul(a, b)),
    (operator.truediv, lambda builder, vector, a, b: builder.fdiv(a, b)),
):
    _register_elementwise(_operator, 2, _emit)
    _register_elementwise(getattr(operator, f"i{_operator.__name__}"), 2, _emit)
for _operator, _predicate in ((operator.ge, ">="), (operator.le, "<="), (operator.gt, ">"), (operator.lt, "<")):
    _register_elementwise(_operator, 2, _comparison(_predicate), _MASK)
_register_elementwise(operator.neg, 1, lambda builder, vector, a: builder.fneg(a))
_register_elementwise(lanes.fma, 3, _intrinsic("fmuladd"))
_register_elementwise(lanes.minimum, 2, _select_by("<"))
_register_elementwise(lanes.maximum, 2, _select_by(">"))
_register_elementwise(lanes.absolute, 1, _intrinsic("fabs"))
_register_elementwise(lanes.sqrt, 1, _intrinsic("sqrt"))
_register_elementwise(lanes.floor, 1, _intrinsic("floor"))
_register_elementwise(lanes.ceil, 1, _intrinsic("ceil"))
_register_elementwise(lanes.log2, 1, _intrinsic("log2"))

# ------------------------------------------------------------------------------------------------ exponentials

# Minimax polynomials of 2^r on [-1/2, 1/2] in the relative error, from the Remez algorithm in 50 digits: 7.5e-8 and
# 3e-18 before rounding.
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
# ln 2 in two parts, the first with so few bits that its product with a whole exponent is exact.
_LN2_FLOAT32 = (0.693359375, -2.1219444005469057e-4)
_LN2_FLOAT64 = (0.6931471803691238, 1.9082149292705877e-10)


def _rounder(vector: Any) -> Any:
    """Return 1.5 * 2^(mantissa bits). Adding it rounds to a whole number, which is in the low bits of the sum.

    Conversion to an integer is undefined for values that do not fit, such as exponents far outside of a Gaussian.
    """
    return _constant(vector, 1.5 * 2.0 ** (23 if _is_single(vector) else 52))


def _scaled_power(builder: Any, vector: Any, fraction: Any, shifted: Any) -> Any:
    """Return 2^fraction, fraction in [-1/2, 1/2], times 2 to the whole number in the low bits of `shifted`."""
    mantissa_bits, coefficients = (23, _EXP2_FLOAT32) if _is_single(vector) else (52, _EXP2_FLOAT64)
    integers = ir.VectorType(ir.IntType(32 if _is_single(vector) else 64), WIDTH)
    value = _constant(vector, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = _call(builder, "fmuladd", vector, value, fraction, _constant(vector, coefficient))
    exponent = builder.shl(builder.bitcast(shifted, integers), ir.Constant(integers, [mantissa_bits] * WIDTH))
    return builder.bitcast(builder.add(builder.bitcast(value, integers), exponent), vector)


def _emit_exp2(builder: Any, vector: Any, a: Any) -> Any:
    shifted = builder.fadd(a, _rounder(vector))
    return _scaled_power(builder, vector, builder.fsub(a, builder.fsub(shifted, _rounder(vector))), shifted)


def _emit_exp(builder: Any, vector: Any, a: Any) -> Any:
    limit = _constant(vector, 87.0 if _is_single(vector) else 708.0)
    a = builder.select(builder.fcmp_ordered("<", a, limit), a, limit)
    a = builder.select(builder.fcmp_ordered(">", a, builder.fneg(limit)), a, builder.fneg(limit))
    per_e = _constant(vector, math.log2(math.e))
    shifted = _call(builder, "fmuladd", vector, a, per_e, _rounder(vector))
    whole = builder.fneg(builder.fsub(shifted, _rounder(vector)))
    for part in _LN2_FLOAT32 if _is_single(vector) else _LN2_FLOAT64:
        a = _call(builder, "fmuladd", vector, whole, _constant(vector, part), a)
    return _scaled_power(builder, vector, builder.fmul(a, per_e), shifted)


_register_elementwise(lanes.exp2, 1, _emit_exp2)
_register_elementwise(lanes.exp, 1, _emit_exp)

# ------------------------------------------------------------------------------------------------ masks


def _both_masks(*args: Any) -> Any:
    return _MASK if all(isinstance(arg, MaskType) for arg in args) else None


def _one_mask(result: Any) -> _Typing:
    return lambda mask: result if isinstance(mask, MaskType) else None


def _type_select(mask: Any, a: Any, b: Any) -> Any:
    element = _element(a, b)
    return None if element is None or not isinstance(mask, MaskType) else LanesType(element)


def _lower_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    a, b = (_widen(context, builder, args[i], sig.args[i], sig.return_type.element) for i in (1, 2))
    return builder.select(args[0], a, b)


def _lower_bits(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.zext(builder.bitcast(args[0], ir.IntType(WIDTH)), ir.IntType(64))


def _lower_any_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    packed = builder.bitcast(args[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", packed, packed.type(0))


_register(operator.and_, _both_masks, lambda context, builder, sig, args: builder.and_(*args), (MaskType, MaskType))
_register(operator.or_, _both_masks, lambda context, builder, sig, args: builder.or_(*args), (MaskType, MaskType))
_register(lanes.select, _type_select, _lower_select)
_register(lanes.bits, _one_mask(types.int64), _lower_bits)
_register(lanes.any_lane, _one_mask(types.boolean), _lower_any_lane)

# ------------------------------------------------------------------------------------------------ memory


def _is_memory(array: Any) -> bool:
    """Return whether it is a contiguous array or a borrowed one."""
    return isinstance(array, types.CPointer) or (isinstance(array, types.Array) and array.layout == "C")


def _of_floats(array: Any) -> bool:
    return _is_memory(array) and isinstance(array.dtype, types.Float)


def _type_store(array: Any, start: Any, *values: Any) -> Any:
    """Type a function that stores 1 to 16 vectors of the array's float type."""
    fits = _of_floats(array) and 0 < len(values) <= WIDTH and set(values) == {LanesType(array.dtype)}
    return types.void if fits else None


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Return a pointer to an element."""
    borrowed = isinstance(array_type, types.CPointer)
    data = array if borrowed else context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _element_pointer(context: Any, builder: Any, sig: Any, args: Any, offset: Any = 0) -> Any:
    """Return a pointer to array[index + offset]; sig and args begin with the array and the index."""
    index = context.cast(builder, args[1], sig.args[1], _INDEX)
    offset = index.type(offset) if isinstance(offset, int) else offset
    return _address(context, builder, sig.args[0], args[0], builder.add(index, offset))


def _load_part(context: Any, builder: Any, sig: Any, args: Any, offset: Any = 0) -> Any:
    """Load array[start + offset : ... + 16]; sig and args begin with the array and the start."""
    vector = ir.VectorType(context.get_value_type(sig.args[0].dtype), WIDTH)
    pointer = builder.bitcast(_element_pointer(context, builder, sig, args, offset), vector.as_pointer())
    return builder.load(pointer, align=sig.args[0].dtype.bitwidth // 8)


def _store_part(context: Any, builder: Any, sig: Any, args: Any, value: Any, offset: Any = 0) -> None:
    """Store array[start + offset : ... + 16] = value; sig and args begin with the array and the start."""
    pointer = builder.bitcast(_element_pointer(context, builder, sig, args, offset), value.type.as_pointer())
    builder.store(value, pointer, align=sig.args[0].dtype.bitwidth // 8)


def _lower_borrowed(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return context.make_array(sig.args[0])(context, builder, args[0]).data


def _lower_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    _store_part(context, builder, sig, args, args[2])
    return context.get_dummy_value()


def _lower_prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    byte = ir.IntType(8).as_pointer()
    function_type = ir.FunctionType(ir.VoidType(), [byte, _INT32, _INT32, _INT32])
    function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0i8")
    pointer = builder.bitcast(_element_pointer(context, builder, sig, args), byte)
    builder.call(function, [pointer, _INT32(0), _INT32(3), _INT32(1)])  # for reading, into all levels, data
    return context.get_dummy_value()


def _lower_splat(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _widen(context, builder, args[1], sig.args[1], sig.return_type.element)


def _type_vector(array: Any, number: Any) -> Any:
    return LanesType(array.dtype) if _of_floats(array) else None


_register(lanes.borrowed, lambda a: types.CPointer(a.dtype) if _is_memory(a) else None, _lower_borrowed)
_register(lanes.keep_alive, lambda array: types.void, lambda context, *_: context.get_dummy_value())
_register(lanes.load, _type_vector, _load_part)
_register(lanes.splat, _type_vector, _lower_splat)
_register(lanes.store, _type_store, _lower_store)
_register(lanes.prefetch, lambda array, index: types.void if _is_memory(array) else None, _lower_prefetch)

# ------------------------------------------------------------------------------------ vectors and rows of memory


def _shuffle(builder: Any, a: Any, b: Any, order: Iterable[int]) -> Any:
    """Return lanes of a (0 to 15) and b (16 to 31) in the given order."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT32, WIDTH), list(order)))


def _pick(builder: Any, parts: Sequence[Any], order: Sequence[int]) -> Any:
    """Return sixteen lanes of the concatenated vectors."""
    result = parts[0]
    for number, part in enumerate(parts[1:], start=1):
        taken = [WIDTH + lane % WIDTH if lane // WIDTH == number else i for i, lane in enumerate(order)]
        if number == 1:  # lanes of the first vector are still where they were
            taken = [lane if lane < 2 * WIDTH else i for i, lane in enumerate(order)]
        result = _shuffle(builder, result, part, taken)
    return result if len(parts) > 1 else _shuffle(builder, result, result, order)


def _transposed(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Transpose 16 vectors of 16 lanes in four rounds of exchanges between pairs of rows."""
    rows = list(rows)
    step = 1
    while step < WIDTH:
        low = [lane - step + WIDTH if lane & step else lane for lane in range(WIDTH)]
        high = [lane + WIDTH if lane & step else lane + step for lane in range(WIDTH)]
        for i in range(WIDTH):
            if not i & step:
                a, b = rows[i], rows[i + step]
                rows[i], rows[i + step] = _shuffle(builder, a, b, low), _shuffle(builder, a, b, high)
        step *= 2
    return rows


def _padded(vectors: Sequence[Any]) -> list[Any]:
    """Pad to sixteen vectors with zeros; LLVM removes computations with these."""
    return [*vectors, *[ir.Constant(vectors[0].type, None)] * (WIDTH - len(vectors))]


def _type_load_columns(array: Any, start: Any, columns: Any) -> Any:
    if not _of_floats(array) or not isinstance(columns, types.IntegerLiteral):
        return None
    return types.UniTuple(LanesType(array.dtype), columns.literal_value)


def _lower_load_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    columns = sig.args[2].literal_value
    parts = [_load_part(context, builder, sig, args, part * WIDTH) for part in range(columns)]
    picked = [_pick(builder, parts, range(c, columns * WIDTH, columns)) for c in range(columns)]
    return context.make_tuple(builder, sig.return_type, picked)


def _store_interleaved(context: Any, builder: Any, sig: Any, args: Any, values: Sequence[Any]) -> Any:
    columns = len(values)
    for part in range(columns):
        elements = range(WIDTH * part, WIDTH * (part + 1))
        order = [element % columns * WIDTH + element // columns for element in elements]
        _store_part(context, builder, sig, args, _pick(builder, values, order), part * WIDTH)
    return context.get_dummy_value()


def _lower_store_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _store_interleaved(context, builder, sig, args, args[2:])


def _type_store_whole(array: Any, start: Any, *values: Any) -> Any:
    fits = _is_memory(array) and array.dtype == types.int32 and _element(*values) is not None
    return types.void if fits else None


def _lower_store_whole(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    integers = ir.VectorType(_INT32, WIDTH)
    return _store_interleaved(context, builder, sig, args, [builder.fptosi(value, integers) for value in args[2:]])


def _type_load_rows(array: Any, start: Any, stride: Any) -> Any:
    return types.UniTuple(LanesType(array.dtype), WIDTH) if _of_floats(array) else None


def _row_offsets(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    stride = context.cast(builder, args[2], sig.args[2], _INDEX)
    return [builder.mul(stride, stride.type(row)) for row in range(WIDTH)]


def _lower_load_rows(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    rows = [_load_part(context, builder, sig, args, offset) for offset in _row_offsets(context, builder, sig, args)]
    return context.make_tuple(builder, sig.return_type, _transposed(builder, rows))


def _lower_store_rows(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    rows = _transposed(builder, _padded(args[3:]))
    for offset, row in zip(_row_offsets(context, builder, sig, args), rows, strict=True):
        _store_part(context, builder, sig, args, row, offset)
    return context.get_dummy_value()


def _lower_store_sums(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    # A tree: each step halves the lanes of two vectors and packs them into one. It takes 15 steps for 16 sums, where
    # separate sums would take 64.
    vectors = _padded(args[2:])
    step = 1
    while step < WIDTH:
        # Groups of `step` lanes, from a and from b in turn, and the lanes that are added to them.
        lanes_of = [g + side for g in range(0, WIDTH, 2 * step) for side in (0, WIDTH)]
        first = [lane + i for lane in lanes_of for i in range(step)]
        second = [lane + step for lane in first]
        vectors = [
            a
            if isinstance(a, ir.Constant)
            else builder.fadd(_shuffle(builder, a, b, first), _shuffle(builder, a, b, second))
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
        step *= 2
    _store_part(context, builder, sig, args, vectors[0])
    return context.get_dummy_value()


_register(lanes.load_columns, _type_load_columns, _lower_load_columns)
_register(lanes.store_columns, _type_store, _lower_store_columns)
_register(lanes.store_whole, _type_store_whole, _lower_store_whole)
_register(lanes.load_rows, _type_load_rows, _lower_load_rows)
_register(lanes.store_rows, lambda array, start, stride, *values: _type_store(array, start, *values), _lower_store_rows)
_register(lanes.store_sums, _type_store, _lower_store_sums)

# ------------------------------------------------------------------------------------------------ integers


def _lower_lowest_bit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value = context.cast(builder, args[0], sig.args[0], types.int64)
    return builder.cttz(value, ir.IntType(1)(1))


def _lower_fetch_add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer = _address(context, builder, sig.args[0], args[0], ir.IntType(64)(0))
    amount = context.cast(builder, args[1], sig.args[1], types.int64)
    return builder.atomic_rmw("add", pointer, amount, "monotonic")


_register(lanes.lowest_bit, lambda value: types.int64, _lower_lowest_bit)
_register(
    lanes.fetch_add, lambda counter, amount: types.int64 if counter.dtype == types.int64 else None, _lower_fetch_add
)
