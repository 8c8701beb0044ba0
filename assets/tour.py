"""Take the README's tour: the real interface on a real scene, drawn without a window.

usage: python assets/tour.py NAME SCENE.ply EDIT.gdf... -o OUT.png
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from progdf.gdf.file import Gdf
from tests.helpers.ui_rig import Rig, rig
from viewer.camera.view_camera import first_camera
from viewer.files.document import load
from viewer.panel import panel
from viewer.state import selection
from viewer.state.layers import with_slider_value
from viewer.state.view_state import LayerState, ViewState

SIZE = (1280, 800)
# palette sizes that keep a file below 250 kB
COLORS = 144
PANEL_COLORS = 96


def layers(hand: Rig) -> None:
    """Show two edits, with the gains of the upper one unfolded and its color gain reduced."""
    hand.key("G")
    view = hand.main_view.work.view
    reduced = with_slider_value(view.layers[-1], "color", 0.5)
    hand.main_view.store.change(replace(view, layers=(*view.layers[:-1], reduced)))
    hand.settle()


def compare(hand: Rig) -> None:
    """Show the original beside the edited scene, with the pointer on the divider."""
    _set_strengths(hand, (1.0,) * len(hand.strengths))
    hand.key("Shift+Y")
    hand.move(490.0, 300.0)
    hand.frame(3)


def session(hand: Rig) -> None:
    """Show snapshots of two mixtures in the panel, one compared with the other."""
    for strengths in ((1.0, 0.2), (0.3, 1.0)):
        _set_strengths(hand, strengths)
        hand.key("F5")
    hand.key("Shift+F5")
    hand.key("Alt+G")
    hand.frame(8)


def timeline(hand: Rig) -> None:
    """Show a film of three keys: the edits fade in while the camera orbits. The playhead is between keys."""
    start = hand.main_view.work.view
    bare = tuple(replace(layer, strength=0.0) for layer in start.layers)
    hand.main_view.store.change(replace(start, layers=bare))
    hand.key("K")
    for frames, turn, first in ((32, 40.0, 1.0), (30, 30.0, 0.0)):
        for _ in range(frames):
            hand.key(".")
        view = hand.main_view.work.view
        layers = tuple(
            replace(layer, strength=first if i == 0 else 1.0 - 0.5 * first)
            for i, layer in enumerate(view.layers)
        )
        turned = replace(view.camera, azimuth=view.camera.azimuth + turn)
        hand.main_view.store.change(replace(view, layers=layers, camera=turned))
        hand.key("K")
    for _ in range(38):
        hand.key(",")
    hand.frame(3)


def _set_strengths(hand: Rig, strengths: Sequence[float]) -> None:
    """Set the first edits to these strengths."""
    view = hand.main_view.work.view
    layers = (replace(layer, strength=s) for layer, s in zip(view.layers, strengths, strict=False))
    hand.main_view.store.change(replace(view, layers=tuple(layers)))
    hand.settle()


def painted(hand: Rig) -> None:
    """Paint the first edit on one side, with the brush still visible."""
    hand.key("B")
    hand.key("Backspace")
    hand.key("X")
    hand.key("X")
    for _ in range(3):
        hand.key("]")
    for x, top, bottom in ((340.0, 160.0, 400.0), (420.0, 120.0, 420.0), (500.0, 120.0, 230.0)):
        hand.drag((x, top), (x, bottom))


def selected(hand: Rig) -> None:
    """Select the head with a lasso and save it as a region, then start a second lasso that subtracts."""
    hand.key("L")
    for corners in (((330, 90), (640, 60), (680, 330), (330, 340)), ((480, 180), (600, 190), (560, 280))):
        hand.move(*corners[0])
        hand.press()
        for corner in corners[1:]:
            hand.move(*corner)
        if corners[0] == (480, 180):
            break
        hand.release()
        view = hand.main_view.work.view
        kept = selection.add_region(view.selection, "head", Path("head.region.npy"))
        hand.main_view.store.change(replace(view, selection=kept))
        hand.modifier(imgui.Key.mod_ctrl)


SHOTS: dict[str, Callable[[Rig], None]] = {
    "layers": layers,
    "paint": painted,
    "select": selected,
    "compare": compare,
    "session": session,
    "timeline": timeline,
}
"""Name of a shot → function that brings the interface into its state."""


def first_state(gdfs: tuple[Gdf, ...], strengths: tuple[float, ...] = (0.8, 0.6, 0.5, 0.4)) -> ViewState:
    """Return a view with every edit at a partial strength, never at reduced resolution."""
    stack = tuple(LayerState(i, gdf.name, strengths[i % 4]) for i, gdf in enumerate(gdfs))
    return ViewState(layers=stack, background=(0.75, 0.82, 0.88), dynamic_resolution="off")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=sorted(SHOTS))
    parser.add_argument("scene", type=Path)
    parser.add_argument("gdfs", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    document = load(options.scene, options.gdfs)
    aspect = (SIZE[0] - panel.WIDTH_PX) / SIZE[1]
    view = replace(first_state(document.gdfs), camera=first_camera(document.scene, aspect=aspect))
    with rig(view, SIZE, stack=document) as hand:
        SHOTS[options.name](hand)
        hand.frame(3)
        picture = Image.fromarray(hand.image())
    _quantize(picture, SIZE[0] - round(panel.WIDTH_PX)).save(options.out, optimize=True)


def _quantize(window: Image.Image, panel_at: int) -> Image.Image:
    """Quantize the picture with dithering, and the panel without.

    Each gets a palette of its own, because dithering would add grain to the panel's flat colors.
    """
    picture = window.crop((0, 0, panel_at, window.height))
    palette = picture.quantize(COLORS, kmeans=3, dither=Image.Dither.NONE)
    picture = picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    right = window.crop((panel_at, 0, *window.size)).quantize(
        PANEL_COLORS, kmeans=3, dither=Image.Dither.NONE
    )
    both = Image.new("P", window.size)
    both.putpalette(
        (palette.getpalette() or [])[: 3 * COLORS] + (right.getpalette() or [])[: 3 * PANEL_COLORS]
    )
    both.paste(picture, (0, 0))
    both.paste(right.point([(i + COLORS) % 256 for i in range(256)]), (panel_at, 0))
    return both


if __name__ == "__main__":
    main()
