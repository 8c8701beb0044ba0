"""The loss, term by term: right gradients, paid when due, and each doing what it is there for."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import pack
from progdf.metrics.lpips import Lpips
from tests.helpers.count import Count
from tests.helpers.trained import WHITE, small
from trainer.editors import make_editor
from trainer.optimize.losses import (
    GradientL1,
    LpipsLoss,
    Moment,
    Objective,
    TermMeans,
    describe_loss,
    erode,
    l1,
    loss_table,
    progressive_change,
    sharpness,
    total_loss,
)
from trainer.optimize.pgs import ParameterSnapshot, PgsSettings, TargetStage, learning_rates, optimize
from trainer.options import EditorOptions, OptimizeOptions, Over, Progressive
from trainer.views.crops import crop_scene
from trainer.views.view import crop


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def moment(**more: object) -> Moment:
    """A step in the middle of a run that has arrived at its stage."""
    moved = (noise(5, 14, seed=2) - 0.5).requires_grad_()
    settled = Moment(
        noise(8, 9, 3).requires_grad_(), noise(8, 9, 3, seed=1), 0, 100, 10, True, moved, torch.zeros(5, 14)
    )
    return replace(settled, **more)  # type: ignore[arg-type]


def paying(perceptual_weight: float = 0.1, **more: object) -> OptimizeOptions:
    """What an objective is to pay for."""
    return replace(OptimizeOptions(), perceptual_weight=perceptual_weight, **more)  # type: ignore[arg-type]


ALL_TERMS = paying(0.3, perceptual_every=1, progressive="decay", sharpness="hinge")


# ---- gradients


def test_l1_and_the_stand_in_have_the_gradients_of_finite_differences() -> None:
    image = noise(8, 9, 3).requires_grad_()
    target = noise(8, 9, 3, seed=1)
    for measure in (l1, GradientL1()):
        assert torch.autograd.gradcheck(lambda x, measure=measure: measure(x, target), image)


@pytest.mark.parametrize("form", ["hinge", "paper"])
def test_sharpness_has_the_gradient_of_finite_differences(form: str) -> None:
    image = 0.5 * noise(8, 9, 3)
    target = noise(8, 9, 3, seed=1)
    inside = noise(8, 9, seed=3) > 0.3
    assert float(sharpness(image, target, "hinge", inside)) > 0, "the hinge is open"
    assert torch.autograd.gradcheck(
        lambda x: sharpness(x, target, form, inside),  # type: ignore[arg-type]
        image.requires_grad_(),
    )


@pytest.mark.parametrize("grows", [False, True])
@pytest.mark.parametrize("over", get_args(Over))
def test_the_progressive_change_has_the_gradient_of_finite_differences(grows: bool, over: Over) -> None:
    moved = noise(5, 14).requires_grad_()
    previous = noise(5, 14, seed=1)
    assert torch.autograd.gradcheck(lambda x: progressive_change(x, previous, 70, grows, over), moved)


def test_lpips_has_the_gradient_of_finite_differences() -> None:
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
        nudge = 1e-7 * (noise(32, 32, 3, seed=10 + seed) - 0.5)  # longer ones step over kinks of the ReLUs
        with torch.no_grad():
            rise = float(measure(image + nudge, target) - measure(image - nudge, target)) / 2
        assert float((image.grad * nudge).sum()) == pytest.approx(rise, rel=1e-5)


# ---- which terms, when


def test_each_term_has_its_name_and_their_sum_is_the_loss() -> None:
    terms = Objective(GradientL1(), ALL_TERMS).terms(moment())
    assert list(terms) == ["l1", "perceptual", "progressive", "sharpness"]
    assert float(total_loss(terms).detach()) == pytest.approx(sum(float(x.detach()) for x in terms.values()))


def test_weights_scale_their_terms_and_leave_l1_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    now = moment(image=0.5 * noise(8, 9, 3))
    single = Objective(GradientL1(), ALL_TERMS).terms(now)
    monkeypatch.setattr("trainer.optimize.losses.PROGRESSIVE_WEIGHT", 10.0)
    monkeypatch.setattr("trainer.optimize.losses.SHARPNESS_WEIGHT", {"hinge": 0.2})
    double = Objective(GradientL1(), replace(ALL_TERMS, perceptual_weight=0.6)).terms(now)
    for name, value in single.items():
        assert float(value.detach()) > 0
        factor = 1.0 if name == "l1" else 2.0
        assert float(double[name].detach()) == pytest.approx(factor * float(value.detach())), name


def test_the_perceptual_term_is_paid_every_so_many_steps_and_only_at_the_stages_own_picture() -> None:
    objective = Objective(GradientL1(), paying(perceptual_every=3))
    paid = ["perceptual" in objective.terms(moment(local=local)) for local in range(6)]
    assert paid == [True, False, False, True, False, False]
    assert "perceptual" not in objective.terms(moment(local=0, arrived=False))


def test_a_new_stage_forgets_the_targets_of_the_last() -> None:
    forgotten = []

    class Watched(GradientL1):
        def forget(self) -> None:
            forgotten.append(True)

    Objective(Watched(), paying()).begin_stage()
    assert forgotten == [True]


def test_the_line_for_the_log_names_what_is_really_used() -> None:
    assert describe_loss(paying(), "gradient-l1") == "L1 + 0.1 gradient-l1 every 2 steps"
    assert describe_loss(ALL_TERMS, "lpips-vgg") == (
        "L1 + 0.3 lpips-vgg + 5 progressive (decay, mean) + 0.1 sharpness (hinge)"
    )


# ---- the progressive constraint


def test_the_progressive_change_is_the_printed_sum_or_the_members_mean() -> None:
    moved = noise(5, 14)
    previous = noise(5, 14, seed=1)
    squares = (moved - previous).square().sum(dim=1)
    lengths: dict[Over, Tensor] = {"sum": squares.sum(), "mean": squares.mean()}
    for over, length in lengths.items():
        for step in (0, 50, 600):
            grown, decayed = (
                progressive_change(moved, previous, step, grows, over) for grows in (True, False)
            )
            assert float(grown) == pytest.approx(0.05 * 1.1 ** (step / 50) * float(length))
            assert float(decayed) == pytest.approx(0.05 * 1.1 ** (-step / 50) * float(length))


def recolored(weights: OptimizeOptions, steps: int = 30, **more: object) -> list[ParameterSnapshot]:
    """The recordings of a short recoloring of a small bear."""
    case = small("body")
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    original = pack(case.scene[case.region.members], with_shN=True)
    crops = [crop_scene(case.scene, case.region.members, v.camera, v.box, WHITE) for v in case.views]
    stage = TargetStage(1.0, [crop(editor.edit(v, 1.0), v.box) for v in case.views], steps)
    settings = PgsSettings(learning_rates("color", original.shape[1], 1.0), ramp=0.0)
    settings = replace(settings, **more)  # type: ignore[arg-type]
    return list(optimize(original, crops, crops[:1], [stage], Objective(GradientL1(), weights), settings))


def distance_traveled(weights: OptimizeOptions) -> float:
    """Mean offset at the end of it."""
    return float(recolored(weights)[-1].offsets.abs().mean())


@pytest.mark.parametrize("progressive", ["decay", "growth"])
def test_the_sum_over_members_holds_an_edit_back_far_more_than_their_mean(progressive: Progressive) -> None:
    free = distance_traveled(paying())
    mean, total = (
        distance_traveled(paying(progressive=progressive, progressive_over=over)) for over in get_args(Over)
    )
    assert 5 * total < mean < free


def test_a_frozen_edit_is_recorded_too_where_recordings_go_by_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.optimize.losses.PROGRESSIVE_WEIGHT", 1e4)
    frozen = paying(progressive="growth", progressive_over="sum")
    assert [found.step for found in recolored(frozen, every=8, smoothing=0.0)] == [8, 16, 24, 30]
    assert len(recolored(frozen)) < 4 < len(recolored(paying())), "else by what is seen"


# ---- sharpness


def test_the_hinge_is_shut_where_the_render_is_as_sharp_as_its_target() -> None:
    texture = noise(20, 20, 3)
    soft = texture.mean(dim=(0, 1)).expand_as(texture)
    assert float(sharpness(texture, texture, "hinge")) == 0.0
    assert float(sharpness(texture, soft, "hinge")) == 0.0
    assert float(sharpness(soft, texture, "hinge")) > 0.1


def test_the_hinge_looks_inside_the_mask_only() -> None:
    texture = noise(20, 20, 3)
    soft = texture.clone()
    soft[:, 10:] = 0.5
    left = torch.zeros(20, 20, dtype=torch.bool)
    left[:, :8] = True
    assert float(sharpness(soft, texture, "hinge", left)) == 0.0
    assert float(sharpness(soft, texture, "hinge", ~left)) > 0.0


def test_the_papers_sharpness_pulls_at_pixels_inside_the_picture_and_pays_for_contrast() -> None:
    """The printed sum of signed Laplacians telescopes to the rim; that of squares does not."""
    image = noise(20, 20, 3).requires_grad_()
    lost = sharpness(image, image.detach(), "paper")
    lost.backward()
    assert image.grad is not None
    assert float(image.grad[2:-2, 2:-2].abs().max()) > 1e-3
    assert float(sharpness(2 * image, image, "paper").detach()) == pytest.approx(4 * float(lost.detach()))


def test_descending_the_hinge_brings_back_a_lost_texture_s_sharpness() -> None:
    target = noise(24, 24, 3)
    image = (0.25 * target + 0.75 * target.mean()).requires_grad_()
    optimizer = torch.optim.SGD([image], lr=20.0)
    before = float(sharpness(image, target, "hinge").detach())
    for _ in range(40):
        optimizer.zero_grad()
        loss = sharpness(image, target, "hinge")
        loss.backward()
        optimizer.step()
    assert float(sharpness(image, target, "hinge").detach()) < 0.1 * before


def test_erosion_takes_the_rim_but_not_at_the_border_of_the_picture() -> None:
    mask = torch.zeros(12, 12)
    mask[3:, 3:] = 1.0
    inner = erode(mask, by=2)
    assert bool(inner[5:, 5:].all())
    assert int(inner.sum()) == 49


# ---- means


def test_a_terms_mean_is_over_the_steps_that_paid_for_it() -> None:
    means = TermMeans()
    means.add({"l1": 1.0, "perceptual": 4.0})
    means.add({"l1": 2.0})
    assert means.read() == {"l1": 1.5, "perceptual": 4.0}
    assert means.read() == {}


def test_the_table_of_losses_has_a_gap_where_a_term_was_not_paid() -> None:
    table = loss_table([(3, {"l1": 0.123456789}), (7, {"l1": 0.1, "perceptual": 0.5})])
    assert table == {"step": [3, 7], "l1": [0.12346, 0.1], "perceptual": [None, 0.5]}


def test_kept_features_have_a_bound_and_values_do_not_depend_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
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
        """Of all targets, and of how many pictures features were computed."""
        before = features.calls
        values = [float(loss(pictures[0], target, key)) for key, target in enumerate(pictures[1:])]
        return values, features.calls - before

    expected, calls = distances(roomy)
    assert distances(tight) == (expected, calls) == (expected, 6)
    assert distances(roomy) == (expected, 3)
    assert distances(tight) == (expected, 4), "one of the three targets found no room"
