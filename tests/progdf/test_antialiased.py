"""Tests of scenes trained with Mip-Splatting's 2D filter: the flag is kept, and every renderer applies it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import moderngl
import pytest
import torch

from progdf.__main__ import main
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import load_ply, load_ply_with_report, save_ply
from progdf.formats.ply_file import read_header
from progdf.gaussians import Gaussians, pack
from progdf.rasterize import alpha_weights, render
from progdf.region import Region
from tests.helpers.drawn import EVERY
from tests.helpers.ply_files import scene_of, table_of, write
from tests.helpers.scenes import front_camera
from tests.helpers.stacks import Stack, bear_stack
from trainer.views.crops import crop_scene
from trainer.views.view import make_view
from viewer.camera.view_camera import first_camera, to_camera
from viewer.render.engine import ViewEngine
from viewer.state.view_state import LayerState, ViewState

WHITE = torch.ones(3)
SIZE = (96, 72)


@pytest.fixture(scope="module")
def stack() -> Stack:
    bear = bear_stack(1500)
    return replace(bear, demo=replace(bear.demo, gaussians=replace(bear.scene, antialiased=True)))


def with_comment(path: Path, comment: bytes) -> Path:
    save_ply(path, scene_of(0))
    path.write_bytes(path.read_bytes().replace(b"\nelement", b"\ncomment " + comment + b"\nelement", 1))
    return path


@pytest.mark.parametrize(
    ("comment", "expected"),
    [
        (b"SplatRenderMode: mip", True),
        (b"  splatrendermode:  MIP ", True),
        (b"antialiased 1", True),
        (b"SplatRenderMode: default", False),
        (b"antialiased 0", False),
        (b"antialiased 1\ncomment antialiased 0", False),
        (b"not antialiased 1", False),
        (b"SplatRenderMode: \x1b[2Jmip\xff\xfe", False),
    ],
)
def test_comment_marks_a_scene_as_antialiased(tmp_path: Path, comment: bytes, expected: bool) -> None:
    scene, report = load_ply_with_report(with_comment(tmp_path / "scene.ply", comment))
    assert scene.antialiased is report.antialiased is expected


def test_info_reports_antialiased_and_never_prints_a_comment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_comment(tmp_path / "scene.ply", b"antialiased 1\ncomment \x1b]0;pwned\x07")
    assert main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "antialiased: trained and rendered with Mip-Splatting's 2D filter" in output
    assert "\x1b" not in output
    assert "pwned" not in output


def test_saved_scene_keeps_antialiased(tmp_path: Path) -> None:
    save_ply(tmp_path / "mip.ply", replace(scene_of(1), antialiased=True))
    assert read_header(tmp_path / "mip.ply").antialiased
    again = load_ply(tmp_path / "mip.ply")
    assert again.antialiased
    save_ply(tmp_path / "plain.ply", replace(again, antialiased=False))
    assert b"comment" not in (tmp_path / "plain.ply").read_bytes()[:400]


def test_repaired_scene_keeps_antialiased(tmp_path: Path) -> None:
    columns = table_of(scene_of(0))
    columns["opacity"][3] = torch.inf
    path = write(tmp_path / "inf.ply", columns)
    path.write_bytes(path.read_bytes().replace(b"\nelement", b"\ncomment antialiased 1\nelement", 1))
    scene, report = load_ply_with_report(path)
    assert report.opaque == 1
    assert scene.antialiased


def test_row_selection_conversion_and_edits_keep_antialiased(stack: Stack) -> None:
    scene = stack.scene
    rows = torch.arange(5)
    assert scene[rows].antialiased
    assert scene.to(dtype=torch.float64).antialiased
    assert scene.replace_rows(rows, pack(scene[rows])).antialiased
    assert compose_layers(scene, [Layer(stack.gdfs[0], 0.5)]).antialiased


def test_exported_edit_keeps_antialiased(stack: Stack, tmp_path: Path) -> None:
    scene, edit, *_ = stack.save(tmp_path)
    assert main(["export", str(scene), str(edit), "--out", str(tmp_path / "edited.ply")]) == 0
    assert load_ply(tmp_path / "edited.ply").antialiased


@pytest.mark.parametrize("engine", EVERY)
def test_alpha_weights_use_the_filter(stack: Stack, engine: str) -> None:
    """Compare Σ w over all Gaussians with the share of a pixel that they cover."""
    scene = stack.scene
    camera = to_camera(first_camera(stack.scene, stack.demo.cameras), 40, 30)
    white = replace(scene, sh0=torch.full_like(scene.sh0, 1.7724539), shN=scene.shN[:, :0])
    covered = render(white, camera, (0.0, 0.0, 0.0)).image[..., 0].sum()
    weights = alpha_weights(scene, camera, torch.ones(30, 40), engine=engine)[:, 2].sum()
    torch.testing.assert_close(weights, covered, rtol=1e-4, atol=0.0)  # sums of float32


def test_training_views_use_the_filter(stack: Stack) -> None:
    scene = stack.scene
    camera = to_camera(first_camera(stack.scene, stack.demo.cameras), *SIZE)
    region = Region("all", torch.arange(len(scene)), torch.ones(len(scene)))
    expected = render(scene, camera, WHITE).image.clamp(0.0, 1.0)
    view = make_view(scene, region, camera, WHITE)
    torch.testing.assert_close(view.image, expected, rtol=0.0, atol=2e-6)
    for still in (False, True):
        crop = crop_scene(scene, region.members, camera, (0, 0, *SIZE), WHITE, still)
        image = crop.render(pack(scene))
        torch.testing.assert_close(image, expected, rtol=0.0, atol=2e-6)


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["gl", "cpu"])
def test_viewer_draws_antialiased_like_the_rasterizer(ctx: moderngl.Context, stack: Stack, draw: str) -> None:
    view = ViewState(
        camera=first_camera(stack.scene, stack.demo.cameras), layers=(LayerState(0, "scarf", 0.7),)
    )
    engine = ViewEngine(ctx, stack.scene, stack.gdfs, draw)  # type: ignore[arg-type]
    try:
        found = torch.from_numpy(engine.image(view, SIZE))
    finally:
        engine.release()
    edited = compose_layers(stack.scene, [Layer(stack.gdfs[0], 0.7)])
    expected = render(edited, to_camera(view.camera, *SIZE), view.background).image
    fat = render(replace(edited, antialiased=False), to_camera(view.camera, *SIZE), view.background).image
    assert float((found - expected).abs().max()) < 1 / 255  # boundary at the 1/255 cut, as in test_gl_parity
    assert float((found - fat).abs().max()) > 0.1


def test_single_point_is_drawn_with_the_stated_share_of_opacity() -> None:
    """A point has det0 / det = 0, so the square root of the floor 0.005 of its opacity remains."""
    camera = front_camera(9, 9)
    point = Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), -20.0),
        logit_opacities=torch.zeros(1),
        sh0=torch.full((1, 3), -1.7724539),
        shN=torch.zeros(1, 0, 3),
        antialiased=True,
    )
    ink = [
        float((1 - render(replace(point, antialiased=a), camera, WHITE).image).max()) for a in (True, False)
    ]
    torch.testing.assert_close(ink[0] / ink[1], 0.005**0.5, rtol=1e-3, atol=0.0)
