"""Comparable areas of a divided picture: beside its divider and below its labels."""

from __future__ import annotations

import numpy as np

SIZE = (340, 540)  # of the picture beside the panel of the default rig
BANNER = 60  # height of the labels, in pixels


def beside_line(picture: np.ndarray, at: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the areas left and right of the divider and its knob, below the labels."""
    return picture[BANNER:, : at - 15], picture[BANNER:, at + 15 :]
