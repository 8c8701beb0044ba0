"""The window's tests remember nothing of each other."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def empty_state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the window remembers for its user begins empty."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "memory"))
