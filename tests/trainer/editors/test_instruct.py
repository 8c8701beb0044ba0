"""instruct:"…" end to end with real diffusers pipelines whose networks are tiny and random."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from progdf.gdf.file import load_gdf
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk
from tests.helpers.demo_scenes import bear
from tests.helpers.tiny_pipelines import (
    klein_pipeline,
    tiny_flux2_klein,
    tiny_flux_kontext,
    tiny_instruct_pix2pix,
)
from tests.helpers.trained import quick_options, small, train, write_bear
from trainer.editors import make_editor
from trainer.editors.adapters import ADAPTERS, Adapter, default_model, load_pipeline, missing_pipeline
from trainer.editors.instruct import InstructEditor, sentence
from trainer.editors.mixed_steps import MixedSteps, network_steps
from trainer.options import EditorOptions, TrainOptions, with_values
from trainer.resolve import resolve, resolve_kind
from trainer.run.command import check_command
from trainer.store.pretrained import LastValueCache
from trainer.store.run_folder import RunFolder, begin_log
from trainer.views.view import render_view

BATMAN = 'instruct:"turn him into Batman"'


@pytest.fixture(scope="module")
def diffusers() -> None:
    for package in ("diffusers", "transformers", "accelerate"):
        pytest.importorskip(package, reason="pip install progdf-studio[diffusion]")


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


@pytest.mark.slow
@pytest.mark.parametrize("make", [tiny_instruct_pix2pix, tiny_flux_kontext, tiny_flux2_klein])
def test_saved_pipeline_edits_a_view_at_its_own_size(
    diffusers: None, make: Callable[[Path], Path], tmp_path: Path
) -> None:
    view = small(image_size=66).views[0]
    editor = editor_of(settings_of(str(make(tmp_path))))
    edited = editor.edit(view, 1.0)
    assert edited.shape == view.image.shape
    assert 0.0 <= float(edited.min()) <= float(edited.max()) <= 1.0
    assert float((edited - view.image).abs().mean()) > 0.02
    assert torch.equal(editor.edit(view, 0.0), view.image)


def test_same_seed_repeats_the_picture_and_another_seed_differs(pix2pix: str) -> None:
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


def test_prompt_reaches_the_pipeline_without_its_quotes(pix2pix: str) -> None:
    view = small().views[0]
    quoted = editor_of(settings_of(pix2pix)).edit(view, 1.0)
    plain = editor_of(settings_of(pix2pix), "instruct:turn him into Batman").edit(view, 1.0)
    other = editor_of(settings_of(pix2pix), "instruct:make it snow").edit(view, 1.0)
    assert torch.equal(quoted, plain)
    assert not torch.equal(quoted, other)


def test_any_strength_works_and_the_change_grows_with_it(pix2pix: str) -> None:
    view = small().views[0]
    editor = editor_of(settings_of(pix2pix, edit_steps=4))
    assert editor.stages == ()
    shares = [float((editor.edit(view, s) - view.image).norm()) for s in (0.25, 0.5, 0.75, 1.0)]
    assert shares == sorted(shares)
    assert shares[0] > 0
    assert editor.calls((0.25, 0.5, 0.75, 1.0)) == 1 + 3 + 4 + 4


def test_view_is_edited_once_for_all_runs(pix2pix: str, tmp_path: Path) -> None:
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


def test_model_receives_the_padded_region_and_its_output_is_cached(pix2pix: str, tmp_path: Path) -> None:
    view = small(image_size=200).views[0]
    editor = editor_of(settings_of(pix2pix, edit_size=128, cache=tmp_path))
    (x0, y0, x1, y1), camera = editor.frame(view)
    shown = (view.mask > 0.5).nonzero()
    inside = (shown[:, 0] >= y0) & (shown[:, 0] < y1) & (shown[:, 1] >= x0) & (shown[:, 1] < x1)
    assert bool(inside.all())
    assert (x1 - x0) * (y1 - y0) < 0.8 * 200 * 200
    assert camera.width % 32 == camera.height % 32 == 0
    assert 0.7 * 128**2 < camera.width * camera.height <= 128**2
    middle = torch.tensor([[x0 + x1, y0 + y1]]) / 2  # of the box, in view pixels
    rays = (middle - view.camera.K[:2, 2]) / view.camera.K.diagonal()[:2]
    framed = rays * camera.K.diagonal()[:2] + camera.K[:2, 2]
    assert torch.allclose(framed, torch.tensor([[camera.width, camera.height]]) / 2, atol=1e-3)
    edited = editor.edit(view, 1.0)
    native = tmp_path / f"{view.camera.name}.png"
    assert Image.open(native).size == (camera.width, camera.height)
    outside = torch.ones(200, 200, dtype=torch.bool)
    outside[y0:y1, x0:x1] = False
    assert torch.equal(edited[outside], view.image[outside])


def test_unchanged_model_output_leaves_the_view_bit_identical(pix2pix: str) -> None:
    view = small(image_size=200).views[0]
    editor = editor_of(settings_of(pix2pix, edit_size=128))
    assert torch.equal(editor.paste(view, editor.original(view)), view.image)


def test_model_is_reloaded_if_guidance_changes_the_prompt_encoding(
    pix2pix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.store.pretrained._models", LastValueCache())
    view = small().views[0]
    with_guidance, without, again = (
        editor_of(settings_of(pix2pix, guidance=guidance)).edit(view, 1.0) for guidance in ("7.5", "1", "7.5")
    )
    assert not torch.equal(with_guidance, without)
    assert torch.equal(with_guidance, again)


@pytest.mark.parametrize("name", ADAPTERS)
def test_adapter_arguments_are_keywords_of_the_pipeline(diffusers: None, name: str) -> None:
    import diffusers as library

    adapter = ADAPTERS[name]
    known = inspect.signature(getattr(library, name).__call__).parameters
    picture = Image.new("RGB", (64, 32))
    asked = adapter.arguments(known, "x", [picture], 3, adapter.guidance, adapter.image_guidance)
    assert set(asked) | {"generator", "output_type"} <= set(known)
    assert {"prompt", "image", "num_inference_steps"} <= set(asked)
    assert (adapter.guidance is None) == (adapter.guidance_word not in asked)


@pytest.mark.parametrize("model", ["timbrooks/instruct-pix2pix", "someone/no-such-model"])
def test_missing_pipeline_error_names_the_download(
    diffusers: None, model: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ProgdfError, match=f"hf download {model} --include") as caught:
        editor_of(EditorOptions(BATMAN, model))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("damage", ["no model_index.json", "no weights", "cut weights", "another pipeline"])
def test_incomplete_pipeline_folder_is_a_one_line_error(pix2pix: str, damage: str, tmp_path: Path) -> None:
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
    with pytest.raises(ProgdfError, match="; ") as caught:
        editor_of(settings_of(str(folder))).edit(view, 1.0)
    assert "\n" not in str(caught.value)


def test_image_guidance_for_a_model_without_it_is_refused(diffusers: None, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not support picture guidance; "):
        editor_of(settings_of(str(tiny_flux_kontext(tmp_path)), guidance="2.5,1.5"))


def test_empty_prompt_is_refused() -> None:
    with pytest.raises(ProgdfError, match="needs an instruction; "):
        editor_of(EditorOptions(""), 'instruct:""')


def test_missing_packages_are_reported_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(ProgdfError, match=r"pip install 'progdf-studio\[diffusion\]"):
        editor_of(EditorOptions(""))


def text_run(folder: Path, model: str, out: str, **more: object) -> TrainOptions:
    return quick_options(
        folder,
        out,
        editor=BATMAN,
        model=model,
        edit_steps=2,
        edit_size=64,
        steps=32,
        stages=0,
        views=4,
        image_size=64,
        kind="style",
        **more,
    )


@pytest.mark.slow
def test_text_edit_trains_in_stages_and_resumes_to_the_same_bits(
    pix2pix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bear(tmp_path, 900)
    result = train(text_run(tmp_path, pix2pix, "run"), quiet=True)
    painted = result.folder.root / "views" / "painted"
    rounds = ("anchor", "sweep", "round_1", "round_2")
    for kept in (painted / name for name in rounds):
        assert len(list(kept.glob("*.png"))) == len(list(kept.glob("*.json"))) > 0
    assert sum(len(list((painted / name).glob("*.png"))) for name in rounds) == 3 * 4
    assert len(result.report["trajectory"]["stages"]) == 4
    log = result.folder.log.read_text(encoding="utf-8")
    assert "network calls per picture" in log
    assert "12 pictures to paint: one view after another, then all twice more" in log
    assert re.search(r"a style edit at strength .*, 1$", log, re.MULTILINE)
    assert {"unexplained", "unexplained_fine", "contrast", "left_out"} < set(result.report["agreement"])

    paint, count = MixedSteps.paint, iter(range(1000))

    def stops(self: MixedSteps, *args: object) -> torch.Tensor:
        if next(count) == 9:
            raise KeyboardInterrupt
        return paint(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(MixedSteps, "paint", stops)
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        train(text_run(tmp_path, pix2pix, "stopped", name="run"), quiet=True)
    resumed = train(text_run(tmp_path, pix2pix, "stopped", name="run", resume=True), quiet=True)
    pictures = len(list(painted.rglob("*.png")))
    assert next(count) == pictures + 1, "what was painted before is not painted again"
    whole, again = (load_gdf(r.folder.gdf("run")).field for r in (result, resumed))
    assert all(torch.equal(whole.offsets(s), again.offsets(s)) for s in (0.25, 0.5, 1.0))


@pytest.mark.slow  # four runs; the fast tests cover views that follow an approved picture
def test_run_follows_the_anchor_and_refuses_a_changed_anchor(pix2pix: str, tmp_path: Path) -> None:
    klein = str(tiny_flux2_klein(tmp_path / "klein"))
    demo = bear(900)
    _ = write_bear(tmp_path, 900)
    camera = demo.cameras[1].resize(80, 60)
    anchor = tmp_path / "anchor.png"
    painted = render_view(demo.gaussians, camera, torch.ones(3)).clamp(0.0, 1.0).flip(2)

    def save(picture: torch.Tensor) -> None:
        to_picture(picture).save(anchor, pnginfo=camera_chunk(camera))

    save(painted)
    options = with_values(text_run(tmp_path, klein, "run"), anchor=anchor)
    result = train(options, quiet=True)
    log = result.folder.log.read_text(encoding="utf-8")
    assert "all views follow" not in log, "one is given"
    save(painted.flip(0))
    with pytest.raises(ProgdfError, match=r"anchor\.png has changed since"):
        train(replace(options, resume=True), quiet=True)
    away = replace(camera, viewmat=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ camera.viewmat)
    to_picture(painted).save(anchor, pnginfo=camera_chunk(away))
    other = with_values(text_run(tmp_path, klein, "away"), anchor=anchor)
    with pytest.raises(
        ProgdfError, match=r"anchor\.png does not show the region; take it from another position"
    ):
        train(other, quiet=True)
    with pytest.raises(ProgdfError, match="accepts no reference pictures and cannot follow --anchor"):
        train(with_values(text_run(tmp_path, pix2pix, "alone"), anchor=anchor), quiet=True)


def test_weights_are_checked_before_a_run_folder_is_reused(pix2pix: str, tmp_path: Path) -> None:
    write_bear(tmp_path, 900)
    (tmp_path / "run" / "views").mkdir(parents=True)
    begin_log(RunFolder(tmp_path / "run"), text_run(tmp_path, "gone", "run").edit)
    with pytest.raises(ProgdfError, match="the weights of gone are not on this machine"):
        check_command(resolve(text_run(tmp_path, "gone", "run")))


def test_geometry_edit_requests_only_the_full_strength(pix2pix: str, tmp_path: Path) -> None:
    options = resolve(text_run(tmp_path, pix2pix, "run"))
    assert [resolve_kind(options, kind, 0).stages for kind in ("color", "style", "geometry")] == [4, 4, 1]
    several = replace(options, optimize=replace(options.optimize, stages=3))
    assert resolve_kind(several, "geometry", 0).stages == 3


def test_text_edits_default_to_512_pixel_views(tmp_path: Path) -> None:
    assert resolve(with_values(text_run(tmp_path, "m", "run"), image_size=0)).views.image_size == 512
    assert resolve(text_run(tmp_path, "m", "run")).views.image_size == 64
    assert resolve(quick_options(tmp_path, image_size=0)).views.image_size == 0


@pytest.mark.parametrize("option", [{"quantize": "nf4"}, {"device": "cpu"}])
def test_model_options_are_for_text_edits_only(option: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not apply to recolor; it is for instruct"):
        resolve(quick_options(tmp_path, **option))


def test_components_on_the_gpu_in_turn_paint_the_same_picture(
    pix2pix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from diffusers import AutoencoderKL

    tiled = []
    # the tiny autoencoder would have tiles of 32 pixels
    monkeypatch.setattr(AutoencoderKL, "enable_tiling", lambda self: tiled.append(self))
    editor = editor_of(settings_of(pix2pix))
    view = small().views[0]
    mixed = load_pipeline(editor.request, replace(editor.placement, in_turn=True))
    in_turn = replace(editor, load=lambda: mixed)
    for strength in (0.5, 1.0, 0.5):
        assert torch.equal(in_turn.edit(view, strength), editor.edit(view, strength))
    assert len(tiled) == 1
    assert mixed.calls == 2 * network_steps(0.5, 1.0, 2) + 2


def test_four_bit_weights_need_their_package_and_a_gpu(pix2pix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.editors.adapters.find_spec", lambda package: package)
    with pytest.raises(ProgdfError, match="nf4 needs a GPU"):
        editor_of(settings_of(pix2pix, quantize="nf4"))
    monkeypatch.setattr("trainer.editors.adapters.find_spec", lambda package: None)
    with pytest.raises(ProgdfError, match=r"pip install 'progdf-studio\[quantize\]"):
        editor_of(settings_of(pix2pix, quantize="nf4"))


@pytest.mark.parametrize(
    ("typed", "read"),
    [
        ("like the boys'", "like the boys'"),
        ("'like the boys'", "like the boys"),
        ("\"he says 'no'\"", "he says 'no'"),
        ('"', '"'),
        ("'twas night", "'twas night"),
    ],
)
def test_only_a_pair_of_enclosing_quotes_is_removed(typed: str, read: str) -> None:
    assert sentence(typed) == read


def test_note_reports_the_end_of_the_prompt_that_clip_ignores(pix2pix: str) -> None:
    assert "does not read" not in editor_of(settings_of(pix2pix)).note
    words = " ".join(["very"] * 90 + ["batman"])
    note = editor_of(settings_of(pix2pix), f"instruct:{words}").note
    assert "it ignores the end of the prompt: “" in note
    assert note.endswith("batman”")


def test_base_model_of_klein_gets_its_own_settings(diffusers: None, tmp_path: Path) -> None:
    model = str(tmp_path / "base")
    klein_pipeline(tmp_path, is_distilled=False).save_pretrained(model)
    base = editor_of(EditorOptions(BATMAN, model, edit_size=64)).request
    assert (base.steps, base.guidance, base.adapter.passes) == (50, 4.0, 2)
    editor = editor_of(EditorOptions(BATMAN, model, edit_size=64, edit_steps=2))
    assert editor.calls((1.0,)) == 4
    assert editor.edit(small().views[0], 1.0).shape == small().views[0].image.shape


GIB = 2**30


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Callable[[float, float], None]:
    """Return a function that simulates a GPU with the given free and total bytes."""

    def has(free: float, total: float) -> None:
        monkeypatch.setattr("trainer.editors.adapters.gpu_memory", lambda: (int(free), int(total)))
        monkeypatch.setattr(
            "trainer.editors.adapters.model_device", lambda choice: "cpu" if choice == "cpu" else "cuda"
        )
        monkeypatch.setattr(
            torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation
        )

    return has


def test_note_reports_device_precision_and_memory(pix2pix: str, card: Callable[[float, float], None]) -> None:
    assert "on the CPU in float32" in editor_of(settings_of(pix2pix)).note
    card(8 * GIB, 8 * GIB)
    assert (
        "on cuda in float16, all components at once: about 1.0 GB needed, 8.6 GB free; 2 network calls"
        in editor_of(settings_of(pix2pix)).note
    )
    card(GIB / 2, 8 * GIB)
    tight = editor_of(settings_of(pix2pix))
    assert tight.placement.in_turn
    assert "one component at a time: about 1.0 GB needed, 0.5 GB free" in tight.note
    assert editor_of(settings_of(pix2pix, device="cpu")).placement.device == "cpu"


def test_gpu_without_bfloat16_uses_float16(
    diffusers: None, tmp_path: Path, card: Callable[[float, float], None]
) -> None:
    card(8 * GIB, 8 * GIB)
    assert editor_of(settings_of(str(tiny_flux2_klein(tmp_path)))).placement.dtype == torch.float16


def test_klein_is_the_default_if_installed_and_fitting(
    monkeypatch: pytest.MonkeyPatch, card: Callable[[float, float], None]
) -> None:
    small_model = "timbrooks/instruct-pix2pix"
    sizes = {"transformer": 3_880_000_000, "text_encoder": 4_020_000_000, "vae": 80_000_000}
    assert default_model() == small_model  # no GPU
    card(1 * GIB, 12 * GIB)
    monkeypatch.setattr("trainer.editors.adapters.component_sizes", lambda model, adapter: sizes)
    assert default_model() == "black-forest-labs/FLUX.2-klein-4B"
    card(8 * GIB, 8 * GIB)
    assert default_model() == small_model

    def absent(model: str, adapter: Adapter) -> dict[str, int]:
        raise missing_pipeline(model)

    card(80 * GIB, 80 * GIB)
    monkeypatch.setattr("trainer.editors.adapters.component_sizes", absent)
    assert default_model() == small_model


def test_large_model_on_a_cpu_needs_an_explicit_device(pix2pix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.editors.adapters._MAX_CPU_PARAMETERS", 1000)
    with pytest.raises(ProgdfError, match=r"finds no GPU: .* or add --device cpu"):
        editor_of(settings_of(pix2pix))
    assert editor_of(settings_of(pix2pix, device="cpu")).note


@pytest.mark.parametrize("when", ["loading", "painting"])
def test_gpu_out_of_memory_is_one_line_with_remedies(
    pix2pix: str, when: str, monkeypatch: pytest.MonkeyPatch, card: Callable[[float, float], None]
) -> None:
    from diffusers import StableDiffusionInstructPix2PixPipeline as Pipeline

    card(GIB / 2, 8 * GIB)
    editor = editor_of(settings_of(pix2pix))

    def runs_out(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9.00 GiB")

    if when == "loading":
        monkeypatch.setattr(Pipeline, "from_pretrained", runs_out)
    else:
        monkeypatch.setattr(MixedSteps, "paint", runs_out)
        editor = replace(editor, load=lambda: MixedSteps.__new__(MixedSteps))
    with pytest.raises(
        ProgdfError, match=r"about 1\.0 GB needed, 0\.5 GB free; add --quantize nf4, .*klein-4B"
    ) as caught:
        editor.edit(small().views[0], 1.0)
    assert "\n" not in str(caught.value)


def test_gated_model_error_names_the_login(
    diffusers: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(
        ProgdfError, match=r"--include model_index\.json' after accepting its license .* 'hf auth login'"
    ):
        editor_of(EditorOptions(BATMAN, "black-forest-labs/FLUX.1-Kontext-dev"))


@pytest.mark.parametrize(
    ("kind", "option", "line"),
    [
        ("Flux2KleinKVPipeline", {"guidance": "4"}, "--guidance does not apply"),
        ("QwenImageEditPlusPipeline", {"edit_size": 512}, "--edit-size does not apply"),
        ("QwenImageEditPlusPipeline", {}, "constraints.txt 'progdf-studio.qwen.'"),
    ],
)
def test_option_or_package_unsuited_to_the_model_is_refused(
    diffusers: None,
    kind: str,
    option: dict[str, object],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "model_index.json").write_text(
        json.dumps({"_class_name": kind, "_diffusers_version": "0.42.1"})
    )
    monkeypatch.setattr("trainer.editors.adapters.find_spec", lambda package: package if option else None)
    with pytest.raises(ProgdfError, match=line):
        editor_of(EditorOptions(BATMAN, str(tmp_path), **option))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ADAPTERS)
@pytest.mark.parametrize("shape", [(1, 1), (16, 9), (9, 1), (3, 4), (1, 30)])
def test_paint_size_has_the_area_and_multiples_of_the_model(name: str, shape: tuple[int, int]) -> None:
    adapter = ADAPTERS[name]
    for size in (adapter.size, 64, 32):
        width, height = adapter.paint_size(*shape, size)
        assert width % 32 == height % 32 == 0
        assert min(width, height) >= 64
        if size == adapter.size and max(shape) < 20:
            assert 0.85 * size * size < width * height <= (1.1 if adapter.is_fixed else 1.0) * size * size
            assert abs(width / height / (shape[0] / shape[1]) - 1) < 0.15


@pytest.mark.parametrize("shape", [(1, 1), (16, 9), (9, 1), (3, 4), (700, 333)])
def test_paint_size_is_unchanged_by_the_rescaling_of_the_model(
    diffusers: None, shape: tuple[int, int]
) -> None:
    from diffusers.pipelines.qwenimage.pipeline_qwenimage_edit_plus import calculate_dimensions

    width, height = ADAPTERS["QwenImageEditPlusPipeline"].paint_size(*shape, 1024)
    assert calculate_dimensions(1024 * 1024, width / height) == (width, height)
