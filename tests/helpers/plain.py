"""Measures of plain English and of dense code in Python sources and Markdown pages.

`python -m tests.helpers.plain [PATH …]` prints them, a row per path.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

RELATIVE_LEADS = frozenset({"What", "Whether", "Which", "Where", "Of", "Who", "How", "That", "Those"})
_WHAT = re.compile(r"\bwhat\b", re.IGNORECASE)
_FIRST_WORD = re.compile(r"[A-Za-z]+")
_CODE_BLOCK = re.compile(r"```.*?```", re.DOTALL)


@dataclass(frozen=True)
class Counts:
    """Words and constructs of some files."""

    words: int = 0  # of docstrings, comments and paragraphs
    whats: int = 0  # "what" among these words
    docstrings: int = 0
    relative_leads: int = 0  # docstrings that start with a relative word instead of a verb or noun
    code_lines: int = 0  # without imports, comments and docstrings
    parallel: int = 0  # a, b = x, y
    products: int = 0  # "text" * condition, [item] * bool(item)
    nested: int = 0  # conditional expressions inside conditional expressions

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))

    @property
    def measures(self) -> dict[str, float]:
        """Rates: per 1 000 words, in percent of docstrings, and per 1 000 lines of code."""
        lines = max(self.code_lines, 1) / 1000
        return {
            "what": 1000 * self.whats / max(self.words, 1),
            "leads": 100 * self.relative_leads / max(self.docstrings, 1),
            "parallel": self.parallel / lines,
            "products": self.products / lines,
            "nested": self.nested / lines,
        }


def count_python(source: str) -> Counts:
    """Count the prose and the dense constructs of one Python file."""
    tree = ast.parse(source)
    docstrings = [*_docstrings(tree)]
    doc_lines = {line for _, first, last in docstrings for line in range(first, last + 1)}
    texts = [text for text, _, _ in docstrings]
    texts += [
        token.string.lstrip("#: ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    ]
    code_lines = sum(
        bool(line.strip())
        and not line.strip().startswith(("#", "import ", "from "))
        and number not in doc_lines
        for number, line in enumerate(source.splitlines(), 1)
    )
    nodes = [*ast.walk(tree)]
    return Counts(
        words=sum(len(text.split()) for text in texts),
        whats=sum(len(_WHAT.findall(text)) for text in texts),
        docstrings=len(docstrings),
        relative_leads=sum(_starts_relative(text) for text, _, _ in docstrings),
        code_lines=code_lines,
        parallel=sum(_is_parallel(node) for node in nodes),
        products=sum(_is_product(node) for node in nodes),
        nested=sum(_is_nested(node) for node in nodes),
    )


def count_markdown(text: str) -> Counts:
    """Count the words of a page's paragraphs; code blocks and tables are left out."""
    paragraphs = [
        paragraph
        for paragraph in _CODE_BLOCK.sub("", text).split("\n\n")
        if paragraph.strip() and not paragraph.lstrip().startswith("|")
    ]
    return Counts(
        words=sum(len(paragraph.split()) for paragraph in paragraphs),
        whats=sum(len(_WHAT.findall(paragraph)) for paragraph in paragraphs),
    )


def count_files(paths: Iterable[Path]) -> Counts:
    """Count all .py and .md files of some paths; folders are searched."""
    total = Counts()
    for path in paths:
        files = [path] if path.is_file() else sorted([*path.rglob("*.py"), *path.rglob("*.md")])
        for file in files:
            text = file.read_text(encoding="utf-8")
            total += count_python(text) if file.suffix == ".py" else count_markdown(text)
    return total


def _docstrings(tree: ast.AST) -> Iterator[tuple[str, int, int]]:
    """Yield the text and the lines of each string that stands alone, attribute docstrings included."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                text = child.value.value
                if isinstance(text, str):
                    yield text.strip(), child.lineno, child.end_lineno or child.lineno


def _starts_relative(text: str) -> bool:
    first = _FIRST_WORD.match(text)
    return first is not None and first.group() in RELATIVE_LEADS


def _is_parallel(node: ast.AST) -> bool:
    if not isinstance(node, ast.Assign):
        return False
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def _is_product(node: ast.AST) -> bool:
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult)):
        return False
    conditions = ast.Compare | ast.BoolOp | ast.Attribute | ast.UnaryOp | ast.Call
    pairs = ((node.left, node.right), (node.right, node.left))
    return any(
        _is_literal(text) and isinstance(factor, conditions) and not _is_count(factor)
        for text, factor in pairs
    )


def _is_count(node: ast.AST) -> bool:
    """Return True for `len(…)` and `.ndim`: repeating a list so often is no hidden condition."""
    if isinstance(node, ast.Attribute):
        return node.attr == "ndim"
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len"


def _is_literal(node: ast.AST) -> bool:
    is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return is_text or isinstance(node, ast.List | ast.JoinedStr)


def _is_nested(node: ast.AST) -> bool:
    if not isinstance(node, ast.IfExp):
        return False
    return isinstance(node.orelse, ast.IfExp) or isinstance(node.body, ast.IfExp)


def main(arguments: Sequence[str]) -> None:
    """Print the measures of each path."""
    for name in arguments or ["progdf", "trainer", "viewer", "benchmarks", "tests", "README.md", "docs"]:
        measures = count_files([Path(name)]).measures
        print(f"{name:12}", "  ".join(f"{key} {value:5.2f}" for key, value in measures.items()))


if __name__ == "__main__":
    main(sys.argv[1:])
