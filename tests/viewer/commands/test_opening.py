"""Sessions on the command line: render, export and film them with everything they hold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.compose.layers import Gains
from progdf.errors import ProgdfError
from progdf.field.baked import GradeForm, identity_map, lattice_colors
from progdf.field.grade import bake_grade, fit_grade, lattice_form, map_colors
from progdf.formats import scene_file
from progdf.formats.axes import Axes
from progdf.formats.cube import read_cube, write_cube
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.file import save_gdf
from progdf.quaternions import normalize_quats
from progdf.region import Region, from_mask
from progdf.sh import C0
from tests.helpers.edits import edit_of
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import full_view
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import ViewCamera
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.pictures import film
from viewer.render.engine import ViewEngine
from viewer.state import timeline
from viewer.state.view_state import Comparison, Keyframe, LayerState, Timeline, ViewState

SMALL = ("--size", "64x48", "--engine", "cpu")


def saved(folder: Path, view: ViewState) -> Path:
    """Write work.session.json, the bear and its edits to `folder`; return the session's path."""
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
def test_duplicate_edit_is_refused_under_any_file_name(
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
def test_exported_session_matches_the_window(here: Path, blend: str) -> None:
    """Covers strengths, gains, paint, visibility, layer order and blend rule."""
    view = replace(full_view(), blend=blend)
    again = LayerState(2, "ears once more", 0.6, gains=Gains(1.0, 1.0, 0.3))
    three = tuple(replace(layer, solo=False, enabled=True) for layer in (*view.layers, again))
    scene, scarf, ears = bear().save(here)
    opened = document.load(scene, [scarf, ears, ears])
    for layers in (view.layers, three, three[::-1]):
        shown = replace(view, layers=layers)
        session.save(here / "work.session.json", WindowSession(opened, shown))
        assert run("export", "--session", "work.session.json", "-o", "edited.ply") == 0
        expected = ViewEngine(None, opened.scene, opened.gdfs).gaussians(shown)
        found = load_ply("edited.ply")
        for name in ATTRIBUTES:
            was = getattr(expected, name)
            now = getattr(found, name)
            was = normalize_quats(was) if name == "quats" else was
            assert torch.allclose(now, was, rtol=1e-5, atol=1e-6), name


def test_export_reports_the_included_layers(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, full_view())
    assert run("export", "work.session.json", "-o", "edited.ply") == 0
    assert "ears → gold 0.375; read back" in capsys.readouterr().out


def test_set_overrides_the_session_by_layer_or_edit_name(here: Path) -> None:
    saved(here, full_view())
    for name in ("ears", "ears → gold"):
        assert run("export", "work.session.json", "--set", f"{name}=0", "-o", "edited.ply") == 0
        assert torch.equal(load_ply("edited.ply").means, bear().scene.means)


def test_blend_option_overrides_the_session(here: Path) -> None:
    view = replace(full_view(), blend="normalized")
    shown_layers = tuple(replace(layer, solo=False, enabled=True, blend="") for layer in view.layers)
    view = replace(view, layers=shown_layers)
    scene, _, ears = bear().save(here)
    opened = document.load(scene, [ears, ears])
    session.save(here / "work.session.json", WindowSession(opened, view))
    one = ("--blend", "ears=sum")
    for name, given in (("own", ()), ("sum", ("--blend", "sum")), ("one", one)):
        assert run("export", "work.session.json", "--set", "ears=1", *given, "-o", f"{name}.ply") == 0
        shown = replace(view, blend=given[1] if name == "sum" else view.blend)
        layers = tuple(
            replace(layer, strength=1.0 if layer.gdf == 0 else layer.strength) for layer in view.layers
        )
        if name == "one":
            layers = tuple(replace(l, blend="sum" if l.gdf == 0 else l.blend) for l in layers)
        expected = ViewEngine(None, opened.scene, opened.gdfs).gaussians(replace(shown, layers=layers))
        assert torch.allclose(load_ply(f"{name}.ply").means, expected.means, atol=1e-6)
    assert not torch.equal(load_ply("own.ply").sh0, load_ply("sum.ply").sh0)


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (("--out", "bear.ply"), "bear.ply is one of the files to read"),
        (("--out", "x.ply", "--set", "hat=1"), "there is no edit of that name; there are ears → gold, scarf"),
        (("--out", "x.ply", "ears.gdf"), "an edit was given with the session"),
    ],
)
def test_invalid_session_export_is_one_line_and_changes_no_file(
    here: Path, argv: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(here, full_view())
    before = {path: path.read_bytes() for path in here.iterdir()}
    assert run("export", "work.session.json", *argv) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in here.iterdir()} == before


