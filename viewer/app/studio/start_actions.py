"""What the start page needs of the application: pictures of recent files, and the demo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import moderngl

from progdf.demo_scenes import SKY
from progdf.errors import ProgdfError
from progdf.io.atomic import state_folder
from viewer.app.application import failure_line
from viewer.files import small_pictures
from viewer.gl.present import picture_texture
from viewer.jobs.delivery import Deliveries
from viewer.pictures.film import to_pixels
from viewer.render.engine import ViewEngine
from viewer.state import history
from viewer.state.view_state import Comparison, ViewState

from .start_page import RecentFile
from .training_actions import StudioApplication

POLL_S = 0.5


class StartActions:
    """Recent files with their pictures, and the demo, whose edits come one by one.

    Args:
        app: the window
        context: the GL context
        deliveries: runs the demo's command
        memory: folder of the program's state; the user's own if None
    """

    def __init__(
        self,
        app: StudioApplication,
        context: moderngl.Context,
        deliveries: Deliveries,
        memory: Path | None = None,
    ) -> None:
        self._app, self._context, self._deliveries = app, context, deliveries
        self._memory = memory
        self._textures: dict[Path, moderngl.Texture | None] = {}
        self._demo: Path | None = None  # its folder while it is being made
        self._added: set[Path] = set()  # edits of it that are open

    def handle(self, request: str) -> bool:
        """Do what is asked for; False where it is nothing of ours."""
        if request != "demo":
            return False
        if error := failure_line(self._start_demo):
            self._app.main_view.show_message(error, error=True)
        return True

    def poll(self) -> float | None:
        """Open what of the demo is ready; seconds until the next look, None for ever."""
        self._publish()
        if self._demo is None:
            return None
        scene = self._demo / "scene.ply"
        own = self._app.document.path
        if own is not None and own.resolve() != scene.resolve():
            self._demo = None  # the person went on to something else
            return None
        if own is None and scene.is_file():
            self._app.open(scene)
            main_view = self._app.main_view
            view = replace(main_view.work.view, background=SKY)
            main_view.work = replace(main_view.work, view=view, past=history.begin(view))
        edits = sorted(self._demo.glob("*/*.gdf"), key=lambda path: path.stat().st_mtime)
        for path in edits if self._app.document.path is not None else ():
            if path not in self._added:
                self._added.add(path)
                self._app.open(path)
        if not self._deliveries.busy:
            self._demo = None
        return POLL_S

    def keep_picture(self, engine: ViewEngine, view: ViewState, *paths: Path | None) -> None:
        """A small picture of what is on screen, for the next time that the page shows these files."""
        known = [path for path in paths if path is not None]
        if not known:
            return
        try:
            seen = ViewState(view.camera, view.layers, view.blend, view.background, compare=Comparison())
            pixels = to_pixels(engine.image(seen, small_pictures.SIZE))
        except ProgdfError:
            return
        for path in known:
            small_pictures.keep(path, pixels, self._memory)

    def close(self) -> None:
        """Give back the pictures."""
        for texture in self._textures.values():
            if texture is not None:
                texture.release()
        self._textures.clear()

    def _start_demo(self) -> None:
        folder = (self._memory or state_folder()) / "demo"
        self._demo, self._added = folder, set()
        words = ["demo", "--quick", "--no-window", f"--out={folder}"]
        try:
            self._deliveries.start("Demo: four edits", folder, words, folder / "scene.ply")
        except OSError as error:
            raise ProgdfError(f"the demo cannot start: {error.strerror or error}") from error
        self._app.main_view.show_message("Making the demo's scene …")

    def _publish(self) -> None:
        """Recent files as the page shows them, while it is shown."""
        main_view = self._app.main_view
        if not main_view.at_start:
            return
        shown = tuple(RecentFile(path, self._texture(path)) for path in main_view.recent)
        if shown != main_view.recent_files:
            main_view.recent_files = shown
            main_view.wake()

    def _texture(self, path: Path) -> int:
        if path not in self._textures:
            self._textures[path] = None
            pixels = small_pictures.load(path, self._memory)
            if pixels is not None:
                self._textures[path] = picture_texture(self._context, pixels)
        texture = self._textures[path]
        return int(texture.glo) if texture is not None else 0
