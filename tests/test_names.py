"""Test that names and file names in backticks exist, in docstrings, comments and documents."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections import defaultdict
from functools import cache, cached_property
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("progdf", "trainer", "viewer", "shaders", "benchmarks", "release", "tests")
DOCUMENTS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
SOURCE_SUFFIXES = {"py", "md", "glsl", "vert", "frag"}
PLACEHOLDERS = {"NAME", "DIR", "OUT", "SCENE", "VIEW", "PART", "PROMPT", "VERTEX", "FRAGMENT", "A", "V", "I"}

FOREIGN_NAMES = {"JoyImageEditPlusPipeline", "prange", "data_offsets", "RayJob"}
"""Names of diffusers, numba, safetensors and Ray that documents mention."""

QUOTED = re.compile(r"`([A-Za-z_]\w*(?:[./]\w+)+)`")
SINGLE = re.compile(r"(?<![`\w])`([A-Za-z_]\w*)`(?!`)")


class Tree:
    """Names of the repository: files, modules and their names, classes and their attributes, strings."""

    def __init__(self) -> None:
        self.sources = {
            path.relative_to(ROOT): path.read_text(encoding="utf-8")
            for package in PACKAGES
            for path in sorted((ROOT / package).rglob("*.py"))
        }
        self.paths = {p.relative_to(ROOT).as_posix() for name in PACKAGES for p in (ROOT / name).rglob("*")}
        self.paths |= {path.relative_to(ROOT).as_posix() for path in DOCUMENTS}
        self.modules: dict[str, set[str]] = {}  # dotted name -> top-level names
        self.attributes: defaultdict[str, set[str]] = defaultdict(set)  # class -> fields and methods
        self.strings: set[str] = set()
        bases: defaultdict[str, set[str]] = defaultdict(set)
        for path, source in self.sources.items():
            tree = ast.parse(source)
            module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
            self.modules[module] = {name for node in tree.body for name in defined(node)}
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    self.attributes[node.name] |= {name for child in node.body for name in defined(child)}
                    self.attributes[node.name] |= set(re.findall(r"\bself\.(\w+)", ast.unparse(node)))
                    bases[node.name] |= {ast.unparse(base).rpartition(".")[2] for base in node.bases}
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    self.strings.add(node.value)
        for name in list(bases):
            for base in bases[name]:
                self.attributes[name] |= self.attributes.get(base, set())
        for package, names in self.modules.items():  # a folder holds its modules
            parent, _, stem = package.rpartition(".")
            if parent in self.modules:
                self.modules[parent].add(stem)
            if ROOT.joinpath(*package.split("."), "__init__.py").exists():
                names |= set(re.findall(r"\w+", self.sources[Path(*package.split("."), "__init__.py")]))

    def holds_file(self, name: str) -> bool:
        """Return True if a path of the repository ends with `name`."""
        return any(path == name or path.endswith("/" + name) for path in self.paths)

    def defines(self, parts: list[str]) -> bool:
        """Return True if code defines `module.name`, `module.Class.attribute` or `Class.attribute`."""
        if len(parts) == 2 and parts[1] in self.attributes.get(parts[0], ()):
            return True
        for cut in range(len(parts), 0, -1):
            stem = ".".join(parts[:cut])
            rest = parts[cut:]
            for module, names in self.modules.items():
                if module == stem or module.endswith("." + stem):
                    if not rest or (len(rest) == 1 and rest[0] in names):
                        return True
                    if len(rest) == 2 and rest[0] in names and rest[1] in self.attributes.get(rest[0], ()):
                        return True
        return False

    @cached_property
    def single_names(self) -> set[str]:
        """Names that code defines or uses, and the words of its strings and options."""
        names = {word for text in self.strings for word in re.findall(r"\w+", text) if len(text) < 200}
        for source in self.sources.values():
            for node in ast.walk(ast.parse(source)):
                for field in ("id", "attr", "arg", "name", "module"):
                    value = getattr(node, field, None)
                    if isinstance(value, str):
                        names |= set(value.split("."))
        return names

    def is_key(self, name: str) -> bool:
        """Return True if one of our files has this name, or holds a key or tensor of this name."""
        return name in self.strings or "." + name.rpartition(".")[2] in self.strings


def defined(node: ast.stmt) -> list[str]:
    """Return the names that one statement of a module or class defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
        return [node.name]
    if isinstance(node, ast.Assign):
        return [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return [node.target.id]
    return []


@cache
def tree() -> Tree:
    return Tree()


def is_foreign(head: str) -> bool:
    """Return True if the first part is another library, whose names are not checked."""
    return head in ("imgui", "np") or (head not in PACKAGES and importlib.util.find_spec(head) is not None)


def unresolved(text: str, code: str = "") -> list[str]:
    """Return the quoted names in `text` that the tree does not define. `code` is the quoting module."""
    missing = []
    for name in QUOTED.findall(text):
        parts = re.split(r"[./]", name)
        if PLACEHOLDERS & set(parts) or is_foreign(parts[0]):
            continue
        if parts[-1] in SOURCE_SUFFIXES:
            known = tree().holds_file(name)
        elif "/" in name:
            known = tree().holds_file(name) or tree().is_key(name.rpartition("/")[2])
        else:
            known = tree().defines(parts) or tree().is_key(name)
            if not known and re.search(rf"\b{parts[0]}\b\s*[.:,)=]", code.replace(f"`{name}`", "")):
                known = any(parts[1] in names for names in tree().attributes.values())  # a variable's field
        if not known:
            missing.append(name)
    known_names = tree().single_names | FOREIGN_NAMES
    missing += [name for name in SINGLE.findall(text) if name not in known_names and not is_foreign(name)]
    return missing


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_names_in_a_document_exist(path: Path) -> None:
    assert unresolved(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_names_in_docstrings_and_comments_exist(package: str) -> None:
    missing = {
        path.as_posix(): names
        for path, source in tree().sources.items()
        if path.parts[0] == package and path.name != "test_names.py" and (names := unresolved(source, source))
    }
    assert not missing, "\n".join(f"{path}: {', '.join(names)}" for path, names in missing.items())


def test_missing_name_is_found() -> None:
    text = "`progdf.compose.nothing_here` `Layer.nothing_here` `nowhere.py` `gone/file.py` `paint.gone`"
    assert unresolved(text) == re.findall(r"[\w./]+", text)
    assert unresolved("`no_such" + "_name`") == ["no_such" + "_name"]
    assert unresolved("`Layer.strength` `progdf.compose.composer.Composer` `compose/layers.py`") == []
