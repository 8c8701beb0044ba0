"""Dialogs over the picture: where to save, which file to open, how to handle unsaved changes.

All dialogs work by keys: Enter presses the marked button, Escape changes nothing. The save dialog stays open
until the file is saved; then the file actions close it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui, imgui_ctx
from imgui_bundle import portable_file_dialogs as dialogs

from progdf.system.desktop import has_file_dialog
from progdf.terminal import escape_text
from viewer.files.user_files import complete_path, path_completions
from viewer.state.commands import Action, OnItem, Plain, RebindEdit, ReplaceEdit, Save, WithText
from viewer.state.workspace import Dialog
from viewer.ui.context import GAP_PX, PALETTE, UiContext
from viewer.ui.overlay import Area
from viewer.ui.widgets import accent_button, elide, inert, small, tip, wrapped_text

from . import pages

WIDTH_PX = 520.0  # at 1×
_POPUP = "##dialog"
_LOG_CHARACTERS = 20_000
TITLES = {
    "save": "Save session",
    "open": "Open",
    "add_scene": "Add a scene to this view",
    "replace": "Replace the layer's edit",
    "rebind": "Rebind an edit of another scene",
    "leave": "Unsaved changes",
    "overwrite": "File already exists",
    "restore": "Recover unsaved work?",
    "training": "Training is not finished",
    "discard_run": "Discard training",
    "delivery": "Still being written",
    "log": "Training log",
    "export": "Export the edited scene",
    "export_page": "Export a web page",
    "render_picture": "Render picture",
    "render_film": "Render film",
    "about": "About",
    "match": "Is it this view?",
    "allow": "Allow this?",
}
_HINTS = {
    "save": "A .session.json file. The scene and its edits stay where they are.",
    "open": "A scene (.ply, .spz, .sog …), an edit (.gdf, .cube), an edited picture, a session or cameras.",
    "add_scene": "A scene (.ply, .spz, .sog …). It appears at the coordinates of its file.",
    "replace": "An edit (.gdf, .cube). The layer keeps its position, strength and gains.",
    "rebind": "The scene of this edit: the open scene in another file or format.",
    "leave": "Save changes to {}?",
    "overwrite": "{} was not opened in this window. Replacing it cannot be undone.",
    "restore": "The last session was not closed properly. Its unsaved work was saved to {}.",
    "training": "{} is being trained. A stopped run can be resumed when the scene is opened again.",
    "discard_run": "Discard {} of training? This cannot be undone.",
    "delivery": "{} is not finished. If you stop now, nothing is written.",
    "log": "{}",
    "export": "A plain 3DGS .ply of the scene at these strengths, which any viewer opens.",
    "export_page": "One .html file with these sliders, snapshots and film, which any browser opens.",
    "render_picture": "This view at any size, with the same vertical field of view.",
    "render_film": "Renders in the background; the panel shows the progress.",
    "match": "{} carries no camera. This is the nearest view, but too little of it agrees.",
    "allow": "Every training with it does so, too. You are not asked again for exactly this.",
    "about": "Edit a trained 3D Gaussian Splatting scene once, then drag a slider through it.",
}
_SUBMIT = {
    "save": "Save",
    "open": "Open",
    "add_scene": "Add",
    "replace": "Replace",
    "rebind": "Rebind",
    "export": "Export",
    "export_page": "Export",
    "render_picture": "Render",
    "render_film": "Render",
}
"""Button of each dialog that has a path field."""
_OPENS = ("open", "add_scene", "replace", "rebind")
_STAYS_OPEN = imgui.SelectableFlags_.no_auto_close_popups.value
_PATH_ROWS = 6  # visible rows of the list of files
_DELIVERS = ("export", "export_page", "render_picture", "render_film")


@dataclass(frozen=True)
class _Button:
    """Button of a dialog without a path field; `keys` press it too."""

    name: str
    keys: tuple[str, ...] = ()


_CHOICES = {
    "leave": (_Button("Save", ("Enter", "S")), _Button("Discard", ("D",)), _Button("Cancel")),
    "overwrite": (_Button("Rename…", ("Enter", "R")), _Button("Replace"), _Button("Cancel")),
    "training": (_Button("Keep waiting", ("Enter",)), _Button("Stop and quit", ("S",))),
    "discard_run": (_Button("Keep", ("Enter",)), _Button("Discard", ("D",))),
    "delivery": (_Button("Keep waiting", ("Enter",)), _Button("Stop and quit", ("S",))),
    "log": (_Button("Close", ("Enter",)),),
    "about": (_Button("Close", ("Enter",)),),
    "allow": (_Button("Cancel", ("Enter",)), _Button("Allow", ("A",))),
    "match": (_Button("Use it", ("Enter",)), _Button("No", ("N",))),
    "restore": (_Button("Restore", ("Enter", "R")), _Button("Discard", ("D",)), _Button("Later")),
}


@dataclass(frozen=True)
class DialogResult:
    """Dialog after this frame, None once it is closed, and the resulting requests."""

    dialog: Dialog | None
    requests: tuple[Action, ...] = ()


def draw(dialog: Dialog, pressed: Sequence[str], ui: UiContext, area: Area) -> DialogResult:
    """Draw the dialog and return its result.

    Args:
        pressed: chords pressed in this frame
        area: the picture; the dialog is in its upper part
    """
    if not imgui.is_popup_open(_POPUP):
        imgui.open_popup(_POPUP)
    margin = GAP_PX * ui.scale
    top = max(margin, 0.25 * area.height - 90.0 * ui.scale)
    imgui.set_next_window_pos((area.width / 2, top), 0, (0.5, 0.0))
    imgui.set_next_window_size((min(WIDTH_PX * ui.scale, area.width - 2 * margin), 0.0))
    flags = imgui.WindowFlags_
    flags_of_popup = flags.no_decoration.value | flags.no_saved_settings.value | flags.no_move.value
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, (2 * GAP_PX * ui.scale, 2 * GAP_PX * ui.scale))
    imgui.push_style_color(imgui.Col_.modal_window_dim_bg, (0.0, 0.0, 0.0, 0.45))
    answer = DialogResult(dialog)
    if imgui.begin_popup_modal(_POPUP, None, flags_of_popup)[0]:
        context = imgui.get_current_context()
        at_button = not imgui.get_io().want_text_input
        if context.nav_cursor_visible and at_button and context.nav_id not in (0, imgui.get_id("##path")):
            pressed = [chord for chord in pressed if chord != "Enter"]  # the focused item takes it
        answer = _content(dialog, pressed, ui, area.height - margin)
        if answer.dialog is None:
            imgui.close_current_popup()
        imgui.end_popup()
    imgui.pop_style_color()
    imgui.pop_style_var(2)
    return answer


def _content(dialog: Dialog, pressed: Sequence[str], ui: UiContext, bottom: float) -> DialogResult:
    """Draw the content of a dialog. `bottom`: limit of its lower edge, window pixels."""
    with imgui_ctx.push_font(ui.fonts.bold, 0.0):
        imgui.text(TITLES[dialog.kind])
    wrapped_text(_HINTS[dialog.kind].format(escape_text(Path(dialog.text).name)), PALETTE.dim)
    imgui.dummy((0.0, 2.0 * ui.scale))
    if "Escape" in pressed:
        return DialogResult(None, _requests(dialog, "No"))
    if dialog.chosen and dialog.kind in _DELIVERS:
        dialog = replace(dialog, text=dialog.chosen, chosen="")  # the user may still change other options
    if dialog.chosen:
        return _submit(dialog, dialog.chosen)
    if dialog.kind in _CHOICES:
        _is_new(dialog.kind)
        if dialog.kind == "log":
            _log(Path(dialog.text), bottom, ui)
        if dialog.kind in ("about", "allow"):
            wrapped_text(_escape_lines(dialog.text), PALETTE.text)
            imgui.dummy((0.0, 2.0 * ui.scale))
        return _answer(dialog, _pressed_button(_CHOICES[dialog.kind], pressed, ui))
    if _is_new(dialog.kind) or (dialog.error and not imgui.is_any_item_active()):
        imgui.set_keyboard_focus_here()  # Enter removes the focus, and the path needs a correction
    more = 36.0 * ui.scale
    gap = 6.0 * ui.scale
    imgui.set_next_item_width(-more - gap)
    flags = 0 if dialog.error else imgui.InputTextFlags_.auto_select_all.value
    if dialog.kind in _OPENS:
        flags |= imgui.InputTextFlags_.callback_completion.value
    escaped = escape_text(dialog.text)
    _, text = imgui.input_text("##path", escaped, flags, _complete)
    text = dialog.text if text == escaped else text  # a name that is not UTF-8 stays unchanged
    dialog = replace(dialog, text=text)
    imgui.same_line(0.0, gap)
    with inert(dialog.choosing):
        browse = imgui.button("…", (more, 0.0))
    tip("Browse with the system file dialog (Ctrl+B)")
    if browse or ("Ctrl+B" in pressed and not dialog.choosing):
        return DialogResult(dialog, (Plain("browse"),))
    if dialog.kind in _OPENS:
        dialog = replace(dialog, text=_path_list(text, ui) or text)
    if dialog.notice:
        small(dialog.notice, PALETTE.warning)
    if dialog.error:
        wrapped_text(escape_text(dialog.error), PALETTE.error)
    if dialog.options is not None and dialog.kind in ("render_picture", "render_film"):
        kind = dialog.kind.removeprefix("render_")
        text, options = pages.draw_fields(kind, dialog.text, dialog.options, ui)
        dialog = replace(dialog, text=text, options=options)
    imgui.dummy((0.0, 2.0 * ui.scale))
    name = _SUBMIT[dialog.kind]
    button = _buttons((name, "Cancel"), ui)
    if button == "Cancel":
        return DialogResult(None)
    path = text.strip().strip("\"'")
    if path and (button == name or "Enter" in pressed):
        return _submit(dialog, path)
    return DialogResult(dialog)


def _complete(data: imgui.InputTextCallbackData) -> int:
    """Complete the path in the text field; imgui calls it when Tab is pressed."""
    typed = str(data.buf)
    completed = complete_path(typed)
    if completed != typed:
        data.delete_chars(0, data.buf_text_len)
        data.insert_chars(0, completed)
    return 0


def _path_list(typed: str, ui: UiContext) -> str:
    """Draw the files and folders that complete a path; return the pressed one, "" for none.

    The height is constant, so that the buttons below do not move.
    """
    pressed = ""
    row = imgui.get_text_line_height_with_spacing()
    imgui.begin_child("paths", (0.0, _PATH_ROWS * row))
    found = path_completions(typed)
    if not found:
        small("No matching file" if typed.strip() else "Type a path; Tab completes it", PALETTE.dim)
    clipper = imgui.ListClipper()
    clipper.begin(len(found), row)
    while clipper.step():
        for path in found[clipper.display_start : clipper.display_end]:
            name = os.path.basename(path.rstrip(os.sep)) + (os.sep if path.endswith(os.sep) else "")
            line = elide(escape_text(name), imgui.get_content_region_avail().x)
            if imgui.selectable(f"{line}##{path}", False, imgui.SelectableFlags_.no_auto_close_popups.value)[
                0
            ]:
                pressed = path
    imgui.end_child()
    return pressed


def _is_new(kind: str) -> bool:
    """Return True if this dialog was not open in the last frame; another may have used the same popup."""
    storage = imgui.get_state_storage()
    slot = int(imgui.get_id("kind"))
    number = 1 + [*TITLES].index(kind)
    changed = storage.get_int(slot) != number
    storage.set_int(slot, number)
    return bool(changed or imgui.is_window_appearing())


def _submit(dialog: Dialog, path: str) -> DialogResult:
    """Request the file; the dialog stays open if the file may be rejected."""
    kept = dialog.kind in ("save", "open", "add_scene", *_DELIVERS)
    error = dialog.error if dialog.kind in _DELIVERS else ""  # a second press confirms an existing file
    stays = replace(dialog, text=path, chosen="", error=error) if kept else None
    return DialogResult(stays, (_submission(dialog, path),))


def _submission(dialog: Dialog, path: str) -> Action:
    """Return the request of a dialog that has a path field."""
    match dialog.kind:
        case "save":
            return WithText("save_to", path)
        case "open":
            return WithText("open_file", path)
        case "add_scene":
            return WithText("add_file", path)
        case "replace":
            return ReplaceEdit(dialog.item, path)
        case "rebind":
            return RebindEdit(dialog.file, path)
    return WithText("deliver", dialog.kind)


def _pressed_button(choices: Sequence[_Button], pressed: Sequence[str], ui: UiContext) -> str:
    """Return the name of the button pressed by mouse or key; "" for none."""
    button = _buttons([choice.name for choice in choices], ui)
    by_key = (choice.name for choice in choices if any(key in pressed for key in choice.keys))
    return button or next(by_key, "")


def _answer(dialog: Dialog, button: str) -> DialogResult:
    """Return the result of a button of a dialog without a path field."""
    if not button:
        return DialogResult(dialog)
    if button == "Rename…":
        return DialogResult(Dialog("save", dialog.text, dialog.then))
    stays = dialog if button == "Replace" else None  # until the file is written
    return DialogResult(stays, _requests(dialog, button))


def _requests(dialog: Dialog, button: str) -> tuple[Action, ...]:
    """Return the requests of a button; none if it only closes the dialog."""
    then = () if dialog.then is None else (dialog.then,)
    match dialog.kind, button:
        case "leave", "Save":
            return tuple(Save(action) for action in then)
        case "leave", "Discard":
            return Plain("discard"), *then
        case "overwrite", "Replace":
            return (WithText("overwrite", dialog.text),)
        case "training", "Stop and quit":
            return (Plain("stop_and_quit"),)
        case "delivery", "Stop and quit":
            return (Plain("drop_and_quit"),)
        case "discard_run", "Discard" if dialog.item is not None:
            return (OnItem("discard_run", dialog.item),)
        case "allow", "Allow":
            return WithText("allow_outside", dialog.text), *then
        case "match", "Use it":
            return (WithText("use_view", dialog.text),)
        case "match", "No":
            return (Plain("keep_view"),)
        case "restore", "Restore":
            return (WithText("restore_autosave", dialog.text),)
        case "restore", "Discard":
            return (WithText("discard_autosave", dialog.text),)
    return ()


def _log(path: Path, bottom: float, ui: UiContext) -> None:
    """Draw the end of a run's log."""
    try:
        text = path.read_text("utf-8", "replace")[-_LOG_CHARACTERS:]
    except OSError as error:
        text = error.strerror or str(error)
    tall = max(min(260.0 * ui.scale, bottom - imgui.get_cursor_screen_pos().y - 60.0 * ui.scale), 40.0)
    imgui.push_style_color(imgui.Col_.child_bg, PALETTE.scrim)
    padded = imgui.ChildFlags_.always_use_window_padding.value
    imgui.begin_child("log", (0.0, tall), padded)
    wrapped_text(_escape_lines(text), PALETTE.text)
    if imgui.is_window_appearing():
        imgui.set_scroll_here_y(1.0)
    imgui.end_child()
    imgui.pop_style_color()
    imgui.dummy((0.0, 2.0 * ui.scale))


