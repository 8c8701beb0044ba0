"""`progdf demo`: files that load again, pictures of every slider, and the command that opens them."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import trainer.run.resume
import trainer.run.run
from progdf import demo_scenes as scenes
from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.field import fit_keyframes
from progdf.formats.ply import load_ply
from progdf.gaussians import pack
from progdf.gdf.file import Gdf, fingerprint, save_gdf
from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import find_picture_camera
from progdf.region import from_labels
from progdf.scene.regions import parse_region
from tests.helpers import demo_scenes
from trainer.evaluate.suite import analytic_edits
from trainer.options import TrainOptions
from trainer.resolve import resolve
from trainer.run import demo

SIZE = 1500


@pytest.fixture(autouse=True)
def _made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    shows = demo_scenes.bear, demo_scenes.room
    for (name, show), make in zip(demo.SHOWS.items(), shows, strict=True):
        monkeypatch.setitem(demo.SHOWS, name, replace(show, make=make))


@pytest.fixture
def bear() -> scenes.DemoScene:
    return demo_scenes.bear(SIZE)


def _edit(folder: Path, scene: scenes.DemoScene, edit: demo.DemoEdit) -> Gdf:
    """Return the edit without training; a formula recolors each Gaussian."""
    gaussians = load_ply(folder / "scene.ply")
    ids = [scene.label_names.index(part) for part in edit.parts or ("head",)]
    region = from_labels(edit.name, scene.labels, ids)
    formula = analytic_edits.recolor_edit(torch.tensor([0.1, 0.3, 0.9]))
    strengths = torch.tensor([0.0, 0.5, 1.0])
    rows = torch.stack(
        [pack(formula.apply(gaussians, region.members, float(s))[region.members]) for s in strengths]
    )
    return Gdf(
        edit.name, region, fit_keyframes(strengths, rows - rows[0], 3), fingerprint(gaussians), edit.editor
    )


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch, bear: scenes.DemoScene) -> list[Sequence[str]]:
    """Replace training by a formula; return the list of commands that would open the window."""

    def train(options: TrainOptions) -> None:
        plan = resolve(options)
        out = options.out
        edit = next(edit for edit in demo.SHOWS["bear"].edits if edit.name == plan.name == out.name)
        if edit.paint is None:
            region = parse_region(plan.region.region, load_ply(plan.scene), edit.name)
            assert torch.equal(region.members, bear.members(*edit.parts))
        else:
            (picture,) = plan.views.pictures
            assert plan.region.region == "changed"
            assert plan.editor.carry_on == "always"
            assert torch.equal(find_picture_camera(picture).viewmat, bear.cameras[2].viewmat)
        out.mkdir()
        save_gdf(out / f"{edit.name}.gdf", _edit(out.parent, bear, edit))

    opened: list[Sequence[str]] = []

    def run(command: Sequence[str], check: bool) -> SimpleNamespace:
        opened.append(command)
        return SimpleNamespace(returncode=3)

    monkeypatch.setattr(trainer.run.run, "train", train)
    monkeypatch.setattr(subprocess, "run", run)
    return opened


@pytest.mark.parametrize("name", list(demo.SHOWS))
def test_second_demo_edit_is_apart_from_the_first_and_overlaps_the_third(name: str) -> None:
    scene = demo.SHOWS[name].make(2000, 0)
    first, second, third = (set(scene.members(*edit.parts).tolist()) for edit in demo.SHOWS[name].edits[:3])
    assert not first & second
    assert second & third


def test_scene_file_loads_to_the_same_scene(tmp_path: Path, bear: scenes.DemoScene) -> None:
    demo.write_scene(tmp_path / "new", bear)
    assert torch.equal(load_ply(tmp_path / "new" / "scene.ply").means, bear.gaussians.means)
    assert np.array_equal(np.load(tmp_path / "new" / "labels.npy"), bear.labels.numpy())
    cameras = load_cameras(tmp_path / "new" / "cameras.json")
    assert [camera.name for camera in cameras] == [camera.name for camera in bear.cameras]


def test_pictures_show_the_original_at_zero_and_the_edit_at_one(
    tmp_path: Path, bear: scenes.DemoScene
) -> None:
    demo.write_scene(tmp_path, bear)
    gdfs = {edit.name: _edit(tmp_path, bear, edit) for edit in demo.SHOWS["bear"].edits}
    sliders, hero = (np.asarray(Image.open(p)) for p in demo.write_pictures(tmp_path, bear, gdfs, 2))
    assert sliders.shape[1] > 5 * 300
    assert sliders.shape[0] > 4 * 300
    assert hero.shape[1] == 5 * hero.shape[0]
    strengths = np.split(hero.astype(int), 5, axis=1)
    changed = [float((np.abs(picture - strengths[0]).max(axis=2) > 20).mean()) for picture in strengths]
    assert changed[0] == 0
    assert 0.2 < changed[4] < 0.65  # the bear and the grass, neither stone nor sky


def test_demo_ends_with_the_command_that_opens_its_edits(
    tmp_path: Path,
    commands: list[Sequence[str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    out = tmp_path / "demo"
    assert demo.main(["--size", str(SIZE), "--out", str(out)]) == 0
    assert commands == []
    last = capsys.readouterr().out.strip().splitlines()[-1]
    edits = " ".join(f"{out}/{name}/{name}.gdf" for name in ("scarf", "gold", "frost", "panda"))
    assert last.strip() == f"progdf view {out}/scene.ply {edits} --background '#82a3c2'"


def test_window_opens_in_a_separate_process_if_there_is_a_display(
    tmp_path: Path, commands: list[Sequence[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":99")
    assert demo.main(["--size", str(SIZE), "--out", str(tmp_path / "demo")]) == 3
    assert commands[0][1:5] == ["-P", "-m", "progdf", "view"]
    assert demo.main(["--size", str(SIZE), "--out", str(tmp_path / "other"), "--no-window"]) == 0
    assert len(commands) == 1


@pytest.mark.parametrize(
    ("option", "number"),
    [("--seed", "-1"), ("--seed", "9" * 20), ("--threads", "-1"), ("--size", "9" * 12), ("--size", "9" * 20)],
)
def test_invalid_numbers_are_refused_and_write_nothing(
    option: str, number: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = () if option == "--size" else ("--size", str(SIZE))
    assert main(["demo", *size, "--out", str(tmp_path / "demo"), option, number]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith(f"progdf: {option} must be ")
    assert error.endswith(f"got {number}")
    assert not (tmp_path / "demo").exists()


def test_too_few_gaussians_are_refused_and_write_nothing(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="too few for a bear"):
        demo.main(["--size", "10", "--out", str(tmp_path / "demo")])
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(
    ("out", "told"),
    [
        ("/proc/demo", "/proc/demo cannot be written ("),
        ("taken", "taken is a file; give the name of a folder"),
        ("taken/demo", "taken/demo cannot be written ("),
    ],
)
def test_unusable_output_folder_is_a_one_line_error(
    out: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").touch()
    assert main(["demo", "--size", str(SIZE), "--out", out]) == 2
    assert capsys.readouterr().err.startswith(f"progdf: {told}")
    assert list(tmp_path.iterdir()) == [tmp_path / "taken"]


def test_stopped_demo_resumes_and_otherwise_starts_over(
    tmp_path: Path, bear: scenes.DemoScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, bool]] = []

    def train(options: TrainOptions) -> None:
        asked.append((options.out.name, options.resume))
        if len(asked) == 2:
            raise KeyboardInterrupt("--resume")

    here = {"scarf": "finished", "gold": "stopped", "frost": "nothing", "panda": "nothing"}
    monkeypatch.setattr(trainer.run.run, "train", train)
    monkeypatch.setattr(trainer.run.resume, "find_run", lambda options: here[options.out.name])
    arguments = ["--size", str(SIZE), "--out", str(tmp_path / "demo"), "--no-window"]
    with pytest.raises(KeyboardInterrupt, match="repeat the command to continue"):
        demo.main(arguments)
    assert asked == [("scarf", True), ("gold", True)]
    here["gold"] = "nothing"
    monkeypatch.setattr(
        trainer.run.run, "train", lambda options: asked.append((options.out.name, options.resume))
    )
    with pytest.raises(ProgdfError):  # this training writes nothing
        demo.main(arguments)
    assert asked[2:] == [("scarf", False), ("gold", False), ("frost", False), ("panda", False)]
