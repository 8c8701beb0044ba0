"""Frozen state ↔ plain JSON values, checked by the types that its dataclasses declare.

What a class has as a default need not be in the file; what it does not have is refused. Arrays become their
bytes, compressed and in base64.
"""

from __future__ import annotations

import base64
import math
import types
import typing
import zlib
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np

_LARGEST = 1 << 28  # bytes of an array; a header that claims more is not believed


class JsonFormError(ValueError):
    """A value that the state cannot hold; the message says where and why."""


def to_json(value: Any) -> Any:
    """A state as JSON values: dataclasses as tables, tuples as lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        packed = base64.b64encode(zlib.compress(np.ascontiguousarray(value).tobytes(), 6)).decode()
        return {"dtype": value.dtype.str, "shape": list(value.shape), "zlib": packed}
    if isinstance(value, (tuple, list, frozenset)):
        return [to_json(part) for part in (sorted(value) if isinstance(value, frozenset) else value)]
    if isinstance(value, dict):
        return {str(key): to_json(part) for key, part in value.items()}
    return value


def from_json(kind: Any, value: Any, where: str = "") -> Any:
    """The state of type `kind` that `to_json` made `value` of.

    Args:
        kind: a dataclass, or what one declares: numbers, str, bool, tuples, dict, arrays, unions of these
        value: JSON values
        where: the value's name, for messages

    Raises:
        JsonFormError: an unknown key, a missing one, or a value of another type; numbers must be finite.
    """
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _one_of(parts, value, where)
    if is_dataclass(kind):
        return _table(kind, value, where)
    if origin is tuple:
        return _tuple(parts, value, where)
    if kind is np.ndarray or origin is np.ndarray:
        return _array(value, where)
    if origin in (dict, frozenset) or origin is typing.Literal:
        return _other(origin, parts, value, where)
    if kind is type(None) and value is None:
        return None
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if math.isfinite(value):
            return float(value)
        raise JsonFormError(f"{where} is not finite")
    if kind in (int, str, bool) and type(value) is kind:
        return value
    raise JsonFormError(f"{where} is {_short_repr(value)}, not {getattr(kind, '__name__', kind)}")


def _table(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise JsonFormError(f"{where or 'it'} is {_short_repr(value)}, not a table")
    known = {f.name: f for f in fields(kind)}
    at = f"{where}." if where else ""
    for name in value:
        if name not in known:
            raise JsonFormError(f"{at}{name} is unknown")
    for name, f in known.items():
        if name not in value and f.default is MISSING and f.default_factory is MISSING:
            raise JsonFormError(f"{at}{name} is missing")
    hints = _hints(kind)
    found = {name: from_json(hints[name], part, at + name) for name, part in value.items()}
    try:
        return kind(**found)
    except ValueError as error:
        raise JsonFormError(f"{where or 'it'}: {error}") from None


def _tuple(parts: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise JsonFormError(f"{where} is {_short_repr(value)}, not a list")
    if len(parts) == 2 and parts[1] is Ellipsis:
        return tuple(from_json(parts[0], part, f"{where}[{i}]") for i, part in enumerate(value))
    if len(parts) != len(value):
        raise JsonFormError(f"{where} has {len(value)} entries, not {len(parts)}")
    return tuple(from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(parts, value, strict=True)))


def _one_of(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    failures = []
    for kind in kinds:
        try:
            return from_json(kind, value, where)
        except JsonFormError as error:
            if kind is not type(None):
                failures.append(error)
    raise failures[0]


def _other(origin: Any, parts: tuple[Any, ...], value: Any, where: str) -> Any:
    if origin is typing.Literal:
        if value in parts:
            return value
    elif origin is frozenset and isinstance(value, list):
        return frozenset(from_json(parts[0], part, where) for part in value)
    elif origin is dict and isinstance(value, dict):
        return {key: from_json(parts[1], part, f"{where}.{key}") for key, part in value.items()}
    raise JsonFormError(f"{where} is {_short_repr(value)}")


def _array(value: Any, where: str) -> np.ndarray[Any, Any]:
    try:
        dtype, shape = np.dtype(value["dtype"]), tuple(int(side) for side in value["shape"])
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind not in "fiub" or min(shape, default=0) < 0 or size > _LARGEST:
            raise ValueError
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(base64.b64decode(value["zlib"], validate=True), size + 1)
        array = np.frombuffer(content, dtype).reshape(shape).copy()
    except (KeyError, TypeError, ValueError, zlib.error):
        raise JsonFormError(f"{where} is a damaged array") from None
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise JsonFormError(f"{where} is not finite")
    return array


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _short_repr(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:39]}…"
