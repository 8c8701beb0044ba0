"""The playhead: where on the timeline one is, playing or not, as pure functions of time and of what is asked.

Actions come as text, from keys, from the bar and from scripts alike; see `ACTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from .timeline import (
    EASINGS,
    key_before,
    move_key,
    neighbor,
    set_easing,
    set_length,
    state_at,
    with_fps,
    with_key,
    without_key,
)
from .view_state import Timeline, ViewState

LEAST_KEYS = 2
"""What fewer keys mention does not move, and the playhead leaves it to the hand."""


@dataclass(frozen=True)
class Player:
    """Where the playhead stands.

    Args:
        frame: 0 to the timeline's length
        playing: it goes on by itself
        backwards: on the way back of a ping-pong
        part: how much of this frame's time is over, 0..1
        shown: whether the bar is on screen
    """

    frame: int = 0
    playing: bool = False
    backwards: bool = False
    part: float = 0.0
    shown: bool = False


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
    place = ((2 * last - frame if backwards else frame) + steps) % (2 * last)
    return (place, False) if place < last else (2 * last - place, True)


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


def _easing(view: ViewState, player: Player, wanted: str) -> tuple[Timeline, Player]:
    """Of the key that decides at the playhead; the next one of the list where none is named."""
    if not view.timeline.keys:
        return view.timeline, player
    now = key_before(view.timeline, player.frame).easing
    after = wanted or EASINGS[(EASINGS.index(now) + 1) % len(EASINGS)]
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
