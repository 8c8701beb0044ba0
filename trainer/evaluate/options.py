"""The options of `progdf evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

Suite = Literal["sliders"]


@dataclass(frozen=True)
class EvaluateOptions:
    """Measure a finished run as papers do: one table, one picture, on views that training has not seen."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote; with --suite, a folder for the suite's runs, made if need be."""
    suite: Suite | None = None
    """sliders: train edits of the demo scenes whose pictures are known at every strength, and compare the
    trained sliders with these at 11 strengths. Runs that are finished are not trained again."""
    scene: Path | None = None
    """Where the scene is now, if it has moved since the run."""
    text_before: str = ""
    """For CLIP, as for progdf train; the run's own, if nothing is given."""
    text_after: str = ""
    """For CLIP, as for progdf train; the run's own, if nothing is given."""
    threads: int = 0
    """CPU threads; 0 takes all cores."""
