"""Image editors: a view in, the edited view out. One file a family, one line in `EDITORS`, one test each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from progdf.color.edits import parse_grade
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditorOptions
from trainer.views.view import Glance, View

from .base import EditorInput, ImageEditor
from .decal import check_decal, decal
from .instruct import check_instruct, instruct
from .pictures import folder, folder_of, photograph_folders, photographs, picture_paths, pictures
from .procedural import darken, grade, night, paint_of, recolor, remove, stops_of, stripes, tint
from .style import check_style, style


class Family(NamedTuple):
    """A kind of editor."""

    make: Callable[[EditorInput], ImageEditor]
    example: str  # how it is written
    check: Callable[[str], object] | None = None  # of the text after the colon, by itself


EDITORS = {
    "recolor": Family(recolor, "recolor:#3060d0", paint_of),
    "tint": Family(tint, "tint:#d4af37", paint_of),
    "stripes": Family(stripes, "stripes:#20a040", paint_of),
    "darken": Family(darken, "darken:0.7", partial(stops_of, editor="darken")),
    "night": Family(night, "night", partial(stops_of, editor="night")),
    "grade": Family(grade, "grade:exposure=0.7", parse_grade),
    "folder": Family(folder, "folder:DIR", folder_of),
    "photographs": Family(photographs, "photographs:EDITED,ORIGINALS", photograph_folders),
    "pictures": Family(pictures, "pictures:A.png,B.png", picture_paths),
    "decal": Family(decal, "decal:LOGO.png"),
    "style": Family(style, "style:14", check_style),
    "instruct": Family(instruct, 'instruct:"turn him into Batman"'),
    "remove": Family(remove, "remove", lambda what: picture_paths(what) if what else ()),
}
"""Kind of editor → what makes it."""

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


def check_editor(spec: str) -> tuple[str, str]:
    """Split `KIND:WHAT`; ProgdfError if there is no such kind. Cheap: nothing is read or rendered."""
    kind, _, what = spec.partition(":")
    if kind not in EDITORS:
        examples = ", ".join(family.example for family in EDITORS.values())
        raise ProgdfError(f"unknown editor '{kind}'; use one of {examples}")
    return kind, what


def check_new_editor(options: EditorOptions) -> None:
    """ProgdfError if no run can begin so; one that has begun keeps its views, its folder may go."""
    kind, what = check_editor(options.editor)
    if kind == "instruct":
        check_instruct(what, options)
    if kind == "decal":
        check_decal(what, options)
    if (check := EDITORS[kind].check) is not None:
        check(what)


def make_editor(
    options: EditorOptions, scene: Gaussians, region: Region, views: Sequence[View],
    glances: Callable[[], Sequence[Glance]] = list,
) -> ImageEditor:  # fmt: skip
    """The editor that the options name, see `EditorInput`; ProgdfError says what is wrong."""
    kind, what = check_editor(options.editor)
    return EDITORS[kind].make(EditorInput(what, scene, region, views, options, glances))
