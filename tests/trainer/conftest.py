"""Fixtures of the trainer's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.helpers.blank_plots import blank_plots


@pytest.fixture(scope="session", autouse=True)
def plots() -> Iterator[None]:
    """Runs draw no curves; the tests of the report draw them."""
    with blank_plots():
        yield
