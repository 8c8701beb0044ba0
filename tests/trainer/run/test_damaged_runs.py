"""`progdf fit` and the ablation on damaged or malicious run folders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.trajectory import load_trajectory, save_trajectory
from tests.helpers.refused import refusal
from tests.helpers.trained import quick_options, train, write_bear
from trainer.run.record import render_edited_views, reopen_run

Change = Callable[[dict[str, Any], dict[str, Tensor]], object]

CHANGES: dict[str, Change] = {
    "no losses": lambda about, _: about.pop("losses"),
    "losses of one number": lambda about, _: about.update(losses={"step": 1.0, "left": [1.0]}),
    "losses that do not fit": lambda about, _: about["losses"]["left"].append(1.0),
    "no objective": lambda about, _: about.pop("objective"),
    "no name": lambda about, _: about["plan"].pop("name"),
    "a name that leads elsewhere": lambda about, _: about["plan"].update(name="../../elsewhere"),
    "no editor": lambda about, _: about["plan"].pop("editor"),
    "an option of another type": lambda about, _: about["plan"]["field"].update(target_psnr=[1]),
    "an unknown kind": lambda about, _: about.update(kind="else"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a small bear; return the run folder."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder, 400)
    options = quick_options(folder, views=4, image_size=48, steps=16, stages=2)
    train(options, quiet=True)
    return options.out


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_trajectory_metadata_is_checked_before_use(change: Change, run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "trajectory.safetensors"
    trajectory, extra, about = load_trajectory(path)
    about = json.loads(json.dumps(about))
    save_trajectory(path, trajectory, extra, about)
    reopen_run(tmp_path / "run")
    change(about, extra)
    save_trajectory(path, trajectory, extra, about)
    assert "is damaged" in refusal(lambda path: reopen_run(path.parent), path)


def change_cameras(root: Path, change: Callable[[list[dict[str, Any]]], object]) -> None:
    path = root / "cameras.json"
    content = json.loads(path.read_text())
    change(content["cameras"])
    path.write_text(json.dumps(content))


CAMERA_CHANGES: dict[str, tuple[Callable[[list[dict[str, Any]]], object], str]] = {
    "another size": (lambda cameras: cameras[0].update(width=49), "with 49x48 pixels, .*has 48x48"),
    "a huge size": (lambda cameras: cameras[0].update(height=900_000), "with 48x900000 pixels"),
    "one less": (lambda cameras: cameras.pop(), "lacks the camera of the run's view"),
    "one twice": (lambda cameras: cameras.append(cameras[0]), "has 2 cameras named"),
    "another name": (lambda cameras: cameras[0].update(name="other"), "lacks the camera of the run's view"),
    "a name that leads elsewhere": (lambda cameras: cameras[0].update(name="../x"), "not a valid view name"),
}


@pytest.mark.parametrize("name", CAMERA_CHANGES)
def test_cameras_of_another_run_are_refused_by_file_name(name: str, run: Path, tmp_path: Path) -> None:
    root = tmp_path / "run"
    shutil.copytree(run, root)
    render_edited_views(reopen_run(root))
    change, message = CAMERA_CHANGES[name]
    change_cameras(root, change)
    with pytest.raises(ProgdfError, match=f"{root}/cameras.json .*{message}") as caught:
        render_edited_views(reopen_run(root))
    assert "\n" not in str(caught.value)


def test_edited_view_of_another_size_is_refused_by_file_name(run: Path, tmp_path: Path) -> None:
    root = tmp_path / "run"
    shutil.copytree(run, root)
    for path in sorted((root / "views" / "edited").glob("*.png")):
        Image.new("RGB", (40, 48)).save(path)
    with pytest.raises(ProgdfError, match=r"views/edited/.*\.png is 40x48 pixels, its view 48x48; train"):
        render_edited_views(reopen_run(root))