def _escape_lines(text: str) -> str:
    """Escape each line of a text and keep its line breaks."""
    return "\n".join(escape_text(line) for line in text.splitlines())


def _buttons(names: Sequence[str], ui: UiContext) -> str | None:
    """Draw buttons at the right, the first one marked; return the name of the pressed one."""
    wide = 92.0 * ui.scale
    gap = 8.0 * ui.scale
    start = imgui.get_content_region_avail().x - len(names) * wide - (len(names) - 1) * gap
    imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + max(start, 0.0))
    pressed = None
    for i, name in enumerate(names):
        if i:
            imgui.same_line(0.0, gap)
        if (imgui.button if i else accent_button)(name, (wide, 0.0)):
            pressed = name
    return pressed


PROGRAMS = ("zenity", "kdialog", "qarma", "matedialog")
"""Programs that show a file dialog on Linux; one is enough.

Without one, the dialog library answers as if the user had canceled, so this module checks for them. The path
field is always available.
"""

POLL_S = 0.05
"""Seconds between two polls of the system file dialog."""

_OPEN = [
    "Scenes, edits, sessions, cameras",
    "*.ply *.spz *.splat *.ksplat *.sog *.glb *.gltf *.ckpt *.zip *.gz *.gdf *.cube *.json",
    "All files",
    "*",
]
_SAVE = ["Sessions", "*.json", "All files", "*"]


