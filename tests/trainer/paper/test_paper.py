"""`--preset paper`, line by line as documented in docs/paper.md."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.field.trajectory import load_trajectory
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, pack
from progdf.gdf.file import load_gdf
from tests.helpers.trained import WHITE, quick_options, small, train
from trainer.cli import train_options
from trainer.methods import METHODS
from trainer.optimize.losses import GradientL1, l1
from trainer.optimize.pgs import rates_per_column
from trainer.options import TrainOptions, apply_preset, with_values
from trainer.paper.descent import RATE_FACTORS, RATES_3DGS, learning_rates, recording_interval, whole_views
from trainer.paper.losses import RenderedLoss, describe_loss
from trainer.resolve import resolve, resolve_kind
from trainer.run.record import read_record
from trainer.run.run import RunResult
from trainer.views.crops import crop_scene, moving_attributes
from trainer.views.setup import TrainingSetup


def plan(*more: str, region: str = "all") -> TrainOptions:
    words = ("scene.ply", "--out", "run", "--region", region, "--editor", "night", "--preset", "paper")
    return resolve(train_options([*words, *more]))


@pytest.fixture(scope="module")
def finishing() -> list[int]:
    """Return the list of network training steps after the recording, which `run` fills."""
    return []


@pytest.fixture(scope="module")
def run(folder: Path, finishing: list[int]) -> Iterator[RunResult]:
    """Train a short run of the preset with a small network."""
    options = apply_preset(quick_options(folder, "paper", part="scarf"), "paper")
    short = {"steps": 40, "views": 5, "image_size": 56, "size": "tiny"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trainer.fit.network.train_network", lambda *given: finishing.append(given[3]))
        yield train(with_values(options, **short))


def test_pgs_has_the_printed_loss_for_every_kind_of_edit() -> None:
    """Check λ = 1, 5, 1 for L1 + LPIPS, α·β^(−t/s)·mean‖ΔΘ‖², −(∇²R)²; one target, 1500 to 2000 steps."""
    for kind in ("color", "style", "geometry"):
        found = resolve_kind(plan(), kind, 0)
        assert describe_loss(found, "LPIPS") == (
            "L1 + 1 LPIPS + 5 progressive (decay, mean) + 1 sharpness (paper)"
        )
        assert found.solver == "descent"
        assert found.stages == 1
        assert 1500 <= found.steps <= 2000


def test_pgs_frees_all_attributes_and_records_every_100_steps() -> None:
    assert bool((learning_rates("color", 23, 1.0) > 0).all()), "all attributes are free"
    assert resolve_kind(plan(), "color", 0).sh == "off", "three color channels only"
    assert recording_interval(resolve_kind(plan(), "color", 0).steps) == 100


def test_rates_are_3dgs_rates_scaled_as_in_gaussian_editor() -> None:
    multiplied = learning_rates("color", 14, 1.0)
    factors = [5.0] * 3 + [2.0] * 8 + [5.0] * 3  # means; log-scales, quaternion, opacity; color
    plain = rates_per_column(RATES_3DGS, 14, 1.0)
    assert torch.allclose(multiplied / plain, torch.tensor(factors))
    assert RATE_FACTORS.keys() == RATES_3DGS.keys()
    assert learning_rates("geometry", 14, 1.0).equal(multiplied), "the same for all kinds"


def test_paper_uses_at_most_96_views_and_a_time_slider() -> None:
    assert (plan().views.views, plan().optimize.slider) == (96, "time")


def test_field_is_a_position_network_with_hard_bins_fitted_to_pictures() -> None:
    network = METHODS[plan().preset].network_settings(plan().field)
    assert (network.size, network.inputs, network.bins, network.code) == ("paper", "position", "hard", 0)
    assert plan().field.field_loss == "pictures"


def test_field_loss_is_the_printed_sum() -> None:
    """Check L_GDF = L1 + LPIPS of the renders of Θ0 + GDF(s) and the snapshot, −(∇²R)² of the former."""
    case = small("body")
    rows = pack(case.scene[case.region.members])
    height = case.views[0].camera.height
    width = case.views[0].camera.width
    crops = [
        crop_scene(case.scene, case.region.members, view.camera, (0, 0, width, height), WHITE)
        for view in case.views[:2]
    ]
    found = 0.1 * torch.rand_like(rows)
    recorded = 0.1 * torch.rand_like(rows)
    loss = RenderedLoss(crops, rows, ATTRIBUTES, GradientL1())
    assert loss.views == 2
    image, expected = (crops[1].render(rows + offsets) for offsets in (found, recorded))
    gray = image.mean(dim=2)
    laplacian = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * gray[1:-1, 1:-1]
    printed = l1(image, expected) + GradientL1()(image, expected) - laplacian.square().mean()
    assert float(loss(found, recorded, 1)) == pytest.approx(float(printed), rel=1e-6)


def test_losses_cover_whole_pictures() -> None:
    case = small("scarf")
    setup = TrainingSetup(case.scene, case.region, list(case.views), [], WHITE)
    for view in whole_views(setup, {}).train:
        assert view.box == (0, 0, view.camera.width, view.camera.height)
    assert METHODS["paper"].box_views is whole_views


def test_report_names_the_printed_loss(run: RunResult) -> None:
    assert run.report["objective"] == (
        f"L1 + 1 {run.report['edit']['perceptual']} + 5 progressive (decay, mean) + 1 sharpness (paper)"
    )


def test_every_attribute_but_higher_sh_is_recorded(run: RunResult) -> None:
    trajectory, _, _ = load_trajectory(run.folder.trajectory)
    assert trajectory.end.shape[1] == 14
    assert set(moving_attributes(trajectory.end)) == set(ATTRIBUTES) - {"shN"}


def test_snapshots_lie_at_their_steps_and_the_last_is_the_end(run: RunResult) -> None:
    trajectory, _, _ = load_trajectory(run.folder.trajectory)
    assert trajectory.steps.tolist() == [0, 10, 20, 30, 40], "a short run has four"
    assert torch.allclose(trajectory.s, torch.linspace(0, 1, 5))


def test_network_is_not_trained_after_the_recording(
    folder: Path, run: RunResult, finishing: list[int]
) -> None:
    assert finishing == [0]
    origin = load_gdf(run.gdf, load_ply(folder / "scene.ply")).field.origin
    assert origin is not None
    shape = origin.network.shape
    assert (shape.hard, shape.inputs, shape.code) == (True, "position", 0)
    assert bool(origin.network.tensors["heads.weight"].any()), "but beside PGS"


def test_run_of_an_older_version_with_the_preset_is_refused() -> None:
    with pytest.raises(ProgdfError, match=r"older version with --preset paper, .* train it again"):
        read_record({"plan": {"optimize": {"as_printed": True}}})
