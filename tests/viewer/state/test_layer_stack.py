"""Layer stack by mouse, keys and command line: solo, lock, rename, move, gains and overshoot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from progdf.__main__ import main
from progdf.compose.layers import BLENDS
from progdf.compose.reference import Gains, Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES
from progdf.tidy import Step, tidy
from tests.helpers.stacks import Stack, bear_stack
from tests.helpers.ui_rig import HEAD, Rig, bear, first_view, rig
from viewer.camera.view_camera import ViewCamera, eye, to_camera
from viewer.commands.open_stack import stack_layers
from viewer.commands.stack_options import StackOptions
from viewer.panel import card, panel
from viewer.panel.slider import parse_strength
from viewer.state import facts, timeline
from viewer.state.commands import OnItem
from viewer.state.facts import layer_rows
from viewer.state.layers import (
    LONGEST_NAME,
    SLIDERS,
    add_layer,
    change_layer,
    largest_strength,
    move_layers,
    nudge_slider,
    rename_layer,
    replace_edit,
    show_all,
    slider_value,
    step_layers,
    toggle_solo,
    visible_layers,
    with_overshoot,
    with_slider_value,
)
from viewer.state.view_state import OVERSHOOT, LayerState, ViewState
from viewer.state.workspace import original

POINTS = (700, 640)
LEFT = POINTS[0] - panel.WIDTH_PX
THREE = ViewState(layers=(LayerState(0, "a", 0.5), LayerState(1, "b", 0.5), LayerState(2, "c", 0.5)))


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.5, 0.5), POINTS) as opened:
        yield opened


def click(hand: Rig, x: float, y: float) -> None:
    hand.move(x, y)
    hand.press()
    hand.release()


def toggle(hand: Rig, name: str, layer: int) -> None:
    y = HEAD + row(layer)
    hand.move(LEFT + 150, y)  # a hovered card has toggles
    click(hand, hand.at(name)[0], y)


def row(layer: int) -> float:
    """Return the distance of a layer's card below the top card; the last of two layers is on top."""
    return card.CARD_PX * (1 - layer)


def layers(hand: Rig) -> tuple[LayerState, ...]:
    return hand.main_view.work.view.layers


def names(hand: Rig) -> list[str]:
    return [layer.name for layer in layers(hand)]


def type_name(hand: Rig, text: str, end: imgui.Key = imgui.Key.enter) -> None:
    hand.frame(2)
    assert imgui.get_io().want_text_input
    imgui.get_io().add_input_characters_utf8(text)
    hand.frame()
    for down in (True, False):
        hand.modifier(end, down)
    hand.frame(2)


def test_number_follows_the_slider_in_the_same_frame(hand: Rig) -> None:
    top = round(HEAD + row(0)) - 12
    left = POINTS[0] - 80
    hand.move(*hand.slider(0, 0.5))
    hand.press()
    before = hand.image()[top : top + 24, left:]
    hand.move(*hand.slider(0, 0.8))
    shown = hand.image()[top : top + 24, left:]
    hand.frame(3)
    assert (shown != before).any()
    np.testing.assert_array_equal(hand.image()[top : top + 24, left:], shown)


def test_solo_layer_shows_even_if_hidden() -> None:
    view = toggle_solo(THREE, 1)
    view = change_layer(view, 1, lambda layer: LayerState(1, "b", 0.5, enabled=False, solo=True))
    assert [layer.name for layer in visible_layers(view)] == ["b"]
    assert [layer.name for layer in visible_layers(toggle_solo(view, 2))] == ["b", "c"]
    assert visible_layers(show_all(view)) == THREE.layers


def test_layers_move_within_the_stack_and_stop_at_its_ends() -> None:
    for at, order in ((0, "bac"), (1, "abc"), (2, "abc"), (3, "acb")):
        assert "".join(layer.name for layer in move_layers(THREE, (1,), at).layers) == order
    for at, order in ((0, "acb"), (1, "acb"), (2, "bac"), (3, "bac")):
        assert "".join(layer.name for layer in move_layers(THREE, (0, 2), at).layers) == order
    assert step_layers(THREE, (1, 2), 1) == step_layers(THREE, (0,), -1) == THREE


def test_layer_names_are_unique_single_lines_and_never_empty() -> None:
    assert rename_layer(THREE, 0, " b\n ").layers[0].name == "b-2"
    assert rename_layer(THREE, 0, "  \t ") == THREE
    assert rename_layer(THREE, 1, "b") == THREE
    assert len(rename_layer(THREE, 0, "x" * 500).layers[0].name) == LONGEST_NAME


