"""Ceilings on convoluted prose and dense code. They only fall."""

from __future__ import annotations

import subprocess

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.plain import Counts, count_files, count_markdown, count_python

# "what" per 1 000 words; docstrings with a relative lead, percent; then per 1 000 lines of code: parallel
# assignments, text times condition, nested conditional expressions.
CEILINGS = {
    "progdf": (1.0, 1.0, 1.5, 0.0, 0.0),
    "trainer": (1.0, 1.0, 0.5, 0.0, 0.0),
    "viewer": (1.0, 1.0, 1.4, 0.0, 0.0),
    "benchmarks": (1.0, 1.0, 1.1, 0.0, 0.0),
    "tests": (1.0, 1.0, 1.0, 0.1, 0.0),
    "README.md": (1.0, 0.0, 0.0, 0.0, 0.0),
    "docs": (1.0, 0.0, 0.0, 0.0, 0.0),
}
MAX_SUBJECT = 72  # characters
FIRST_CHECKED = "0cbb5285"  # older commits have longer subjects


@pytest.mark.parametrize("name", CEILINGS)
def test_prose_is_plain_and_code_is_not_packed(name: str) -> None:
    measures = count_files([ROOT / name]).measures
    over = {
        measure: f"{value:.2f} > {ceiling}"
        for (measure, value), ceiling in zip(measures.items(), CEILINGS[name], strict=True)
        if value > ceiling
    }
    assert not over, f"{name}: {over}; see docs/contributing.md and python -m tests.helpers.plain"


def test_measures_count_each_construct_once() -> None:
    source = '''"""What there is."""
a, b = 1, 2  # what
words = "x" * bool(a)
c = 1 if a else 2 if b else 3
'''
    assert count_python(source) == Counts(4, 2, 1, 1, 3, 1, 1, 1)
    page = "What is it?\n\n```\nwhat\n```\n\n| what | what |\n"
    assert count_markdown(page) == Counts(words=3, whats=1)


def test_commit_subjects_are_short() -> None:
    log = ["git", "log", "--no-merges", "--format=%s", f"{FIRST_CHECKED}..HEAD"]
    done = subprocess.run(log, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip("no git history")
    assert [subject for subject in done.stdout.splitlines() if len(subject) > MAX_SUBJECT] == []
