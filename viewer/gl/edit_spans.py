"""Where in the scene's textures the edit pass draws: the members of edits as spans of neighboring texels.

A region that a file holds in one piece is a span a texture row; scattered members are a span each. Either way
as many texels are drawn as there are members, however large the scene is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import SPAN, SPLATS_PER_ROW


def spans_of(rows: NDArray[np.int64], slots: NDArray[np.int64]) -> NDArray[Any]:
    """The spans that cover `rows` and nothing else.

    Args:
        rows: Gaussians, ascending, each of them in `slots`. [M]
        slots: Gaussians that are a member of any edit, ascending. [U]

    Returns:
        [S] of `SPAN`, S ≤ M
    """
    broken = (np.diff(rows) != 1) | (rows[1:] % SPLATS_PER_ROW == 0)
    begins = np.concatenate([np.arange(min(len(rows), 1)), 1 + np.flatnonzero(broken)])
    firsts = rows[begins]
    spans = np.zeros(len(begins), SPAN)
    spans["row"], spans["column"] = np.divmod(firsts, SPLATS_PER_ROW)
    spans["texels"] = np.diff(begins, append=len(rows))
    spans["slot"] = np.searchsorted(slots, firsts)
    return spans
