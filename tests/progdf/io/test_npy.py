"""Files of numbers: what numpy wrote is read, anything else is refused in one line and costs nothing."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from progdf.io.tensors import open_npy
from tests.helpers.hostile import NPY_HEADERS, npy
from tests.helpers.refused import refusal


@pytest.mark.parametrize("header", NPY_HEADERS.values(), ids=NPY_HEADERS.keys())
def test_a_hostile_header_is_refused_and_allocates_nothing(header: bytes, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refusal(open_npy, npy(tmp_path / "a.npy", header))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_what_is_no_npy_at_all_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for content in (b"", b"\x93NUMPY", b"PK\x03\x04", b"\x93NUMPY\x07\x00" + b"\0" * 90):
        path.write_bytes(content)
        refusal(open_npy, path)
    assert "does not exist" in refusal(open_npy, tmp_path / "none.npy")


@pytest.mark.parametrize("dtype", ["<f4", ">i2", "u1", "?"])
def test_numbers_of_any_type_are_read(dtype: str, tmp_path: Path) -> None:
    numbers = np.array([[0, 1], [1, 0]]).astype(dtype)
    np.save(tmp_path / "a.npy", numbers)
    assert np.array_equal(open_npy(tmp_path / "a.npy"), numbers)
