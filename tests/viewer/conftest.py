"""Fixtures of the viewer's tests: an empty state folder, a rig with the bear, and the bear's files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.sessions import bear_files, saved_session
from tests.helpers.ui_rig import Rig, rig


@pytest.fixture(autouse=True)
def empty_state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start every test with an empty state folder."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "memory"))


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig() as opened:
        yield opened


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return bear_files(tmp_path)


@pytest.fixture
def saved(folder: Path) -> Path:
    return saved_session(folder)
