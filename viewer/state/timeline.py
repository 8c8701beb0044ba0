"""Keys on a timeline as pure functions: set, drop, move and ease them, and the state at any frame.

A key holds the camera and every strength. Frames are whole numbers from 0 to `Timeline.length`, so a film is
the same however fast or slowly it is drawn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from viewer.camera import tween
from viewer.camera.view_camera import ViewCamera

from .view_state import FASTEST, LONGEST, Keyframe, Timeline, ViewState

EASINGS = tween.EASINGS


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
    return tween.camera(keys, frame) if len(keys) >= least else None


def strengths_at(timeline: Timeline, frame: float, least: int = 1) -> dict[int, float]:
    """The strength of each edit that at least `least` keys mention, by `LayerState.gdf`."""
    tracks: dict[int, list[tween.Point]] = {}
    for key in timeline.keys:
        for gdf, strength in key.strengths:
            tracks.setdefault(gdf, []).append((key.frame, key.easing, strength))
    return {gdf: tween.value(points, frame) for gdf, points in tracks.items() if len(points) >= least}


def _with(timeline: Timeline, key: Keyframe) -> Timeline:
    keys = sorted((*timeline.keys, key), key=lambda k: k.frame)
    return replace(timeline, keys=tuple(keys), length=max(timeline.length, key.frame))
