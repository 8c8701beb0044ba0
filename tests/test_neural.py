"""The neural field: exact where it must be, the same every time, small on disk, and baked to run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import safetensors.torch
import torch
from edits import curved_trajectory, edit_of, some_rows
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes import random_gaussians
from torch import Tensor

from progdf.checkpoint import Gdf, _checksum, load_gdf, open_gdf, save_gdf
from progdf.compose import compose
from progdf.errors import ProgdfError
from progdf.field import BakedField, NeuralField, NeuralSettings, baked_neural, fit_neural, position_floor
from progdf.field.bake import NeuralForm, bake_nodes
from progdf.field.judge import FieldJudge
from progdf.field.neural import NeuralShape, course
from progdf.field.neural_fit import NeuralFit, rendered_importance, trained
from progdf.gaussians import ATTRIBUTES, Gaussians, attribute_slices, pack
from progdf.layers import Layer

MEMBERS = 40
SHORT = NeuralSettings(steps=40, batch=64, code=3)
FORMS = {
    "own": SHORT,
    "own, hard bins": replace(SHORT, bins="hard"),
    "position": replace(SHORT, inputs="position", code=0),
    "position, hard bins": replace(SHORT, inputs="position", code=0, bins="hard"),
}


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Layers this small gain nothing from two, which wait for each other on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@cache
def scene() -> Gaussians:
    return random_gaussians(300, seed=1, sh_degree=1)


@cache
def members() -> Tensor:
    return some_rows(scene(), MEMBERS)


def rows() -> Tensor:
    return pack(scene()[members()])


@cache
def network(form: str = "own", moving: tuple[str, ...] = ("means", "sh0")) -> NeuralField:
    strengths, offsets = curved_trajectory(MEMBERS, moving=moving)
    return fit_neural(strengths, offsets, rows(), FORMS[form])


@cache
def baked(form: str = "own") -> BakedField:
    return baked_neural(network(form), rows())


def smooth_trajectory(places: Tensor) -> tuple[Tensor, Tensor]:
    """Strengths and offsets of members whose colours change as a smooth function of their place."""
    strengths = torch.linspace(0, 1, 9)
    offsets = torch.zeros(9, len(places), 14)
    wave = torch.sin(places)
    bend = torch.cos(places)
    offsets[:, :, 11:14] = (
        strengths[:, None, None] * wave + torch.sin(torch.pi * strengths)[:, None, None] * bend
    )
    offsets[0], offsets[-1, :, 11:14] = 0.0, wave
    return strengths, offsets


# ---- the network's own answer


@pytest.mark.parametrize("form", FORMS)
def test_a_network_answers_exactly_zero_at_zero(form: str) -> None:
    assert not bool(network(form).bound(rows()).offsets(0.0).any())


@pytest.mark.parametrize("form", FORMS)
def test_no_answer_of_the_network_moves_anything_at_zero(form: str) -> None:
    shape = network(form).shape
    wild = torch.full((5, 6), 1e6)
    assert not bool(course(shape, torch.zeros(5), wild, wild).any())


@pytest.mark.parametrize("form", ["own", "position"])
def test_interpolated_bins_leave_no_jump(form: str) -> None:
    field = network(form).bound(rows())
    whole = float((field.offsets(1.0) - field.offsets(0.0)).abs().max())
    for edge in torch.arange(11) / 10:
        step = field.offsets(float(edge) + 1e-4) - field.offsets(max(0.0, float(edge) - 1e-4))
        assert float(step.abs().max()) < 0.02 * whole


def test_hard_bins_stand_still_and_jump() -> None:
    field = network("position, hard bins").bound(rows())
    assert torch.equal(field.offsets(0.31), field.offsets(0.39))
    assert torch.equal(field.offsets(1e-6), field.offsets(0.099))  # the paper's s = 0 and s = 0.1 are one
    assert float((field.offsets(0.401) - field.offsets(0.399)).abs().max()) > 1e-3


def test_a_network_that_keeps_the_end_meets_it_by_itself() -> None:
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    assert torch.equal(network().bound(rows()).offsets(1.0), offsets[-1])


def test_only_attributes_that_move_have_outputs() -> None:
    shape = network().shape
    assert shape.attributes == ("means", "sh0")
    assert network().tensors["heads.weight"].shape[0] == 6
    packed = network().bound(rows()).offsets(0.5)
    still = [columns for name, columns in attribute_slices(14).items() if name not in shape.attributes]
    assert not any(bool(packed[:, columns].any()) for columns in still)


def test_the_same_seed_gives_the_same_network_and_another_seed_another() -> None:
    strengths, offsets = curved_trajectory(MEMBERS)
    found = [fit_neural(strengths, offsets, rows(), replace(SHORT, seed=seed)) for seed in (0, 0, 1)]
    same = [
        torch.equal(found[0].tensors[name], other.tensors[name])
        for other in found[1:]
        for name in ("control",)
    ]
    assert same == [True, False]
    assert all(torch.equal(tensor, found[1].tensors[name]) for name, tensor in found[0].tensors.items())
    assert torch.equal(found[0].codes, found[1].codes)


def test_training_brings_the_network_to_the_trajectory() -> None:
    strengths, offsets = smooth_trajectory(scene().means[members()])
    errors = []
    for steps in (1, 300):
        given = NeuralSettings(inputs="position", steps=steps, batch=128)
        field = fit_neural(strengths, offsets, rows(), given).bound(rows())
        middle = field.offsets(float(strengths[4])) - offsets[4]
        errors.append(float(middle.square().mean() / offsets[4].square().mean()))
    assert errors[1] < 0.02 < 0.5 < errors[0]  # .0005 when written


def test_a_code_tells_what_no_place_can() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    same_place = rows().clone()
    same_place[:] = same_place[0]
    errors = []
    for code in (0, 4):
        given = NeuralSettings(inputs="position", steps=400, batch=128, code=code)
        field = fit_neural(strengths, offsets, same_place, given).bound(same_place)
        errors.append(float((field.offsets(0.5) - offsets[4]).square().sum() / offsets[4].square().sum()))
    assert errors[1] < 0.2 * errors[0]


def test_visible_members_are_fitted_first() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    same_place = rows()[:1].expand(MEMBERS, -1).clone()
    visibility = torch.full((MEMBERS,), 1e-6)
    visibility[7] = 1.0
    given = NeuralSettings(inputs="position", steps=200, batch=128)
    field = fit_neural(strengths, offsets, same_place, given, visibility).bound(same_place)
    wrong = (field.offsets(0.5) - offsets[4]).square().sum(dim=1)
    assert int(wrong.argmin()) == 7


def test_importance_is_what_pictures_show() -> None:
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    found = rendered_importance(offsets, lambda moved: moved[:, 11:14])
    assert found["sh0"] > 0.999
    assert sum(found.values()) == pytest.approx(1.0)


def test_the_loss_of_pictures_is_paid_in_the_last_steps() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    seen: list[tuple[int, ...]] = []

    def pictures(found: Tensor, recorded: Tensor) -> Tensor:
        seen.append((*found.shape, *recorded.shape))
        return (found - recorded).abs().mean()

    fit_neural(strengths, offsets, rows(), replace(SHORT, picture_share=0.1), pictures=pictures)
    assert seen == [(MEMBERS, 14, MEMBERS, 14)] * 4


def test_what_moves_nothing_cannot_be_learned() -> None:
    with pytest.raises(ValueError, match="nothing moves"):
        fit_neural(torch.linspace(0, 1, 3), torch.zeros(3, MEMBERS, 14), rows(), SHORT)


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_members_are_enough(count: int) -> None:
    strengths, offsets = curved_trajectory(max(count, 1))
    field = fit_neural(strengths, offsets[:, :1], rows()[:1], SHORT)
    assert torch.equal(baked_neural(field, rows()[:1]).offsets(1.0), offsets[-1])
    empty = NeuralFit(rows()[:0], 14, ("sh0",), SHORT)
    assert empty.step(strengths, offsets[:, :0]) == 0.0


def test_a_fit_goes_on_to_the_same_bits_after_it_was_saved() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))

    def new() -> NeuralFit:
        return NeuralFit(rows(), 14, ("sh0",), SHORT)

    whole, first, second = new(), new(), new()
    for fit in (whole, first):
        fit.scale_to(offsets)
    for _ in range(6):
        whole.step(strengths, offsets)
    for _ in range(3):
        first.step(strengths, offsets)
    kept = {name: tensor.clone() for name, tensor in first.saved().items()}
    first.step(strengths, offsets)  # what was saved does not change with it
    second.restore(kept)
    for _ in range(3):
        second.step(strengths, offsets)
    assert whole.saved().keys() == second.saved().keys()
    assert all(torch.equal(tensor, second.saved()[name]) for name, tensor in whole.saved().items())


def test_a_trajectory_that_grows_does_not_change_what_the_network_answers() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    fit = NeuralFit(rows(), 14, ("sh0",), replace(SHORT, inputs="position"))
    fit.scale_to(0.1 * offsets)
    trained(fit, strengths, 0.1 * offsets, 20)
    before = fit.field().bound(rows()).offsets(0.5)
    fit.scale_to(offsets)
    after = fit.field().bound(rows()).offsets(0.5)
    assert torch.allclose(before, after, atol=2e-3 * float(before.abs().max()))  # half precision


def test_a_fit_takes_over_the_outputs_that_still_move() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    given = replace(SHORT, inputs="position")
    first = NeuralFit(rows(), 14 + 9, ("means", "sh0", "shN"), given)
    wide = torch.cat([offsets, offsets[:, :, :9]], dim=2)
    first.scale_to(wide)
    trained(first, strengths, wide, 20)
    second = NeuralFit(rows(), 14, ("sh0",), given)
    second.adopt(first.shape, first.saved())
    second.scale_to(offsets)
    expected = first.field().bound(rows()).offsets(0.5)[:, 11:14]
    found = second.field().bound(rows()).offsets(0.5)[:, 11:14]
    assert torch.allclose(found, expected, atol=2e-3 * float(expected.abs().max()))


# ---- baked


@pytest.mark.parametrize("form", FORMS)
def test_the_ends_of_a_baked_network_are_exact(form: str) -> None:
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    assert not bool(baked(form).offsets(0.0).any())
    assert torch.equal(baked(form).offsets(1.0), offsets[-1])


@pytest.mark.parametrize("form", ["own", "own, hard bins"])
def test_baking_costs_as_much_as_it_says_and_that_is_little(form: str) -> None:
    field, bound = baked(form), network(form).bound(rows())
    strengths = torch.arange(1, 26) / 26
    wrong = sum(float((field.offsets(float(s)) - bound.offsets(float(s))).square().sum()) for s in strengths)
    whole = sum(float(bound.offsets(float(s)).square().sum()) for s in strengths)
    assert field.origin is not None
    assert field.origin.error is not None
    assert field.origin.error["rms"] == pytest.approx((wrong / whole) ** 0.5, rel=1e-3)
    assert field.origin.error["rms"] < 0.02


def test_what_a_network_misses_of_the_end_is_spread_over_the_way() -> None:
    form = network("position")
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    missing = float((form.bound(rows()).offsets(1.0) - offsets[-1]).norm())
    field = baked("position")
    last = float((field.offsets(1.0) - field.offsets(0.99)).norm())
    assert last < 0.2 * missing


def test_the_pull_follows_the_recorded_errors_where_they_are_known() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    judge = FieldJudge(strengths, offsets, lambda moved: moved[:, 11:14])
    follows = FieldJudge.curve
    known = baked_neural(network("position"), rows(), lambda s: _at(strengths, offsets, s))
    assert sum(follows(judge, known)) >= sum(follows(judge, baked("position"))) - 1e-6


def _at(strengths: Tensor, offsets: Tensor, s: float) -> Tensor:
    place = s * (len(strengths) - 1)
    left = min(int(place), len(strengths) - 2)
    return torch.lerp(offsets[left], offsets[left + 1], place - left)


def test_hard_bins_are_baked_as_steps() -> None:
    field = baked("position, hard bins")
    nodes = bake_nodes(10, hard=True)
    assert bool((nodes[1:] > nodes[:-1]).all())
    assert torch.allclose(field.offsets(0.41), field.offsets(0.49), atol=1e-6)
    jump = float((field.offsets(0.4001) - field.offsets(0.3999)).abs().max())
    assert jump > 10 * float((field.offsets(0.3999) - field.offsets(0.31)).abs().max())


# ---- on disk


@pytest.fixture(scope="module")
def edit() -> Gdf:
    return edit_of(scene(), members(), baked())


@pytest.fixture(scope="module")
def saved(edit: Gdf, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gdf") / "shirt.gdf"
    save_gdf(path, edit)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_a_network_comes_back_and_is_written_to_the_same_bytes(tmp_path: Path, form: str) -> None:
    save_gdf(tmp_path / "a.gdf", edit_of(scene(), members(), baked(form)))
    found = load_gdf(tmp_path / "a.gdf", scene())
    for s in (0.0, 0.37, 1.0):
        assert torch.equal(found.field.offsets(s), baked(form).offsets(s))
    save_gdf(tmp_path / "b.gdf", found)
    assert (tmp_path / "a.gdf").read_bytes() == (tmp_path / "b.gdf").read_bytes()


def test_a_baked_network_is_composed_as_any_field(saved: Path) -> None:
    gdf = load_gdf(saved, scene())
    assert gdf.field.kind == "neural"
    start = compose(scene(), [Layer(gdf, 0.0)])
    assert all(torch.equal(getattr(start, name), getattr(scene(), name)) for name in ATTRIBUTES)
    end = compose(scene(), [Layer(gdf, 1.0)])
    assert torch.equal(pack(end[members()]), rows() + gdf.field.offsets(1.0))


def test_the_file_holds_the_network_and_not_what_is_baked_of_it(saved: Path, edit: Gdf) -> None:
    assert saved.stat().st_size <= MEMBERS * edit.field.bytes_per_member + 300 / 8 + 4_096
    content = saved.read_bytes()
    names = set(safetensors.torch.load(content))
    assert {"network.layers.0.weight", "codes", "end"} < names
    assert not any(name.endswith(".rest") for name in names)


def test_a_network_needs_its_scene(saved: Path) -> None:
    with pytest.raises(ProgdfError, match=r"shirt\.gdf keeps a neural field, .*; load it with the scene"):
        load_gdf(saved)
    assert "network" in open_gdf(saved).field


def test_another_scene_is_refused_before_anything_is_baked(saved: Path) -> None:
    means = scene().means.clone()
    means[3] += 1.0
    with pytest.raises(ProgdfError, match="made for another scene"):
        load_gdf(saved, replace(scene(), means=means))


def test_a_network_that_looks_at_colours_refuses_a_scene_of_other_colours(saved: Path) -> None:
    with pytest.raises(ProgdfError, match=r"another scene: room\.ply .* look different"):
        load_gdf(saved, replace(scene(), sh0=scene().sh0 + 1), "room.ply")


def test_a_network_that_sees_places_alone_does_not_mind_other_colours(tmp_path: Path) -> None:
    save_gdf(tmp_path / "a.gdf", edit_of(scene(), members(), baked("position")))
    load_gdf(tmp_path / "a.gdf", replace(scene(), sh0=scene().sh0 + 1))


def test_a_file_without_a_network_stays_readable_for_older_programs(saved: Path, tmp_path: Path) -> None:
    plain = replace(baked(), origin=None, kind="separable")
    save_gdf(tmp_path / "plain.gdf", edit_of(scene(), members(), plain))
    assert [_header(path)["format"] for path in (tmp_path / "plain.gdf", saved)] == [1, 2]


def _header(path: Path) -> dict[str, object]:
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header: dict[str, object] = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["progdf"])
    return header


def rewritten(
    saved: Path, tmp_path: Path, network: dict[str, object], tensors: dict[str, Tensor | None]
) -> Path:
    """The file with other values, its checksum made to fit: a wrong writer's."""
    header = _header(saved)
    described = header["field"]
    assert isinstance(described, dict)
    described["network"] |= network
    kept = safetensors.torch.load(saved.read_bytes())
    for name, tensor in tensors.items():
        if tensor is None:
            del kept[name]
        else:
            kept[name] = tensor
    text = json.dumps(header)
    path = tmp_path / "shirt.gdf"
    path.write_bytes(safetensors.torch.save(kept, {"progdf": text, "sha256": _checksum(text, kept)}))
    return path


