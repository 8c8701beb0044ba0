"""Lanes out of arrays and back: one column of eight rows at a time, the rows in any order."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from .jit import kernel
from .lanes import LANES, WIDTH, Lanes, VectorType

Array = NDArray[Any]

Rows = Any
"""Inside a kernel: the numbers of eight rows."""

_INT64 = ir.IntType(64)
_rows = VectorType("Rows", ir.VectorType(_INT64, WIDTH))
_mask, _doubles = VectorType("Mask", ir.VectorType(ir.IntType(1), WIDTH)), LANES[types.float64]


@intrinsic  # type: ignore[untyped-decorator]
def rows_from(typingctx: Any, at: Any, end: Any) -> Any:
    """at, at + 1, …; from `end` on, the one before it over and over. int64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _vector(builder, _places(builder, *args))

    return _rows(types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def rows_at(typingctx: Any, ids: Any, at: Any, end: Any) -> Any:
    """What `ids` holds at `rows_from(at, end)`. int64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        places = _places(builder, *args[1:])
        return _vector(builder, [builder.load(builder.gep(data, [place])) for place in places])

    return _rows(ids, types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def first(typingctx: Any, count: Any) -> Any:
    """A mask that holds for the first `count` lanes. count: int64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _vector(builder, [builder.icmp_signed("<", _INT64(lane), args[0]) for lane in range(WIDTH)])

    return _mask(types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def gather(typingctx: Any, array: Any, rows: Any, column: Any) -> Any:
    """The numbers at a column of eight rows, in float64. array: C-contiguous rows of float32 or float64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointers = _pointers(context, builder, sig, *args)
        values = _vector(builder, [builder.load(pointer) for pointer in pointers])
        return values if array.dtype == types.float64 else builder.fpext(values, _doubles.vector)

    return _doubles(array, rows, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def scatter(typingctx: Any, array: Any, rows: Any, column: Any, values: Any) -> Any:
    """Set a column of eight rows, rounded to the array's type. array: as in `gather`, or bool for a mask."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        values = args[3]
        if array.dtype == types.float32:
            values = builder.fptrunc(values, LANES[array.dtype].vector)
        elif array.dtype == types.boolean:
            values = builder.zext(values, ir.VectorType(ir.IntType(8), WIDTH))
        for lane, pointer in enumerate(_pointers(context, builder, sig, *args[:3])):
            builder.store(builder.extract_element(values, _lane(lane)), pointer)
        return context.get_dummy_value()

    return types.void(array, rows, types.int64, values), generate


def _lane(number: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), number)


def _vector(builder: ir.IRBuilder, values: list[ir.Value]) -> ir.Value:
    vector = ir.Constant(ir.VectorType(values[0].type, WIDTH), ir.Undefined)
    for lane, value in enumerate(values):
        vector = builder.insert_element(vector, value, _lane(lane))
    return vector


def _places(builder: ir.IRBuilder, at: ir.Value, end: ir.Value) -> list[ir.Value]:
    last = builder.sub(end, _INT64(1))
    places = [builder.add(at, _INT64(lane)) for lane in range(WIDTH)]
    return [builder.select(builder.icmp_signed("<", place, last), place, last) for place in places]


def _pointers(
    context: Any, builder: ir.IRBuilder, sig: Any, array: ir.Value, rows: ir.Value, column: ir.Value
) -> list[ir.Value]:
    """Where each lane's row has the column."""
    fields = context.make_array(sig.args[0])(context, builder, array)
    stride = builder.extract_value(fields.strides, 0)
    columns = builder.ptrtoint(builder.gep(fields.data, [column]), _INT64)
    offsets = [builder.mul(builder.extract_element(rows, _lane(lane)), stride) for lane in range(WIDTH)]
    return [builder.inttoptr(builder.add(columns, offset), fields.data.type) for offset in offsets]


@kernel(inline=True)
def gather_vec(array: Array, rows: Rows) -> tuple[Lanes, Lanes, Lanes]:
    """Columns 0, 1, 2."""
    return gather(array, rows, 0), gather(array, rows, 1), gather(array, rows, 2)


@kernel(inline=True)
def scatter_vec(array: Array, rows: Rows, values: tuple[Lanes, Lanes, Lanes]) -> None:
    """Columns 0, 1, 2."""
    scatter(array, rows, 0, values[0])
    scatter(array, rows, 1, values[1])
    scatter(array, rows, 2, values[2])
