"""Image editors: functions from a view to its edited view.

Each family of editors has one module, one line in `EDITORS` and one test module.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from progdf.color.edits import parse_grade
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditorOptions
from trainer.views.view import RegionThumbnail, View

from .base import EditorInput, ImageEditor
from .decal import check_decal, decal
from .instruct import check_instruct, instruct
from .pictures import folder, folder_of, photograph_folders, photographs, picture_paths, pictures
from .procedural import darken, grade, night, paint_of, recolor, remove, stops_of, stripes, tint
from .style import check_style, style


class Family(NamedTuple):
    """One kind of editor."""

    make: Callable[[EditorInput], ImageEditor]
    example: str  # an example of its option value
    check: Callable[[str], object] | None = None  # checks the text after the colon without reading the scene


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
"""Editor families by kind."""

PER_VIEW = ("folder", "photographs", "style", "instruct")
"""Kinds that edit each view on its own. Nothing makes the views agree."""

COLOR_FUNCTIONS = ("recolor", "tint", "darken", "night", "grade")
"""Kinds that map each color to another color, independent of its position."""

EXTERNAL = ("folder", "photographs", "pictures")
"""Kinds whose pictures are made elsewhere. They exist only at the strengths that the user supplies."""

KIND_UNKNOWN = ("folder", "photographs", "instruct")
"""Kinds that cannot tell which attributes their pictures change."""

COSTLY_STRENGTHS = ("instruct",)
"""Kinds that run a model for every strength. Previews must not request their strengths."""


def check_editor(spec: str) -> tuple[str, str]:
    """Split `KIND:WHAT` into its two parts. Nothing is read or rendered.

    Raises:
        ProgdfError: the kind is unknown.
    """
    kind, _, what = spec.partition(":")
    if kind not in EDITORS:
        examples = ", ".join(family.example for family in EDITORS.values())
        raise ProgdfError(f"unknown editor '{kind}'; use one of {examples}")
    return kind, what


def check_new_editor(options: EditorOptions) -> None:
    """Check that a new run can start with this editor.

    A resumed run needs no check: it keeps its views, and the folder of its pictures may be gone.

    Raises:
        ProgdfError: the editor, its text or one of its options is invalid.
    """
    kind, what = check_editor(options.editor)
    if kind == "instruct":
        check_instruct(what, options)
    if kind == "decal":
        check_decal(what, options)
    check = EDITORS[kind].check
    if check is not None:
        check(what)


def make_editor(
    options: EditorOptions, scene: Gaussians, region: Region, views: Sequence[View],
    glances: Callable[[], Sequence[RegionThumbnail]] = list,
) -> ImageEditor:  # fmt: skip
    """Return the editor that the options name (see `EditorInput`).

    Raises:
        ProgdfError: the editor cannot be made.
    """
    kind, what = check_editor(options.editor)
    return EDITORS[kind].make(EditorInput(what, scene, region, views, options, glances))
