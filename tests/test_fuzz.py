"""Fuzz test of every reader. A longer round: `python -m tests.helpers.fuzz READER COUNT SEED FOLDER`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.fuzz import READ_AT_ONCE, READERS
from tests.helpers.fuzz_folders import COSTLY, FILES_OF_RUNS
from tests.helpers.paths import ROOT

GROUPS = {
    **{f"files {i + 1}": READ_AT_ONCE[i::3] for i in range(3)},
    "converted": ("spz", "spz in glb"),
    "colmap": ("colmap",),
    "kernels": ("kernels",),
    "resume": tuple(name for name in FILES_OF_RUNS if name.startswith("resume")),
    "fit": tuple(name for name in FILES_OF_RUNS if name.startswith("fit")),
}
"""Readers that share a process, as its start takes longer than most readers."""


def test_every_reader_is_in_one_group() -> None:
    assert sorted(name for group in GROUPS.values() for name in group) == sorted(READERS)


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_fuzzed_file_is_read_or_refused_in_one_line(group: str, tmp_path: Path) -> None:
    count = "20" if GROUPS[group][0] in COSTLY else "200"
    words = [sys.executable, "-m", "tests.helpers.fuzz", ",".join(GROUPS[group]), count, "1", str(tmp_path)]
    ran = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    assert ran.stdout == ""
    assert ran.returncode == 0, ran.stderr
