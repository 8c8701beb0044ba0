"""Packages of other projects: remedies for missing ones, and the package at fault for a failed import."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from progdf.__main__ import run_guarded
from progdf.errors import without_commands
from progdf.system.packages import broken_package, import_fault, install_extra, pip_install
from tests.helpers.paths import ROOT


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a folder whose modules can be imported during the test."""
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def failure(module: str) -> Exception:
    """Return the error of importing a module."""
    with pytest.raises(Exception) as caught:  # noqa: PT011
        importlib.import_module(module)
    return caught.value


def test_extra_is_installed_with_pip() -> None:
    assert install_extra("styles") == "pip install 'progdf-studio[styles]'"
    assert pip_install("lpips") == "pip install lpips"


@pytest.mark.parametrize("remedy", [lambda: install_extra("styles"), lambda: pip_install("lpips")])
def test_bundle_advises_the_python_package_in_terminal_and_window(
    remedy: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    line = f"style:14 needs a package; {remedy()}"  # type: ignore[operator]
    assert "pip install" not in line
    assert "the desktop bundle does not hold it" in line
    assert "pipx install" in line
    assert without_commands(line) == line


def test_no_message_names_pip_by_itself() -> None:
    """Only `progdf.system.packages` knows that a bundle has no pip; `progdf.errors` removes the command."""
    found = {
        path.relative_to(ROOT).as_posix()
        for package in ("progdf", "trainer", "viewer")
        for path in (ROOT / package).rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if "pip install" in line and "`pip install" not in line  # in a docstring
    }
    assert found == {"progdf/system/packages.py", "progdf/errors.py"}


@pytest.mark.parametrize(
    "code",
    [
        "raise ImportError('libfoo.so.1: cannot open shared object file')",
        "raise OSError('libfoo.so.1 is broken')",
        "def load():\n    raise RuntimeError('built for another processor')\nload()",
        "import a_module_that_is_not_there",
    ],
)
def test_package_that_fails_to_import_is_named(
    modules: Path, code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (modules / "broken_one.py").write_text(code)
    (modules / "outer_one.py").write_text("import broken_one")
    assert broken_package(failure("outer_one")) == "broken_one"

    def run(_: object) -> int:
        importlib.import_module("outer_one")
        return 0

    assert run_guarded(run, []) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("progdf: the package broken_one cannot be imported (")
    assert line.endswith("; install progdf-studio with pip again")


def test_missing_package_is_named() -> None:
    assert broken_package(failure("a_module_that_is_not_there.part")) == "a_module_that_is_not_there"


def test_error_after_the_import_blames_no_package(modules: Path) -> None:
    (modules / "fine_one.py").write_text("def fail():\n    raise RuntimeError('later')\n")
    module = importlib.import_module("fine_one")
    with pytest.raises(RuntimeError) as caught:
        module.fail()
    assert broken_package(caught.value) == ""
    assert broken_package(failure("progdf.a_module_that_is_not_there")) == ""


def test_reason_is_one_short_line() -> None:
    assert import_fault(ImportError("a\n  b")) == "ImportError: a b"
    assert import_fault(ValueError()) == "ValueError"
    assert len(import_fault(ValueError("x" * 1000))) == 300