def test_lock_holds_strength_and_gains() -> None:
    locked = LayerState(0, "a", 0.5, locked=True)
    for active_slider in SLIDERS:
        assert with_slider_value(locked, active_slider, 0.1) == locked
        assert (
            slider_value(with_slider_value(LayerState(0, "a", 0.5), active_slider, 0.1), active_slider) == 0.1
        )


def test_strength_stays_at_most_1_without_overshoot() -> None:
    over = with_overshoot(THREE, True)
    assert nudge_slider(over, 0, "strength", 0.6).layers[0].strength == 1.1
    assert nudge_slider(over, 0, "strength", 9.0).layers[0].strength == OVERSHOOT
    assert nudge_slider(over, 0, "color", 9.0).layers[0].gains.color == 1.0
    back = with_overshoot(nudge_slider(over, 0, "strength", 9.0), False)
    assert back.layers[0].strength == 1.0
    assert parse_strength("130%", largest_strength(over)) == OVERSHOOT


def test_keys_do_everything_that_the_cards_do(hand: Rig) -> None:
    hand.key("1")
    for chord, field in (("Shift+H", "solo"), ("Shift+L", "locked")):
        hand.key(chord)
        assert [getattr(layer, field) for layer in layers(hand)] == [False, True]
    hand.key("Right")
    assert hand.strengths == [0.5, 0.5], "locked"
    hand.key("Shift+L")
    hand.key("Right")
    assert hand.strengths == pytest.approx([0.5, 0.51])
    hand.key("H")
    hand.key("Alt+H")
    assert all(layer.enabled and not layer.solo for layer in layers(hand))
    hand.key("G")
    assert hand.main_view.work.view.unfolded == (1,)
    hand.key("Alt+Down")
    assert names(hand) == ["ears", "scarf"]
    assert hand.main_view.work.focus == 0, "the focus goes with its layer"
    hand.key("M")
    assert [layer.blend for layer in layers(hand)] == [BLENDS[0], ""], "on from adjust, the last"
    assert hand.main_view.work.view.blend == BLENDS[-1], "the rule of the stack stays"
    message = hand.main_view.work.message
    assert message is not None
    assert message.text == "Blend: Average (ears)"
    hand.key("O")
    for _ in range(9):
        hand.key("Shift+Right")
    assert hand.strengths == [OVERSHOOT, 0.5]
    hand.key("O")
    assert hand.strengths == [1.0, 0.5]


def test_alt_arrows_select_the_gains_that_the_edit_has(hand: Rig) -> None:
    hand.key("2")
    hand.key("Alt+Right")
    assert hand.main_view.work.active_slider == "color", (
        "a change of color moves neither geometry nor opacity"
    )
    assert hand.main_view.work.view.unfolded == (0,)
    hand.key("Shift+Left")
    assert layers(hand)[0].gains == Gains(color=0.9)
    assert hand.strengths == [0.5, 0.5]
    hand.key("Alt+Right")
    assert hand.main_view.work.active_slider == "texture"
    hand.key("Alt+Right")
    assert hand.main_view.work.active_slider == "strength"
    hand.key("1")
    for _ in range(3):
        hand.key("Alt+Left")
    assert hand.main_view.work.active_slider == "geometry"


def test_every_layer_change_is_one_undo_entry(hand: Rig) -> None:
    before = hand.picture()
    for i, chord in enumerate(("Shift+H", "Shift+L", "Alt+Down", "O"), 1):
        hand.key(chord)
        assert len(hand.main_view.work.past.past) == i
    assert not np.array_equal(hand.picture(), before)
    for _ in range(4):
        hand.key("Ctrl+Z")
    assert hand.main_view.work.view == first_view(bear(), 0.5, 0.5)
    hand.rest()  # until the undo message has disappeared
    assert np.array_equal(hand.picture(), before)


def test_unfolding_is_no_undo_entry(hand: Rig) -> None:
    hand.key("G")
    assert hand.main_view.work.past.past == ()


@pytest.mark.parametrize(("name", "field"), [("solo", "solo"), ("lock", "locked")])
def test_card_toggles_change_only_their_own_layer(hand: Rig, name: str, field: str) -> None:
    toggle(hand, name, 1)
    assert [getattr(layer, field) for layer in layers(hand)] == [False, True]
    assert len(hand.main_view.work.past.past) == 1
    toggle(hand, name, 1)
    assert not any(getattr(layer, field) for layer in layers(hand))


