"""Timeline keys and playhead as pure functions: set, move, ease, play, and the state at any frame."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from viewer.camera import views
from viewer.camera.view_camera import ViewCamera

from .commands import Action, ChooseKeys, argument
from .view_state import MAX_FPS, MAX_FRAME, Keyframe, LayerState, Timeline, ViewState, following

EASINGS = views.EASINGS


CAMERA = -1
"""Row of the camera. The row of an edit is its `LayerState.gdf`."""
RowKey = tuple[int, int]
"""Row and frame of a key."""


def split_keys(timeline: Timeline) -> dict[RowKey, Keyframe]:
    """Split the keyframes into keys that each belong to one row."""
    found = {}
    for key in timeline.keys:
        if key.camera is not None:
            found[CAMERA, key.frame] = replace(key, strengths=())
        for strength in key.strengths:
            found[strength[0], key.frame] = replace(key, strengths=(strength,), camera=None)
    return found


def join_keys(timeline: Timeline, keys: Mapping[RowKey, Keyframe]) -> Timeline:
    """Return a timeline of these keys. Those with the same frame and easing become one `Keyframe`."""
    joined: dict[tuple[int, str], Keyframe] = {}
    for (_, frame), key in sorted(keys.items(), key=lambda item: item[0]):
        joined_key = joined.get((frame, key.easing), Keyframe(frame, easing=key.easing))
        strengths = (*joined_key.strengths, *key.strengths)
        camera = key.camera or joined_key.camera
        joined[frame, key.easing] = replace(joined_key, strengths=strengths, camera=camera)
    ordered = tuple(sorted(joined.values(), key=lambda key: key.frame))
    return replace(timeline, keys=ordered, length=max((timeline.length, *(key.frame for key in ordered))))


def keys_at(timeline: Timeline, frame: int) -> list[RowKey]:
    """Return the keys of all rows at a frame."""
    return [key for key in split_keys(timeline) if key[1] == frame]


def with_key(timeline: Timeline, frame: int, view: ViewState, rows: Sequence[int] | None = None) -> Timeline:
    """Set a key at a frame from the camera and strengths of `view`.

    It replaces an existing key. Its easing is that of the replaced key, else of the key before.

    Args:
        timeline: the timeline
        frame: frame of the key
        view: source of the values
        rows: rows that get the key; None for all
    """
    keys = split_keys(timeline)
    for row in (CAMERA, *(layer.gdf for layer in view.layers)) if rows is None else rows:
        strengths = tuple((layer.gdf, layer.strength) for layer in view.layers if layer.gdf == row)
        before = [key for (r, f), key in keys.items() if r == row and f <= frame]
        latest = max(before, key=lambda key: key.frame) if before else None
        if latest is None and timeline.keys:
            latest = key_before(timeline, frame)
        easing = latest.easing if latest else EASINGS[0]
        keys[row, frame] = Keyframe(frame, strengths, view.camera if row == CAMERA else None, easing)
    return join_keys(timeline, keys)


def without_keys(timeline: Timeline, chosen: Collection[RowKey]) -> Timeline:
    """Remove the given keys that exist."""
    return join_keys(timeline, {at: key for at, key in split_keys(timeline).items() if at not in chosen})


def shift_keys(timeline: Timeline, chosen: Collection[RowKey], by: int, copy: bool = False) -> Timeline:
    """Move or copy keys by `by` frames.

    Nothing changes if a key would land on another key of its row or outside the timeline.
    """
    keys = split_keys(timeline)
    moved = {(row, frame + by): replace(keys[row, frame], frame=frame + by) for row, frame in chosen}
    others = {at: key for at, key in keys.items() if copy or at not in chosen}
    if others.keys() & moved.keys() or not all(0 <= frame <= timeline.length for _, frame in moved):
        return timeline
    return join_keys(timeline, others | moved)


def set_easing(timeline: Timeline, chosen: Collection[RowKey], easing: str) -> Timeline:
    """Set the easing from these keys to the next."""
    keys = split_keys(timeline)
    return join_keys(
        timeline, {at: replace(k, easing=easing) if at in chosen else k for at, k in keys.items()}
    )


def key_before(timeline: Timeline, frame: int) -> Keyframe:
    """Return the key whose easing applies at a frame: the last one up to it, else the first."""
    return next((key for key in reversed(timeline.keys) if key.frame <= frame), timeline.keys[0])


def set_length(timeline: Timeline, length: int) -> Timeline:
    """Set the last frame, at most `MAX_FRAME`. It stays at or after the last key, so that no key is lost."""
    last = timeline.keys[-1].frame if timeline.keys else 0
    return replace(timeline, length=max(1, last, min(length, MAX_FRAME)))


def with_fps(timeline: Timeline, fps: int) -> Timeline:
    """Set the frame rate, clamped to 1 to `MAX_FPS` frames per second."""
    return replace(timeline, fps=max(1, min(fps, MAX_FPS)))


def neighbor(timeline: Timeline, frame: int, step: int) -> int:
    """Return the frame of the next (step 1) or previous (−1) key, else the last or first frame."""
    frames = [key.frame for key in timeline.keys]
    if step > 0:
        return min((f for f in frames if f > frame), default=timeline.length)
    return max((f for f in frames if f < frame), default=0)


def turntable(camera: ViewCamera, fps: int, seconds: float) -> Timeline:
    """Return a timeline that orbits the pivot once at constant speed and loops seamlessly."""
    count = min(max(2, round(fps * seconds)), MAX_FRAME)
    azimuths = [(camera.azimuth + 180.0 + 360.0 * frame / count) % 360.0 - 180.0 for frame in range(count)]
    keys = tuple(
        Keyframe(frame, (), replace(camera, azimuth=azimuth)) for frame, azimuth in enumerate(azimuths)
    )
    return Timeline(keys, count - 1, fps)


def slider_film(view: ViewState, gdfs: Sequence[int], fps: int, seconds: float) -> Timeline:
    """Return a ping-pong timeline that moves the strengths of these edits from 0 to 1, one after the other.

    The other strengths are unchanged.
    """
    step = min(max(1, round(fps * seconds / 2)), MAX_FRAME // len(gdfs))
    still = tuple((layer.gdf, layer.strength) for layer in view.layers if layer.gdf not in gdfs)
    keys = tuple(
        Keyframe(i * step, (*((gdf, float(at < i)) for at, gdf in enumerate(gdfs)), *still))
        for i in range(len(gdfs) + 1)
    )
    return Timeline(keys, len(gdfs) * step, fps, ping_pong=True)


def film_frames(timeline: Timeline) -> Iterator[int]:
    """Yield the frames of one loop in playback order, including the return of a ping-pong."""
    yield from range(timeline.length + 1)
    if timeline.ping_pong:
        yield from range(timeline.length - 1, 0, -1)


def state_at(timeline: Timeline, frame: float, view: ViewState, least: int = 1) -> ViewState:
    """Return `view` with the camera and strengths of a frame.

    Rows with fewer than `least` keys are unchanged. Before the first key and after the last key values are
    constant.
    """
    camera = camera_at(timeline, frame, least)
    strengths = strengths_at(timeline, frame, least)
    layers = tuple(
        replace(layer, strength=strengths[layer.gdf])
        if strengths.get(layer.gdf, layer.strength) != layer.strength
        else layer
        for layer in view.layers
    )
    camera = view.camera if camera is None else replace(camera, mode=view.camera.mode)
    return replace(view, layers=layers, camera=camera)


def camera_at(timeline: Timeline, frame: float, least: int = 1) -> ViewCamera | None:
    """Return the camera at a frame, or None if fewer than `least` keys have one."""
    keys = [(key.frame, key.easing, key.camera) for key in timeline.keys if key.camera is not None]
    return views.camera_between(keys, frame) if len(keys) >= least else None


def strengths_at(timeline: Timeline, frame: float, least: int = 1) -> dict[int, float]:
    """Return the strengths at a frame of all edits with at least `least` keys, by `LayerState.gdf`."""
    return {
        g: views.value_between(points, frame)
        for g, points in tracks(timeline).items()
        if len(points) >= least
    }


def tracks(timeline: Timeline) -> dict[int, list[views.Point]]:
    """Return the strength keys of each edit, by `LayerState.gdf`."""
    found: dict[int, list[views.Point]] = {}
    for key in timeline.keys:
        for gdf, strength in key.strengths:
            found.setdefault(gdf, []).append((key.frame, key.easing, strength))
    return found


MIN_KEYS = 2
"""Smallest number of keys for the playhead to move a row. Rows with fewer keys are left to the user."""


@dataclass(frozen=True)
class Player:
    """State of the playhead, and the selected and copied keys."""

    frame: int = 0  # 0 to the timeline's length
    playing: bool = False  # whether playback is running
    backwards: bool = False  # whether a ping-pong runs backwards
    part: float = 0.0  # elapsed share of the current frame's time, 0 to 1
    shown: bool = False  # whether the timeline bar is visible
    unfolded: bool = False  # whether the bar has a row for the camera and each layer
    chosen: frozenset[RowKey] = frozenset()  # selected keys, to be moved, copied and deleted
    copied: tuple[tuple[int, Keyframe], ...] = ()  # rows and keys on the clipboard
    # last known camera while auto key is on (changed rows get a key at the playhead), None for off
    auto_key: ViewCamera | None = None


def auto_key(view: ViewState, player: Player, before: Sequence[LayerState]) -> tuple[ViewState, Player]:
    """Add keys for the values that the user has changed, if auto key is on.

    These are the strengths that differ from `before`, and the camera if it already has a key. A camera
    without keys gets none, as the user may only have looked around.
    """
    if player.auto_key is None or player.playing:
        return view, player
    old_strengths = {layer.gdf: layer.strength for layer in before}
    rows = [
        layer.gdf for layer in view.layers if layer.strength != old_strengths.get(layer.gdf, layer.strength)
    ]
    keyed_camera = camera_at(view.timeline, player.frame)
    if keyed_camera is not None and view.camera not in (
        player.auto_key,
        replace(keyed_camera, mode=view.camera.mode),
    ):
        rows.append(CAMERA)
    keyed = with_key(view.timeline, player.frame, view, rows) if rows else view.timeline
    return replace(view, timeline=keyed), replace(player, auto_key=view.camera)


def advance(player: Player, timeline: Timeline, seconds: float) -> Player:
    """Advance the playhead by `seconds` of playback. Slow drawing skips frames and keeps the speed."""
    elapsed = player.part + max(0.0, seconds) * timeline.fps
    steps = int(elapsed)
    frame, backwards = _step_frames(timeline, player.frame, player.backwards, steps)
    return replace(player, frame=frame, backwards=backwards, part=elapsed - steps)


def next_frame_delay(player: Player, timeline: Timeline) -> float | None:
    """Return the seconds until the next frame is due, or None if playback is paused."""
    return (1.0 - player.part) / timeline.fps if player.playing else None


def perform(view: ViewState, player: Player, action: Action) -> tuple[ViewState, Player]:
    """Apply an action. If the playhead moves, the view takes the values of its new frame.

    Args:
        view: the state
        player: the playhead
        action: a command; its name is one of `ACTIONS`

    Raises:
        KeyError: the action is unknown.
    """
    timeline, after = ACTIONS[action.name](view, player, argument(action))
    after = replace(after, frame=max(0, min(after.frame, timeline.length)))
    view = replace(view, timeline=timeline)
    if after.frame != player.frame:
        view = state_at(timeline, after.frame, view, MIN_KEYS)
    return view, after


def _step_frames(timeline: Timeline, frame: int, backwards: bool, steps: int) -> tuple[int, bool]:
    last = timeline.length
    if not timeline.ping_pong:
        return (frame + steps) % (last + 1), False
    step = ((2 * last - frame if backwards else frame) + steps) % (2 * last)
    return (step, False) if step < last else (2 * last - step, True)


def _key(view: ViewState, player: Player, row: int | None) -> tuple[Timeline, Player]:
    """Set a key at the playhead in the given row, or in all rows."""
    rows = None if row is None else [row]
    return with_key(view.timeline, player.frame, view, rows), replace(player, shown=True)


def _drop_key(view: ViewState, player: Player, row: int | None) -> tuple[Timeline, Player]:
    """Delete the chosen keys, else the keys at the playhead. With a row, delete its key at the playhead."""
    here = [key for key in keys_at(view.timeline, player.frame) if row in (None, key[0])]
    chosen = chosen_keys(view.timeline, player) if row is None else ()
    return without_keys(view.timeline, chosen or here), replace(player, chosen=frozenset())


def chosen_keys(timeline: Timeline, player: Player) -> frozenset[RowKey]:
    """Return the chosen keys that still exist."""
    return player.chosen & split_keys(timeline).keys()


def _choose_keys(view: ViewState, player: Player, action: ChooseKeys) -> tuple[Timeline, Player]:
    keys = action.keys
    if action.toggles:
        keys = player.chosen - keys if keys <= player.chosen else player.chosen | keys
    return view.timeline, replace(player, chosen=keys)


def _move_keys(view: ViewState, player: Player, by: float, copy: bool = False) -> tuple[Timeline, Player]:
    """Move or copy the chosen keys. The playhead follows a chosen key at its frame."""
    chosen = chosen_keys(view.timeline, player)
    step = int(by)
    moved = shift_keys(view.timeline, chosen, step, copy)
    if moved is view.timeline:
        return moved, player
    if any(frame == player.frame for _, frame in chosen):
        player = replace(player, frame=player.frame + step, playing=False, part=0.0)
    return moved, replace(player, chosen=frozenset((row, frame + step) for row, frame in chosen))


def _copy_keys(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    chosen = chosen_keys(view.timeline, player)
    keys = ((row, key) for (row, frame), key in split_keys(view.timeline).items() if (row, frame) in chosen)
    return view.timeline, replace(player, copied=tuple(keys))


def _paste_keys(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    """Paste the copied keys, the first at the playhead, over existing ones. The timeline grows if needed."""
    by = player.frame - min((key.frame for _, key in player.copied), default=0)
    pasted = {(row, key.frame + by): replace(key, frame=key.frame + by) for row, key in player.copied}
    pasted = {at: key for at, key in pasted.items() if at[1] <= MAX_FRAME}
    joined = join_keys(view.timeline, split_keys(view.timeline) | pasted)
    return joined, replace(player, chosen=frozenset(pasted))


def _play(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    """Play or pause. With fewer than two keys nothing can move, so only the bar appears."""
    playing = not player.playing and len(view.timeline.keys) > 1
    return view.timeline, replace(player, playing=playing, part=0.0, shown=True)


def _seek(view: ViewState, player: Player, frame: float) -> tuple[Timeline, Player]:
    return view.timeline, _seek_to(player, int(frame))


def _step(view: ViewState, player: Player, by: float) -> tuple[Timeline, Player]:
    return view.timeline, replace(_seek_to(player, player.frame + int(by)), shown=True)


def _jump(view: ViewState, player: Player, way: float) -> tuple[Timeline, Player]:
    return view.timeline, _seek_to(player, neighbor(view.timeline, player.frame, int(way)))


def _seek_to(player: Player, frame: int) -> Player:
    return replace(player, frame=frame, playing=False, backwards=False, part=0.0)


def _easing(view: ViewState, player: Player, name: str | None) -> tuple[Timeline, Player]:
    """Set an easing (default: the next one) on the chosen keys, else on those that apply at the playhead."""
    if not view.timeline.keys:
        return view.timeline, player
    chosen = chosen_keys(view.timeline, player)
    deciding = key_before(view.timeline, player.frame)
    now = split_keys(view.timeline)[min(chosen)].easing if chosen else deciding.easing
    name = name or following(EASINGS, now)
    return set_easing(view.timeline, chosen or keys_at(view.timeline, deciding.frame), name), player


def _auto_key(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    return view.timeline, replace(player, auto_key=None if player.auto_key else view.camera, shown=True)


def _ping_pong(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    toggled = replace(view.timeline, ping_pong=not view.timeline.ping_pong)
    return toggled, replace(player, backwards=False)


def _toggle_bar(view: ViewState, player: Player, _: None) -> tuple[Timeline, Player]:
    """Show or hide the timeline bar and stop playback."""
    return view.timeline, replace(player, shown=not player.shown, playing=False)


ACTIONS: dict[str, Callable[[ViewState, Player, Any], tuple[Timeline, Player]]] = {
    "key": _key,
    "drop_key": _drop_key,
    "choose_keys": _choose_keys,
    "move_keys": _move_keys,
    "clone_keys": lambda view, player, by: _move_keys(view, player, by, copy=True),
    "copy_keys": _copy_keys,
    "paste_keys": _paste_keys,
    "auto_key": _auto_key,
    "timeline_rows": lambda view, player, _: (
        view.timeline,
        replace(player, unfolded=not (player.unfolded and player.shown), shown=True),
    ),
    "play": _play,
    "seek": _seek,
    "step": _step,
    "jump": _jump,
    "easing": _easing,
    "ping_pong": _ping_pong,
    "length": lambda view, player, frames: (set_length(view.timeline, int(frames)), player),
    "fps": lambda view, player, fps: (with_fps(view.timeline, int(fps)), player),
    "timeline": _toggle_bar,
}
