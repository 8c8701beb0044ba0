"""Original against edited, full screen, side by side or subtracted, in the window and in files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.metrics.image import psnr
from tests.helpers.divided import BANNER, SIZE, beside_line
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.camera.view_camera import half_camera, to_camera
from viewer.state.snapshots import toggle_mode
from viewer.state.view_state import Comparison, ViewState


@cache
def whole(scarf: float, ears: float, draw: str = "cpu") -> np.ndarray:
    """Render the bear without a comparison in the default rig. Call it before another rig exists."""
    with rig(first_view(bear(), scarf, ears), draw=draw) as hand:
        return hand.picture()


@pytest.fixture
def hand() -> Iterator[Rig]:
    whole(0.0, 0.0), whole(1.0, 1.0)
    with rig(first_view(bear(), 1.0, 1.0)) as opened:
        yield opened


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_shift_y_splits_the_view_into_original_and_edited(draw: str) -> None:
    original = whole(0.0, 0.0, draw)
    with rig(first_view(bear(), 1.0, 1.0), draw=draw) as hand:
        edited = hand.picture()
        hand.key("Shift+Y")
        left, right = beside_line(hand.picture(), 170)
        assert np.array_equal(left, beside_line(original, 170)[0])
        assert np.array_equal(right, beside_line(edited, 170)[1])
        assert not np.array_equal(left, beside_line(edited, 170)[0])
        hand.key("Shift+Y")
        assert np.array_equal(hand.picture(), edited)


@pytest.mark.gl
def test_divider_follows_the_pointer_without_drawing_splats(hand: Rig) -> None:
    hand.key("Shift+Y")
    before = hand.main_view.work.view.camera
    drawn = hand.main_view.canvas.pictures_drawn
    hand.drag((170.0, 300.0), (100.0, 310.0))
    assert hand.main_view.work.view.compare.divider == pytest.approx(100 / 340)
    assert (hand.main_view.work.view.camera, hand.main_view.canvas.pictures_drawn) == (before, drawn)
    left, right = beside_line(hand.picture(), 100)
    assert np.array_equal(left, beside_line(whole(0.0, 0.0), 100)[0])
    assert np.array_equal(right, beside_line(whole(1.0, 1.0), 100)[1])
    hand.drag((100.0, 300.0), (-50.0, 300.0))
    assert hand.main_view.work.view.compare.divider == 0.0
    assert len(hand.main_view.work.past.past) == 1, "the comparison is set once, wherever its divider goes"


@pytest.mark.gl
def test_drag_beside_the_divider_orbits_both_sides(hand: Rig) -> None:
    hand.key("Shift+Y")
    hand.drag((250.0, 300.0), (280.0, 300.0))
    view = hand.main_view.work.view
    assert view.compare.divider == 0.5
    left, right = beside_line(hand.picture(), 170)
    for side, shown in ((left, replace(view, layers=())), (right, view)):
        image = hand.main_view.engine.image(replace(shown, compare=Comparison()), SIZE)
        expected = beside_line(np.clip(image, 0, 1) * 255, 170)[0 if side is left else 1]
        assert np.abs(side - expected).max() <= 0.51


@pytest.mark.gl
def test_slider_in_split_changes_only_the_right_side(hand: Rig) -> None:
    hand.key("Shift+Y")
    hand.drag((170.0, 300.0), (120.0, 300.0))
    left, right = beside_line(hand.picture(), 120)
    for _ in range(8):
        hand.key("2")  # the lower layer, the scarf
        hand.key("Shift+Left")
    now_left, now_right = beside_line(hand.picture(), 120)
    assert np.array_equal(left, now_left)
    assert not np.array_equal(right, now_right)


@pytest.mark.gl
def test_difference_is_amplified_and_reports_the_psnr(hand: Rig) -> None:
    hand.key("Alt+Y")
    view = hand.main_view.work.view
    edited = hand.main_view.engine.image(view, SIZE).clip(0, 1)
    original = hand.main_view.engine.image(replace(view, layers=()), SIZE).clip(0, 1)
    expected = np.round((4.0 * np.abs(edited - original)).clip(0, 1) * 255)
    hand.frame()
    assert np.abs(hand.picture()[BANNER:] - expected[BANNER:]).max() <= 1
    assert (hand.picture()[BANNER:] == 0).mean() > 0.5
    found = psnr(torch.from_numpy(edited), torch.from_numpy(original))
    assert hand.main_view.canvas.comparer.psnr == pytest.approx(found, abs=1e-6)
    hand.main_view.store.change(replace(view, compare=replace(view.compare, amplify=16.0)))
    hand.settle()
    assert hand.picture()[BANNER:].astype(int).sum() > 1.5 * expected[BANNER:].sum()


@pytest.mark.gl
def test_equal_pictures_have_no_difference() -> None:
    with rig(first_view(bear(), 0.0, 0.0)) as hand:
        hand.key("Alt+Y")
        assert hand.picture()[BANNER:].max() == 0
        assert hand.main_view.canvas.comparer.psnr == math.inf
        assert hand.main_view.canvas.comparer.labels(hand.main_view.work.view).line == "difference: none"


@pytest.mark.gl
def test_backslash_shows_the_whole_original_over_any_comparison(hand: Rig) -> None:
    original = whole(0.0, 0.0)
    for chord in ("Shift+Y", "Alt+Y"):
        hand.key(chord)
        hand.key("\\")
        assert np.array_equal(hand.picture()[BANNER:], original[BANNER:])
        hand.key("\\")


@pytest.mark.gl
def test_difference_is_updated_after_a_slider_moved_in_split_mode(hand: Rig) -> None:
    hand.key("Alt+Y")
    before = hand.picture()
    psnr_before = hand.main_view.canvas.comparer.psnr
    hand.key("Shift+Y")
    for _ in range(5):
        hand.key("2")  # the lower layer, the scarf
        hand.key("Shift+Left")
    hand.key("Alt+Y")
    assert not np.array_equal(hand.picture()[BANNER:], before[BANNER:])
    assert hand.main_view.canvas.comparer.psnr != psnr_before


@pytest.mark.gl
def test_idle_comparison_draws_nothing(hand: Rig) -> None:
    for chord in ("Shift+Y", "Alt+Y"):
        hand.key(chord)
        hand.pause(1.0)
        hand.frame(2)  # a tooltip may wait for one second of rest
        drawn = hand.main_view.canvas.pictures_drawn
        hand.frame(3)
        assert hand.main_view.next_frame_delay() is None
        assert hand.main_view.canvas.pictures_drawn == drawn


@pytest.mark.gl
def test_saved_picture_holds_the_comparison_with_its_labels(tmp_path: Path) -> None:
    with rig(first_view(bear(), 1.0, 1.0), pictures=tmp_path) as hand:
        hand.key("Shift+Y")
        shown = hand.picture()
        hand.key("F2")
        picture = Image.open(tmp_path / "bear_001.png")
        assert not picture.info, "a comparison is no view that could be edited"
        saved = np.asarray(picture)
        left, right = beside_line(saved, 170)
        shown_left, shown_right = beside_line(shown, 170)
        assert np.array_equal(left, shown_left)
        assert np.array_equal(right, shown_right)


@pytest.mark.gl
def test_y_shows_two_pictures_that_orbit_together_and_allow_picking(hand: Rig, tmp_path: Path) -> None:
    hand.key("Y")
    hand.drag((250.0, 300.0), (290.0, 310.0))
    view = hand.main_view.work.view
    half = half_camera(to_camera(view.camera, *SIZE))
    sides = (hand.picture()[BANNER:, :165], hand.picture()[BANNER:, 175:])
    images = [
        np.clip(hand.main_view.engine.image(replace(shown, compare=Comparison()), camera=half), 0, 1) * 255
        for shown in (replace(view, layers=()), view)
    ]
    assert np.abs(sides[0] - images[0][BANNER:, :165]).max() <= 0.51
    assert np.abs(sides[1] - images[1][BANNER:, 5:]).max() <= 0.51
    assert np.abs(images[0] - images[1]).max() > 60
    hand.main_view.store.replace(replace(hand.main_view.work, focus=None))
    hand.click(262.0, 262.0)
    assert hand.main_view.work.focus is not None, "the scarf in the right half"
    hand.main_view.store.replace(replace(hand.main_view.work, focus=None))
    hand.click(92.0, 262.0)
    assert hand.main_view.work.focus is not None, "and in the left one"
    hand.main_view.pictures, shown = tmp_path, hand.picture()
    hand.key("F2")
    saved = np.asarray(Image.open(tmp_path / "bear_001.png"))
    assert np.array_equal(saved[BANNER:, :165], shown[BANNER:, :165])
    assert np.array_equal(saved[BANNER:, 175:], shown[BANNER:, 175:])


@pytest.mark.gl
def test_backslash_shows_the_original_until_pressed_or_a_slider_moves(hand: Rig) -> None:
    edited = hand.picture()
    hand.key("\\")
    assert np.array_equal(hand.picture()[BANNER:], whole(0.0, 0.0)[BANNER:])
    hand.key("\\")
    assert np.array_equal(hand.picture(), edited)
    hand.key("\\")
    hand.key("Shift+Left")
    assert not hand.main_view.work.before


def test_comparison_modes_toggle_and_replace_each_other() -> None:
    view = ViewState()
    split = toggle_mode(view, "split")
    assert split.compare.mode == "split"
    assert toggle_mode(split, "split") == view
    assert toggle_mode(split, "difference").compare.mode == "difference"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    bear().save(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rendered(*options: str) -> np.ndarray:
    common = ("bear.ply", "scarf.gdf", "--set", "scarf=1", "--size", "96x72", "--engine", "cpu")
    assert main(["render", *common, *options, "-o", "out.png"]) == 0
    return np.asarray(Image.open("out.png")).astype(int)


def test_render_writes_a_split_at_the_given_share(folder: Path) -> None:
    edited = rendered()
    original = rendered("--set", "scarf=0")
    picture = rendered("--split", "0.25")
    assert np.array_equal(picture[26:, :21], original[26:, :21])
    assert np.array_equal(picture[26:, 28:], edited[26:, 28:])
    assert (picture[:, 24] == 255).all(), "the divider"


def test_render_splits_in_the_middle_by_default(folder: Path) -> None:
    assert (rendered("--split")[:, 48] == 255).all()


def test_render_writes_a_difference_and_reports_the_psnr(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edited = rendered()
    original = rendered("--set", "scarf=0")
    picture = rendered("--difference", "2")
    expected = np.minimum(2 * np.abs(edited - original), 255)
    assert np.abs(picture[26:] - expected[26:]).max() <= 2
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "about"),
    [
        (("--split", "1.5"), "between 0 and 1"),
        (("--split=left",), "between 0 and 1"),
        (("--difference", "0"), "between 1 and 64"),
        (("--split", "--difference"), "one of them"),
        (("--split", "--sheet", "scarf"), "one of them"),
    ],
)
def test_invalid_comparison_options_are_one_line(
    folder: Path, options: tuple[str, ...], about: str, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["render", "bear.ply", "scarf.gdf", "--engine", "cpu", *options, "-o", "bad.png"]
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert about in error
    assert not Path("bad.png").exists()