def test_alt_click_on_an_eye_shows_only_its_layer(hand: Rig) -> None:
    hand.modifier(imgui.Key.mod_alt)
    click(hand, *hand.at("eye"))
    hand.modifier(imgui.Key.mod_alt, False)
    assert [(layer.enabled, layer.solo) for layer in layers(hand)] == [(True, False), (True, True)]


def test_solo_layer_looks_like_the_others_at_zero(hand: Rig) -> None:
    toggle(hand, "solo", 1)
    alone = hand.picture()
    toggle(hand, "solo", 1)
    hand.drag(hand.slider(0, 0.5), hand.slider(0, -0.5))
    assert hand.strengths == [0.0, 0.5]
    assert np.array_equal(hand.picture(), alone)


def test_original_is_shown_also_while_a_layer_is_solo() -> None:
    view = toggle_solo(THREE, 0)
    assert visible_layers(original(view)) == ()


def test_locked_slider_does_not_move(hand: Rig) -> None:
    toggle(hand, "lock", 0)
    hand.drag(hand.slider(0, 0.5), hand.slider(0, 0.9))
    assert hand.strengths == [0.5, 0.5]
    click(hand, POINTS[0] - 44, HEAD + row(0))
    hand.frame(2)
    assert not imgui.get_io().want_text_input


def test_gain_dragged_in_the_fold_scales_only_its_kind(hand: Rig) -> None:
    toggle(hand, "fold", 1)
    before = hand.main_view.engine.gaussians(hand.main_view.work.view).sh0.clone()
    _, y = hand.at("##geometry")
    hand.drag((POINTS[0] - 76, y), (LEFT + 90, y))
    assert layers(hand)[1].gains == Gains(geometry=0.0)
    assert len(hand.main_view.work.past.past) == 1
    after = hand.main_view.engine.gaussians(hand.main_view.work.view)
    assert torch.equal(after.sh0, before)
    assert torch.equal(after.means, bear().scene.means)
    hand.pause(0.5)
    hand.double_click(LEFT + 150, y)
    assert layers(hand)[1].gains == Gains(), "a double click brings all of it back"


def test_dragging_a_name_down_moves_its_layer_as_one_entry(hand: Rig) -> None:
    hand.move(LEFT + 100, HEAD)
    hand.press()
    for y in (HEAD + 10, HEAD + 60, HEAD + card.CARD_PX + 30):
        hand.move(LEFT + 100, y)
        assert names(hand) == ["scarf", "ears"], "the order changes with the release"
    hand.release()
    assert names(hand) == ["ears", "scarf"]
    assert hand.main_view.work.focus == 0
    assert len(hand.main_view.work.past.past) == 1
    hand.key("Ctrl+Z")
    assert names(hand) == ["scarf", "ears"]
    assert hand.main_view.work.focus == 1


def test_dragging_a_name_back_changes_nothing(hand: Rig) -> None:
    hand.drag((LEFT + 100, HEAD), (LEFT + 100, HEAD + 30))
    assert hand.main_view.work.past.past == ()


def test_double_click_on_a_name_renames_the_layer(hand: Rig) -> None:
    hand.double_click(LEFT + 100, HEAD + row(1))
    type_name(hand, "golden ears")
    assert names(hand) == ["scarf", "golden ears"]
    assert len(hand.main_view.work.past.past) == 1
    assert not imgui.get_io().want_text_input
    assert hand.main_view.work.renaming is None


def test_enter_renames_the_focused_layer_and_escape_cancels(hand: Rig) -> None:
    hand.key("2")
    hand.key("Enter")
    type_name(hand, "nothing", imgui.Key.escape)
    assert names(hand) == ["scarf", "ears"]
    assert hand.main_view.work.renaming is None
    hand.key("Enter")
    type_name(hand, "ears")
    assert names(hand) == ["ears-2", "ears"]


def test_click_on_a_splat_focuses_its_layer_but_a_drag_does_not(hand: Rig) -> None:
    places = bear().scene.means[bear().gdfs[1].region.members]
    ear = places[places[:, 0] > 0].mean(0)
    hand.key("2")
    at = on_screen(hand, ear)
    hand.drag(at, (at[0] + 40, at[1]))
    assert hand.main_view.work.focus == 0
    hand.pause(0.5)  # avoids a double click
    at = on_screen(hand, ear)
    before = hand.main_view.work.view
    click(hand, *at)
    assert hand.main_view.work.focus == 1
    assert hand.main_view.work.view == before
    click(hand, 5.0, 5.0)
    assert hand.main_view.work.focus == 1, "the background is nobody's"


