"""Take the README's picture of a page with sliders: in a browser, at desktop and phone size.

usage: python assets/page.py DEMO_FOLDER OUT.jpg
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1]))
from progdf.__main__ import main as progdf

EDITS = ("scarf", "gold", "frost")
STRENGTHS = ({"scarf": 0.9, "gold": 0.7, "frost": 0.0}, {"scarf": 0.3, "gold": 0.1, "frost": 0.8})
SCREENS = ((1024, 720, False), (390, 720, True))
MOVE = "(it, to) => { it.value = to; it.dispatchEvent(new Event('input', { bubbles: true })) }"
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main(demo: Path, out: Path) -> None:
    """Export a page, open it twice, move its sliders through input events, and join both pictures."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        page = Path(folder) / "page.html"
        edits = [str(demo / name / f"{name}.gdf") for name in EDITS]
        command = ["export", str(demo / "scene.ply"), *edits, "-o", str(page), "--title", "The bear"]
        if progdf([*command, "--background", "#82a3c2"]):
            sys.exit("the page could not be written")
        browser = started.chromium.launch(executable_path=chromium, args=SOFTWARE)
        pictures = [
            take(browser, page, strengths, Path(folder) / f"{screen[0]}.png", *screen)
            for strengths, screen in zip(STRENGTHS, SCREENS, strict=True)
        ]
        browser.close()
    whole = Image.new("RGB", (sum(picture.width for picture in pictures) + 16, SCREENS[0][1]), "white")
    for left, picture in zip((0, pictures[0].width + 16), pictures, strict=True):
        whole.paste(picture, (left, 0))
    whole.save(out, quality=88)


def take(
    browser: Any, page: Path, strengths: dict[str, float], to: Path, width: int, height: int, touch: bool
) -> Image.Image:
    """Take a screenshot with the sliders set; the browser prefers dark at phone size."""
    tab = browser.new_page(
        viewport={"width": width, "height": height},
        has_touch=touch,
        color_scheme="dark" if touch else "light",
    )
    tab.goto(page.as_uri())
    tab.wait_for_timeout(6000)
    for name, value in strengths.items():
        tab.get_by_role("slider", name=name).first.evaluate(MOVE, value)
    tab.wait_for_timeout(3000)
    tab.screenshot(path=to)
    tab.close()
    return Image.open(to).convert("RGB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
