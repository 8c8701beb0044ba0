"""Command lines and Python blocks of the documents, with their section."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.paths import ROOT

DOCUMENTS = (
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "docs" / "lab" / "experiments.md",
)
PROGRAMS = ("progdf", "python", "make")
SHELL_LANGUAGES = ("", "bash", "sh", "console")


@dataclass(frozen=True)
class Example:
    """A command line or a block of code in a document."""

    document: str  # relative to the repository
    heading: str  # heading of the section; empty before the first heading
    text: str  # without prompt, path of the environment and comment

    @property
    def words(self) -> list[str]:
        """Words as a shell splits them."""
        return shlex.split(self.text)

    @property
    def title(self) -> str:
        """Name of the example in a list of tests."""
        return f"{Path(self.document).name}, {self.heading}: {self.text}"


def blocks(text: str, language: str = "") -> list[str]:
    """Return the fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def command_examples() -> list[Example]:
    """Return every documented command line once, in the order of the documents."""
    found: dict[str, Example] = {}
    for path in DOCUMENTS:
        name = path.relative_to(ROOT).as_posix()
        for heading, text in _sections(path.read_text(encoding="utf-8")):
            for line in (*_fenced_lines(text), *_inline_lines(text)):
                found.setdefault(line, Example(name, heading, line))
    return list(found.values())


def python_examples() -> list[Example]:
    """Return every Python block of the documents."""
    return [
        Example(path.relative_to(ROOT).as_posix(), heading, code)
        for path in DOCUMENTS
        for heading, text in _sections(path.read_text(encoding="utf-8"))
        for code in blocks(text, "python")
    ]


def _sections(text: str) -> Iterator[tuple[str, str]]:
    """Yield each heading with the text below it, the text before the first heading included."""
    heading = ""
    lines: list[str] = []
    is_code = False
    for line in text.splitlines():
        if line.startswith("```"):
            is_code = not is_code
        if not is_code and re.match(r"#+ ", line):
            yield heading, "\n".join(lines) + "\n"
            heading = line.lstrip("#").strip()
            lines = []
        else:
            lines.append(line)
    yield heading, "\n".join(lines) + "\n"


def _fenced_lines(text: str) -> Iterator[str]:
    for language in SHELL_LANGUAGES:
        for block in blocks(text, language):
            for line in block.replace("\\\n", " ").splitlines():
                command = _bare_command(line)
                if command:
                    yield command


def _inline_lines(text: str) -> Iterator[str]:
    """Yield complete command lines between backticks. The name of a command alone is no example."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    for span in re.findall(r"`([^`]+)`", prose):
        command = _bare_command(" ".join(span.split()))
        if command and _is_complete(command.split()):
            yield command


def _bare_command(line: str) -> str:
    """Return the line without its comment, prompt and environment; empty if it starts no program of ours."""
    line = re.sub(r"(^|\s)#(\s.*)?$", "", line).strip()
    line = line.removeprefix("$ ").removeprefix(".venv/bin/")
    if line.partition(" ")[0] not in PROGRAMS or line.startswith("python -m venv"):
        return ""
    return line


def _is_complete(words: list[str]) -> bool:
    """Return True for a command line, False for the name of a command or of one of its options."""
    if words[:2] == ["progdf", "--version"]:
        return True
    names = {"progdf": 2, "python": 4, "make": 1}[words[0]]
    arguments = words[names:]
    is_shortened = any("…" in word for word in words)
    return bool(arguments) and not is_shortened and not arguments[0].startswith("-")
