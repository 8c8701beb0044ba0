"""Tests of portability to Windows and macOS, as far as Linux can show it."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from progdf.io.atomic import is_portable
from tests.helpers.paths import ROOT
from tests.test_structure import parse, source_files

BARE = ROOT / "tests" / "helpers" / "bare_system"


def run_bare(folder: Path, what: str) -> str:
    """Run `tests.helpers.bare_run` without the modules that Windows lacks, on a console without UTF-8."""
    environment = {
        **os.environ,
        "BARE_FOLDER": os.path.realpath(folder),
        "PYTHONPATH": os.pathsep.join((str(BARE), str(ROOT))),
        "PYTHONIOENCODING": "ascii",
        "USERNAME": "somebody",  # getpass reads it on Windows
    }
    finished = subprocess.run(
        [sys.executable, "-m", "tests.helpers.bare_run", what],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return (folder / "bare.txt").read_text("utf-8")


@pytest.mark.slow
def test_commands_need_no_module_that_windows_lacks(tmp_path: Path) -> None:
    assert run_bare(tmp_path, "commands").count("\n") == 1
    assert sorted(path.name for path in tmp_path.glob("*.p*")) == ["a.png", "b.png", "bear.ply", "edited.ply"]


@pytest.mark.slow
def test_window_trainings_start_stop_resume_and_die_as_on_windows(tmp_path: Path) -> None:
    children = run_bare(tmp_path, "jobs").splitlines()[1:]
    assert [line.endswith("--resume") for line in children] == [False, True, False]


@pytest.mark.parametrize(
    "name", ["CON", "nul.x", "Com1.png", "lpt².a.b", "aux ", "a.", "b ", "conout$", "a:b"]
)
def test_names_invalid_on_windows_are_not_portable(name: str) -> None:
    assert not is_portable(name)


@pytest.mark.parametrize("name", ["console", "nulls.x", "a.con", "view_001", "lpt", "é"])
def test_ordinary_names_are_portable(name: str) -> None:
    assert is_portable(name)


SYSTEM_NAMES = {"sys.platform", "os.name", "platform.system", "os.startfile", "os.killpg", "os.setpriority"}
"""Names whose use means that a module treats systems differently."""

WITHOUT_PACKAGE = Path("progdf/io/native_child.py")
"""Script that imports nothing of the package, so it has its own test of the system."""


def system_tests(source: str) -> set[str]:
    """Return the names of `SYSTEM_NAMES` that a source uses."""
    return {
        ast.unparse(node) for node in ast.walk(parse(source)) if isinstance(node, ast.Attribute)
    } & SYSTEM_NAMES


def test_only_one_package_asks_for_the_system() -> None:
    found = {
        path: names
        for path in source_files()
        if path.parts[:2] != ("progdf", "system")
        and path.parts[0] != "benchmarks"
        and path != WITHOUT_PACKAGE
        for names in [system_tests((ROOT / path).read_text(encoding="utf-8"))]
        if names
    }
    assert not found
    assert system_tests("import sys\nif sys.platform == 'win32': pass") == {"sys.platform"}


def text_without_encoding(tree: ast.AST) -> Iterator[int]:
    """Yield the lines of calls that open a text file without an encoding."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
        values = [*node.args, *(word.value for word in node.keywords if word.arg == "mode")]
        constants = [value.value for value in values if isinstance(value, ast.Constant)]
        modes = [mode for mode in constants if isinstance(mode, str) and mode and set(mode) <= set("rwaxbt+")]
        if name == "open":  # the function, or a path's method; not `Image.open(path)` or a window's own
            asks = isinstance(called, ast.Name) or bool(modes) or not (node.args or node.keywords)
        else:
            asks = name in ("fdopen", "read_text", "write_text")
        given = name in ("read_text", "write_text") and len(node.args) > (name == "write_text")
        named = any(word.arg == "encoding" for word in node.keywords)
        if asks and not (given or named or any("b" in mode for mode in modes)):
            yield node.lineno


def test_every_text_file_is_opened_with_an_encoding() -> None:
    found = [
        f"{path}:{line}"
        for path in source_files()
        for line in text_without_encoding(parse((ROOT / path).read_text(encoding="utf-8")))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "open(p)",
        "open(p, 'w')",
        "p.open()",
        "p.open('a')",
        "p.read_text()",
        "p.write_text(s)",
        "os.fdopen(h)",
    ],
)
def test_encoding_check_sees_each_way_to_open_a_text_file(line: str) -> None:
    assert list(text_without_encoding(ast.parse(line)))
