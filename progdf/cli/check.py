"""`progdf check SCENE`: what the file holds, what had to be repaired, what is stray in the scene."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from progdf.errors import print_line
from progdf.formats.scene_file import load_scene_with_report
from progdf.io.cameras import load_cameras
from progdf.scene.stats import survey
from progdf.scene.strays import find_strays
from progdf.scene.up_axis import UpChoice, find_up

from .options import parse_options


@dataclass(frozen=True)
class CheckOptions:
    """Report what a scene's file holds and what had to be repaired to load it. Nothing is written.

    Args:
        scene: a .ply, .spz, .splat, .ksplat or .sog
        cameras: its cameras, which tell the up axis
        up: the axis that is up
    """

    scene: Annotated[Path, tyro.conf.Positional]
    cameras: Path | None = None
    up: UpChoice = "auto"


def main(argv: Sequence[str]) -> int:
    """Print the load report, the survey, the strays. Raises ProgdfError for a file that cannot be loaded."""
    options = parse_options(CheckOptions, argv, "progdf check")
    scene, report = load_scene_with_report(options.scene)
    cameras = [] if options.cameras is None else load_cameras(options.cameras, scene.origin)
    up = find_up(scene, cameras, options.up, options.scene)
    for line in report.lines() + survey(scene, up).lines():
        print_line(line)
    strays = find_strays(scene)
    if len(strays.rows):
        path = shlex.quote(str(options.scene))
        print_line(f"strays: {strays.describe()}; progdf edit {path} --clean -o CLEAN.ply leaves them out")
    return 0
