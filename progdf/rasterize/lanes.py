"""Eight numbers at once, as types of numba's: what the pixel loops and the projection are written in.

numba has no vector type, and whether LLVM turns a loop into vector code, and how it adds up its lanes, is
LLVM's choice. `Lanes` are LLVM's <8 x float> or <8 x double>: one or two AVX registers, more of SSE's or
NEON's. Arithmetic, comparison, min, max, abs, roots and rounding are Python's and numpy's own, lane by lane,
with the float flags of the kernel that they stand in; a number beside lanes of its type stands for eight
equal ones. So a function that branches by `choose` alone does for one number or for eight what it says.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, builtin_registry, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numpy.typing import NDArray

Array = NDArray[Any]
Lanes = Any
"""Inside a kernel: eight float32 or eight float64."""

Mask = Any
"""Inside a kernel: eight booleans."""

WIDTH = 8
"""How many lanes there are."""

_FLOATS, _DOUBLES = ir.VectorType(ir.FloatType(), WIDTH), ir.VectorType(ir.DoubleType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_BOOLS = ir.VectorType(ir.IntType(1), WIDTH)


class VectorType(types.Type):  # type: ignore[misc]
    """numba's name for a vector of LLVM's."""

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.vector)


_singles, _doubles = VectorType("Lanes(float32)", _FLOATS), VectorType("Lanes(float64)", _DOUBLES)
_mask = VectorType("Mask", _BOOLS)
LANES = {types.float32: _singles, types.float64: _doubles}
"""numba's type of a number -> that of eight."""


def _spread(builder: ir.IRBuilder, kind: types.Type, value: ir.Value) -> ir.Value:
    """Eight times the same where it is one number."""
    if isinstance(kind, VectorType):
        return value
    vector = ir.Constant(LANES[kind].vector, ir.Undefined)
    single = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(single, vector, ir.Constant(_INTS, [0] * WIDTH))


def _function(
    name: Callable[..., Any], arguments: tuple[types.Type, ...], result: types.Type,
    emit: Callable[..., ir.Value],
) -> None:  # fmt: skip
    """Teach numba a function or an operator for arguments of exactly these types."""

    class _Template(AbstractTemplate):  # type: ignore[misc]
        key = name

        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if args == arguments else None

    # not `infer_global`: it asks functions for their module, which numpy's older ones cannot tell
    builtin_registry.register_global(name, types.Function(_Template))

    @lower_builtin(name, *arguments)  # type: ignore[untyped-decorator]
    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return emit(builder, *(_spread(builder, *pair) for pair in zip(sig.args, args, strict=True)))


def _llvm(name: str) -> Callable[..., ir.Value]:
    def emit(builder: ir.IRBuilder, a: ir.Value) -> ir.Value:
        kind = ir.FunctionType(a.type, [a.type])
        suffix = "v8f32" if a.type == _FLOATS else "v8f64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"{name}.{suffix}"), [a])

    return emit


