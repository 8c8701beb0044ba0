"""Counting of calls."""

from __future__ import annotations

import pytest


class Count:
    """Replacement for a function that counts its calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, target: object, name: str) -> None:
        self.calls = 0
        original = getattr(target, name)

        def counted(*args: object, **kwargs: object) -> object:
            self.calls += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(target, name, counted)