LAYOUT = {
    "width": 64,
    "layers": 3,
    "attributes": ["means", "sh0"],
    "channels": 14,
    "inputs": "own",
    "code": 3,
    "bins": 10,
    "hard": False,
    "frequencies": 8,
}


@pytest.mark.parametrize(
    ("network", "tensors"),
    [
        ({"shape": {**LAYOUT, "width": 65}}, {}),
        ({"shape": {**LAYOUT, "width": 10**9}}, {}),
        ({"shape": {**LAYOUT, "attributes": ["sh0", "means"]}}, {}),
        ({"shape": {**LAYOUT, "attributes": ["__class__"]}}, {}),
        ({"shape": {**LAYOUT, "inputs": "everything"}}, {}),
        ({"shape": {**LAYOUT, "inputs": "position"}}, {}),
        ({"shape": {**LAYOUT, "channels": 23}}, {}),
        ({"shape": {**LAYOUT, "depth": 3}}, {}),
        ({"ranks": {"means": 10**6}}, {}),
        ({"ranks": None}, {}),
        ({}, {"end": torch.zeros(39, 6)}),
        ({}, {"codes": torch.zeros(40, 4, dtype=torch.int8)}),
        ({}, {"network.heads.weight": None}),
        ({}, {"network.extent": torch.zeros(())}),
        ({}, {"network.spread": torch.full((6,), float("nan"))}),
        ({}, {"nodes": torch.linspace(0, 1, 100_000)}),
        ({}, {"nodes": torch.linspace(0, 2, 41)}),
        ({}, {"pull.means": torch.zeros(7)}),
    ],
)
def test_a_network_that_contradicts_itself_is_refused(
    saved: Path, tmp_path: Path, network: dict[str, object], tensors: dict[str, Tensor | None]
) -> None:
    with pytest.raises(ProgdfError, match="does not hold together") as refused:
        load_gdf(rewritten(saved, tmp_path, network, tensors), scene())
    assert "\n" not in str(refused.value)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_or_missing_bytes_are_one_line(saved: Path, tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(saved.read_bytes())
    reach = 8 + int.from_bytes(content[:8], "little") if data.draw(st.booleans()) else len(content)
    place = data.draw(st.integers(0, reach - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    kept = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content) - 1)))
    path = tmp_path / "shirt.gdf"
    path.write_bytes(content[:kept])
    refused = None
    try:
        found = load_gdf(path, scene())
    except ProgdfError as error:
        refused = str(error)
    assert "\n" not in refused if refused else torch.equal(found.field.offsets(0.5), baked().offsets(0.5))


