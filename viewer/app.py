"""The application: a window, the stage in it, its loop, and the files dropped on it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui

from progdf.checkpoint import Gdf, load_gdf
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.ply import load_ply

from .engine import Engine
from .layer_rows import layer_rows
from .stage import Stage
from .state import LayerState, ViewState
from .turntable import bounds_of, first_camera
from .window import Window, interruptible
from .workspace import SceneFacts

SIZE = (1280, 800)


@dataclass(frozen=True)
class Document:
    """What is open: the scene and its edits, in the order of `LayerState.gdf`."""

    title: str
    scene: Gaussians
    gdfs: tuple[Gdf, ...] = ()

    def facts(self) -> SceneFacts:
        """What the panel and the camera need to know of it."""
        rows = layer_rows(self.scene, self.gdfs)
        return SceneFacts(self.title, len(self.scene), bounds_of(self.scene), rows)


def run(document: Document, state: ViewState, pictures: Path = Path(), size: tuple[int, int] = SIZE) -> int:
    """Open the window and stay until it is closed.

    Args:
        document: the scene and its edits
        state: what to show first
        pictures: folder for saved pictures
        size: of the window, at 1×

    Returns:
        The exit status, 0.

    Raises:
        ProgdfError: there is no display, or no OpenGL 3.3 on it.
    """
    window = Window(_window_title(document.title), size)
    try:
        app = App(window, document, state, pictures)
        try:
            with interruptible():
                app.loop()
        finally:
            app.close()
    finally:
        window.close()
    return 0


class App:
    """One window with its stage and engine."""

    def __init__(self, window: Window, document: Document, state: ViewState, pictures: Path) -> None:
        self.window, self.document = window, document
        self.context = window.context()
        self.engine = Engine(self.context, document.scene, document.gdfs)
        self.stage = Stage(self.context, self.engine, document.facts(), state, window.ui_scale, pictures)
        self.dropped: list[Path] = []
        self.failure: BaseException | None = None
        self.last = time.perf_counter()
        window.listen(self.stage.wake, self._remember_dropped, self._redraw)

    def close(self) -> None:
        self.stage.ui.make_current()
        imgui.backends.glfw_shutdown()
        self.stage.close()
        self.engine.release()

    def loop(self) -> None:
        """Draw while something changes, sleep while nothing does."""
        imgui.backends.glfw_new_frame()
        self.stage.greet(self.context.screen)
        self.window.present()
        while not self.window.closing:
            self.window.wait(self.stage.patience())
            if self.failure is not None:
                raise self.failure
            for path in self._take_dropped():
                self.open(path)
            self.draw()

    def draw(self) -> None:
        """One frame of the latest state; nothing while the window is minimised."""
        if 0 in self.window.pixels:
            self.stage.rest()
            return
        arrived = time.perf_counter()
        seconds, self.last = arrived - self.last, arrived
        self.stage.ui.make_current()
        self.stage.ui.set_scale(self.window.ui_scale)
        imgui.backends.glfw_new_frame()
        screen = self.context.screen
        self.stage.frame(screen, self.window.pixels, seconds, self.window.take_keys(), arrived)
        self.window.present()
        requests = self.stage.take_requests()
        if "full_screen" in requests:
            self.window.toggle_full_screen()
        if "quit" in requests:
            self.window.ask_to_close()

    def _redraw(self) -> None:
        try:
            self.draw()
        except BaseException as failure:  # glfw would only print it
            self.failure = failure

    def _remember_dropped(self, paths: Sequence[Path]) -> None:
        self.dropped += paths
        self.stage.wake()

    def _take_dropped(self) -> list[Path]:
        paths, self.dropped = self.dropped, []
        return paths

    def open(self, path: Path) -> None:
        """A dropped file, by what it is: a scene replaces all, an edit comes on top of the stack."""
        try:
            if path.suffix.lower() == ".gdf":
                self._add_edit(load_gdf(path, self.document.scene))
            elif path.suffix.lower() == ".ply":
                self._open_scene(Document(path.name, load_ply(path)))
            else:
                raise ProgdfError(f"{path.name} is neither a scene nor an edit; drop a .ply or a .gdf file")
        except ProgdfError as error:
            self.stage.tell(str(error), error=True)
        except OSError as error:
            self.stage.tell(f"{path} cannot be read: {error.strerror}", error=True)

    def _add_edit(self, gdf: Gdf) -> None:
        """On top, at full strength, so that one sees what came; undo takes it off again."""
        layer = LayerState(len(self.document.gdfs), gdf.name, strength=1.0)
        self._replace_engine(replace(self.document, gdfs=(*self.document.gdfs, gdf)))
        view = self.stage.work.view
        self.stage.change(replace(view, layers=(*view.layers, layer)))

    def _open_scene(self, document: Document) -> None:
        self._replace_engine(document)
        self.stage.restart(replace(self.stage.work.view, camera=first_camera(document.scene), layers=()))
        self.window.rename(_window_title(document.title))

    def _replace_engine(self, document: Document) -> None:
        engine = Engine(self.context, document.scene, document.gdfs)
        self.engine.release()
        self.document, self.engine = document, engine
        self.stage.serve(engine, document.facts())


def _window_title(name: str) -> str:
    return f"{name} – ProGDF Studio"
