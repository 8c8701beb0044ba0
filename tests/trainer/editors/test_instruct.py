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
from trainer.editors.adapters import ADAPTERS
from trainer.editors.instruct import InstructEditor
from trainer.editors.mixed_steps import MixedSteps
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


def test_any_strength_can_be_asked_for_and_the_change_grows_with_it(pix2pix: str) -> None:
    view = small().views[0]
    editor = editor_of(settings_of(pix2pix, edit_steps=4))
    assert editor.stages == ()
    shares = [float((editor.edit(view, s) - view.image).norm()) for s in (0.25, 0.5, 0.75, 1.0)]
    assert shares == sorted(shares)
    assert shares[0] > 0
    assert editor.calls((0.25, 0.5, 0.75, 1.0)) == 1 + 3 + 4 + 4


def test_a_view_is_edited_once_for_all_runs(pix2pix: str, tmp_path: Path) -> None:
    view = small().views[0]
    settings = settings_of(pix2pix, cache=tmp_path)
    first = editor_of(settings).edit(view, 1.0)
    note = json.loads((tmp_path / f"{view.camera.name}.json").read_text())
    assert note["editor"]["instruct"] == "turn him into Batman"

    def fails() -> MixedSteps:
        raise AssertionError("it was kept")

    assert torch.equal(replace(editor_of(settings), load=fails).edit(view, 1.0), first)
    for other in (editor_of(replace(settings, seed=1)), editor_of(settings)):
        with pytest.raises(AssertionError, match="kept"):
            replace(other, load=fails).edit(view, 0.5)


def test_a_model_gets_the_region_with_a_margin_at_its_own_size_and_its_answer_is_kept(
    pix2pix: str, tmp_path: Path
) -> None:
    view = small(image_size=200).views[0]
    editor = editor_of(settings_of(pix2pix, edit_size=128, cache=tmp_path))
    (x0, y0, x1, y1), camera = editor.frame(view)
    shown = (view.mask > 0.5).nonzero()
    inside = (shown[:, 0] >= y0) & (shown[:, 0] < y1) & (shown[:, 1] >= x0) & (shown[:, 1] < x1)
    assert bool(inside.all())
    assert (x1 - x0) * (y1 - y0) < 0.8 * 200 * 200
    assert camera.width % 32 == camera.height % 32 == 0
    assert 0.7 * 128**2 < camera.width * camera.height <= 128**2
    middle = torch.tensor([[x0 + x1, y0 + y1]]) / 2  # of the box, in the view: of the frame, in the frame
    rays = (middle - view.camera.K[:2, 2]) / view.camera.K.diagonal()[:2]
    framed = rays * camera.K.diagonal()[:2] + camera.K[:2, 2]
    assert torch.allclose(framed, torch.tensor([[camera.width, camera.height]]) / 2, atol=1e-3)
    edited = editor.edit(view, 1.0)
    native = tmp_path / f"{view.camera.name}.png"
    assert Image.open(native).size == (camera.width, camera.height)
    outside = torch.ones(200, 200, dtype=torch.bool)
    outside[y0:y1, x0:x1] = False
    assert torch.equal(edited[outside], view.image[outside])


def test_what_a_model_leaves_alone_stays_to_the_bit(pix2pix: str) -> None:
    view = small(image_size=200).views[0]
    editor = editor_of(settings_of(pix2pix, edit_size=128))
    assert torch.equal(editor.paste(view, editor.original(view)), view.image)


@pytest.mark.parametrize("name", ADAPTERS)
def test_the_table_s_words_are_keywords_of_the_pipelines(diffusers: None, name: str) -> None:
    import diffusers as library

    adapter = ADAPTERS[name]
    picture = Image.new("RGB", (64, 32))
    asked = adapter.arguments("x", [picture], adapter.steps, adapter.guidance, adapter.image_guidance)
    known = inspect.signature(getattr(library, name).__call__).parameters
    assert set(asked) | {"generator"} <= set(known)
    assert None not in asked.values()


@pytest.mark.parametrize("model", ["timbrooks/instruct-pix2pix", "someone/no-such-model"])
def test_missing_weights_are_one_line_that_names_what_to_download(
    diffusers: None, model: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ProgdfError, match=f"hf download {model} --include") as told:
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
    assert len(list(painted.glob("*.png"))) == len(list(painted.glob("*.json"))) == 5
    assert result.report["trajectory"]["stages"] == [1.0]
    assert "the edited views" in result.folder.log.read_text(encoding="utf-8")
    assert set(result.report["agreement"]) == {"psnr_best", "unexplained", "agree"}
