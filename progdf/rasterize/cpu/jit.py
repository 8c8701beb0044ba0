"""Compilation of the kernels: float flags, the cache on disk, and a vector type of eight float32.

numba has no vector type. LLVM alone decides if a loop is vectorized and in which order it sums. With plain
loops a forward and backward pass takes 1.7 times as long, and its bits differ between processors. A `Vector`
is LLVM's <8 x float>: one AVX register, or two SSE or NEON registers. Arithmetic and comparisons use Python's
operators, lane by lane, with the float flags of the surrounding kernel. A float32 next to a vector counts as
eight equal lanes.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import operator
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from functools import cache as once
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock

from progdf.errors import ProgdfError, is_out_of_memory
from progdf.io.atomic import cache_folder, temporary_folder
from progdf.system.files import is_private

try:
    import numba
    from llvmlite import ir
    from numba import config, types
    from numba.core import cgutils
    from numba.core.typing.templates import AbstractTemplate, builtin_registry, signature
    from numba.extending import intrinsic, lower_builtin, models, register_model
except Exception as error:  # numba reads its settings on import and raises any error that they cause
    if is_out_of_memory(error) or isinstance(error, ImportError):  # not a setting
        raise
    raise ProgdfError(
        f"numba cannot be loaded ({type(error).__name__}: {error}); check the variables NUMBA_…, and "
        ".numba_config.yaml in the current folder"
    ) from error
if config.DISABLE_JIT:
    raise ProgdfError("the rasterizer needs numba's compiler; unset NUMBA_DISABLE_JIT")

log = logging.getLogger("progdf")

FAST = {"nnan", "ninf", "nsz", "contract", "reassoc", "afn"}
"""Float flags of the pixel loops.

`arcp` is left out: it costs gradients one decimal digit and saves no time.
"""

Number = Any
"""Number inside a kernel, of the type that numba infers.

