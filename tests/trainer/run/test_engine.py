"""Which engine draws a run's steps: the same edit from each, and a run keeps to the one it began with."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import trainer.setup
from progdf.errors import ProgdfError
from progdf.gaussians import pack
from progdf.rasterize import engines
from progdf.rasterize.engines import ENGINES, choose_engine, get_engine
from tests.helpers.card import CARD, Card
from tests.helpers.drawn import NEEDS_WARP
from tests.helpers.trained import WHITE, Small, quick_options, small, train, write_bear
from trainer.optimize.losses import Objective, perceptual_loss
from trainer.optimize.pgs import PgsSettings, PgsState, TargetStage, learning_rates, optimize
from trainer.options import OptimizeOptions
from trainer.resolve import resolve, resolve_kind
from trainer.run import training
from trainer.views.crops import crop_scene


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
def test_a_run_on_warp_ends_at_the_cpu_engine_s_digits(folder: Path, asked: dict[str, object]) -> None:
    ends = []
    for engine in ("cpu", "warp"):
        out = f"{engine}-{asked.get('kind', 'color')}"
        options = quick_options(folder, out, part="scarf", views=4, image_size=48, engine=engine, **asked)
        ends.append(train(options))
    cpu, warp = ends
    assert "the steps are drawn by warp on " in warp.folder.log.read_text()
    assert "by warp" not in cpu.folder.log.read_text()
    # a step's gradients differ by 1e-5 of the largest, and Adam takes what hardly shows for as much
    assert warp.report["edit"]["psnr_to_views"] == pytest.approx(
        cpu.report["edit"]["psnr_to_views"], abs=0.02
    )
    assert warp.report["edit"]["lpips_to_views"] == pytest.approx(
        cpu.report["edit"]["lpips_to_views"], abs=2e-4
    )
    difference = (warp.trajectory.end - cpu.trajectory.end).norm() / cpu.trajectory.end.norm()
    assert float(difference) < 0.01


def test_auto_is_warp_where_there_is_a_card_and_warp_and_else_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for card, installed, chosen in ((True, True, "warp"), (True, False, "cpu"), (False, True, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda card=card: card)
        monkeypatch.setattr(engines, "find_spec", lambda name, there=installed: object() if there else None)
        assert choose_engine("auto") == chosen
        assert choose_engine("cpu") == "cpu"


def test_colors_are_solved_for_on_the_processor_whatever_draws_the_steps(folder: Path) -> None:
    options = resolve(quick_options(folder, "either", part="scarf", engine="warp"))
    assert [resolve_kind(options, kind, 0).engine for kind in ("color", "style")] == ["cpu", "warp"]


def test_without_warp_the_run_is_refused_before_it_begins(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.delitem(sys.modules, ENGINES["warp"], raising=False)
    get_engine.cache_clear()
    with pytest.raises(ProgdfError, match="the warp engine needs warp-lang; pip install"):
        train(quick_options(folder, "none", engine="warp"))
    assert not (folder / "none").exists()


def test_a_run_goes_on_with_the_engine_that_it_began_with(folder: Path) -> None:
    asked = {"views": 4, "image_size": 48, "steps": 16, "stages": 1, "part": "scarf"}
    train(quick_options(folder, "kept", **asked))
    with pytest.raises(ProgdfError, match="was started with --engine cpu, not warp"):
        train(quick_options(folder, "kept", engine="warp", resume=True, **asked))


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Card]:
    """A card on which the reference draws in place of warp."""
    monkeypatch.setitem(ENGINES, "warp", ENGINES["reference"])
    get_engine.cache_clear()
    for module in (training, trainer.setup):
        monkeypatch.setattr(
            module, "engine_device", lambda name: CARD if name == "warp" else torch.device("cpu")
        )
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
def test_a_whole_run_works_where_its_steps_are_on_a_card(
    tmp_path: Path, card: Card, asked: dict[str, object]
) -> None:
    """Nothing on the card meets what is not, and the result is that of the processor."""
    write_bear(tmp_path, 400)
    asked = {"part": "scarf", "views": 4, "image_size": 40} | asked
    there = train(quick_options(tmp_path, "there", engine="warp", **asked))
    assert card.moved > 0
    here = train(quick_options(tmp_path, "here", engine="cpu", **asked))
    assert there.report["edit"]["psnr_to_views"] == pytest.approx(
        here.report["edit"]["psnr_to_views"], abs=0.02
    )
    assert type(there.trajectory.end) is Tensor


@pytest.fixture(scope="module")
def case() -> Small:
    """Made before there is a card, on which all takes ten times as long."""
    return small("scarf", 400, 2, 32)


@pytest.mark.parametrize("kind", ["color", "style", "geometry"])
def test_no_step_moves_anything_to_the_card_or_back(case: Small, card: Card, kind: str) -> None:
    moved = []
    scene = case.scene.to(CARD)
    original = pack(scene[case.region.members.to(CARD)], with_shN=True)
    crops = [
        crop_scene(scene, case.region.members, v.camera, v.box, WHITE, engine="warp") for v in case.views
    ]
    targets = [crop_.original.clamp(0.0, 1.0).flip(2) for crop_ in crops]
    objective = Objective(perceptual_loss()[0], OptimizeOptions(perceptual_weight=0.3, sharpness="hinge"))
    rates = learning_rates(kind, original.shape[1], 1.0)
    for steps in (1, 1, 2):
        before = card.moved
        stages = [TargetStage(1.0, targets, steps)]
        assert list(optimize(original, crops, [], stages, objective, PgsSettings(rates, ramp=0.0)))
        moved.append(card.moved - before)
    assert moved[2] == moved[1], "the first brings the network there, each its rates"


def test_a_saved_state_goes_back_to_the_card(card: Card) -> None:
    rows = torch.rand(5, 14).to(CARD)
    state = PgsState(rows)
    state.view(3)
    state.descend(torch.rand(5, 14).to(CARD), torch.ones(14).to(CARD), 0.1, True, 0.9)
    state.pictures = [torch.rand(4, 4, 3).to(CARD)]
    saved = state.capture_state()
    kept = replace(saved, tensors={name: tensor.detach().cpu() for name, tensor in saved.tensors.items()})
    again = PgsState(rows)
    again.restore(kept)
    assert again.moved.device == again.pictures[0].device == CARD
    assert torch.equal(again.moved.detach().cpu(), state.moved.detach().cpu())
    assert torch.equal(again.second.cpu(), state.second.cpu())
