"""Command `progdf view`: opens a window at once and shows a splash during slow imports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from tyro.conf import OmitArgPrefixes

from progdf.errors import ProgdfError

from .stack_options import NO_SCENE, DrawingOptions, StackOptions, parse

STARTING = "Starting …"


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Open the window with the scene and one slider per edit. Without a scene it shows a start page."""

    stack: OmitArgPrefixes[StackOptions] = StackOptions(scene=NO_SCENE)
    drawing: OmitArgPrefixes[DrawingOptions] = DrawingOptions()


def main(argv: Sequence[str]) -> int:
    """Run `progdf view`: open the window and stay until it is closed."""
    options: ViewOptions = parse(ViewOptions, argv, "progdf view")

    def opens() -> Any:
        from .open_stack import open_view

        return open_view(options.stack, options.drawing)

    def load() -> Callable[..., int]:
        from viewer.app.app import run

        return run

    if not all(path.exists() for path in (options.stack.scene, *options.stack.gdfs)):
        opens()  # report errors before the window opens
    from viewer.ui.splash import Splash  # glfw, which the other commands do not need

    try:
        splash = Splash()
    except ProgdfError:
        opens()
        raise
    try:
        splash.draw(STARTING, 0.0)
        with ThreadPoolExecutor(1) as worker:
            run = splash.wait(worker.submit(load), STARTING)
        return run(splash, opens, options.drawing.engine)
    finally:
        splash.close()
