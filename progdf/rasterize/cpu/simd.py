"""Eight float32 at once, as a type of numba's: what the pixel loops are written in.

numba has no vector type, and whether LLVM turns a loop into vector code, and in which order it adds up, is
LLVM's choice: plain loops are 1.3 to 1.5 times slower, and their bits differ from processor to processor.
A `Vector` is LLVM's <8 x float>: one AVX register, two of SSE's or NEON's. Arithmetic and comparisons are
Python's own, lane by lane, with the float flags of the kernel around them; a float32 beside a vector
counts as eight equal ones.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, builtin_registry, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

Vector = Any
"""Inside a kernel: eight float32."""

Mask = Any
"""Inside a kernel: eight booleans."""

WIDTH = 8
"""Lanes of a vector."""

_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_BOOLS = ir.VectorType(ir.IntType(1), WIDTH)


def select(mask: Mask, a: Vector, b: Vector) -> Vector:
    """a where the mask holds, b elsewhere, lane by lane."""


def broadcast(value: Any) -> Vector:
    """Eight times a float32."""


def lane_indices() -> Vector:
    """0, 1, …, 7"""


def lane_sums(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Vector:
    """The sum of the lanes of each of eight vectors, as a vector; always added up in the same order."""


def lane_sum(value: Vector) -> Any:
    """The sum of the lanes, as `lane_sums` adds them up."""


def truncate(value: Vector) -> Vector:
    """Each lane without what follows the point, |value| < 2³¹."""


def ldexp(value: Vector, exponent: Vector) -> Vector:
    """value · 2^exponent where the exponent is whole and the result a normal number."""


class _VectorType(types.Type):  # type: ignore[misc]
    """numba's name for a vector of LLVM's."""

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.vector)


_vector, _mask, _single = _VectorType("Vector", _FLOATS), _VectorType("Mask", _BOOLS), types.float32


def _broadcast(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Eight times the same where it is one number."""
    if isinstance(value.type, ir.VectorType):
        return value
    vector = ir.Constant(_FLOATS, ir.Undefined)
    single = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(single, vector, ir.Constant(_INTS, [0] * WIDTH))


def _define(
    function: Callable[..., Any], arguments: tuple[types.Type, ...], result: types.Type,
    emit: Callable[..., ir.Value],
) -> None:  # fmt: skip
    """Teach numba a function or an operator for arguments of exactly these types; `emit` gets vectors."""

    class _Template(AbstractTemplate):  # type: ignore[misc]
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if args == arguments else None

    builtin_registry.register_global(function, types.Function(_Template))

    @lower_builtin(function, *arguments)  # type: ignore[untyped-decorator]
    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return emit(builder, *(_broadcast(builder, value) for value in args))


def _add_shuffled(b: ir.IRBuilder, x: ir.Value, y: ir.Value, first: list[int], second: list[int]) -> ir.Value:
    """Lanes `first` of x and y, laid end to end, plus lanes `second`."""
    kind = ir.VectorType(ir.IntType(32), len(first))
    return b.fadd(*(b.shuffle_vector(x, y, ir.Constant(kind, lanes)) for lanes in (first, second)))


def _lane_sums(b: ir.IRBuilder, *vectors: ir.Value) -> ir.Value:
    for part in (8, 4, 2):  # so many lanes belong to one sum; its halves are added up
        low = [k for k in range(2 * WIDTH) if k % part < part // 2]
        high = [k + part // 2 for k in low]
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = tuple(_add_shuffled(b, x, y, low, high) for x, y in pairs)
    return vectors[0]


def _lane_sum(b: ir.IRBuilder, vector: ir.Value) -> ir.Value:
    for half in (4, 2, 1):
        vector = _add_shuffled(b, vector, vector, list(range(half)), list(range(half, 2 * half)))
    return b.extract_element(vector, ir.Constant(ir.IntType(32), 0))


def _ldexp(b: ir.IRBuilder, value: ir.Value, exponent: ir.Value) -> ir.Value:
    shift = b.shl(b.fptosi(exponent, _INTS), ir.Constant(_INTS, [23] * WIDTH))
    return b.bitcast(b.add(b.bitcast(value, _INTS), shift), _FLOATS)


for _pair in ((_vector, _vector), (_vector, _single), (_single, _vector)):
    _define(operator.add, _pair, _vector, lambda b, x, y: b.fadd(x, y))
    _define(operator.iadd, _pair, _vector, lambda b, x, y: b.fadd(x, y))
    _define(operator.sub, _pair, _vector, lambda b, x, y: b.fsub(x, y))
    _define(operator.mul, _pair, _vector, lambda b, x, y: b.fmul(x, y))
    _define(operator.truediv, _pair, _vector, lambda b, x, y: b.fdiv(x, y))
    _define(operator.lt, _pair, _mask, lambda b, x, y: b.fcmp_ordered("<", x, y))
    _define(operator.le, _pair, _mask, lambda b, x, y: b.fcmp_ordered("<=", x, y))
    _define(operator.gt, _pair, _mask, lambda b, x, y: b.fcmp_ordered(">", x, y))
for _pair in ((_vector, _vector), (_vector, _single), (_single, _vector), (_single, _single)):
    _define(select, (_mask, *_pair), _vector, lambda b, mask, x, y: b.select(mask, x, y))
_define(operator.and_, (_mask, _mask), _mask, lambda b, x, y: b.and_(x, y))
_define(broadcast, (_single,), _vector, lambda b, x: x)
_define(lane_indices, (), _vector, lambda b: ir.Constant(_FLOATS, [float(lane) for lane in range(WIDTH)]))
_define(lane_sums, (_vector,) * WIDTH, _vector, _lane_sums)
_define(lane_sum, (_vector,), _single, _lane_sum)
_define(truncate, (_vector,), _vector, lambda b, x: b.sitofp(b.fptosi(x, _INTS), _FLOATS))
_define(ldexp, (_vector, _vector), _vector, _ldexp)


def _pointer(context: Any, builder: ir.IRBuilder, sig: Any, array: ir.Value, at: ir.Value) -> ir.Value:
    data = context.make_array(sig.args[0])(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _FLOATS.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, at: Any) -> Any:
    """array[at : at + 8] of a contiguous float32 array; nothing is checked. at: uint64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load(_pointer(context, builder, sig, *args), align=4)

    return _vector(array, types.uint64), generate


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, at: Any, value: Any) -> Any:
    """array[at : at + 8] = value; as `load`."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        builder.store(args[2], _pointer(context, builder, sig, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, _vector), generate


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(typingctx: Any, array: Any, row: Any) -> Any:
    """Have the first 64 bytes of a row fetched before they are asked for; no harm where it does not exist."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        fields = context.make_array(sig.args[0])(context, builder, args[0])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        offset = builder.mul(builder.extract_value(fields.strides, 0), args[1])
        address = builder.gep(builder.bitcast(fields.data, byte), [offset])
        builder.call(function, [address, number(0), number(3), number(1)])  # to read, to be kept, data
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
