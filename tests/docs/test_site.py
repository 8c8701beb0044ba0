"""Tests of the site: its navigation, its links, and a strict build."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]


def load_script(name: str) -> ModuleType:
    """Import a script of docs/site/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_every_page_is_in_the_navigation() -> None:
    listed = re.findall(r": ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    docs = ROOT / "docs"
    pages = {path.relative_to(docs).as_posix() for path in docs.rglob("*.md")}
    generated = set(load_script("hooks").PAGES.values())
    assert set(listed) == {page for page in pages if not page.startswith("workflows/")} | generated
    assert len(listed) == len(set(listed))


@pytest.mark.parametrize(
    ("source", "folder", "target", "link"),
    [
        ("index.md", "", "docs/cli.md", "cli.md"),
        ("index.md", "", "assets/hero.webp", "assets/hero.webp"),
        ("viewer.md", "docs/", "../assets/tour/paint.png", "assets/tour/paint.png"),
        ("viewer.md", "docs/", "../README.md", "index.md"),
        ("lab/regret.md", "docs/lab", "../benchmarks.md", "../benchmarks.md"),
        ("lab/selection.md", "docs/lab", "../../assets/subject.png", "../assets/subject.png"),
    ],
)
def test_links_lead_to_pages_of_the_site(source: str, folder: str, target: str, link: str) -> None:
    assert load_script("hooks").site_link(source, folder, target) == link


def test_bars_in_the_code_of_a_table_show_without_their_escape() -> None:
    page = SimpleNamespace(file=SimpleNamespace(src_uri="cli.md"))
    row = r"| `--scene bear\|room` | a \| b |"
    written = load_script("hooks").on_page_markdown(f"{row}\n\n`a\\|b`\n", page, None, None)
    assert written == "| `--scene bear|room` | a \\| b |\n\n`a\\|b`\n"


def test_short_code_spans_stay_in_one_line() -> None:
    convert = load_script("hooks").on_page_content
    long = "--fill none|picture|smooth|surface"
    block = "<pre><span></span><code>a\n</code></pre>"
    html = f"<code>--fill</code> <code>{long}</code> {block}"
    shown = convert(html, None, None, None)
    assert shown.startswith('<code class="unbroken">--fill</code> ')
    assert shown.replace("<wbr>", "").endswith(f" <code>{long}</code> {block}")
    assert shown.count("|<wbr>") == long.count("|")


def test_gallery_lists_every_exhibit_with_its_picture_and_credit() -> None:
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    listed = re.findall(r"^## (.+)\n\n!\[.*\]\(\.\./assets/exhibits/(\w+)\.jpg\)", text, re.MULTILINE)
    exhibits = load_script("gallery").EXHIBITS
    assert listed == [(exhibit.title, exhibit.name) for exhibit in exhibits]
    for exhibit in exhibits:
        assert (ROOT / "assets" / "exhibits" / f"{exhibit.name}.jpg").stat().st_size <= 80_000
        assert f"*{exhibit.credit}.*" in " ".join(text.split())


@pytest.mark.slow
def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Every link, anchor and docstring resolves; each page of the gallery is at most 4 MB."""
    pytest.importorskip("mkdocs")
    subprocess.run([sys.executable, ROOT / "docs/site/gallery.py", ROOT / "build/gallery"], check=True)
    command = [sys.executable, "-P", "-m", "mkdocs", "build", "-q", "-d", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "site" / "index.html").is_file()
    exhibits = sorted((tmp_path / "site" / "gallery").glob("*.html"))
    assert len(exhibits) == len(load_script("gallery").EXHIBITS)
    assert max(page.stat().st_size for page in exhibits) <= 4e6