# ---- the floor


def test_a_smooth_edit_is_told_by_the_neighbours_and_a_random_one_is_not() -> None:
    places = torch.randn(800, 3, generator=torch.Generator().manual_seed(0))
    strengths, smooth = smooth_trajectory(places)
    _, random = curved_trajectory(800, moving=("sh0",))
    assert position_floor(strengths, smooth, places).unpredictable["sh0"] < 0.2
    assert position_floor(strengths, random, places).unpredictable["sh0"] > 0.9


def test_the_floor_in_pictures_is_that_of_the_neighbours() -> None:
    places = torch.arange(6.0)[:, None].expand(6, 3) ** 2
    strengths = torch.tensor([0.0, 1.0])
    offsets = torch.zeros(2, 6, 14)
    offsets[1, :, 11] = torch.tensor([1.0, 1.1, 2.0, 2.1, 5.0, 5.1])
    judge = FieldJudge(strengths, offsets, lambda moved: moved[:, 11:14] / 10)
    found = position_floor(strengths, offsets, places, judge=judge)
    assert found.neighbours in (1, 2, 4)
    assert found.psnr_worst < found.psnr_mean < 60.0


def test_a_lone_member_has_no_neighbours() -> None:
    strengths, offsets = curved_trajectory(1)
    assert position_floor(strengths, offsets, torch.zeros(1, 3)).unpredictable["means"] == 1.0


def test_layouts_that_make_no_sense_are_refused() -> None:
    for changed in (
        {"width": 0},
        {"layers": 65},
        {"attributes": ()},
        {"attributes": ("sh0", "means")},
        {"code": -1},
    ):
        with pytest.raises(ValueError, match=r"expected|are not some of"):
            NeuralShape(**{"width": 8, "layers": 2, "attributes": ("sh0",), "channels": 14} | changed)


def test_a_form_refuses_other_numbers_of_members() -> None:
    form = baked().origin
    assert isinstance(form, NeuralForm)
    with pytest.raises(ValueError, match="expected 40"):
        form.baked(rows()[:39])
