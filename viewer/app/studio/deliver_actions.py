"""What the window delivers: the scene as a .ply, pictures and films, each by the command that does it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Container
from dataclasses import replace
from pathlib import Path

from progdf import __version__
from progdf.errors import ProgdfError
from viewer.app.application import Application, failure_line
from viewer.files import exports, session
from viewer.files.session import WindowSession
from viewer.files.typed_paths import parse_path
from viewer.jobs.delivery import Deliveries, DeliverOptions
from viewer.state.view_state import Comparison, Keyframe, Timeline, ViewState
from viewer.state.workspace import Dialog

POLL_S = 0.3
ASKS = {"export": ".ply", "render_picture": ".png", "render_film": ".mp4"}
"""Questions, and how the names of their files end."""


class DeliverActions:
    """Asks where to, and starts the commands. `close` it with the window.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app
        self.deliveries = Deliveries()
        self._leaves = False
        self._asked: dict[str, DeliverOptions] = {}  # the last of each kind, for the next

    def handle(self, request: str) -> bool:
        """Do what is asked for; False where it is nothing of ours."""
        name, _, argument = request.partition(":")
        if name in ASKS:
            self._report(lambda: self._ask(name))
        elif name == "deliver":
            self._deliver(argument)
        elif name == "stop_delivery":
            self.deliveries.stop(int(argument))
        elif name == "quit" and self.deliveries.busy and not self._leaves:
            written = next(shown.title for shown in self.deliveries.shown if shown.status != "failed")
            self._app.main_view.ask(Dialog("delivery", written))
        elif name == "drop_and_quit":
            self._leaves = True
            for shown in self.deliveries.shown:
                self.deliveries.stop(shown.number)
        elif name == "about":
            lines = f"ProGDF Studio {__version__}, Python {sys.version.split()[0]}"
            self._app.main_view.ask(Dialog("about", lines))
        else:
            return False
        self._publish()
        return True

    def poll(self) -> float | None:
        """Look at the commands; seconds until the next look, None for ever."""
        for delivery in self.deliveries.poll():
            if delivery.status == "failed":
                self._app.main_view.show_message(f"{delivery.title}: {delivery.error}", error=True)
            elif delivery.status == "done":
                self._app.main_view.show_message(f"Wrote {delivery.out}")
        self._publish()
        if self._leaves and not self.deliveries.busy:
            self._leaves = False
            self._app.main_view.request("quit")
        return POLL_S if self.deliveries.busy else None

    def close(self) -> None:
        """Stop what is being written."""
        self.deliveries.close()

    def _ask(self, name: str) -> None:
        document, main_view = self._app.document, self._app.main_view
        if document.path is None:
            raise ProgdfError("there is no scene yet; open one first")
        view = main_view.work.view
        options = self._asked.get(name, DeliverOptions())
        if name == "render_film":
            keys = ("timeline",) if len(view.timeline.keys) > 1 else ()
            moving = (*keys, *(layer.name for layer in reversed(view.layers)))
            if not moving:
                raise ProgdfError(
                    "there is nothing to move yet; make an edit, or set keys on the timeline (K)"
                )
            focus = main_view.work.focus
            chosen = moving[0] if keys or focus is None else view.layers[focus].name
            options = self._asked.get(name, DeliverOptions(width=1280, height=720))
            fps = view.timeline.fps if keys else options.fps
            options = replace(options, moves=chosen, can_move=moving, fps=fps)
        suffix = options.format if name == "render_film" else ASKS[name]
        path = _free(
            exports.folder_of(document.path) / f"{document.path.stem}_edited{suffix}", self._written()
        )
        main_view.ask(Dialog(name, str(path), options=options))

    def _deliver(self, kind: str) -> None:
        """Start what the question that is open asks for; what is wrong stands in it."""
        main_view = self._app.main_view
        asked = main_view.work.dialog
        if asked is not None:
            error = failure_line(lambda: self._start(kind, asked))
            main_view.work = replace(main_view.work, dialog=replace(asked, error=error) if error else None)
            main_view.wake()

    def _start(self, kind: str, asked: Dialog) -> None:
        out, options = parse_path(asked.text).resolve(), asked.options or DeliverOptions()
        suffix = options.format if kind == "render_film" else ASKS[kind]
        if out.suffix.lower() != suffix:
            out = out.with_name(out.name + suffix) if suffix else out
        if not out.parent.is_dir():
            raise ProgdfError(f"the folder {out.parent} does not exist; create it first")
        if out in self._written():
            raise ProgdfError(f"{out.name} is being written already; choose another name")
        exists = f"{out.name} exists; give another name, or press again to replace it"
        if out.exists() and asked.error != exists:
            raise ProgdfError(exists)
        view = self._app.main_view.work.view
        if kind == "render_film" and options.moves != "timeline":
            view = _slider_film(view, options)
        elif kind == "render_film":
            view = replace(view, timeline=replace(view.timeline, fps=options.fps))
        stack = self._save_stack(view)
        size = f"--size={options.width}x{options.height}"
        words = {
            "export": ["export", stack, f"--out={out}"],
            "render_picture": ["render", stack, f"--out={out}", size, *["--alpha"] * options.alpha],
            "render_film": ["render", stack, f"--out={out}", size, f"--timeline={stack}"],
        }
        self.deliveries.start(f"{_TITLES[kind]} {out.name}", out, words[kind], self._app.document.path)
        self._asked[kind] = options

    def _written(self) -> set[Path]:
        """What is being written just now."""
        return {shown.out for shown in self.deliveries.shown if shown.status in ("running", "stopping")}

    def _save_stack(self, view: ViewState) -> str:
        """A session of what the window shows, for a command; without the comparison."""
        path = self.deliveries.folder / f"stack{len(list(self.deliveries.folder.iterdir()))}.session.json"
        session.save(path, WindowSession(self._app.document, replace(view, compare=Comparison())))
        return str(path)

    def _report(self, act: Callable[[], None]) -> None:
        if error := failure_line(act):
            self._app.main_view.show_message(error, error=True)

    def _publish(self) -> None:
        """The panel shows what is made from this scene, and from others what goes on."""
        main_view, scene = self._app.main_view, self._app.document.path
        deliveries = tuple(
            replace(shown, elsewhere=shown.scene.name if shown.scene and shown.scene != scene else "")
            for shown in self.deliveries.shown
            if shown.scene in (None, scene) or shown.status != "failed"
        )
        if deliveries != main_view.work.deliveries:
            main_view.work = replace(main_view.work, deliveries=deliveries)
            main_view.wake()


_TITLES = {"export": "Exporting", "render_picture": "Rendering", "render_film": "Rendering"}


def _slider_film(view: ViewState, options: DeliverOptions) -> ViewState:
    """The view with a timeline on which one layer's slider goes there and back."""
    gdf = next(layer.gdf for layer in view.layers if layer.name == options.moves)
    length = max(round(options.fps * options.seconds / 2), 1)
    still = tuple((layer.gdf, layer.strength) for layer in view.layers if layer.gdf != gdf)
    keys = tuple(Keyframe(frame, ((gdf, s), *still)) for frame, s in ((0, 0.0), (length, 1.0)))
    return replace(view, timeline=Timeline(keys, length, options.fps, ping_pong=True))


def _free(path: Path, taken: Container[Path]) -> Path:
    """The path, or one with a number where something has its name, or will have."""
    free, number = path, 2
    while free.exists() or free in taken:
        free, number = path.with_stem(f"{path.stem}-{number}"), number + 1
    return free
