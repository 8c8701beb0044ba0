"""Run the tutorials of docs/tutorials as they are printed, and renew their pictures.

usage: python assets/tutorials.py [NAME …]

A page is a script. Its shell blocks are commands, its Python blocks share their names, and a block with a
title, such as ```toml title="catalogue.toml", is a file. All run in order, in a new folder that holds
the files of assets/scenes. The picture PICTURE.jpg of a page is made of PICTURE.png, which a step writes.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageOps

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from progdf.__main__ import main as progdf  # noqa: E402
from tests.helpers.image_server import Call, image_server  # noqa: E402

PAGES = ROOT / "docs" / "tutorials"
PICTURES = ROOT / "assets" / "tutorials"
SCENES = ROOT / "assets" / "scenes"
EXHIBITS = ROOT / "assets" / "exhibits"
EDITS = {
    "catalogue": ("runs/robot/blue/blue.gdf", "runs/robot/green/green.gdf", "runs/robot/red/red.gdf"),
    "logo": ("runs/letters/letters.gdf", "runs/logo/logo.gdf"),
    "pose": ("tilt.gdf", "wave.gdf"),
}
"""Edits that a page makes for docs/gallery.md."""
MAX_BYTES = 80_000
BLOCK = re.compile(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```', re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"\]\(\.\./\.\./assets/tutorials/([\w-]+)/([\w-]+)\.jpg\)")
DRAFT = {"--views": "5", "--image-size": "64", "--steps": "24", "--stages": "2", "--report": "none"}
"""Options of `progdf train` that make a run cheap, for tests."""

DRAFT_API = {"--edit-size": "64"}
DRAFT_FILM = "54x96"


class TutorialError(Exception):
    """A step of a page that failed, or a picture that no step has made."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str  # "" or "bash" for commands
    title: str  # name of the file that it is; "" if it runs
    text: str


def names() -> list[str]:
    """Return the names of all tutorials."""
    return sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index")


def blocks(name: str) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    return [Block(*match.groups("")) for match in BLOCK.finditer(text)]


def pictures(name: str) -> list[str]:
    """Return the names of a page's own pictures, without their ending."""
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    return [stem for page, stem in PICTURE.findall(text) if page == name]


def run_page(name: str, folder: Path, draft: bool) -> dict[str, Path]:
    """Run a page in a folder. Return the file of each of its pictures.

    Args:
        draft: train with a few small views

    Raises:
        TutorialError: a step failed, or a picture is missing.
    """
    for file in SCENES.iterdir():
        shutil.copy(file, folder)
    variables: dict[str, object] = {"__name__": "tutorial"}
    with contextlib.chdir(folder):
        for block in blocks(name):
            if block.title:
                text = block.text
                if draft and block.language == "toml":  # a catalogue
                    options = "".join(f"{key[2:]} = {_toml(value)}\n" for key, value in DRAFT.items())
                    text = f"[defaults]\n{options}\n{text}"
                Path(block.title).write_text(text, encoding="utf-8")
            elif block.language == "python":
                exec(compile(block.text, f"{name}.md", "exec"), variables)
            elif block.language in ("", "bash"):
                for line in block.text.replace("\\\n", " ").splitlines():
                    run_line(shlex.split(line), draft)
    found = {stem: folder / f"{stem}.png" for stem in pictures(name)}
    missing = [file.name for file in found.values() if not file.exists()]
    if missing:
        raise TutorialError(f"no step of {name}.md writes {missing[0]}")
    return found


def _toml(value: str) -> str:
    return value if value.isdigit() else f'"{value}"'


def run_line(words: list[str], draft: bool) -> None:
    """Run one command line; `progdf view` is left out, because it waits for its user.

    Raises:
        TutorialError: it is no command of progdf, or it failed.
    """
    if not words or words[:2] == ["progdf", "view"]:
        return
    if words[0] != "progdf":
        raise TutorialError(f"not a command of progdf: {shlex.join(words)}")
    if words[1] == "render":
        words = with_options(words, {"--engine": "cpu"})  # the same pictures everywhere
    if words[1] == "batch":
        words = with_options(words, {"--workers": "1"})  # in this process, where kernels are compiled
    if draft and words[1] == "train":
        words = with_options(words, DRAFT | (DRAFT_API if "--api-url" in words else {}))
    if draft and Path(words[-1]).suffix == ".mp4":
        words = with_options(words, {"--size": DRAFT_FILM})
    start = sum(os.times()[:4])
    with _with_server(words) as served:
        status = progdf(served[1:])
    if status:
        raise TutorialError(f"status {status}: {shlex.join(words)}")
    print(f"{sum(os.times()[:4]) - start:.0f} s of processor: {shlex.join(words)}", flush=True)


def with_options(words: list[str], options: dict[str, str]) -> list[str]:
    """Return a command line with these options, in place of its own values."""
    changed = list(words)
    for option, value in options.items():
        if option in changed:
            changed[changed.index(option) + 1] = value
        else:
            changed[2:2] = [option, value]
    return changed


@contextlib.contextmanager
def _with_server(words: list[str]) -> Iterator[list[str]]:
    """Yield the words with a running stand-in for the printed server."""
    if "--api-url" not in words:
        yield words
        return
    with image_server(lambda call, i: paint_gold(call)) as server:
        yield with_options(words, {"--api-url": server.url})


def paint_gold(call: Call) -> Image.Image:
    """Return the picture of a call in gold: the stand-in for a model that follows a prompt."""
    gray = ImageOps.grayscale(call.pictures[0])
    return ImageOps.colorize(gray, "#1c0d02", "#fff6d0", "#c8901c", midpoint=112)


def save(picture: Image.Image, out: Path) -> None:
    """Write a .jpg at the best quality that fits into `MAX_BYTES`."""
    for quality in range(90, 40, -4):
        picture.save(out, quality=quality, optimize=True)
        if out.stat().st_size <= MAX_BYTES:
            return
    raise TutorialError(f"{out.name} is larger than {MAX_BYTES} bytes at any quality; draw it smaller")


def renew(name: str) -> None:
    """Run a page in full. Replace its pictures, and its edits in the gallery."""
    with tempfile.TemporaryDirectory() as folder:
        made = run_page(name, Path(folder), draft=False)
        for edit in EDITS.get(name, ()):
            shutil.copy(Path(folder, edit), EXHIBITS)
        shutil.rmtree(PICTURES / name, ignore_errors=True)
        (PICTURES / name).mkdir(parents=True)
        for stem, file in made.items():
            with Image.open(file) as picture:
                save(picture.convert("RGB"), PICTURES / name / f"{stem}.jpg")


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for page in sys.argv[1:] or names():
        renew(page)
