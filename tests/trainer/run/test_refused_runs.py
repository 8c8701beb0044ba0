"""Refused trainings: one line, status 2 and no files, wherever in the run the fault is found."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.io.atomic import LOCK
from progdf.io.cameras import save_cameras
from tests.helpers.scenes import orbit_camera
from tests.helpers.trained import quick_options, train, write_bear
from trainer.run import run as training
from trainer.store.run_folder import RunFolder, lock_folder

GAUSSIANS = 400
OUT = Path("runs/new")
GOOD = {"--region": "labels:labels.npy:5", "--editor": "recolor:#3060d0", "--cameras": ""}
SMALL = ("--views", "4", "--image-size", "32", "--steps", "8", "--stages", "1", "--threads", "1")

PYTHON = shlex.quote(sys.executable)
COPY = f"command:{PYTHON} copy.py {{input}} {{output}}"
FAIL = f"command:{PYTHON} fail.py {{input}} {{output}}"
HALF = f"command:{PYTHON} half.py {{input}} {{output}}"

REFUSALS = {
    "label of no Gaussian": ({"--region": "labels:labels.npy:77"}, "no Gaussian with label 77"),
    "labels of another scene": ({"--region": "labels:few.npy:1"}, "few.npy"),
    "box without Gaussians": ({"--region": "box:50,50,50,51,51,51"}, "holds no Gaussian"),
    "ball without Gaussians": ({"--region": "sphere:90,0,0,0.1"}, "holds no Gaussian"),
    "rows beyond the scene": ({"--region": "file:beyond.npy"}, "beyond.npy"),
    "unknown argument": ({"--editor": "recolor:#3060d0,way=hue"}, "'way=hue' is not an option"),
    "unknown style": ({"--editor": "style:99"}, "unknown style"),
    "cameras of another frame": ({"--cameras": "away.json"}, "is not in the frame"),
    "cameras that see nothing": ({"--cameras": "away.json --cameras-anyway"}, "none of the 2 cameras sees"),
    "no edited views": ({"--editor": "folder:empty"}, "empty has no picture"),
    "views that are not edited": ({"--editor": "folder:other"}, "other has no picture"),
    "edited views of no shape": ({"--editor": "folder:wide"}, "wide"),
    "picture without a camera": ({"--editor": "pictures:plain.png"}, "plain.png has no stored camera"),
    "decal without a camera": ({"--editor": "decal:plain.png"}, "decal: needs --camera"),
    "transparent decal": ({"--editor": "decal:clear.png"}, "fully transparent"),
    "program that copies": ({"--editor": COPY}, "does not change the view"),
    "program that fails": ({"--editor": FAIL}, "it is broken"),
    "server that is not there": (
        {"--editor": "api:red", "--cameras": "--model m --api-url http://127.0.0.1:9/v1"},
        "127.0.0.1:9 cannot be reached",
    ),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a scene and with everything that `REFUSALS` name."""
    folder = tmp_path_factory.mktemp("refused")
    write_bear(folder, GAUSSIANS)
    np.save(folder / "few.npy", np.ones(4, np.uint8))
    np.save(folder / "beyond.npy", np.array([GAUSSIANS + 1]))
    behind = torch.eye(4)
    behind[2, 3] = -50.0
    camera = replace(orbit_camera(), viewmat=behind)
    origin = torch.zeros(3, dtype=torch.float64)
    save_cameras(folder / "away.json", [replace(camera, name=name) for name in "ab"], origin)
    for name in ("empty", "other", "wide"):
        (folder / name).mkdir()
    Image.new("RGB", (32, 32)).save(folder / "other" / "view.png")
    for index in range(6):
        for view in ("orbit", "between"):
            Image.new("RGB", (320, 8)).save(folder / "wide" / f"{view}_{index:03d}.png")
    Image.new("RGB", (32, 32)).save(folder / "plain.png")
    Image.new("RGBA", (32, 32)).save(folder / "clear.png")
    (folder / "copy.py").write_text("import shutil, sys\nshutil.copy(*sys.argv[1:])\n")
    (folder / "fail.py").write_text("print('loading the model')\nraise SystemExit('it is broken')\n")
    (folder / "half.py").write_text(
        "import sys\nfrom pathlib import Path\nfrom PIL import Image\n"
        "with Path('calls').open('a') as calls:\n    calls.write('.')\n"
        "if len(Path('calls').read_text()) > 3:\n    raise SystemExit('it is broken')\n"
        "Image.open(sys.argv[1]).point(lambda level: level // 2).save(sys.argv[2])\n"
    )
    return folder


