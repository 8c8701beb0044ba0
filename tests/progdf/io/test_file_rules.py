"""Tests of the rules for files of other programs."""

from __future__ import annotations

import pytest

from progdf.errors import ProgdfError
from progdf.io.file_rules import check_fields, damage_error, unsupported_error


def test_harmless_fields_are_returned_in_file_order() -> None:
    ignored = check_fields("a.ply", ["x", "note", "y", "author"], {"x", "y"}, {}, "export it again")
    assert ignored == ("note", "author")


def test_refused_field_is_named_with_its_meaning_and_a_remedy() -> None:
    with pytest.raises(ProgdfError, match=r"a\.json uses 'k4' \(lens distortion\).*; undistort first"):
        check_fields("a.json", ["w", "k4"], {"w"}, {"k4": "lens distortion"}, "undistort first")


def test_errors_name_the_file_and_the_remedy() -> None:
    assert str(unsupported_error("b.sog", "version 9", "export version 2")) == (
        "b.sog uses version 9, which is not supported; export version 2"
    )
    assert str(damage_error("c.ply", "row 2 is cut off")) == (
        "c.ply is damaged: row 2 is cut off; copy or export it again"
    )
