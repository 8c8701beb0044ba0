"""Tests of the bundle's entry point as the interpreter of its own child processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

SHOW = "import sys; print(__name__, *sys.argv[1:])"


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        (["-P", "-c", SHOW, "a", "b"], "__main__ a b"),
        (["-P", "-m", "shown", "a"], "__main__ a"),
        (["-P", "shown.py", "a"], "__main__ a"),
    ],
)
def test_bundle_runs_python_as_its_children_need(words: list[str], printed: str, tmp_path: Path) -> None:
    (tmp_path / "shown.py").write_text(SHOW, encoding="utf-8")
    command = [sys.executable, str(ROOT / "release" / "program.py"), *words]
    environment = {"PYTHONPATH": str(tmp_path), "PATH": ""}
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == printed