def on_screen(hand: Rig, point: torch.Tensor) -> tuple[float, float]:
    camera = to_camera(hand.main_view.work.view.camera, round(LEFT), POINTS[1])
    x, y, z = (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]).tolist()
    return float(camera.K[0, 0]) * x / z + LEFT / 2, float(camera.K[1, 1]) * y / z + POINTS[1] / 2


def test_double_click_sets_the_pivot(hand: Rig) -> None:
    before = hand.main_view.work.view.camera
    hand.double_click(*on_screen(hand, bear().scene.means[bear().gdfs[0].region.members].mean(0)))
    after = hand.main_view.work.view.camera
    assert after.pivot != before.pivot
    assert eye(after) == pytest.approx(eye(before), abs=1e-4)


def test_layer_rows_count_shared_members_and_list_gain_kinds() -> None:
    stack = bear()
    rows = layer_rows(stack.scene, (stack.gdfs[0], stack.gdfs[1], stack.gdfs[0]))
    scarf, ears = (len(gdf.region) for gdf in stack.gdfs)
    assert [row.shared for row in rows] == [(scarf, 0, scarf), (0, ears, 0), (scarf, 0, scarf)]
    assert [row.kinds for row in rows[:2]] == [{"color", "texture"}, {"color", "geometry", "texture"}]


def test_thumbnail_of_a_removal_shows_the_removed_part() -> None:
    stack = bear()
    removed = tidy(stack.scene, [Step("remove", stack.gdfs[0].region)], "removed")
    assert np.ptp(facts.draw_thumbnail(stack.scene, removed, ViewCamera()).astype(int)) > 100


def test_thumbnail_of_a_large_region_uses_a_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = bear()
    camera = ViewCamera()
    whole = facts.draw_thumbnail(stack.scene, stack.gdfs[0], camera).astype(float)
    monkeypatch.setattr(facts, "MAX_COUNTED_MEMBERS", len(stack.gdfs[0].region) // 2)
    part = facts.draw_thumbnail(stack.scene, stack.gdfs[0], camera).astype(float)
    assert 0.0 < abs(part - whole).mean() < 0.25 * abs(whole - whole[0, 0]).mean()


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Stack, Path]:
    stack = bear_stack(800)
    folder = tmp_path_factory.mktemp("layers")
    stack.save(folder)
    return stack, folder


