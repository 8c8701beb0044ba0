"""Tests of the equality of dataclasses that hold arrays."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import pytest
import torch
from torch import Tensor

from progdf.system.equality import equal_fields
from tests.helpers.paths import ROOT
from tests.test_structure import parse, source_files

ARRAYS = {"Tensor", "NDArray", "ndarray", "Floats", "Rows", "Singles", "Mask", "Pixels"}
CONTAINERS = {"Callable", "tuple", "list", "dict", "Mapping", "Sequence"}
"""Types that compare the same array as equal to itself."""


@dataclass(frozen=True)
class Picture:
    """Name with an array."""

    __eq__ = equal_fields

    name: str
    image: Tensor
    note: str = field(default="", compare=False)


def test_pictures_with_the_same_array_are_equal_and_one_key() -> None:
    image = torch.zeros(2, 2)
    one = Picture("a", image)
    assert one == replace(one)
    assert one == Picture("a", image, note="not compared")
    assert one != replace(one, name="b")
    assert one != "a"
    assert {one: 1}[replace(one)] == 1
    with pytest.raises(RuntimeError, match="ambiguous"):
        _ = one == replace(one, image=image.clone())


def unsafe_classes(source: str) -> Iterator[str]:
    """Yield the dataclasses with arrays, also those of a base in the file, whose equality is Python's own."""
    holders: set[str] = set()
    for node in ast.walk(parse(source)):
        if not isinstance(node, ast.ClassDef):
            continue
        if any(map(holds_array, node.body)) or holders & {ast.unparse(base) for base in node.bases}:
            holders.add(node.name)
        decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
        generated = any(text.startswith("dataclass") and "eq=False" not in text for text in decorators)
        own = any("__eq__" in (getattr(line, "name", ""), ast.unparse(line)[:6]) for line in node.body)
        if generated and not own and node.name in holders:
            yield node.name


def holds_array(line: ast.stmt) -> bool:
    """Return whether a line declares a field that is an array itself."""
    if not isinstance(line, ast.AnnAssign):
        return False
    names = {part.id for part in ast.walk(line.annotation) if isinstance(part, ast.Name)}
    names |= {part.attr for part in ast.walk(line.annotation) if isinstance(part, ast.Attribute)}
    return bool(names & ARRAYS) and not names & CONTAINERS


def test_dataclasses_with_arrays_compare_them_by_identity() -> None:
    found = [
        f"{path}: {name}"
        for path in source_files()
        if path.parts[0] != "benchmarks"
        for name in unsafe_classes((ROOT / path).read_text(encoding="utf-8"))
    ]
    assert not found, f"add `__eq__ = equal_fields` to {found}"


@pytest.mark.parametrize(
    ("line", "unsafe"),
    [("image: Tensor", True), ("image: np.ndarray | None = None", True), ("images: list[Tensor]", False)],
)
def test_equality_check_sees_arrays(line: str, unsafe: bool) -> None:
    code = f"@dataclass(frozen=True)\nclass A:\n    {line}\n"
    assert list(unsafe_classes(code)) == ["A"] * unsafe
    assert not list(unsafe_classes(code.replace("    ", "    __eq__ = equal_fields\n    ", 1)))
