"""Segmenters: a picture and a prompt in, a mask out. One file, one line in `SEGMENTERS`, one test each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from trainer.options import RegionOptions

from .base import Segmenter
from .grounded_sam import check_grounded_sam, grounded_sam

SEGMENTERS: Mapping[str, Callable[[RegionOptions], Segmenter]] = {"text": grounded_sam}
"""Kind of region → the segmenter behind it, loaded when it is made."""

SEGMENTER_CHECKS: Mapping[str, Callable[[RegionOptions], None]] = {"text": check_grounded_sam}
"""Kind of region → what raises a ProgdfError where that segmenter cannot be made; it loads no weights."""

__all__ = ["SEGMENTERS", "SEGMENTER_CHECKS", "Segmenter"]
