"""`progdf check SCENE.ply`: what the file holds, what had to be repaired, what is odd about the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from progdf.command_line import parsed
from progdf.ply import load_ply_with_report
from progdf.survey import survey


@dataclass(frozen=True)
class Options:
    """Report what a 3DGS .ply file holds and what had to be repaired to load it. Nothing is written.

    Args:
        scene: the .ply file
    """

    scene: Annotated[Path, tyro.conf.Positional]


def main(argv: Sequence[str]) -> int:
    """Print the load report, then the survey. Raises ProgdfError for a file that cannot be loaded."""
    options = parsed(Options, argv, "progdf check")
    scene, report = load_ply_with_report(options.scene)
    for line in report.lines() + survey(scene).lines():
        print(line)
    return 0
