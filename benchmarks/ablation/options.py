"""Options of the ablation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class AblateOptions:
    """Train finished runs again, each time with one part of the method left out or replaced; compare results.

    Finished variants are saved in RUN/ablation. An interrupted ablation resumes, and --only adds to it.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of progdf train; their scene, region, edited views and options are used."""
    only: str = ""
    """Variants by name, such as one-target,no-lpips; empty for all that apply to the run."""
    seeds: int = 1
    """Seeds per variant, starting with the run's own; variants that use no seed are trained once."""
    quick: bool = False
    """A draft: 240 steps in 4 stages, 12 views."""
    markdown: Path | None = None
    """Also put the table of all runs between its markers in this Markdown file."""
    plot: Path | None = None
    """Also draw the figures of all runs into this PNG file."""
    scene: Path | None = None
    """New path of the scene, if it has moved since the run."""
    threads: int = 0
    """CPU threads; 0 uses all cores."""
