"""Keys on a timeline and its playhead as pure functions: set, move, ease and play, the state at any frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from viewer.camera import views
from viewer.camera.view_camera import ViewCamera

from .view_state import FASTEST, LONGEST, Keyframe, Timeline, ViewState

EASINGS = views.EASINGS


def key_at(timeline: Timeline, frame: int) -> Keyframe | None:
    """The key that stands at a frame."""
    return next((key for key in timeline.keys if key.frame == frame), None)


def with_key(timeline: Timeline, frame: int, view: ViewState) -> Timeline:
    """What `view` shows becomes the key at a frame, in place of the one there, whose easing stays."""
    old = key_at(timeline, frame)
    easing = old.easing if old else key_before(timeline, frame).easing if timeline.keys else EASINGS[0]
    strengths = {layer.gdf: layer.strength for layer in view.layers}
    key = Keyframe(frame, tuple(strengths.items()), view.camera, easing)
    return _with(without_key(timeline, frame), key)


def without_key(timeline: Timeline, frame: int) -> Timeline:
    """The key at a frame taken away; unchanged where there is none."""
    return replace(timeline, keys=tuple(key for key in timeline.keys if key.frame != frame))


def move_key(timeline: Timeline, frame: int, to: int) -> Timeline:
    """The key at `frame` at another place; unchanged where another key stands there, or off the timeline."""
    key = key_at(timeline, frame)
    if key is None or key_at(timeline, to) or not 0 <= to <= timeline.length:
        return timeline
    return _with(without_key(timeline, frame), replace(key, frame=to))


def set_easing(timeline: Timeline, frame: int, easing: str) -> Timeline:
    """Another way to go on from the key at a frame, or from the last one before it."""
    if not timeline.keys or easing not in EASINGS:
        return timeline
    key = key_before(timeline, frame)
    return _with(without_key(timeline, key.frame), replace(key, easing=easing))


def key_before(timeline: Timeline, frame: int) -> Keyframe:
    """The key that decides how things move at a frame: the last one up to it, else the first."""
    return next((key for key in reversed(timeline.keys) if key.frame <= frame), timeline.keys[0])


def set_length(timeline: Timeline, length: int) -> Timeline:
    """Another last frame; no key is lost, so it ends with the last key at the earliest."""
    last = timeline.keys[-1].frame if timeline.keys else 0
    return replace(timeline, length=max(1, last, min(length, LONGEST)))


def with_fps(timeline: Timeline, fps: int) -> Timeline:
    """Another pace, 1 to `FASTEST` frames per second."""
    return replace(timeline, fps=max(1, min(fps, FASTEST)))


def neighbor(timeline: Timeline, frame: int, step: int) -> int:
    """The frame of the next key (step 1) or of the one before (−1); an end of the timeline where none is."""
    frames = [key.frame for key in timeline.keys]
    if step > 0:
        return min((f for f in frames if f > frame), default=timeline.length)
    return max((f for f in frames if f < frame), default=0)


def turntable(camera: ViewCamera, fps: int, seconds: float) -> Timeline:
    """Once around the pivot at an even pace: after the last frame comes the first."""
    count = min(max(2, round(fps * seconds)), LONGEST)
    turns = [(camera.azimuth + 180.0 + 360.0 * frame / count) % 360.0 - 180.0 for frame in range(count)]
    keys = tuple(Keyframe(frame, (), replace(camera, azimuth=turn)) for frame, turn in enumerate(turns))
    return Timeline(keys, count - 1, fps)


def slider_film(view: ViewState, gdfs: Sequence[int], fps: int, seconds: float) -> Timeline:
    """The sliders of these edits from 0 to 1, one after the other, and back again; the others stay."""
    step = min(max(1, round(fps * seconds / 2)), LONGEST // len(gdfs))
    still = tuple((layer.gdf, layer.strength) for layer in view.layers if layer.gdf not in gdfs)
    keys = tuple(
        Keyframe(i * step, (*((gdf, float(at < i)) for at, gdf in enumerate(gdfs)), *still))
        for i in range(len(gdfs) + 1)
    )
    return Timeline(keys, len(gdfs) * step, fps, ping_pong=True)


def film_frames(timeline: Timeline) -> Iterator[int]:
    """The frames of one round, in the order they are shown: there, and back again where it is a ping-pong."""
    yield from range(timeline.length + 1)
    if timeline.ping_pong:
        yield from range(timeline.length - 1, 0, -1)


def state_at(timeline: Timeline, frame: float, view: ViewState, least: int = 1) -> ViewState:
    """`view` with the camera and strengths of a frame; what fewer than `least` keys mention stays as it is.

    Before the first key and after the last everything rests.
    """
    camera, strengths = camera_at(timeline, frame, least), strengths_at(timeline, frame, least)
    layers = tuple(
        replace(layer, strength=strengths[layer.gdf])
        if strengths.get(layer.gdf, layer.strength) != layer.strength
        else layer
        for layer in view.layers
    )
    camera = view.camera if camera is None else replace(camera, mode=view.camera.mode)
    return replace(view, layers=layers, camera=camera)


def camera_at(timeline: Timeline, frame: float, least: int = 1) -> ViewCamera | None:
    """The camera of a frame, or None where fewer than `least` keys have one."""
    keys = [(key.frame, key.easing, key.camera) for key in timeline.keys if key.camera is not None]
    return views.camera_between(keys, frame) if len(keys) >= least else None


def strengths_at(timeline: Timeline, frame: float, least: int = 1) -> dict[int, float]:
    """The strength of each edit that at least `least` keys mention, by `LayerState.gdf`."""
    tracks: dict[int, list[views.Point]] = {}
    for key in timeline.keys:
        for gdf, strength in key.strengths:
            tracks.setdefault(gdf, []).append((key.frame, key.easing, strength))
    return {gdf: views.value_between(points, frame) for gdf, points in tracks.items() if len(points) >= least}


def _with(timeline: Timeline, key: Keyframe) -> Timeline:
    keys = sorted((*timeline.keys, key), key=lambda k: k.frame)
    return replace(timeline, keys=tuple(keys), length=max(timeline.length, key.frame))


LEAST_KEYS = 2
"""What fewer keys mention does not move, and the playhead leaves it to the hand."""


@dataclass(frozen=True)
class Player:
    """Where the playhead stands."""

    frame: int = 0  # 0 to the timeline's length
    playing: bool = False  # it goes on by itself
    backwards: bool = False  # on the way back of a ping-pong
    part: float = 0.0  # how much of this frame's time is over, 0..1
    shown: bool = False  # whether the bar is on screen


def advance(player: Player, timeline: Timeline, seconds: float) -> Player:
    """The playhead after so much time of playing; a slow frame skips frames and keeps the pace."""
    over = player.part + max(0.0, seconds) * timeline.fps
    steps = int(over)
    frame, backwards = _step_frames(timeline, player.frame, player.backwards, steps)
    return replace(player, frame=frame, backwards=backwards, part=over - steps)


def next_frame_delay(player: Player, timeline: Timeline) -> float | None:
    """Seconds until the next frame of the film is due; None while nothing plays."""
    return (1.0 - player.part) / timeline.fps if player.playing else None


def perform(view: ViewState, player: Player, action: str) -> tuple[ViewState, Player]:
    """The state and the playhead after an action; a playhead that moved takes the picture along.

    Args:
        action: a name of `ACTIONS`, with an argument after a colon where it has one

    Raises:
        KeyError: there is no such action.
    """
    name, _, argument = action.partition(":")
    timeline, after = ACTIONS[name](view, player, argument)
    after = replace(after, frame=max(0, min(after.frame, timeline.length)))
    view = replace(view, timeline=timeline)
    if after.frame != player.frame:
        view = state_at(timeline, after.frame, view, LEAST_KEYS)
    return view, after


def _step_frames(timeline: Timeline, frame: int, backwards: bool, steps: int) -> tuple[int, bool]:
    last = timeline.length
    if not timeline.ping_pong:
        return (frame + steps) % (last + 1), False
    step = ((2 * last - frame if backwards else frame) + steps) % (2 * last)
    return (step, False) if step < last else (2 * last - step, True)


def _key(view: ViewState, player: Player, _: str) -> tuple[Timeline, Player]:
    return with_key(view.timeline, player.frame, view), replace(player, shown=True)


def _drop_key(view: ViewState, player: Player, _: str) -> tuple[Timeline, Player]:
    return without_key(view.timeline, player.frame), player


def _move_key(view: ViewState, player: Player, places: str) -> tuple[Timeline, Player]:
    """`FROM>TO`; the playhead goes with the key."""
    frame, _, to = places.partition(">")
    moved = move_key(view.timeline, int(frame), int(to))
    went = moved is not view.timeline
    return moved, replace(player, frame=int(to), playing=False, part=0.0) if went else player


def _play(view: ViewState, player: Player, _: str) -> tuple[Timeline, Player]:
    """Play or pause; with fewer than two keys nothing could move, so only the bar appears."""
    playing = not player.playing and len(view.timeline.keys) > 1
    return view.timeline, replace(player, playing=playing, part=0.0, shown=True)


def _seek(view: ViewState, player: Player, frame: str) -> tuple[Timeline, Player]:
    return view.timeline, _at(player, int(frame))


def _step(view: ViewState, player: Player, by: str) -> tuple[Timeline, Player]:
    return view.timeline, replace(_at(player, player.frame + int(by)), shown=True)


def _jump(view: ViewState, player: Player, way: str) -> tuple[Timeline, Player]:
    return view.timeline, _at(player, neighbor(view.timeline, player.frame, int(way)))


def _at(player: Player, frame: int) -> Player:
    return replace(player, frame=frame, playing=False, backwards=False, part=0.0)


def _easing(view: ViewState, player: Player, chosen: str) -> tuple[Timeline, Player]:
    """Of the key that decides at the playhead; the next one of the list where none is named."""
    if not view.timeline.keys:
        return view.timeline, player
    now = key_before(view.timeline, player.frame).easing
    after = chosen or EASINGS[(EASINGS.index(now) + 1) % len(EASINGS)]
    return set_easing(view.timeline, player.frame, after), player


def _ping_pong(view: ViewState, player: Player, _: str) -> tuple[Timeline, Player]:
    turned = replace(view.timeline, ping_pong=not view.timeline.ping_pong)
    return turned, replace(player, backwards=False)


def _bar(view: ViewState, player: Player, _: str) -> tuple[Timeline, Player]:
    """Show or hide the bar; nothing plays out of sight."""
    return view.timeline, replace(player, shown=not player.shown, playing=False)


ACTIONS: dict[str, Callable[[ViewState, Player, str], tuple[Timeline, Player]]] = {
    "key": _key,
    "drop_key": _drop_key,
    "move_key": _move_key,
    "play": _play,
    "seek": _seek,
    "step": _step,
    "jump": _jump,
    "easing": _easing,
    "ping_pong": _ping_pong,
    "length": lambda view, player, frames: (set_length(view.timeline, int(frames)), player),
    "fps": lambda view, player, fps: (with_fps(view.timeline, int(fps)), player),
    "timeline": _bar,
}
