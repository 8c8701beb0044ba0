"""Tests of strays: planted ones are found, Gaussians of the scene are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.__main__ import main
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import load_gdf
from progdf.scene import strays
from progdf.scene.strays import Strays, clean, find_strays, picture_difference
from tests.helpers import plain_strays
from tests.helpers.paths import SHARED_DATA
from tests.helpers.scenes import concatenate, one_gaussian, random_gaussians
from tests.helpers.stacks import bear_stack

ONE_STEP_DB = 20 * np.log10(255)
"""PSNR of pictures that differ by one 8-bit step, which is invisible."""


@cache
def bear() -> Gaussians:
    return bear_stack(3000).scene


@cache
def littered() -> tuple[Gaussians, dict[str, list[int]]]:
    """Return the bear with strays among its rows, and the rows of each kind."""
    scene = bear()
    small = float(scene.scales.median())
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(40, 4))
    planted: dict[str, list[Gaussians]] = {
        "giants": [
            one_gaussian((x, 2.0, 0.5), scales=(3.0, 2.5, 0.05), quat=tuple(q))
            for x, q in zip((-1.0, 0.0, 1.5), quats, strict=False)
        ],
        "needles": [
            one_gaussian((x, 1.0, z), scales=(2.0, small / 20, small / 20), quat=(1.0, 0.0, 0.3 * z, 1.0))
            for x, z in ((0.5, 0.2), (-0.6, 0.4), (0.0, -0.8))
        ],
        "floaters": [
            *(one_gaussian(tuple(p), scales=(small,) * 3) for p in rng.normal(size=(9, 3)) * 2 + (0, 9, 0)),
            *(one_gaussian((6.0, 4.0 + d, 3.0), scales=(small,) * 3) for d in (0.0, small, 2 * small)),
        ],
        "faint": [one_gaussian(tuple(p), opacity=0.003) for p in rng.normal(size=(5, 3))],
    }
    strays = [(kind, each) for kind, those in planted.items() for each in those]
    more = [replace(s, shN=torch.zeros(1, scene.shN.shape[1], 3)) for _, s in strays]
    whole = concatenate(scene, *more)
    order = torch.from_numpy(rng.permutation(len(whole)))
    place = {int(row): i for i, row in enumerate(order)}
    where: dict[str, list[int]] = {kind: [] for kind in planted}
    for i, (kind, _) in enumerate(strays):
        where[kind].append(place[len(scene) + i])
    return whole[order], where


def same(a: Strays, b: Strays) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


def test_planted_strays_are_found_and_scene_rows_are_kept() -> None:
    scene, where = littered()
    found = find_strays(scene)
    assert sorted(where["faint"]) == found.faint.tolist()
    assert sorted(where["floaters"]) == found.floaters.tolist()
    assert sorted(where["giants"] + where["needles"]) == sorted([*found.giants, *found.needles])
    assert set(where["giants"]) <= set(found.giants.tolist())
    assert found.describe().endswith("12 floaters, 5 too transparent to be drawn")


@pytest.mark.parametrize("factor", [1.0, 2.0**-9, 2.0**11])
def test_moved_rotated_and_scaled_scene_has_the_same_strays(factor: float) -> None:
    scene, _ = littered()
    half_turn = scene.quats[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1.0, -1.0, 1.0])  # about x
    moved = replace(
        scene,
        means=scene.means * torch.tensor([1.0, -1.0, -1.0]) * factor
        + factor * torch.tensor([8.0, -4.0, 2.0]),
        quats=half_turn,
        log_scales=scene.log_scales + float(np.log(factor)),
    )
    assert same(find_strays(moved), find_strays(scene))


def test_cleaned_scene_has_no_strays() -> None:
    scene, _ = littered()
    cleaned = clean(scene, find_strays(scene))
    assert find_strays(cleaned).describe() == "none"
    assert len(cleaned) == len(bear())


@pytest.mark.slow
@pytest.mark.parametrize("size", [1000, 2000, 4000])
def test_clean_scene_loses_nothing_visible(size: int) -> None:
    scene = bear_stack(size).scene
    _, worst = picture_difference(scene, clean(scene, find_strays(scene)))
    assert worst >= ONE_STEP_DB


def test_removing_invisible_gaussians_changes_no_pixel() -> None:
    scene = bear()
    faint = replace(scene, logit_opacities=scene.logit_opacities.clone())
    faint.logit_opacities[::3] = -5.6  # 1/271
    strays = Strays(np.arange(0, len(scene), 3), *[np.zeros(0, np.int64)] * 3)
    assert np.array_equal(find_strays(faint).faint, strays.faint)
    assert picture_difference(faint, clean(faint, strays)) == (99.0, 99.0)


@pytest.mark.parametrize("count", [1, 10, 70])
def test_few_or_coincident_gaussians_have_no_strays(count: int) -> None:
    assert find_strays(bear()[:count]).describe() == "none"
    assert find_strays(one_gaussian()[torch.zeros(count, dtype=torch.int64)]).describe() == "none"


def crowded() -> Gaussians:
    """Return the scene with strays, with a third of the bear's rows at one position."""
    scene, _ = littered()
    means = scene.means.clone()
    means[::3] = scene.means.median(dim=0).values
    return replace(scene, means=means)


