"""Image editors: functions from a view to its edited view.

Each editor has one factory and one row in `EDITORS`, which answers every question about it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from progdf.color.grade import parse_grade
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import REMOVAL_VIEWS, EditorOptions
from trainer.views.view import RegionThumbnail, View

from .adapters import default_model
from .base import EditorInput, EditorRow, ImageEditor, Waiting
from .command import check_command_editor, command
from .decal import check_decal, decal
from .instruct import IMAGE_SIZE, check_instruct, instruct
from .paint import check_paint, paint
from .pictures import (
    folder,
    folder_cameras,
    folder_of,
    photograph_folders,
    photographs,
    photographs_note,
    picture_paths,
    pictures,
    removal_pictures,
)
from .procedural import darken, grade, night, paint_of, recolor, remove, stops_of, stripes, tint
from .server.comfy import check_comfy
from .server.editor import api, check_served, comfy
from .server.images_api import check_api
from .style import check_style, style


def _text_check(check: Callable[[str], object]) -> Callable[[str, EditorOptions], object]:
    """Return a check with the signature of `EditorRow.check` that ignores the options."""
    return lambda what, options: check(what)


_check_paint = _text_check(paint_of)

_SERVER_OPTIONS = (
    "api_url",
    "degrees",
    "price_per_call",
    "yes",
    "anchor",
    "edit_size",
    "edit_workers",
    "edit_timeout",
)  # options of the editors whose model a server runs

EDITORS = {
    "recolor": EditorRow(recolor, "recolor:#3060d0", _check_paint, color_function=True, is_parallel=True),
    "tint": EditorRow(tint, "tint:#d4af37", _check_paint, color_function=True, is_parallel=True),
    "stripes": EditorRow(stripes, "stripes:#20a040", _check_paint, is_parallel=True, paints_members=True),
    "darken": EditorRow(
        darken,
        "darken:0.7",
        _text_check(partial(stops_of, editor="darken")),
        color_function=True,
        is_parallel=True,
    ),
    "night": EditorRow(
        night,
        "night",
        _text_check(partial(stops_of, editor="night")),
        color_function=True,
        is_parallel=True,
    ),
    "grade": EditorRow(
        grade,
        "grade:exposure=0.7",
        _text_check(parse_grade),
        color_function=True,
        is_parallel=True,
        is_manual=True,
    ),
    "folder": EditorRow(
        folder,
        "folder:DIR",
        _text_check(folder_of),
        per_view=True,
        external=True,
        knows_kind=False,
        cameras=folder_cameras,
        remedy="edit the views more consistently, or use --kind geometry if parts move",
    ),
    "photographs": EditorRow(
        photographs,
        "photographs:EDITED,ORIGINALS",
        _text_check(photograph_folders),
        per_view=True,
        external=True,
        knows_kind=False,
        note=photographs_note,
    ),
    "pictures": EditorRow(
        pictures,
        "pictures:A.png,B.png",
        _text_check(picture_paths),
        external=True,
        files=picture_paths,
        shows_scene=True,
        sets_views=True,
        options=("fill", "removal", "carry_on"),
        run="trained or removed",
    ),
    "decal": EditorRow(
        decal,
        "decal:LOGO.png",
        check_decal,
        files=lambda what: (Path(what),),
        options=("at", "camera"),
        run="pasted",
    ),
    "paint": EditorRow(
        paint,
        "paint:A.png,B.png",
        check_paint,
        files=picture_paths,
        shows_scene=True,
        run="pasted",
    ),
    "style": EditorRow(
        style,
        "style:14",
        _text_check(check_style),
        per_view=True,
        options=("edit_size",),
        remedy="use a calmer style (14, 23, 20, 7)",
    ),
    "instruct": EditorRow(
        instruct,
        'instruct:"turn him into Batman"',
        check_instruct,
        per_view=True,
        knows_kind=False,
        slow_strengths=True,
        model=default_model,
        image_size=IMAGE_SIZE,
        options=("model", "guidance", "edit_steps", "anchor", "quantize", "device", "edit_size"),
        remedy="make the prompt more specific, or use --kind geometry if parts move",
    ),
    "command": EditorRow(
        command,
        "command:'magick {input} -modulate 100,{100..30} {output}'",
        check_command_editor,
        per_view=True,
        knows_kind=False,
        slow_strengths=True,
        runs_program=True,
        options=("prompt", "strengths_by", "edit_workers", "edit_timeout"),
        remedy="let the program edit all views alike, or use --kind geometry if parts move",
    ),
    "api": EditorRow(
        api,
        'api:"turn him into a marble statue"',
        check_api,
        per_view=True,
        knows_kind=False,
        slow_strengths=True,
        sends_pictures=True,
        image_size=IMAGE_SIZE,
        options=("model", "api_references", "api_mask", *_SERVER_OPTIONS),
        remedy="make the prompt more specific, or use --kind geometry if parts move",
    ),
    "comfy": EditorRow(
        comfy,
        "comfy:WORKFLOW.json",
        check_comfy,
        per_view=True,
        knows_kind=False,
        slow_strengths=True,
        sends_pictures=True,
        image_size=IMAGE_SIZE,
        options=("prompt", *_SERVER_OPTIONS),
        remedy="make the prompt more specific, or use --kind geometry if parts move",
    ),
    "remove": EditorRow(
        remove,
        "remove",
        _text_check(removal_pictures),
        files=removal_pictures,
        options=("fill",),
        run="removed",
        views=REMOVAL_VIEWS,
    ),
}
"""Rows of the editors, by the word before the colon in `--editor`."""


def check_editor(spec: str) -> tuple[str, str]:
    """Split `KIND:WHAT`, the value of `--editor`, into its two parts. Nothing is read or rendered.

    Raises:
        ProgdfError: the kind is unknown.
    """
    kind, _, what = spec.partition(":")
    if kind not in EDITORS:
        examples = ", ".join(row.example for row in EDITORS.values())
        raise ProgdfError(f"unknown editor '{kind}'; use one of {examples}")
    return kind, what


def editor_row(options: EditorOptions) -> EditorRow:
    """Return the row of the editor that the options name.

    Raises:
        ProgdfError: the kind is unknown.
    """
    return EDITORS[check_editor(options.editor)[0]]


def check_new_editor(options: EditorOptions) -> None:
    """Check that a new run can start with this editor.

    A resumed run needs no check: it keeps its views, and the folder of its pictures may be gone.

    Raises:
        ProgdfError: the editor, its text or one of its options is invalid.
    """
    row = editor_row(options)
    if row.check is not None:
        row.check(options.text, options)


def check_server(options: EditorOptions) -> None:
    """Check that the editor's server answers, if it has one. No picture is sent.

    Raises:
        ProgdfError: nothing listens at its address, or it cannot run the workflow.
    """
    if editor_row(options).sends_pictures:
        check_served(options).connect()


def make_editor(
    options: EditorOptions, scene: Gaussians, region: Region, views: Sequence[View],
    glances: Callable[[], Sequence[RegionThumbnail]] = list, seen: Gaussians | None = None,
    say: Callable[[str], object] = str, waiting: Waiting = nullcontext,
) -> ImageEditor:  # fmt: skip
    """Return the editor that the options name (see `EditorInput`).

    Raises:
        ProgdfError: the editor cannot be made.
    """
    row = editor_row(options)
    return row.make(
        EditorInput(
            options.text, scene, region, views, options, glances=glances, seen=seen, say=say, waiting=waiting
        )
    )
