"""Fonts of the interface, and installed fonts for characters that they lack, such as Chinese file names."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from imgui_bundle import imgui
from PIL import ImageFont

from progdf.system.desktop import font_folders

from .splash import FONTS, REGULAR, TEXT_PX

FALLBACKS = (
    *("notosanscjk", "sourcehansans", "pingfang", "hiragino sans gb", "msyh", "yugoth", "meiryo", "malgun"),
    *("applesdgothicneo", "arial unicode", "droidsansfallback", "notosanssc", "notosansjp", "notosanskr"),
    *("wqy", "simsun", "msgothic", "nanumgothic", "unifont", "notosans", "dejavusans", "segoeui"),
)
"""Beginnings of the names of font files with many characters, the preferred first."""
_SUFFIXES = (".ttf", ".ttc", ".otf")
_NO_CHARACTER = "\uffff"


@dataclass(frozen=True)
class Fonts:
    """Regular font with icons, and bold font."""

    regular: imgui.ImFont
    bold: imgui.ImFont


def load_fonts(atlas: imgui.ImFontAtlas) -> Fonts:
    """Load the fonts of the interface into the atlas."""
    regular = atlas.add_font_from_file_ttf(str(REGULAR), TEXT_PX)
    merged = imgui.ImFontConfig()
    merged.merge_mode = True
    merged.glyph_min_advance_x = TEXT_PX
    atlas.add_font_from_file_ttf(str(FONTS / "Font_Awesome_6_Free-Solid-900.otf"), TEXT_PX - 2, merged)
    bold = atlas.add_font_from_file_ttf(str(FONTS / "Roboto" / "Roboto-Bold.ttf"), TEXT_PX)
    return Fonts(regular, bold)


class FallbackFonts:
    """Installed fonts that are merged into the fonts of the interface once a text needs them.

    Args:
        atlas: the atlas of the fonts
        fonts: the fonts of the interface
    """

    def __init__(self, atlas: imgui.ImFontAtlas, fonts: Fonts) -> None:
        self._atlas = atlas
        self._fonts = fonts
        self._known: set[str] = set()  # characters that were looked up
        self._loaded: set[Path] = set()

    def cover(self, text: str) -> str:
        """Load fonts for the characters of a text, between two frames.

        Returns:
            The characters that no installed font has, each reported once.
        """
        if text.isascii():
            return ""
        new = sorted({*text} - self._known)
        self._known.update(new)
        lacking = [c for c in new if c.isprintable() and not self._has(c)]
        missing = ""
        for character in lacking:
            if self._has(character):
                continue  # the font of an earlier character has it too
            path = next((path for path in fallback_files() if has_character(path, character)), None)
            if path is None:
                missing += character
            elif path not in self._loaded:
                self._load(path)
        return missing

    def _has(self, character: str) -> bool:
        return bool(self._fonts.regular.is_glyph_in_font(ord(character)))

    def _load(self, path: Path) -> None:
        self._loaded.add(path)
        for font in (self._fonts.regular, self._fonts.bold):
            merged = imgui.ImFontConfig()
            merged.merge_mode = True
            merged.dst_font = font
            self._atlas.add_font_from_file_ttf(str(path), TEXT_PX, merged)


def missing_message(characters: str) -> str:
    """Return the message about characters that no installed font has."""
    codes = ", ".join(f"U+{ord(c):04X}" for c in characters[:3])
    more = " …" if len(characters) > 3 else ""
    return f"No installed font has {codes}{more} of the names here. Install Noto Sans CJK and restart."


@cache
def fallback_files() -> tuple[Path, ...]:
    """Return the installed fonts of `FALLBACKS`, the preferred first."""
    found = sorted((_rank(path), path) for folder in font_folders() for path in _font_files(folder))
    return tuple(path for rank, path in found if rank[0] < len(FALLBACKS))


def _font_files(folder: Path) -> Iterator[Path]:
    for parent, _, names in os.walk(folder.expanduser()):
        yield from (Path(parent) / name for name in names if name.lower().endswith(_SUFFIXES))


def _rank(path: Path) -> tuple[int, bool, int]:
    """Return the order of a font: by name, regular weights first, then short names."""
    name = path.name.lower()
    order = next((i for i, start in enumerate(FALLBACKS) if name.startswith(start)), len(FALLBACKS))
    return order, "regular" not in name, len(name)


def has_character(path: Path, character: str) -> bool:
    """Return True if a font file has a glyph for the character; False for a file that cannot be read."""
    try:
        font = ImageFont.truetype(str(path), 16)
        glyph, unknown = (bytes(font.getmask(text)) for text in (character, _NO_CHARACTER))
    except OSError:
        return False
    return bool(glyph) and glyph != unknown
