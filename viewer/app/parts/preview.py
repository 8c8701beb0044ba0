"""Live preview of a new edit while its form is open, computed by a `progdf preview` process.

A grade that one color map reproduces is a live layer on top of the stack. Other editors show their own
picture over the view.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.atomic import make_folder
from progdf.io.images import open_picture
from progdf.io.picture_camera import find_picture_camera
from progdf.system.desktop import open_in_program
from viewer.app.grading import GradePreview
from viewer.app.messages import Messages, Requests, error_line
from viewer.camera.view_camera import ViewCamera, from_camera, to_camera
from viewer.files import region_files, user_files
from viewer.files.document import DocumentStore
from viewer.files.scenes import OwnScene
from viewer.jobs import consent, training
from viewer.jobs.preview_process import Preview, PreviewChild, PreviewInputs
from viewer.render.engine import ViewEngine
from viewer.state.commands import Plain
from viewer.state.forms import (
    EDITORS,
    LOOK_PX,
    NO_CHANGE,
    SHEET_COLUMNS,
    SHEET_PX,
    STYLE_ORDER,
    NewEdit,
    with_picture,
)
from viewer.state.transient import Cover, PreviewGhost, PreviewState
from viewer.state.view_state import LayerState
from viewer.state.workspace import Dialog, Store, with_camera, with_transient
from viewer.ui.window import wake_window

LONGEST_SIDE = 960
"""Longest side of a preview, in pixels; larger windows show it enlarged."""
CAMERA_SETTLE_S = 0.12
"""Time without camera motion before a preview is requested, in seconds."""
POLL_S = 0.04
"""Interval at which the answer is polled, in seconds."""
WATCH_S = 0.5
"""Interval at which a picture open in another program is checked, in seconds."""
_ANCHORED = ("instruct:", "api:", "comfy:", "command:")  # editors that paint this view if asked
PAINT_TEXT = "Paint in the other program and save. The saved picture appears here."
IDLE_TIMEOUT_S = 120.0
"""Time without an open form after which the preview process ends, in seconds."""


@dataclass(frozen=True)
class PreviewedView:
    """Picture of a view that is open in another program."""

    path: Path
    camera: ViewCamera  # camera of the view
    view_size: tuple[int, int]  # size of the view on screen, pixels
    size: tuple[int, int]  # size of the picture, pixels; a preview's is limited by `LONGEST_SIDE`
    state: tuple[int, int]  # state of the file at the last check, see `_file_state`


def _file_state(path: Path) -> tuple[int, int]:
    """Return the file's modification time in ns and its size in bytes; (0, 0) if it does not exist."""
    try:
        state = path.stat()
    except OSError:
        return 0, 0
    return state.st_mtime_ns, state.st_size


def is_allowed_form(form: NewEdit) -> bool:
    """Return True if the user has allowed the form's program or server."""
    return consent.is_allowed(consent.outside_action(form.spec, form.url))