def test_sheet_of_a_renamed_layer_ignores_the_comparison(here: Path) -> None:
    saved(here, full_view())
    sheets = []
    for name in ("ears", "ears → gold"):
        assert run("render", "work.session.json", "--sheet", name, *SMALL, "-o", "sheet.png") == 0
        sheets.append(np.asarray(Image.open("sheet.png")))
    first = sheets[0][-50:, :64]
    last = sheets[0][-50:, -70:-6]
    assert np.abs(first.astype(int) - last).max() > 20, "the slider moves"
    assert sheets[0].shape == sheets[1].shape


def test_sheet_shows_a_layer_in_a_hidden_group_but_not_at_zero(
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


def test_session_with_a_comparison_is_rendered_in_it(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, replace(full_view(), compare=Comparison("difference", amplify=2.0)))
    assert run("render", "work.session.json", *SMALL, "-o", "a.png") == 0
    assert "PSNR of edited against original" in capsys.readouterr().out


def filmed(moving: bool) -> ViewState:
    """Return a view whose scarf turns green within eight frames; `moving` adds the camera to the keys."""
    view = replace(full_view(), timeline=Timeline(length=8), compare=Comparison())
    view = replace(view, layers=tuple(replace(layer, solo=False, enabled=True) for layer in view.layers))
    film_keys = view.timeline
    for frame, strength in ((0, 0.0), (8, 1.0)):
        layers = tuple(replace(layer, strength=strength) for layer in view.layers)
        film_keys = timeline.with_key(film_keys, frame, replace(view, layers=layers))
    keys = film_keys.keys if moving else tuple(replace(key, camera=None) for key in film_keys.keys)
    return replace(view, timeline=replace(film_keys, keys=keys))


def test_timeline_of_a_session_can_be_filmed(here: Path) -> None:
    view = filmed(moving=True)
    saved(here, view)
    given = ("render", "--session", "work.session.json", "--timeline", *SMALL)
    assert run(*given, "-o", "frames") == 0
    assert len(list(Path("frames").iterdir())) == 9
    expected = ViewEngine(None, bear().scene, bear().gdfs).image(
        timeline.state_at(view.timeline, 5, view), (64, 48)
    )
    found = np.asarray(Image.open("frames/frame_0005.png")).astype(int)
    assert np.abs(found - film.to_pixels(expected)).max() <= 1


def test_timeline_exports_numbered_scenes_equal_to_the_film(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = filmed(moving=True)
    saved(here, view)
    given = ("export", "work.session.json", "--timeline")
    assert run(*given, "-o", "film.PLY") == 0
    assert "film_000.PLY to film_008.PLY: 9 frames of the timeline" in capsys.readouterr().out
    assert run(*given, "--frames", "3", "-o", "few.ply") == 0
    engine = ViewEngine(None, bear().scene, bear().gdfs)
    for frame, file in ((0, "few_000.ply"), (4, "few_001.ply"), (5, "film_005.PLY"), (8, "few_002.ply")):
        state = timeline.state_at(view.timeline, frame, view)
        found = ViewEngine(None, load_ply(file), []).image(replace(state, layers=()), (64, 48))
        assert np.abs(found - engine.image(state, (64, 48))).max() < 1e-4, file


def test_timeline_exports_usd_time_samples_at_its_frame_rate(here: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="pip install progdf-studio[usd]")
    saved(here, replace(view := filmed(moving=False), timeline=replace(view.timeline, fps=12)))
    given = ("export", "work.session.json", "--timeline")
    for more, rate, last in (((), 12.0, 8.0), (("--frames", "3"), 3.0, 2.0)):
        assert run(*given, *more, "-o", f"{rate}.usdc") == 0
        stage = usd.Stage.Open(f"{rate}.usdc")
        assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (rate, last)


def test_failed_frame_export_leaves_no_frames_and_keeps_inputs(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(here, filmed(moving=False))
    Path("same_001.ply").symlink_to("bear.ply")
    given = ("work.session.json", "--timeline")
    assert run("export", *given, "-o", "same.ply") == 2
    assert "same_001.ply is one of the files to read" in capsys.readouterr().err
    whole = scene_file.save_scene

    def full(path: Path, scene: Gaussians, axes: Axes) -> None:
        if path.name == "film_003.ply":
            raise ProgdfError(f"{path} cannot be written: no space left on device")
        whole(path, scene, axes)

    monkeypatch.setattr(scene_file, "save_scene", full)
    assert run("export", *given, "-o", "film.ply") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(here.glob("film*"))


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (Timeline((Keyframe(0, camera=ViewCamera()),), 8), "moves no slider"),
        (Timeline((Keyframe(0, ((0, 0.0),)),), 2000), "has 2001 frames; limit them with --frames"),
    ],
)
def test_timeline_without_a_scene_sequence_is_refused(
    here: Path, keys: Timeline, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(here, replace(full_view(), timeline=keys))
    assert run("export", "work.session.json", "--timeline", "-o", "a.ply") == 2
    assert said in capsys.readouterr().err
    assert run("export", "work.session.json", "--timeline", "-o", "a.html") == 2


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_sheet_frames_are_distinct(count: int) -> None:
    from viewer.pictures.film import sheet_frames

    found = sheet_frames(Timeline(length=12, ping_pong=True), count)
    assert len(found) == min(count, 13)
    assert found[0] == 0
    assert count == 1 or found[-1] == 12


def test_sheet_of_a_timeline_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, filmed(moving=True))
    film_of = ("--timeline", "--sheet", "ears")
    assert run("render", "work.session.json", *film_of, *SMALL, "-o", "x.png") == 2
    assert "--sheet and --timeline cannot be combined; give only one of them" in capsys.readouterr().err
    assert not list(here.glob("x.*"))


def test_session_without_keys_cannot_be_filmed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved(here, replace(full_view(), timeline=Timeline()))
    assert run("render", "work.session.json", "--timeline", "-o", "a.gif") == 2
    assert "the timeline has no keys" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["view", "render", "export"])