@pytest.mark.parametrize("exact", [strays._MAX_EXACT_GAUSSIANS, 0])
@pytest.mark.parametrize("make", [lambda: littered()[0], crowded, bear, lambda: random_gaussians(3000, 1)])
def test_shortcuts_find_the_strays_of_a_full_search(
    make: Callable[[], Gaussians], exact: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strays, "_MAX_EXACT_GAUSSIANS", exact)
    scene = make()
    found = find_strays(scene)
    assert {kind: getattr(found, kind).tolist() for kind in plain_strays.KINDS} == plain_strays.find_strays(
        scene
    )


@pytest.mark.parametrize("returned", [0, 40])
def test_cached_neighborhoods_equal_new_ones_after_members_change(returned: int) -> None:
    draws = np.random.default_rng(0)
    points = draws.normal(size=(2000, 3)).astype(np.float32)
    points[:60] = 0.01 * points[:60] + 5.0  # leaves together, so that the tree is built again
    extents = draws.uniform(0.0, 0.4, 2000)
    cached = strays._Neighborhoods(points, extents)
    is_member = np.ones(2000, bool)
    for _ in range(4):
        cached.set_members(is_member.copy())
        fresh = strays._Neighborhoods(points, extents)
        fresh.set_members(is_member.copy())
        everyone = np.arange(2000)
        assert np.array_equal(cached.find_isolated(), fresh.find_isolated())
        assert np.array_equal(cached.emptiness(everyone, ends), fresh.emptiness(everyone, ends))
        assert np.array_equal(cached.loneliness(cached.members), fresh.loneliness(fresh.members))
        is_member[draws.integers(0, 2000, 40)] = False
        is_member[:55] = False
        is_member[draws.integers(0, 2000, returned)] = True


def ends(rows: strays.Rows) -> strays.Floats:
    """Return four positions for each row. [M] -> [M,4,3]"""
    return np.sin(rows[:, None, None] + 10.0 * np.arange(12.0).reshape(4, 3))


