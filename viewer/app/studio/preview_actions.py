"""The editor's own picture over the view while the form of a new edit is open."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import moderngl
import numpy as np

from progdf.errors import ProgdfError
from viewer.app.application import Application
from viewer.app.studio.cover import Cover
from viewer.camera.view_camera import ViewCamera, to_camera
from viewer.jobs.new_edit import EDITORS, NewEdit
from viewer.jobs.preview_child import PreviewChild, PreviewPicture

LONGEST_SIDE = 960
"""Pixels of a picture; larger windows show it enlarged."""
REST_S, POLL_S = 0.12, 0.04
"""The camera rests so long before a picture is asked for; between two looks for it."""
KEPT_S = 120.0
"""So long the child waits for the form to be opened again."""


_Wanted = tuple[str, str, float, ViewCamera, tuple[int, int], tuple[float, float, float]]


class PreviewActions:
    """Asks the child for pictures and shows them. `close` it with the window.

    Args:
        app: the window
        context: the GL context
        region: a form's region as `progdf train` has it; files that it needs go into the folder
    """

    def __init__(
        self,
        app: Application,
        context: moderngl.Context,
        region: Callable[[NewEdit, Path], str],
    ) -> None:
        self._app, self._context, self._region = app, context, region
        self._child: PreviewChild | None = None
        self._texture: moderngl.Texture | None = None
        self._asked: _Wanted | None = None
        self._number, self._outstanding = 0, False
        self._seen: _Wanted | None = None  # what was wanted at the last look
        self._seen_at = 0.0
        self._used_at = 0.0
        self._broken = False  # it cannot be started, or has ended by itself

    def poll(self) -> float | None:
        """Ask for what is wanted and show what has come; seconds until the next look, None for ever."""
        now = time.monotonic()
        scene = self._app.document.path
        wanted = self._wanted()
        if wanted is None or scene is None:
            self._show("", None)
            self._broken = False
            if self._child is not None and now - self._used_at > KEPT_S:
                self._end()
            return KEPT_S if self._child is not None else None
        self._used_at = now
        if self._broken:
            return None
        if self._child is None:
            try:
                self._child = PreviewChild(scene)
            except OSError as error:
                self._broken = True
                self._show(f"No preview: {error.strerror or error}", None, failed=True)
                return None
        self._take()
        if self._broken:
            return None
        if wanted != self._seen:
            same_place = self._seen is not None and wanted[3:] == self._seen[3:]
            self._seen, self._seen_at = wanted, now - REST_S if same_place else now
        if wanted != self._asked and now - self._seen_at >= REST_S:
            self._ask(wanted)
        return POLL_S if self._outstanding or wanted != self._asked else None

    def leave_scene(self) -> None:
        """The child is for a scene that is not open any more."""
        self._end()
        self._broken = False

    def close(self) -> None:
        """End the child."""
        self._end()
        if self._texture is not None:
            self._texture.release()
            self._texture = None

    def _wanted(self) -> _Wanted | None:
        """What the picture depends on; None where none is wanted."""
        main_view = self._app.main_view
        work = main_view.work
        form = work.form
        shown = work.form_open and work.view.panel and form.preview and form.choice.pictured
        if not shown or form.obstacle:
            return None
        place = f"{form.region}|{form.typed_region}|{hash(work.view.selection.members)}"
        size = main_view.picture_size
        return place, form.spec, round(form.strength, 2), work.view.camera, size, work.view.background

    def _ask(self, wanted: _Wanted) -> None:
        assert self._child is not None
        self._asked = wanted
        _, editor, strength, camera, (width, height), background = wanted
        scale = min(1.0, LONGEST_SIDE / max(width, height))
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        try:
            region = self._region(self._app.main_view.work.form, self._child.folder)
        except (ProgdfError, OSError) as error:
            self._outstanding = False
            self._show(" ".join(str(error).split()), None, failed=True)
            return
        self._number = self._child.ask(region, editor, strength, to_camera(camera, *size), background)
        self._outstanding = True
        shown = self._app.main_view.cover
        in_place = shown is not None and (shown.camera, shown.size) == wanted[3:5]
        self._show("" if in_place else "Drawing …", shown)

    def _take(self) -> None:
        """What the child has answered."""
        assert self._child is not None
        answer = self._child.take()
        if answer is None:
            return
        if answer.number == self._number or answer.number < 0:
            self._outstanding = False
        if answer.pixels is None:
            if answer.number < 0:
                self._broken = True
                self._end()
            self._show(answer.error, None, failed=True)
        elif self._asked is not None and answer.number == self._number:
            _, editor, strength, camera, size, _ = self._asked
            kind = editor.partition(":")[0]
            title = next(choice.title for choice in EDITORS if choice.kind == kind)
            name = f"Preview: {title} at {strength:.2f}"
            self._show("", Cover(self._upload(answer), camera, size, name))
            self._app.main_view.wake()

    def _upload(self, answer: PreviewPicture) -> int:
        assert answer.pixels is not None
        height, width = answer.pixels.shape[:2]
        if self._texture is None or self._texture.size != (width, height):
            if self._texture is not None:
                self._texture.release()
            self._texture = self._context.texture((width, height), 3, alignment=1)
            self._texture.filter = moderngl.LINEAR, moderngl.LINEAR
        self._texture.write(np.ascontiguousarray(answer.pixels).tobytes(), alignment=1)
        return int(self._texture.glo)

    def _show(self, said: str, cover: Cover | None, failed: bool = False) -> None:
        """The cover, and what the form says of it."""
        main_view = self._app.main_view
        if (main_view.cover, main_view.preview_said) != (cover, (said, failed)):
            main_view.cover, main_view.preview_said = cover, (said, failed)
            main_view.wake()

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None
        self._asked, self._seen, self._outstanding = None, None, False
