"""instruct:"…" end to end with real diffusers pipelines whose networks are tiny and random."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from tests.helpers.tiny_pipelines import tiny_flux2_klein, tiny_flux_kontext, tiny_instruct_pix2pix
from tests.helpers.trained import quick_options, small, train, write_bear
from trainer.editors import make_editor
from trainer.editors.instruct import ADAPTERS, InstructEditor
from trainer.options import EditorOptions

BATMAN = 'instruct:"turn him into Batman"'


@pytest.fixture(scope="module")
def diffusers() -> Iterator[None]:
    for package in ("diffusers", "transformers", "accelerate"):
        pytest.importorskip(package, reason="pip install progdf-studio[diffusion]")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # networks this small only wait for each other on more
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def pix2pix(diffusers: None, tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tiny_instruct_pix2pix(tmp_path_factory.mktemp("pix2pix")))


def settings_of(model: str, **more: object) -> EditorOptions:
    return replace(EditorOptions(BATMAN, model, edit_size=64, edit_steps=2), **more)  # type: ignore[arg-type]


def editor_of(settings: EditorOptions, spec: str = BATMAN) -> InstructEditor:
    case = small()
    editor = make_editor(replace(settings, editor=spec), case.scene, case.region, case.views)
    assert isinstance(editor, InstructEditor)
    return editor


@pytest.mark.parametrize("make", [tiny_instruct_pix2pix, tiny_flux_kontext, tiny_flux2_klein])
def test_a_saved_pipeline_edits_a_view_at_its_own_size(
    diffusers: None, make: Callable[[Path], Path], tmp_path: Path
) -> None:
    view = small(image_size=66).views[0]
    editor = editor_of(settings_of(str(make(tmp_path))))
    edited = editor.edit(view, 1.0)
    assert edited.shape == view.image.shape
    assert 0.0 <= float(edited.min()) <= float(edited.max()) <= 1.0
    assert float((edited - view.image).abs().mean()) > 0.02
    assert torch.equal(editor.edit(view, 0.0), view.image)


def test_the_same_seed_gives_the_same_picture_and_another_another(pix2pix: str) -> None:
    view = small().views[0]
    first, again, other = (editor_of(settings_of(pix2pix, seed=s)).edit(view, 1.0) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert float((first - other).abs().mean()) > 0.01


@pytest.mark.parametrize(
    "change", [{"guidance": "2"}, {"guidance": "7.5,4"}, {"edit_steps": 3}, {"edit_size": 96}]
)
def test_every_option_reaches_the_pipeline(pix2pix: str, change: dict[str, object]) -> None:
    view = small().views[0]
    plain, changed = (editor_of(settings_of(pix2pix, **more)).edit(view, 1.0) for more in ({}, change))
    assert not torch.equal(plain, changed)


def test_the_sentence_reaches_the_pipeline_without_its_quotes(pix2pix: str) -> None:
    view = small().views[0]
    quoted = editor_of(settings_of(pix2pix)).edit(view, 1.0)
    plain = editor_of(settings_of(pix2pix), "instruct:turn him into Batman").edit(view, 1.0)
    other = editor_of(settings_of(pix2pix), "instruct:make it snow").edit(view, 1.0)
    assert torch.equal(quoted, plain)
    assert not torch.equal(quoted, other)


def test_one_target_by_default_and_strengths_by_guidance_on_request(pix2pix: str) -> None:
    view = small().views[0]
    assert editor_of(settings_of(pix2pix)).stages == (1.0,)
    with pytest.raises(ValueError, match=r"not 0\.5"):
        editor_of(settings_of(pix2pix)).edit(view, 0.5)
    graded = editor_of(settings_of(pix2pix, graded=True))
    assert graded.stages == ()
    half = editor_of(settings_of(pix2pix, guidance="4.25")).edit(view, 1.0)  # half way from 1 to 7.5
    assert torch.equal(graded.edit(view, 0.5), half)


def test_a_view_is_edited_once_for_all_runs(pix2pix: str, tmp_path: Path) -> None:
    view = small().views[0]
    settings = settings_of(pix2pix, cache=tmp_path)
    first = editor_of(settings).edit(view, 1.0)
    note = json.loads((tmp_path / f"{view.camera.name}.json").read_text())
    assert note["editor"]["instruct"] == "turn him into Batman"
    again = editor_of(settings)

    def fails(picture: torch.Tensor, guidance: float, seed: int | None) -> torch.Tensor:
        raise AssertionError("it was kept")

    assert torch.equal(replace(again, ask=fails).edit(view, 1.0), first)
    with pytest.raises(AssertionError, match="kept"):
        replace(editor_of(replace(settings, seed=1)), ask=fails).edit(view, 1.0)


@pytest.mark.parametrize("name", ADAPTERS)
def test_the_table_s_words_are_keywords_of_the_pipelines(diffusers: None, name: str) -> None:
    import diffusers as library

    adapter = ADAPTERS[name]
    picture = Image.new("RGB", (64, 32))
    asked = adapter.arguments("x", picture, adapter.steps, adapter.guidance, adapter.image_guidance)
    known = inspect.signature(getattr(library, name).__call__).parameters
    assert set(asked) | {"generator"} <= set(known)
    assert None not in asked.values()


@pytest.mark.parametrize("model", ["timbrooks/instruct-pix2pix", "someone/no-such-model"])
def test_missing_weights_are_one_line_that_names_what_to_download(
    diffusers: None, model: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ProgdfError, match=f"hf download {model}") as told:
        editor_of(EditorOptions(BATMAN, model))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("damage", ["no model_index.json", "no weights", "cut weights", "another pipeline"])
def test_a_folder_that_is_no_whole_pipeline_is_one_line(pix2pix: str, damage: str, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "model"
    shutil.copytree(pix2pix, folder)
    weights = folder / "unet" / "diffusion_pytorch_model.safetensors"
    if damage == "no model_index.json":
        (folder / "model_index.json").unlink()
    elif damage == "no weights":
        weights.unlink()
    elif damage == "cut weights":
        weights.write_bytes(weights.read_bytes()[:1000])
    else:
        index = json.loads((folder / "model_index.json").read_text())
        index["_class_name"] = "StableDiffusionPipeline"
        (folder / "model_index.json").write_text(json.dumps(index))
    view = small().views[0]
    with pytest.raises(ProgdfError, match="; ") as told:
        editor_of(settings_of(str(folder))).edit(view, 1.0)
    assert "\n" not in str(told.value)


def test_image_guidance_for_a_model_without_it_is_one_line(diffusers: None, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not support guidance of the picture; "):
        editor_of(settings_of(str(tiny_flux_kontext(tmp_path)), guidance="2.5,1.5"))


def test_an_empty_sentence_is_one_line() -> None:
    with pytest.raises(ProgdfError, match="needs an instruction; "):
        editor_of(EditorOptions(""), 'instruct:""')


def test_without_the_packages_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(ProgdfError, match=r"pip install progdf-studio\[diffusion\]"):
        editor_of(EditorOptions(""))


def test_a_run_is_trained_on_what_a_pipeline_makes_of_its_views(pix2pix: str, tmp_path: Path) -> None:
    write_bear(tmp_path, 900)
    options = quick_options(
        tmp_path,
        editor=BATMAN,
        model=pix2pix,
        edit_steps=1,
        edit_size=64,
        steps=24,
        stages=1,
        views=5,
        image_size=64,
    )
    result = train(options, quiet=True)
    painted = result.folder.root / "views" / "painted"
    counts = {place.name: len(list(place.glob("*.png"))) for place in painted.iterdir() if place.is_dir()}
    assert counts == {"anchor": 1, "sweep": 4, "round_1": 5, "round_2": 5}
    assert result.report["trajectory"]["stages"] == [1.0]
    assert "the edited views" in result.folder.log.read_text(encoding="utf-8")
    assert {"psnr_best", "unexplained", "contrast", "agree"} <= set(result.report["agreement"])
    for path in painted.glob("*/*.png"):
        original = Image.open(result.folder.view("original", path.stem))
        assert Image.open(path).size == original.size