def test_help_describes_the_default_behavior(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert [trace for trace in ("None", "False", "(default: )", "STR", "PATH") if trace in text] == []
    assert "--set NAME=S" in text


def look_of(folder: Path) -> GradeForm:
    """Write look.cube, a table of 5³ colors, and look.gdf, a grade of another scene with a residual."""
    table = torch.rand(125, 3, generator=torch.Generator().manual_seed(1))
    write_cube(folder / "table.cube", table, "table")
    other = random_gaussians(60)
    maps = torch.stack([identity_map(1), identity_map(1) * 0.25])
    residual = torch.stack([torch.zeros(60, 3), torch.full((60, 3), 0.2)])
    form = fit_grade(torch.tensor([0.0, 1.0]), 1, maps, residual, 1, torch.ones(60))
    save_gdf(folder / "look.gdf", edit_of(other, torch.arange(60), bake_grade(form, pack(other)), "look"))
    return lattice_form(read_cube(folder / "table.cube"))


def test_foreign_grade_applies_to_a_region_and_a_table_to_all(
    here: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bear().save(here)
    form = look_of(here)
    rows = torch.arange(50)
    np.save("rows.npy", rows.numpy())
    words = ("bear.ply", "table.cube", "look.gdf", "--region", "look=file:rows.npy", "--set", "table=0.5")
    assert run("export", *words, "-o", "edited.ply") == 0
    (left_out,) = caplog.messages
    assert left_out == (
        "look on file:rows.npy: without its residual, which fits only the scene it was trained on"
    )
    scene = bear().scene
    edited = load_ply("edited.ply")
    sh = scene.sh
    expected = torch.lerp(sh, map_colors(sh, form.table[1], 0), 0.5)
    expected[rows] = map_colors(expected[rows], identity_map(1) * 0.25, 1)
    assert torch.allclose(edited.sh, expected, atol=2e-5)
    assert torch.equal(edited.means, scene.means)
    assert run("render", *words, *SMALL, "-o", "x.png") == 0


def test_exported_color_table_has_the_strength_of_the_grade(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bear().save(here)
    form = look_of(here)
    assert run("export", "bear.ply", "table.cube", "-o", "same.cube") == 0
    torch.testing.assert_close(read_cube("same.cube"), form.table[1], atol=1e-6, rtol=0)
    assert run("export", "bear.ply", "table.cube", "--set", "table=0.25", "-o", "weak.cube") == 0
    weak = torch.lerp(form.table[0], form.table[1], 0.25)
    torch.testing.assert_close(read_cube("weak.cube"), weak, atol=1e-6, rtol=0)
    words = ("bear.ply", "look.gdf", "--region", "look=all")
    assert run("export", *words, "--gain", "look:color=0.5", "-o", "look.cube") == 0
    found = read_cube("look.cube")
    assert len(found) == 33**3
    torch.testing.assert_close(found, 0.625 * lattice_colors(33), atol=1e-6, rtol=0)
    assert "look 1" in capsys.readouterr().out
    for name in ("direct", "again"):
        edit = (*words[1:], "--gain", "look:color=0.5") if name == "direct" else ("look.cube",)
        assert run("export", "bear.ply", *edit, "-o", f"{name}.ply") == 0
    direct = load_ply("direct.ply")
    again = load_ply("again.ply")
    within = ((bear().scene.sh0 * C0).abs() < 0.4).all(dim=1)  # a color table covers only 0 to 1
    assert torch.allclose(direct.sh0[within], again.sh0[within], atol=0.05)
    assert int(within.sum()) > 500


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("look.gdf",), "its grade can be applied to any scene with --region look=all"),
        (("table.cube", "--region", "look=all"), "--region look: there is no edit of that name"),
        (("table.cube", "--region", "table"), "--region table has no NAME=REGION"),
        (("table.cube", "--region", "table=all", "--region", "table=all"), "names an edit twice"),
        (("table.cube", "--region", "table=masks:x"), "unknown region 'masks:x'"),
        (("table.cube", "--region", "table=sphere:99,99,99,1"), "holds no Gaussian"),
        (("scarf.gdf", "--region", "scarf=all"), "scarf is not a grade: its field is"),
        (("no.cube",), "no.cube does not exist"),
        (("bad.cube",), "bad.cube has a line 'hello'"),
    ],
)
@pytest.mark.parametrize("command", ["view", "render", "export"])
def test_grade_that_cannot_be_placed_is_refused(
    here: Path, command: str, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bear().save(here)
    look_of(here)
    (here / "bad.cube").write_text("hello\n")
    before = set(here.iterdir())
    out = {"render": ("-o", "x.png"), "export": ("-o", "x.ply")}.get(command, ())
    assert run(command, "bear.ply", *words, *out) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]
    assert set(here.iterdir()) == before


