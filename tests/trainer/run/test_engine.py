"""Rendering engine of a run: all give the same edit, and a run keeps the engine it started with."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import pack
from progdf.rasterize import engines
from progdf.rasterize.engines import ENGINES, choose_engine, get_engine
from tests.helpers.card import CARD, Card
from tests.helpers.drawn import NEEDS_WARP
from tests.helpers.trained import WHITE, Small, quick_options, small, train, write_bear
from trainer import resolve as resolution
from trainer.optimize.losses import Objective, perceptual_loss
from trainer.optimize.pgs import PgsSettings, PgsState, TargetStage, learning_rates, optimize
from trainer.options import OptimizeOptions
from trainer.resolve import resolve, resolve_kind
from trainer.run import training
from trainer.views import boxes
from trainer.views.crops import crop_scene

CPU = torch.device("cpu")


@NEEDS_WARP
@pytest.mark.parametrize(
    "asked",
    [
        {"kind": "style", "steps": 12, "stages": 1},
        pytest.param(
            {"kind": "geometry", "group_steps": 10, "steps": 16, "stages": 1}, marks=pytest.mark.slow
        ),
    ],
    ids=["style", "geometry"],
)
def test_run_on_warp_matches_the_cpu_engine(folder: Path, asked: dict[str, object]) -> None:
    ends = []
    for engine in ("cpu", "warp"):
        out = f"{engine}-{asked.get('kind', 'color')}"
        options = quick_options(folder, out, part="scarf", views=4, image_size=48, engine=engine, **asked)
        ends.append(train(options))
    cpu, warp = ends
    assert "warp renders the training steps on " in warp.folder.log.read_text()
    assert "by warp" not in cpu.folder.log.read_text()
    # gradients differ by 1e-5 of the largest; Adam scales small gradients up to the same size
    assert warp.report["edit"]["psnr_to_views"] == pytest.approx(
        cpu.report["edit"]["psnr_to_views"], abs=0.02
    )
    assert warp.report["edit"]["lpips_to_views"] == pytest.approx(
        cpu.report["edit"]["lpips_to_views"], abs=2e-4
    )
    difference = (warp.trajectory.end - cpu.trajectory.end).norm() / cpu.trajectory.end.norm()
    assert float(difference) < 0.01


def test_auto_engine_is_warp_with_a_gpu_and_warp_else_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for card, installed, chosen in ((True, True, "warp"), (True, False, "cpu"), (False, True, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda card=card: card)
        monkeypatch.setattr(engines, "find_spec", lambda name, there=installed: object() if there else None)
        assert choose_engine("auto") == chosen
        assert choose_engine("cpu") == "cpu"


def test_colors_are_solved_on_the_cpu_without_a_gpu(folder: Path) -> None:
    options = resolve(quick_options(folder, "either", part="scarf", engine="warp"))
    assert [resolve_kind(options, kind, 0).engine for kind in ("color", "style")] == ["cpu", "warp"]


@pytest.mark.parametrize(("asked", "chosen"), [("auto", "cpu"), ("warp", "warp")])
def test_colors_are_solved_on_a_gpu_only_if_warp_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, asked: str, chosen: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(engines, "find_spec", lambda name: object())
    options = resolve(quick_options(folder, "either", part="scarf", engine=asked))
    assert [resolve_kind(options, kind, 0).engine for kind in ("color", "style")] == [chosen, "warp"]


def test_run_without_warp_is_refused_before_it_begins(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.delitem(sys.modules, ENGINES["warp"], raising=False)
    get_engine.cache_clear()
    with pytest.raises(ProgdfError, match="the warp engine needs warp-lang; pip install"):
        train(quick_options(folder, "none", engine="warp"))
    assert not (folder / "none").exists()


def test_run_keeps_the_engine_it_began_with(folder: Path) -> None:
    asked = {"views": 4, "image_size": 48, "steps": 16, "stages": 1, "part": "scarf"}
    train(quick_options(folder, "kept", **asked))
    with pytest.raises(ProgdfError, match="was started with --engine cpu, not warp"):
        train(quick_options(folder, "kept", engine="warp", resume=True, **asked))


@pytest.fixture(scope="module")
def bear_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write a small bear before the simulated GPU, on which everything takes ten times as long."""
    return write_bear(tmp_path_factory.mktemp("bear"), 400)


