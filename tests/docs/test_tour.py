"""Tests of the scripts in assets/, and of assets/tour.py, which takes the pictures of the window."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.helpers.paths import ROOT
from tests.helpers.ui_rig import bear

TOUR: dict[str, Any] = runpy.run_path(str(ROOT / "assets" / "tour.py"))
SHOTS = [pytest.param(shot, marks=() if shot == "select" else pytest.mark.slow) for shot in TOUR["SHOTS"]]


@pytest.mark.parametrize("script", sorted((ROOT / "assets").glob("*.py")), ids=lambda script: script.stem)
def test_script_imports_names_that_exist(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripts are outside the packages that mypy checks."""
    monkeypatch.syspath_prepend(script.parent)
    if "playwright" in script.read_text(encoding="utf-8"):
        pytest.importorskip("playwright")
    runpy.run_path(str(script))


def test_every_picture_of_the_tour_has_a_shot() -> None:
    assert {path.stem for path in (ROOT / "assets" / "tour").iterdir()} == set(TOUR["SHOTS"])


@pytest.mark.gl
@pytest.mark.parametrize("shot", SHOTS)
def test_tour_takes_its_pictures(shot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = bear().save(tmp_path)
    out = tmp_path / "shot.png"
    monkeypatch.setattr("sys.argv", ["tour.py", shot, *map(str, files), "-o", str(out)])
    TOUR["main"]()
    with Image.open(out) as picture:
        assert picture.size == TOUR["SIZE"]
        assert len(picture.getcolors() or []) > TOUR["PANEL_COLORS"]
