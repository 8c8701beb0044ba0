"""`progdf view` with a count of its loop's turns: python counted_view.py TURNS ARGUMENTS…

A turn handles the pending events and draws at most one frame. An idle window takes no turns.
"""

from __future__ import annotations

import os
import sys

from progdf.__main__ import main
from viewer.app.app import App


def count_turns(path: str) -> None:
    """Write the number of turns of the window's loop to the file, in 8 bytes."""
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
