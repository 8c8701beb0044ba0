"""Memory bank, and networks trained jointly with the edit or after it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import trainer.run.run
from progdf.field import neural_fit
from progdf.field.choose import FieldEvaluator
from progdf.field.neural_fit import NeuralFit, NeuralSettings
from progdf.field.separable import fit_keyframes
from progdf.field.trajectory import load_trajectory
from progdf.formats.ply import load_ply
from progdf.gdf.file import load_gdf
from tests.helpers.edits import curved_trajectory
from tests.helpers.trained import quick_options
from trainer.options import FitOptions, with_values
from trainer.paper.descent import RATE_FACTORS
from trainer.paper.network import JointTraining, MemoryBank
from trainer.run.finish import load_evaluator, refit
from trainer.run.record import render_edited_views, reopen_run
from trainer.run.run import RunResult


@pytest.fixture(scope="module", autouse=True)
def short_fits() -> Iterator[None]:
    """Limit the training of networks to a few hundred steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neural_fit, "EFFORT", {"tiny": (200, 256, 5e-3)})
        patch.setattr("trainer.fit.network.EFFORT", neural_fit.EFFORT)
        patch.setattr("trainer.fit.network.PICTURE_STEPS", 20)
        # colors alone, fast enough for 60 steps
        factors = dict.fromkeys(RATE_FACTORS, 0.0) | {"sh0": 30.0}
        patch.setattr("trainer.paper.descent.RATE_FACTORS", factors)
        yield


def train_jointly(folder: Path, out: str, resume: bool = False) -> RunResult:
    """Train a short run whose position network is trained jointly with the members."""
    settings = {"steps": 60, "stages": 2, "views": 5, "image_size": 56, "field": "neural", "name": "joint"}
    bending = "recolor:#30a050"  # its path differs from the line between two keyframes
    method = {"preset": "paper", "color_solver": False}
    options = quick_options(folder, out, **settings, **method, editor=bending, resume=resume)
    return trainer.run.run.train(options, quiet=True)


def raw_keyframes_psnr(run: RunResult) -> float:
    """Return the worst PSNR of two keyframes in raw parameters along the recordings, dB."""
    finished = reopen_run(run.folder.root)
    trajectory = finished.trajectory
    setup = render_edited_views(finished)
    views = load_evaluator(run.folder, setup, setup.judging, trajectory)
    ends = torch.stack([trajectory.node(0), trajectory.node(len(trajectory) - 1)])
    line = fit_keyframes(trajectory.s[[0, -1]], ends, 2, trajectory.s.tolist())
    errors = FieldEvaluator(trajectory.s, trajectory.offsets, views.counted_pixels, trajectory.at)
    return errors.candidate(line, "2 raw keyframes").worst


@pytest.fixture(scope="module")
def alongside(folder: Path) -> RunResult:
    """Return a finished run whose network was trained jointly with the edit."""
    return train_jointly(folder, "joint")


# ---- memory bank


def test_bank_begins_with_the_original() -> None:
    bank = MemoryBank(5, 14)
    assert bank.strengths.tolist() == [0.0]
    assert not bool(bank.offsets.any())


def test_bank_stores_half_precision_in_order() -> None:
    bank = MemoryBank(5, 14)
    offsets = torch.randn(5, 14)
    bank.add(0.25, offsets)
    assert bank.offsets.dtype == torch.float16
    assert torch.equal(bank.offsets[1], offsets.half())
    with pytest.raises(ValueError, match=r"after one at 0\.25"):
        bank.add(0.25, offsets)


def test_full_bank_drops_the_most_redundant_snapshot() -> None:
    bank = MemoryBank(1, 14, most=4)
    for strength in (0.3, 0.35, 0.4, 1.0):
        bank.add(strength, torch.full((1, 14), strength))
    assert bank.strengths.tolist() == pytest.approx([0.0, 0.3, 0.4, 1.0])
    assert bank.offsets[:, 0, 0].tolist() == pytest.approx([0.0, 0.3, 0.4, 1.0], abs=1e-3)


