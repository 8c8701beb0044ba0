"""A .gdf file comes back as it was saved, or is refused with one line."""

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
from progdf.gaussians import Gaussians
from progdf.gdf.file import (
    Gdf,
    SceneFingerprint,
    file_metadata,
    fingerprint,
    load_gdf,
    save_gdf,
    verify,
)
from progdf.gdf.header import FORMAT, read_head
from progdf.io.tensors import pack_metadata
from progdf.region import Region
from tests.helpers.edits import curved_field, edit_of, some_rows
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


def test_an_edit_comes_back_as_it_was_saved(shirt: Gdf, saved: Path, scene: Gaussians) -> None:
    assert same(load_gdf(saved, scene), shirt)


@pytest.mark.parametrize("rest_type", [torch.int8, torch.float16, torch.float32])
def test_every_storage_type_survives(scene: Gaussians, tmp_path: Path, rest_type: torch.dtype) -> None:
    edit = edit_of(scene, some_rows(scene, 9), curved_field(9, rest_type=rest_type))
    save_gdf(tmp_path / "a.gdf", edit)
    assert same(load_gdf(tmp_path / "a.gdf"), edit)


@pytest.mark.parametrize("count", [0, 1, 7, 299, 300])
def test_regions_of_any_size_survive(scene: Gaussians, tmp_path: Path, count: int) -> None:
    edit = edit_of(scene, some_rows(scene, count), curved_field(count))
    save_gdf(tmp_path / "a.gdf", edit)
    assert same(load_gdf(tmp_path / "a.gdf"), edit)


@pytest.mark.parametrize("members", [torch.arange(20, 200), torch.arange(0, 300, 2), torch.tensor([3, 250])])
def test_runs_patterns_and_lone_rows_survive(scene: Gaussians, tmp_path: Path, members: torch.Tensor) -> None:
    edit = edit_of(scene, members, curved_field(len(members)))
    save_gdf(tmp_path / "a.gdf", edit)
    assert torch.equal(load_gdf(tmp_path / "a.gdf").region.members, members)


def test_a_soft_score_is_kept_to_half_a_level(scene: Gaussians, tmp_path: Path) -> None:
    score = torch.rand(300, generator=torch.Generator().manual_seed(0))
    members = (score >= 0.7).nonzero()[:, 0]
    edit = Gdf("soft", Region("soft", members, score), curved_field(len(members)), fingerprint(scene))
    save_gdf(tmp_path / "a.gdf", edit)
    assert float((load_gdf(tmp_path / "a.gdf").region.score - score).abs().max()) <= 0.5 / 255 + 1e-6


def test_the_file_is_hardly_larger_than_its_members(tmp_path: Path) -> None:
    scene = random_gaussians(30_000, seed=2)
    field = curved_field(3_000)
    save_gdf(tmp_path / "a.gdf", edit_of(scene, some_rows(scene, 3_000), field))
    members_as_bits = 30_000 / 8
    assert (tmp_path / "a.gdf").stat().st_size <= 3_000 * field.bytes_per_member + members_as_bits + 4_096


def test_numbers_that_json_does_not_know_become_null(shirt: Gdf, tmp_path: Path) -> None:
    save_gdf(
        tmp_path / "a.gdf", replace(shirt, report={"clip": float("nan"), "sizes": (1, 2), "at": Path("x")})
    )
    assert load_gdf(tmp_path / "a.gdf").report == {"clip": None, "sizes": [1, 2], "at": "x"}


def test_a_field_with_numbers_that_are_not_finite_is_not_saved(shirt: Gdf, tmp_path: Path) -> None:
    bases = shirt.field.attributes["means"]
    broken = replace(bases, end_offset=bases.end_offset.index_fill(0, torch.tensor([0]), float("inf")))
    field = replace(shirt.field, attributes={**shirt.field.attributes, "means": broken})
    with pytest.raises(ValueError, match=r"means\.full of shirt"):
        save_gdf(tmp_path / "a.gdf", replace(shirt, field=field))
    assert not list(tmp_path.iterdir())


def test_a_place_that_does_not_exist_is_named(shirt: Gdf, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match=r"does not exist; create it first"):
        save_gdf(tmp_path / "nowhere" / "a.gdf", shirt)


# ---- other scenes