class PreviewActions:
    """Requests to the preview process for the form, and the display of its answers. `close` it with the
    window.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        context: the GL context
        picture_size: returns width and height of the picture on screen, in pixels
        save_edited: writes the picture on screen with its visible layers into a folder; returns its path
        engine: returns the engine that draws the window
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        context: moderngl.Context,
        picture_size: Callable[[], tuple[int, int]],
        save_edited: Callable[[Path, str], Path],
        engine: Callable[[], ViewEngine],
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._context = context
        self._picture_size = picture_size
        self._save_edited = save_edited
        self._grading = GradePreview(
            store=store, documents=documents, messages=messages, context=context, engine=engine
        )
        self._child: PreviewChild | None = None
        self._texture: moderngl.Texture | None = None
        self._sent: PreviewInputs | None = None
        self._number = 0  # number of the sent request
        self._view_number = 0  # number of the last request for the view itself
        self._outstanding = False  # no answer to it yet
        self._seen: PreviewInputs | None = None  # request at the last poll
        self._seen_at = self._used_at = 0.0
        self._broken = False  # the process cannot be started, or has ended
        self._grade: tuple[PreviewInputs, Gdf, Path] | None = None  # live grade: request, edit, file
        self._pose: tuple[int, ViewCamera, tuple[int, int]] | None = None  # `asks`, camera, size
        self._painted: tuple[PreviewInputs, NDArray[np.uint8]] | None = None  # a sentence's picture
        self._child_scene = Path()  # scene of the process
        self._sent_at = 0.0
        self._palette_of = ""  # region of the form's palette
        self._looks_of: ViewCamera | None = None  # view of the looks' thumbnails
        self._sheet: moderngl.Texture | None = None  # thumbnails in every style
        self._sheet_of: PreviewInputs | None = None  # the painted view
        self._tiles: frozenset[int] = frozenset()  # styles painted in this view
        self._drawn: frozenset[int] = frozenset()  # styles in the sheet, also of an earlier view
        self._tile = -1  # the requested style
        self._region_sent = ""  # region in the process's format
        self._painting: PreviewedView | None = None
        self._behind: Cover | None = None  # picture of a continued edit, until the view moves
        self._ghosts: dict[Path, moderngl.Texture] = {}  # pictures of previews in training, by run

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about previews, by name."""
        return {"paint_view": self._paint_view, "test_editor": self._test_editor, **self._grading.requests}

    def poll(self) -> float | None:
        """Request the preview and show an answer; return the seconds until the next poll, None for never."""
        self._free_ghosts()
        self._grading.update()
        if self._painting is not None and self._is_painting(self._painting):
            self._end_live()
            return self._follow(self._painting)
        now = time.monotonic()
        scene = self._scene()
        request = self._request()
        if request is None or scene is None:
            if self._behind is not None and self._behind.camera != self._store.get().view.camera:
                self._behind = None
            self._show("", self._behind)
            self._end_live()
            self._broken = False
            if self._child is not None and now - self._used_at > IDLE_TIMEOUT_S:
                self._end()
            return IDLE_TIMEOUT_S if self._child is not None else None
        self._used_at = now
        if self._child is None and not self._broken:
            try:
                self._child = PreviewChild(scene, wake_window)
                self._child_scene = scene
            except OSError as error:
                self._broken = True
                self._show(f"No preview: {error.strerror or error}", None, failed=True)
        if self._child is not None:
            self._take(self._child, request)
        if self._outstanding and request.editor.startswith(_ANCHORED) and request.seed >= 0:
            self._show(f"Painting … {now - self._sent_at:.0f} s", self._store.get().transient.cover)
        self._show_live()
        if self._child is None or self._broken:
            return None
        grade_matches = self._grade is not None and request.of_all_views == self._grade[0].of_all_views
        if grade_matches and not self._outstanding:
            self._sent = self._seen = request  # one grade serves every strength and view
        if request != self._seen:
            moved = (
                self._seen is None
                or request.camera != self._seen.camera
                or request.size != self._seen.size
                or request.editor.startswith("grade:")  # the engine shows it meanwhile
            )
            self._seen = request
            self._seen_at = now if moved else now - CAMERA_SETTLE_S
        # One request at a time. Changes in the meantime are requested next, and every answer is shown.
        if request != self._sent and not self._outstanding and now - self._seen_at >= CAMERA_SETTLE_S:
            self._send(request, self._child)
        elif request == self._sent and not self._outstanding and request.editor.startswith("style:"):
            self._ask_painting(request, self._child)
        return POLL_S if self._outstanding or request != self._sent else None

    def _test_editor(self, _: None) -> None:
        """Let the form's program or server edit this view; ask first if the user has not allowed it yet."""
        work = self._store.get()
        form = work.form
        action = consent.outside_action(form.spec, form.url)
        if form.obstacle:
            return
        if not consent.is_allowed(action):
            self._messages.ask(Dialog("allow", action, then=Plain("test_editor")))
            return
        user_files.keep_outside(form.outside)
        self._store.replace(replace(work, form=replace(form, asks=form.asks + 1, anchor="")))
        self._store.wake()

    def _paint_view(self, _: None) -> None:
        """Save a picture of this view, open it in another program and add it to the form.

        Raises:
            ProgdfError: the scene or a visible edit has no file, or the picture cannot be written.
        """
        scene = self._documents.get().file
        self._end_live()
        camera = self._store.get().view.camera
        size = self._picture_size()
        folder = training.edits_folder(scene)
        make_folder(folder)
        path = self._save_edited(folder, scene.stem)
        form = with_picture(self._store.get().form, path, further=False)
        self._store.replace(replace(self._store.get(), form=form, form_open=True))
        self._open_painter(PreviewedView(path, camera, size, size, _file_state(path)), None)

    def follow_anchor(self, path: Path) -> None:
        """Open a sentence's picture, written at `path`, in another program and show the saved result."""
        if self._pose is not None and self._painted is not None:
            height, width = self._painted[1].shape[:2]
            _, camera, view_size = self._pose
            picture = PreviewedView(path, camera, view_size, (width, height), _file_state(path))
            self._open_painter(picture, self._store.get().transient.cover)

    def look_behind(self, path: Path) -> None:
        """Turn the view to the camera of a picture, and show the picture there until the view moves.

        Raises:
            ProgdfError: the picture cannot be read, or has no camera.
        """
        document = self._documents.get()
        camera = find_picture_camera(path, origin=document.scene.origin)
        picture = open_picture(path).convert("RGB")
        work = self._store.get()
        width, height = size = self._picture_size()
        shown = round(picture.height * width / height), picture.height
        whole = Image.new("RGB", shown, "white")
        whole.paste(picture, ((shown[0] - picture.width) // 2, 0))
        view_camera = from_camera(work.view.camera, camera, document.bounds)
        self._behind = Cover(self._upload(np.asarray(whole)), view_camera, size, "Continued all around")
        self._store.replace(with_camera(replace(work, form_open=False), view_camera))
        self._show("", self._behind)

    def _open_painter(self, picture: PreviewedView, cover: Cover | None) -> None:
        self._painting = picture
        self._show(PAINT_TEXT, cover)
        if not open_in_program(picture.path):
            self._messages.show(f"No program for pictures was found. Open {picture.path} in yours.")

    def _is_painting(self, painted: PreviewedView) -> bool:
        """Return whether the form uses the picture that is being painted."""
        work = self._store.get()
        path = str(painted.path)
        is_in_form = path in work.form.pictures.split(", ") or path == work.form.anchor
        return work.form_open and work.view.panel and is_in_form

    def _follow(self, painted: PreviewedView) -> float:
        """Show the saved picture over the view; return the seconds until the next check."""
        state = _file_state(painted.path)
        if state == painted.state:
            return WATCH_S
        try:
            pixels = np.asarray(open_picture(painted.path).convert("RGB"))
        except ProgdfError:  # not completely written yet
            return WATCH_S
        self._painting = replace(painted, state=state)
        height, width = pixels.shape[:2]
        if (width, height) != painted.size:
            template = "{} has {}×{} pixels instead of {}×{}; save it at its original size"
            self._show(template.format(painted.path.name, width, height, *painted.size), None, failed=True)
        else:
            cover = Cover(self._upload(pixels), painted.camera, painted.view_size, "Painted")
            self._show("This is the saved picture. Train makes it an edit.", cover)
            self._store.wake()
        return WATCH_S

    def anchor(self, form: NewEdit) -> tuple[NDArray[np.uint8], Camera] | None:
        """Return the picture of one view that the edit of a sentence should follow, and its camera; None if
        missing."""
        request = self._request()
        if self._painted is None or request is None or request != self._painted[0] or not form.asks:
            return None
        pixels = self._painted[1]
        return pixels, to_camera(request.camera, pixels.shape[1], pixels.shape[0])

    def draft(self, form: NewEdit) -> Path | None:
        """Return the grade's file that previews the form; None if there is none."""
        request = self._request()
        if form != self._store.get().form or request is None or self._grade is None:
            return None
        return self._grade[2] if request.of_all_views == self._grade[0].of_all_views else None

    def leave_ghost(self, run: Path) -> None:
        """Keep the form's picture in its view until the edit of a run has a layer."""
        work = self._store.get()
        cover = work.transient.cover
        if cover is None or self._texture is None or cover is self._behind:
            return
        self._ghosts[run] = self._texture
        self._texture = None
        ghost = PreviewGhost(run, replace(cover, name=f"{cover.name} · {run.name} is training"))
        ghosts = (*work.transient.ghosts, ghost)
        self._store.replace(with_transient(work, cover=None, ghosts=ghosts))

    def _free_ghosts(self) -> None:
        """Free the pictures of previews that are no longer shown."""
        shown = {ghost.run for ghost in self._store.get().transient.ghosts}
        for run in self._ghosts.keys() - shown:
            self._ghosts.pop(run).release()

    def leave_scene(self) -> None:
        """End the process of the closed scene."""
        self._end()
        self._grade = None
        self._painting = None
        self._painted = None
        self._pose = None
        self._behind = None
        self._palette_of = ""
        self._grading.leave_scene()
        self._broken = False

    def close(self) -> None:
        """End the process and release the textures."""
        self._end()
        self._grading.close()
        for texture in (self._texture, self._sheet, *self._ghosts.values()):
            if texture is not None:
                texture.release()
        self._texture = self._sheet = None
        self._ghosts = {}

    def _scene(self) -> Path | None:
        """Return the file of the scene that holds the form's region; None for no preview.

        The process of another scene ends.
        """
        opened = self._documents.get()
        if opened.path is None:
            return None
        try:
            scene = self._own().path
        except ProgdfError:  # the region spans several scenes, which the form reports when it trains
            return None
        if self._child is not None and self._child_scene != scene:
            self._end()
        return scene

    def _own(self) -> OwnScene:
        work = self._store.get()
        return region_files.own_scene(work.form, self._documents.get(), work.view.selection)

    def _request(self) -> PreviewInputs | None:
        """Return the request for the form and the view; None for no preview."""
        work = self._store.get()
        size = self._picture_size()
        form = work.form
        view = work.view
        of_sentence = form.choice.has_anchor
        if form.choice.is_outside and (not form.asks or not is_allowed_form(form)):
            return None
        pictured = (form.preview and form.choice.pictured) or of_sentence
        if not (work.form_open and view.panel and pictured) or form.obstacle not in ("", NO_CHANGE):
            return None
        region = self._grading.region_key()
        shows_old_looks = "Looks" not in form.folded and self._looks_of != view.camera
        if form.choice.setting == "grade" and (self._palette_of != region or shows_old_looks):
            return PreviewInputs(region, "grade", 1.0, view.camera, size, view.background)
        if form.obstacle:
            return None
        if of_sentence:  # a diffusion model is slow: its picture keeps the view of the request
            if self._pose is None or self._pose[0] != form.asks:
                self._pose = form.asks, view.camera, size
            _, camera, size = self._pose
            seed = form.asks - 1
            return PreviewInputs(
                region,
                form.spec,
                1.0,
                camera,
                size,
                view.background,
                model=form.model_option,
                seed=seed,
                api_url=form.url,
                prompt=form.prompt,
            )
        strength = round(form.strength, 2)
        return PreviewInputs(region, form.spec, strength, view.camera, size, view.background, estimate=True)

    def _send(self, request: PreviewInputs, child: PreviewChild) -> None:
        work = self._store.get()
        self._sent, self._sent_at = request, time.monotonic()
        scale = min(1.0, LONGEST_SIDE / max(request.size))
        width, height = (max(round(side * scale), 1) for side in request.size)
        if request.editor == "grade":
            width, height = LOOK_PX
        try:
            opened = self._documents.get()
            own = self._own()
            state = own.selection(work.view.selection, len(opened.original))
            region = region_files.region_option(work.form, child.folder, state, own.count)
        except (ProgdfError, OSError) as error:
            self._outstanding = False
            self._show(error_line(error), None, failed=True)
            return
        self._number = child.ask(region, request, own.camera(to_camera(request.camera, width, height)))
        self._view_number = self._number
        self._outstanding = True
        self._region_sent = region
        cover = work.transient.cover
        in_place = cover is not None and (cover.camera, cover.size) == (request.camera, request.size)
        text = "Looking for models …" if request.seed < 0 else "Drawing …"
        self._show("" if in_place or self._grade else text, cover)

    def _ask_painting(self, request: PreviewInputs, child: PreviewChild) -> None:
        """Request the next thumbnail of the sheet: this view in one style. The form's own preview has
        priority."""
        view = replace(request, editor="", strength=1.0)
        if view != self._sheet_of:
            if self._sheet_of is None or view.region != self._sheet_of.region:
                self._drawn = frozenset()
            self._sheet_of, self._tiles = view, frozenset()
        missing = next((style for style in STYLE_ORDER if style not in self._tiles), None)
        if missing is not None:
            painted = replace(view, editor=f"style:{missing}", estimate=False)
            self._number = child.ask(
                self._region_sent, painted, self._own().camera(to_camera(view.camera, *SHEET_PX))
            )
            self._tile = missing
            self._outstanding = True

    def _take_painting(self, pixels: NDArray[np.uint8] | None) -> None:
        """Add a thumbnail to the sheet; None marks a style that failed."""
        style = self._tile
        self._tile = -1
        self._tiles |= {style}
        if pixels is None:
            return
        (width, height), index = SHEET_PX, STYLE_ORDER.index(style)
        if self._sheet is None:
            rows = -(-len(STYLE_ORDER) // SHEET_COLUMNS)
            self._sheet = self._context.texture((SHEET_COLUMNS * width, rows * height), 3, alignment=1)
        offset = index % SHEET_COLUMNS * width, index // SHEET_COLUMNS * height
        self._sheet.write(np.ascontiguousarray(pixels).tobytes(), (*offset, width, height), alignment=1)
        self._drawn |= {style}
        store = self._store
        preview = store.get().transient.preview._replace(sheet=int(self._sheet.glo), styles=self._drawn)
        store.replace(with_transient(store.get(), preview=preview))
        self._store.wake()

    def _take(self, child: PreviewChild, now: PreviewInputs) -> None:
        """Show the answers of the process."""
        while self._child is child and (answer := child.take()) is not None:
            self._show_answer(answer, now)

    def _show_answer(self, answer: Preview, now: PreviewInputs) -> None:
        """Show an answer unless the region or the editor family has changed since."""
        if answer.number in (self._number, -1):
            self._outstanding = False
        if self._tile >= 0 and answer.number == self._number:
            self._take_painting(answer.pixels)
        elif answer.error:
            if answer.number < 0:
                self._broken = True
                self._end()
            self._end_live()
            self._show(answer.error, None, failed=True, models=answer.models)
        elif self._sent is None or self._sent.kind != now.kind:
            return
        elif answer.made == "palette" and answer.sample is not None:
            self._palette_of = self._sent.region
            self._looks_of = self._sent.camera
            self._grading.take(answer.sample, answer.palette, self._palette_of)
        elif answer.made == "near":
            if answer.number == self._view_number:
                self._show(answer.note.capitalize(), self._store.get().transient.cover, near=answer.near)
        elif answer.note and answer.grade is None:
            self._show(answer.note, None, models=answer.models)
        elif answer.grade is not None:
            opened = self._documents.get()
            scene = opened.scene_at(self._child_scene)
            gdf = opened.place(load_gdf(answer.grade, opened.scene_files[scene].gaussians), scene)
            self._grade = self._sent, gdf, answer.grade
            if self._sent.kind[1] != "grade":  # remove the preview of the previous color
                self._store.replace(with_transient(self._store.get(), live=()))
            self._show(f"Live: {answer.note}", None, near=answer.near)
        elif answer.pixels is not None and self._sent.kind[1] == "grade":
            self._show("", None)  # the engine shows it
        elif answer.pixels is not None:
            kind, _, argument = self._sent.editor.partition(":")
            title = next(choice.title for choice in EDITORS if choice.kind == kind)
            self._end_live()
            name = f"Preview: {title} at {self._sent.strength:.2f}"
            text = ""
            self._painted = None
            if self._sent.editor.startswith(_ANCHORED):
                argument = argument if kind in ("instruct", "api") else title
                name = f"Anchor: {argument}"
                text = "Training follows this picture; no estimate for prompts"
                if answer.follows:
                    self._painted = self._sent, answer.pixels
                else:
                    name = f"Example: {argument}"
                    text = "Example only, as this model follows no picture; no estimate for prompts"
                if kind == "command":
                    text = "Example: training runs the program on each view by itself"
            texture = self._upload(answer.pixels)
            self._show(text, Cover(texture, self._sent.camera, self._sent.size, name))
            self._store.wake()

    def _show_live(self) -> None:
        """Show the grade as a layer on top, at the form's strength."""
        if self._grade is None or self._store.get().form.choice.setting == "grade":
            return
        document = self._documents.get()
        layers = self._store.get().view.layers
        name = self._store.get().form.layer_name
        solo = any(layer.solo for layer in layers)
        strength = self._store.get().form.strength
        live = (LayerState(len(document.gdfs), name, strength, solo=solo),)
        shown = self._store.get().transient.live
        if not shown:
            self._documents.replace(document, (self._grade[1],), live)
        elif shown != live:
            self._store.replace(with_transient(self._store.get(), live=live))
            self._store.wake()

    def _end_live(self) -> None:
        if self._grade is not None and self._store.get().transient.live:
            self._documents.replace(self._documents.get())
        self._grade = None

    def _upload(self, pixels: NDArray[np.uint8]) -> int:
        """Write a picture to the texture of the cover, and return its GL name. Earlier covers end."""
        self._behind = None
        size = pixels.shape[1], pixels.shape[0]
        if self._texture is None or self._texture.size != size:
            if self._texture is not None:
                self._texture.release()
            self._texture = self._context.texture(size, 3, alignment=1)
            self._texture.filter = moderngl.LINEAR, moderngl.LINEAR
        self._texture.write(np.ascontiguousarray(pixels).tobytes(), alignment=1)
        return int(self._texture.glo)

    def _show(
        self,
        text: str,
        cover: Cover | None,
        failed: bool = False,
        models: tuple[str, ...] | None = None,
        near: str = "",
    ) -> None:
        """Set the picture over the view and the preview's state in the form."""
        work = self._store.get()
        available_models = work.transient.preview.models if models is None else models
        request = self._request()
        painted = self._painted is not None and self._painted[0] == request
        busy = self._outstanding and request is not None  # answers for an earlier form keep nobody waiting
        sheet = 0 if self._sheet is None else int(self._sheet.glo)
        state = PreviewState(text, failed, busy, painted, available_models, sheet, self._drawn, near)
        if (work.transient.cover, work.transient.preview) != (cover, state):
            self._store.replace(with_transient(work, cover=cover, preview=state))
            self._store.wake()

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None
        self._sent = None
        self._seen = None
        self._outstanding = False
        self._tile = -1
