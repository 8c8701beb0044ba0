"""Which way is up: asked of a scene that does not tell clearly, and remembered when a person chooses it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import moderngl
import torch

from progdf.scene import known_ups
from progdf.scene.up_axis import direction_name
from viewer.camera.view_camera import Vec3, first_camera
from viewer.gl.present import picture_texture
from viewer.pictures.film import to_pixels
from viewer.render.engine import ViewEngine
from viewer.state import workspace
from viewer.state.view_state import ViewState

from .training_actions import StudioApplication
from .up_strip import SIZE, UpChoice, UpStrip

MOST = 4
"""Directions that are offered, the likeliest first."""


class UpActions:
    """Asks, draws the pictures one by one, and remembers the answer. `close` it with the window.

    Args:
        app: the window
        context: the GL context
    """

    def __init__(self, app: StudioApplication, context: moderngl.Context) -> None:
        self._app, self._context = app, context
        self._textures: list[moderngl.Texture] = []
        self._looked = False  # at the scene
        self._path: Path | None = None  # its file
        self._up: Vec3 | None = None  # and what a person had set as up at the last look

    def handle(self, request: str) -> bool:
        """Do what is asked for; False where it is nothing of ours."""
        name, _, index = request.partition(":")
        strip, main_view = self._app.main_view.up_strip, self._app.main_view
        if name not in ("set_up", "keep_up"):
            return False
        before = main_view.work.view.camera
        if strip is not None and name == "set_up":
            home = strip.choices[int(index)].camera
            view = replace(main_view.work.view, camera=replace(home, mode=before.mode))
            work = workspace.record_undo(replace(main_view.work, home=home, view=view))
            main_view.work = workspace.glide_from(work, before)
            self._answer(home.up)
        elif strip is not None:
            self._answer(before.up)
        return True

    def poll(self, session: Path | None, engine: ViewEngine) -> float | None:
        """Ask where a scene was opened that does not tell, and remember what is chosen, in the panel too.

        Returns:
            Seconds until the next look, None for ever.

        Args:
            session: that is open, which knows
            engine: draws the pictures
        """
        main_view, document = self._app.main_view, self._app.document
        # what a person sets, also by undo; not where a film, a picture or a snapshot leads the camera
        up, before = main_view.work.past.present.look.up, self._up
        self._up = up
        if not self._looked:
            self._looked, self._path = True, document.path
            if document.path is None or session is not None:
                return None
            found = document.found_up
            if found.certain or up != found.direction:
                return None  # it tells, or somebody said
            main_view.up_strip = self._question()
        elif up != before:
            self._answer(up)  # as the panel was told
            return None
        strip = main_view.up_strip
        if strip is None:
            return None
        missing = next((i for i, choice in enumerate(strip.choices) if not choice.texture), None)
        if missing is None:
            return None
        choices = [*strip.choices]
        choices[missing] = replace(choices[missing], texture=self._draw(choices[missing], engine))
        main_view.up_strip = replace(strip, choices=tuple(choices))
        main_view.wake()
        return 0.0

    def _answer(self, up: Vec3) -> None:
        if self._path is not None:
            known_ups.remember(self._app.document.scene, up)
            self._up = up
        self.close()
        self._app.main_view.wake()

    def leave_scene(self) -> None:
        """There is another scene to ask about."""
        self.close()
        self._looked = False

    def close(self) -> None:
        """No question any more."""
        self._app.main_view.up_strip = None
        for texture in self._textures:
            texture.release()
        self._textures.clear()

    def _question(self) -> UpStrip:
        scene, camera = self._app.document.scene, self._app.main_view.work.view.camera
        ups = self._app.document.found_up.candidates
        names = [direction_name(torch.tensor(up)).upper().replace("-", "−") for up in ups]
        choices = tuple(
            UpChoice(name, first_camera(scene, aspect=SIZE[0] / SIZE[1], fov_y=camera.fov_y, up=up))
            for name, up in zip(names[:MOST], ups[:MOST], strict=True)
        )
        return UpStrip(
            choices, next((choice.name for choice in choices if choice.camera.up == camera.up), "")
        )

    def _draw(self, choice: UpChoice, engine: ViewEngine) -> int:
        background = self._app.main_view.work.view.background
        pixels = to_pixels(engine.image(ViewState(choice.camera, background=background), SIZE))
        texture = picture_texture(self._context, pixels)
        self._textures.append(texture)
        return int(texture.glo)