@pytest.mark.parametrize("words", [("table.cube", "look.gdf", "--region", "look=all"), ("scarf.gdf",), ()])
def test_color_table_export_needs_exactly_one_grade(
    here: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    bear().save(here)
    look_of(here)
    assert run("export", "bear.ply", *words, "-o", "x.cube") == 2
    assert "x.cube holds the color map of one grade; give one edit" in capsys.readouterr().err
    assert not (here / "x.cube").exists()


def test_session_remembers_the_region_of_a_grade(here: Path) -> None:
    scene, scarf, _ = bear().save(here)
    look_of(here)
    (here / "edits").mkdir()
    region = from_mask("a third", torch.arange(len(bear().scene)) % 3 == 0)

    def place(_: Gaussians, index: int, name: str) -> Region | None:
        return region if index else None

    opened = document.load(scene, [scarf, here / "look.gdf", here / "table.cube"], place)
    view = ViewState(layers=tuple(LayerState(i, gdf.name, 0.5) for i, gdf in enumerate(opened.gdfs)))
    session.save(here / "work.session.json", WindowSession(opened, view))
    again = session.open_session(here / "work.session.json").document
    assert [gdf.applied for gdf in again.gdfs] == [False, True, True]
    for was, now in zip(opened.gdfs, again.gdfs, strict=True):
        assert (now.name, now.region.name) == (was.name, was.region.name)
        assert torch.equal(now.region.members, was.region.members)
        assert torch.equal(now.field.offsets(0.5), was.field.offsets(0.5))
    edits = json.loads((here / "work.session.json").read_text())["edits"]
    assert [set(edit) - {"file", "sha256"} for edit in edits] == [
        set(),
        {"region", "members"},
        {"region", "members"},
    ]
    assert run("export", "work.session.json", "-o", "edited.ply") == 0
    assert run("export", "work.session.json", "--region", "look=all", "-o", "edited.ply") == 2
