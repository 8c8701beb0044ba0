"""Tests of .gdf files: they load as saved, or are refused in one line."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.field.baked import BASIS_TYPES, END_TYPES
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, SceneFingerprint, fingerprint, load_gdf, save_gdf, verify
from progdf.gdf.header import FORMAT
from progdf.region import Region
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.scenes import random_gaussians


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(300, seed=1, sh_degree=1)


@pytest.fixture(scope="module")
def shirt(scene: Gaussians) -> Gdf:
    edit = edit_of(scene, some_rows(scene, 40), curved_field(40, channels=14 + 9))
    score = edit.region.score.clone()
    score[edit.region.members[:5]] = torch.tensor([204, 153, 250, 1, 0]) / 255
    score[edit.region.members[-1] + 1 if int(edit.region.members[-1]) < 299 else 0] = 51 / 255
    return replace(
        edit,
        region=replace(edit.region, score=score),
        options={"steps": 600, "lr": 0.5},
        report={"psnr": 43.2},
    )


@pytest.fixture(scope="module")
def saved(shirt: Gdf, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gdf") / "shirt.gdf"
    save_gdf(path, shirt)
    return path


def same(a: Gdf, b: Gdf) -> bool:
    plain = all(
        getattr(a, name) == getattr(b, name) for name in ("name", "scene", "instruction", "options", "report")
    )
    fields = (a.field.kind, a.field.channels, a.field.recorded) == (
        b.field.kind,
        b.field.channels,
        b.field.recorded,
    )
    tensors = [
        (a.region.members, b.region.members),
        (a.region.score, b.region.score),
        (a.field.knots, b.field.knots),
    ]
    for name, bases in a.field.attributes.items():
        tensors += [(part, getattr(b.field.attributes[name], key)) for key, part in vars(bases).items()]
    return (
        plain
        and fields
        and list(a.field.attributes) == list(b.field.attributes)
        and all(x.dtype == y.dtype and torch.equal(x, y) for x, y in tensors)
    )


def test_edit_loads_as_saved(shirt: Gdf, saved: Path, scene: Gaussians) -> None:
    assert same(load_gdf(saved, scene), shirt)


@pytest.mark.parametrize("end_type", END_TYPES)
@pytest.mark.parametrize("basis_type", BASIS_TYPES)
def test_every_storage_type_loads_as_saved(
    scene: Gaussians, tmp_path: Path, basis_type: torch.dtype, end_type: torch.dtype
) -> None:
    field = curved_field(9, basis_type=basis_type, end_type=end_type)
    edit = edit_of(scene, some_rows(scene, 9), field)
    save_gdf(tmp_path / "a.gdf", edit)
    assert same(load_gdf(tmp_path / "a.gdf"), edit)


@pytest.mark.parametrize("count", [0, 1, 7, 299, 300])
def test_regions_of_any_size_load_as_saved(scene: Gaussians, tmp_path: Path, count: int) -> None:
    edit = edit_of(scene, some_rows(scene, count), curved_field(count))
    save_gdf(tmp_path / "a.gdf", edit)
    assert same(load_gdf(tmp_path / "a.gdf"), edit)


@pytest.mark.parametrize("members", [torch.arange(20, 200), torch.arange(0, 300, 2), torch.tensor([3, 250])])
def test_runs_patterns_and_single_rows_load_as_saved(
    scene: Gaussians, tmp_path: Path, members: torch.Tensor
) -> None:
    edit = edit_of(scene, members, curved_field(len(members)))
    save_gdf(tmp_path / "a.gdf", edit)
    assert torch.equal(load_gdf(tmp_path / "a.gdf").region.members, members)


def test_soft_score_is_kept_to_half_a_level(scene: Gaussians, tmp_path: Path) -> None:
    score = torch.rand(300, generator=torch.Generator().manual_seed(0))
    members = (score >= 0.7).nonzero()[:, 0]
    edit = Gdf("soft", Region("soft", members, score), curved_field(len(members)), fingerprint(scene))
    save_gdf(tmp_path / "a.gdf", edit)
    assert float((load_gdf(tmp_path / "a.gdf").region.score - score).abs().max()) <= 0.5 / 255 + 1e-6


def test_file_is_hardly_larger_than_its_members(tmp_path: Path) -> None:
    scene = random_gaussians(30_000, seed=2)
    field = curved_field(3_000)
    save_gdf(tmp_path / "a.gdf", edit_of(scene, some_rows(scene, 3_000), field))
    members_as_bits = 30_000 / 8
    assert (tmp_path / "a.gdf").stat().st_size <= 3_000 * field.bytes_per_member + members_as_bits + 4_096


def test_values_unknown_to_json_become_null(shirt: Gdf, tmp_path: Path) -> None:
    save_gdf(
        tmp_path / "a.gdf", replace(shirt, report={"clip": float("nan"), "sizes": (1, 2), "at": Path("x")})
    )
    assert load_gdf(tmp_path / "a.gdf").report == {"clip": None, "sizes": [1, 2], "at": "x"}


def test_field_with_values_that_are_not_finite_is_not_saved(shirt: Gdf, tmp_path: Path) -> None:
    bases = shirt.field.attributes["means"]
    broken = replace(bases, end_offset=bases.end_offset.index_fill(0, torch.tensor([0]), float("inf")))
    field = replace(shirt.field, attributes={**shirt.field.attributes, "means": broken})
    with pytest.raises(ValueError, match=r"means\.end_offset of shirt"):
        save_gdf(tmp_path / "a.gdf", replace(shirt, field=field))
    assert not list(tmp_path.iterdir())


def test_field_that_would_not_load_is_not_saved(shirt: Gdf, tmp_path: Path) -> None:
    bases = shirt.field.attributes["log_scales"]
    wild = replace(bases, scale=1e6 * bases.scale)
    field = replace(shirt.field, attributes={**shirt.field.attributes, "log_scales": wild})
    with pytest.raises(ValueError, match="farther than any scene reaches"):
        save_gdf(tmp_path / "a.gdf", replace(shirt, field=field))
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_named(shirt: Gdf, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match=r"does not exist; create it first"):
        save_gdf(tmp_path / "nowhere" / "a.gdf", shirt)


# ---- other scenes


def test_scene_of_another_size_is_named_with_both_sizes(shirt: Gdf) -> None:
    far_larger = replace(shirt, region=Region("r", torch.zeros(0, dtype=torch.int64), torch.zeros(41_203)),
                         field=curved_field(0, moving=()), scene=SceneFingerprint(41_203, ""))  # fmt: skip
    expected = "shirt.gdf was made for another scene: it has 41 203 Gaussians, room.ply has 52 870"
    with pytest.raises(ProgdfError) as refused:
        verify(far_larger, random_gaussians(52_870), "shirt.gdf", "room.ply")
    assert str(refused.value).startswith(expected + "; ")
    assert "progdf rebind shirt.gdf --from SCENE --to room.ply" in str(refused.value)


def test_scene_with_one_moved_center_is_another_scene(saved: Path, scene: Gaussians) -> None:
    means = scene.means.clone()
    means[17, 1] += 1e-6
    with pytest.raises(ProgdfError, match=r"shirt\.gdf was made for another scene: .* at other positions"):
        load_gdf(saved, replace(scene, means=means))


def test_scene_of_another_sh_degree_is_refused(saved: Path, scene: Gaussians) -> None:
    with pytest.raises(ProgdfError, match="SH degree 0"):
        load_gdf(saved, replace(scene, shN=scene.shN[:, :0]))


def test_colors_may_differ(saved: Path, scene: Gaussians) -> None:
    load_gdf(saved, replace(scene, sh0=scene.sh0 + 1))


# ---- files that differ from the saved ones


def refusal(path: Path) -> str:
    with pytest.raises(ProgdfError) as refused:
        load_gdf(path)
    line = str(refused.value)
    assert "\n" not in line
    return line


def written(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "shirt.gdf"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "content", [b"", b"ply\nformat ascii 1.0\n", b"PK\x03\x04" + bytes(60), b"{}", b"\x80\x04" * 9]
)
def test_files_of_another_kind_are_refused(tmp_path: Path, content: bytes) -> None:
    assert "shirt.gdf is not a .gdf file" in refusal(written(tmp_path, content))


def test_other_safetensors_files_are_refused(tmp_path: Path) -> None:
    content = safetensors.torch.save({"weight": torch.ones(3)}, {"format": "pt"})
    assert "is a safetensors file, but not a .gdf" in refusal(written(tmp_path, content))


def test_missing_file_is_named(tmp_path: Path) -> None:
    assert "shirt.gdf does not exist" in refusal(tmp_path / "shirt.gdf")


def test_folder_is_refused(tmp_path: Path) -> None:
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.999])
def test_truncated_file_is_refused(saved: Path, tmp_path: Path, kept: float) -> None:
    content = saved.read_bytes()
    assert "truncated" in refusal(written(tmp_path, content[: int(kept * len(content))]))


def test_single_flipped_bit_is_noticed(saved: Path, tmp_path: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[-100] ^= 1
    assert "is damaged" in refusal(written(tmp_path, bytes(content)))


def rewritten(saved: Path, tmp_path: Path, **changes: object) -> Path:
    """Write the file with other header values and a matching checksum, as a wrong writer would."""
    content = saved.read_bytes()
    header = header_of(content)
    tensors = safetensors.torch.load(content)
    for key, value in changes.items():
        if key in header:
            header[key] = value
        elif value is None:
            del tensors[key.replace("__", ".")]
        else:
            tensors[key.replace("__", ".")] = value
    return written(tmp_path, signed_gdf(header, tensors))


def test_file_of_a_newer_version_suggests_an_update(saved: Path, tmp_path: Path) -> None:
    line = refusal(rewritten(saved, tmp_path, format=FORMAT + 6))
    assert line == f"shirt.gdf has format {FORMAT + 6}, this progdf reads format {FORMAT}; update progdf"


@pytest.mark.parametrize(
    "changes",
    [
        {"means__end_offset": torch.ones(39, 3)},
        {"means__end_offset": torch.ones(40, 3, dtype=torch.float64)},
        {"means__end_offset": torch.ones(40, 3, dtype=torch.int16), "means__scale": torch.ones(2, 3)},
        {"means__end_offset": torch.full((40, 3), float("nan"))},
        {"means__residual_basis": None},
        {"means__coefficients": torch.ones(9, 3)},
        {"knots": torch.linspace(0, 2, 9)},
        {"knots": torch.zeros(0)},
        {"members__bits": None},
        {"scene": {"count": 10**15, "means_sha256": ""}},
        {"scene": {"count": -1, "means_sha256": ""}},
        {"scene": {"count": 200, "means_sha256": ""}},
        {"scene": None},
        {"field": {"kind": "separable", "channels": 14, "attributes": ["__class__"], "recorded": []}},
        {"field": {"kind": "separable", "channels": 1e99, "attributes": [], "recorded": []}},
        {"field": []},
        {"options": "text"},
        {"name": ["shirt"]},
        {"field": {"kind": "separable", "channels": 14, "attributes": ["means"], "recorded": "0.5"}},
        {"field": {"kind": "neural", "channels": 14, "attributes": [], "recorded": [], "network": {}}},
        {"members": -1},
        {"members": 10**9},
        {"means__end_offset": torch.full((40, 3), 3e38)},
        {"means__end_offset": torch.ones(40, 3, dtype=torch.int8), "means__scale": torch.full((3, 3), 1e30)},
        {"log_scales__end_offset": torch.full((40, 3), 200.0)},
    ],
)
def test_inconsistent_file_is_refused(saved: Path, tmp_path: Path, changes: dict[str, object]) -> None:
    assert "is inconsistent" in refusal(rewritten(saved, tmp_path, **changes))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_or_missing_bytes_give_the_same_edit_or_an_error(
    saved: Path, shirt: Gdf, tmp_path: Path, data: st.DataObject
) -> None:
    content = bytearray(saved.read_bytes())
    in_header = data.draw(st.booleans())
    reach = 8 + int.from_bytes(content[:8], "little") if in_header else len(content)
    for place in data.draw(st.lists(st.integers(0, reach - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    length = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path = written(tmp_path, bytes(content[:length]))
    refused = None
    try:
        found = load_gdf(path)
    except ProgdfError as error:
        refused = str(error)
    assert "\n" not in refused if refused else same(found, shirt)


# ---- changed headers


def test_header_with_another_number_of_members_is_refused(saved: Path, tmp_path: Path) -> None:
    assert "has 41 members" in refusal(rewritten(saved, tmp_path, members=41))


def places(value: object, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the paths of all values inside a JSON value."""
    yield at
    if isinstance(value, dict | list):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(entry, (*at, key))


