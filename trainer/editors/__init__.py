"""Image editors: a view in, the edited view out. One file a family, one line in `EDITORS`, one test each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from progdf.color.edits import parse_grade
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditorOptions
from trainer.views.view import View

from .base import EditorInput, ImageEditor
from .decal import check_decal, decal
from .instruct import check_instruct, instruct
from .pictures import folder, folder_of, photograph_folders, photographs, picture_paths, pictures
from .procedural import darken, grade, night, paint_of, recolor, remove, stops_of, stripes, tint
from .style import check_style, style

Factory = Callable[[EditorInput], ImageEditor]

EDITORS: dict[str, Factory] = {
    "recolor": recolor,
    "tint": tint,
    "stripes": stripes,
    "darken": darken,
    "night": night,
    "grade": grade,
    "folder": folder,
    "photographs": photographs,
    "pictures": pictures,
    "decal": decal,
    "style": style,
    "instruct": instruct,
    "remove": remove,
}
"""Kind of editor → its factory."""

PER_VIEW = ("folder", "photographs", "style", "instruct")
"""Kinds whose views are edited one by one, so that nothing makes them agree."""

COLOR_FUNCTIONS = ("recolor", "tint", "darken", "night", "grade")
"""Kinds that give each color another one, wherever it is."""

EXTERNAL = ("folder", "photographs", "pictures")
"""Kinds whose pictures were made elsewhere, at the strengths that they were made at."""

KIND_UNKNOWN = ("folder", "photographs", "instruct")
"""Kinds that do not know what their pictures move."""

COSTLY_STRENGTHS = ("instruct",)
"""Kinds that paint every strength anew: what a model takes its time for is not done to look around."""

EXAMPLES = (
    "recolor:#3060d0",
    "tint:#d4af37",
    "stripes:#20a040",
    "darken:0.7",
    "night",
    "grade:exposure=0.7",
    "folder:DIR",
    "photographs:EDITED,ORIGINALS",
    "pictures:A.png,B.png",
    "decal:LOGO.png",
    "style:14",
    "remove",
)


CHECKS: dict[str, Callable[[str], object]] = {
    "recolor": paint_of,
    "tint": paint_of,
    "stripes": paint_of,
    "darken": partial(stops_of, editor="darken"),
    "night": partial(stops_of, editor="night"),
    "grade": parse_grade,
    "folder": folder_of,
    "photographs": photograph_folders,
    "pictures": picture_paths,
    "style": check_style,
    "remove": lambda what: picture_paths(what) if what else (),
}
"""Kind of editor → the check of the text after the colon, by itself."""


def check_editor(spec: str) -> tuple[str, str]:
    """Split `KIND:WHAT`; ProgdfError if there is no such kind. Cheap: nothing is read or rendered."""
    kind, _, what = spec.partition(":")
    if kind not in EDITORS:
        raise ProgdfError(f"unknown editor '{kind}'; use one of {', '.join(EXAMPLES)}")
    return kind, what


def check_new_editor(options: EditorOptions) -> None:
    """ProgdfError if no run can begin so; one that has begun keeps its views, its folder may go."""
    kind, what = check_editor(options.editor)
    if kind == "instruct":
        check_instruct(what, options)
    if kind == "decal":
        check_decal(what, options)
    if kind in CHECKS:
        CHECKS[kind](what)


def make_editor(
    options: EditorOptions, scene: Gaussians, region: Region, views: Sequence[View]
) -> ImageEditor:
    """The editor that the options name, for one region and its views; ProgdfError says what is wrong."""
    kind, what = check_editor(options.editor)
    return EDITORS[kind](EditorInput(what, scene, region, views, options))


__all__ = [
    "COLOR_FUNCTIONS",
    "COSTLY_STRENGTHS",
    "EDITORS",
    "EXTERNAL",
    "KIND_UNKNOWN",
    "PER_VIEW",
    "ImageEditor",
    "check_editor",
    "check_new_editor",
    "make_editor",
]
