"""Live grade of the form: effect on the scene, histogram, looks, and settings on the clipboard."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import replace

import moderngl
import numpy as np
from imgui_bundle import imgui

from progdf.color.grade import grade_fully, parse_grade
from progdf.color.looks import BUILT_IN, describe_look, look_name
from progdf.errors import ProgdfError
from progdf.field.baked import lattice_colors
from progdf.formats.cube import SIDE, SUFFIX, write_cube
from progdf.io.atomic import make_folder, numbered_names
from viewer.app.messages import Messages, Requests
from viewer.files import region_files, user_files
from viewer.files.document import DocumentStore
from viewer.jobs.preview_process import RegionSample
from viewer.render.engine import ViewEngine
from viewer.render.live_grade import FormGrader, LiveGrade
from viewer.state.commands import Plain
from viewer.state.forms import LOOK_COLUMNS, LOOK_PX, with_settings
from viewer.state.transient import LookShelf
from viewer.state.workspace import Store, with_transient


class GradePreview:
    """Grade of the form on screen, within the frame of a change. `close` it with the window.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        context: the GL context
        engine: returns the engine that draws the window
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        context: moderngl.Context,
        engine: Callable[[], ViewEngine],
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._context = context
        self._engine = engine
        self._grader = FormGrader()
        self._region = ""  # region of the grader's rows, see `region_key`
        self._palette: tuple[str, ...] = ()  # main colors of this region, #rrggbb
        self._sheet: moderngl.Texture | None = None
        self._looks: tuple[tuple[str, str], ...] | None = None  # None: to be read again
        self._drawn: tuple[RegionSample, tuple[tuple[str, str], ...]] | None = None  # inputs of the sheet
        self._scope_of: tuple[object, ...] | None = None  # inputs of the histogram

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about grades, by name."""
        return {
            "copy_edit": self._copy,
            "paste_edit": self._paste,
            "save_look": self._save_look,
            "show_looks": self._show_looks,
        }

    def region_key(self) -> str:
        """Return the form's region as a key."""
        work = self._store.get()
        form = work.form
        return f"{form.region}|{form.typed_region}|{hash(work.view.selection.members)}"

    def take(self, sample: RegionSample, palette: Sequence[str], region: str) -> None:
        """Take over the sample and the main colors of a region, unless the form has another one by now.

        `sample`: its rows are those of the scene that holds the region
        """
        if region == self.region_key():
            work = self._store.get()
            try:
                own = region_files.own_scene(work.form, self._documents.get(), work.view.selection)
            except ProgdfError:  # of several scenes, others are visible by now
                return
            sample = replace(sample, rows=sample.rows + own.rows.start)
            self._region = region
            self._grader.sample = sample
            rows = self._grader.rows
            if rows is None or not np.array_equal(rows, sample.rows):
                self._grader.rows = sample.rows
            self._palette = tuple(palette)
            if all(source == target for source, target in self._store.get().form.palette):
                self._set_palette()
            self._store.wake()

    def update(self) -> None:
        """Show the grade of the form on the Gaussians of its region, and its histogram and looks."""
        work = self._store.get()
        form = work.form
        is_open = work.form_open and work.view.panel and form.choice.setting == "grade"
        live = None
        if is_open:
            self._find_rows()
            if not form.palette and self._palette:  # the form was opened again
                self._set_palette()
            live = self._grader.live(form)
            self._update_scope(live)
            self._update_shelf()
        else:
            self._looks = None
        shown = live if form.preview and not work.before else None
        engine = self._engine()
        if engine.live != shown:
            engine.live = shown
            self._store.wake()

    def leave_scene(self) -> None:
        """Forget the region of the closed scene."""
        self._region = ""
        self._palette = ()
        self._grader = FormGrader()

    def close(self) -> None:
        """Release the texture."""
        if self._sheet is not None:
            self._sheet.release()
            self._sheet = None

    def _set_palette(self) -> None:
        """Put the region's main colors into the form, unchanged."""
        work = self._store.get()
        form = replace(work.form, palette=tuple((color, color) for color in self._palette))
        self._store.replace(replace(work, form=form))
        self._store.wake()

    def _find_rows(self) -> None:
        """Find the rows of a new region, so that it is graded before the preview process has answered."""
        key = self.region_key()
        if key == self._region:
            return
        self._region = key
        self._palette = ()
        self._grader.sample = None
        work = self._store.get()
        count = len(self._documents.get().original)
        self._grader.rows = region_files.region_rows(work.form, work.view.selection, count)

    def _update_scope(self, live: LiveGrade | None) -> None:
        """Compute the histogram again after a change: quickly during a drag, exactly after it."""
        is_moving = bool(imgui.is_any_item_active())
        inputs = (self._grader.sample, self._grader.is_empty, live, is_moving)
        if self._scope_of == inputs:
            return
        self._scope_of = inputs
        scope = self._grader.scope(live, is_moving)
        self._store.replace(with_transient(self._store.get(), scope=scope))
        self._store.wake()

    def _update_shelf(self) -> None:
        """Read the looks, and draw their thumbnails after the view or the looks have changed."""
        if self._looks is None:
            self._looks = (
                *user_files.read_looks(),
                *((name, f"grade:{settings}") for name, settings in BUILT_IN.items()),
            )
            if self._drawn is not None and self._drawn[1] == self._looks:
                self._looks = self._drawn[1]  # so that the thumbnails stay
        sample = self._grader.sample
        if sample is None:
            if self._store.get().transient.shelf.looks != self._looks:
                self._set_shelf(0)
            return
        if self._drawn is not None and self._drawn[0] is sample and self._drawn[1] is self._looks:
            return
        self._drawn = sample, self._looks
        width, height = LOOK_PX
        rows = -(-len(self._looks) // LOOK_COLUMNS)
        pixels = np.zeros((rows * height, LOOK_COLUMNS * width, 3), np.uint8)
        for i, (_, look) in enumerate(self._looks):
            thumbnail = self._grader.thumbnail(look)
            if thumbnail is not None and thumbnail.shape == (height, width, 3):
                row, column = divmod(i, LOOK_COLUMNS)
                pixels[row * height : (row + 1) * height, column * width : (column + 1) * width] = thumbnail
        self.close()
        self._sheet = self._context.texture(
            (pixels.shape[1], pixels.shape[0]), 3, pixels.tobytes(), alignment=1
        )
        self._set_shelf(int(self._sheet.glo))

    def _set_shelf(self, sheet: int) -> None:
        shelf = LookShelf(self._looks or (), sheet)
        self._store.replace(with_transient(self._store.get(), shelf=shelf))
        self._store.wake()

    def _save_look(self, _: None) -> None:
        """Save the form's grade as a look, a .cube file that other programs read too.

        Raises:
            ProgdfError: the grade changes nothing, or the folder cannot be written to.
        """
        form = self._store.get().form
        settings = form.spec.partition(":")[2]
        grade = parse_grade(settings)
        folder = user_files.looks_folder()
        make_folder(folder)
        names = numbered_names(form.name.strip() or describe_look(grade))
        path = next(path for name in names if not (path := folder / f"{name}{SUFFIX}").exists())
        write_cube(path, grade_fully(lattice_colors(SIDE).float(), grade), path.stem, settings)
        self._looks = None
        note = "; other programs read it without clarity" if grade.clarity else ""
        line = f"Saved the look “{look_name(path.stem)}” as {path}{note}"
        self._messages.show(line, button=("Show folder", Plain("show_looks")))
        self._store.wake()

    def _show_looks(self, _: None) -> None:
        """Show the folder of the looks, where files are renamed and deleted.

        Raises:
            ProgdfError: the folder cannot be created.
        """
        folder = user_files.looks_folder()
        make_folder(folder)
        webbrowser.open(folder.as_uri())

    def _copy(self, index: int | None) -> None:
        """Copy the settings of an edit as text.

        Args:
            index: its layer; None for the open form, or else the focused layer

        Raises:
            ProgdfError: the layer has no settings.
        """
        work = self._store.get()
        settings = work.form.spec
        if index is not None or not work.form_open:
            edits = self._documents.get().edits
            index = work.focus if index is None else index
            layer = None if index is None else work.view.layers[index]
            settings = "" if layer is None or layer.gdf >= len(edits) else edits[layer.gdf].instruction
        if not settings:
            raise ProgdfError("select a layer that was trained, or open the form; then copy its settings")
        imgui.set_clipboard_text(settings)
        self._messages.show(f"Copied {settings}")

    def _paste(self, _: None) -> None:
        """Open the form with the settings on the clipboard, for its region.

        Raises:
            ProgdfError: the clipboard has no settings of an edit.
        """
        text = (imgui.get_clipboard_text() or "").strip()
        work = self._store.get()
        form = with_settings(work.form, text) if "\n" not in text else None
        if form is None:
            content = f"the clipboard has no settings of an edit, but '{text[:40]}'"
            raise ProgdfError(f"{content if text else 'the clipboard is empty'}; copy some settings first")
        form = replace(form, region=work.form.region, error="")
        self._store.replace(replace(work, form=form, form_open=True, form_opening=not work.form_open))
        self._store.wake()
