"""Equality of dataclasses that hold arrays, the same in every Python version."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any


def equal_fields(first: Any, second: object) -> bool:
    """Compare two dataclasses by their fields. Make it the `__eq__` of a dataclass with arrays.

    The same array is equal to itself; different arrays raise, as they have no single truth value. Up to
    3.12 Python does this by itself, because it compares tuples of the fields. From 3.13 on it compares field
    by field, which raises for the same array, too.
    """
    if first is second:
        return True
    kind: Any = type(first)
    names = _compared_names(kind)
    if type(second) is not kind:
        return NotImplemented  # type: ignore[no-any-return]  # an operator's answer, which Python replaces
    return tuple(getattr(first, name) for name in names) == tuple(getattr(second, name) for name in names)


@cache
def _compared_names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind) if field.compare)