def obstacle() -> str:
    """Return the reason why no system file dialog can be shown, in one line; "" if one can."""
    if has_file_dialog(PROGRAMS):
        return ""
    return f"No file dialog is installed ({PROGRAMS[0]} or {PROGRAMS[1]}); type the path"


class Browser:
    """System file dialog next to one of our dialogs, one at a time.

    Call `close` before discarding it: otherwise the library waits for the user.
    """

    def __init__(self) -> None:
        self._dialog: dialogs.open_file | dialogs.save_file | None = None

    @property
    def on_screen(self) -> bool:
        """True if a system dialog is open and must be polled after `POLL_S`."""
        return self._dialog is not None

    def open(self, dialog: Dialog, near: Path) -> Dialog:
        """Open the system dialog; return our dialog with a notice, or the reason why it cannot open.

        Args:
            dialog: a dialog with a path field
            near: a file in whose folder to start if no path is typed
        """
        if missing := obstacle():
            return replace(dialog, notice=missing)
        self.close()
        path = Path(dialog.text or near).expanduser().absolute()
        if dialog.kind in _OPENS:
            folder = path if path.is_dir() else path.parent
            self._dialog = dialogs.open_file("Open", escape_text(f"{folder}/"), _OPEN)
        else:
            filters = _SAVE if dialog.kind == "save" else ["All files", "*"]
            self._dialog = dialogs.save_file("Save", escape_text(str(path)), filters)
        return replace(
            dialog, choosing=True, notice="Choose a file in the system dialog, or type a path here"
        )

    def poll(self, dialog: Dialog | None) -> Dialog | None:
        """Return our dialog after a poll of the system dialog, with the chosen file if any. Does not wait."""
        if self._dialog is None or dialog is None or not dialog.choosing:
            self.close()  # our dialog was answered meanwhile
            return dialog
        if not self._dialog.ready(0):
            return dialog
        answer: Sequence[str] | str = self._dialog.result()
        path = answer if isinstance(answer, str) else next(iter(answer), "")
        self._dialog = None
        return replace(dialog, choosing=False, notice="", chosen=path)

    def close(self) -> None:
        """Close the system dialog, answered or not."""
        if self._dialog is not None and not self._dialog.ready(0):
            self._dialog.kill()
        self._dialog = None
