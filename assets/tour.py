"""Takes the README's tour: the real interface on a real scene, drawn without a window.

usage: python assets/tour.py NAME SCENE.ply EDIT.gdf... -o OUT.png

"recorded" needs the edits in their run folders.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from ui_rig import Rig, rig

from progdf.checkpoint import Gdf
from progdf.ply import load_ply
from viewer.arguments import load_edits
from viewer.state import LayerState, ViewState
from viewer.turntable import first_camera
from viewer.workspace import Dialog

SIZE = (1280, 800)


def layers(hand: Rig) -> None:
    """Two edits, gains and curve of the first unfolded, its colour held back."""
    hand.wheel(490.0, 400.0, 1.0)
    hand.key("G")
    hand.key("Tab")
    for _ in range(2):
        hand.key("Shift+Left")


def compare(hand: Rig) -> None:
    """The original beside the edited scene, the divider in the hand."""
    _whole(hand)
    _wheel_in(hand)
    hand.key("Y")
    hand.move(490.0, 300.0)
    hand.frame(3)


def difference(hand: Rig) -> None:
    """What differs, four times as bright, with the PSNR."""
    _whole(hand)
    _wheel_in(hand)
    hand.key("Shift+Y")


def recorded(hand: Rig) -> None:
    """The field beside what training recorded at the same strengths, with the PSNR."""
    hand.key("F")
    hand.wheel(200.0, 200.0, -1.5)
    hand.key("Alt+Y")


def session(hand: Rig) -> None:
    """Snapshots in the panel, and the question before changes are lost."""
    _wheel_in(hand)
    for chord in ("1", *["Shift+Right"] * 2, "F3", *["Shift+Left"] * 5, "F3", "2", *["Shift+Left"] * 9, "F3"):
        hand.key(chord)
    hand.frame(8)
    hand.wheel(1130.0, 600.0, -100.0)
    hand.stage.ask(Dialog("leave", "playbot.session.json", "quit"))
    hand.settle()


def timeline(hand: Rig) -> None:
    """A film of three keys: the edits come while the camera goes around; the playhead on the way."""
    _wheel_in(hand)
    start = hand.stage.work.view
    bare = tuple(replace(layer, strength=0.0) for layer in start.layers)
    hand.stage.change(replace(start, layers=bare))
    hand.key("K")
    for frames, turn, first in ((32, 40.0, 1.0), (30, 30.0, 0.0)):
        for _ in range(frames):
            hand.key(".")
        view = hand.stage.work.view
        layers = tuple(
            replace(layer, strength=first if i == 0 else 1.0 - 0.5 * first)
            for i, layer in enumerate(view.layers)
        )
        turned = replace(view.camera, azimuth=view.camera.azimuth + turn)
        hand.stage.change(replace(view, layers=layers, camera=turned))
        hand.key("K")
    for _ in range(38):
        hand.key(",")
    hand.frame(3)


def _whole(hand: Rig) -> None:
    """All edits at full strength."""
    view = hand.stage.work.view
    full = tuple(replace(layer, strength=1.0) for layer in view.layers)
    hand.stage.change(replace(view, layers=full))
    hand.settle()


def _wheel_in(hand: Rig) -> None:
    """Nearer to the focused layer."""
    hand.key("F")
    hand.wheel(490.0, 400.0, -6.5)


def timings(hand: Rig) -> None:
    """A slider in the hand: only its part of the picture is drawn, and the figures say so."""
    _wheel_in(hand)
    hand.key("F10")
    first = hand.strengths[0]
    hand.move(*hand.slider(0, first))
    hand.press()
    for step in range(1, 25):
        hand.move(*hand.slider(0, first - 0.01 * step))


def painted(hand: Rig) -> None:
    """The first edit rubbed away in a band, the brush still there."""
    hand.wheel(490.0, 400.0, 1.0)
    hand.key("B")
    hand.drag((470.0, 210.0), (500.0, 330.0))


SHOTS: dict[str, Callable[[Rig], None]] = {
    "layers": layers,
    "paint": painted,
    "compare": compare,
    "difference": difference,
    "recorded": recorded,
    "session": session,
    "timeline": timeline,
    "timings": timings,
}
"""What a hand does before the picture is taken."""


def first_state(gdfs: tuple[Gdf, ...], strengths: tuple[float, ...] = (0.8, 0.6, 0.5, 0.4)) -> ViewState:
    """Every edit part of the way."""
    stack = tuple(LayerState(i, gdf.name, strengths[i % 4]) for i, gdf in enumerate(gdfs))
    return ViewState(layers=stack, background=(0.75, 0.82, 0.88))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=sorted(SHOTS))
    parser.add_argument("scene", type=Path)
    parser.add_argument("gdfs", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    asked = parser.parse_args()
    scene = load_ply(asked.scene)
    gdfs = load_edits(asked.gdfs, scene, asked.scene)
    view = replace(first_state(gdfs), camera=first_camera(scene, aspect=980 / 800))
    with rig(view, SIZE, stack=_Opened(scene, gdfs), gdf_paths=asked.gdfs) as hand:
        hand.stage.facts = replace(hand.stage.facts, title=asked.scene.name)
        SHOTS[asked.name](hand)
        hand.frame(3)
        picture = Image.fromarray(hand.image())
    # no dithering: it would grain the interface's flat colours
    picture.quantize(256, kmeans=3, dither=Image.Dither.NONE).save(asked.out, optimize=True)


class _Opened:
    """What the rig needs of a scene and its edits."""

    def __init__(self, scene: object, gdfs: tuple[Gdf, ...]) -> None:
        self.scene, self.gdfs = scene, gdfs


if __name__ == "__main__":
    main()