def test_a_scene_of_another_size_is_named_with_both_sizes(shirt: Gdf) -> None:
    far_larger = replace(shirt, region=Region("r", torch.zeros(0, dtype=torch.int64), torch.zeros(41_203)),
                         field=curved_field(0, moving=()), scene=SceneFingerprint(41_203, ""))  # fmt: skip
    expected = "shirt.gdf was made for another scene: it has 41 203 Gaussians, room.ply has 52 870"
    with pytest.raises(ProgdfError) as refused:
        verify(far_larger, random_gaussians(52_870), "shirt.gdf", "room.ply")
    assert str(refused.value).startswith(expected + "; ")
    assert "progdf rebind shirt.gdf --from SCENE --to room.ply" in str(refused.value)


def test_a_scene_with_one_center_moved_is_another_scene(saved: Path, scene: Gaussians) -> None:
    means = scene.means.clone()
    means[17, 1] += 1e-6
    with pytest.raises(ProgdfError, match=r"shirt\.gdf was made for another scene: .* at other places"):
        load_gdf(saved, replace(scene, means=means))


def test_a_scene_of_another_sh_degree_is_refused(saved: Path, scene: Gaussians) -> None:
    with pytest.raises(ProgdfError, match="SH degree 0"):
        load_gdf(saved, replace(scene, shN=scene.shN[:, :0]))


def test_colors_may_differ(saved: Path, scene: Gaussians) -> None:
    load_gdf(saved, replace(scene, sh0=scene.sh0 + 1))


# ---- files that are not what was saved


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


def test_safetensors_of_something_else_are_refused(tmp_path: Path) -> None:
    content = safetensors.torch.save({"weight": torch.ones(3)}, {"format": "pt"})
    assert "is a safetensors file, but not a .gdf" in refusal(written(tmp_path, content))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "shirt.gdf does not exist" in refusal(tmp_path / "shirt.gdf")


def test_a_folder_is_no_edit(tmp_path: Path) -> None:
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.999])
def test_a_file_cut_short_says_so(saved: Path, tmp_path: Path, kept: float) -> None:
    content = saved.read_bytes()
    assert "truncated" in refusal(written(tmp_path, content[: int(kept * len(content))]))


def test_one_flipped_bit_of_a_number_is_noticed(saved: Path, tmp_path: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[-100] ^= 1
    assert "is damaged" in refusal(written(tmp_path, bytes(content)))


def rewritten(saved: Path, tmp_path: Path, **changes: object) -> Path:
    """The file with other values in its header, its checksum made to fit: a wrong writer's."""
    content = saved.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["progdf"])["header"]
    tensors = safetensors.torch.load(content)
    for key, value in changes.items():
        if key in header:
            header[key] = value
        elif value is None:
            del tensors[key.replace("__", ".")]
        else:
            tensors[key.replace("__", ".")] = value
    text = json.dumps(header)
    return written(tmp_path, safetensors.torch.save(tensors, pack_metadata(file_metadata(text, tensors))))


def test_a_file_of_a_newer_version_asks_for_an_update(saved: Path, tmp_path: Path) -> None:
    line = refusal(rewritten(saved, tmp_path, format=FORMAT + 6))
    assert line == f"shirt.gdf has format {FORMAT + 6}, this progdf reads format {FORMAT}; update progdf"


