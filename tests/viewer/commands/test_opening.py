"""Sessions on the command line: rendered, exported and filmed with all that they hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.compose.layers import Gains
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES
from progdf.quaternions import normalize_quats
from tests.helpers.sessions import full_view
from tests.helpers.ui_rig import bear
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.pictures import film
from viewer.render.engine import ViewEngine
from viewer.state import timeline
from viewer.state.view_state import Comparison, LayerState, Timeline, ViewState

SMALL = ("--size", "64x48", "--engine", "cpu")


def saved(folder: Path, view: ViewState) -> Path:
    """work.session.json in `folder`, beside the bear and its edits."""
    scene, *gdfs = bear().save(folder)
    session.save(folder / "work.session.json", WindowSession(document.load(scene, gdfs), view))
    return folder / "work.session.json"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*argv: str) -> int:
    return main(list(argv))


@pytest.mark.parametrize("command", ["view", "render", "export"])
def test_an_edit_given_twice_is_refused_however_its_file_is_named(
    here: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bear().save(here)
    (here / "link.gdf").symlink_to("ears.gdf")
    out = {"render": ("-o", "x.png"), "export": ("-o", "x.ply")}.get(command, ())
    for again, told in (("./ears.gdf", "ears.gdf was given twice"), ("link.gdf", "first as ears.gdf")):
        assert run(command, "bear.ply", "ears.gdf", "scarf.gdf", again, *out) == 2
        error = capsys.readouterr().err
        assert told in error
        assert error.count("\n") == 1
    assert not list(here.glob("x.*"))


@pytest.mark.parametrize("blend", ["normalized", "sum", "over"])
def test_an_exported_session_is_what_the_window_shows(here: Path, blend: str) -> None:
    """Strengths, gains, paint, which layers show, their order and how they blend."""
    view = replace(full_view(), blend=blend)
    again = LayerState(2, "ears once more", 0.6, gains=Gains(1.0, 1.0, 0.3))
    three = tuple(replace(layer, solo=False, enabled=True) for layer in (*view.layers, again))
    scene, scarf, ears = bear().save(here)
    opened = document.load(scene, [scarf, ears, ears])
    for layers in (view.layers, three, three[::-1]):
        shown = replace(view, layers=layers)
        session.save(here / "work.session.json", WindowSession(opened, shown))
        assert run("export", "--session", "work.session.json", "-o", "edited.ply") == 0
        expected, found = (
            ViewEngine(None, opened.scene, opened.gdfs).gaussians(shown),
            load_ply("edited.ply"),
        )
        for name in ATTRIBUTES:
            was, now = getattr(expected, name), getattr(found, name)
            was = normalize_quats(was) if name == "quats" else was
            assert torch.allclose(now, was, rtol=1e-5, atol=1e-6), name


def test_an_export_says_which_layers_of_the_session_are_in_it(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(here, full_view())
    assert run("export", "work.session.json", "-o", "edited.ply") == 0
    assert "ears → gold 0.375; read back" in capsys.readouterr().out


def test_a_strength_said_beside_the_session_wins_under_the_layers_name_or_its_edits(here: Path) -> None:
    saved(here, full_view())
    for name in ("ears", "ears → gold"):
        assert run("export", "work.session.json", "--set", f"{name}=0", "-o", "edited.ply") == 0
        assert torch.equal(load_ply("edited.ply").means, bear().scene.means)


def test_a_blend_rule_given_beside_the_session_takes_the_place_of_its_own(here: Path) -> None:
    view = replace(full_view(), blend="normalized")
    view = replace(view, layers=tuple(replace(layer, solo=False, enabled=True) for layer in view.layers))
    scene, _, ears = bear().save(here)
    opened = document.load(scene, [ears, ears])
    session.save(here / "work.session.json", WindowSession(opened, view))
    for name, given in (("own", ()), ("sum", ("--blend", "sum"))):
        assert run("export", "work.session.json", "--set", "ears=1", *given, "-o", f"{name}.ply") == 0
        shown = replace(view, blend=given[1] if given else view.blend)
        layers = tuple(
            replace(layer, strength=1.0 if layer.gdf == 0 else layer.strength) for layer in view.layers
        )
        expected = ViewEngine(None, opened.scene, opened.gdfs).gaussians(replace(shown, layers=layers))
        assert torch.allclose(load_ply(f"{name}.ply").means, expected.means, atol=1e-6)
    assert not torch.equal(load_ply("own.ply").sh0, load_ply("sum.ply").sh0)


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (("--out", "bear.ply"), "bear.ply is one of the files to read"),
        (("--out", "x.ply", "--paint", "ears=w.npy"), "--paint was given with the session"),
        (("--out", "x.ply", "--set", "hat=1"), "there is no edit of that name; there are ears → gold, scarf"),
        (("--out", "x.ply", "ears.gdf"), "an edit was given with the session"),
    ],
)
def test_an_export_of_a_session_that_cannot_be_is_one_line_and_changes_no_file(
    here: Path, argv: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(here, full_view())
    before = {path: path.read_bytes() for path in here.iterdir()}
    assert run("export", "work.session.json", *argv) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in here.iterdir()} == before


def test_a_sweep_moves_a_renamed_layer_of_a_session_and_leaves_its_comparison_alone(here: Path) -> None:
    saved(here, full_view())
    sheets = []
    for name in ("ears", "ears → gold"):
        assert run("render", "work.session.json", "--sheet", name, *SMALL, "-o", "sheet.png") == 0
        sheets.append(np.asarray(Image.open("sheet.png")))
    first, last = sheets[0][-50:, :64], sheets[0][-50:, -70:-6]
    assert np.abs(first.astype(int) - last).max() > 20, "the slider moves"
    assert sheets[0].shape == sheets[1].shape


def test_a_sweep_shows_a_layer_whose_group_is_hidden_and_refuses_one_whose_group_is_at_zero(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ears, scarf = full_view().layers
    view = replace(full_view(), layers=(replace(ears, solo=False), scarf), compare=Comparison())
    given = ("render", "work.session.json", "--sheet", "ears", *SMALL, "-o", "sheet.png")
    sheets = []
    for enabled in (True, False):
        saved(here, replace(view, groups=(replace(view.groups[0], enabled=enabled),)))
        assert run(*given) == 0
        sheets.append(Path("sheet.png").read_bytes())
    assert sheets[0] == sheets[1]
    saved(here, replace(view, groups=(replace(view.groups[0], strength=0.0),)))
    capsys.readouterr()
    assert run(*given) == 2
    assert "its group warm is at 0, so nothing would change" in capsys.readouterr().err


def test_a_session_in_a_comparison_is_rendered_in_it(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, replace(full_view(), compare=Comparison("difference", amplify=2.0)))
    assert run("render", "work.session.json", *SMALL, "-o", "a.png") == 0
    assert "PSNR of edited against original" in capsys.readouterr().out


def filmed(moving: bool) -> ViewState:
    """The scarf turned green in eight frames, with or without the camera."""
    view = replace(full_view(), timeline=Timeline(length=8), compare=Comparison())
    view = replace(view, layers=tuple(replace(layer, solo=False, enabled=True) for layer in view.layers))
    made = view.timeline
    for frame, strength in ((0, 0.0), (8, 1.0)):
        layers = tuple(replace(layer, strength=strength) for layer in view.layers)
        made = timeline.with_key(made, frame, replace(view, layers=layers))
    keys = made.keys if moving else tuple(replace(key, camera=None) for key in made.keys)
    return replace(view, timeline=replace(made, keys=keys))


def test_the_sessions_own_timeline_can_be_filmed(here: Path) -> None:
    view = filmed(moving=True)
    saved(here, view)
    given = ("render", "--session", "work.session.json", "--timeline", "work.session.json", *SMALL)
    assert run(*given, "-o", "frames") == 0
    assert len(list(Path("frames").iterdir())) == 9
    expected = ViewEngine(None, bear().scene, bear().gdfs).image(
        timeline.state_at(view.timeline, 5, view), (64, 48)
    )
    found = np.asarray(Image.open("frames/frame_0005.png")).astype(int)
    assert np.abs(found - film.to_pixels(expected)).max() <= 1


def test_a_contact_sheet_shows_frames_from_the_first_to_the_last_of_a_film(here: Path) -> None:
    view = filmed(moving=False)
    saved(here, view)
    given = ("render", "work.session.json", "--timeline", "work.session.json", *SMALL)
    assert run(*given, "-o", "frames") == 0
    assert run(*given, "--sheet", "5", "-o", "sheet.png") == 0
    page = np.asarray(Image.open("sheet.png"))
    for frame in (0, 2, 4, 6, 8):
        assert holds(page, np.asarray(Image.open(f"frames/frame_{frame:04d}.png")))
    assert not holds(page, np.asarray(Image.open("frames/frame_0003.png")))
    first = Path("sheet.png").read_bytes()
    assert run(*given, "--sheet", "5", "-o", "sheet.png") == 0
    assert Path("sheet.png").read_bytes() == first


def holds(page: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the picture is somewhere on the page, pixel for pixel."""
    height, width = picture.shape[:2]
    ys, xs = np.nonzero((page == picture[0, 0]).all(-1))
    return any(
        np.array_equal(page[y : y + height, x : x + width], picture) for y, x in zip(ys, xs, strict=True)
    )


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_a_contact_sheet_never_shows_a_frame_twice(count: int) -> None:
    from viewer.pictures.film import sheet_frames

    found = sheet_frames(Timeline(length=12, ping_pong=True), count)
    assert len(found) == min(count, 13)
    assert found[0] == 0
    assert count == 1 or found[-1] == 12


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--sheet", "ears"), "--sheet ears is not a number of pictures"),
        (("--sheet", "0"), "from 1 to 100"),
        (("--sheet", "4", "-o", "x.gif"), "x.gif holds an animation"),
        (("--sheet", "4", "--frame", "all"), "moves the camera"),
        (("--against", "recorded"), "add --split or --difference"),
    ],
)
def test_a_sheet_or_comparison_that_makes_no_sense_is_one_line(
    here: Path, options: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(here, filmed(moving=True))
    film_of = ("--timeline", "work.session.json") if "--sheet" in options else ()
    out = () if "-o" in options else ("-o", "x.png")
    assert run("render", "work.session.json", *film_of, *SMALL, *options, *out) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not list(here.glob("x.*"))


def test_a_session_without_keys_cannot_be_filmed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, replace(full_view(), timeline=Timeline()))
    assert run("render", "work.session.json", "--timeline", "work.session.json", "-o", "a.gif") == 2
    assert "has no keys on its timeline" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["view", "render", "export"])
def test_help_says_what_happens_without_an_option(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    assert [trace for trace in ("None", "False", "(default: )", "STR", "PATH") if trace in text] == []
    assert "--set NAME=S" in text
