"""Tests of fields: exact ends, errors that fall with rank, and the choice of a small field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import progdf.field.baked
from progdf.field import (
    AttributeBases,
    BakedField,
    FieldEvaluator,
    choose_field,
    fit_keyframes,
    fit_separable,
)
from progdf.field.baked import END_TYPES, interpolate_at
from progdf.field.choose import FieldChoice, grow_ranks, render_trajectories, store_ends
from progdf.field.separable import (
    channel_weights,
    course_sums,
    decode_bases,
    fit_amplitude,
    fit_course,
    principal_modes,
    quantize_bases,
    store_attribute,
)
from progdf.gaussians import ATTRIBUTES, attribute_slices
from progdf.metrics.image import LEVEL, ROUNDING
from tests.helpers.edits import at_snapshots, curved_field, curved_trajectory, linear_pictures

EVERYTHING = dict.fromkeys(ATTRIBUTES, 2)
BASIS_TYPES = [torch.int8, torch.float16, torch.float32]


# ---- both kinds


@pytest.mark.parametrize("basis_type", BASIS_TYPES)
def test_ends_of_a_separable_field_are_exact(basis_type: torch.dtype) -> None:
    strengths, offsets = curved_trajectory(50, channels=14 + 24)
    field = fit_separable(strengths, offsets, EVERYTHING, basis_type=basis_type)
    assert not bool(field.offsets(0.0).any())
    assert torch.equal(field.offsets(1.0), offsets[-1])


@pytest.mark.parametrize("in_half", [False, True])
@pytest.mark.parametrize("count", [2, 3, 4, 9, 40])
def test_ends_of_a_keyframe_field_are_exact(in_half: bool, count: int) -> None:
    strengths, offsets = curved_trajectory(50)
    offsets[1:-1] = offsets[1:-1].half().float() if in_half else offsets[1:-1]
    field = fit_keyframes(strengths, offsets, count)
    assert not bool(field.offsets(0.0).any())
    assert torch.equal(field.offsets(1.0), offsets[-1])


@pytest.mark.parametrize("kind", ["separable", "keyframes"])
def test_unmoved_attributes_are_absent(kind: str) -> None:
    strengths, offsets = curved_trajectory(50, channels=14 + 9, moving=("sh0",))
    field = (
        fit_separable(strengths, offsets, EVERYTHING)
        if kind == "separable"
        else fit_keyframes(strengths, offsets, 4)
    )
    assert list(field.attributes) == ["sh0"]
    assert field.bytes_per_member == 3 * (4 + 2) if kind == "separable" else 3 * 4 * 3


@pytest.mark.parametrize("members", [0, 1, 2])
def test_fields_of_at_most_two_members_work(members: int) -> None:
    strengths, offsets = curved_trajectory(members)
    for field in (fit_separable(strengths, offsets, EVERYTHING), fit_keyframes(strengths, offsets, 3)):
        assert torch.equal(field.offsets(1.0), offsets[-1])


def test_two_snapshots_give_a_straight_path() -> None:
    strengths, offsets = curved_trajectory(20, snapshots=2)
    field = fit_separable(strengths, offsets, EVERYTHING)
    assert torch.allclose(field.offsets(0.25), 0.25 * offsets[-1])


def test_edit_that_returns_to_its_start_is_followed() -> None:
    strengths, offsets = curved_trajectory(40)
    offsets[-1] = 0.0
    field = fit_separable(strengths, offsets, dict.fromkeys(ATTRIBUTES, 7))
    assert not bool(field.offsets(1.0).any())
    assert float((at_snapshots(field, strengths) - offsets).abs().max()) < 0.03


@pytest.mark.parametrize(
    ("strengths", "offsets", "message"),
    [
        (torch.tensor([0.0, 0.5]), torch.zeros(2, 3, 14), "ascend from 0 to 1"),
        (torch.tensor([0.0, 0.6, 0.5, 1.0]), torch.zeros(4, 3, 14), "must ascend"),
        (torch.tensor([0.0, 1.0]), torch.ones(2, 3, 14), "must be 0"),
        (torch.tensor([0.0, 1.0]), torch.zeros(3, 3, 14), r"expected .T,M,C."),
        (
            torch.tensor([0.0, 1.0]),
            torch.tensor([0.0, float("nan")])[:, None, None].expand(2, 3, 14),
            "not finite",
        ),
    ],
)
def test_invalid_trajectory_is_refused(strengths: Tensor, offsets: Tensor, message: str) -> None:
    for fit in (lambda: fit_separable(strengths, offsets, {}), lambda: fit_keyframes(strengths, offsets, 3)):
        with pytest.raises(ValueError, match=message):
            fit()


# ---- separable


def test_trajectory_of_two_bends_is_exact_with_two_bases() -> None:
    strengths, offsets = curved_trajectory(80)
    field = fit_separable(strengths, offsets, EVERYTHING, basis_type=torch.float32)
    assert torch.allclose(at_snapshots(field, strengths), offsets, atol=1e-5)


def test_int8_bases_are_within_half_a_step() -> None:
    exact = torch.randn(3, 100, 4, generator=torch.Generator().manual_seed(0))
    rest, step = quantize_bases(exact, torch.int8)
    assert rest.dtype == torch.int8
    assert bool(((rest.float() * step[:, None] - exact).abs() <= 0.5001 * step[:, None]).all())


def test_error_falls_with_rank() -> None:
    rng = torch.Generator().manual_seed(4)
    strengths = torch.linspace(0, 1, 17)
    offsets = torch.randn(17, 60, 14, generator=rng).cumsum(dim=0)
    offsets -= offsets[:1].clone()
    errors = []
    for rank in (0, 1, 2, 4, 8, 15):
        field = fit_separable(strengths, offsets, dict.fromkeys(ATTRIBUTES, rank))
        errors.append(float((at_snapshots(field, strengths) - offsets).square().mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3 * errors[0]


def test_offsets_are_linear_between_snapshots() -> None:
    field = curved_field(30)
    low = float(field.knots[3])
    high = float(field.knots[4])
    middle = field.offsets(0.25 * low + 0.75 * high)
    assert torch.allclose(middle, 0.25 * field.offsets(low) + 0.75 * field.offsets(high), atol=1e-5)


def test_last_segment_is_extrapolated_beyond_the_end() -> None:
    field = curved_field(30)
    last = field.offsets(1.0) - field.offsets(float(field.knots[-2]))
    assert torch.allclose(field.offsets(1.125), field.offsets(1.0) + last, atol=1e-4)


def test_weights_improve_the_fit_of_visible_members() -> None:
    strengths, offsets = curved_trajectory(60, seed=1)
    offsets[:, 30:] += 3 * curved_trajectory(30, seed=2)[1][:, :, :]
    weights = torch.ones(60)
    weights[30:] = 1e-6
    ranks = dict.fromkeys(ATTRIBUTES, 1)

    def error(field: BakedField) -> float:
        return float((at_snapshots(field, strengths) - offsets)[:, :30].square().sum())

    assert error(fit_separable(strengths, offsets, ranks, weights)) < error(
        fit_separable(strengths, offsets, ranks)
    )


def test_fit_is_deterministic() -> None:
    a = curved_field(40, seed=7)
    b = curved_field(40, seed=7)
    for name, bases in a.attributes.items():
        assert all(torch.equal(part, getattr(b.attributes[name], key)) for key, part in vars(bases).items())


# ---- baked fields


def test_inconsistent_bases_are_refused() -> None:
    bases = curved_field(5).attributes["means"]
    for broken in (
        {"end_offset": bases.end_offset[:4]},
        {"scale": bases.scale[1:]},
        {"coefficients": bases.coefficients[:, :1]},
        {"coefficients": bases.coefficients + 0.1},
        {"end_offset": bases.end_offset.double()},
        {"residual_basis": bases.residual_basis.int()},
    ):
        with pytest.raises(ValueError, match=r"expected|fit|coefficients"):
            replace(bases, **broken)


def test_knots_must_ascend_from_zero_to_one() -> None:
    field = curved_field(5)
    for nodes in (field.knots * 2, field.knots.flip(0), field.knots.double(), field.knots[:1]):
        with pytest.raises(ValueError, match="knots"):
            replace(field, knots=nodes)


def test_attributes_must_have_the_same_members() -> None:
    field = curved_field(5)
    other = curved_field(6)
    with pytest.raises(ValueError, match="different numbers of members"):
        replace(field, attributes={**field.attributes, "sh0": other.attributes["sh0"]})


# ---- choice of a field


def test_chosen_field_meets_its_target_with_fewer_bytes_than_keyframes() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    render = linear_pictures(60, 14)
    evaluator = FieldEvaluator(strengths, offsets, render, target=45.0)
    chosen = choose_field(strengths, offsets, render, evaluator=evaluator)
    keyframes = (fit_keyframes(strengths, offsets, count) for count in range(2, 18))
    best = next(field for field in keyframes if min(evaluator.curve(field)) >= 45.0)
    assert chosen.met
    assert chosen.best.worst >= 45.0
    assert chosen.best.field.bytes_per_member < best.bytes_per_member / 3
    end = chosen.best.field.offsets(1.0)
    assert float((render(end) - render(offsets[-1])).square().mean()) <= 10**-4.5


def test_chosen_field_spends_no_bytes_on_invisible_attributes() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    render = linear_pictures(60, 14)
    evaluator = FieldEvaluator(strengths, offsets, render, target=50.0)
    field = choose_field(strengths, offsets, render, evaluator=evaluator).best.field
    assert field.attributes["quats"].bytes_per_member == 4
    assert field.attributes["sh0"].residual_basis.shape[0] > 0


def test_straight_trajectory_needs_one_byte_per_value() -> None:
    strengths, offsets = curved_trajectory(20)
    straight = strengths[:, None, None] * offsets[-1]
    chosen = choose_field(strengths, straight, linear_pictures(20, 14))
    assert len(chosen.tried) == 1
    assert chosen.best.field.bytes_per_member == 14
    assert chosen.best.worst > 55


def test_unreachable_target_is_reported_with_the_best_field() -> None:
    rng = torch.Generator().manual_seed(4)
    offsets = torch.randn(33, 40, 14, generator=rng)
    offsets[0] = 0
    strengths = torch.linspace(0, 1, 33)
    render = linear_pictures(40, 14)
    evaluator = FieldEvaluator(strengths, offsets, render, target=98.0)
    chosen = choose_field(strengths, offsets, render, evaluator=evaluator)
    assert not chosen.met
    assert chosen.best.worst == max(c.worst for c in chosen.tried)
    assert chosen.why.endswith("none reaches 98 dB")


def test_choice_reports_the_smallest_sufficient_field() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    chosen = choose_field(strengths, offsets, linear_pictures(60, 14))
    assert chosen.why == f"the smallest of {len(chosen.tried)} fields that reaches 40 dB"
    sizes = [c.field.bytes_per_member for c in chosen.tried if c.excess <= 1]
    assert chosen.best.field.bytes_per_member == min(sizes)


@pytest.mark.parametrize(("at", "serves"), [(2, True), (4, False)])
def test_field_must_be_close_at_full_strength_too(at: int, serves: bool) -> None:
    """Shift one of four strengths by 1.3 levels of 8 bits, which the mean over all hides."""
    strengths = torch.linspace(0, 1, 5)
    offsets = strengths[:, None, None].expand(5, 40, 14).contiguous()
    edited = {float(s): o[:, :3] for s, o in zip(strengths[1:], offsets[1:], strict=True)}
    evaluator = FieldEvaluator(strengths, offsets, lambda rows: rows[:, :3], edited=edited)
    off = offsets.clone()
    off[at] += 1.3 / 255
    assert (evaluator.candidate(fit_keyframes(strengths, off, 5), "off").excess <= 1.0) is serves


def test_error_of_the_edit_decides_how_much_is_stored() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    render = linear_pictures(60, 14)
    noise = torch.randn(render(offsets[-1]).shape, generator=torch.Generator().manual_seed(0))

    def choice(missed: float) -> FieldChoice:
        edited = {s: render(interpolate_at(strengths, offsets, s)) + missed * noise for s in (0.5, 1.0)}
        evaluator = FieldEvaluator(strengths, offsets, render, edited=edited)
        return choose_field(strengths, offsets, render, evaluator=evaluator)

    rough = choice(0.1)
    fine = choice(0.001)
    assert rough.met
    assert fine.met
    assert rough.best.field.bytes_per_member < fine.best.field.bytes_per_member
    for chosen, missed in ((rough, 0.1), (fine, 0.001)):
        own = ROUNDING + missed**2 * float(noise.square().mean())
        assert chosen.best.to_editor is not None
        assert 10 ** (-chosen.best.to_editor / 10) <= 1.1001 * max(own, LEVEL), (
            "what no screen shows is nothing"
        )
    assert 10 ** (-fine.best.to_editor / 10) > 1.1 * own


def test_only_far_moving_ends_are_stored_in_16_bits() -> None:
    strengths, offsets = curved_trajectory(60)
    render = linear_pictures(60, 14)
    means = attribute_slices(14)["means"]

    def near(moved: Tensor) -> Tensor:
        enlarged = moved.clone()
        enlarged[:, means] *= 2000
        return render(enlarged)

    ends = store_ends(offsets, FieldEvaluator(strengths, offsets, near))
    assert {name: levels.dtype for name, (levels, _) in ends.items()} == {
        name: torch.int16 if name == "means" else torch.int8 for name in ATTRIBUTES if name != "shN"
    }


@pytest.mark.parametrize("end_type", END_TYPES)
def test_end_offset_is_decoded_from_its_levels(end_type: torch.dtype) -> None:
    strengths, offsets = curved_trajectory(40)
    offsets = offsets[:, :, attribute_slices(14)["means"]].clone()
    stored = None if end_type == torch.float32 else quantize_bases(offsets[-1:], end_type)
    if stored is not None:
        offsets[-1] = decode_bases(*stored)[0]
    trajectory = fit_amplitude(offsets, torch.ones(40, 3), stored)
    bases = store_attribute(trajectory, principal_modes(trajectory.gram)[:, :2])
    field = BakedField("separable", strengths, {"means": bases}, 14)
    assert bases.end_offset.dtype == end_type
    assert torch.equal(field.offsets(1.0)[:, :3], offsets[-1])
    assert not bool(field.offsets(0.0).any())


def test_course_summed_in_ranges_matches_the_plain_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    strengths, offsets = curved_trajectory(60)
    columns = attribute_slices(14)["sh0"]
    part = offsets[:, :, columns].clone()
    plain_sums = fit_amplitude(part, torch.ones(60, 3))
    modes = principal_modes(plain_sums.gram)
    plain = store_attribute(plain_sums, modes[:, : plain_sums.needed_rank(0.001)])
    monkeypatch.setattr(progdf.field.baked, "_RANGE_MEMBERS", 7)
    found = fit_course(part)
    sums = course_sums(part)
    torch.testing.assert_close(sums.amplitude.float(), plain_sums.amplitude)
    torch.testing.assert_close(sums.gram, plain_sums.gram, atol=1e-5, rtol=1e-4)
    assert found.residual_basis.shape == plain.residual_basis.shape
    assert torch.equal(found.end, part[-1])
    for s in strengths.tolist():
        fields = [BakedField("separable", strengths, {"sh0": bases}, 14) for bases in (found, plain)]
        values = [field.offsets(s)[:, columns] for field in fields]
        torch.testing.assert_close(values[0], values[1], atol=1e-3 * float(part.abs().max()), rtol=0)


def test_offsets_summed_in_ranges_have_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    strengths, offsets = curved_trajectory(60)
    field = fit_separable(strengths, offsets, {"means": 2, "sh0": 1})
    whole = field.offsets(0.37)
    bases = field.attributes["means"]
    factors = field.factors("means", 0.37)
    plain = factors[0] * bases.end_offset.float() + torch.einsum(
        "rc,rmc->mc", factors[1:], bases.residual_basis.float()
    )
    torch.testing.assert_close(whole[:, :3], plain)
    monkeypatch.setattr(progdf.field.baked, "_RANGE_MEMBERS", 7)
    assert torch.equal(field.offsets(0.37), whole)


def test_lossless_field_can_be_requested() -> None:
    strengths, offsets = curved_trajectory(20)
    chosen = choose_field(strengths, offsets, linear_pictures(20, 14), kind="lossless")
    assert chosen.met
    assert chosen.best.worst > 90
    assert torch.equal(at_snapshots(chosen.best.field, strengths), offsets)


def test_edit_that_moves_nothing_gets_an_empty_field() -> None:
    chosen = choose_field(torch.linspace(0, 1, 5), torch.zeros(5, 9, 14), linear_pictures(9, 14))
    assert chosen.met
    assert chosen.best.field.bytes_per_member == 0


def test_edit_invisible_in_every_view_gets_the_fewest_bytes() -> None:
    strengths, offsets = curved_trajectory(20)
    chosen = choose_field(strengths, offsets, lambda moved: torch.zeros(0, 3))
    assert chosen.met
    assert chosen.best.field.bytes_per_member == 14


def test_expected_error_matches_a_linear_rendering() -> None:
    strengths, offsets = curved_trajectory(40, snapshots=17)
    render = linear_pictures(40, 14)
    seen = render_trajectories(offsets, channel_weights(None, 40, 14), render)
    expected = seen.mse({})
    field = fit_separable(strengths, offsets, {})
    found = [
        float((render(field.offsets(float(s))) - render(o)).square().mean())
        for s, o in zip(strengths, offsets, strict=True)
    ]
    assert torch.allclose(expected, torch.tensor(found, dtype=torch.float64), rtol=1e-3, atol=1e-12)


def test_expected_error_accounts_for_the_kept_bases() -> None:
    _, offsets = curved_trajectory(40, snapshots=17)
    render = linear_pictures(40, 14)
    seen = render_trajectories(offsets, channel_weights(None, 40, 14), render)
    left = torch.zeros_like(offsets)
    for name, columns in attribute_slices(14).items():
        mix = seen.modes[name][:, :1].float()
        residual = seen.trajectories[name].residual.flatten(1)
        left[:, :, columns] = (residual - mix @ (mix.T @ residual)).reshape(left[:, :, columns].shape)
    found = torch.stack([render(o).double().square().mean() for o in left])
    expected = seen.mse(dict.fromkeys(ATTRIBUTES, 1))
    assert torch.allclose(expected, found, rtol=1e-2, atol=1e-9)


def test_bytes_go_to_the_most_visible_attributes_first() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    render = linear_pictures(60, 14)
    evaluator = FieldEvaluator(strengths, offsets, render)
    seen = render_trajectories(offsets, channel_weights(None, 60, 14), render)
    columns = attribute_slices(14)

    def size(ranks: Mapping[str, int]) -> int:
        return sum(rank * (columns[name].stop - columns[name].start) for name, rank in ranks.items())

    ranks = [ranks for ranks in grow_ranks(seen) if size(ranks) <= 6][-1]
    bases = {n: store_attribute(t, seen.modes[n][:, : ranks[n]]) for n, t in seen.trajectories.items()}
    best = evaluator.candidate(BakedField("separable", strengths, bases, 14), "")
    for ranks in ({"means": 2}, {"means": 1, "log_scales": 1}, {"quats": 1, "logit_opacities": 2}):
        other = fit_separable(strengths, offsets, ranks)
        assert best.worst > evaluator.candidate(other, "").worst


def test_all_snapshots_as_keyframes_have_no_error() -> None:
    strengths, offsets = curved_trajectory(20)
    evaluator = FieldEvaluator(strengths, offsets, linear_pictures(20, 14))
    assert min(evaluator.curve(fit_keyframes(strengths, offsets, 9))) > 90


@settings(max_examples=40, deadline=None)
@given(
    members=st.integers(0, 20),
    snapshots=st.integers(2, 8),
    rank=st.integers(0, 9),
    scale=st.sampled_from([1e-20, 1e-6, 1.0, 1e6]),
    seed=st.integers(0, 99),
)
def test_any_trajectory_gives_a_finite_field_with_exact_ends(
    members: int, snapshots: int, rank: int, scale: float, seed: int
) -> None:
    rng = torch.Generator().manual_seed(seed)
    strengths = torch.rand(snapshots, generator=rng).cumsum(0) + torch.arange(snapshots)
    strengths = (strengths - strengths[0]) / (strengths[-1] - strengths[0])
    strengths[-1] = 1.0
    offsets = scale * torch.randn(snapshots, members, 14, generator=rng)
    offsets[:, :, attribute_slices(14)["quats"]] = 0.0
    offsets[0] = 0.0
    field = fit_separable(strengths, offsets, dict.fromkeys(ATTRIBUTES, rank))
    assert torch.equal(field.offsets(1.0), offsets[-1] if members else field.offsets(1.0))
    assert bool(at_snapshots(field, strengths).isfinite().all())
    assert isinstance(next(iter(field.attributes.values()), None), AttributeBases | None)
