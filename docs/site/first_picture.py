"""Measure the time to the first picture of exported pages, in Chromium with software GL.

usage: python docs/site/first_picture.py FOLDER [--runs 5]

Prints a row per page, in seconds from the start of the navigation: the still, the first live picture, which
has few pixels, and the sharp picture; and the processor time of all processes of the browser until the first
live picture, which other programs do not change much. Each is the least of several runs.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE: Any = {"width": 1280, "height": 800}
POLL_MS = 50
LIMIT_MS = 300_000
ENTRIES = """[...performance.getEntriesByType("paint"), ...performance.getEntriesByType("mark")]
    .map((entry) => [entry.name, entry.startTime / 1000])"""
STILL = "first-contentful-paint"
FIRST = "first picture"
SHARP = "sharp picture"
PROCESSOR = "processor"


def measure(browser: Browser, page: Path) -> dict[str, float]:
    """Open a page in a new tab. Return the seconds of `STILL`, `FIRST`, `SHARP` and `PROCESSOR`."""
    context = browser.new_context(viewport=SIZE)
    tab = context.new_page()
    processes = browser.new_browser_cdp_session()
    before = _processor_seconds(processes)
    tab.goto(page.resolve().as_uri(), wait_until="commit")
    found: dict[str, float] = {}
    for _ in range(LIMIT_MS // POLL_MS):
        found |= dict(tab.evaluate(ENTRIES))
        if FIRST in found and PROCESSOR not in found:
            found[PROCESSOR] = _processor_seconds(processes) - before
        if SHARP in found:
            break
        tab.wait_for_timeout(POLL_MS)
    context.close()
    return found


def _processor_seconds(processes: Any) -> float:
    return sum(each["cpuTime"] for each in processes.send("SystemInfo.getProcessInfo")["processInfo"])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    heads = ["page", "MB", "still, s", "first, s", "sharp, s", "processor time until the first, s"]
    print(f"| {' | '.join(heads)} |\n{'| --- ' * len(heads)}|")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=SOFTWARE)
        for page in sorted(options.folder.glob("*.html")):
            runs = [measure(browser, page) for _ in range(options.runs)]
            least = [min(run[name] for run in runs) for name in (STILL, FIRST, SHARP, PROCESSOR)]
            cells = [page.stem, f"{page.stat().st_size / 1e6:.1f}", *(f"{seconds:.1f}" for seconds in least)]
            print(f"| {' | '.join(cells)} |", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
