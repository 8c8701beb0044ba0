"""Every tool gives the same result bit for bit by keys alone as by mouse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app.parts.pictures import DecalTextures
from viewer.state.commands import Plain
from viewer.state.transient import Decal
from viewer.state.view_state import SelectTool
from viewer.state.workspace import with_transient
from viewer.ui.keys import TOOL_KEYS, bind

pytestmark = pytest.mark.gl
WINDOW = (700, 640)
MIDDLE = (200.0, 320.0)
ARROWS = {"Left": (-4, 0), "Right": (4, 0), "Up": (0, -4), "Down": (0, 4)}
WAY = ("Shift+Up", "Shift+Up", "Right", "Right")
DRAG = ("Shift+Right", "Right", "Shift+Down", "Down", "Shift+Left", "Shift+Left")


def places(start: tuple[float, float], way: Sequence[str]) -> list[tuple[float, float]]:
    """Return the positions that arrow keys reach from `start`, in order."""
    found = [start]
    for chord in way:
        modifier, _, arrow = chord.rpartition("+")
        dx, dy = ARROWS[arrow]
        many = 10 if modifier else 1
        found.append((found[-1][0] + many * dx, found[-1][1] + many * dy))
    return found


def by_mouse(hand: Rig, tool: str) -> None:
    start = places(MIDDLE, WAY)[-1]
    corners = places(start, DRAG)
    if tool in ("J", "I"):
        hand.click(*start)
    elif tool == "P":
        for corner in corners:
            hand.click(*corner)
            hand.rest(0.5)
        hand.key("Enter")
    else:
        hand.move(*start)
        hand.press()
        for corner in corners[1:]:
            hand.move(*corner)
        hand.release()


def by_keys(hand: Rig, tool: str) -> None:
    def strike(chord: str) -> None:
        hand.key(chord)
        hand.rest(0.5)  # two presses in quick succession are a double click, as with the mouse

    hand.move(5.0, 600.0)  # an arbitrary mouse position
    for chord in WAY:
        strike(chord)
    strike("Space")
    if tool in ("J", "I"):
        return
    for chord in DRAG:
        strike(chord)
        if tool == "P":
            strike("Space")
    strike("Enter")


def test_keyboard_pointer_starts_in_the_middle_of_the_picture() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        assert tuple(side / 2 for side in hand.main_view.picture_size) == MIDDLE


@pytest.mark.parametrize("tool", ["R", "L", "P", "U", "Shift+U", "Shift+R", "J", "I", "B"])
def test_tool_works_by_keys_as_by_mouse(tool: str) -> None:
    views = []
    for drive in (by_mouse, by_keys):
        with rig(replace(first_view(bear(), 0.7, 0.7), select=SelectTool(through=True)), WINDOW) as hand:
            hand.key("2")
            before = hand.main_view.work.view
            hand.key(tool)
            camera = hand.main_view.work.view.camera
            drive(hand, tool)
            view = hand.main_view.work.view
            assert (view.selection, view.layers) != (before.selection, before.layers), "it did something"
            assert [l.strength for l in view.layers] == [0.7, 0.7]
            assert view.camera == camera
            assert len(hand.main_view.work.past.past) == 1
            views.append((view.selection, view.layers))
    assert views[0] == views[1]


@pytest.mark.parametrize("tool", ["R", "L", "U", "Shift+U", "Shift+R", "B"])
def test_resting_tool_requests_no_frames(tool: str) -> None:
    with rig(replace(first_view(bear(), 0.7, 0.7), select=SelectTool(through=True)), WINDOW) as hand:
        hand.key("2")
        hand.key(tool)
        hand.move(*MIDDLE)
        hand.press()
        hand.move(MIDDLE[0] + 30.0, MIDDLE[1])
        hand.frame(12)
        assert hand.main_view.work.transient.tool.drag is not None
        assert hand.main_view.next_frame_delay() != 0.0
        hand.release()


def decal_of(hand: Rig) -> Decal:
    decal = hand.main_view.work.transient.gizmo
    assert isinstance(decal, Decal)
    return decal


def test_decal_is_placed_by_keys(tmp_path: Path) -> None:
    pixels = np.zeros((40, 80, 4), np.uint8)
    pixels[10:30, 20:60] = 200, 30, 30, 255
    Image.fromarray(pixels).save(tmp_path / "logo.png")
    with rig(first_view(bear()), WINDOW) as hand:
        hand.main_view.store.replace(
            with_transient(
                hand.main_view.work, gizmo=DecalTextures(hand.main_view.context).load(tmp_path / "logo.png")
            )
        )
        for chord in WAY:
            hand.key(chord)
        assert isinstance(hand.main_view.work.transient.gizmo, Decal)
        first = hand.main_view.work.transient.gizmo
        assert first.at == places(MIDDLE, WAY)[-1]
        for chord in ("Ctrl+Up", "Ctrl+Up", "Ctrl+Down", "Ctrl+Left", "Ctrl+Shift+Left"):
            hand.key(chord)
        sized = decal_of(hand)
        assert sized.at == first.at
        assert (sized.size, sized.angle) == (pytest.approx(1.08 * first.size), 15.0)
        hand.key("Space")
        placed = decal_of(hand)
        assert placed.placed
        assert placed.frame is not None
        hand.key("Ctrl+Up")
        hand.key("Ctrl+Right")
        changed = decal_of(hand)
        assert changed.frame is not None
        assert changed.frame.size == pytest.approx(1.08 * placed.frame.size)
        assert changed.frame.angle == changed.angle == 10.0
        assert changed.mesh is not None
        hand.key("Enter")
        assert Plain("lay_decal") in hand.main_view.take_requests()


def test_escape_releases_the_pointer_to_the_mouse() -> None:
    with rig(replace(first_view(bear()), select=SelectTool(through=True)), WINDOW) as hand:
        hand.key("U")
        for chord in (*WAY, "Space", "Down"):
            hand.key(chord)
        assert hand.main_view.work.view.selection.count
        hand.key("Escape")
        hand.frame(3)
        assert hand.main_view.work.view.selection.count == 0
        assert not hand.io.mouse_down[0]
        assert hand.main_view.work.view.select.tool == "brush"
        assert hand.main_view.work.transient.pointer.at is not None
        hand.move(120.0, 200.0)
        hand.frame(2)
        assert hand.main_view.work.transient.pointer.at is None
        hand.key("Escape")
        hand.key("Right")
        assert hand.strengths != [0.0, 0.0], "without a tool arrows are those of the layer"


def test_tool_keys_can_be_rebound_independently() -> None:
    try:
        assert bind({"point_press": "J", "nudge:0.01": "Left"}) == []
        assert TOOL_KEYS["J"].id == "point_press"
        assert "Space" not in TOOL_KEYS
        assert TOOL_KEYS["Left"].id == "point:-4,0", "a key may be both"
    finally:
        bind({})
