"""The field against what was recorded of its edit: found in the run folder, drawn beside it, told apart."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from PIL import Image

from progdf.__main__ import main
from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field.trajectory import FILE_NAME, save_trajectory
from progdf.gaussians import pack
from progdf.gdf.file import save_gdf
from progdf.metrics.image import psnr
from tests.helpers.divided import BANNER, SIZE, beside_line
from tests.helpers.stacks import recording_of
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.pictures import compare
from viewer.render.engine import ViewEngine
from viewer.state import facts
from viewer.state.actions import toggle_against, toggle_mode
from viewer.state.facts import RecordingFile
from viewer.state.view_state import Comparison, ViewState

AT = 0.4  # a strength between the snapshots at 0.31 and 0.5


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    return bear().save_runs(tmp_path)


def against_recorded(scarf: float, ears: float, mode: str = "split") -> ViewState:
    return replace(first_view(bear(), scarf, ears), compare=Comparison(mode, against="recorded"))


def drawn(view: ViewState, recorded: tuple[bool, bool]) -> np.ndarray:
    """The picture of `view` without a comparison, with some edits as they were recorded."""
    gdfs = [
        replace(gdf, field=facts.recorded_field(recording_of(gdf))) if kept else gdf
        for gdf, kept in zip(bear().gdfs, recorded, strict=True)
    ]
    return ViewEngine(None, bear().scene, gdfs, "cpu").image(replace(view, compare=Comparison()), SIZE)


@pytest.fixture
def hand(runs: list[Path]) -> Iterator[Rig]:
    drawn(first_view(bear(), 1.0, 1.0), (True, True))
    with rig(first_view(bear(), AT, AT), gdf_paths=runs[1:]) as made:
        yield made


@pytest.fixture
def tall(runs: list[Path]) -> Iterator[Rig]:
    """With room for the whole panel."""
    drawn(first_view(bear(), 1.0, 1.0), (True, True))
    with rig(first_view(bear(), AT, AT), (640, 600), gdf_paths=runs[1:]) as made:
        yield made


def test_the_recording_of_an_edit_is_found_in_its_run_folder(runs: list[Path]) -> None:
    for gdf, path in zip(bear().gdfs, runs[1:], strict=True):
        assert facts.find_recording(gdf, path) == RecordingFile(path.with_name(FILE_NAME))


def test_between_two_snapshots_the_recording_goes_straight_as_the_runs_own_errors_are_taken(
    runs: list[Path],
) -> None:
    scarf = bear().gdfs[0]
    found = facts.load_recorded(scarf, facts.find_recording(scarf, runs[1]))
    trajectory = recording_of(scarf)
    members = scarf.region.members
    for s in (0.0, 0.31, AT, 0.9, 1.0):
        shown = pack(compose_layers(bear().scene, [Layer(found, s)])[members])
        expected = pack(bear().scene[members]) + trajectory.at(s)
        assert torch.allclose(shown, expected, atol=1e-5)


def test_an_edit_outside_its_run_folder_has_no_recording(runs: list[Path], tmp_path: Path) -> None:
    shutil.copy(runs[1], tmp_path / "alone.gdf")
    found = facts.find_recording(bear().gdfs[0], tmp_path / "alone.gdf")
    assert (found.path, found.reason) == (None, f"there is no {FILE_NAME} beside alone.gdf")


def test_the_recording_of_another_edit_is_not_taken_for_this_ones(runs: list[Path]) -> None:
    ears = bear().gdfs[1]
    save_gdf(runs[1].with_name("ears.gdf"), ears)
    found = facts.find_recording(ears, runs[1].with_name("ears.gdf"))
    assert found.path is None
    assert "belongs to another edit" in found.reason


def test_a_damaged_recording_is_no_recording_and_says_why(runs: list[Path]) -> None:
    runs[1].with_name(FILE_NAME).write_bytes(b"\x40\x00\x00\x00\x00\x00\x00\x00{broken")
    found = facts.find_recording(bear().gdfs[0], runs[1])
    assert found.path is None
    assert "is damaged" in found.reason


def test_the_words_say_which_snapshots_are_shown_and_which_edits_have_none() -> None:
    here, nowhere = RecordingFile(Path("trajectory.safetensors")), RecordingFile()
    gdfs = bear().gdfs

    def told(scarf: float, ears: float, *found: RecordingFile) -> str:
        return facts.describe(first_view(bear(), scarf, ears), gdfs, found)

    assert told(AT, 0.0, here, here) == "recorded, between 0.31 and 0.5"
    assert told(0.5, 0.0, here, here) == "recorded at 0.5"
    assert told(0.0, 0.0, here, here) == "recorded at 0"
    assert told(AT, 0.74, here, here) == "recorded: scarf 0.31–0.5, ears 0.74"
    assert told(AT, 0.74, here, nowhere) == "recorded: scarf 0.31–0.5; field: ears"
    assert told(0.0, 0.74, here, nowhere) == "field: ears"
    assert told(1.2, 0.0, here, here) == "recorded at 1"


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_alt_y_shows_the_recorded_snapshots_left_and_the_field_right(runs: list[Path], draw: str) -> None:
    view = first_view(bear(), AT, AT)
    recorded, field = (drawn(view, which) for which in ((True, True), (False, False)))
    with rig(view, gdf_paths=runs[1:], draw=draw) as hand:
        hand.key("Alt+Y")
        assert hand.main_view.work.view.compare == Comparison("split", against="recorded")
        found = hand.picture().astype(float)
        near = 0.51 if draw == "cpu" else 2.0  # OpenGL is held to the CPU in test_gl_parity
        for side, expected in zip(beside_line(found, 170), (recorded, field), strict=True):
            where = 0 if expected is recorded else 1
            pixels = beside_line(expected.clip(0, 1) * 255, 170)[where]
            assert np.abs(side - pixels).max() <= near
        assert np.abs(recorded - field).max() > 0.02, "or nothing is shown"


@pytest.mark.gl
def test_the_psnr_of_field_against_recording_is_told_on_the_fields_side(hand: Rig) -> None:
    view = hand.main_view.work.view
    recorded, field = (drawn(view, which).clip(0, 1) for which in ((True, True), (False, False)))
    expected = psnr(torch.from_numpy(recorded), torch.from_numpy(field))
    hand.key("Alt+Y")
    comparer = hand.main_view.canvas.comparer
    assert comparer.psnr == pytest.approx(expected, abs=1e-3)
    said = comparer.labels(hand.main_view.work.view)
    assert said.right == f"field · PSNR {expected:.1f} dB"
    assert said.left == "recorded: scarf 0.31–0.5, ears 0.31–0.5"
    hand.key("D")
    assert comparer.psnr == pytest.approx(expected, abs=1e-3)
    assert comparer.labels(hand.main_view.work.view).line == (
        f"difference × 4 · PSNR {expected:.1f} dB · {said.left}"
    )
    apart = np.round((4 * np.abs(recorded - field)).clip(0, 1) * 255)
    assert np.abs(hand.picture()[BANNER:] - apart[BANNER:]).max() <= 1


@pytest.mark.gl
def test_a_slider_moves_both_sides_at_the_same_strength(hand: Rig) -> None:
    hand.key("Alt+Y")
    hand.drag(hand.slider(0, AT), hand.slider(0, 0.8))
    view = hand.main_view.work.view
    assert view.layers[0].strength == pytest.approx(0.8, abs=0.02)
    expected = drawn(view, (True, True)).clip(0, 1) * 255
    left = beside_line(hand.picture().astype(float), 170)[0]
    assert np.abs(left - beside_line(expected, 170)[0]).max() <= 0.51


@pytest.mark.gl
def test_at_a_difference_left_and_come_back_to_after_a_slider_moved_the_new_one_is_shown(hand: Rig) -> None:
    hand.key("D")
    before, psnr_before = hand.picture(), hand.main_view.canvas.comparer.psnr
    hand.key("Shift+Y")
    for _ in range(5):
        hand.key("2")  # the lower layer, the scarf
        hand.key("Shift+Right")
    hand.key("D")
    assert not np.array_equal(hand.picture()[BANNER:], before[BANNER:])
    assert hand.main_view.canvas.comparer.psnr != psnr_before


@pytest.mark.gl
def test_an_edit_without_a_recording_shows_its_field_on_both_sides(runs: list[Path]) -> None:
    runs[2].with_name(FILE_NAME).unlink()
    view = first_view(bear(), AT, AT)
    expected = drawn(view, (True, False)).clip(0, 1) * 255
    with rig(view, gdf_paths=runs[1:]) as hand:
        hand.key("Alt+Y")
        left = beside_line(hand.picture().astype(float), 170)[0]
        assert np.abs(left - beside_line(expected, 170)[0]).max() <= 0.51
        said = hand.main_view.canvas.comparer.labels(hand.main_view.work.view)
        assert said.left == "recorded: scarf 0.31–0.5; field: ears"


@pytest.mark.gl
def test_beyond_one_the_field_stands_beside_the_last_snapshot(runs: list[Path]) -> None:
    view = replace(against_recorded(1.2, 0.0), overshoot=True)
    last = drawn(first_view(bear(), 1.0, 0.0), (True, True)).clip(0, 1) * 255
    with rig(view, gdf_paths=runs[1:]) as hand:
        left = beside_line(hand.picture().astype(float), 170)[0]
        assert np.abs(left - beside_line(last, 170)[0]).max() <= 0.51


@pytest.mark.gl
def test_where_nothing_was_recorded_the_original_is_shown_and_the_reason_told() -> None:
    view = first_view(bear(), AT, AT)
    original = drawn(first_view(bear(), 0.0, 0.0), (False, False)).clip(0, 1) * 255
    with rig(view) as hand:
        hand.key("Alt+Y")
        said = hand.main_view.canvas.comparer.labels(hand.main_view.work.view)
        assert said.notice == f"Against the original: {facts.NO_FILE}"
        left = beside_line(hand.picture().astype(float), 170)[0][BANNER:]
        assert np.abs(left - beside_line(original, 170)[0][BANNER:]).max() <= 0.51
        shown = hand.image()[:100]
        hand.key("Alt+Y")
        assert hand.main_view.canvas.comparer.labels(hand.main_view.work.view).notice == ""
        assert not np.array_equal(hand.image()[:100], shown), "the notice is gone"


@pytest.mark.gl
def test_the_choice_is_dead_where_nothing_was_recorded_and_works_where_it_was(tall: Rig) -> None:
    tall.key("Shift+Y")
    choose_recorded(tall)
    assert tall.main_view.work.view.compare.against == "recorded"
    with rig(first_view(bear(), AT, AT), (640, 600)) as bare:
        bare.key("Shift+Y")
        choose_recorded(bare)
        assert bare.main_view.work.view.compare.against == "original"


def choose_recorded(hand: Rig) -> None:
    """From the menu of the comparison at the top of the picture."""
    pill = next(window for window in imgui.get_current_context().windows if window.name == "comparison")
    hand.click(pill.pos.x + pill.size.x - 16.0, pill.pos.y + 16.0)
    menu = imgui.get_current_context().open_popup_stack[0].window.pos
    hand.click(menu.x + 40.0, menu.y + 127.5)


@pytest.mark.gl
def test_a_recording_that_breaks_after_it_was_found_is_no_crash(runs: list[Path]) -> None:
    with rig(first_view(bear(), AT, AT), gdf_paths=runs[1:]) as hand:
        for path in runs[1:]:
            path.with_name(FILE_NAME).unlink()
        hand.key("Alt+Y")
        said = hand.main_view.canvas.comparer.labels(hand.main_view.work.view)
        assert said.left == compare.ORIGINAL
        assert "does not exist" in said.notice


def test_a_recording_that_does_not_fit_its_edit_is_one_line(runs: list[Path]) -> None:
    scarf, ears = bear().gdfs
    extra = {"members": scarf.region.members}
    save_trajectory(runs[1].with_name(FILE_NAME), recording_of(ears), extra, {})
    with pytest.raises(ProgdfError, match="belongs to another edit"):
        facts.load_recorded(scarf, RecordingFile(runs[1].with_name(FILE_NAME)))


def test_another_recording_of_the_same_members_is_not_taken_for_this_ones(runs: list[Path]) -> None:
    scarf = bear().gdfs[0]
    other = recording_of(scarf)
    extra = {"members": scarf.region.members}
    save_trajectory(runs[1].with_name(FILE_NAME), replace(other, end=other.end + 1e-6), extra, {})
    assert "belongs to another edit" in facts.find_recording(scarf, runs[1]).reason


def test_a_recording_is_shown_where_the_field_shows_it(runs: list[Path]) -> None:
    scarf = bear().gdfs[0]
    recorded = recording_of(scarf)
    extra = {"members": scarf.region.members, "score": scarf.region.score}
    early = replace(recorded, s=recorded.s.square())
    save_trajectory(runs[1].with_name(FILE_NAME), early, extra, {})
    found = facts.load_recorded(scarf, facts.find_recording(scarf, runs[1]))
    assert found.field.knots.tolist() == recorded.s.tolist()


def test_against_the_recording_goes_on_with_a_split_and_back_to_the_original() -> None:
    on = toggle_against(ViewState())
    assert on.compare == Comparison("split", against="recorded")
    assert toggle_against(on).compare == Comparison("split")
    apart = toggle_mode(on, "difference")
    assert apart.compare == Comparison("difference", against="recorded")


def test_equal_pictures_are_told_as_such_and_figures_that_were_not_taken_are_left_out() -> None:
    split = Comparison("split", against="recorded")
    assert compare.labels(split, math.inf, "recorded at 0").right == "field · no difference"
    assert compare.labels(split, math.nan, "recorded at 0").right == "field"


def rendered(*options: str) -> np.ndarray:
    common = (
        "bear.ply",
        "scarf/scarf.gdf",
        "ears/ears.gdf",
        "--set",
        f"scarf={AT}",
        "--set",
        "ears=0",
        "--size",
        "96x72",
    )
    assert main(["render", *common, "--engine", "cpu", *options, "-o", "out.png"]) == 0
    return np.asarray(Image.open("out.png")).astype(int)


@pytest.mark.parametrize("options", [("--split", "0.7"), ("--difference", "8")])
def test_render_compares_with_the_recording(
    runs: list[Path],
    options: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(runs[0].parent)
    original, field = rendered(*options), rendered()
    recorded = rendered(*options, "--against", "recorded")
    told = capsys.readouterr().out.splitlines()[-1]
    assert told.startswith("PSNR of the field against what was recorded ")
    assert told.endswith("dB (recorded, between 0.31 and 0.5)")
    assert np.abs(recorded - original).max() > 20
    if "--split" in options:
        assert np.array_equal(recorded[26:, 71:], field[26:, 71:])
        assert not np.array_equal(recorded[26:, :63], field[26:, :63])
    else:
        assert recorded[26:].sum() < 0.5 * original[26:].sum(), "the field is near to the recording"


def test_render_says_in_one_line_why_there_is_no_recording(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(runs[0].parent)
    for path in runs[1:]:
        path.with_name(FILE_NAME).unlink()
    argv = ["render", "bear.ply", "scarf/scarf.gdf", "--split", "--against", "recorded", "-o", "x.png"]
    assert main([*argv, "--engine", "cpu"]) == 2
    error = capsys.readouterr().err
    assert f"there is no {FILE_NAME} beside scarf.gdf; give the .gdf in its run folder" in error
    assert error.count("\n") == 1
    assert not Path("x.png").exists()
