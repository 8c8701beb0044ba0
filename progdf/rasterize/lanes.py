"""Eight float32 at once, as a type of numba's: what the pixel loops are written in.

numba has no vector type, and whether LLVM turns a loop over pixels into vector code, and how it adds up its
lanes, is LLVM's choice. A `Lanes` is LLVM's <8 x float>: one AVX register, two of SSE's or NEON's. Arithmetic
and comparison are Python's operators, lane by lane; a float32 beside lanes stands for eight equal ones.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numpy.typing import NDArray

from progdf.rasterize.jit import FAST

Array = NDArray[Any]
Lanes = Any
"""Inside a kernel: eight float32."""

Mask = Any
"""Inside a kernel: eight booleans."""

WIDTH = 8
"""How many lanes there are."""

_FLAGS = tuple(sorted(FAST))
_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_BOOLS = ir.VectorType(ir.IntType(1), WIDTH)


class _LanesType(types.Type):  # type: ignore[misc]
    """numba's name for <8 x float>."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


class _MaskType(types.Type):  # type: ignore[misc]
    """numba's name for <8 x i1>."""

    def __init__(self) -> None:
        super().__init__(name="Mask")


_lanes, _mask = _LanesType(), _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BOOLS)


def _spread(builder: ir.IRBuilder, kind: types.Type, value: ir.Value) -> ir.Value:
    """Eight times the same where it is one number."""
    if kind == _lanes:
        return value
    single = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    first = ir.Constant(_INTS, [0] * WIDTH)
    return builder.shuffle_vector(single, ir.Constant(_FLOATS, ir.Undefined), first)


def _operator(name: Callable[..., Any], result: types.Type, emit: Callable[..., ir.Value]) -> None:
    """Teach numba an operator between lanes, or lanes and a float32."""
    pairs = ((_lanes, _lanes), (_lanes, types.float32), (types.float32, _lanes))

    @infer_global(name)
    class _Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if args in pairs else None

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return emit(builder, *(_spread(builder, *pair) for pair in zip(sig.args, args, strict=True)))

    for pair in pairs:
        lower_builtin(name, *pair)(lower)


_operator(operator.add, _lanes, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_operator(operator.iadd, _lanes, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
_operator(operator.sub, _lanes, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_operator(operator.mul, _lanes, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_operator(operator.truediv, _lanes, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_operator(operator.lt, _mask, lambda builder, a, b: builder.fcmp_ordered("<", a, b, flags=_FLAGS))
_operator(operator.le, _mask, lambda builder, a, b: builder.fcmp_ordered("<=", a, b, flags=_FLAGS))
_operator(operator.gt, _mask, lambda builder, a, b: builder.fcmp_ordered(">", a, b, flags=_FLAGS))


@infer_global(operator.and_)
class _And(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(_mask, *args) if args == (_mask, _mask) else None


@lower_builtin(operator.and_, _mask, _mask)  # type: ignore[untyped-decorator]
def _lower_and(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    return builder.and_(*args)


@intrinsic  # type: ignore[untyped-decorator]
def choose(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask holds, b elsewhere, lane by lane."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        chosen, otherwise = (_spread(builder, sig.args[k], args[k]) for k in (1, 2))
        return builder.select(args[0], chosen, otherwise)

    return _lanes(mask, a, b), generate


def _address(context: Any, builder: ir.IRBuilder, sig: Any, array: ir.Value, at: ir.Value) -> ir.Value:
    data = context.make_array(sig.args[0])(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _FLOATS.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, at: Any) -> Any:
    """array[at : at + 8]; contiguous float32, nothing is checked. at: uint64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, sig, *args), align=4)

    return _lanes(array, types.uint64), generate


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, at: Any, value: Any) -> Any:
    """array[at : at + 8] = value; as `load`."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        builder.store(args[2], _address(context, builder, sig, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, _lanes), generate


@intrinsic  # type: ignore[untyped-decorator]
def spread(typingctx: Any, value: Any) -> Any:
    """Eight times a float32."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _spread(builder, sig.args[0], args[0])

    return _lanes(types.float32), generate


@intrinsic  # type: ignore[untyped-decorator]
def count(typingctx: Any) -> Any:
    """0, 1, …, 7."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return ir.Constant(_FLOATS, [float(lane) for lane in range(WIDTH)])

    return _lanes(), generate


@intrinsic  # type: ignore[untyped-decorator]
def totals(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """The sums of the lanes of eight, as eight lanes; always added up in the same order."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vectors = list(args)
        for part in (8, 4, 2):  # so many lanes belong to one sum; its halves are added up
            low = [k for k in range(2 * WIDTH) if k % part < part // 2]
            high = [k + part // 2 for k in low]
            vectors = [_add_shuffled(builder, x, y, low, high) for x, y in zip(vectors[::2], vectors[1::2])]  # noqa: B905
        return vectors[0]

    return _lanes(a, b, c, d, e, f, g, h), generate


@intrinsic  # type: ignore[untyped-decorator]
def total(typingctx: Any, value: Any) -> Any:
    """The sum of the lanes, as `totals` adds them up. float32"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        vector = args[0]
        for half in (4, 2, 1):
            vector = _add_shuffled(builder, vector, vector, list(range(half)), list(range(half, 2 * half)))
        return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))

    return types.float32(_lanes), generate


def _add_shuffled(
    builder: ir.IRBuilder, x: ir.Value, y: ir.Value, first: list[int], second: list[int]
) -> ir.Value:
    """Lanes `first` of x and y, laid end to end, plus lanes `second`."""
    kind = ir.VectorType(ir.IntType(32), len(first))
    sides = [builder.shuffle_vector(x, y, ir.Constant(kind, lanes)) for lanes in (first, second)]
    return builder.fadd(*sides, flags=_FLAGS)


@intrinsic  # type: ignore[untyped-decorator]
def whole(typingctx: Any, value: Any) -> Any:
    """Each lane without what follows the point, |value| < 2³¹."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.sitofp(builder.fptosi(args[0], _INTS), _FLOATS)

    return _lanes(_lanes), generate


@intrinsic  # type: ignore[untyped-decorator]
def times_power(typingctx: Any, value: Any, exponent: Any) -> Any:
    """value · 2^exponent where the exponent is whole and the result a normal number."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        shift = builder.shl(builder.fptosi(args[1], _INTS), ir.Constant(_INTS, [23] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(args[0], _INTS), shift), _FLOATS)

    return _lanes(_lanes, _lanes), generate
