"""Tests of grades: one color map per region plus a small residual, and nothing else in the file."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field.baked import (
    MONOMIALS,
    GradeForm,
    SliderRemap,
    identity_map,
    identity_remap,
    remap_slider,
    unpack_levels,
)
from progdf.field.grade import (
    MAX_COLOR,
    RESIDUAL_STEPS,
    ResidualBases,
    bake_grade,
    band_offsets,
    fit_grade,
    lattice_form,
    map_colors,
    map_colors_along,
    mapped_bands,
    member_bands,
    monomials,
    residual_bases,
)
from progdf.formats.cube import read_cube, write_cube
from progdf.gaussians import Gaussians, attribute_slices, pack
from progdf.gdf.file import apply_grade, load_gdf, read_gdf, save_gdf
from progdf.io.tensors import deflate
from progdf.region import from_mask, whole_scene
from progdf.sh import C0, basis
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.scenes import random_gaussians

KNOTS = torch.tensor([0.0, 0.4, 1.0])


def some_table(degree: int, strength: float = 1.0, seed: int = 1) -> Tensor:
    """Return a map that mixes the channels, and bends them if its degree allows it."""
    draws = torch.Generator().manual_seed(seed)
    return identity_map(degree) + strength * 0.2 * torch.randn(MONOMIALS[degree], 3, generator=draws)


def some_form(rows: Tensor, degree: int = 2, bands: int = 1, rank: int = 2) -> GradeForm:
    """Return a grade of these members with a random residual."""
    draws = torch.Generator().manual_seed(4)
    table = torch.stack([some_table(degree, float(s)) for s in KNOTS])
    residual = 0.1 * torch.randn(2, len(rows), 3 * bands, generator=draws)
    residual = torch.stack([torch.zeros_like(residual[0]), 0.5 * residual[0], residual[1]])
    return fit_grade(KNOTS, degree, table, residual, rank, torch.ones(len(rows)))


def directions(count: int = 300) -> Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(7)), dim=1
    )


def drawn(sh: Tensor, toward: Tensor) -> Tensor:
    """Return the rendered colors from each direction. [M,B,3], [D,3] -> [M,D,3]"""
    values = basis(int(sh.shape[1] ** 0.5) - 1, toward)
    return (torch.einsum("db,mbc->mdc", values, sh) + 0.5).clamp_min(0.0)


def polynomial(colors: Tensor, table: Tensor, degree: int) -> Tensor:
    """Return the colors after the map. [...,3] -> [...,3]"""
    return torch.einsum("k...,kc->...c", monomials(colors.movedim(-1, 0), degree), table)


@pytest.mark.parametrize("degree", MONOMIALS)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_identity_map_changes_no_bit(degree: int, sh_degree: int) -> None:
    sh = member_bands(pack(random_gaussians(50, sh_degree=sh_degree), with_shN=sh_degree > 0))
    assert torch.equal(map_colors(sh, identity_map(degree), degree), sh)
    assert monomials(torch.rand(3, 4, 5), degree).shape == (MONOMIALS[degree], 4, 5)


@pytest.mark.parametrize("degree", MONOMIALS)
def test_map_of_a_region_without_bands_is_exact_as_rendered(degree: int) -> None:
    sh = member_bands(pack(random_gaussians(200), with_shN=False))
    table = some_table(degree)
    colors = sh[:, 0] * C0 + 0.5
    expected = polynomial(colors.clamp(0.0, MAX_COLOR), table, degree) + (colors - MAX_COLOR).clamp_min(0.0)
    found = map_colors(sh, table, degree)[:, 0] * C0 + 0.5
    torch.testing.assert_close(found.clamp_min(0.0), expected.clamp_min(0.0), atol=2e-6, rtol=0)


@pytest.mark.parametrize("sh_degree", [1, 2, 3])
def test_linear_map_of_unclamped_colors_is_exact_from_every_side(sh_degree: int) -> None:
    sh = 0.1 * member_bands(pack(random_gaussians(80, sh_degree=sh_degree), with_shN=True))
    table = torch.tensor([[0.1, 0.0, 0.05], [0.5, 0.2, 0.0], [0.1, 0.6, 0.1], [0.0, 0.1, 0.7]])
    expected = polynomial(drawn(sh, directions()), table, 1)
    found = drawn(map_colors(sh, table, 1), directions())
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)


def test_clamped_colors_are_closer_than_a_least_squares_fit() -> None:
    sh = member_bands(pack(random_gaussians(300, sh_degree=2), with_shN=True))
    table = some_table(1, 0.3)
    toward = directions()
    before = drawn(sh, toward)
    assert float((before <= 0.0).float().mean()) > 0.05
    bright = before.clamp_max(MAX_COLOR)
    expected = (polynomial(bright, table, 1) + before - bright).clamp_min(0.0)
    values = basis(2, toward)
    plain = torch.stack([torch.linalg.lstsq(values, wanted - 0.5).solution for wanted in expected])
    mapped = map_colors(sh, table, 1)
    errors = [float((drawn(some, toward) - expected).square().mean()) for some in (mapped, plain)]
    assert errors[0] < errors[1], errors


def some_mask(members: int) -> Tensor:
    """Return shares of a map, from none to all. [M] uint8"""
    return torch.linspace(0, 255, members).round().to(torch.uint8)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 2])
def test_grade_file_restores_the_field_in_at_most_a_byte_per_value(
    tmp_path: Path, sh_degree: int, masked: bool
) -> None:
    scene = random_gaussians(400, sh_degree=sh_degree)
    members = some_rows(scene, 150)
    rows = pack(scene[members], with_shN=sh_degree > 0)
    form = some_form(rows, bands=4 if sh_degree else 1)
    form = replace(form, mask=some_mask(len(rows))) if masked else form
    field = bake_grade(form, rows)
    gdf = edit_of(scene, members, field)
    save_gdf(tmp_path / "edit.gdf", gdf)
    again = load_gdf(tmp_path / "edit.gdf", scene)
    assert again.field.kind == "grade"
    numbers = 2 * 3 * (4 if sh_degree else 1) + masked
    assert numbers / 2 < field.bytes_per_member < numbers + 0.5, "they are drawn: hardly any repeats"
    for s in (0.0, 0.3, 0.7, 1.0):
        assert torch.equal(again.field.offsets(s), field.offsets(s))
    assert not bool(field.offsets(0.0).any())
    stored = read_gdf(tmp_path / "edit.gdf").field.origin
    assert isinstance(stored, GradeForm)
    assert torch.equal(stored.residual, form.residual)
    assert (stored.mask is not None) == masked
    with pytest.raises(ProgdfError, match="keeps a grade field, which is baked on its scene"):
        load_gdf(tmp_path / "edit.gdf")


@pytest.fixture
def packed(tmp_path: Path) -> tuple[dict[str, object], dict[str, Tensor], GradeForm]:
    """Return the header, the tensors and the grade of a file of 150 members."""
    scene = random_gaussians(400)
    members = some_rows(scene, 150)
    rows = pack(scene[members], with_shN=False)
    form = replace(some_form(rows), mask=some_mask(150))
    save_gdf(tmp_path / "edit.gdf", edit_of(scene, members, bake_grade(form, rows)))
    content = (tmp_path / "edit.gdf").read_bytes()
    return header_of(content), safetensors.torch.load(content), form


def test_grade_file_of_format_6_gives_the_same_grade(
    packed: tuple[dict[str, object], dict[str, Tensor], GradeForm], tmp_path: Path
) -> None:
    header, tensors, form = packed
    del tensors["functions.packed"]
    older = tensors | {"residual.packed": deflate(form.residual.movedim(2, 1))}
    (tmp_path / "older.gdf").write_bytes(signed_gdf(header | {"format": 6}, older))
    stored = read_gdf(tmp_path / "older.gdf").field.origin
    assert isinstance(stored, GradeForm)
    assert torch.equal(stored.residual, form.residual)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_functions_missing_in_members_take_no_levels(share: float) -> None:
    draws = torch.Generator().manual_seed(2)
    levels = torch.randint(-90, 90, (2, 999, 9, 3), generator=draws, dtype=torch.int8)
    levels[:, :, 1:] *= torch.rand(999, 8, 1, generator=draws) < share
    knots = torch.tensor([0.0, 1.0])
    table = torch.stack([identity_map(1), some_table(1)])
    scale = torch.ones(2, 27)
    coefficients = torch.tensor([[0.0, 0.0], [1.0, 0.5]])
    form = GradeForm(1, knots, table, levels.flatten(2), scale, coefficients)
    packed = form.packed_levels
    assert torch.equal(unpack_levels(packed["functions"], packed["residual"], 2, 999, 27), form.residual)
    assert form.bytes_per_member < 1.02 * (6 + 48 * share) + 1.0


def test_grade_file_of_format_5_gives_the_same_grade(
    packed: tuple[dict[str, object], dict[str, Tensor], GradeForm], tmp_path: Path
) -> None:
    header, tensors, form = packed
    assert form.mask is not None
    assert not {"residual", "mask"} & set(tensors)
    tensors = {name: tensor for name, tensor in tensors.items() if not name.endswith(".packed")}
    older = tensors | {"residual": form.residual, "mask": form.mask}
    (tmp_path / "older.gdf").write_bytes(signed_gdf(header | {"format": 5}, older))
    stored = read_gdf(tmp_path / "older.gdf").field.origin
    assert isinstance(stored, GradeForm)
    assert stored.mask is not None
    assert torch.equal(stored.residual, form.residual)
    assert torch.equal(stored.mask, form.mask)


@pytest.mark.parametrize(
    "wrong",
    [
        {"residual.packed": torch.zeros(20, dtype=torch.uint8)},
        {"residual.packed": deflate(torch.zeros(899, dtype=torch.int8))},
        {"functions.packed": torch.zeros(20, dtype=torch.uint8)},
        {"functions.packed": deflate(torch.zeros(18, dtype=torch.uint8))},
        {"functions.packed": deflate(torch.zeros(19, dtype=torch.uint8))},
        {"residual.packed": deflate(torch.zeros(1 << 22, dtype=torch.int8))},
        {"residual.packed": deflate(torch.zeros(900, dtype=torch.int8)).short()},
        {"mask.packed": deflate(torch.zeros(149, dtype=torch.uint8))},
        {"scale": torch.ones(1 << 20, 3), "coefficients": torch.zeros(3, 1 << 20)},
        {"scale": torch.ones(3)},
    ],
)
def test_packed_levels_of_a_wrong_count_are_refused(
    packed: tuple[dict[str, object], dict[str, Tensor], GradeForm], tmp_path: Path, wrong: dict[str, Tensor]
) -> None:
    header, tensors, _ = packed
    (tmp_path / "wrong.gdf").write_bytes(signed_gdf(header, tensors | wrong))
    with pytest.raises(ProgdfError, match="is inconsistent"):
        read_gdf(tmp_path / "wrong.gdf")


def test_coarser_levels_take_fewer_bytes_and_err_by_at_most_a_step() -> None:
    rows = pack(random_gaussians(2000), with_shN=False)
    draws = torch.Generator().manual_seed(4)
    residual = torch.zeros(2, len(rows), 3)
    residual[1] = 0.1 * torch.randn(len(rows), 3, generator=draws).clamp(-2, 2)
    table = torch.stack([identity_map(1), some_table(1)])
    forms = {
        k: fit_grade(torch.tensor([0.0, 1.0]), 1, table, residual, 1, torch.ones(len(rows)), coarser=k)
        for k in RESIDUAL_STEPS
    }
    sizes = [form.bytes_per_member for form in forms.values()]
    assert sizes[::2] == sorted(sizes[::2], reverse=True)
    assert all(b < 1.005 * a for a, b in pairwise(sizes)), "a twelfth is less than zlib's own ups and downs"
    assert sizes[-1] < 0.7 * sizes[0], "of some 7.9 bits three go"
    for k, form in forms.items():
        found = torch.einsum("r,rmc->mc", form.coefficients[1], form.residual * form.scale[:, None])
        assert float((found - residual[1]).abs().max()) < k * 0.2 / 127


def test_members_beyond_eight_bits_get_extra_bases() -> None:
    rows = pack(random_gaussians(4000), with_shN=False)
    residual = torch.zeros(2, len(rows), 3)
    residual[1] = 0.05 * torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(4)).clamp(-2, 2)
    residual[1, :3] *= 0.19 / residual[1, :3].abs().clamp_min(1e-3)
    table = torch.stack([identity_map(1), some_table(1)])
    form = fit_grade(torch.tensor([0.0, 1.0]), 1, table, residual, 1, torch.ones(len(rows)))
    assert len(form.residual) == 2
    assert form.residual[1].any(dim=1).nonzero()[:, 0].tolist() == [0, 1, 2]
    found = torch.einsum("r,rmc->mc", form.coefficients[1], form.residual * form.scale[:, None])
    assert float((found - residual[1]).abs().max()) < 1.1 * 0.1 / 127 / 2


def test_both_ends_match_the_stored_grade(tmp_path: Path) -> None:
    scene = random_gaussians(300, sh_degree=1)
    members = some_rows(scene, 120)
    rows = pack(scene[members], with_shN=True)
    form = some_form(rows)
    field = bake_grade(form, rows)
    change = torch.einsum("r,rmc->mc", form.coefficients[-1], form.residual * form.scale[:, None])
    mapped = map_colors(member_bands(rows), form.table[-1], 2) - member_bands(rows)
    mapped[:, :1] += change[:, None]
    assert torch.equal(field.offsets(1.0), band_offsets(mapped, rows.shape[1]))
    edited = compose_layers(scene, [Layer(edit_of(scene, members, field), 0.0)])
    assert torch.equal(edited.sh, scene.sh)


def test_grade_between_knots_is_the_map_and_its_residual() -> None:
    rows = pack(random_gaussians(500, sh_degree=2), with_shN=True)
    form = some_form(rows, bands=4)
    field = bake_grade(form, rows)
    expected = mapped_bands(form, rows)
    expected[:, :, :12] += torch.einsum("sr,rmc->smc", form.coefficients, form.residual * form.scale[:, None])
    found = torch.stack([member_bands(field.offsets(float(s))).flatten(1) for s in KNOTS])
    error = float((found - expected).square().mean().sqrt() / expected.square().mean().sqrt())
    assert error < 0.01


def test_mask_scales_the_map_per_member() -> None:
    rows = pack(random_gaussians(200, sh_degree=1), with_shN=True)
    whole = some_form(rows, rank=0)
    form = replace(whole, mask=some_mask(200))
    assert form.label == "grade of degree 2, a mask, no residual"
    share = (torch.arange(200) / 199 * 255).round()[:, None] / 255
    expected = share * bake_grade(whole, rows).offsets(1.0)
    found = bake_grade(form, rows).offsets(1.0)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    assert not bool(found[0].any()), "none of it"
    full = replace(whole, mask=torch.full((200,), 255, dtype=torch.uint8))
    assert torch.equal(bake_grade(full, rows).offsets(0.7), bake_grade(whole, rows).offsets(0.7))
    for mask in (torch.zeros(199, dtype=torch.uint8), torch.zeros(200)):
        with pytest.raises(ValueError, match=r"mask is .*, expected \[200\] uint8"):
            replace(whole, mask=mask)


def test_outlier_members_do_not_coarsen_the_others() -> None:
    members = 5000
    residual = torch.zeros(2, members, 3)
    residual[1] = 0.1 * torch.rand(members, 3, generator=torch.Generator().manual_seed(2))
    residual[1, :3] = 30.0
    table = torch.stack([identity_map(1), some_table(1)])
    form = fit_grade(torch.tensor([0.0, 1.0]), 1, table, residual, 1, torch.ones(members))
    found = form.coefficients[1, 0] * form.residual[0] * form.scale[0]
    assert float((found[3:] - residual[1, 3:]).abs().max()) < 0.001


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, 4])
def test_rendered_bands_are_read_from_and_written_to_their_columns(sh_degree: int) -> None:
    scene = random_gaussians(40, sh_degree=sh_degree)
    rows = pack(scene, with_shN=sh_degree > 0)
    bands = member_bands(rows)
    columns = attribute_slices(rows.shape[1])
    assert torch.equal(bands, scene.sh[:, :16])
    for count in {1, bands.shape[1]}:
        offsets = band_offsets(bands[:, :count], rows.shape[1])
        assert torch.equal(offsets[:, columns["sh0"]], scene.sh0)
        assert torch.equal(member_bands(offsets)[:, :count], bands[:, :count])
        assert int(offsets.any(dim=0).sum()) == 3 * count


def test_remapped_slider_is_kept_by_the_file(tmp_path: Path) -> None:
    scene = random_gaussians(300)
    members = some_rows(scene, 120)
    rows = pack(scene[members], with_shN=False)
    even = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    remap = SliderRemap(torch.tensor([0.0, 0.2, 1.0], dtype=torch.float64), even)
    plain = bake_grade(some_form(rows), rows)
    field = remap_slider(plain, remap)
    save_gdf(tmp_path / "edit.gdf", edit_of(scene, members, field))
    again = load_gdf(tmp_path / "edit.gdf", scene).field
    assert again.recorded == field.recorded
    for s in (0.1, 0.5, 0.8, 1.0):
        assert torch.equal(again.offsets(s), field.offsets(s))
    torch.testing.assert_close(field.offsets(0.5), plain.offsets(0.2), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"degree": 4}, "grade has degree 4"),
        ({"degree": 3}, "table is"),
        ({"table": torch.zeros(3, 10, 3)}, "must be the identity"),
        ({"knots": torch.tensor([0.0, 0.5, 0.5])}, "knots must"),
        ({"knots": torch.tensor([0.0, 0.5, 0.4, 1.0])}, "table is"),
        ({"coefficients": torch.ones(3, 2)}, "residual 0 at strength 0"),
        ({"residual": torch.zeros(2, 120, 5, dtype=torch.int8)}, "scale is"),
        ({"residual": torch.zeros(2, 120, 3)}, "expected .* int8"),
    ],
)
def test_inconsistent_parts_are_refused(change: dict[str, object], message: str) -> None:
    form = some_form(pack(random_gaussians(120), with_shN=False))
    with pytest.raises(ValueError, match=message):
        replace(form, **change)  # type: ignore[arg-type]


def test_grade_with_more_bands_than_the_scene_is_refused() -> None:
    scene: Gaussians = random_gaussians(60)
    rows = pack(scene, with_shN=False)
    with pytest.raises(ValueError, match="grade of 60 members does not fit 60"):
        bake_grade(some_form(rows, bands=4), rows)
    assert identity_remap().is_identity


def some_lattice(side: int = 5) -> GradeForm:
    return lattice_form(torch.rand(side**3, 3, generator=torch.Generator().manual_seed(side)))


@pytest.mark.parametrize("form", ["degree 2", "lattice"])
@pytest.mark.parametrize("sh_degree", [0, 2])
def test_grade_of_another_scene_maps_the_colors_of_this_scene(
    tmp_path: Path, form: str, sh_degree: int
) -> None:
    scene = random_gaussians(300, sh_degree=sh_degree)
    other = random_gaussians(90, seed=5)
    rows = pack(other[torch.arange(40)], with_shN=False)
    grade = some_lattice() if form == "lattice" else some_form(rows)
    if form == "lattice":
        write_cube(tmp_path / "look.cube", grade.table[1], "look")
        path = tmp_path / "look.cube"
        grade = replace(grade, table=torch.stack([grade.table[0], read_cube(path)]))
    else:
        path = tmp_path / "look.gdf"
        save_gdf(path, edit_of(other, torch.arange(40), bake_grade(grade, rows)))
    region = from_mask("some", torch.arange(300) % 3 == 0)
    gdf = load_gdf(path, scene, place=lambda stored: region)
    assert (gdf.applied, gdf.region.name, gdf.field.recorded) == (True, "some", ())
    assert gdf.report == {"left_out": "" if form == "lattice" else "residual"}
    edited = compose_layers(scene, [Layer(gdf, 1.0)])
    expected = map_colors(scene.sh[region.members], grade.table[-1], grade.degree)
    torch.testing.assert_close(edited.sh[region.members], expected, atol=2e-6, rtol=0)
    assert compose_layers(scene, [Layer(gdf, 0.0)]) is scene
    save_gdf(tmp_path / "bound.gdf", gdf)
    again = load_gdf(tmp_path / "bound.gdf", scene)
    assert not again.applied
    assert torch.equal(again.field.offsets(0.7), gdf.field.offsets(0.7))


def test_only_a_bounded_grade_applies_to_a_foreign_region(tmp_path: Path) -> None:
    scene, other = random_gaussians(300), random_gaussians(90, seed=5)
    save_gdf(tmp_path / "bent.gdf", edit_of(other, torch.arange(12), curved_field(12), "bent"))
    with pytest.raises(ProgdfError, match="bent is not a grade: its field is separable"):
        load_gdf(tmp_path / "bent.gdf", scene, place=lambda stored: whole_scene(scene))
    rows = pack(other[torch.arange(40)], with_shN=False)
    form = some_form(rows)
    look = edit_of(other, torch.arange(40), bake_grade(form, rows), "look")
    save_gdf(tmp_path / "look.gdf", look)
    wild = replace(form, table=form.table * torch.tensor([1.0, 1.0, 1e30])[:, None, None])
    absurd = replace(look, field=replace(look.field, origin=wild))
    with pytest.raises(ProgdfError, match="farther than any scene reaches"):
        apply_grade(absurd, scene, whole_scene(scene))
    with pytest.raises(ProgdfError, match="look has no Gaussians"):
        load_gdf(tmp_path / "look.gdf", scene, place=lambda stored: from_mask("", torch.zeros(300) > 0))
    with pytest.raises(
        ProgdfError, match="its grade can be applied to any scene with --region look=all"
    ) as refused:
        load_gdf(tmp_path / "look.gdf", scene)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("spoilt", ["rows", "knots", "identity"])
def test_invalid_lattice_is_refused(spoilt: str) -> None:
    good = some_lattice(3)
    tables = {"rows": good.table[:, :26], "identity": good.table.flip(0), "knots": good.table[[0, 0, 1]]}
    knots = KNOTS if spoilt == "knots" else good.knots
    with pytest.raises(ValueError, match=r"lattice|identity"):
        replace(good, knots=knots, table=tables[spoilt], coefficients=torch.zeros(len(knots), 0))


def test_bases_made_one_at_a_time_match_those_made_at_once() -> None:
    course = torch.randn(6, 5000, 12, generator=torch.Generator().manual_seed(5))
    course[0] = 0.0
    weights = torch.rand(5000, generator=torch.Generator().manual_seed(6))
    bases = ResidualBases.of(course, weights)
    for rank in (2, 0, 4):
        exact, largest = bases.first(rank)
        expected, expected_largest = residual_bases(course, rank, weights)
        torch.testing.assert_close(exact, expected, atol=1e-5, rtol=0)
        assert largest == pytest.approx(expected_largest)


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("degree", [1, 3])
def test_maps_of_all_knots_at_once_match_single_ones(degree: int, sh_degree: int) -> None:
    sh = member_bands(pack(random_gaussians(300, sh_degree=sh_degree), with_shN=sh_degree > 0))
    tables = torch.stack([identity_map(degree), some_table(degree, 0.4), some_table(degree)])
    expected = torch.stack([map_colors(sh, table, degree) for table in tables])
    assert torch.equal(map_colors_along(sh, tables, degree), expected)
