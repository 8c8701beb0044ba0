"""What `progdf view`, `render` and `export` open: a scene with edits, or a session that holds both."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from viewer.camera.view_camera import Vec3, up_of, with_up
from viewer.files import document, session
from viewer.files.document import Document
from viewer.state.layers import largest_strength
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import ViewState

from . import arguments
from .layer_arguments import stack_of
from .options import PictureOptions, StackOptions

NAME = "--session"
_SAID_BY_SESSION = ("gdfs", "gain", "solo", "paint", "overshoot", "background")


@dataclass(frozen=True)
class OpenStack:
    """What was opened, and how it shall look.

    Args:
        document: the scene and its edits
        view: of a scene without the camera, which is for the command to choose
        session: the file that holds all this; None for a scene
        snapshots: those of the session
        asked_up: an axis, or "auto"
        warning: what of the session was not taken as it is
    """

    document: Document
    view: ViewState
    session: Path | None = None
    snapshots: tuple[SliderSnapshot, ...] = ()
    asked_up: str = "auto"
    warning: str = ""

    @property
    def up(self) -> Vec3:
        """The direction that is up in the scene."""
        opened = self.document
        if self.asked_up == "auto":
            return opened.found_up.direction
        return up_of(opened.scene, opened.gdfs, self.asked_up)

    @property
    def files(self) -> tuple[Path, ...]:
        """All that was read."""
        own = (self.document.path, self.session)
        return (*(path for path in own if path is not None), *self.document.gdf_paths)

    def layer(self, name: str) -> str:
        """The layer of that name; else of the edit of that name, as a session's layers may be renamed."""
        named = {self.document.gdfs[layer.gdf].name: layer.name for layer in self.view.layers}
        return name if name in named.values() else named.get(name, name)


def open_stack(options: StackOptions, unset: float = 0.0) -> OpenStack:
    """Open what the options name.

    Args:
        options: of the command
        unset: the strength of a scene's edits that no --set names

    Raises:
        ProgdfError: a file is missing or broken, an edit was made for another scene or given twice, options
            name no edit; or they say what a session says already.
    """
    if is_session(options.scene):
        return _session(options)
    _check_each_once(options.gdfs)
    view = ViewState(blend=options.blend or "normalized", overshoot=options.overshoot)
    if isinstance(options, PictureOptions):
        view = replace(view, background=arguments.parse_background(options.background))
    found = document.load(options.scene, options.gdfs)
    layers = stack_of(
        found.gdfs, options.set, options.gain, options.solo, options.overshoot, options.paint, unset
    )
    return OpenStack(found, replace(view, layers=layers), asked_up=_up_option(options))


def is_session(path: Path) -> bool:
    """Whether a file is a session, by its content; a file that cannot be read is none."""
    return path.is_file() and kind_of(path) == "session"


def drop_option_name(argv: Sequence[str]) -> list[str]:
    """`--session FILE` and `--session=FILE` as the FILE in the scene's place."""
    found: list[str] = []
    first: list[str] = []
    rest = iter(argv)
    for argument in rest:
        if argument == NAME:
            file = next(rest, None)
            if file is None:
                raise ProgdfError(f"{NAME} needs a file; write {NAME} FILE")
            first.append(file)
        elif argument.startswith(f"{NAME}="):
            first.append(argument.removeprefix(f"{NAME}="))
        else:
            found.append(argument)
    return [*first, *found]


def _check_each_once(gdfs: Sequence[Path]) -> None:
    """Raises ProgdfError where an edit is named twice, which is a slip; sessions may hold one twice."""
    seen: dict[str, Path] = {}
    for path in gdfs:
        first = seen.setdefault(os.path.realpath(path), path)
        if first is not path:
            again = "" if first == path else f", first as {first}"
            raise ProgdfError(f"{path} was given twice{again}; give each edit once")


def _session(options: StackOptions) -> OpenStack:
    """The session with the strengths and the blend rule that were given beside it."""
    defaults = {f.name: f.default for f in fields(options)}
    for name in _SAID_BY_SESSION:
        if name in defaults and getattr(options, name) != defaults[name]:
            what = "an edit was given" if name == "gdfs" else f"--{name} was given"
            raise ProgdfError(
                f"{what} with the session {options.scene.name}, which already sets it; leave it out"
            )
    kept = session.open_session(options.scene)
    found = OpenStack(
        kept.document, kept.view, options.scene, kept.snapshots, _up_option(options), kept.warning
    )
    settings = [
        f"{found.layer(name)}{equals}{s}" for name, equals, s in (t.rpartition("=") for t in options.set)
    ]
    strengths = arguments.strengths_of(kept.view.layers, settings, largest_strength(kept.view))
    layers = (replace(l, strength=strengths.get(l.name, l.strength)) for l in kept.view.layers)
    view = replace(kept.view, layers=tuple(layers), blend=options.blend or kept.view.blend)
    if _up_option(options) != "auto":  # else the session's own
        view = replace(view, camera=with_up(view.camera, found.up))
    return replace(found, view=view)


def _up_option(options: StackOptions) -> str:
    return options.up if isinstance(options, PictureOptions) else "auto"
