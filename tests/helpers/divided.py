"""Where a divided picture can be compared: beside its divider and below its words."""

from __future__ import annotations

import numpy as np

SIZE = (340, 540)  # of the picture beside the panel of the default rig
BANNER = 60  # rows in which words stand


def beside_line(picture: np.ndarray, at: int) -> tuple[np.ndarray, np.ndarray]:
    """Left and right of the divider and its knob, below the words."""
    return picture[BANNER:, : at - 15], picture[BANNER:, at + 15 :]