@pytest.mark.slow
def test_info_shows_or_refuses_any_header_in_one_line(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = saved.read_bytes()
    header = header_of(content)
    tensors = safetensors.torch.load(content)
    assert main(["info", str(written(tmp_path, signed_gdf(header, tensors)))]) == 0
    others: list[object] = [None, [], {}, "", "means", -1, 0, 1e300, 2**70, True, [[]], {"a": []}]
    for place in list(places(header)):
        for other in others:
            changed = json.loads(json.dumps(header))
            if place:
                inner = changed
                for key in place[:-1]:
                    inner = inner[key]
                inner[place[-1]] = other
            else:
                changed = other
            path = written(tmp_path, signed_gdf(changed, tensors))
            assert main(["info", str(path)]) in (0, 2), (place, other)
            with suppress(ProgdfError):
                load_gdf(tmp_path / "shirt.gdf")
    assert all(line.isprintable() for line in capsys.readouterr().out.splitlines())


def test_small_file_of_a_huge_scene_costs_little_memory(saved: Path, tmp_path: Path) -> None:
    content = safetensors.torch.load(saved.read_bytes())
    members: dict[str, object] = {name: None for name in content if name.startswith("members.")}
    members["members.runs"] = torch.tensor([[0, 1 << 25]], dtype=torch.int32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scene = {"count": 1 << 25, "means_sha256": ""}
    refusal(rewritten(saved, tmp_path, scene=scene, members=1 << 25, **members))
    refusal(rewritten(saved, tmp_path, scene=scene, **members))
    refusal(rewritten(saved, tmp_path, scene={"count": 1 << 28, "means_sha256": ""}, **members))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