def test_export_and_render_accept_gains_solo_and_overshoot(
    saved: tuple[Stack, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack, folder = saved
    monkeypatch.chdir(folder)
    options = ("--set", "scarf=1", "--set", "ears=1.1", "--overshoot", "--gain", "ears:geometry=0.5")
    edits = ("bear.ply", "scarf.gdf", "ears.gdf", *options)
    assert main(["export", *edits, "--solo", "ears", "-o", "a.ply"]) == 0
    expected = compose_layers(stack.scene, [Layer(stack.gdfs[1], 1.1, gains=Gains(geometry=0.5))])
    read = load_ply("a.ply")
    for name in set(ATTRIBUTES) - {"quats"}:
        assert torch.equal(getattr(read, name), getattr(expected, name))
    small = ("--size", "64x48", "--engine", "cpu")
    for out, more in (("a.png", ("--solo", "ears")), ("b.png", ())):
        assert main(["render", *edits, *more, *small, "-o", out]) == 0
    assert Path("a.png").read_bytes() != Path("b.png").read_bytes()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"gain": ["scarf=0.5"]}, "write NAME:KIND=G, for example scarf:color=0.5"),
        ({"gain": ["scarf:shine=0.5"]}, "the gains are geometry, opacity, color"),
        ({"gain": ["scarf:color=2"]}, "the gain '2' is not a number from 0 to 1"),
        ({"gain": ["scarf:color=nan"]}, "not a number from 0 to 1"),
        ({"gain": ["hat:color=1"]}, "there is no edit of that name"),
        ({"solo": ["hat"]}, "--solo hat: there is no edit of that name"),
        ({"set": ["scarf=1.1"]}, "not a number from 0 to 1"),
        ({"set": ["scarf=1.3"], "overshoot": True}, "not a number from 0 to 1.2"),
    ],
)
def test_invalid_layer_option_is_one_clear_line(options: dict[str, object], told: str) -> None:
    with pytest.raises(ProgdfError, match=told) as error:
        stack_layers(bear().gdfs, StackOptions(scene=Path("bear.ply"), **options))  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_sweep_of_a_layer_hidden_by_solo_is_refused(
    saved: tuple[Stack, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(saved[1])
    edits = ("bear.ply", "scarf.gdf", "ears.gdf", "--solo", "ears")
    assert main(["render", *edits, "--sweep", "scarf", "-o", "a.gif"]) == 2
    assert "ears is shown alone and hides it; show scarf alone too" in capsys.readouterr().err


def menu(hand: Rig, layer: int, command: str) -> None:
    """Right-click a layer's card and pick a command."""
    hand.pause(0.5)
    hand.move(LEFT + 150, HEAD + row(layer))
    hand.press(1)
    hand.release(1)
    click(hand, *hand.at(command))


def test_top_card_is_the_top_layer(hand: Rig) -> None:
    """The rule "over" puts the last layer on top, and it has the first card."""
    click(hand, LEFT + 100, HEAD)
    assert hand.main_view.work.focus == 1
    hand.key("2")
    assert hand.main_view.work.focus == 0
    hand.key("Alt+Up")
    assert names(hand) == ["ears", "scarf"]
    hand.main_view.store.change(add_layer(hand.main_view.work.view, 0, "new"))
    hand.settle()
    click(hand, LEFT + 100, HEAD)
    assert layers(hand)[hand.main_view.work.focus or 0].name == "new"


def test_layer_deleted_from_its_menu_is_restored_by_undo(hand: Rig) -> None:
    before = hand.main_view.work.view
    picture = hand.picture()
    menu(hand, 1, "remove")
    assert names(hand) == ["scarf"]
    assert hand.main_view.work.focus == 0
    assert not np.array_equal(hand.picture(), picture)
    hand.key("Ctrl+Z")
    assert hand.main_view.work.view.layers == before.layers
    hand.move(5.0, 5.0)
    hand.rest()
    assert np.array_equal(hand.picture(), picture)
    hand.key("1")
    hand.key("Ctrl+Delete")
    hand.key("Ctrl+Delete")
    assert names(hand) == []
    assert hand.main_view.work.focus is None
    hand.key("Ctrl+Delete")


def test_layer_menu_renames_and_requests_other_actions(hand: Rig) -> None:
    menu(hand, 0, "rename")
    type_name(hand, "shawl")
    assert names(hand) == ["shawl", "ears"]
    menu(hand, 0, "duplicate")
    menu(hand, 1, "replace")
    assert hand.main_view.take_requests() == (OnItem("duplicate", 0), OnItem("replace", 1))
    toggle(hand, "menu", 0)
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup.value)
    hand.modifier(imgui.Key.escape)
    hand.frame(2)
    assert not imgui.is_popup_open("", imgui.PopupFlags_.any_popup.value)


def test_double_click_on_a_slider_resets_it_to_its_default(hand: Rig) -> None:
    hand.double_click(*hand.slider(1, 0.5))
    assert hand.strengths == [0.5, 0.0]
    assert len(hand.main_view.work.past.past) == 1, "on the handle it is one step"
    lens = (LEFT - 60, 189.0)  # in the view popover
    hand.pause(0.5)
    click(hand, LEFT - 24, 24.0)
    click(hand, *lens)
    assert hand.main_view.work.view.camera.fov_y != 45.0
    hand.pause(0.5)
    hand.double_click(*lens)
    hand.frame(3)
    assert hand.main_view.work.view.camera.fov_y == 45.0


def test_replaced_layer_keeps_its_position_strength_and_keys(hand: Rig) -> None:
    view = change_layer(hand.main_view.work.view, 0, lambda layer: LayerState(0, "scarf", 0.3, paint="x"))
    view = timeline_with_key(view)
    after = replace_edit(view, 0, 7, "ears")
    assert after.layers[0] == LayerState(7, "ears-2", 0.3)
    assert after.layers[1] == view.layers[1]
    assert dict(after.timeline.keys[0].strengths) == {7: 0.3, 1: 0.5}


def timeline_with_key(view: ViewState) -> ViewState:
    return replace(view, timeline=timeline.with_key(view.timeline, 0, view))
