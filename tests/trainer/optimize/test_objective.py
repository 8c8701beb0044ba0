"""Loss terms: gradients, schedule and effect of each."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.metrics.lpips import Lpips
from tests.helpers.count import Count
from trainer.optimize.losses import (
    GradientL1,
    LpipsLoss,
    Moment,
    Objective,
    TermMeans,
    describe_loss,
    l1,
    loss_table,
    total_loss,
)
from trainer.options import OptimizeOptions


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def moment(**more: object) -> Moment:
    """Return a step in the middle of a run, at the target of its stage."""
    moved = (noise(5, 14, seed=2) - 0.5).requires_grad_()
    settled = Moment(
        noise(8, 9, 3).requires_grad_(), noise(8, 9, 3, seed=1), 0, 100, 10, True, moved, torch.zeros(5, 14)
    )
    return replace(settled, **more)  # type: ignore[arg-type]


def paying(perceptual_weight: float = 0.1, **more: object) -> OptimizeOptions:
    """Return optimization options with these loss terms."""
    return replace(OptimizeOptions(), perceptual_weight=perceptual_weight, **more)  # type: ignore[arg-type]


ALL_TERMS = paying(0.3)


# ---- gradients


def test_l1_and_gradient_l1_match_finite_differences() -> None:
    image = noise(8, 9, 3).requires_grad_()
    target = noise(8, 9, 3, seed=1)
    for measure in (l1, GradientL1()):
        assert torch.autograd.gradcheck(lambda x, measure=measure: measure(x, target), image)


def test_lpips_gradient_matches_finite_differences() -> None:
    try:
        network = Lpips.load()
    except ProgdfError as error:
        pytest.skip(str(error))
    kernels, biases, importance = (
        [x.double() for x in part] for part in (network.kernels, network.biases, network.importance)
    )
    exact = replace(network, kernels=kernels, biases=biases, importance=importance)
    image = noise(32, 32, 3).requires_grad_()
    target = noise(32, 32, 3, seed=1)
    measure = LpipsLoss(exact)
    measure(image, target).backward()
    assert image.grad is not None
    for seed in range(3):
        nudge = 1e-7 * (noise(32, 32, 3, seed=10 + seed) - 0.5)  # larger steps cross kinks of the ReLUs
        with torch.no_grad():
            rise = float(measure(image + nudge, target) - measure(image - nudge, target)) / 2
        assert float((image.grad * nudge).sum()) == pytest.approx(rise, rel=1e-5)


# ---- schedule of terms


def test_loss_is_the_sum_of_its_named_terms() -> None:
    terms = Objective(GradientL1(), ALL_TERMS).terms(moment())
    assert list(terms) == ["l1", "perceptual"]
    assert float(total_loss(terms).detach()) == pytest.approx(sum(float(x.detach()) for x in terms.values()))


def test_weights_scale_their_terms_and_leave_l1_unchanged() -> None:
    now = moment(image=0.5 * noise(8, 9, 3))
    single = Objective(GradientL1(), ALL_TERMS).terms(now)
    double = Objective(GradientL1(), replace(ALL_TERMS, perceptual_weight=0.6)).terms(now)
    for name, value in single.items():
        assert float(value.detach()) > 0
        factor = 1.0 if name == "l1" else 2.0
        assert float(double[name].detach()) == pytest.approx(factor * float(value.detach())), name


def test_perceptual_term_is_computed_every_second_step_at_the_stage_target() -> None:
    objective = Objective(GradientL1(), paying())
    paid = ["perceptual" in objective.terms(moment(local=local)) for local in range(4)]
    assert paid == [True, False, True, False]
    assert "perceptual" not in objective.terms(moment(local=0, arrived=False))


def test_new_stage_forgets_the_targets_of_the_last() -> None:
    forgotten = []

    class Watched(GradientL1):
        def forget(self) -> None:
            forgotten.append(True)

    Objective(Watched(), paying()).begin_stage()
    assert forgotten == [True]


def test_loss_description_names_the_active_terms() -> None:
    assert describe_loss(paying(), "gradient-l1") == "L1 + 0.1 gradient-l1 every 2 steps"
    assert describe_loss(ALL_TERMS, "lpips-vgg") == "L1 + 0.3 lpips-vgg every 2 steps"


# ---- means


def test_term_mean_covers_only_the_steps_that_computed_it() -> None:
    means = TermMeans()
    means.add({"l1": 1.0, "perceptual": 4.0})
    means.add({"l1": 2.0})
    assert means.read() == {"l1": 1.5, "perceptual": 4.0}
    assert means.read() == {}


def test_loss_table_has_gaps_for_skipped_terms() -> None:
    table = loss_table([(3, {"l1": 0.123456789}), (7, {"l1": 0.1, "perceptual": 0.5})])
    assert table == {"step": [3, 7], "l1": [0.12346, 0.1], "perceptual": [None, 0.5]}


def test_feature_cache_is_bounded_without_changing_values(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        network = Lpips.load()
    except ProgdfError as error:
        pytest.skip(str(error))
    pictures = [noise(40, 40, 3, seed=seed).float() for seed in range(4)]
    sizes = [sum(x.numel() * 4 for x in network.features(target)) for target in pictures[1:]]
    assert sum(sizes) > 80_000 > sizes[0] + sizes[1]
    roomy = LpipsLoss(network)
    tight = LpipsLoss(network, room=80_000)
    features = Count(monkeypatch, Lpips, "features")

    def distances(loss: LpipsLoss) -> tuple[list[float], int]:
        """Return the distances to all targets, and the number of pictures whose features were computed."""
        before = features.calls
        values = [float(loss(pictures[0], target, key)) for key, target in enumerate(pictures[1:])]
        return values, features.calls - before

    expected, calls = distances(roomy)
    assert distances(tight) == (expected, calls) == (expected, 6)
    assert distances(roomy) == (expected, 3)
    assert distances(tight) == (expected, 4), "one of the three targets found no room"
