"""Members that no picture shows: found by what leaving them changes, left out, and told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from progdf.field import BakedField, Candidate, FieldJudge, NeuralSettings, baked_neural, fit_neural
from progdf.field.active import PIXEL, Pictures, invisible_members, resting, without
from progdf.field.rendered import Render
from progdf.gaussians import pack
from progdf.rasterize import render
from progdf.region import Region
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.edits import curved_field, curved_trajectory, linear_pictures
from tests.helpers.scenes import random_gaussians
from trainer.fit.active import drop_invisible
from trainer.fit.fit import Fitted

STRENGTHS = (0.5, 1.0)


def one_view(shown: Render) -> Pictures:
    return lambda offsets: [shown(offsets)]


def largest_change(field: BakedField, gone: torch.Tensor, shown: Render) -> float:
    left = resting(field, gone)
    return max(float((shown(field.offsets(s)) - shown(left.offsets(s))).abs().max()) for s in STRENGTHS)


def test_members_that_no_picture_shows_are_found() -> None:
    field, shown = curved_field(60), linear_pictures(60, 14)  # every other one does not show
    effect = torch.ones(60)
    effect[::2] = 0.0
    found = invisible_members(field, effect, one_view(shown), STRENGTHS)
    assert found.gone.nonzero()[:, 0].tolist() == list(range(0, 60, 2))
    assert found.largest == 0.0


def test_no_picture_changes_by_more_than_is_allowed_and_one_more_would() -> None:
    field, shown = curved_field(60), linear_pictures(60, 14)
    effect = torch.arange(60.0)
    found = invisible_members(field, effect, one_view(shown), STRENGTHS, most=0.2)
    assert 1 < int(found.gone.sum()) < 60
    assert found.largest == pytest.approx(largest_change(field, found.gone, shown))
    assert found.largest <= 0.2
    one_more = found.gone.clone()
    one_more[int(found.gone.sum())] = True
    assert largest_change(field, one_more, shown) > 0.2


def test_pictures_at_every_strength_count() -> None:
    field = curved_field(9)

    def only_half_way(offsets: torch.Tensor) -> Sequence[torch.Tensor]:
        half = float((offsets - field.offsets(0.5)).abs().max()) < 1e-3 or not bool(offsets.any())
        return [offsets if half else torch.zeros_like(offsets)]

    found = invisible_members(field, torch.zeros(9), only_half_way, STRENGTHS)
    assert not bool(found.gone.all())


def test_all_members_go_where_nothing_shows() -> None:
    found = invisible_members(
        curved_field(9), torch.ones(9), lambda offsets: [torch.zeros(4, 4, 3)], STRENGTHS
    )
    assert bool(found.gone.all())


def test_fields_without_them_are_the_same_for_all_others() -> None:
    field = curved_field(30)
    gone = torch.arange(30) % 3 == 0
    rest, fewer = resting(field, gone), without(field, gone)
    for s in (0.0, 0.37, 1.0):
        whole = field.offsets(s)
        assert torch.equal(fewer.offsets(s), whole[~gone])
        assert torch.equal(rest.offsets(s)[~gone], whole[~gone])
        assert not bool(rest.offsets(s)[gone].any())
    assert fewer.bytes_per_member == field.bytes_per_member


def test_a_network_keeps_its_members() -> None:
    strengths, offsets = curved_trajectory(6, snapshots=3)
    rows = torch.zeros(6, 14)
    network = fit_neural(strengths, offsets, rows, NeuralSettings("tiny", steps=1))
    with pytest.raises(ValueError, match="a network holds all its members"):
        without(baked_neural(network, rows), torch.ones(6, dtype=torch.bool))


def test_what_lies_inside_a_body_is_dropped_and_the_figures_tell() -> None:
    scene = random_gaussians(300, seed=4)
    shell = scene.means / scene.means.norm(dim=1, keepdim=True)
    inside = torch.arange(300) < 40
    means = torch.where(inside[:, None], 0.01 * shell, shell)
    log_scales = torch.where(inside[:, None], torch.tensor(-6.0), torch.tensor(-1.2)).expand(300, 3)
    scene = replace(scene, means=means, log_scales=log_scales, logit_opacities=torch.full((300,), 12.0))
    members = torch.arange(300)
    field = curved_field(300, moving=("sh0",))
    cameras = orbit_rig(scene, 4, 48, 48)
    strengths, offsets = curved_trajectory(300, moving=("sh0",))

    def counted(moved: torch.Tensor) -> torch.Tensor:
        edited = scene.replace_rows(members, pack(scene) + moved)
        return torch.cat([render(edited, camera).reshape(-1, 3) for camera in cameras])

    errors = FieldJudge(strengths, offsets, counted)
    chosen: Candidate = errors.candidate(field, "sh0")
    fitted = Fitted(chosen, True, (chosen,), {}, "")
    dropped = drop_invisible(scene, members, cameras, fitted, errors, STRENGTHS)
    assert not bool(dropped.kept[inside].any())
    assert 40 <= dropped.count < 150
    assert dropped.largest <= PIXEL
    region = dropped.region(Region("all", members, torch.ones(300)))
    assert len(region) == 300 - dropped.count == dropped.field(field).members
    told = dropped.figures()
    assert (told["members"], told["of"]) == (dropped.count, 300)
    assert told["bytes"] == round(dropped.count * field.bytes_per_member)
    assert f"dropped {dropped.count} of 300 members that no view shows" in dropped.line()