def beside(seed: int = 0) -> JointTraining:
    rows = torch.randn(20, 14, generator=torch.Generator().manual_seed(1))
    settings = NeuralSettings(inputs="position", batch=32, seed=seed)
    fit = NeuralFit(rows, 14, ("sh0",), settings)
    return JointTraining(fit, 14, (0.5, 1.0), (10, 20), lambda moved: moved[:, 11:14])


def test_step_maps_linearly_to_strength_within_its_stage() -> None:
    along = beside()
    assert [along.strength(step) for step in (0, 5, 10, 20, 30)] == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_field_waits_for_the_first_recording() -> None:
    along = beside()
    along.step()
    assert along.fit.steps == 0
    along.add(3, curved_trajectory(20, moving=("sh0",))[1][4])
    along.step()
    assert along.fit.steps == 1


def test_joint_training_resumes_to_the_same_bits() -> None:
    _, offsets = curved_trajectory(20, moving=("sh0",))
    recordings = [(4, offsets[3].half()), (11, offsets[5].half()), (25, offsets[8].half())]

    def run(along: JointTraining, begin: int, end: int) -> None:
        for step in range(begin, end):
            for at, found in recordings:
                if at == step:
                    along.add(at, found)
            along.step()

    whole = beside()
    first = beside()
    second = beside()
    run(whole, 0, 30)
    run(first, 0, 15)
    kept = first.capture_state()
    second.restore(replace(kept, tensors={name: tensor.clone() for name, tensor in kept.tensors.items()}))
    second.refill([(at, found) for at, found in recordings if at < 15])
    run(second, 15, 30)
    for name, tensor in whole.capture_state().tensors.items():
        assert torch.equal(tensor, second.capture_state().tensors[name]), name


# ---- runs


@pytest.mark.slow
def test_joint_network_is_finished_and_matches_the_recording(folder: Path, alongside: RunResult) -> None:
    field = alongside.report["field"]
    assert field["kind"] == "neural"
    assert field["endpoint_error"] == 0.0
    assert field["outside_change"] == 0.0
    assert field["psnr_worst"] > alongside.report["baselines"]["keyframes2"]["psnr_worst"]
    assert field["psnr_worst"] > raw_keyframes_psnr(alongside) + 3.0
    assert field["bake_error"]["psnr_worst"] > field["psnr_worst"]
    gdf = load_gdf(alongside.gdf, load_ply(folder / "scene.ply"))
    assert gdf.field.origin is not None
    assert gdf.field.origin.network.shape.inputs == "position"


@pytest.mark.slow
def test_interrupted_run_finishes_its_network_to_the_same_bits(
    folder: Path, alongside: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = JointTraining.step
    steps = 0

    def interrupted(self: JointTraining) -> None:
        nonlocal steps
        steps += 1
        if steps == 31:
            raise KeyboardInterrupt
        step(self)

    monkeypatch.setattr("trainer.store.state.SAVE_EVERY", 0.0)
    monkeypatch.setattr(JointTraining, "step", interrupted)
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        train_jointly(folder, "again")
    monkeypatch.setattr(JointTraining, "step", step)
    found = train_jointly(folder, "again", resume=True)
    scene = load_ply(folder / "scene.ply")
    one, other = (load_gdf(result.gdf, scene).field.origin for result in (alongside, found))
    assert one is not None
    assert other is not None
    for name, tensor in one.network.tensors.items():
        assert torch.equal(tensor, other.network.tensors[name]), name


def test_refit_trains_a_network_on_the_recording(folder: Path, alongside: RunResult) -> None:
    before = alongside.folder.trajectory.read_bytes()
    kept = alongside.gdf.read_bytes()
    found = refit(
        with_values(FitOptions(alongside.folder.root), field="neural", field_loss="pictures", threads=1),
        quiet=True,
    )
    assert alongside.folder.trajectory.read_bytes() == before
    origin = load_gdf(found.gdf, load_ply(folder / "scene.ply")).field.origin
    assert origin is not None
    assert (origin.network.shape.inputs, origin.network.shape.code) == ("position", 0)
    trajectory, _, _ = load_trajectory(found.folder.trajectory)
    assert _end(found, folder).equal(trajectory.end)
    alongside.gdf.write_bytes(kept)


def _end(result: RunResult, folder: Path) -> Tensor:
    return load_gdf(result.gdf, load_ply(folder / "scene.ply")).field.offsets(1.0)
