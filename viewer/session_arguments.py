"""What `progdf view` and `progdf render` open: a scene with edits, or a session that holds both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.info import kind_of

from . import arguments, session
from .session import Session
from .state import ViewState

NAME = "--session"
_SAID_BY_SESSION = ("gdfs", "gain", "solo", "overshoot", "blend", "background")


@dataclass(frozen=True)
class Opened:
    """A session, and the file it came from."""

    session: Session
    path: Path


def is_session(path: Path) -> bool:
    """Whether a file is a session, by its content; a file that cannot be read is none."""
    return path.is_file() and kind_of(path) == "session"


def from_session(options: Any) -> Opened | None:
    """The session that `options.scene` names, with the strengths of `options.set`; None for a scene.

    Raises:
        ProgdfError: see `session.open_session`; or an option says what the session says already.
    """
    if not is_session(options.scene):
        return None
    defaults = {f.name: f.default for f in fields(options)}
    for name in _SAID_BY_SESSION:
        if getattr(options, name) != defaults[name]:
            what = "an edit was given" if name == "gdfs" else f"--{name} was given"
            raise ProgdfError(
                f"{what} with the session {options.scene.name}, which says it too; leave it out"
            )
    opened = session.open_session(options.scene)
    return Opened(replace(opened, view=_set(opened, options.set)), options.scene)


def without_name(argv: Sequence[str]) -> list[str]:
    """`--session FILE` and `--session=FILE` as the FILE in the scene's place."""
    found: list[str] = []
    first: list[str] = []
    rest = iter(argv)
    for argument in rest:
        if argument == NAME:
            file = next(rest, None)
            if file is None:
                raise ProgdfError(f"{NAME} names no file; write {NAME} FILE")
            first.append(file)
        elif argument.startswith(f"{NAME}="):
            first.append(argument.removeprefix(f"{NAME}="))
        else:
            found.append(argument)
    return [*first, *found]


def _set(opened: Session, settings: Sequence[str]) -> ViewState:
    """The session's view with the strengths that `NAME=S` settings name."""
    named = {setting.rpartition("=")[0] for setting in settings}
    asked = arguments.layers_of(opened.document.gdfs, settings)
    strengths = {layer.gdf: layer.strength for layer in asked if layer.name in named}
    layers = (
        replace(layer, strength=strengths.get(layer.gdf, layer.strength)) for layer in opened.view.layers
    )
    return replace(opened.view, layers=tuple(layers))
