"""Fonts for names in other scripts: loaded when a name needs them, with a message if there is none."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.helpers.ui_rig import Rig
from viewer.ui import fonts
from viewer.ui.splash import FONTS, REGULAR

pytestmark = pytest.mark.gl
MATH_FONT = FONTS / "latex" / "latinmodern-math.otf"


def open_session(hand: Rig, name: str) -> None:
    """Give the session a name and draw it."""
    hand.main_view.store.replace(replace(hand.main_view.work, session=name))
    hand.frame(2)


def test_characters_of_a_font_file_are_known() -> None:
    assert fonts.has_character(REGULAR, "é")
    assert not fonts.has_character(REGULAR, "像")
    assert not fonts.has_character(REGULAR.with_name("missing.ttf"), "é")


def test_font_is_loaded_once_a_name_needs_it(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fonts, "fallback_files", lambda: (REGULAR, MATH_FONT))
    regular = hand.main_view.ui.fonts.regular
    assert not regular.is_glyph_in_font(ord("∮"))
    open_session(hand, "field ∮ straße")
    assert regular.is_glyph_in_font(ord("∮"))
    assert hand.main_view.work.message is None


def test_character_without_a_font_is_reported_once(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fonts, "fallback_files", lambda: ())
    open_session(hand, "石像")
    assert hand.main_view.work.message is not None
    assert "U+50CF, U+77F3" in hand.main_view.work.message.text
    hand.main_view.store.replace(replace(hand.main_view.work, message=None))
    hand.frame()
    assert hand.main_view.work.message is None