Python's int and float cannot express float32 or uint64.
"""

_F = TypeVar("_F", bound=Callable[..., Any])
_first_call = threading.Lock()

listeners: list[Callable[[], None]] = []
"""Functions to call after each kernel that has been compiled, or loaded from the disk."""


def kernel(
    *, fast: bool = False, contract: bool = False, cache: bool = False, inline: bool = False,
    allocates: bool = False,
) -> Callable[[_F], _F]:  # fmt: skip
    """Compile a function with numba. It releases the interpreter lock.

    Args:
        fast: use the flags of the pixel loops (`FAST`); otherwise strict IEEE
        contract: strict except for fused multiply-adds
        cache: for functions that Python calls, not for kernels called by kernels. The machine code is kept on
            disk, and the cache is read at the first call
        inline: always inline into the calling kernel
        allocates: allow the kernel to create arrays. Without it, numba skips reference counting of the array
            arguments, which would make threads that share them wait at each call
    """
    flags: set[str] | bool = False
    if fast:
        flags = FAST
    elif contract:
        flags = {"contract"}

    def compile_now(function: _F) -> _F:
        options = {"nogil": True, "error_model": "numpy", "forceinline": inline, "_nrt": allocates}
        compiled: _F = numba.njit(fastmath=flags, cache=cache, **options)(function)
        return compiled

    return _compile_when_called(compile_now) if cache else compile_now


def _compile_when_called(compile_now: Callable[[_F], _F]) -> Callable[[_F], _F]:
    def decorate(function: _F) -> _F:
        compiled: _F | None = None

        def call_first(*arguments: Any) -> Any:
            """Load or compile the kernel. One process at a time, because two would write the same files."""
            nonlocal compiled
            with _first_call, FileLock(kernel_cache() / f"{function.__name__}.lock"):
                loaded = compiled or _with_cache_folder(compile_now, function)
                try:
                    result = loaded(*arguments)
                except Exception as error:  # the type depends on how a cache file is truncated
                    log.warning("recompiling the kernels in %s (%s)", kernel_cache(), error)
                    for path in kernel_cache().rglob("*.nb[ic]"):
                        path.unlink(missing_ok=True)
                    loaded = _with_cache_folder(compile_now, function)
                    result = loaded(*arguments)
            compiled = loaded
            for listener in listeners:
                listener()
            return result

        @wraps(function)
        def call(*arguments: Any) -> Any:
            return compiled(*arguments) if compiled is not None else call_first(*arguments)

        return call  # type: ignore[return-value]

    return decorate


def _with_cache_folder(compile_now: Callable[[_F], _F], function: _F) -> _F:
    before = config.CACHE_DIR  # read by the decorator; the caches of other packages stay in place
    config.CACHE_DIR = str(kernel_cache())
    try:
        return compile_now(function)
    finally:
        config.CACHE_DIR = before


@once
def kernel_cache() -> Path:
    """Return the folder of compiled kernels. It is created when the first kernel is needed."""
    folder = find_cache_folder()
    if not any(folder.rglob("*.nbi")):
        log.warning("compiling the rasterizer's kernels (about 20 s, once per machine)")
    return folder


def find_cache_folder() -> Path:
    """Return a folder that this user may write, for this version of the kernels. Never in the source tree."""
    override = os.environ.get("NUMBA_CACHE_DIR")
    root = Path(override) if override else cache_folder() / "kernels"
    temporary = temporary_folder()
    for base in (root, temporary / "kernels"):
        folder = base / _source_version()
        try:
            if base.parent == temporary:
                temporary.mkdir(mode=0o700, exist_ok=True)
                if not is_private(temporary):  # do not run machine code of another user
                    continue
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    log.warning("cannot write to %s; every process compiles the kernels again", root)
    folder = Path(tempfile.mkdtemp(prefix="progdf-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _source_version() -> str:
    """Return a hash of all files that kernels depend on.

    numba's cache notices neither changed constants nor changed imported functions.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).parents[2]
    for path in sorted(
        [
            *package.glob("rasterize/**/*.py"),
            *package.glob("compose/*.py"),
            *package.glob("pull/*_kernel.py"),
            *package.glob("formats/packed/*_kernel.py"),
            package / "sh.py",
        ]
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


Vector = Any
"""Eight float32 inside a kernel."""

Mask = Any
"""Eight booleans inside a kernel."""

WIDTH = 8
"""Number of lanes of a vector."""

_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_BOOLS = ir.VectorType(ir.IntType(1), WIDTH)


def select(mask: Mask, a: Vector, b: Vector) -> Vector:
    """Return a where the mask is true and b elsewhere, lane by lane."""


def broadcast(value: Any) -> Vector:
    """Return a vector with a float32 in all eight lanes."""


def lane_indices() -> Vector:
    """Return 0, 1, …, 7."""


def lane_sums(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Vector:
    """Return the lane sums of eight vectors as one vector. The order of summation is fixed."""


def lane_sum(value: Vector) -> Any:
    """Return the sum of the lanes, in the order of `lane_sums`."""


def truncate(value: Vector) -> Vector:
    """Return each lane rounded towards zero, |value| < 2³¹."""


def ldexp(value: Vector, exponent: Vector) -> Vector:
    """Return value · 2^exponent for integer exponents and results that are normal numbers."""


def sqrt(value: Vector) -> Vector:
    """Return the square root of each lane; NaN below 0."""


class _VectorType(types.Type):  # type: ignore[misc]
    """Numba type of an LLVM vector."""

    def __init__(self, name: str, vector: ir.VectorType) -> None:
        super().__init__(name=name)
        self.vector = vector


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.vector)


_vector = _VectorType("Vector", _FLOATS)
_mask = _VectorType("Mask", _BOOLS)
_single = types.float32


def _broadcast(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Return a vector: a vector as it is, a number in all lanes."""
    if isinstance(value.type, ir.VectorType):
        return value
    vector = ir.Constant(_FLOATS, ir.Undefined)
    single = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(single, vector, ir.Constant(_INTS, [0] * WIDTH))


def _define(
    function: Callable[..., Any], arguments: tuple[types.Type, ...], result: types.Type,
    emit: Callable[..., ir.Value],
) -> None:  # fmt: skip
    """Register a function or operator with numba for arguments of exactly these types.

    `emit` receives vectors.
    """

    class _Template(AbstractTemplate):  # type: ignore[misc]
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            return signature(result, *args) if args == arguments else None

    builtin_registry.register_global(function, types.Function(_Template))

    @lower_builtin(function, *arguments)  # type: ignore[untyped-decorator]
    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return emit(builder, *(_broadcast(builder, value) for value in args))


def _add_shuffled(b: ir.IRBuilder, x: ir.Value, y: ir.Value, first: list[int], second: list[int]) -> ir.Value:
    """Return lanes `first` plus lanes `second` of the concatenation of x and y."""
    kind = ir.VectorType(ir.IntType(32), len(first))
    return b.fadd(*(b.shuffle_vector(x, y, ir.Constant(kind, lanes)) for lanes in (first, second)))


def _lane_sums(b: ir.IRBuilder, *vectors: ir.Value) -> ir.Value:
    for part in (8, 4, 2):  # lanes per sum; each step adds the two halves
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


def _sqrt(b: ir.IRBuilder, value: ir.Value) -> ir.Value:
    kind = ir.FunctionType(_FLOATS, [_FLOATS])
    function = cgutils.get_or_insert_function(b.module, kind, f"llvm.sqrt.v{WIDTH}f32")
    return b.call(function, [value])


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
_define(sqrt, (_vector,), _vector, _sqrt)
_define(truncate, (_vector,), _vector, lambda b, x: b.sitofp(b.fptosi(x, _INTS), _FLOATS))
_define(ldexp, (_vector, _vector), _vector, _ldexp)


def _pointer(context: Any, builder: ir.IRBuilder, sig: Any, array: ir.Value, at: ir.Value) -> ir.Value:
    data = context.make_array(sig.args[0])(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _FLOATS.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, at: Any) -> Any:
    """Return array[at : at + 8] of a contiguous float32 array, without a bounds check. at: uint64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load(_pointer(context, builder, sig, *args), align=4)

    return _vector(array, types.uint64), generate


@intrinsic  # type: ignore[untyped-decorator]
def load_numbers(typingctx: Any, array: Any, at: Any) -> Any:
    """Return array[at : at + 8] of a contiguous array, without a bounds check.

    array: float32 or uint16; at: uint64
    """

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        if array.dtype == types.float32:
            return builder.load(_pointer(context, builder, sig, *args), align=4)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        shorts = ir.VectorType(ir.IntType(16), WIDTH)
        numbers = builder.load(builder.bitcast(builder.gep(data, [args[1]]), shorts.as_pointer()), align=2)
        return builder.uitofp(numbers, _FLOATS)

    return _vector(array, types.uint64), generate


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, at: Any, value: Any) -> Any:
    """Set array[at : at + 8] = value, without a bounds check. at: uint64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        builder.store(args[2], _pointer(context, builder, sig, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, _vector), generate


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(typingctx: Any, array: Any, row: Any) -> Any:
    """Prefetch the first 64 bytes of a row. Safe for a row that does not exist."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        fields = context.make_array(sig.args[0])(context, builder, args[0])
        byte = ir.IntType(8).as_pointer()
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        offset = builder.mul(builder.extract_value(fields.strides, 0), args[1])
        address = builder.gep(builder.bitcast(fields.data, byte), [offset])
        # flags: read, keep in all cache levels, data
        builder.call(function, [address, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
