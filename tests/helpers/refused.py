"""How the tests ask for the one line in which a file is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from progdf.errors import ProgdfError


def refusal(load: Callable[[Path], object], path: Path) -> str:
    """What loading a broken file says: one line, with its name, and what would be right."""
    with pytest.raises(ProgdfError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message, message
    assert str(path) in message, message
    assert ";" in message, f"what would be right is missing: {message}"
    return message
