"""Reports without their plots, which take half of the time of a small run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from PIL import Image

from trainer.report import report
from trainer.report.plots import PAPER, Plot


@contextmanager
def blank_plots() -> Iterator[None]:
    """Leave the plots in report.png blank."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "draw_plot", _leave_blank)
        yield


def _leave_blank(_: Plot, width: int, height: int) -> Image.Image:
    return Image.new("RGB", (width, height), PAPER)
