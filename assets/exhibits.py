"""Take the pictures of docs/gallery.md: a screenshot of each exported page.

usage: python assets/exhibits.py FOLDER      (the folder that docs/site/gallery.py has written)
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from page import SOFTWARE, take
from playwright.sync_api import sync_playwright
from tutorials import save

OUT = Path(__file__).parent / "exhibits"
SIZE = (800, 520)


def main(folder: Path) -> None:
    """Open each page in a browser, and write its picture."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=SOFTWARE)
        for page in sorted(folder.glob("*.html")):
            shot = take(browser, page.resolve(), {}, folder / f"{page.stem}.png", *SIZE, touch=False)
            save(shot, OUT / f"{page.stem}.jpg")
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
