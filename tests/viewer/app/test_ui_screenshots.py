"""Screenshots of the interface on a software GPU. Check them after --regenerate-screenshots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.stacks import many_edits
from tests.helpers.ui_rig import TRACK, Rig, bear, first_view, rig
from viewer.panel import panel
from viewer.state import selection
from viewer.state.selection import SelectionState
from viewer.state.view_state import Brush, LayerGroup, LayerState, ViewState
from viewer.state.workspace import Dialog, with_transient

Compare = Callable[[str, np.ndarray], None]


pytestmark = [pytest.mark.gl, pytest.mark.usefixtures("software_gpu")]
SMALLEST = (1024, 640)
"""Smallest window size that the layout supports, points."""


def crowded() -> ViewState:
    """Return a view with more layers than fit, too long names and one hidden layer."""
    names = (
        "scarf",
        "ears → gold",
        "an edit with a name that is far too long for its row",
        "d",
        "e",
        "f",
        "g",
    )
    layers = tuple(LayerState(i % 2, name, i / 6, enabled=i != 1) for i, name in enumerate(names))
    return replace(first_view(bear()), layers=layers)


def the_panel(hand: Rig) -> np.ndarray:
    return hand.image()[:, -round(panel.WIDTH_PX) :]


def test_screenshot_of_the_smallest_window(screenshot: Compare) -> None:
    with rig(replace(first_view(bear(), 0.7, 0.5), axes=True), SMALLEST) as hand:
        screenshot("ui_main", hand.image())


def test_screenshot_of_a_dense_screen(screenshot: Compare) -> None:
    with rig(replace(first_view(bear(), 0.7, 0.5), axes=True), (700, 560), density=2.0) as hand:
        screenshot("ui_2x", hand.image())


def test_scaled_desktop_looks_like_a_dense_screen() -> None:
    view = first_view(bear(), 0.7, 0.5)
    with rig(view, (700, 560), density=2.0) as hand:
        dense = hand.image()
    with rig(view, (1400, 1120), scale=2.0) as hand:
        scaled = hand.image()
    # edges of text may fall between pixels in one image and on pixels in the other
    assert (np.abs(dense.astype(int) - scaled).max(axis=-1) > 40).mean() < 0.01


def test_screenshot_of_more_layers_than_fit(screenshot: Compare) -> None:
    with rig(crowded(), SMALLEST) as hand:
        screenshot("ui_crowded", the_panel(hand))
        hand.wheel(900.0, 300.0, -100.0)
        hand.frame(20)
        screenshot("ui_crowded_scrolled", the_panel(hand))


def test_screenshot_of_the_key_list_and_a_message(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        hand.key("F1")
        hand.main_view.messages.show(
            "shirt.gdf was made for another scene: it has 41 203 Gaussians, bear.ply has 1 500", True
        )
        hand.settle()
        screenshot("ui_help", hand.image())


def test_screenshot_of_the_original_without_edits(screenshot: Compare) -> None:
    with rig(first_view(bear()), SMALLEST) as hand:
        hand.key("\\")
        hand.frame(2)
        screenshot("ui_original", hand.image())


def test_screenshot_of_a_value_being_typed(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        hand.modifier(imgui.Key.mod_ctrl)
        hand.move(900.0, TRACK)
        hand.press()
        hand.release()
        hand.modifier(imgui.Key.mod_ctrl, False)
        hand.frame(3)
        screenshot("ui_typing", the_panel(hand))


def test_screenshot_of_gains_with_a_solo_and_a_locked_layer(screenshot: Compare) -> None:
    view = replace(first_view(bear(), 1.1, 0.5), overshoot=True, unfolded=(0,))
    first, second = view.layers
    layers = (replace(first, solo=True), replace(second, locked=True))
    with rig(replace(view, layers=layers), SMALLEST) as hand:
        hand.key("Alt+Right")
        hand.frame(3)
        screenshot("ui_gains", hand.image())


def test_screenshot_of_the_split_comparison(screenshot: Compare) -> None:
    with rig(first_view(bear(), 1.0, 1.0), SMALLEST) as hand:
        hand.key("Shift+Y")
        hand.move(362.0, 250.0)
        hand.frame(3)
        screenshot("ui_split", hand.image())


def test_screenshot_of_the_difference(screenshot: Compare) -> None:
    with rig(first_view(bear(), 1.0, 1.0), SMALLEST) as hand:
        hand.key("Alt+Y")
        screenshot("ui_difference", hand.image())


def test_screenshot_of_snapshots_and_a_question(screenshot: Compare) -> None:
    with rig(first_view(bear(), 1.0, 0.0), SMALLEST) as hand:
        for chord in ("F5", *["Shift+Left"] * 5, "F5"):
            hand.key(chord)
        hand.frame(5)
        hand.main_view.store.replace(
            with_transient(
                hand.main_view.work, recent=(Path("/scenes/bear.ply"), Path("/scenes/edits/scarf.gdf"))
            )
        )
        hand.main_view.messages.ask(Dialog("open"))
        hand.frame(3)
        screenshot("ui_snapshots", hand.image())


def test_screenshot_of_twenty_layers_as_rows_with_a_group(screenshot: Compare) -> None:
    stack, view = many_edits(bear())
    layers = [replace(layer, strength=i * 7 % 20 / 19) for i, layer in enumerate(view.layers)]
    layers[2], layers[6] = replace(layers[2], enabled=False), replace(layers[6], locked=True)
    groups = (LayerGroup("Tank and frame", strength=0.8),)
    layers[9:12] = [replace(layer, group=groups[0].name) for layer in layers[9:12]]
    with rig(replace(view, layers=tuple(layers), groups=groups), (1024, 800), stack=stack) as hand:
        hand.click(815.0, 132.0)
        hand.modifier(imgui.Key.mod_shift)
        hand.click(815.0, 244.0)
        hand.modifier(imgui.Key.mod_shift, False)
        hand.move(300.0, 700.0)
        hand.frame(3)
        screenshot("ui_rows", the_panel(hand))


def test_screenshot_of_two_snapshots_compared(screenshot: Compare) -> None:
    with rig(first_view(bear(), 1.0, 0.0), SMALLEST) as hand:
        for chord in ("F5", *["Shift+Right"] * 10, "2", *["Shift+Left"] * 10, "F5"):
            hand.key(chord)
        hand.rest()
        hand.key("Shift+F5")
        hand.move(300.0, 600.0)
        hand.frame(20)
        screenshot("ui_compared", hand.image())


def test_screenshot_of_a_lasso_its_selection_and_a_region(screenshot: Compare) -> None:
    mask = bear().demo.labels.numpy() == 1
    kept = selection.add_region(selection.select(SelectionState(), mask), "scarf", Path("scarf.region.npy"))
    with rig(replace(first_view(bear(), 0.7, 0.5), selection=kept), SMALLEST) as hand:
        hand.key("L")
        path = ((250, 130), (330, 100), (450, 120), (480, 230), (420, 330), (300, 320), (240, 240))
        hand.move(*path[0])
        hand.press()
        for place in path[1:]:
            hand.move(*place)
        hand.release()
        hand.modifier(imgui.Key.mod_ctrl)
        hand.move(300, 380)
        hand.press()
        for place in ((360, 300), (430, 360), (400, 430)):
            hand.move(*place)
        screenshot("ui_select", hand.image())


def test_screenshot_of_axes_and_the_ground_grid(screenshot: Compare) -> None:
    head = selection.select(SelectionState(), np.isin(bear().demo.labels.numpy(), (1, 2)))
    view = replace(first_view(bear()), axes=True, grid=True, background=(0.11, 0.11, 0.12))
    view = replace(view, selection=selection.isolate(head, len(bear().scene)))
    with rig(view, SMALLEST) as hand:
        hand.main_view.messages.show("Saved bear.session.json")
        hand.move(651.0, 53.0)
        hand.frame(3)
        screenshot("ui_orientation", hand.image())


def test_screenshot_of_a_brush_and_its_controls(screenshot: Compare) -> None:
    view = replace(first_view(bear(), 1.0, 0.5), brush=Brush(active=True, radius=25.0))
    with rig(view, SMALLEST) as hand:
        hand.drag((360.0, 300.0), (420.0, 320.0))
        hand.frame(3)
        screenshot("ui_paint", hand.image())


def test_screenshot_of_the_command_palette_and_a_search(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        hand.key("Ctrl+P")
        hand.frame(3)
        screenshot("ui_palette", hand.image())
        hand.io.add_input_characters_utf8("snap")
        hand.frame(3)
        screenshot("ui_palette_search", hand.image())


def test_screenshot_of_the_history(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        for chord in ("1", "Shift+Right", "H", "2", "Right", "Ctrl+A", "Ctrl+Z", "Ctrl+Alt+Z"):
            hand.key(chord)
        hand.frame(3)
        screenshot("ui_history", hand.image())


def test_screenshot_of_a_tool_moved_by_keys(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        for chord in ("U", *["Shift+Up"] * 2, "Space", *["Shift+Right"] * 2, "Shift+Down"):
            hand.key(chord)
        hand.frame(2)
        screenshot("ui_tool_by_keys", hand.image())
