"""`progdf view` as it is, in a process of its own that says how it fares: one line of JSON at a time.

    python -m benchmarks.viewer.watched BEGAN WIDTHxHEIGHT leave|stay SCENE.ply [A.gdf …] …

`imports_s`, `first_s` and `memory_mb` once the first picture is on the screen, counted from BEGAN
(seconds of the epoch);
`frames`, `pictures` and `slider_ms` (of the last 120 slider events to finished pixels) when it is closed.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

from viewer.commands.view import main as view


def main(arguments: list[str]) -> int:
    """Open the window and stay as `progdf view` does; "leave" closes it after the first picture."""
    from viewer.app import app as application  # where `progdf view` imports it
    from viewer.ui import splash

    imported = time.time()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start deaf to it
    began, size, stays = float(arguments[0]), arguments[1].split("x"), arguments[2] == "stay"
    watched: list[application.App] = []
    slider_ms: deque[float] = deque(maxlen=120)

    class Watched(application.App):
        """Tells when its first picture is on the screen, and takes the time of sliders."""

        def draw(self) -> None:
            before = self.main_view.work.view.layers
            arrived = time.perf_counter()
            super().draw()
            layers = self.main_view.work.view.layers
            if [layer.strength for layer in layers] != [layer.strength for layer in before]:
                self.context.finish()
                slider_ms.append(1e3 * (time.perf_counter() - arrived))
            if not watched and self.main_view.canvas.pictures_drawn:
                self.context.finish()
                watched.append(self)
                _say(
                    imports_s=imported - began,
                    first_s=time.time() - began,
                    memory_mb=_most_mb(),
                    draws_with=self.engine.draws_with,
                    renderer=str(self.context.info["GL_RENDERER"]),
                )
                if not stays:
                    self.leave()

    real = application.App
    opened = splash.Splash
    application.App = Watched  # type: ignore[misc]
    splash.Splash = partial(opened, size=(int(size[0]), int(size[1])))  # type: ignore[assignment, misc]
    try:
        return view(arguments[3:])
    except KeyboardInterrupt:
        return 0
    finally:
        # type: ignore[misc]
        application.App = real
        splash.Splash = opened
        if watched and stays:
            shown = watched[0].main_view
            _say(
                frames=shown.frames,
                pictures=shown.canvas.pictures_drawn,
                slider_ms=list(slider_ms),
            )


def _most_mb() -> float:
    """The most memory that this process has held so far, MB of 1e6 bytes.

    Not `resource.getrusage`: its figure begins with what the parent held when it started this process.
    """
    status = Path("/proc/self/status").read_text("utf-8")
    (most,) = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(most) / 1e6


def _say(**figures: Any) -> None:
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
