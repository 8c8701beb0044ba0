"""Panel without a GPU: scripted input on the real widgets and the resulting changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import HEAD, SLIDER_INSET, TRACK, center, item_box
from viewer.camera.view_camera import Bounds, ViewCamera, axes
from viewer.panel import card, panel, view_settings
from viewer.panel.slider import parse_strength
from viewer.state import history, workspace
from viewer.state.actions import perform
from viewer.state.commands import Action, Plain
from viewer.state.facts import LayerRow
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import SceneFacts, Workspace
from viewer.ui import widgets
from viewer.ui.context import UiContext
from viewer.ui.overlay import Area

SIZE = (1024, 640)
ROW = LayerRow(3120, (0.2, 0.6, 0.3), (0.0, 0.25, 0.5, 0.75, 1.0), "stripes:#30a050", Bounds())
FACTS = SceneFacts("bear.ply", 24_000, Bounds(), (ROW, ROW))
STACK = ViewState(
    camera=ViewCamera(fov_y=40.1),
    layers=(LayerState(0, "scarf", 0.5), LayerState(1, "body", 0.0)),
    background=(0.1, 0.2, 0.3),
)


@dataclass
class Hand:
    """Draw the panel frame by frame like the main view, and keep its result."""

    ui: UiContext
    work: Workspace
    actions: list[Action] = field(default_factory=list)

    def frame(self) -> None:
        imgui.new_frame()
        self.work = panel.draw(self.work, FACTS, panel.Pictures(), False, self.ui, self.actions)
        area = Area((SIZE[0] - panel.WIDTH_PX) * self.ui.scale, SIZE[1] * self.ui.scale)
        view = view_settings.draw_view(self.work.view, area, 0.0, self.ui, self.actions)
        self.work = replace(self.work, view=view)
        imgui.render()
        if not imgui.is_any_item_active():
            self.work = workspace.record_undo(self.work)

    def move(self, x: float, y: float) -> None:
        imgui.get_io().add_mouse_pos_event(x * self.ui.scale, y * self.ui.scale)
        self.frame()

    def button(self, down: bool) -> None:
        imgui.get_io().add_mouse_button_event(0, down)
        self.frame()

    def click(self, x: float, y: float) -> None:
        self.move(x, y)
        self.button(True)
        self.button(False)
        self.frame()

    def click_item(self, name: str, number: int = 0) -> None:
        x, y = center(item_box(self.frame, name, number))
        self.click(x / self.ui.scale, y / self.ui.scale)

    def hold(self, key: imgui.Key, down: bool) -> None:
        imgui.get_io().add_key_event(key, down)
        self.frame()

    def type(self, text: str) -> None:
        imgui.get_io().add_input_characters_utf8(text)
        self.frame()
        for down in (True, False):
            self.hold(imgui.Key.enter, down)
        self.frame()

    @property
    def strengths(self) -> list[float]:
        return [layer.strength for layer in self.work.view.layers]


def hand_on(view: ViewState, scale: float = 1.0) -> Hand:
    hand = Hand(UiContext(scale), workspace.new_workspace(view))
    io = imgui.get_io()
    io.display_size = imgui.ImVec2(SIZE[0] * scale, SIZE[1] * scale)
    io.delta_time = 1 / 60
    io.backend_flags |= imgui.BackendFlags_.renderer_has_textures.value
    for _ in range(3):
        hand.frame()
    return hand


@pytest.fixture(params=[1.0, 2.0], ids=["1x", "2x"])
def hand(request: pytest.FixtureRequest) -> Iterator[Hand]:
    opened = hand_on(STACK, request.param)
    yield opened
    opened.ui.close()


LEFT = SIZE[0] - panel.WIDTH_PX
START = LEFT + SLIDER_INSET
SPAN = panel.WIDTH_PX - 2 * SLIDER_INSET
TRACKS = (TRACK + card.CARD_PX, TRACK)  # heights of the two sliders' tracks; the last layer lies on top
EYES = (HEAD + card.CARD_PX, HEAD)


def at(strength: float) -> float:
    return START + strength * SPAN


def test_drawing_changes_nothing(hand: Hand) -> None:
    assert hand.work == workspace.new_workspace(STACK)
    assert hand.actions == []


def test_drag_moves_the_slider_and_makes_one_undo_entry(hand: Hand) -> None:
    hand.move(at(0.5), TRACKS[0])
    hand.button(True)
    for strength in (0.55, 0.6, 0.9, 0.75):
        hand.move(at(strength), TRACKS[0])
        assert len(hand.work.past.past) == 0, "the entry comes with the release"
    hand.button(False)
    assert hand.strengths == pytest.approx([0.75, 0.0], abs=0.01)
    assert len(hand.work.past.past) == 1
    undone = perform(hand.work, Plain("undo"), FACTS)
    assert undone.view == STACK
    assert perform(undone, Plain("redo"), FACTS).view == hand.work.view


def test_drag_back_to_the_start_leaves_no_undo_entry(hand: Hand) -> None:
    hand.move(at(0.5), TRACKS[0])
    hand.button(True)
    hand.move(at(0.8), TRACKS[0])
    hand.move(at(0.5), TRACKS[0])
    hand.button(False)
    assert hand.strengths == [0.5, 0.0]
    assert hand.work.past.past == ()


def test_pressing_the_handle_off_center_does_not_make_it_jump(hand: Hand) -> None:
    hand.move(at(0.5) + 4, TRACKS[0])
    hand.button(True)
    assert hand.strengths[0] == 0.5
    hand.button(False)


def test_pressing_the_track_moves_the_handle_there(hand: Hand) -> None:
    hand.click(at(0.25), TRACKS[1])
    assert hand.strengths == pytest.approx([0.5, 0.25], abs=0.005)
    assert hand.work.focus == 1


def test_drag_beyond_the_ends_stops_at_exactly_0_and_1(hand: Hand) -> None:
    for x, expected in ((SIZE[0] - 1, 1.0), (LEFT - 300, 0.0)):
        hand.move(at(hand.strengths[0]), TRACKS[0])
        hand.button(True)
        hand.move(x, TRACKS[0] + 50)
        hand.button(False)
        assert hand.strengths[0] == expected


def test_shift_drags_ten_times_finer(hand: Hand) -> None:
    hand.move(at(0.5), TRACKS[0])
    hand.hold(imgui.Key.mod_shift, True)
    hand.button(True)
    hand.move(at(0.7), TRACKS[0])
    hand.button(False)
    hand.hold(imgui.Key.mod_shift, False)
    assert hand.strengths[0] == pytest.approx(0.52, abs=1e-3)


def test_move_in_the_frame_of_the_shift_press_counts_in_full(hand: Hand) -> None:
    hand.move(at(0.5), TRACKS[0])
    hand.button(True)
    imgui.get_io().add_mouse_pos_event(at(0.7) * hand.ui.scale, TRACKS[0] * hand.ui.scale)
    hand.hold(imgui.Key.mod_shift, True)
    assert hand.strengths[0] == pytest.approx(0.7, abs=4e-3)
    hand.move(at(0.8), TRACKS[0])
    hand.button(False)
    hand.hold(imgui.Key.mod_shift, False)
    assert hand.strengths[0] == pytest.approx(0.71, abs=4e-3)


def test_mouse_sets_a_slider_within_half_a_percent() -> None:
    assert 1.0 / SPAN < 0.005


def test_ctrl_click_types_a_value(hand: Hand) -> None:
    hand.hold(imgui.Key.mod_ctrl, True)
    hand.click(at(0.1), TRACKS[0])
    hand.hold(imgui.Key.mod_ctrl, False)
    assert hand.strengths[0] == 0.5
    hand.frame()
    assert imgui.get_io().want_text_input
    hand.type("37%")
    assert hand.strengths[0] == pytest.approx(0.37)
    assert not imgui.get_io().want_text_input
    assert len(hand.work.past.past) == 1


def test_escape_discards_the_typed_value(hand: Hand) -> None:
    hand.hold(imgui.Key.mod_ctrl, True)
    hand.click(at(0.1), TRACKS[0])
    hand.hold(imgui.Key.mod_ctrl, False)
    imgui.get_io().add_input_characters_utf8("0.9")
    hand.frame()
    for down in (True, False):
        hand.hold(imgui.Key.escape, down)
    hand.frame()
    assert hand.strengths[0] == 0.5


def test_opening_a_value_without_a_change_does_not_round_it() -> None:
    view = ViewState(layers=(LayerState(0, "scarf", 0.123456),))
    hand = hand_on(view)
    hand.click(SIZE[0] - 40, EYES[1])
    hand.frame()
    assert imgui.get_io().want_text_input
    hand.click(LEFT + 150, 500)
    hand.frame()
    assert not imgui.get_io().want_text_input
    assert hand.work.view == view
    hand.ui.close()


def test_click_on_the_number_types_a_value(hand: Hand) -> None:
    hand.click(SIZE[0] - 40, EYES[1])
    hand.frame()
    hand.type("0.125")
    assert hand.strengths[1] == 0.125


def test_eye_hides_only_its_layer(hand: Hand) -> None:
    hand.click_item("eye")
    assert [layer.enabled for layer in hand.work.view.layers] == [True, False]
    assert hand.strengths == [0.5, 0.0]
    assert len(hand.work.past.past) == 1


def test_click_on_a_card_focuses_it(hand: Hand) -> None:
    assert hand.work.focus == 1
    hand.click(LEFT + 150, EYES[0])
    assert hand.work.focus == 0
    assert hand.work.view == STACK


def test_blend_rule_is_chosen_from_the_list_and_can_be_undone(hand: Hand) -> None:
    hand.click_item("about layers")
    hand.click_item("##Add")
    assert hand.work.view.blend == "sum"
    assert perform(hand.work, Plain("undo"), FACTS).view == STACK


def test_buttons_request_the_same_actions_as_keys(hand: Hand) -> None:
    hand.click_item("help")
    hand.click_item("picture")
    assert hand.actions == [Plain("help"), Plain("picture")]


def test_undo_button_is_disabled_without_history(hand: Hand) -> None:
    hand.click_item("undo")
    assert hand.actions == []
    hand.click(at(0.3), TRACKS[1])
    hand.click_item("undo")
    assert hand.actions == [Plain("undo")]


def test_up_axis_button_rolls_the_camera_upright() -> None:
    hand = hand_on(ViewState())
    hand.click_item("view")
    hand.click_item("−Z")
    assert hand.work.view.camera.up == (0.0, 0.0, -1.0)
    assert history.next_undo(hand.work.past) == "up axis"
    hand.ui.close()


def test_up_direction_of_the_view_can_become_the_up_axis() -> None:
    hand = hand_on(ViewState())
    before = axes(hand.work.view.camera)
    hand.click_item("view")
    hand.click_item("View")
    after = axes(hand.work.view.camera)
    assert hand.work.view.camera.elevation == pytest.approx(0.0)
    for old, new in ((before.up, after.up), (before.right, after.right)):
        assert new == pytest.approx(old), "the picture does not turn"
    hand.ui.close()


def test_wheel_over_the_panel_scrolls_without_moving_sliders() -> None:
    layers = tuple(LayerState(i % 2, f"layer {i}", 0.5) for i in range(12))
    hand = hand_on(ViewState(layers=layers))
    hand.move(at(0.5), TRACKS[0])
    imgui.get_io().add_mouse_wheel_event(0.0, -3.0)
    for _ in range(4):
        hand.frame()
    assert hand.work.view.layers == layers
    assert imgui.get_io().want_capture_mouse
    hand.ui.close()


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.7", 0.7), (" 70 % ", 0.7), ("0,25", 0.25), ("1.5", 1.0), ("-3", 0.0), ("abc", None), ("", None)],
)
def test_typed_strengths_accept_percent_comma_and_spaces(text: str, value: float | None) -> None:
    assert parse_strength(text) == value


@pytest.mark.parametrize("text", ["nan", "inf", "1e999", "%"])
def test_typed_nonsense_never_gives_a_strength_outside_0_to_1(text: str) -> None:
    value = parse_strength(text)
    assert value is None or 0.0 <= value <= 1.0


def test_long_names_are_shortened_to_fit() -> None:
    hand = hand_on(STACK)
    imgui.new_frame()
    room = imgui.calc_text_size("a long name").x
    assert widgets.elide("a long name", room) == "a long name"
    short = widgets.elide("a long name that goes on and on", room)
    assert short.endswith("…")
    assert imgui.calc_text_size(short).x <= room
    imgui.render()
    hand.ui.close()
