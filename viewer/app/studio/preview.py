"""What a new edit will be while its form is open, made by `progdf preview`: a live layer on top of the stack
where one map of color carries it, else the editor's own picture over the view.
"""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import moderngl
import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError, without_commands
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.atomic import make_folder
from progdf.io.cameras import save_cameras
from progdf.io.json_values import convert_json, decode_json, plain
from viewer.app.application import Application, Requests, error_line
from viewer.camera.view_camera import Vec3, ViewCamera, to_camera
from viewer.files import user_files
from viewer.jobs import training
from viewer.jobs.child import Child
from viewer.jobs.training import EDITORS, SHEET_COLUMNS, SHEET_PX, STILL, STYLE_ORDER, NewEdit
from viewer.state.view_state import LayerState
from viewer.state.workspace import PreviewState
from viewer.ui.window import wake_window

from .pages import Cover

LONGEST_SIDE = 960
"""Pixels of a picture; larger windows show it enlarged."""
REST_S = 0.12
POLL_S = 0.04
"""The camera rests so long before a picture is asked for; between two looks for it."""
WATCH_S = 0.5
"""Between two looks at a picture that another program changes."""
PAINT_TEXT = "Paint in the program that opens, and save: what you saved is shown here"
KEPT_S = 120.0
"""So long the child waits for the form to be opened again."""


@dataclass(frozen=True)
class _Request:
    """What a picture depends on."""

    region: str
    editor: str
    strength: float
    camera: ViewCamera
    size: tuple[int, int]  # of the view, pixels
    background: Vec3
    model: str = ""  # of a sentence
    seed: int = 0  # the same; -1 asks what would paint, for no picture

    @property
    def of_all_views(self) -> tuple[str, str]:
        """What a grade depends on."""
        return self.region, self.editor

    @property
    def kind(self) -> tuple[str, str]:
        """What a hand does not change by the way, as it does a slider or the camera."""
        return self.region, self.editor.partition(":")[0]


@dataclass(frozen=True)
class Preview:
    """What came of a request: a picture, the file of a grade, a palette or a note, or why there is none."""

    number: int  # -1: the child has ended, or what it wrote cannot be read
    pixels: Any = None  # the picture. [H,W,3] uint8
    grade: Path | None = None
    error: str = ""
    made: Literal["picture", "grade", "note", "palette"] = "picture"
    note: str = ""  # what would paint a sentence
    models: tuple[str, ...] = ()  # that are on this machine
    follows: bool = False  # whether the edit of a sentence can follow this picture
    palette: tuple[str, ...] = ()  # the region's main colors, #rrggbb


