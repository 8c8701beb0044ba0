"""SOG scenes, versions 1 and 2: values, limits, and refusals of unsupported versions and features."""

from __future__ import annotations

import io
import json
import os
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.cli.info import kind_of
from progdf.formats.scene_file import load_scene, load_scene_with_report
from progdf.gaussians import Gaussians
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_scene, write_sog1, write_zip
from tests.helpers.scenes import random_gaussians


def scene_of(degree: int = 0) -> Gaussians:
    """Return a scene of two image rows and a part of a third."""
    return random_gaussians(40, seed=4, sh_degree=degree)


def change_table(folder: Path, changes: dict[str, Any]) -> Path:
    """Set values of a folder's meta.json by dotted names. Return the folder."""
    meta = folder / "meta.json"
    table = json.loads(meta.read_text())
    for name, value in changes.items():
        *above, last = name.split(".")
        inner = table
        for key in above:
            inner = inner[key]
        inner[last] = value
    meta.write_text(json.dumps(table))
    return folder


def unpacked_sog2(folder: Path, degree: int = 1) -> Path:
    """Write a folder of version 2."""
    with zipfile.ZipFile(write_scene(folder.with_suffix(".sog"), scene_of(degree))) as archive:
        archive.extractall(folder)
    return folder


def test_unpacked_sog_opens_by_its_folder_and_by_meta_json(tmp_path: Path) -> None:
    bundle = write_scene(tmp_path / "scene.sog", scene_of(1))
    folder = tmp_path / "robot"
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(folder)
    expected = load_scene(bundle)
    for path in (folder, folder / "meta.json"):
        assert kind_of(path) == "scene"
        scene, report = load_scene_with_report(path)
        assert torch.equal(scene.means, expected.means)
        assert report.file == "robot"
    assert main(["info", str(folder)]) == 0


def test_sog_that_names_files_elsewhere_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(write_scene(tmp_path / "scene.sog", scene_of())) as archive:
        archive.extractall(tmp_path / "robot")
    meta = tmp_path / "robot" / "meta.json"
    table = json.loads(meta.read_text())
    table["quats"]["files"] = ["../../secret.webp"]
    meta.write_text(json.dumps(table))
    assert "names images outside its folder" in refusal(load_scene, meta)


@pytest.mark.parametrize("kind", ["link", "pipe", "folder", "missing"])
def test_sog_image_that_is_no_regular_file_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(write_scene(tmp_path / "scene.sog", scene_of())) as archive:
        archive.extractall(tmp_path / "robot")
    image = tmp_path / "robot" / "quats.webp"
    image.rename(tmp_path / "outside.webp")
    if kind == "link":
        image.symlink_to(tmp_path / "outside.webp")
    elif kind == "pipe":
        os.mkfifo(image)
    elif kind == "folder":
        image.mkdir()
    assert "quats.webp is missing, a link or no regular file" in refusal(load_scene, tmp_path / "robot")


