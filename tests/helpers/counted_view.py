"""`progdf view` as it is, which counts the turns of its loop: python counted_view.py TURNS ARGUMENTS…

A turn handles the events that are there and draws at most one frame; a window at rest takes none.
"""

from __future__ import annotations

import os
import sys

from progdf.__main__ import main
from viewer.app.app import App


def count_turns(path: str) -> None:
    """Keep in the file how often the window's loop has come to draw since it was opened, 8 bytes."""
    file = os.open(path, os.O_RDWR | os.O_CREAT)
    draw = App.draw
    turns = 0

    def counted(app: App) -> None:
        nonlocal turns
        draw(app)
        turns += 1
        os.pwrite(file, turns.to_bytes(8, "little"), 0)

    App.draw = counted  # type: ignore[method-assign]


if __name__ == "__main__":
    count_turns(sys.argv[1])
    sys.exit(main(["view", *sys.argv[2:]]))
