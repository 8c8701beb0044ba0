"""Access to the one-line error of a refused file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from progdf.errors import ProgdfError


def refusal(load: Callable[[Path], object], path: Path) -> str:
    """Return the error of loading a broken file. It must be one line with the file's path and a remedy."""
    with pytest.raises(ProgdfError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message, message
    assert str(path) in message, message
    assert ";" in message, f"what would be right is missing: {message}"
    return message