@pytest.fixture(autouse=True)
def here(files: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Enter the folder; check that the test leaves its files as they were, except for those of runs."""
    monkeypatch.chdir(files)
    yield files
    for name in ("runs", "calls"):
        assert not Path(name).exists(), "removed by the run or by the test"


def refused(capsys: pytest.CaptureFixture[str], **changes: str) -> str:
    """Return the last line of a training that is refused."""
    options = {**GOOD, **changes}
    more = options.pop("--cameras")
    if more.startswith("away"):
        more = f"--cameras {more}"
    words = [word for option in options.items() for word in option]
    assert main(["train", "scene.ply", "--out", str(OUT), *words, *SMALL, *more.split()]) == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("refusal", REFUSALS)
def test_refused_run_leaves_no_files(refusal: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes, message = REFUSALS[refusal]
    if "api:" in changes.get("--editor", ""):
        pytest.importorskip("openai")
    before = sorted(here.rglob("*"))
    line = refused(capsys, **changes)
    assert line.startswith("progdf: ")
    assert message in line
    assert sorted(here.rglob("*")) == before


def test_refused_run_keeps_an_empty_folder_and_foreign_files(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    OUT.mkdir(parents=True)
    refused(capsys, **{"--editor": "folder:empty"})
    assert list(Path("runs").rglob("*")) == [OUT]
    note = OUT / "views" / "note.txt"
    views = training._render_originals

    def add_note(*given: object) -> object:
        made = views(*given)  # type: ignore[arg-type]
        note.write_text("mine")
        return made

    monkeypatch.setattr(training, "_render_originals", add_note)
    refused(capsys, **{"--editor": "folder:empty"})
    assert [path for path in Path("runs").rglob("*") if path.is_file()] == [note]
    note.unlink()
    note.parent.rmdir()
    OUT.rmdir()
    OUT.parent.rmdir()


def test_paintings_of_a_program_that_fails_later_are_kept(capsys: pytest.CaptureFixture[str]) -> None:
    assert "it is broken" in refused(capsys, **{"--editor": HALF})
    assert list((OUT / "views" / "painted").rglob("*.png"))
    assert RunFolder(OUT).log.is_file()
    _remove_all(OUT.parent)
    Path("calls").unlink()


def test_refusal_beside_a_running_training_leaves_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.store.run_folder._LOCK_WAIT_S", 0.0)
    write_bear(tmp_path, GAUSSIANS)
    folder = RunFolder(tmp_path / "run")
    folder.root.mkdir()
    with lock_folder(folder), pytest.raises(ProgdfError, match="being trained by another process"):
        train(quick_options(tmp_path))
    assert [path.name for path in folder.root.iterdir()] == [LOCK]


def test_refused_repetition_keeps_the_finished_run(tmp_path: Path) -> None:
    write_bear(tmp_path, GAUSSIANS)
    options = quick_options(tmp_path, part="scarf", views=4, image_size=32, steps=8, stages=1, report="none")
    run = train(options).folder
    before = {path.name for path in run.root.iterdir()}
    with pytest.raises(ProgdfError, match="another editor"):
        train(replace(options, editor=replace(options.editor, editor="folder:nowhere")))
    assert {path.name for path in run.root.iterdir()} == before


def _remove_all(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    folder.rmdir()