@pytest.fixture
def bear_folder(bear_files: tuple[Path, Path], tmp_path: Path) -> Path:
    """Return a folder with the small bear. Request it before `card`."""
    for path in bear_files:
        shutil.copy(path, tmp_path)
    return tmp_path


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Card]:
    """Simulate a GPU on which the reference engine replaces warp."""
    monkeypatch.setitem(ENGINES, "warp", ENGINES["reference"])
    get_engine.cache_clear()
    for module in (training, boxes):
        monkeypatch.setattr(module, "engine_device", lambda name: CARD if name == "warp" else CPU)
    with Card() as made:
        yield made
    get_engine.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize(
    "asked",
    [
        {"kind": "style", "steps": 8, "stages": 1},
        {"kind": "geometry", "group_steps": 4, "steps": 8, "stages": 1},
    ],
    ids=["style", "geometry"],
)
def test_full_run_works_with_steps_on_a_gpu(bear_folder: Path, card: Card, asked: dict[str, object]) -> None:
    """Check that no operation mixes devices and that the result matches the CPU."""
    asked = {"part": "scarf", "views": 4, "image_size": 32} | asked
    there = train(quick_options(bear_folder, "there", engine="warp", **asked))
    assert card.moved > 0
    here = train(quick_options(bear_folder, "here", engine="cpu", **asked))
    assert there.report["edit"]["psnr_to_views"] == pytest.approx(
        here.report["edit"]["psnr_to_views"], abs=0.02
    )
    assert type(there.trajectory.end) is Tensor


@pytest.fixture(scope="module")
def case() -> Small:
    """Return a case made before the simulated GPU, on which everything takes ten times as long."""
    return small("scarf", 400, 2, 32)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["color", "style", "geometry"])
def test_no_step_transfers_data_to_or_from_the_gpu(case: Small, card: Card, kind: str) -> None:
    moved = []
    scene = case.scene.to(CARD)
    original = pack(scene[case.region.members.to(CARD)], with_shN=True)
    crops = [
        crop_scene(scene, case.region.members, v.camera, v.box, WHITE, engine="warp") for v in case.views
    ]
    targets = [crop_.original.clamp(0.0, 1.0).flip(2) for crop_ in crops]
    objective = Objective(perceptual_loss()[0], OptimizeOptions(perceptual_weight=0.3, kind="style"))
    rates = learning_rates(kind, original.shape[1], 1.0)
    for steps in (1, 1, 2):
        before = card.moved
        stages = [TargetStage(1.0, targets, steps)]
        assert list(optimize(original, crops, [], stages, objective, PgsSettings(rates, ramp=0.0)))
        moved.append(card.moved - before)
    assert moved[2] == moved[1], "the first brings the network there, each its rates"


def test_saved_state_is_restored_to_the_gpu(card: Card) -> None:
    rows = torch.rand(5, 14).to(CARD)
    state = PgsState(rows)
    state.view(3)
    state.descend(torch.rand(5, 14).to(CARD), torch.ones(14).to(CARD), 0.1)
    state.pictures = [torch.rand(4, 4, 3).to(CARD)]
    saved = state.capture_state()
    kept = replace(saved, tensors={name: tensor.detach().cpu() for name, tensor in saved.tensors.items()})
    again = PgsState(rows)
    again.restore(kept)
    assert again.moved.device == again.pictures[0].device == CARD
    assert torch.equal(again.moved.detach().cpu(), state.moved.detach().cpu())
    assert torch.equal(again.second.cpu(), state.second.cpu())


@pytest.mark.slow
@pytest.mark.parametrize(
    "asked",
    [{}, {"editor": "grade:exposure=0.7"}, {"editor": "stripes:#20a040", "views": 6}],
    ids=["recolor", "grade", "stripes"],
)
def test_colors_are_solved_for_on_a_gpu(
    bear_folder: Path, card: Card, monkeypatch: pytest.MonkeyPatch, asked: dict[str, object]
) -> None:
    """Check that no operation mixes devices and that the result matches the CPU."""
    monkeypatch.setattr(resolution, "engine_device", lambda name: CARD if name == "warp" else CPU)
    asked = {"part": "scarf", "views": 4, "image_size": 40, "threads": 1} | asked
    there = train(quick_options(bear_folder, "there", engine="warp", **asked))
    assert "colors are solved for, on" in there.folder.log.read_text()
    here = train(quick_options(bear_folder, "here", engine="cpu", **asked))
    assert there.report["edit"]["psnr_to_views"] == pytest.approx(
        here.report["edit"]["psnr_to_views"], abs=0.05
    )
    assert type(there.trajectory.end) is Tensor
