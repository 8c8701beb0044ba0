"""Golden pictures: their folder and the allowed differences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .paths import ROOT

SCREENSHOTS = ROOT / "tests" / "screenshots"
LEVELS = 2
"""Largest difference of a pixel, of 255 levels.

The last bits of both engines and of a software GPU differ between processors. They become visible where
values are rounded to 8 bits: in the picture of the splats, and where colors are blended over it.
"""
SHARE = 0.02
"""Largest share of pixels that may differ at all.

Float32 errors change about one pixel in 20 000. The largest observed share is 1.2 % of the window, from two
pictures that llvmpipe without AVX scales down in a card.
"""


def difference(golden: NDArray[np.uint8], found: NDArray[np.uint8]) -> str:
    """Return the fault of a picture, or "" if it matches its golden within rounding. [H,W,3] both"""
    if golden.shape != found.shape:
        return f"the picture is {found.shape}, its golden {golden.shape}"
    apart = np.abs(golden.astype(int) - found.astype(int)).max(axis=-1)
    for levels, share in ((LEVELS, 0.0), (0, SHARE)):
        if (count := int((apart > levels).sum())) > share * apart.size:
            return f"{count} pixels differ by more than {levels}/255 (largest {int(apart.max())})"
    return ""