def test_large_scene_searches_few_neighborhoods(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []
    search = strays._Neighborhoods._search

    def counted(
        body: strays._Neighborhoods, rows: strays.Rows, count: int
    ) -> tuple[strays.Floats, strays.Rows]:
        searched.append(len(rows))
        return search(body, rows, count)

    monkeypatch.setattr(strays._Neighborhoods, "_search", counted)
    for limit in ("_MAX_EXACT_GAUSSIANS", "_EMPTINESS_SAMPLE", "_LONELINESS_SAMPLE"):
        monkeypatch.setattr(strays, limit, 100)
    scene = concatenate(*[replace(littered()[0], means=littered()[0].means + 50.0 * i) for i in range(5)])
    assert len(find_strays(scene).rows) == 5 * 23
    assert sum(searched) < len(scene), "of all rounds together"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plant.ply", "playbot_31k.ply"])
def test_real_scene_is_clean_after_cleaning(name: str) -> None:
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not here")
    scene = load_ply(path)
    cleaned = clean(scene, find_strays(scene))
    assert 0 < len(scene) - len(cleaned) < len(scene) // 100
    assert find_strays(cleaned).describe() == "none"


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 0
    return capsys.readouterr().out


def test_clean_writes_a_scene_without_strays_and_reports_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene, _ = littered()
    save_ply("dirty.ply", scene)
    before = Path("dirty.ply").read_bytes()
    assert "progdf edit dirty.ply --clean -o CLEAN.ply leaves them out" in run(capsys, "info", "dirty.ply")
    lines = run(capsys, "edit", "dirty.ply", "--clean", "-o", "clean.ply").splitlines()
    assert lines[0].startswith("clean: 23 of 3 023 Gaussians removed: ")
    assert lines[1].startswith("rendered views: ")
    assert lines[2] == "wrote clean.ply: 3 000 Gaussians"
    assert "labels and edits of dirty.ply no longer fit" in lines[3]
    assert "progdf rebind EDIT.gdf --from dirty.ply --to clean.ply -o NEW.gdf" in lines[3]
    assert Path("dirty.ply").read_bytes() == before
    again = run(capsys, "edit", "clean.ply", "--clean", "-o", "again.ply").splitlines()
    assert again == ["clean: there are no strays", "wrote again.ply: 3 000 Gaussians"]
    assert Path("again.ply").read_bytes() == Path("clean.ply").read_bytes()
    assert "strays" not in run(capsys, "info", "clean.ply")


def test_edit_is_carried_over_to_the_cleaned_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    stack = bear_stack(3000)
    path, scarf, _ = stack.save(tmp_path)
    faint = replace(stack.scene, logit_opacities=stack.scene.logit_opacities.clone())
    faint.logit_opacities[5:40:5] = -9.0
    save_ply("clean.ply", clean(faint, find_strays(faint)))
    run(capsys, "rebind", str(scarf), "--from", str(path), "--to", "clean.ply", "-o", "new.gdf")
    cleaned = load_ply("clean.ply")
    members = load_gdf(Path("new.gdf"), cleaned).region.members
    expected = set(stack.gdfs[0].region.members.tolist()) - set(range(5, 40, 5))
    rows = [row for row in range(3000) if row not in range(5, 40, 5)]
    assert {rows[int(i)] for i in members} == expected


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("-o", "x.ply"), "no change is requested; add at least one option, for example --clean"),
        (("--clean", "-o", "x.obj"), "x.obj does not end in a known format"),
        (("--clean", "-o", "bear.ply"), "bear.ply is one of the files to read; choose another name"),
    ],
)
def test_impossible_edit_is_reported_in_one_line(
    arguments: tuple[str, ...],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    save_ply("bear.ply", bear())
    assert main(["edit", "bear.ply", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"progdf: {line}")
    assert error.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["bear.ply"]


def test_scene_without_visible_gaussians_is_not_cleaned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_ply(tmp_path / "a.ply", one_gaussian(opacity=0.001))
    assert main(["edit", str(tmp_path / "a.ply"), "--clean", "-o", str(tmp_path / "b.ply")]) == 2
    assert "no visible Gaussian" in capsys.readouterr().err


def test_attributes_of_remaining_rows_keep_their_bits() -> None:
    scene, _ = littered()
    strays = find_strays(scene)
    rows = np.setdiff1d(np.arange(len(scene)), strays.rows)
    for name in ATTRIBUTES:
        assert torch.equal(getattr(clean(scene, strays), name), getattr(scene, name)[rows])
