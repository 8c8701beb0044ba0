"""Cameras, timelines and changed pictures as files: opened into the view on screen, or kept from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import edits_in_picture, find_picture_camera
from viewer.camera.view_camera import from_camera, to_camera
from viewer.files import exports, timeline_file
from viewer.jobs.training import with_picture
from viewer.state.playback import Player
from viewer.state.workspace import with_camera

from .application import Application
from .main_view import MainView

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
"""Endings of what `edit_picture` takes."""


def look_through(main_view: MainView, path: Path) -> None:
    """Take the first camera of a file.

    Raises:
        ProgdfError: it holds none.
    """
    _take_camera(main_view, load_cameras(path, main_view.facts.origin)[0])
    main_view.show_message(f"Looking through the first camera of {path.name}")


def edit_picture(main_view: MainView, path: Path) -> None:
    """Put a picture that was changed into the form of a new edit, and look from where it was taken.

    Raises:
        ProgdfError: it is no picture, its camera is not found, or it was taken with edits on.
    """
    camera = find_picture_camera(path, origin=main_view.facts.origin)
    if edits := edits_in_picture(path):
        raise ProgdfError(f"{path.name} was taken with edits on ({edits}); take the view with Ctrl+F2")
    _take_camera(main_view, camera)
    work = main_view.work
    main_view.work = replace(work, form=with_picture(work.form, path, work.form_open), form_open=True)


def _take_camera(main_view: MainView, camera: Camera) -> None:
    seen = from_camera(main_view.work.view.camera, camera, main_view.facts.bounds)
    main_view.work = with_camera(main_view.work, seen)


def keep_camera(app: Application, session: Path | None) -> None:
    """Add the view on screen to the cameras kept beside the session, or the scene.

    Raises:
        ProgdfError: see `exports.camera`.
    """
    main_view = app.main_view
    place = session or app.document.path or main_view.pictures / app.document.title
    camera = to_camera(main_view.work.view.camera, *main_view.picture_size)
    path, count = exports.camera(place, camera, main_view.facts.origin)
    main_view.show_message(
        f"Saved as camera {count} in {path.resolve()}; use it with progdf train … --cameras {path.name}"
    )


def open_timeline(main_view: MainView, path: Path) -> None:
    """The keys of a file take the place of those there are; undo brings them back.

    Raises:
        ProgdfError: see `timeline_file.load`.
    """
    view = main_view.work.view
    main_view.change(replace(view, timeline=timeline_file.load(path, view.layers, main_view.facts.origin)))
    main_view.work = replace(main_view.work, player=Player(shown=True))
    main_view.show_message(f"Opened {path.name}; press Space to play it")
