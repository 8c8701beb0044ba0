"""Tests of edits that add and remove Gaussians: invisible at strength 0, complete at 1, linear between."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from progdf.cli import rebind
from progdf.compose.added import extend, remaining_rows
from progdf.compose.composer import Composer
from progdf.compose.reference import BLENDS, Gains, Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field import BakedField
from progdf.field.baked import identity_map
from progdf.field.grade import map_colors
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES, Gaussians, attribute_slices
from progdf.gdf.file import Gdf, load_gdf, read_gdf, save_gdf
from progdf.rasterize import render
from tests.helpers.draws import Draws
from tests.helpers.edits import bits, curved_field, edit_of, growing, some_rows, whole_grade
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.scenes import front_camera, random_gaussians

LOGIT = attribute_slices(14)["logit_opacities"]
COUNT = 300


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(COUNT, seed=5, sh_degree=1)


@pytest.fixture(scope="module")
def hat(scene: Gaussians) -> Gdf:
    return growing(scene, some_rows(scene, 40, 1), 25, 7)


def test_added_and_removed_rows_change_nothing_at_zero(scene: Gaussians, hat: Gdf) -> None:
    composed = compose_layers(scene, [Layer(hat, 0.0)])
    assert len(composed) == COUNT + 25
    assert bits(composed[:COUNT]) == bits(scene)
    assert bits(composed[remaining_rows(scene, composed)]) == bits(scene)
    before, after = (render(each, front_camera()).image for each in (scene, composed))
    assert float(before.std()) > 0.01
    # the number of vectorized values depends on the row count, so last bits may differ
    assert float((before - after).abs().max()) <= 1e-6


def test_opacity_of_added_and_removed_rows_is_linear(scene: Gaussians, hat: Gdf) -> None:
    end = compose_layers(scene, [Layer(hat, 1.0)]).opacities
    members = hat.region.members[::2]
    for s in np.linspace(0.0, 1.0, 41):
        opacity = compose_layers(scene, [Layer(hat, float(s))]).opacities
        assert float(opacity[COUNT:].sum() / end[COUNT:].sum()) == pytest.approx(s, abs=0.02)
        assert float(opacity[members].sum() / scene.opacities[members].sum()) == pytest.approx(
            1 - s, abs=0.02
        )


def test_exported_rows_at_one_include_added_and_exclude_removed(scene: Gaussians, hat: Gdf) -> None:
    composed = compose_layers(scene, [Layer(hat, 1.0)])
    rows = remaining_rows(scene, composed)
    faint = scene.logit_opacities < -np.log(254)
    gone = set(hat.region.members[::2].tolist()) - set(faint.nonzero()[:, 0].tolist())
    assert set(range(COUNT + 25)) - set(rows.tolist()) == gone


@pytest.mark.parametrize("blend", BLENDS)
def test_composer_matches_the_reference_on_random_stacks(scene: Gaussians, blend: str) -> None:
    draws = Draws(11)
    gdfs = [
        growing(scene, some_rows(scene, 40, 1), 25, 7),
        edit_of(scene, some_rows(scene, 90, 2), curved_field(90, 2), "shirt"),
        growing(scene, some_rows(scene, 60, 3), 1, 8, "pin"),
    ]
    composer = Composer(scene, gdfs)
    for _ in range(250):
        order = draws.order(3).tolist()
        layers = [
            Layer(
                gdfs[i],
                float(draws.uniform(1)) * 1.2,
                enabled=float(draws.uniform(1)) < 0.8,
                gains=Gains(*draws.uniform(4).tolist()) if float(draws.uniform(1)) < 0.3 else Gains(),
                weights=draws.uniform(gdfs[i].members) if float(draws.uniform(1)) < 0.4 else None,
            )
            for i in order
        ]
        composer.update(layers, blend)
        # the reference appends rows in the order of its layers
        plain = compose_layers(scene, [*(Layer(gdf, 0.0) for gdf in gdfs), *layers], blend)
        assert bits(composer.gaussians) == bits(plain)


def test_extended_scene_composes_like_the_scene_and_its_edits(scene: Gaussians, hat: Gdf) -> None:
    extended, (edit,) = extend(scene, [hat])
    assert bits(compose_layers(extended, [Layer(edit, 0.6)])) == bits(
        compose_layers(scene, [Layer(hat, 0.6)])
    )
    assert extend(extended, [edit])[0] is extended


def test_added_rows_are_saved_exactly_with_their_origin(scene: Gaussians, hat: Gdf, tmp_path: Path) -> None:
    save_gdf(tmp_path / "hat.gdf", hat)
    loaded = load_gdf(tmp_path / "hat.gdf", scene)
    assert loaded.added is not None
    assert hat.added is not None
    assert bits(loaded.added) == bits(hat.added)
    assert bits(compose_layers(scene, [Layer(loaded, 0.4)])) == bits(compose_layers(scene, [Layer(hat, 0.4)]))
    far = replace(hat.added, origin=(1e6, 0.0, -3e5))
    save_gdf(tmp_path / "far.gdf", replace(hat, added=far))
    moved = compose_layers(scene, [Layer(load_gdf(tmp_path / "far.gdf", scene), 0.0)])
    assert torch.equal(moved.means[COUNT:], far.world_means.float())


def test_rebind_carries_added_rows_over(
    scene: Gaussians, hat: Gdf, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    order = Draws(2).order(COUNT)
    save_ply(tmp_path / "a.ply", scene)
    save_ply(tmp_path / "b.ply", scene[order])
    save_gdf(tmp_path / "hat.gdf", hat)
    paths = [f"--from={tmp_path / 'a.ply'}", f"--to={tmp_path / 'b.ply'}"]
    rebind.main([str(tmp_path / "hat.gdf"), *paths, "-o", str(tmp_path / "new.gdf")])
    a = load_ply(tmp_path / "a.ply")
    b = load_ply(tmp_path / "b.ply")
    rebound = compose_layers(b, [Layer(load_gdf(tmp_path / "new.gdf", b), 0.7)])
    original = compose_layers(a, [Layer(hat, 0.7)])
    rows = torch.cat([order, torch.arange(COUNT, COUNT + 25)])
    assert bits(rebound) == bits(original[rows])


def hostile_changes(draws: Draws, tensors: dict[str, torch.Tensor]) -> dict[str, object]:
    """Return one change that a wrong or hostile writer may make."""
    names = sorted(tensors)
    name = names[int(draws.uniform(1) * len(names))]
    tensor = tensors[name]
    size = int(draws.uniform(1) * 60)
    ways: list[dict[str, object]] = [
        {name: None},
        {name: tensor.double()},
        {name: tensor[:size]},
        {name: torch.cat([tensor, tensor])},
        {name: tensor.reshape(-1)},
        {
            name: (tensor.float() + float("nan")).to(tensor.dtype)
            if tensor.is_floating_point()
            else tensor[:0]
        },
        {name: (tensor.float() * 1e30).to(tensor.dtype) if tensor.is_floating_point() else tensor[:0]},
        {"added": size},
        {"added": -1},
        {"added": 10**12},
        {"added": "25"},
        {"added_origin": [0.0]},
        {"added_origin": [1e400, 0.0, 0.0]},
        {"members": size},
        {"added.logit_opacities": torch.full((25,), 2.0)},
        {"added.shN": torch.zeros(25, 2, 3)},
    ]
    return ways[int(draws.uniform(1) * len(ways))]


@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.slow)])
def test_hostile_files_are_refused_in_one_line(
    scene: Gaussians, hat: Gdf, tmp_path: Path, count: int
) -> None:
    path = tmp_path / "hat.gdf"
    save_gdf(path, hat)
    content = path.read_bytes()
    tensors = safetensors.torch.load(content)
    draws = Draws(count)
    refused = 0
    for _ in range(count):
        header = header_of(content)
        parts = dict(tensors)
        for key, value in hostile_changes(draws, tensors).items():
            target: dict[str, object] = header if key in header else parts  # type: ignore[assignment]
            if value is None:
                del target[key]
            else:
                target[key] = value
        path.write_bytes(signed_gdf(header, parts))
        line = ""
        try:
            composed = compose_layers(scene, [Layer(load_gdf(path, scene), 0.5)])
            assert all(bool(torch.isfinite(getattr(composed, name)).all()) for name in ATTRIBUTES)
        except ProgdfError as error:
            line = str(error)
            refused = refused + 1
        assert "\n" not in line
    assert refused > count / 2


def test_added_rows_visible_at_zero_are_refused(scene: Gaussians, hat: Gdf) -> None:
    assert hat.added is not None
    shown = replace(hat.added, logit_opacities=torch.full((25,), -5.0))
    with pytest.raises(ValueError, match="is visible at strength 0"):
        replace(hat, added=shown)


def test_field_without_members_for_the_added_rows_is_refused(scene: Gaussians, hat: Gdf) -> None:
    with pytest.raises(ValueError, match="25 rows are added"):
        replace(hat, field=curved_field(40))
    with pytest.raises(ValueError, match="25 rows are added"):
        replace(hat, field=BakedField("separable", torch.tensor([0.0, 1.0]), {}, 14))


def test_info_counts_the_added_rows(hat: Gdf, tmp_path: Path) -> None:
    save_gdf(tmp_path / "hat.gdf", hat)
    assert read_gdf(tmp_path / "hat.gdf").members == 65


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("first", [True, False])
def test_scene_grade_also_reaches_rows_added_by_other_layers(
    scene: Gaussians, hat: Gdf, blend: str, first: bool
) -> None:
    dark = whole_grade(scene)
    gdfs = [dark, hat] if first else [hat, dark]
    alone = compose_layers(scene, [Layer(hat, 1.0)])
    for s in (0.3, 1.0):
        layers = [Layer(gdf, s if gdf is dark else 1.0) for gdf in gdfs]
        both = compose_layers(scene, layers, blend)
        taken = round(255 * (2 + 230 / 255) / 3) / 255
        expected = torch.lerp(
            alone.sh[COUNT:], map_colors(alone.sh[COUNT:], identity_map(1) * (1 - s / 2), 1), taken
        )
        torch.testing.assert_close(both.sh[COUNT:], expected, atol=2e-3, rtol=0)
        assert torch.equal(both.logit_opacities[COUNT:], alone.logit_opacities[COUNT:]), (
            "it hides none of them"
        )
        assert torch.equal(both.means[COUNT:], alone.means[COUNT:])
        composer = Composer(scene, gdfs)
        composer.update(layers, blend)
        assert bits(composer.gaussians) == bits(both)
        composer.update([Layer(gdfs[0], 0.0), Layer(gdfs[1], 0.0)], blend)
        assert bits(composer.gaussians[:COUNT]) == bits(scene)


def test_average_shares_only_the_attributes_that_both_layers_change(scene: Gaussians) -> None:
    dark = whole_grade(scene)
    shirt = edit_of(scene, torch.arange(90), curved_field(90, 2), "shirt")
    both = compose_layers(scene, [Layer(shirt, 1.0), Layer(dark, 1.0)], "normalized")
    alone, graded = (compose_layers(scene, [Layer(edit, 1.0)]) for edit in (shirt, dark))
    for name in ("means", "log_scales", "quats", "logit_opacities"):
        assert torch.equal(getattr(both, name), getattr(alone, name)), name
    shared = (alone.sh0 + graded.sh0)[:90] / 2
    torch.testing.assert_close(both.sh0[:90], shared, atol=1e-5, rtol=0)
    assert torch.equal(both.sh0[90:], graded.sh0[90:])
