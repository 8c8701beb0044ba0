"""Hooks of the site: pages that lie outside docs/, and links that lead there."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "assets/scenes/CREDITS.md": "scenes.md",
    "trainer/evaluate/suite/captures/CREDITS.md": "captures.md",
}
"""Page of the repository → its name in the site."""

GALLERY = ROOT / "build" / "gallery"
"""Exported pages, made by `docs/site/gallery.py`."""

UNBROKEN = 24  # characters of a code span that stays in one line

STYLE = "assets/site.css"
"""Name of `site.css` in the site."""

_CODE_SPAN = re.compile(r"(?<!<span></span>)<code>([^<\n]+)</code>")
_TABLE_ROW = re.compile(r"^\|.*\|$", re.MULTILINE)
_CODE_LINK = re.compile(r"\[([^\]\[]*)\]\([^)]+\.(?:py|ipynb)\)|\[([^\]\[]*)\]\(LICENSE\)")
_COMMANDS = re.compile(r"^```\n(?=(?:progdf|make|python3?|pip|\.venv/bin/\w+) )", re.MULTILINE)
_EXHIBIT = re.compile(r"!\[[^\]]*\]\(\.\./assets/exhibits/([\w-]+)\.jpg\)")
_LINK = re.compile(r"(\]\(|src=\"|href=\")([^)\"#\s]+)")


def on_files(files: Any, config: Any) -> Any:
    """Add pages of the repository, pictures and scenes of assets/, the gallery and the style sheet."""
    from mkdocs.structure.files import File  # of the extra `docs`

    for source, name in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text))
    assets = ROOT / "assets"
    pictures = {path for path in assets.rglob("*") if path.suffix in (".png", ".jpg", ".webp", ".svg")}
    scenes = {path for path in (assets / "scenes").iterdir() if path.suffix != ".md"}
    for path in sorted(pictures | scenes):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    files.append(File.generated(config, STYLE, abs_src_path=str(ROOT / "docs" / "site" / "site.css")))
    for made in sorted(GALLERY.glob("*.html")):
        files.append(File.generated(config, f"gallery/{made.name}", abs_src_path=str(made)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead links of the repository to pages of the site, unlink those to code, and link exhibits.

    Blocks of commands get the class `commands`, which wraps them. A `|` in the code of a table loses its
    escape, which the site would show.
    """
    source = page.file.src_uri
    if source == "gallery.md":
        opener = "[Open the live sliders](gallery/\\1.html){ .md-button }"
        markdown = _EXHIBIT.sub(rf"[\g<0>](gallery/\1.html)\n\n{opener}", markdown)
    written = {name: path for path, name in PAGES.items()}.get(source, f"docs/{source}")
    folder = written.rpartition("/")[0]
    markdown = _COMMANDS.sub("``` { .text .commands }\n", markdown)
    markdown = _TABLE_ROW.sub(lambda row: re.sub(r"`[^`]+`", _without_escapes, row.group(0)), markdown)

    def convert(match: re.Match[str]) -> str:
        before, target = match.groups()
        if re.match(r"[a-z]+:", target):
            return match.group(0)
        return before + site_link(source, folder, target)

    linked = _CODE_LINK.sub(lambda match: match.group(1) or match.group(2), markdown)
    return _LINK.sub(convert, linked)


def _without_escapes(code: re.Match[str]) -> str:
    return code.group(0).replace("\\|", "|")


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Keep short code spans such as `--fill` in one line, and let long ones break after each `|`."""

    def convert(match: re.Match[str]) -> str:
        text = match.group(1)
        if len(text) <= UNBROKEN:
            return f'<code class="unbroken">{text}</code>'
        return f"<code>{text.replace('|', '|<wbr>')}</code>"

    return _CODE_SPAN.sub(convert, html)


def site_link(source: str, folder: str, target: str) -> str:
    """Return a relative link inside the site.

    Args:
        source: page of the site that holds the link
        folder: folder of the repository from which the link is written, "" for its root
        target: the link as written, without its anchor
    """
    parts = [part for part in folder.split("/") if part]
    for part in target.split("/"):
        if part == "..":
            del parts[-1:]
        else:
            parts.append(part)
    path = "/".join(parts)
    path = PAGES.get(path, path.removeprefix("docs/"))
    return posixpath.relpath(path, posixpath.dirname(source) or ".")
