"""`progdf edit SCENE … -o OUT.ply`: a scene with its Gaussians changed for good, as a new file."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply_checked
from progdf.formats.scene_file import load_scene, scene_name
from progdf.gaussians import Gaussians
from progdf.io.atomic import check_not_an_input
from progdf.metrics.image import NO_DIFFERENCE
from progdf.scene.strays import clean, find_strays, picture_difference
from progdf.terminal import format_count, group_digits, print_line

from .options import absent_option, parse_options


@dataclass(frozen=True)
class EditOptions:
    """Write a scene again without what should not be in it. The scene itself is never changed."""

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """a .ply, .spz, .splat, .ksplat or .sog."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.ply")]
    """the .ply file to write."""
    clean: Annotated[bool, tyro.conf.FlagCreatePairsOff, absent_option(None)] = False
    """leave out floaters, needles, giants and what is too transparent to be drawn."""


def main(argv: Sequence[str]) -> int:
    """Do what is asked for and write it. Raises ProgdfError where that is nothing, or would leave nothing."""
    options = parse_options(EditOptions, argv, "progdf edit")
    if not options.clean:
        raise ProgdfError("nothing was asked for; say what to do with the scene, for example --clean")
    if options.out.suffix.lower() != ".ply":
        raise ProgdfError(f"{options.out} is not a .ply file; give the new scene a name that ends in .ply")
    check_not_an_input(options.out, [options.scene])
    scene = load_scene(options.scene)
    edited = _clean(scene)
    if not len(edited):
        raise ProgdfError(f"nothing of {options.scene} would be left; it has no Gaussian that is drawn")
    save_ply_checked(options.out, edited)
    print_line(f"wrote {options.out}: {format_count(len(edited))}")
    if len(edited) < len(scene):
        old, new = shlex.quote(str(options.scene)), shlex.quote(str(options.out))
        print_line(
            f"rows have new numbers: labels and edits of {scene_name(options.scene)} no longer fit; "
            f"an edit is carried over by progdf rebind EDIT.gdf --from {old} --to {new} -o NEW.gdf"
        )
    return 0


def _clean(scene: Gaussians) -> Gaussians:
    """Without strays; prints which, and what that changes in pictures."""
    strays = find_strays(scene)
    if not len(strays.rows):
        print_line("clean: there are no strays")
        return scene
    edited = clean(scene, strays)
    print_line(
        f"clean: {group_digits(len(strays.rows))} of {format_count(len(scene))} left out: {strays.describe()}"
    )
    mean, worst = picture_difference(scene, edited) if len(edited) else (0.0, 0.0)
    if worst >= NO_DIFFERENCE:
        print_line("pictures from all around: no pixel differs")
    else:
        print_line(
            f"pictures from all around: {mean:.1f} dB to those before, {worst:.1f} dB where most differs"
        )
    return edited
