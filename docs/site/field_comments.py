"""Extension of griffe: the comment of a dataclass field is its text in the reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from griffe import Attribute, Docstring, Extension


class FieldComments(Extension):
    """Reader of comments behind or above fields, such as `strength: float = 1.0  # slider value, 0 to 1`."""

    def on_attribute(self, *, attr: Attribute, **_: Any) -> None:
        """Give an attribute without a docstring its comment."""
        if attr.docstring is not None or attr.lineno is None or not isinstance(attr.filepath, Path):
            return
        comment = attr.source.partition("  # ")[2] or comment_above(attr.filepath, attr.lineno)
        if comment:
            text = comment[0].upper() + comment[1:]
            attr.docstring = Docstring(text, lineno=attr.lineno, endlineno=attr.lineno, parent=attr)


def comment_above(file: Path, line: int) -> str:
    """Return the comment on the lines directly above a line, numbered from 1; "" if there is none."""
    found: list[str] = []
    for text in reversed(file.read_text(encoding="utf-8").splitlines()[: line - 1]):
        if not text.strip().startswith("# "):
            break
        found.insert(0, text.strip().removeprefix("# "))
    return " ".join(found)
