"""JSON from files, checked: an error is reported with its place, its name and what it is.

`where` is how a message begins: "camera 3 of cameras.json".
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch
from torch import Tensor

from progdf.errors import ProgdfError

DEEPEST = 64
"""Lists and tables in one another that a file may have: what walks through them never runs out of stack."""

_LONGEST_INT = 18  # digits; what is longer is a float, as in most languages

_T = TypeVar("_T")


def decode_json(content: bytes | str) -> Any:
    """The value that a JSON text holds: every number finite, every text encodable, nothing nested too deeply.

    Raises:
        ValueError: it is no JSON, or holds what no file of ours does; one line.
    """
    try:
        value = json.loads(
            content,
            parse_int=lambda digits: int(digits) if len(digits) <= _LONGEST_INT else _parse_finite(digits),
            parse_float=_parse_finite,
            parse_constant=_parse_finite,
            object_pairs_hook=_refuse_repeats,
        )
    except RecursionError:
        raise ValueError(f"it is nested more than {DEEPEST} deep") from None
    _check(value, 0)
    return value


def convert_json(value: object, kind: type[_T]) -> _T:
    """A JSON value as a dataclass, a `msgspec.Struct`, or what else declares its types.

    Raises:
        ValueError: it is of another type; the message says where.
    """
    try:
        return msgspec.convert(value, kind, dec_hook=_path)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None


def plain(value: object) -> Any:
    """The JSON value that `convert_json` reads back; paths are text."""
    return msgspec.to_builtins(value, enc_hook=str)


def _path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"expected {kind.__name__}, got {value!r:.40}")


def _parse_finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"{digits[:12]}{'…' * (len(digits) > 12)} is not a usable number")
    return number


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a key appears twice")
    return table


def _check(value: object, depth: int) -> None:
    if depth > DEEPEST:
        raise ValueError(f"it is nested more than {DEEPEST} deep")
    if isinstance(value, str):
        value.encode()  # half a surrogate pair raises, a ValueError too
    elif isinstance(value, list):
        for entry in value:
            _check(entry, depth + 1)
    elif isinstance(value, dict):
        for key, entry in value.items():
            key.encode()
            _check(entry, depth + 1)


def table_at(where: str, entry: object) -> Mapping[str, Any]:
    """The entry, which must be a JSON object."""
    if not isinstance(entry, dict):
        raise ProgdfError(f"{where} is not a JSON object; export the cameras again")
    return entry


def number_at(where: str, table: Mapping[str, Any], key: str) -> float:
    """A number that is finite in float32."""
    value = table.get(key)
    if not _is_number(value):
        raise ProgdfError(f"{where} has {key} = {_short_text(value)}; expected a number")
    return float(table[key])


def angle_at(where: str, table: Mapping[str, Any], key: str) -> float:
    """A field of view in radians, between 0 and pi."""
    angle = number_at(where, table, key)
    if not 0 < angle < math.pi:
        raise ProgdfError(f"{where} has {key} = {angle:g}; expected an angle between 0 and pi")
    return angle


def pixels_at(where: str, table: Mapping[str, Any], key: str) -> int:
    """A whole number of pixels, from 1 to a million."""
    number = number_at(where, table, key)
    if number != round(number) or not 1 <= number <= 1_000_000:
        raise ProgdfError(f"{where} has {key} = {number:g}; expected a whole number of pixels")
    return int(number)


def matrix_at(where: str, table: Mapping[str, Any], key: str, rows: tuple[int, ...], columns: int) -> Tensor:
    """Rows of numbers, as many as one of `rows`, each of so many columns. [R,C] float64"""
    value = table.get(key)
    good = (
        isinstance(value, list)
        and len(value) in rows
        and all(isinstance(row, list) and len(row) == columns for row in value)
        and all(_is_number(x) for row in value for x in row)
    )
    if not good:
        shape = " or ".join(f"{count}x{columns}" for count in rows)
        raise ProgdfError(f"{where} has no usable {key}; {shape} finite numbers expected")
    return torch.tensor(value, dtype=torch.float64)


def _is_number(value: object) -> bool:
    """Finite, and within what float32 can hold (JSON has integers of any length)."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 3e38


def _short_text(value: object) -> str:
    return "nothing" if value is None else repr(value)[:40]
