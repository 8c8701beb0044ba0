"""What an ablation can be told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class AblateOptions:
    """Train finished runs again without one part of the method, or with another: one table, one picture.

    What is done is kept in RUN/ablation: an interrupted ablation goes on, and --only adds to it.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that progdf train wrote; scene, region, edited views and options are taken over."""
    only: str = ""
    """Some variants by name, as one-target,no-lpips; all that make sense for the run if empty."""
    seeds: int = 1
    """How often each variant is trained, from the run's own seed on; once where a seed changes nothing."""
    quick: bool = False
    """A draft: 240 steps in 4 stages, 12 views."""
    markdown: Path | None = None
    """Also put the table of all runs between its markers in this Markdown file."""
    plot: Path | None = None
    """Also draw the figures of all runs into this PNG file."""
    scene: Path | None = None
    """Where the scene is now, if it has moved since the run."""
    threads: int = 0
    """CPU threads; 0 takes all cores."""
