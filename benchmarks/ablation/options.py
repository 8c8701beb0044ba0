"""What an ablation can be told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class AblateOptions:
    """Train a finished run again without one part of the method, or with another: one table, one picture.

    What is done is kept in RUN/ablation: an interrupted ablation goes on, and --only adds to it.
    """

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote; its scene, region, edited views and options are taken over."""
    only: str = ""
    """Some variants by name, as one-target,no-lpips; all that make sense for the run if empty."""
    quick: bool = False
    """A draft: 240 steps in 4 stages, 12 views."""
    scene: Path | None = None
    """Where the scene is now, if it has moved since the run."""
    threads: int = 0
    """CPU threads; 0 takes all cores."""
