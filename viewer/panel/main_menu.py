"""The menu of the window (☰): files, new edits, what is delivered, help."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from imgui_bundle import imgui

from progdf.terminal import escape_text
from viewer.state.view_state import ViewState
from viewer.state.workspace import Workspace, is_compact
from viewer.ui.context import Icon, UiContext
from viewer.ui.keys import shortcut
from viewer.ui.widgets import elide, icon_button, menu, tip

NAME = "main menu"
MOST_PX = 360.0
_FILES = (("Open…", "open"),)
_SAVES = (("Save", "save"), ("Save as…", "save_as"))
_MAKES = (
    ("New edit", "new_edit"),
    ("Take this view", "take_view"),
    ("Hide strays", "hide_strays"),
    ("Export .ply…", "export"),
    ("Render picture…", "render_picture"),
    ("Render film…", "render_film"),
)
_VIEWS = (
    ("Front", "look:front"),
    ("Back", "look:back"),
    ("Right", "look:right"),
    ("Left", "look:left"),
    ("Top", "look:top"),
    ("Bottom", "look:bottom"),
)
_LAYERS = (
    ("Select all", "select_layers"),
    ("Search", "search"),
    ("Group", "group"),
    ("Ungroup", "ungroup"),
    ("Copy values", "copy_values"),
    ("Paste values", "paste_values"),
    ("Reset", "reset"),
    ("Reset all", "reset_all"),
)
_FRAMES = (("Frame", "frame"), ("Home", "home"))
_HELP = (("Shortcuts", "help"), ("About", "about"), ("Quit", "quit"))


def button(work: Workspace, recent: Sequence[Path], ui: UiContext, actions: list[str]) -> None:
    """The button at the right of the present line, and its menu while it is open.

    `recent`: files opened before, the last one first.
    """
    if icon_button("menu", Icon.BARS, ui):
        imgui.open_popup(NAME)
    tip("Menu")
    with menu(NAME, ui) as is_open:
        if is_open:
            actions += _items(_FILES)
            actions += _recent(recent, ui)
            actions += _items(_SAVES)
            imgui.separator()
            actions += _items(_MAKES)
            imgui.separator()
            actions += _view(work.view)
            actions += _layers(work)
            imgui.separator()
            actions += _items(_HELP)


def _items(items: Sequence[tuple[str, str]]) -> list[str]:
    return [action for name, action in items if imgui.menu_item(name, shortcut(action), False)[0]]


def _view(view: ViewState) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("View"):
        actions += _items(_VIEWS)
        imgui.separator()
        actions += _items(_FRAMES)
        imgui.separator()
        for name, action, on in (("Ground grid", "grid", view.grid), ("Axes", "axes", view.axes)):
            actions += [action] * bool(imgui.menu_item(name, shortcut(action), on)[0])
        imgui.end_menu()
    return actions


def _layers(work: Workspace) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("Layers", bool(work.view.layers)):
        actions += _items(_LAYERS)
        imgui.separator()
        actions += ["cards"] * bool(imgui.menu_item("Compact rows", shortcut("cards"), is_compact(work))[0])
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
