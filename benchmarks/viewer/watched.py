"""Unmodified `progdf view` in a separate process that reports measurements as lines of JSON.

    python -m benchmarks.viewer.watched BEGAN WIDTHxHEIGHT leave|stay SCENE.ply [A.gdf …] …

After the first picture is on the screen it reports `imports_s`, `first_s` and `memory_mb`, counted from BEGAN
(seconds since the epoch). When it is closed it reports `frames`, `pictures` and `slider_ms` (the last 120
slider events, to finished pixels).
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
    """Open the window like `progdf view`; "leave" closes it after the first picture."""
    from viewer.app import app as application  # where `progdf view` imports it
    from viewer.ui import splash

    imported = time.time()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore SIGINT
    began, size, stays = float(arguments[0]), arguments[1].split("x"), arguments[2] == "stay"
    watched: list[application.App] = []
    slider_ms: deque[float] = deque(maxlen=120)

    class Watched(application.App):
        """An app that reports its first picture and measures slider events."""

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
                _report(
                    imports_s=imported - began,
                    first_s=time.time() - began,
                    memory_mb=_peak_mb(),
                    draws_with=self.engine.draws_with,
                    renderer=str(self.context.info["GL_RENDERER"]),
                )
                if not stays:
                    self.leave()

    real_app = application.App
    real_splash = splash.Splash
    application.App = Watched  # type: ignore[misc]
    splash.Splash = partial(real_splash, size=(int(size[0]), int(size[1])))  # type: ignore[assignment, misc]
    try:
        return view(arguments[3:])
    except KeyboardInterrupt:
        return 0
    finally:
        application.App = real_app  # type: ignore[misc]
        splash.Splash = real_splash  # type: ignore[misc]
        if watched and stays:
            main_view = watched[0].main_view
            _report(
                frames=main_view.frames,
                pictures=main_view.canvas.pictures_drawn,
                slider_ms=list(slider_ms),
            )


def _peak_mb() -> float:
    """Return the peak memory of this process, MB of 1e6 bytes.

    It does not use `resource.getrusage`, whose figure starts at the parent's memory when this process was
    started.
    """
    status = Path("/proc/self/status").read_text("utf-8")
    (peak,) = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(peak) / 1e6


def _report(**figures: Any) -> None:
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
