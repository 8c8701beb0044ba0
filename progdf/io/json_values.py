"""JSON from files, checked by the types and ranges that dataclasses and Structs declare."""

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

DEEPEST = 64
"""Lists and tables in one another that a file may have: what walks through them never runs out of stack."""

_MAX_BYTES = 1 << 20  # of the files that programs keep for themselves
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


def convert_json(value: object, kind: type[_T], closed: bool = False) -> _T:
    """A JSON value as a dataclass, a `msgspec.Struct`, or what else declares its types and ranges.

    Args:
        value: JSON values
        kind: what it is to be
        closed: refuse keys that `kind` does not have

    Raises:
        ValueError: it is something else; the message says where, what was found and what was expected.
    """
    try:
        converted = msgspec.convert(value, kind, dec_hook=_path)
    except msgspec.ValidationError as error:
        raise ValueError(_explain(str(error), value)) from None
    if closed:
        _refuse_unknown(value, plain(converted), "")
    return converted


def read_json(path: Path, kind: type[_T]) -> _T:
    """A small file of the program's own as `kind`, see `convert_json`.

    Raises:
        ProgdfError: it is missing, no file, damaged or larger than any of them; one line.
    """
    content = read_file(path, _MAX_BYTES + 1)
    try:
        if len(content) > _MAX_BYTES:
            raise ValueError("it is too large")
        return convert_json(decode_json(content), kind)
    except ValueError as error:
        raise ProgdfError(f"{path} is damaged ({error}); delete it") from None


def check_text(text: str, holder: str) -> str:
    """Return a text that JSON can hold; names of files and arguments may be other bytes.

    Args:
        text: a text, in which bytes that are not UTF-8 are surrogate escapes
        holder: the thing that is to hold it, such as "a session"

    Raises:
        ProgdfError: the text is not UTF-8.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ProgdfError(f"{holder} cannot hold {text!r:.80}: it is not UTF-8; rename it") from None
    return text


def one_of(names: Sequence[str]) -> msgspec.Meta:
    """What the type of a text declares that is one of a few names."""
    return msgspec.Meta(pattern=rf"^({'|'.join(names)})\Z")


def plain(value: object) -> Any:
    """The JSON value that `convert_json` reads back; paths are text, with forward slashes on any system."""
    return msgspec.to_builtins(value, enc_hook=_text)


def _text(value: object) -> str:
    return value.as_posix() if isinstance(value, PurePath) else str(value)


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


def _explain(text: str, value: Any) -> str:
    """An error of msgspec's that begins with the place's name and what is there."""
    text, _, where = text.replace("`", "").partition(" - at $")
    for name, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", where.partition("[...")[0]):
        value = value[name or int(index)]
    text = re.sub(r"str matching regex '\^(\(.*\)).*'", r"one of \1", text[0].lower() + text[1:])
    text = text.replace("float that's a multiple of 1.0", "a whole number")
    at = where.removeprefix(".") or "it"
    return f"{at} is {value!r:.40}, {text}" if text.startswith("expected") else f"{at}: {text}"


def _refuse_unknown(value: Any, known: Any, at: str) -> None:
    if isinstance(value, dict):
        for key, part in value.items():
            if key not in known:
                raise ValueError(f"{at}{key} is unknown")
            _refuse_unknown(part, known[key], f"{at}{key}.")
    elif isinstance(value, list):
        for i, (part, item) in enumerate(zip(value, known, strict=True)):
            _refuse_unknown(part, item, f"{at[:-1]}[{i}].")
