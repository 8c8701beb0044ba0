"""Tests of a network in a .gdf file: small, deterministic, bound to its scene, or refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, pack
from progdf.gdf.file import Gdf, load_gdf, read_gdf, save_gdf
from tests.helpers.edits import edit_of
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.networks import FORMS, MEMBERS, baked, members, rows, scene


@pytest.fixture(scope="module")
def edit() -> Gdf:
    return edit_of(scene(), members(), baked())


@pytest.fixture(scope="module")
def saved(edit: Gdf, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gdf") / "shirt.gdf"
    save_gdf(path, edit)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_network_loads_as_saved_and_rewrites_the_same_bytes(tmp_path: Path, form: str) -> None:
    save_gdf(tmp_path / "a.gdf", edit_of(scene(), members(), baked(form)))
    found = load_gdf(tmp_path / "a.gdf", scene())
    for s in (0.0, 0.37, 1.0):
        assert torch.equal(found.field.offsets(s), baked(form).offsets(s))
    save_gdf(tmp_path / "b.gdf", found)
    assert (tmp_path / "a.gdf").read_bytes() == (tmp_path / "b.gdf").read_bytes()


def test_baked_network_composes_like_any_field(saved: Path) -> None:
    gdf = load_gdf(saved, scene())
    assert gdf.field.kind == "neural"
    start = compose_layers(scene(), [Layer(gdf, 0.0)])
    assert all(torch.equal(getattr(start, name), getattr(scene(), name)) for name in ATTRIBUTES)
    end = compose_layers(scene(), [Layer(gdf, 1.0)])
    assert torch.equal(pack(end[members()]), rows() + gdf.field.offsets(1.0))


def test_file_holds_the_network_without_the_baked_field(saved: Path, edit: Gdf) -> None:
    assert saved.stat().st_size <= MEMBERS * edit.field.bytes_per_member + 300 / 8 + 4_096
    content = saved.read_bytes()
    names = set(safetensors.torch.load(content))
    assert {"network.layers.0.weight", "codes", "end"} < names
    assert not any(name.endswith(".residual_basis") for name in names)


def test_network_needs_its_scene(saved: Path) -> None:
    with pytest.raises(ProgdfError, match=r"shirt\.gdf keeps a neural field, .*; load it with the scene"):
        load_gdf(saved)
    assert read_gdf(saved).field.origin is not None


def test_another_scene_is_refused_before_baking(saved: Path) -> None:
    means = scene().means.clone()
    means[3] += 1.0
    with pytest.raises(ProgdfError, match="made for another scene"):
        load_gdf(saved, replace(scene(), means=means))


def test_network_with_color_inputs_refuses_other_colors(saved: Path) -> None:
    with pytest.raises(
        ProgdfError, match=r"another scene: room\.ply has its positions, but other attributes"
    ):
        load_gdf(saved, replace(scene(), sh0=scene().sh0 + 1), "room.ply")


def test_network_with_position_inputs_accepts_other_colors(tmp_path: Path) -> None:
    save_gdf(tmp_path / "a.gdf", edit_of(scene(), members(), baked("position")))
    load_gdf(tmp_path / "a.gdf", replace(scene(), sh0=scene().sh0 + 1))


def rewritten(
    saved: Path, tmp_path: Path, network: dict[str, object], tensors: dict[str, Tensor | None]
) -> Path:
    """Write the file with other values and a matching checksum, as a wrong writer would."""
    header = header_of(saved.read_bytes())
    header["field"]["network"] |= network
    stored = safetensors.torch.load(saved.read_bytes())
    for name, tensor in tensors.items():
        if tensor is None:
            del stored[name]
        else:
            stored[name] = tensor
    path = tmp_path / "shirt.gdf"
    path.write_bytes(signed_gdf(header, stored))
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
        ({}, {"knots": torch.linspace(0, 1, 100_000)}),
        ({}, {"knots": torch.linspace(0, 2, 41)}),
        ({}, {"end_correction.means": torch.zeros(7)}),
    ],
)
def test_inconsistent_network_is_refused(
    saved: Path, tmp_path: Path, network: dict[str, object], tensors: dict[str, Tensor | None]
) -> None:
    with pytest.raises(ProgdfError, match="is inconsistent") as refused:
        load_gdf(rewritten(saved, tmp_path, network, tensors), scene())
    assert "\n" not in str(refused.value)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_or_missing_bytes_are_reported_in_one_line(
    saved: Path, tmp_path: Path, data: st.DataObject
) -> None:
    content = bytearray(saved.read_bytes())
    reach = 8 + int.from_bytes(content[:8], "little") if data.draw(st.booleans()) else len(content)
    place = data.draw(st.integers(0, reach - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    length = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content) - 1)))
    path = tmp_path / "shirt.gdf"
    path.write_bytes(content[:length])
    refused = None
    try:
        found = load_gdf(path, scene())
    except ProgdfError as error:
        refused = str(error)
    assert "\n" not in refused if refused else torch.equal(found.field.offsets(0.5), baked().offsets(0.5))
