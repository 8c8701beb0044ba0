"""Fixtures of the trainer's tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.blank_plots import blank_plots
from tests.helpers.trained import write_bear


@pytest.fixture(scope="session", autouse=True)
def plots() -> Iterator[None]:
    """Replace the curves of reports by blank images; the tests of the report draw them."""
    with blank_plots():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a small bear to a folder; return the folder."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder)
    return folder
