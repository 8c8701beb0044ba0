"""Painted strength: strokes as pure functions, by the hand, in sessions' text, and from files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ui_rig import Rig, bear, first_view, rig

from progdf.camera import Camera
from progdf.compose import Layer, compose
from progdf.errors import ProgdfError
from viewer import paint
from viewer.layer_arguments import stack_of
from viewer.paint import Stroke
from viewer.state import Brush
from viewer.turntable import to_camera

POINTS = (700, 640)
LINE = Stroke(
    np.ones(5, np.float32),
    np.array([[0, 0], [10, 0], [20, 0], [40, 0], [np.nan, np.nan]], np.float32),
    np.zeros(5, np.float32),
)
ERASE = Brush(active=True, radius=20.0, softness=0.5)


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(replace(first_view(bear(), 1.0, 1.0), brush=ERASE), POINTS) as made:
        yield made


def weights(hand: Rig, layer: int = 0) -> np.ndarray:
    found = paint.decoded(hand.stage.work.view.layers[layer].paint, len(bear().gdfs[layer].region))
    return np.ones(len(bear().gdfs[layer].region)) if found is None else found.numpy()


def camera_of(hand: Rig) -> Camera:
    return to_camera(hand.stage.work.view.camera, POINTS[0] - 300, POINTS[1])


def scarf_on_screen(hand: Rig) -> tuple[float, float]:
    camera, members = camera_of(hand), bear().gdfs[0].region.members
    x, y, z = (camera.viewmat[:3, :3] @ bear().scene.means[members].mean(0) + camera.viewmat[:3, 3]).tolist()
    return float(camera.K[0, 0] * x / z + camera.K[0, 2]), float(camera.K[1, 1] * y / z + camera.K[1, 2])


def test_paint_survives_its_text_to_a_255th_and_full_paint_is_no_text() -> None:
    drawn = torch.rand(300, generator=torch.Generator().manual_seed(0)).numpy()
    found = paint.decoded(paint.encoded(drawn), 300)
    assert found is not None
    assert np.abs(found.numpy() - drawn).max() <= 0.5 / 255 + 1e-6
    assert paint.encoded(np.ones(300, np.float32)) == paint.FULL
    assert paint.decoded(paint.FULL, 300) is None


@pytest.mark.parametrize("text", ["no base64!", "AAAA", paint.encoded(np.zeros(7, np.float32))])
def test_damaged_or_foreign_paint_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ProgdfError, match="paint it anew"):
        paint.decoded(text, 5)


def test_a_brush_is_full_inside_fades_to_its_edge_and_reaches_no_further() -> None:
    stroke = paint.drawn_to(LINE, 0.0, 0.0, ERASE)
    assert stroke.reached.tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0])
    hazy = paint.drawn_to(LINE, 0.0, 0.0, replace(ERASE, softness=1.0))
    assert hazy.reached.tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.0])
    dense = paint.drawn_to(LINE, 0.0, 0.0, ERASE, density=4.0)
    assert dense.reached[3] == 1.0, "the radius is in pixels at 1×"


def test_a_stroke_does_not_depend_on_how_many_events_it_came_in() -> None:
    whole = paint.drawn_to(paint.drawn_to(LINE, -20.0, 0.0, ERASE), 25.0, 0.0, ERASE)
    steps = LINE
    for x in np.linspace(-20.0, 25.0, 31):
        steps = paint.drawn_to(steps, float(x), 0.0, ERASE)
    assert steps.reached == pytest.approx(whole.reached, abs=1e-5)


def test_erase_add_and_smooth_go_to_none_to_all_and_to_the_mean() -> None:
    before = np.array([0.0, 1.0, 0.5, 0.25, 0.75], np.float32)
    stroke = replace(LINE, before=before, reached=np.array([1, 1, 0, 0, 0], np.float32))
    for mode, expected in (("erase", 0.0), ("add", 1.0), ("smooth", 0.5)):
        found = paint.decoded(paint.painted(stroke, mode), 5)
        assert found is not None
        assert found.tolist() == pytest.approx([expected, expected, 0.5, 0.25, 0.75], abs=0.003)


def test_the_front_brush_leaves_what_lies_behind_and_the_other_does_not(hand: Rig) -> None:
    gdf, scene = bear().gdfs[0], bear().scene
    front = paint.begun(paint.FULL, gdf, scene, camera_of(hand), through=False)
    through = paint.begun(paint.FULL, gdf, scene, camera_of(hand), through=True)
    assert not np.isnan(through.places).any()
    hidden = np.isnan(front.places[:, 0])
    assert 0.2 < hidden.mean() < 0.8, "a scarf goes around the neck"
    camera = camera_of(hand)
    depth = (scene.means[gdf.region.members] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2].numpy()
    assert depth[hidden].mean() > depth[~hidden].mean()


def test_a_stroke_on_the_picture_takes_the_edit_away_there_as_one_undo_entry(hand: Rig) -> None:
    camera, before = hand.stage.work.view.camera, hand.picture()
    x, y = scarf_on_screen(hand)
    hand.drag((x - 15, y), (x + 15, y))
    assert hand.stage.work.view.camera == camera, "the left button paints"
    assert weights(hand).min() < 0.02
    assert weights(hand, 1).min() == 1.0, "only the focused layer"
    assert len(hand.stage.work.past.past) == 1
    expected = compose(
        bear().scene,
        [Layer(bear().gdfs[0], 1.0, weights=torch.from_numpy(weights(hand))), Layer(bear().gdfs[1], 1.0)],
    )
    assert torch.allclose(hand.stage.engine.gaussians(hand.stage.work.view).sh0, expected.sh0, atol=1e-6)
    assert np.abs(hand.picture().astype(int) - before).max() > 20
    hand.key("Ctrl+Z")
    assert hand.stage.work.view.layers[0].paint == paint.FULL


def test_locked_hidden_or_no_layers_are_not_painted_and_the_window_says_why(hand: Rig) -> None:
    x, y = scarf_on_screen(hand)
    for chord, told in (("L", "locked"), ("H", "hidden"), ("Escape", "focused")):
        hand.key(chord)
        hand.drag((x, y), (x + 5, y))
        assert weights(hand).min() == 1.0
        assert hand.stage.work.message is not None
        assert told in hand.stage.work.message.text
        hand.key(chord)
        hand.frame(30)


def test_the_keys_of_the_brush_do_what_its_controls_do(hand: Rig) -> None:
    hand.key("B")
    assert not hand.stage.work.view.brush.active
    for chord in ("B", "X", "Shift+B", "]", "Shift+["):
        hand.key(chord)
    assert hand.stage.work.view.brush == Brush(True, 25.0, 0.4, "smooth", True)
    for _ in range(40):
        hand.key("]")
    assert hand.stage.work.view.brush.radius == paint.LARGEST_PX
    hand.key("Backspace")
    assert weights(hand).max() == 0.0
    hand.key("Shift+Backspace")
    assert hand.stage.work.view.layers[0].paint == paint.FULL
    assert hand.stage.work.past.past[0].layers[0].paint == paint.FULL


def test_weights_come_from_a_file_of_the_region_or_of_the_scene(tmp_path: Path) -> None:
    gdf = bear().gdfs[0]
    of_scene = np.linspace(0, 1, len(bear().scene), dtype=np.float32)
    of_region = of_scene[gdf.region.members.numpy()]
    for name, array in (("scene", of_scene), ("region", of_region)):
        np.save(tmp_path / f"{name}.npy", array)
    layers = [
        stack_of(bear().gdfs, [], paint=[f"scarf={tmp_path / name}.npy"])[0] for name in ("scene", "region")
    ]
    assert layers[0] == layers[1]
    assert layers[0].paint == paint.encoded(of_region)
    np.save(tmp_path / "long.npy", np.zeros(3))
    np.save(tmp_path / "large.npy", of_region + 1.0)
    for text, told in (
        ("scarf", "NAME=WEIGHTS.npy"),
        (f"hat={tmp_path / 'scene.npy'}", "no edit of that name"),
        (f"scarf={tmp_path / 'none.npy'}", "save weights with numpy.save"),
        (f"scarf={tmp_path / 'long.npy'}", "would be right"),
        (f"scarf={tmp_path / 'large.npy'}", "outside 0 to 1"),
    ):
        with pytest.raises(ProgdfError, match=told):
            stack_of(bear().gdfs, [], paint=[text])