for _number, _kind in LANES.items():
    for _pair in ((_kind, _kind), (_kind, _number), (_number, _kind)):
        _function(operator.add, _pair, _kind, lambda builder, a, b: builder.fadd(a, b))
        _function(operator.iadd, _pair, _kind, lambda builder, a, b: builder.fadd(a, b))
        _function(operator.sub, _pair, _kind, lambda builder, a, b: builder.fsub(a, b))
        _function(operator.mul, _pair, _kind, lambda builder, a, b: builder.fmul(a, b))
        _function(operator.truediv, _pair, _kind, lambda builder, a, b: builder.fdiv(a, b))
        _function(operator.lt, _pair, _mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
        _function(operator.le, _pair, _mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
        _function(operator.gt, _pair, _mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
        _function(operator.ge, _pair, _mask, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
        _function(operator.eq, _pair, _mask, lambda builder, a, b: builder.fcmp_ordered("==", a, b))
        # as Python has it: the first, unless the second is less or greater
        _function(min, _pair, _kind, lambda b, x, y: b.select(b.fcmp_ordered("<", y, x), y, x))
        _function(max, _pair, _kind, lambda b, x, y: b.select(b.fcmp_ordered(">", y, x), y, x))
    _function(operator.neg, (_kind,), _kind, lambda builder, a: builder.fneg(a))
    _function(abs, (_kind,), _kind, _llvm("llvm.fabs"))
    _function(math.sqrt, (_kind,), _kind, _llvm("llvm.sqrt"))
    _function(math.log2, (_kind,), _kind, _llvm("llvm.log2"))
    _function(np.floor, (_kind,), _kind, _llvm("llvm.floor"))
    _function(np.ceil, (_kind,), _kind, _llvm("llvm.ceil"))
_function(operator.and_, (_mask, _mask), _mask, lambda builder, a, b: builder.and_(a, b))


@intrinsic  # type: ignore[untyped-decorator]
def choose(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask holds, b elsewhere, lane by lane; or one of two numbers by a boolean."""
    kinds = [kind for kind in (a, b) if isinstance(kind, VectorType)] or [LANES[a]] if mask == _mask else [a]

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        chosen, otherwise = args[1:]
        if mask == _mask:
            chosen, otherwise = (_spread(builder, sig.args[k], args[k]) for k in (1, 2))
        return builder.select(args[0], chosen, otherwise)

    return kinds[0](mask, a, b), generate


@intrinsic  # type: ignore[untyped-decorator]
def any_of(typingctx: Any, mask: Any) -> Any:
    """Whether a mask holds for any lane."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        bits = ir.IntType(WIDTH)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), bits(0))

    return types.boolean(_mask), generate


def _address(context: Any, builder: ir.IRBuilder, sig: Any, array: ir.Value, at: ir.Value) -> ir.Value:
    data = context.make_array(sig.args[0])(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), LANES[sig.args[0].dtype].vector.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, at: Any) -> Any:
    """array[at : at + 8]; contiguous float32 or float64, nothing is checked. at: uint64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, sig, *args), align=array.dtype.bitwidth // 8)

    return LANES[array.dtype](array, types.uint64), generate


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, at: Any, value: Any) -> Any:
    """array[at : at + 8] = value; as `load`."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        address = _address(context, builder, sig, *args[:2])
        builder.store(args[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.uint64, LANES[array.dtype]), generate


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(typingctx: Any, array: Any, row: Any) -> Any:
    """Have the first 64 bytes of a row fetched before they are asked for; no harm where there is no such row.

    What another processor wrote last takes longer to come than most of what is done with it.
    """
    return types.void(array, types.int64), _fetch(0)


@intrinsic  # type: ignore[untyped-decorator]
def prefetch_to_write(typingctx: Any, array: Any, row: Any) -> Any:
    """As `prefetch`, so that no other processor has them."""
    return types.void(array, types.int64), _fetch(1)


def _fetch(write: int) -> Callable[..., ir.Value]:
    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        fields = context.make_array(sig.args[0])(context, builder, args[0])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        offset = builder.mul(builder.extract_value(fields.strides, 0), args[1])
        address = builder.gep(builder.bitcast(fields.data, byte), [offset])
        builder.call(function, [address, number(write), number(3), number(1)])  # to be kept; data
        return context.get_dummy_value()

    return generate


@intrinsic  # type: ignore[untyped-decorator]
def spread(typingctx: Any, value: Any) -> Any:
    """Eight times a number."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _spread(builder, sig.args[0], args[0])

    return LANES[value](value), generate


@intrinsic  # type: ignore[untyped-decorator]
def widen(typingctx: Any, value: Any) -> Any:
    """Eight float32 as float64."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.fpext(args[0], _DOUBLES)

    return _doubles(_singles), generate


@intrinsic  # type: ignore[untyped-decorator]
def count(typingctx: Any) -> Any:
    """0, 1, …, 7 in float32."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return ir.Constant(_FLOATS, [float(lane) for lane in range(WIDTH)])

    return _singles(), generate


@intrinsic  # type: ignore[untyped-decorator]
def totals(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """The sums of the lanes of eight, as eight lanes, float32; always added up in the same order."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vectors = list(args)
        for part in (8, 4, 2):  # so many lanes belong to one sum; its halves are added up
            low = [k for k in range(2 * WIDTH) if k % part < part // 2]
            high = [k + part // 2 for k in low]
            vectors = [_add_shuffled(builder, x, y, low, high) for x, y in zip(vectors[::2], vectors[1::2])]  # noqa: B905
        return vectors[0]

    return _singles(a, b, c, d, e, f, g, h), generate


@intrinsic  # type: ignore[untyped-decorator]
def total(typingctx: Any, value: Any) -> Any:
    """The sum of the lanes, as `totals` adds them up."""
    number = next(number for number, kind in LANES.items() if kind == value)

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vector = args[0]
        for half in (4, 2, 1):
            vector = _add_shuffled(builder, vector, vector, list(range(half)), list(range(half, 2 * half)))
        return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))

    return number(value), generate


def _add_shuffled(
    builder: ir.IRBuilder, x: ir.Value, y: ir.Value, first: list[int], second: list[int]
) -> ir.Value:
    """Lanes `first` of x and y, laid end to end, plus lanes `second`."""
    kind = ir.VectorType(ir.IntType(32), len(first))
    sides = [builder.shuffle_vector(x, y, ir.Constant(kind, lanes)) for lanes in (first, second)]
    return builder.fadd(*sides)


@intrinsic  # type: ignore[untyped-decorator]
def whole(typingctx: Any, value: Any) -> Any:
    """Each lane without what follows the point, |value| < 2³¹."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.sitofp(builder.fptosi(args[0], _INTS), _FLOATS)

    return _singles(_singles), generate


@intrinsic  # type: ignore[untyped-decorator]
def times_power(typingctx: Any, value: Any, exponent: Any) -> Any:
    """value · 2^exponent where the exponent is whole and the result a normal number."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        shift = builder.shl(builder.fptosi(args[1], _INTS), ir.Constant(_INTS, [23] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(args[0], _INTS), shift), _FLOATS)

    return _singles(_singles, _singles), generate
