"""The menu of the window (☰): files, new edits, what is delivered, help."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from imgui_bundle import imgui

from progdf.terminal import escape_text
from viewer.state.view_state import ViewState
from viewer.ui.context import Icon, UiContext
from viewer.ui.widgets import elide, icon_button, menu, tip

NAME = "main menu"
MOST_PX = 360.0
_FILES = (("Open…", "Ctrl+O", "open"),)
_SAVES = (("Save", "Ctrl+S", "save"), ("Save as…", "Ctrl+Shift+S", "save_as"))
_MAKES = (
    ("New edit", "Ctrl+N", "new_edit"),
    ("Take this view", "Ctrl+F2", "take_view"),
    ("Hide strays", "", "hide_strays"),
    ("Export .ply…", "Ctrl+E", "export"),
    ("Render picture…", "Ctrl+P", "render_picture"),
    ("Render film…", "Ctrl+Shift+P", "render_film"),
)
_VIEWS = (
    ("Front", "Numpad 1", "look:front"),
    ("Back", "Ctrl+Numpad 1", "look:back"),
    ("Right", "Numpad 3", "look:right"),
    ("Left", "Ctrl+Numpad 3", "look:left"),
    ("Top", "Numpad 7", "look:top"),
    ("Bottom", "Ctrl+Numpad 7", "look:bottom"),
)
_LAYERS = (
    ("Select all", "Ctrl+Alt+A", "select_layers"),
    ("Search", "Ctrl+F", "search"),
    ("Group", "Ctrl+G", "group"),
    ("Ungroup", "Ctrl+Shift+G", "ungroup"),
    ("Copy values", "Ctrl+C", "copy_values"),
    ("Paste values", "Ctrl+V", "paste_values"),
    ("Reset", "Ctrl+R", "reset"),
    ("Reset all", "Ctrl+Shift+R", "reset_all"),
)
_FRAMES = (("Frame", "F", "frame"), ("Home", "Shift+F", "home"))
_HELP = (("Shortcuts", "F1", "help"), ("About", "", "about"), ("Quit", "Ctrl+Q", "quit"))


def button(recent: Sequence[Path], view: ViewState, compact: bool, ui: UiContext) -> list[str]:
    """The button at the right of the present line, and its menu while it is open; what was chosen.

    `compact`: layers are shown as rows of one line.
    """
    if icon_button("menu", Icon.BARS, ui):
        imgui.open_popup(NAME)
    tip("Menu")
    actions: list[str] = []
    with menu(NAME, ui) as is_open:
        if is_open:
            actions += _items(_FILES)
            actions += _recent(recent, ui)
            actions += _items(_SAVES)
            imgui.separator()
            actions += _items(_MAKES)
            imgui.separator()
            actions += _view(view)
            actions += _layers(view, compact)
            imgui.separator()
            actions += _items(_HELP)
    return actions


def _items(items: Sequence[tuple[str, str, str]]) -> list[str]:
    return [action for name, keys, action in items if imgui.menu_item(name, keys, False)[0]]


def _view(view: ViewState) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("View"):
        actions += _items(_VIEWS)
        imgui.separator()
        actions += _items(_FRAMES)
        imgui.separator()
        shown = (("Ground grid", "Shift+G", "grid", view.grid), ("Axes", "", "axes", view.axes))
        actions += [action for name, keys, action, on in shown if imgui.menu_item(name, keys, on)[0]]
        imgui.end_menu()
    return actions


def _layers(view: ViewState, compact: bool) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("Layers", bool(view.layers)):
        actions += _items(_LAYERS)
        imgui.separator()
        actions += ["cards"] * bool(imgui.menu_item("Compact rows", "Alt+G", compact)[0])
        imgui.end_menu()
    return actions


def _recent(recent: Sequence[Path], ui: UiContext) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("Recent", bool(recent)):
        for i, path in enumerate(recent):
            name = elide(escape_text(path.name), MOST_PX * ui.scale)
            if imgui.menu_item(f"{name}##{i}", "", False)[0]:
                actions.append(f"open_file:{path}")
            tip(escape_text(str(path)))
        imgui.end_menu()
    return actions
