"""Tests of docs/tutorials: each page runs as it is printed, and shows pictures that its own steps make."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.helpers.paths import ROOT

TUTORIALS: dict[str, Any] = runpy.run_path(str(ROOT / "assets" / "tutorials.py"))
NAMES = TUTORIALS["names"]()


@pytest.mark.parametrize("name", NAMES)
def test_tutorial_pictures_exist_and_are_small(name: str) -> None:
    shown = TUTORIALS["pictures"](name)
    folder: Path = TUTORIALS["PICTURES"] / name
    assert sorted(path.stem for path in folder.iterdir()) == sorted(shown)
    assert max(path.stat().st_size for path in folder.iterdir()) <= TUTORIALS["MAX_BYTES"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_tutorial_runs_as_printed(name: str, tmp_path: Path) -> None:
    """Train with a few small views. The pictures come out, at the sizes of those that the page shows."""
    made = TUTORIALS["run_page"](name, tmp_path, draft=True)
    assert set(made) == set(TUTORIALS["pictures"](name))
    for stem, file in made.items():
        with Image.open(file) as new, Image.open(TUTORIALS["PICTURES"] / name / f"{stem}.jpg") as shown:
            assert new.size == shown.size
