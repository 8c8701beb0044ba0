"""Streamed SOG scenes (lod-meta.json): the finest level of every tile, and refusals of broken indices."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from progdf.__main__ import main
from progdf.cli.info import kind_of
from progdf.formats.scene_file import load_scene, load_scene_with_report, save_scene
from progdf.gaussians import ATTRIBUTES, concatenate
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_sog1
from tests.helpers.scenes import random_gaussians

SCENE = random_gaussians(60, seed=4, sh_degree=1)


def write_tree(folder: Path, changes: dict[str, Any] | None = None) -> Path:
    """Write two tiles of 30 rows and a coarser one of 10. Return the folder.

    The first leaf has rows 0 to 20 of the first tile, the second its last 10, and the third the second tile.
    """
    folder.mkdir()
    write_sog1(folder / "0_0", SCENE[:30])
    write_sog1(folder / "0_1", SCENE[30:])
    write_sog1(folder / "1_0", SCENE[:10])
    leaves = [
        {"lods": {"0": _rows(0, 0, 20), "1": _rows(1, 0, 6)}},
        {"lods": {"0": _rows(0, 20, 10), "1": _rows(1, 6, 4)}},
        {"lods": {"0": _rows(2, 0, 30)}},
    ]
    index = {
        "lodLevels": 2,
        "environment": None,
        "filenames": ["0_0/meta.json", "1_0/meta.json", "0_1/meta.json"],
        "tree": {"bound": {}, "children": [{"children": leaves[:2]}, leaves[2]]},
        **(changes or {}),
    }
    (folder / "lod-meta.json").write_text(json.dumps(index))
    return folder


def _rows(file: int, offset: int, count: int) -> dict[str, int]:
    return {"file": file, "offset": offset, "count": count}


def test_tree_opens_at_its_finest_level_by_folder_and_by_index(tmp_path: Path) -> None:
    folder = write_tree(tmp_path / "town")
    tiles = [load_scene(folder / name) for name in ("0_0", "0_1")]
    expected = concatenate(tiles)
    for path in (folder, folder / "lod-meta.json"):
        assert kind_of(path) == "scene"
        scene, report = load_scene_with_report(path)
        for name in ATTRIBUTES:
            assert torch.equal(getattr(scene, name), getattr(expected, name))
        assert report.file == "town"
        assert "the finest level in 2 tiles (coarser levels of 10 Gaussians are not read)" in report.format
        used = ("0_0", "0_1")
        stored = sum(file.stat().st_size for name in used for file in (folder / name).iterdir())
        assert report.file_bytes == stored + (folder / "lod-meta.json").stat().st_size
    assert main(["info", str(folder)]) == 0


def test_surroundings_of_a_tree_are_read(tmp_path: Path) -> None:
    folder = write_tree(tmp_path / "town", {"environment": "env/meta.json"})
    write_sog1(folder / "env", SCENE[:5])
    scene = load_scene(folder)
    assert len(scene) == 65
    assert torch.equal(scene.means[60:], load_scene(folder / "env").means)


def test_leaf_without_the_finest_level_uses_its_own_finest(tmp_path: Path) -> None:
    leaves = [{"lods": {"1": _rows(1, 0, 10)}}, {"lods": {"0": _rows(2, 0, 30)}}]
    folder = write_tree(tmp_path / "town", {"tree": {"children": leaves}})
    assert len(load_scene(folder)) == 40


def test_opened_tree_is_written_as_one_file(tmp_path: Path) -> None:
    scene = load_scene(write_tree(tmp_path / "town"))
    save_scene(tmp_path / "town.ply", scene)
    assert torch.equal(load_scene(tmp_path / "town.ply").means, scene.means)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 2}, "version 2 of a streamed SOG scene"),
        ({"filenames": ["../a/meta.json", "1_0/meta.json", "0_1/meta.json"]}, "outside its folder"),
        ({"filenames": ["/a/meta.json", "1_0/meta.json", "0_1/meta.json"]}, "outside its folder"),
        ({"filenames": ["9_9/meta.json", "1_0/meta.json", "0_1/meta.json"]}, "9_9/meta.json is missing"),
        ({"filenames": []}, "names rows that no tile has"),
        ({"tree": {"lods": {"0": _rows(0, 25, 10)}}}, "lod-meta.json names row 34"),
        ({"tree": {"lods": {"0": _rows(0, -1, 10)}}}, "names rows that no tile has"),
        ({"tree": {"lods": {"5": _rows(0, 0, 10)}}}, "names a level that is not one of 2"),
        ({"tree": {"lods": {"fine": _rows(0, 0, 10)}}}, "names a level that is not one of 2"),
        ({"tree": {"children": 2 * [{"lods": {"0": _rows(0, 0, 10)}}]}}, "two leaves name the same rows"),
        ({"tree": {}}, "holds 0 Gaussians"),
        ({"tree": 3}, "in lod-meta.json, tree is 3, expected object, got int"),
        ({"tree": {"lods": {"0": {"file": 0}}}}, "in lod-meta.json, tree.lods[...].offset is missing"),
        ({"tree": {"lods": {"0": 3}}}, "in lod-meta.json, tree.lods[...]: expected object, got int"),
        ({"lodLevels": 0}, "in lod-meta.json, lodLevels is 0, expected int >= 1"),
    ],
)
def test_broken_index_is_refused_in_one_line(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    message = refusal(load_scene, write_tree(tmp_path / "town", changes))
    assert said in message
    assert "\n" not in message


def test_missing_field_of_the_index_is_named(tmp_path: Path) -> None:
    folder = write_tree(tmp_path / "town")
    (folder / "lod-meta.json").write_text('{"lodLevels": 2, "filenames": []}')
    assert "is damaged: in lod-meta.json, tree is missing; " in refusal(load_scene, folder)


def test_memory_does_not_grow_with_the_stated_number_of_levels(tmp_path: Path) -> None:
    assert len(load_scene(write_tree(tmp_path / "town", {"lodLevels": 10**15}))) == 60


def test_tile_behind_a_link_is_refused(tmp_path: Path) -> None:
    folder = write_tree(tmp_path / "town")
    (folder / "0_0").rename(tmp_path / "elsewhere")
    (folder / "0_0").symlink_to(tmp_path / "elsewhere")
    assert "0_0/meta.json is a link" in refusal(load_scene, folder)


def test_tiles_of_different_degrees_are_refused(tmp_path: Path) -> None:
    folder = write_tree(tmp_path / "town")
    shutil.rmtree(folder / "0_1")
    write_sog1(folder / "0_1", random_gaussians(30, seed=1))
    assert "differs from other tiles in SH degree" in refusal(load_scene, folder)