@pytest.mark.parametrize(
    "changes",
    [
        {"means__full": torch.ones(39, 3)},
        {"means__full": torch.ones(40, 3, dtype=torch.float64)},
        {"means__full": torch.full((40, 3), float("nan"))},
        {"means__rest": None},
        {"means__coefficients": torch.ones(9, 3)},
        {"nodes": torch.linspace(0, 2, 9)},
        {"nodes": torch.zeros(0)},
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
        {"means__full": torch.full((40, 3), 3e38)},
        {"log_scales__full": torch.full((40, 3), 200.0)},
    ],
)
def test_a_file_that_contradicts_itself_is_refused(
    saved: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    assert "is inconsistent" in refusal(rewritten(saved, tmp_path, **changes))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_or_missing_bytes_give_the_same_edit_or_one_line(
    saved: Path, shirt: Gdf, tmp_path: Path, data: st.DataObject
) -> None:
    content = bytearray(saved.read_bytes())
    in_header = data.draw(st.booleans())
    reach = 8 + int.from_bytes(content[:8], "little") if in_header else len(content)
    for place in data.draw(st.lists(st.integers(0, reach - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    kept = data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))
    path = written(tmp_path, bytes(content[:kept]))
    refused = None
    try:
        found = load_gdf(path)
    except ProgdfError as error:
        refused = str(error)
    assert "\n" not in refused if refused else same(found, shirt)


# ---- files that are opened by their header


def header_size(path: Path) -> int:
    return 8 + int.from_bytes(path.read_bytes()[:8], "little")


def test_an_edit_is_told_from_its_header_alone(saved: Path, shirt: Gdf, tmp_path: Path) -> None:
    path = tmp_path / "shirt.gdf"
    whole = saved.read_bytes()
    path.write_bytes(whole[: header_size(saved)] + bytes(len(whole) - header_size(saved)))
    head = read_head(path)
    assert (head.name, head.instruction, head.scene) == (shirt.name, shirt.instruction, shirt.scene)
    assert (head.options, head.report) == (shirt.options, shirt.report)
    assert head.members == len(shirt.region)
    assert head.bytes_per_member == shirt.field.bytes_per_member
    assert head.knots == len(shirt.field.knots)
    assert head.bases() == {
        name: 1 + len(bases.residual_basis) for name, bases in shirt.field.attributes.items()
    }
    with pytest.raises(ProgdfError, match="is damaged"):
        load_gdf(path)


def test_every_flipped_byte_of_a_header_is_noticed_when_it_is_opened(
    saved: Path, shirt: Gdf, tmp_path: Path
) -> None:
    whole = saved.read_bytes()
    told = read_head(saved)
    for place in range(0, header_size(saved), 7):
        content = bytearray(whole)
        content[place] ^= 1 << (place % 8)
        path = written(tmp_path, bytes(content))
        try:
            head = read_head(path)
        except ProgdfError:
            continue
        assert replace(head, path=told.path, sha256=told.sha256) == told, place


def test_an_edit_of_another_scene_is_refused_before_its_numbers_are_read(
    saved: Path, scene: Gaussians, tmp_path: Path
) -> None:
    whole = saved.read_bytes()
    path = written(tmp_path, whole[: header_size(saved)] + bytes(len(whole) - header_size(saved)))
    with pytest.raises(ProgdfError, match="made for another scene"):
        load_gdf(path, replace(scene, means=scene.means + 1))


def test_a_header_with_another_number_of_members_is_refused(saved: Path, tmp_path: Path) -> None:
    assert "has 41 members" in refusal(rewritten(saved, tmp_path, members=41))


def resigned(path: Path, tmp_path: Path, header: object) -> Path:
    """The file with another JSON header and checksums that fit it: what somebody would make to do harm."""
    content = path.read_bytes()
    text = json.dumps(header)
    tensors = safetensors.torch.load(content)
    return written(tmp_path, safetensors.torch.save(tensors, pack_metadata(file_metadata(text, tensors))))


def places(value: object, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Where in a JSON value there are values."""
    yield at
    if isinstance(value, dict | list):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(entry, (*at, key))


def test_info_of_any_header_is_told_or_refused_in_one_line(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = saved.read_bytes()
    header = json.loads(json.loads(content[8 : header_size(saved)])["__metadata__"]["progdf"])["header"]
    assert main(["info", str(resigned(saved, tmp_path, header))]) == 0
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
            assert main(["info", str(resigned(saved, tmp_path, changed))]) in (0, 2), (place, other)
            with suppress(ProgdfError):
                load_gdf(tmp_path / "shirt.gdf")
    assert all(line.isprintable() for line in capsys.readouterr().out.splitlines())


def test_a_small_file_of_a_huge_scene_costs_little(saved: Path, tmp_path: Path) -> None:
    content = safetensors.torch.load(saved.read_bytes())
    there: dict[str, object] = {name: None for name in content if name.startswith("members.")}
    there["members.runs"] = torch.tensor([[0, 1 << 25]], dtype=torch.int32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scene = {"count": 1 << 25, "means_sha256": ""}
    refusal(rewritten(saved, tmp_path, scene=scene, members=1 << 25, **there))
    refusal(rewritten(saved, tmp_path, scene=scene, **there))
    refusal(rewritten(saved, tmp_path, scene={"count": 1 << 28, "means_sha256": ""}, **there))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
