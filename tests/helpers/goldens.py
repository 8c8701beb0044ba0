"""Golden pictures: where they are, and what of a picture may differ from its golden."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .paths import ROOT

SCREENSHOTS = ROOT / "tests" / "screenshots"
LEVELS = 2
"""Of 255. The last bits of both engines and of a software GPU differ between processors. It shows where
values are rounded to 8 bits: into the picture of the splats, and where something is blended over it."""
SHARE = 0.02
"""Of the pixels may differ at all. Float32 errors round one in 20 000 otherwise; the most that was seen are
two pictures that llvmpipe without AVX scales down in a card (1.2 % of the window)."""


def difference(golden: NDArray[np.uint8], found: NDArray[np.uint8]) -> str:
    """What is wrong with a picture; "" where it is its golden, but for how processors round. [H,W,3] both"""
    if golden.shape != found.shape:
        return f"the picture is {found.shape}, its golden {golden.shape}"
    apart = np.abs(golden.astype(int) - found.astype(int)).max(axis=-1)
    for levels, share in ((LEVELS, 0.0), (0, SHARE)):
        if (count := int((apart > levels).sum())) > share * apart.size:
            return f"{count} pixels differ by more than {levels}/255 (largest {int(apart.max())})"
    return ""