@pytest.mark.parametrize("packed", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, None])
def test_sog_table_size_is_bounded_before_parsing(packed: int | None, tmp_path: Path) -> None:
    """Write 15 kB that unpack to 16 MB, also in an archive that declares 2 bytes."""
    content = b'{"means": {}, "quats": [' + b"0," * 7_999_900 + b"0]}"
    path = tmp_path / ("meta.json" if packed is None else "a.sog")
    if packed is None:
        path.write_bytes(content)
    else:
        with zipfile.ZipFile(path, "w", packed) as archive:
            archive.writestr("meta.json", content)
        path.write_bytes(path.read_bytes().replace(len(content).to_bytes(4, "little"), b"\2\0\0\0"))
    tracemalloc.start()
    refusal(load_scene, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


def test_oversized_sog_table_is_named(tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text('{"means": {}, "quats": "' + "a" * (1 << 20) + '"}')
    assert "a meta.json of more than 1 MB" in refusal(load_scene, tmp_path / "meta.json")


def test_sog1_positions_are_within_half_a_step(tmp_path: Path) -> None:
    scene = scene_of(3)
    found, report = load_scene_with_report(write_sog1(tmp_path / "robot", scene))
    logs = scene.means.sign() * scene.means.abs().log1p()
    found_logs = found.means.sign() * found.means.abs().log1p()
    step = (logs.amax(dim=0) - logs.amin(dim=0)) / 65535
    assert bool(((found_logs - logs).abs() <= 0.51 * step).all())
    assert report.format == ".sog 1"
    assert report.sh_degree == 3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 3}, "SOG version 3, which is not supported; convert it with `splat-transform"),
        ({"version": "2b"}, "SOG version 2b"),
        ({"quats.encoding": "euler"}, "quats.encoding 'euler'"),
        ({"shN.quantization": 6}, "shN.quantization 6"),
        ({"model": "2dgs"}, "the model '2dgs'"),
        ({"means.mins": [0.0, 0.0]}, "is damaged: means.mins is not a list of 3 numbers"),
        ({"sh0.maxs": [1.0, 1.0, 1.0]}, "is damaged: sh0.maxs is not a list of 4 numbers"),
        ({"shN.mins": [0.0]}, "shN.mins and shN.maxs are not numbers"),
        ({"means.shape": [5000, 3]}, "means_l.webp has 48 pixels for 5000 Gaussians"),
        ({"means.shape": []}, "holds 0 Gaussians"),
        ({"means.files": ["means_l.webp"]}, "means names 1 images, the format has 2"),
        ({"shN.files": ["quats.webp", "shN_labels.webp"]}, "quats.webp is 16 pixels wide"),
        ({"scales.mins": "0"}, "is damaged: in meta.json, scales.mins is '0'"),
    ],
)
def test_unsupported_sog1_table_is_named(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    folder = change_table(write_sog1(tmp_path / "robot", scene_of(1)), changes)
    assert said in refusal(load_scene, folder)


@pytest.mark.parametrize("version", [3, 9])
def test_future_sog_versions_are_refused_by_number(version: int, tmp_path: Path) -> None:
    folder = change_table(unpacked_sog2(tmp_path / "robot"), {"version": version})
    assert f"uses SOG version {version}, which is not supported" in refusal(load_scene, folder)


def test_short_codebook_of_sog2_is_damage(tmp_path: Path) -> None:
    folder = change_table(unpacked_sog2(tmp_path / "robot"), {"scales.codebook": [0.0] * 255})
    assert "scales.codebook is not a list of 256 numbers" in refusal(load_scene, folder)


def test_empty_first_codebook_entry_continues_the_others(tmp_path: Path) -> None:
    folder = unpacked_sog2(tmp_path / "robot")
    codebook = [index / 100.0 for index in range(256)]
    expected = load_scene(change_table(folder, {"sh0.codebook": codebook}))
    found = load_scene(change_table(folder, {"sh0.codebook": [None, *codebook[1:]]}))
    row = expected.sh0 == 0.0
    assert bool(row.any())
    assert torch.allclose(found.sh0[row], torch.tensor(0.01 - 2.54 / 255))
    assert torch.equal(found.sh0[~row], expected.sh0[~row])


def test_label_outside_the_palette_is_damage(tmp_path: Path) -> None:
    folder = write_sog1(tmp_path / "robot", scene_of(1))
    Image.new("RGB", (16, 3), (255, 1, 0)).save(folder / "shN_labels.webp", lossless=True)
    assert "names row 511 of a palette of 64" in refusal(load_scene, folder)


def test_unknown_fields_of_a_sog_are_listed(tmp_path: Path) -> None:
    folder = change_table(write_sog1(tmp_path / "robot", scene_of()), {"license": "CC0", "asset": {}})
    assert load_scene_with_report(folder)[1].ignored_properties == ("license",)


def test_image_that_claims_too_many_pixels_is_refused(tmp_path: Path) -> None:
    folder = write_sog1(tmp_path / "robot", scene_of())
    Image.new("RGB", (4000, 4000)).save(folder / "scales.webp", lossless=True)
    tracemalloc.start()
    assert "scales.webp claims 4000x4000 pixels" in refusal(load_scene, folder)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


@pytest.mark.parametrize("prefix", ["", "robot/"])
def test_zipped_sog_folder_opens_under_any_name(prefix: str, tmp_path: Path) -> None:
    folder = write_sog1(tmp_path / "robot", scene_of(1))
    contents = {f"{prefix}{file.name}": file.read_bytes() for file in folder.iterdir()}
    path = write_zip(tmp_path / "download.zip", contents | {"__MACOSX/robot/meta.json": b"x"})
    assert kind_of(path) == "scene"
    assert torch.equal(load_scene(path).means, load_scene(folder).means)


def test_png_images_are_accepted(tmp_path: Path) -> None:
    folder = write_sog1(tmp_path / "robot", scene_of())
    expected = load_scene(folder)
    stream = io.BytesIO()
    Image.open(folder / "quats.webp").save(stream, "PNG")
    (folder / "quats.png").write_bytes(stream.getvalue())
    found = load_scene(change_table(folder, {"quats.files": ["quats.png"]}))
    assert torch.equal(found.quats, expected.quats)


def test_archive_without_images_is_damaged(tmp_path: Path) -> None:
    folder = write_sog1(tmp_path / "robot", scene_of())
    path = write_zip(tmp_path / "a.sog", {"meta.json": (folder / "meta.json").read_bytes()})
    assert "is damaged: means_l.webp is missing" in refusal(load_scene, path)
    path.write_bytes(b"PK\3\4 cut")
    assert "no readable meta.json" in refusal(load_scene, path)
