"""Keys and playhead: interpolation between keys, key actions and playback."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from viewer.camera import views
from viewer.camera.view_camera import Bounds, ViewCamera, axes, cross, dot, to_camera
from viewer.state import history, timeline, workspace
from viewer.state.actions import ACTIONS, perform
from viewer.state.commands import Action, ChooseKeys, OnItem, Plain, WithText, WithValue
from viewer.state.facts import LayerRow
from viewer.state.timeline import Player
from viewer.state.view_state import Keyframe, LayerState, Timeline, ViewState
from viewer.state.workspace import SceneFacts, Workspace
from viewer.ui.keys import KEYS

LAYERS = (LayerState(0, "scarf", 0.2), LayerState(1, "ears", 0.4))
FACTS = SceneFacts("bear.ply", 3, Bounds(), (LayerRow(3, (0.5,) * 3, (), "", Bounds()),) * 2)


def view(scarf: float = 0.2, ears: float = 0.4, **camera: object) -> ViewState:
    layers = (replace(LAYERS[0], strength=scarf), replace(LAYERS[1], strength=ears))
    return ViewState(camera=replace(ViewCamera(), **camera), layers=layers)


def two_keys(easing: str = "smooth", length: int = 20) -> Timeline:
    film = timeline.with_key(Timeline(length=length), 0, view(0.0, 1.0, azimuth=170.0, distance=1.0))
    film = timeline.with_key(film, length, view(1.0, 0.5, azimuth=-170.0, distance=100.0))
    return timeline.set_easing(film, timeline.keys_at(film, 0), easing)


def shift(made: Timeline, frame: int, to: int) -> Timeline:
    """Move the keys of all rows from one frame to another."""
    return timeline.shift_keys(made, timeline.keys_at(made, frame), to - frame)


def act(work: Workspace, *actions: Action) -> Workspace:
    for action in actions:
        work = workspace.record_undo(perform(work, action, FACTS))
    return work


tracks = st.lists(
    st.tuples(st.integers(0, 200), st.sampled_from(views.EASINGS), st.floats(0, 1)),
    min_size=1,
    max_size=6,
    unique_by=lambda point: point[0],
).map(sorted)


@given(tracks, st.floats(-10, 210))
def test_value_between_two_keys_stays_in_their_range(points: list[views.Point], frame: float) -> None:
    found = views.value_between(points, frame)
    before = [p for p in points if p[0] <= frame] or points[:1]
    after = [p for p in points if p[0] >= frame] or points[-1:]
    low, high = sorted((before[-1][2], after[0][2]))
    assert low <= found <= high


@given(tracks)
def test_value_at_a_key_is_exact(points: list[views.Point]) -> None:
    assert [views.value_between(points, point[0]) for point in points] == [point[2] for point in points]


def test_smooth_easing_starts_and_ends_slowly_and_never_halts_between() -> None:
    points = [(0, "smooth", 0.0), (10, "smooth", 0.5), (20, "smooth", 1.0)]
    steps = [views.value_between(points, f + 1) - views.value_between(points, f) for f in range(20)]
    assert steps[0] < 0.5 * steps[9]
    assert steps[-1] < 0.5 * steps[10]
    assert steps[9] == pytest.approx(steps[10])
    assert min(steps[5:15]) > 0.04


def test_smooth_easing_has_zero_slope_at_a_turning_point() -> None:
    points = [(0, "smooth", 0.0), (10, "smooth", 1.0), (20, "smooth", 0.0)]
    assert 1.0 - views.value_between(points, 9.9) < 1e-3
    assert 1.0 - views.value_between(points, 10.1) < 1e-3


def test_linear_is_even_and_hold_jumps_at_the_next_key() -> None:
    assert views.value_between([(0, "linear", 0.0), (10, "smooth", 1.0)], 3) == pytest.approx(0.3)
    held = [(0, "hold", 0.0), (10, "smooth", 1.0)]
    assert (views.value_between(held, 9), views.value_between(held, 10)) == (0.0, 1.0)


def test_camera_turns_the_shortest_way_and_distance_is_geometric() -> None:
    middle = timeline.camera_at(two_keys(), 10)
    assert middle is not None
    assert abs(middle.azimuth) == pytest.approx(180.0)
    assert middle.distance == pytest.approx(10.0)


def test_azimuth_can_turn_more_than_once_over_several_keys() -> None:
    assert views.unwrap([0.0, 170.0, -20.0, 150.0, 0.0]) == [0.0, 170.0, 340.0, 510.0, 360.0]


ups = st.sampled_from([(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0.8, 0.0)])


@given(ups, ups, st.floats(-180, 180), st.floats(-90, 90), st.integers(0, 20))
@settings(deadline=None)
def test_camera_turns_along_one_arc_between_any_two_up_axes(
    here: tuple[float, float, float],
    there: tuple[float, float, float],
    azimuth: float,
    elevation: float,
    frame: int,
) -> None:
    assume(here != there)  # otherwise it stays level and may leave the arc
    cameras = (
        ViewCamera(up=here, azimuth=20.0, elevation=10.0),
        ViewCamera(up=there, azimuth=azimuth, elevation=elevation),
    )
    found = views.camera_between([(0, "linear", cameras[0]), (20, "linear", cameras[1])], frame)
    picture = axes(found)
    ends = [axes(camera) for camera in cameras]
    assert bool(to_camera(found, 64, 48).viewmat.isfinite().all())
    assert math.dist(cross(picture.right, picture.up), picture.back) < 1e-6

    def angle(a: object, b: object) -> float:
        trace = sum(dot(getattr(a, n), getattr(b, n)) for n in ("right", "up", "back"))
        return math.acos(max(-1.0, min(1.0, (trace - 1.0) / 2.0)))

    whole = angle(ends[0], ends[1])
    assert angle(ends[0], picture) + angle(picture, ends[1]) <= whole + 1e-2
    if frame in (0, 20):
        assert found == cameras[frame // 20]


def test_camera_turns_evenly_between_up_axes() -> None:
    here = ViewCamera(up=(1, 0, 0), azimuth=109.0, elevation=-8.0)
    there = ViewCamera(up=(0.6, 0.8, 0.0), azimuth=80.0, elevation=-60.0)
    keys = [(0, "linear", here), (20, "linear", there)]

    def turned(frame: int) -> float:
        """Return the angle from the first camera, degrees."""
        first = axes(here)
        picture = axes(views.camera_between(keys, frame))
        trace = sum(dot(getattr(first, name), getattr(picture, name)) for name in ("right", "up", "back"))
        return math.degrees(math.acos(min(1.0, (trace - 1.0) / 2.0)))

    assert [turned(frame) for frame in (5, 10, 15)] == pytest.approx([6.58, 13.16, 19.74], abs=0.01)


def test_values_are_constant_before_the_first_and_after_the_last_key() -> None:
    film = timeline.set_length(shift(two_keys(), 0, 5), 40)
    assert timeline.state_at(film, 0, view()).layers == timeline.state_at(film, 5, view()).layers
    assert timeline.state_at(film, 40, view()).camera == timeline.state_at(film, 20, view()).camera


def test_keys_ignore_later_and_missing_edits() -> None:
    third = LayerState(2, "frost", 0.7)
    shown = timeline.state_at(two_keys(), 20, replace(view(), layers=(LAYERS[1], third)))
    assert [layer.strength for layer in shown.layers] == [0.5, 0.7]


def test_keys_stay_ordered_distinct_and_on_the_timeline() -> None:
    film = timeline.with_key(two_keys(), 7, view())
    assert [key.frame for key in film.keys] == [0, 7, 20]
    assert shift(film, 7, 20) == film
    assert shift(film, 7, 21) == film
    assert shift(film, 7, -1) == film
    assert [key.frame for key in shift(film, 0, 12).keys] == [7, 12, 20]
    assert [key.frame for key in timeline.without_keys(film, timeline.keys_at(film, 7)).keys] == [0, 20]


def test_timeline_is_never_shorter_than_its_last_key() -> None:
    assert timeline.set_length(two_keys(), 3).length == 20
    assert timeline.set_length(Timeline(), -5).length == 1
    assert timeline.with_fps(Timeline(), 0).fps == 1


def test_key_set_again_takes_the_new_state_and_keeps_its_easing() -> None:
    again = timeline.with_key(two_keys("hold"), 0, view(0.6))
    assert again.keys[0].strengths == ((0, 0.6), (1, 0.4))
    assert again.keys[0].easing == "hold"


def test_ping_pong_film_does_not_repeat_its_end_frames() -> None:
    there = Timeline(length=3)
    assert list(timeline.film_frames(there)) == [0, 1, 2, 3]
    assert list(timeline.film_frames(replace(there, ping_pong=True))) == [0, 1, 2, 3, 2, 1]


@pytest.mark.parametrize("ping_pong", [False, True])
def test_playback_shows_the_film_frames_in_order_at_its_rate(ping_pong: bool) -> None:
    film = replace(two_keys(length=3), ping_pong=ping_pong, fps=10)
    player = Player(playing=True)
    seen = [0]
    for _ in range(11):
        player = timeline.advance(player, film, 0.1 + 1e-9)
        seen.append(player.frame)
    assert seen == (list(timeline.film_frames(film)) * 3)[:12]


def test_turntable_is_even_and_loops_seamlessly() -> None:
    start = ViewCamera(azimuth=100.0, elevation=20.0)
    turn = timeline.turntable(start, 24, 1.5)
    frames = list(timeline.film_frames(turn))
    assert len(frames) == 36
    cameras = [timeline.camera_at(turn, frame) for frame in frames]
    assert cameras[0] == start
    for camera, after in zip(cameras, [*cameras[1:], cameras[0]], strict=True):
        assert camera is not None
        assert after is not None
        assert (after.azimuth - camera.azimuth) % 360.0 == pytest.approx(10.0)
        assert replace(after, azimuth=0.0) == replace(start, azimuth=0.0)


def test_slider_film_moves_sliders_in_turn_and_keeps_the_others() -> None:
    one, both = (timeline.slider_film(view(), gdfs, 10, 2.0) for gdfs in ([1], [1, 0]))
    assert [timeline.strengths_at(one, frame) for frame in (0, 5, 10)] == [
        {0: 0.2, 1: s} for s in (0.0, pytest.approx(0.5), 1.0)
    ]
    assert [timeline.strengths_at(both, frame) for frame in (0, 10, 20)] == [
        {1: 0.0, 0: 0.0},
        {1: 1.0, 0: 0.0},
        {1: 1.0, 0: 1.0},
    ]
    assert len(list(timeline.film_frames(both))) == 40


def test_slow_frame_skips_film_frames_to_keep_the_rate() -> None:
    film = replace(two_keys(length=20), fps=10)
    fast = Player(playing=True)
    slow = Player(playing=True)
    for _ in range(47):
        fast = timeline.advance(fast, film, 0.0155)
    slow = timeline.advance(slow, film, 47 * 0.0155)
    assert fast.frame == slow.frame == 7


def test_key_is_set_at_the_playhead_and_can_be_undone() -> None:
    work = act(workspace.new_workspace(view(0.3, azimuth=33.0)), WithValue("seek", 12), Plain("key"))
    assert work.view.timeline.keys == (Keyframe(12, ((0, 0.3), (1, 0.4)), work.view.camera),)
    assert work.player.shown
    undone = act(work, Plain("undo"))
    assert undone.view.timeline.keys == ()
    assert act(undone, Plain("redo")).view.timeline == work.view.timeline


def test_playhead_sets_strengths_and_camera_without_undo_entries() -> None:
    work = workspace.new_workspace(replace(view(0.0, 1.0), timeline=two_keys()))
    entries = len(work.past.past)
    for name, value, scarf in (("seek", 20, 1.0), ("step", -20, 0.0), ("jump", 1, 1.0), ("seek", 10, 0.5)):
        work = act(work, WithValue(name, value))
        assert work.view.layers[0].strength == pytest.approx(scarf)
    assert work.view.camera.distance == pytest.approx(10.0)
    assert len(work.past.past) == entries
    edited = act(replace(work, focus=1), WithValue("nudge", 0.1))
    assert [round(layer.strength, 3) for layer in act(edited, Plain("undo")).view.layers] == [0.5, 0.75]


@pytest.mark.parametrize(
    "leaves",
    [
        [WithValue("seek", frame) for frame in (11, 12, 13)],
        [WithValue("step", 1)],
        [WithValue("jump", 1)],
        [Plain("play")],
    ],
)
def test_undo_restores_an_unkeyed_change_lost_to_the_playhead(leaves: list[Action]) -> None:
    work = workspace.new_workspace(replace(view(0.0, 1.0), timeline=two_keys()))
    work = act(work, WithValue("seek", 10), OnItem("focus", 2), WithValue("nudge", 0.3))
    entries = len(work.past.past)
    left = work
    for action in leaves:  # one drag: undo entries are recorded only at its end
        left = perform(left, action, FACTS)
    left = workspace.record_undo(workspace.advance(left, 0.1))
    assert left.view.layers != work.view.layers
    assert len(left.past.past) == entries + 1, "one drag is one entry"
    assert act(left, Plain("undo")).view.layers == work.view.layers


def test_single_key_does_not_override_strengths_and_camera() -> None:
    work = act(workspace.new_workspace(view(0.3)), Plain("key"), OnItem("focus", 2), WithValue("nudge", 0.5))
    there = act(work, WithValue("seek", 30), WithValue("seek", 0))
    assert there.view == work.view
    only = timeline.state_at(work.view.timeline, 0, work.view)
    assert only.layers[0].strength == 0.3, "in a film a single key still counts"


def test_drag_during_playback_is_one_undo_entry() -> None:
    film = Timeline(
        (Keyframe(0, ((0, 0.0),)), Keyframe(20, ((0, 1.0),))),
        length=20,
    )
    work = act(workspace.new_workspace(replace(view(), timeline=film)), Plain("play"))
    for strength in (0.5, 0.6, 0.7):  # a drag of the other slider
        layers = (work.view.layers[0], replace(work.view.layers[1], strength=strength))
        work = workspace.advance(replace(work, view=replace(work.view, layers=layers)), 0.1)
    work = workspace.record_undo(work)
    assert work.view.layers[0].strength > 0.1
    assert len(work.past.past) == 1
    assert act(work, Plain("undo")).view.layers[1].strength == 0.4


def test_moved_key_takes_the_playhead_along() -> None:
    work = act(
        workspace.new_workspace(replace(view(), timeline=two_keys())),
        WithValue("seek", 20),
        WithValue("length", 40),
    )
    moved = act(work, ChooseKeys(frozenset({(-1, 20), (0, 20), (1, 20)})), WithValue("move_keys", 11))
    assert moved.player.frame == 31
    assert (moved.view.layers, moved.view.camera) == (work.view.layers, work.view.camera)


def frames_of(work: Workspace, row: int) -> list[int]:
    return [frame for r, frame in sorted(timeline.split_keys(work.view.timeline)) if r == row]


def test_whole_keys_split_into_rows_and_join_again() -> None:
    film = timeline.with_key(two_keys(), 7, view(0.9))
    rows = timeline.split_keys(film)
    assert sorted(rows) == [(row, frame) for row in (-1, 0, 1) for frame in (0, 7, 20)]
    assert timeline.join_keys(film, rows) == film
    assert timeline.join_keys(film, dict(reversed(rows.items()))) == film


def test_moving_the_key_of_a_row_keeps_the_other_rows() -> None:
    work = act(
        workspace.new_workspace(replace(view(), timeline=two_keys(length=20))), WithValue("length", 40)
    )
    moved = act(work, ChooseKeys(frozenset({(0, 20)})), WithValue("move_keys", 5))
    assert [frames_of(moved, row) for row in (timeline.CAMERA, 0, 1)] == [[0, 20], [0, 25], [0, 20]]
    assert timeline.strengths_at(moved.view.timeline, 20)[1] == 0.5
    assert timeline.strengths_at(moved.view.timeline, 25)[0] == 1.0
    eased = act(moved, WithText("easing", "hold")).view.timeline
    assert {row: key.easing for row, key in timeline.split_keys(eased).items() if key.easing == "hold"} == {
        (0, 25): "hold"
    }
    assert act(moved, WithValue("move_keys", -25)) == moved, "its row has a key there"
    assert act(moved, Plain("undo")).view.timeline == work.view.timeline


def test_keys_of_one_frame_may_have_different_easings() -> None:
    film = timeline.set_easing(two_keys("linear"), [(0, 0)], "hold")
    assert timeline.strengths_at(film, 10) == {0: 0.0, 1: 0.75}


def test_copied_keys_replace_keys_at_the_playhead() -> None:
    work = act(workspace.new_workspace(replace(view(), timeline=two_keys())), Plain("timeline"))
    work = act(
        work,
        ChooseKeys(frozenset({(0, 0), (0, 20)})),
        Plain("copy_keys"),
        WithValue("seek", 10),
        Plain("paste_keys"),
    )
    assert frames_of(work, 0) == [0, 10, 20, 30]
    assert work.view.timeline.length == 30
    assert timeline.strengths_at(work.view.timeline, 30)[0] == 1.0
    assert work.player.chosen == {(0, 10), (0, 30)}
    dropped = act(work, Plain("drop_key"))
    assert (frames_of(dropped, 0), frames_of(dropped, 1)) == ([0, 20], [0, 20])
    layers = act(work, OnItem("focus", 1), Plain("copy_keys"), Plain("paste_keys"))
    assert layers.view == replace(work.view), "a layer was taken since, and no key is chosen"


def test_dragged_copies_leave_their_originals() -> None:
    work = act(
        workspace.new_workspace(replace(view(), timeline=two_keys())), ChooseKeys(frozenset({(1, 20)}))
    )
    assert act(work, WithValue("clone_keys", 0)).view.timeline == work.view.timeline
    work = act(work, WithValue("clone_keys", -5), WithValue("move_keys", -1))
    assert (frames_of(work, 1), frames_of(work, 0)) == ([0, 14, 20], [0, 20])
    assert act(work, ChooseKeys(frozenset({(1, 20)}), toggles=True)).player.chosen == {(1, 14), (1, 20)}


def test_auto_key_keys_only_changed_values_as_one_entry() -> None:
    work = act(
        workspace.new_workspace(view()),
        Plain("auto_key"),
        WithValue("seek", 10),
        OnItem("focus", 2),
        WithValue("nudge", 0.3),
    )
    assert work.view.timeline.keys == (Keyframe(10, ((0, 0.5),)),)
    assert len(work.past.past) == 1
    assert act(work, Plain("undo")).view.timeline.keys == ()
    work = act(
        work, WithValue("seek", 20), WithValue("nudge", 0.1), WithValue("seek", 5), WithValue("seek", 10)
    )
    assert [frames_of(work, row) for row in (timeline.CAMERA, 0, 1)] == [[], [10, 20], []]
    off = act(work, Plain("auto_key"), WithValue("seek", 15), WithValue("nudge", 0.1))
    assert frames_of(off, 0) == [10, 20]


def test_auto_key_keys_the_camera_once_its_row_has_a_key() -> None:
    def look(work: Workspace, azimuth: float) -> Workspace:
        turned = replace(work.view.camera, azimuth=azimuth)
        return workspace.record_undo(workspace.with_camera(work, turned))

    work = look(act(workspace.new_workspace(view()), Plain("auto_key"), WithValue("seek", 10)), 30.0)
    assert work.view.timeline.keys == ()
    work = look(act(work, OnItem("key", -1), WithValue("seek", 20)), 60.0)
    assert frames_of(work, timeline.CAMERA) == [10, 20]
    work = act(work, WithValue("seek", 15), WithValue("seek", 10), Plain("play"))
    work = workspace.record_undo(workspace.advance(work, 0.2))
    assert frames_of(work, timeline.CAMERA) == [10, 20], "the playhead is no hand"


def test_easing_action_cycles_for_the_key_before_the_playhead() -> None:
    work = act(workspace.new_workspace(replace(view(), timeline=two_keys())), WithValue("seek", 5))
    found = []
    for _ in range(3):
        work = act(work, Plain("easing"))
        found.append(work.view.timeline.keys[0].easing)
    assert found == ["linear", "hold", "smooth"]
    assert work.view.timeline.keys[1].easing == "smooth"


def test_single_key_cannot_be_played_and_hiding_the_bar_stops() -> None:
    work = act(workspace.new_workspace(view()), Plain("key"), Plain("play"))
    assert not work.player.playing
    work = act(workspace.new_workspace(replace(view(), timeline=two_keys())), Plain("play"))
    assert timeline.next_frame_delay(work.player, work.view.timeline) == pytest.approx(1 / 24)
    hidden = act(work, Plain("timeline"))
    assert not hidden.player.playing
    assert timeline.next_frame_delay(hidden.player, hidden.view.timeline) is None


def test_undo_of_a_longer_timeline_keeps_the_playhead_usable() -> None:
    work = act(
        workspace.new_workspace(replace(view(), timeline=two_keys())),
        WithValue("length", 90),
        WithValue("seek", 80),
        Plain("undo"),
        Plain("undo"),
    )
    assert work.view.timeline.length == 20
    assert act(work, WithValue("step", 1)).player.frame == 20


def test_history_restores_the_timeline() -> None:
    past = history.record(history.begin(view()), replace(view(), timeline=two_keys()))
    assert history.undo(past).present.edit.timeline == Timeline()


def test_every_timeline_action_bound_to_a_key_exists() -> None:
    named = {key.action.name for key in KEYS.values()}
    assert {"key", "drop_key", "play", "step", "jump", "easing", "ping_pong", "timeline"} <= named
    assert not set(timeline.ACTIONS) & set(ACTIONS)
