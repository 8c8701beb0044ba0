"""Sizes of the packages, and the tree of their modules.

`python -m tests.helpers.sizes` prints the table, `--tree` writes the tree into docs/modules.md.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[2]
PACKAGES = ("progdf", "trainer", "viewer")
PAGE = ROOT / "docs" / "modules.md"
BEGIN = "<!-- tree -->\n"
END = "<!-- end tree -->\n"
_NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)

parse = cache(ast.parse)
"""Cached parser, as several tests read each file."""


@dataclass(frozen=True)
class Module:
    """Line counts of a file: all lines, code (no blank, comment, docstring or import) and imports."""

    path: Path
    lines: int
    code: int
    imports: int
    tree: ast.Module


def measure(path: Path, source: str) -> Module:
    """Return the sizes of a file."""
    tree = parse(source)
    texts: set[int] = set()
    imports: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        for child in getattr(node, "body", []) if isinstance(getattr(node, "body", None), list) else []:
            if isinstance(child, ast.Expr) and isinstance(getattr(child.value, "value", None), str):
                texts |= set(range(child.lineno, (child.end_lineno or child.lineno) + 1))
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            used |= set(range(token.start[0], token.end[0] + 1))
    return Module(path, source.count("\n"), len(used - texts - imports), len(imports), tree)


@cache
def modules(package: str) -> list[Module]:
    """Return all modules of a package with more than one statement."""
    paths = sorted((ROOT / package).rglob("*.py"), key=lambda path: (path.parent.parts, path.name))
    measured = [measure(path.relative_to(ROOT), path.read_text(encoding="utf-8")) for path in paths]
    return [module for module in measured if len(module.tree.body) > 1]


def functions(module: Module) -> Iterator[tuple[int, str]]:
    """Yield lines and name of every function, without its decorators and docstring."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) is not None and node.body[1:] else node.body
            yield (body[-1].end_lineno or 0) - body[0].lineno + 1, f"{module.path}:{node.lineno} {node.name}"


def calls(module: Module) -> Iterator[tuple[int, str]]:
    """Yield the number of positional arguments of each call, and its location."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Call):
            yield len(node.args), f"{module.path}:{node.lineno} {ast.unparse(node.func)}"


def importers(all_modules: Mapping[str, Module]) -> dict[str, set[str]]:
    """Return the importing modules of each module, by dotted names."""
    result: dict[str, set[str]] = {name: set() for name in all_modules}
    for name, module in all_modules.items():
        is_package = module.path.stem == "__init__"
        home = name.split(".") if is_package else name.split(".")[:-1]
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ImportFrom):
                base = home[: len(home) - node.level + 1] if node.level else []
                base += [node.module] if node.module else []
                for alias in node.names:
                    full = ".".join([*base, alias.name])
                    target = full if full in result else full.rpartition(".")[0]
                    if target in result and target != name:
                        result[target].add(name)
    return result


def dotted(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def table() -> str:
    """Return the sizes of each package and of all, as Markdown."""
    head = ["modules", "lines", "code", "imports", "median file", "longest function", "widest call"]
    rows = ["| | " + " | ".join(head) + " |", "|" + " --- |" * (len(head) + 1)]
    groups = {name: modules(name) for name in PACKAGES}
    for name, group in [*groups.items(), ("all", [module for one in groups.values() for module in one])]:
        lines = sum(module.lines for module in group)
        imports = sum(module.imports for module in group) / lines
        longest = max(size for module in group for size, _ in functions(module))
        widest = max(size for module in group for size, _ in calls(module))
        figures = (
            len(group),
            lines,
            sum(module.code for module in group),
            f"{imports:.1%}",
            f"{median(module.lines for module in group):g}",
            longest,
            widest,
        )
        rows.append(f"| {name} | " + " | ".join(map(str, figures)) + " |")
    return "\n".join(rows)


def tree() -> str:
    """Return the modules of the packages by folder, each with the first line of its docstring."""
    lines = ["```"]
    for package in PACKAGES:
        folder = None
        for module in modules(package):
            if module.path.parent != folder:
                folder = module.path.parent
                lines.append(f"{folder.as_posix()}/")
            first = (ast.get_docstring(module.tree) or "").split("\n")[0].rstrip(".:")
            lines.append(f"  {module.path.name:24} {first}")
    return "\n".join([*lines, "```\n"])


def with_tree(page: str) -> str:
    """Return a page with the tree between its markers."""
    head = page.split(BEGIN)[0]
    tail = page.split(END)[1]
    return f"{head}{BEGIN}{tree()}{END}{tail}"


if __name__ == "__main__":
    if "--tree" in sys.argv:
        PAGE.write_text(with_tree(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(table())