class PreviewChild:
    """One child for one scene; the latest request wins. `close` it.

    Args:
        scene: its file

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, scene: Path) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-preview-")
        self._numbers = itertools.count(1)
        self._answers: deque[str] = deque()
        self._child = Child(["preview", str(scene)], self.folder / "log.txt", talks=True)
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def folder(self) -> Path:
        """Where its pictures go, and files that its requests name."""
        return Path(self._folder.name)

    def ask(self, region: str, request: _Request, camera: Camera) -> int:
        """Ask for a grade or a picture; its number."""
        number = next(self._numbers)
        values = plain(request) | {"number": number, "out": str(self._picture(number)), "region": region}
        values |= {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
        values |= {"width": camera.width, "height": camera.height}
        self._child.send(msgspec.json.encode(values).decode())
        return number

    def take(self) -> Preview | None:
        """The last answer since the last call; a child that has ended says why. Does not wait."""
        line = None
        while self._answers:
            line = self._answers.popleft()
        if line is None:
            ended = self._child.status is not None
            return (
                Preview(-1, error=without_commands(self._child.error()) or "the preview ended")
                if ended
                else None
            )
        try:
            answer = convert_json(decode_json(line), Preview)
            if answer.error or answer.made in ("note", "palette"):
                return replace(answer, error=without_commands(answer.error))
            if answer.made == "grade":
                return replace(answer, grade=self._picture(answer.number).with_suffix(".gdf"))
            with Image.open(self._picture(answer.number)) as picture:
                return replace(answer, pixels=np.asarray(picture.convert("RGB")))
        except (OSError, ValueError) as error:
            return Preview(-1, error=f"the preview cannot be read: {error}")

    def close(self) -> None:
        """End it."""
        self._child.kill()  # it keeps nothing
        self._child.close()
        with contextlib.suppress(OSError):
            self._folder.cleanup()

    def _picture(self, number: int) -> Path:
        return self.folder / f"{number % 8}.png"

    def _listen(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in self._child.output:
                self._answers.append(line.decode("utf-8", "replace"))
                wake_window()


@dataclass(frozen=True)
class PaintedView:
    """A picture of a view that another program changes."""

    path: Path
    camera: ViewCamera  # of the view
    size: tuple[int, int]  # pixels
    state: tuple[int, int]  # of the file when it was last looked at, see `_file_state`


def _file_state(path: Path) -> tuple[int, int]:
    """When it was written, and its size in bytes; (0, 0) where it is not there."""
    try:
        state = path.stat()
    except OSError:
        return 0, 0
    return state.st_mtime_ns, state.st_size


class PreviewActions:
    """Asks the child for what the form says and shows it. `close` it with the window.

    Args:
        app: the window
        context: the GL context
        region: a form's region as `progdf train` has it; files that it needs go into the folder
    """

    def __init__(
        self, app: Application, context: moderngl.Context, region: Callable[[NewEdit, Path], str]
    ) -> None:
        self._app = app
        self._context = context
        self._region = region
        self._child: PreviewChild | None = None
        self._texture: moderngl.Texture | None = None
        self._sent: _Request | None = None
        # of what was sent, and whether there is no answer yet
        self._number = 0
        self._outstanding = False
        self._seen: _Request | None = None  # at the last look
        self._seen_at = self._used_at = 0.0
        self._broken = False  # it cannot be started, or has ended by itself
        self._grade: tuple[_Request, Gdf, Path] | None = None  # of the live layer, and what it was made for
        self._pose: tuple[int, ViewCamera, tuple[int, int]] | None = None  # of which a sentence's picture is
        self._painted: tuple[_Request, NDArray[np.uint8]] | None = None  # that picture
        self._sent_at = 0.0
        self._palette_of = ""  # the region whose colors the form has
        self._sheet: moderngl.Texture | None = None  # of paintings
        self._sheet_of: _Request | None = None  # the view that is painted
        self._tiles: frozenset[int] = frozenset()  # styles that it was painted in already
        self._drawn: frozenset[int] = frozenset()  # those in the sheet, also of another view
        self._tile = -1  # the style that is asked for
        self._region_sent = ""  # the region, as the child knows it
        self._painting: PaintedView | None = None

    @property
    def requests(self) -> Requests:
        """What there is to ask of it."""
        return {"paint_view": self._paint_view}

    def poll(self) -> float | None:
        """Ask for the preview and show what has come; seconds until the next look, None for ever."""
        if self._painting is not None and self._is_painting(self._painting):
            self._end_live()
            return self._follow(self._painting)
        now = time.monotonic()
        scene = self._app.document.path
        request = self._request()
        if request is None or scene is None:
            self._show("", None)
            self._end_live()
            self._broken = False
            if self._child is not None and now - self._used_at > KEPT_S:
                self._end()
            return KEPT_S if self._child is not None else None
        self._used_at = now
        if self._child is None and not self._broken:
            try:
                self._child = PreviewChild(scene)
            except OSError as error:
                self._broken = True
                self._show(f"No preview: {error.strerror or error}", None, failed=True)
        if self._child is not None:
            self._take(self._child, request)
        if self._outstanding and request.editor.startswith("instruct:") and request.seed >= 0:
            self._show(f"Painting … {now - self._sent_at:.0f} s", self._app.main_view.cover)
        self._show_live()
        if self._child is None or self._broken:
            return None
        made = self._grade is not None and request.of_all_views == self._grade[0].of_all_views
        if made and not self._outstanding:
            self._sent = self._seen = request  # one grade is for every strength and view
        if request != self._seen:
            moved = (
                self._seen is None or request.camera != self._seen.camera or request.size != self._seen.size
            )
            self._seen = request
            self._seen_at = now if moved else now - REST_S
        # one at a time: what moves on while it is made is asked for next, and each answer is shown
        if request != self._sent and not self._outstanding and now - self._seen_at >= REST_S:
            self._send(request, self._child)
        elif request == self._sent and not self._outstanding and request.editor.startswith("style:"):
            self._ask_painting(request, self._child)
        return POLL_S if self._outstanding or request != self._sent else None

    def _paint_view(self, _: str) -> None:
        """A picture of this view of the original goes to another program, and into the form.

        Raises:
            ProgdfError: the scene has no file, or the picture cannot be written.
        """
        main_view = self._app.main_view
        scene = self._app.document.file
        self._end_live()
        camera = main_view.work.view.camera
        size = main_view.picture_size
        folder = training.edits_folder(scene)
        make_folder(folder)
        path = main_view.canvas.save_original(folder, scene.stem, main_view.work.view, size)
        beside = path.with_name(f"{path.stem}.camera.json")  # a program may drop what the picture carries
        save_cameras(beside, [to_camera(camera, *size)], self._app.document.scene.origin)
        form = training.with_picture(main_view.work.form, path, further=False)
        main_view.work = replace(main_view.work, form=form, form_open=True)
        self._open_painter(path, camera, size, None)

    def follow_anchor(self, path: Path) -> None:
        """A sentence's picture, written at `path`, goes to another program; what is saved of it is shown."""
        if self._pose is not None and self._painted is not None:
            height, width = self._painted[1].shape[:2]
            self._open_painter(path, self._pose[1], (width, height), self._app.main_view.cover)

    def _open_painter(
        self, path: Path, camera: ViewCamera, size: tuple[int, int], cover: Cover | None
    ) -> None:
        self._painting = PaintedView(path, camera, size, _file_state(path))
        self._show(PAINT_TEXT, cover)
        if not user_files.open_in_program(path):
            self._app.main_view.show_message(
                f"No program opens pictures by itself here: open {path} in yours"
            )

    def _is_painting(self, painted: PaintedView) -> bool:
        """Whether the form is about the picture that is painted."""
        work = self._app.main_view.work
        path = str(painted.path)
        of_form = path in work.form.pictures.split(", ") or path == work.form.anchor
        return work.form_open and work.view.panel and of_form

    def _follow(self, painted: PaintedView) -> float:
        """What was saved of it lies over the view; seconds until the next look."""
        state = _file_state(painted.path)
        if state == painted.state:
            return WATCH_S
        try:
            with Image.open(painted.path) as picture:
                pixels = np.asarray(picture.convert("RGB"))
        except (OSError, SyntaxError, ValueError):  # not whole yet
            return WATCH_S
        self._painting = replace(painted, state=state)
        height, width = pixels.shape[:2]
        if (width, height) != painted.size:
            what = "{} is {}×{} pixels now, and was {}×{}; keep its size"
            self._show(what.format(painted.path.name, width, height, *painted.size), None, failed=True)
        else:
            cover = Cover(self._upload(pixels), painted.camera, painted.size, "Painted")
            self._show("This is what you saved; Train makes it an edit", cover)
            self._app.main_view.wake()
        return WATCH_S

    def anchor(self, form: NewEdit) -> tuple[NDArray[np.uint8], Camera] | None:
        """A sentence's picture of one view, and its camera, which the edit is to follow; None for none."""
        request = self._request()
        if self._painted is None or request is None or request != self._painted[0] or not form.asks:
            return None
        pixels = self._painted[1]
        return pixels, to_camera(request.camera, pixels.shape[1], pixels.shape[0])

    def draft(self, form: NewEdit) -> Path | None:
        """The file of the grade that shows what a form says; None where there is none."""
        request = self._request()
        if form != self._app.main_view.work.form or request is None or self._grade is None:
            return None
        return self._grade[2] if request.of_all_views == self._grade[0].of_all_views else None

    def leave_scene(self) -> None:
        """The child is for a scene that is not open any more."""
        self._end()
        self._grade = None
        self._painting = None
        self._palette_of = ""
        self._broken = False

    def close(self) -> None:
        """End the child."""
        self._end()
        for texture in (self._texture, self._sheet):
            if texture is not None:
                texture.release()
        self._texture = self._sheet = None

    def _request(self) -> _Request | None:
        """What the form and the view ask for; None for no picture."""
        work = self._app.main_view.work
        size = self._app.main_view.picture_size
        form = work.form
        view = work.view
        of_sentence = form.choice.setting == "sentence"
        pictured = (form.preview and form.choice.pictured) or of_sentence
        if not (work.form_open and view.panel and pictured) or form.obstacle not in ("", STILL):
            return None
        region = f"{form.region}|{form.typed_region}|{hash(view.selection.members)}"
        if form.choice.setting == "grade" and self._palette_of != region:
            return _Request(region, "grade", 1.0, ViewCamera(), size, view.background)
        if form.obstacle:
            return None
        if of_sentence:  # a picture takes its time: it is of the view in which it was asked for
            if self._pose is None or self._pose[0] != form.asks:
                self._pose = form.asks, view.camera, size
            _, camera, size = self._pose
            seed = form.asks - 1
            return _Request(region, form.spec, 1.0, camera, size, view.background, form.model, seed)
        return _Request(region, form.spec, round(form.strength, 2), view.camera, size, view.background)

    def _send(self, request: _Request, child: PreviewChild) -> None:
        self._sent, self._sent_at = request, time.monotonic()
        scale = min(1.0, LONGEST_SIDE / max(request.size))
        width, height = (max(round(side * scale), 1) for side in request.size)
        try:
            region = self._region(self._app.main_view.work.form, child.folder)
        except (ProgdfError, OSError) as error:
            self._outstanding = False
            self._show(error_line(error), None, failed=True)
            return
        self._number = child.ask(region, request, to_camera(request.camera, width, height))
        self._outstanding = True
        self._region_sent = region
        cover = self._app.main_view.cover
        in_place = cover is not None and (cover.camera, cover.size) == (request.camera, request.size)
        text = "Looking for models …" if request.seed < 0 else "Drawing …"
        self._show("" if in_place or self._grade else text, cover)

    def _ask_painting(self, request: _Request, child: PreviewChild) -> None:
        """The next of the sheet's: this view in one style, small. What the form says goes first."""
        view = replace(request, editor="", strength=1.0)
        if view != self._sheet_of:
            if self._sheet_of is None or view.region != self._sheet_of.region:
                self._drawn = frozenset()
            self._sheet_of, self._tiles = view, frozenset()
        missing = next((style for style in STYLE_ORDER if style not in self._tiles), None)
        if missing is not None:
            painted = replace(view, editor=f"style:{missing}")
            self._number = child.ask(self._region_sent, painted, to_camera(view.camera, *SHEET_PX))
            self._tile = missing
            self._outstanding = True

    def _take_painting(self, pixels: NDArray[np.uint8] | None) -> None:
        """A picture for the sheet; None where that style could not be painted."""
        style = self._tile
        self._tile = -1
        self._tiles |= {style}
        if pixels is None:
            return
        (width, height), place = SHEET_PX, STYLE_ORDER.index(style)
        if self._sheet is None:
            rows = -(-len(STYLE_ORDER) // SHEET_COLUMNS)
            self._sheet = self._context.texture((SHEET_COLUMNS * width, rows * height), 3, alignment=1)
        at = place % SHEET_COLUMNS * width, place // SHEET_COLUMNS * height
        self._sheet.write(np.ascontiguousarray(pixels).tobytes(), (*at, width, height), alignment=1)
        self._drawn |= {style}
        main_view = self._app.main_view
        main_view.preview = main_view.preview._replace(sheet=int(self._sheet.glo), styles=self._drawn)
        main_view.wake()

    def _take(self, child: PreviewChild, now: _Request) -> None:
        """What the child has answered: shown, unless region or kind of edit are others by now."""
        answer = child.take()
        if answer is None:
            return
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
        elif answer.made == "palette":
            self._palette_of = self._sent.region
            work = self._app.main_view.work
            if all(source == target for source, target in work.form.palette):
                form = replace(work.form, palette=tuple((color, color) for color in answer.palette))
                self._app.main_view.work = replace(work, form=form)
            self._app.main_view.wake()
        elif answer.note and answer.grade is None:
            self._show(answer.note, None, models=answer.models)
        elif answer.grade is not None:
            gdf = load_gdf(answer.grade, self._app.document.original)
            self._grade = self._sent, gdf, answer.grade
            self._app.main_view.live = ()  # of the last color
            self._show(f"Live: {answer.note}", None)
        elif answer.pixels is not None:
            kind, _, what = self._sent.editor.partition(":")
            title = next(choice.title for choice in EDITORS if choice.kind == kind)
            self._end_live()
            name = f"Preview: {title} at {self._sent.strength:.2f}"
            text = ""
            self._painted = None
            if kind == "instruct":
                name = f"Anchor: {what}"
                text = "The edit will follow this picture"
                if answer.follows:
                    self._painted = self._sent, answer.pixels
                else:
                    name = f"Example: {what}"
                    text = "An example: this model cannot follow a picture"
            texture = self._upload(answer.pixels)
            self._show(text, Cover(texture, self._sent.camera, self._sent.size, name))
            self._app.main_view.wake()

    def _show_live(self) -> None:
        """The grade as a layer on top, at the form's strength."""
        if self._grade is None:
            return
        main_view = self._app.main_view
        document = self._app.document
        layers = main_view.work.view.layers
        name = main_view.work.form.layer_name
        solo = any(layer.solo for layer in layers)
        strength = main_view.work.form.strength
        live = (LayerState(len(document.gdfs), name, strength, solo=solo),)
        if not main_view.live:
            self._app.show(document, (self._grade[1],), live)
        elif main_view.live != live:
            main_view.live = live
            main_view.wake()

    def _end_live(self) -> None:
        if self._grade is not None and self._app.main_view.live:
            self._app.show(self._app.document)
        self._grade = None

    def _upload(self, pixels: NDArray[np.uint8]) -> int:
        size = pixels.shape[1], pixels.shape[0]
        if self._texture is None or self._texture.size != size:
            if self._texture is not None:
                self._texture.release()
            self._texture = self._context.texture(size, 3, alignment=1)
            self._texture.filter = moderngl.LINEAR, moderngl.LINEAR
        self._texture.write(np.ascontiguousarray(pixels).tobytes(), alignment=1)
        return int(self._texture.glo)

    def _show(
        self, text: str, cover: Cover | None, failed: bool = False, models: tuple[str, ...] | None = None
    ) -> None:
        """The cover, and what the form says of it."""
        main_view = self._app.main_view
        known = main_view.preview.models if models is None else models
        painted = self._painted is not None and self._painted[0] == self._request()
        sheet = 0 if self._sheet is None else int(self._sheet.glo)
        state = PreviewState(text, failed, self._outstanding, painted, known, sheet, self._drawn)
        if (main_view.cover, main_view.preview) != (cover, state):
            main_view.cover = cover
            main_view.preview = state
            main_view.wake()

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None
        self._sent = None
        self._seen = None
        self._outstanding = False
        self._tile = -1
