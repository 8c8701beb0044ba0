"""Fuzz test of every reader. A longer round: `python -m tests.helpers.fuzz READER COUNT SEED FOLDER`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.fuzz import READERS
from tests.helpers.fuzz_folders import COSTLY
from tests.helpers.paths import ROOT


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_fuzzed_file_is_read_or_refused_in_one_line(reader: str, tmp_path: Path) -> None:
    words = [
        sys.executable,
        "-m",
        "tests.helpers.fuzz",
        reader,
        "20" if reader in COSTLY else "200",
        "1",
        str(tmp_path),
    ]
    ran = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    assert ran.stdout == ""
    assert ran.returncode == 0, ran.stderr
