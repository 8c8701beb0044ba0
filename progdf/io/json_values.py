"""JSON parsing with validation against the types and ranges of dataclasses and Structs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, TypeVar

import msgspec

from progdf.errors import ProgdfError

from .atomic import read_file

MAX_NESTING = 64
"""Largest nesting depth of lists and tables. It keeps recursive functions within the stack."""

_MAX_BYTES = 1 << 20  # largest size of the program's own small files
_MAX_INT_DIGITS = 18  # longer integers become floats, as in most languages

_T = TypeVar("_T")


def decode_json(content: bytes | str) -> Any:
    """Parse a JSON text. All numbers are finite, all texts encodable, and the nesting is bounded.

    Raises:
        ValueError: the text is not JSON, repeats a key, or breaks one of these rules; one line.
    """
    try:
        value = json.loads(
            content,
            parse_int=lambda digits: int(digits) if len(digits) <= _MAX_INT_DIGITS else _parse_finite(digits),
            parse_float=_parse_finite,
            parse_constant=_parse_finite,
            object_pairs_hook=_refuse_repeats,
        )
    except RecursionError:
        raise ValueError(f"it is nested more than {MAX_NESTING} deep") from None
    _check_value(value, 0)
    return value


def convert_json(value: object, kind: type[_T], closed: bool = False) -> _T:
    """Convert a JSON value to a dataclass, a `msgspec.Struct` or another type, and check types and ranges.

    Args:
        value: decoded JSON
        kind: the target type
        closed: refuse keys that `kind` does not have

    Raises:
        ValueError: the value does not match; the message names the position, the value and the expectation.
    """
    try:
        converted = msgspec.convert(value, kind, dec_hook=_decode_path)
    except msgspec.ValidationError as error:
        raise ValueError(_explain(str(error), value)) from None
    if closed:
        _refuse_unknown(value, to_json(converted), "")
    return converted


def read_json(path: Path, kind: type[_T]) -> _T:
    """Read a small JSON file of this program as `kind`, see `convert_json`.

    Raises:
        ProgdfError: the file is missing, not a regular file, damaged or larger than 1 MB; one line.
    """
    content = read_file(path, _MAX_BYTES + 1)
    try:
        if len(content) > _MAX_BYTES:
            raise ValueError("it is too large")
        return convert_json(decode_json(content), kind)
    except ValueError as error:
        raise ProgdfError(f"{path} is damaged ({error}); delete it") from None


def check_text(text: str, holder: str) -> str:
    """Return a text unchanged, after a check that JSON can store it.

    Args:
        text: a file name or an argument; bytes that are not UTF-8 are surrogate escapes in it
        holder: the document that will store it, such as "a session"

    Raises:
        ProgdfError: the text is not UTF-8.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ProgdfError(f"{holder} cannot hold {text!r:.80}: it is not UTF-8; rename it") from None
    return text


def one_of(names: Sequence[str]) -> msgspec.Meta:
    """Return the `Annotated` constraint for a text that must be one of several names."""
    return msgspec.Meta(pattern=rf"^({'|'.join(names)})\Z")


def to_json(value: object) -> Any:
    """Convert a value to JSON types that `convert_json` reads back; paths get forward slashes."""
    return msgspec.to_builtins(value, enc_hook=_encode_path)


def _encode_path(value: object) -> str:
    return value.as_posix() if isinstance(value, PurePath) else str(value)


def _decode_path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"expected {kind.__name__}, got {value!r:.40}")


def _parse_finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        shown_digits = digits if len(digits) <= 12 else f"{digits[:12]}…"
        raise ValueError(f"{shown_digits} is not a usable number")
    return number


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a key appears twice")
    return table


def _check_value(value: object, depth: int) -> None:
    if depth > MAX_NESTING:
        raise ValueError(f"it is nested more than {MAX_NESTING} deep")
    if isinstance(value, str):
        value.encode()  # half a surrogate pair raises UnicodeEncodeError, a ValueError
    elif isinstance(value, list):
        for entry in value:
            _check_value(entry, depth + 1)
    elif isinstance(value, dict):
        for key, entry in value.items():
            key.encode()
            _check_value(entry, depth + 1)


def _explain(text: str, value: Any) -> str:
    """Rewrite an error of msgspec so that it begins with the position and the value found."""
    text, _, where = text.replace("`", "").partition(" - at $")
    for name, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", where.partition("[...")[0]):
        value = value[name or int(index)]
    text = re.sub(r"str matching regex '\^(\(.*\)).*'", r"one of \1", text[0].lower() + text[1:])
    text = text.replace("float that's a multiple of 1.0", "a whole number")
    missing = re.fullmatch(r"object missing required field (\S+)", text)
    if missing is not None:
        return f"{f'{where}.{missing[1]}'.removeprefix('.')} is missing"
    at = where.removeprefix(".") or "it"
    if "[...]" in where or not text.startswith("expected"):  # [...] is an entry that msgspec does not name
        return f"{at}: {text}"
    return f"{at} is {value!r:.40}, {text}"


def _refuse_unknown(value: Any, known: Any, at: str) -> None:
    if isinstance(value, dict):
        for key, part in value.items():
            if key not in known:
                raise ValueError(f"{at}{key} is unknown")
            _refuse_unknown(part, known[key], f"{at}{key}.")
    elif isinstance(value, list):
        for i, (part, item) in enumerate(zip(value, known, strict=True)):
            _refuse_unknown(part, item, f"{at[:-1]}[{i}].")
