"""Tests of trainer checkpoints: names of several trainers, several GPUs, and refused files."""

from __future__ import annotations

import resource
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from progdf.__main__ import main
from progdf.cli.info import describe
from progdf.formats.scene_file import load_scene, load_scene_with_report
from progdf.gaussians import ATTRIBUTES, Gaussians
from tests.helpers.checkpoints import gsplat_tensors, nerfstudio_tensors, save_gsplat
from tests.helpers.ply_files import assert_same, scene_of, table_of, write
from tests.helpers.refused import refusal


def saved(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


PREFIXES = {
    "splatfacto 1.0": "_model.",
    "splatfacto 1.1": "_model.gauss_params.",
    "DDP around the model": "_model.module.gauss_params.",
    "DDP around the pipeline": "module._model.gauss_params.",
    "a pipeline in a pipeline": "pipeline._model.",
}


@pytest.mark.parametrize("prefix", PREFIXES.values(), ids=PREFIXES)
def test_names_of_every_splatfacto_are_read(prefix: str, tmp_path: Path) -> None:
    scene = scene_of(2, 12)
    tensors = nerfstudio_tensors(scene)
    content = {"step": 1, "pipeline": {f"{prefix}{name}": tensor for name, tensor in tensors.items()}}
    assert_same(load_scene(saved(tmp_path / "a.ckpt", content)), scene)


def test_parameters_half_floats_and_older_gsplat_names_are_read(tmp_path: Path) -> None:
    scene = scene_of(1, 12)
    tensors = gsplat_tensors(scene)
    tensors["means3d"] = tensors.pop("means")
    parameters = {name: torch.nn.Parameter(tensor) for name, tensor in tensors.items()}
    assert_same(load_scene(saved(tmp_path / "a.pt", {"splats": OrderedDict(parameters)})), scene)
    halves = {name: tensor.half() for name, tensor in tensors.items()}
    found = load_scene(saved(tmp_path / "b.pt", halves))
    assert torch.equal(found.sh0, scene.sh0.half().float())
    tensors.pop("shN")
    assert load_scene(saved(tmp_path / "c.pt", tensors)).sh_degree == 0


def test_doubles_far_from_zero_keep_their_positions(tmp_path: Path) -> None:
    tensors = gsplat_tensors(scene_of(0, 12))
    far = torch.tensor([5e6, 0.0, 0.0], dtype=torch.float64)
    tensors["means"] = tensors["means"].double() + far
    found = load_scene(saved(tmp_path / "a.pt", {"splats": tensors}))
    assert torch.allclose(found.world_means, tensors["means"], rtol=0.0, atol=1e-6)


def test_checkpoint_values_are_copied(tmp_path: Path) -> None:
    scene = scene_of(1, 12)
    path = saved(tmp_path / "a.pt", {"splats": gsplat_tensors(scene)})
    found = load_scene(path)
    with path.open("r+b") as file:
        file.write(b"\0" * path.stat().st_size)
    assert_same(found, scene)


def sparse(tensor: Tensor) -> Tensor:
    return tensor.to_sparse()


SPECIAL: dict[str, tuple[Callable[[Tensor], Any], str]] = {
    "sparse": (sparse, "sparse tensors"),
    "CSR": (lambda tensor: tensor.to_sparse_csr(), "sparse tensors"),
    "meta": (lambda tensor: tensor.to("meta"), "tensors without numbers"),
    "quantized": (lambda t: torch.quantize_per_tensor(t, 0.1, 0, torch.qint8), "quantized tensors"),
    "complex": (lambda tensor: tensor.to(torch.complex64), "'means' as complex64 numbers"),
    "int": (lambda tensor: tensor.int(), "'means' as int32 numbers"),
    "bool": (lambda tensor: tensor > 0, "'means' as bool numbers"),
    "flat": (lambda tensor: tensor.reshape(-1), "'means' of shape 36"),
    "a scalar": (lambda tensor: tensor[0, 0], "'means' of shape a single number"),
    "expanded": (lambda tensor: torch.zeros(1, 3).expand(12, 3), "'means' as an expanded view"),
    "bytes": (lambda tensor: bytearray(12), "more than weights"),
    "numpy": (lambda tensor: tensor.numpy(), "more than weights"),
}


@pytest.mark.filterwarnings("ignore:Sparse CSR:UserWarning", "ignore:.*quantize:")
@pytest.mark.parametrize("kind", SPECIAL)
def test_tensors_that_are_not_plain_floats_are_named(kind: str, tmp_path: Path) -> None:
    change, named = SPECIAL[kind]
    tensors: dict[str, Any] = dict(gsplat_tensors(scene_of(1, 12)))
    tensors["means"] = change(tensors["means"])
    path = saved(tmp_path / "a.pt", {"splats": tensors})
    message = refusal(load_scene, path)
    assert named in message
    assert "damaged" not in message
    assert main(["info", str(path)]) == 2


def test_expanded_tensors_allocate_no_memory(tmp_path: Path) -> None:
    count = 30_000_000
    zeros = {
        "means": torch.zeros(1).expand(count, 3),
        "quats": torch.zeros(1).expand(count, 4),
        "scales": torch.zeros(1).expand(count, 3),
        "opacities": torch.zeros(1).expand(count),
        "sh0": torch.zeros(1).expand(count, 1, 3),
        "shN": torch.zeros(1).expand(count, 15, 3),
    }
    path = saved(tmp_path / "a.pt", {"splats": zeros})
    assert path.stat().st_size < 10_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "as an expanded view (360000000 bytes from 4 stored ones)" in refusal(load_scene, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB"


def rewritten(path: Path, change: Callable[[bytes], bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """Rewrite the archive with another pickle."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, change(content) if name.endswith("/data.pkl") else content)
    return path


DAMAGES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut": (lambda pickled: pickled[: len(pickled) // 2], "is damaged: its pickle breaks off"),
    "empty": (lambda pickled: b"", "is damaged: its pickle breaks off"),
    "noise": (lambda pickled: b"\xff" * 40, "is damaged: its pickle breaks off"),
    "nothing": (lambda pickled: b"\x80\x02.", "is damaged: its table of tensors is inconsistent"),
    "no such file": (lambda pickled: pickled.replace(b"\x01\0\0\x000", b"\x01\0\0\0Z"), "damaged"),
    "more rows": (lambda pickled: pickled.replace(b"K\x0cK\x03\x86", b"M\xff\xffK\x03\x86"), "is damaged"),
    "protocol 4": (lambda pickled: b"\x80\x04" + pickled[2:], "uses pickle protocol 4"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_pickles_are_reported_in_one_line(damage: str, tmp_path: Path) -> None:
    change, named = DAMAGES[damage]
    path = saved(tmp_path / "a.pt", {"splats": gsplat_tensors(scene_of(1, 12))})
    assert named in refusal(load_scene, rewritten(path, change))
    assert main(["info", str(path)]) == 2


def test_archives_that_torch_does_not_write_are_named(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.pt", {"splats": gsplat_tensors(scene_of(1, 12))})
    assert "a compressed archive" in refusal(load_scene, rewritten(path, bytes, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(tmp_path / "b.pt", "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "not a checkpoint of torch" in refusal(load_scene, tmp_path / "b.pt")
    with zipfile.ZipFile(tmp_path / "c.pt", "w") as archive:
        archive.writestr("c/data.pkl", b"")
        archive.writestr("c/constants.pkl", b"")
    assert "TorchScript" in refusal(load_scene, tmp_path / "c.pt")
    torch.save({"a": torch.zeros(2)}, tmp_path / "d.pt", _use_new_zipfile_serialization=False)
    assert "torch before 1.6" in refusal(load_scene, tmp_path / "d.pt")


FOREIGN = {
    "LFS pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\n", "is a Git LFS pointer"),
    "web page": (b"<html></html>", "is a web page"),
    "empty": (b"", "is empty"),
    "text": (b"hello", "is a text file"),
    "noise": (b"\xff\x81" * 40, "is not a checkpoint of torch"),
    "Parquet": (b"PAR1" + b"a" * 40, "is a Parquet table"),
    "safetensors": (b"\x40\0\0\0\0\0\0\0" + b'{"means": {}}', "is a safetensors file, but no scene"),
}


@pytest.mark.parametrize("kind", FOREIGN)
@pytest.mark.parametrize("name", ["a.ckpt", "a.pt", "a.pth"])
def test_files_that_are_not_checkpoints_are_named(kind: str, name: str, tmp_path: Path) -> None:
    content, named = FOREIGN[kind]
    (tmp_path / name).write_bytes(content)
    message = refusal(load_scene, tmp_path / name)
    assert named in message
    assert "damaged" not in message


def test_taichi_table_is_named_with_its_converter(tmp_path: Path) -> None:
    path = tmp_path / "scene_29999.parquet"
    path.write_bytes(b"PAR1" + b"a" * 40)
    assert "parquet_to_ply.py" in refusal(load_scene, path)
    assert "parquet_to_ply.py" in refusal(describe, path)


COLOR_FIELDS = {
    "gsplat's app_opt": ({"splats": {"features": torch.zeros(12, 32)}}, "'features'"),
    "its colors": ({"splats": {"colors": torch.zeros(12, 3)}}, "'colors'"),
    "its network": ({"app_module": {"embeds.weight": torch.zeros(4, 16)}}, "'app_module'"),
    "bilateral grids of gsplat": ({"post_processing": {"grids": torch.zeros(4, 16)}}, "'post_processing'"),
    "bilateral grids of splatfacto": (
        {"pipeline": {"_model.bil_grids.grids": torch.zeros(4)}},
        "'bil_grids'",
    ),
    "splatfacto-w": (
        {"pipeline": {"_model.appearance_embeds.weight": torch.zeros(4)}},
        "'appearance_embeds'",
    ),
    "time": ({"splats": {"motion": torch.zeros(12, 9)}}, "'motion'"),
}


@pytest.mark.parametrize("field", COLOR_FIELDS)
def test_fields_that_change_colors_or_positions_are_refused_by_name(field: str, tmp_path: Path) -> None:
    more, named = COLOR_FIELDS[field]
    content: dict[str, Any] = {"splats": dict(gsplat_tensors(scene_of(1, 12)))}
    for table, tensors in more.items():
        content[table] = {**content.get(table, {}), **tensors}
    assert named in refusal(load_scene, saved(tmp_path / "a.pt", content))


def test_harmless_tensors_are_listed(tmp_path: Path) -> None:
    pipeline = {f"_model.{name}": tensor for name, tensor in nerfstudio_tensors(scene_of(1, 12)).items()}
    pipeline |= {"_model.camera_optimizer.pose_adjustment": torch.zeros(2, 6)}
    pipeline |= {"_model.lpips.net.weight": torch.zeros(3), "_model.lpips.net.bias": torch.zeros(3)}
    content = {"pipeline": pipeline, "optimizers": {"means": {"state": {0: {"exp_avg": torch.zeros(12, 3)}}}}}
    _, report = load_scene_with_report(saved(tmp_path / "a.ckpt", content))
    assert report.ignored_properties == ("camera_optimizer", "lpips")


def test_training_state_of_the_original_code_is_named(tmp_path: Path) -> None:
    columns = [torch.nn.Parameter(getattr(scene_of(1, 12), name)) for name in ATTRIBUTES]
    content = ((3, *columns, {"state": {}}, 1.0), 30_000)
    message = refusal(load_scene, saved(tmp_path / "chkpnt30000.pth", content))
    assert "original 3DGS code" in message
    assert "point_cloud.ply" in message


def two_ranks(folder: Path, step: int = 29999) -> tuple[Gaussians, Path, Path]:
    scene = scene_of(1, 21)
    folder.mkdir(parents=True, exist_ok=True)
    first = save_gsplat(folder / f"ckpt_{step}_rank0.pt", scene[:10], step)
    return scene, first, save_gsplat(folder / f"ckpt_{step}_rank1.pt", scene[10:], step)


def test_ranks_of_a_training_are_read_together(tmp_path: Path) -> None:
    scene, first, second = two_ranks(tmp_path)
    two_ranks(tmp_path, 6999)
    for path in (first, second):
        found, report = load_scene_with_report(path)
        assert_same(found, scene)
        assert report.format == "checkpoint of a training in 2 parts, one per GPU"
        assert report.file_bytes == first.stat().st_size + second.stat().st_size


def test_missing_rank_is_named(tmp_path: Path) -> None:
    _, first, second = two_ranks(tmp_path / "ckpts")
    first.unlink()
    assert "ckpt_29999_rank0.pt is missing" in refusal(load_scene, second)
    second.rename(first)
    assert len(load_scene(first)) == 11, "a training on one GPU"
    (tmp_path / "stats").mkdir()
    (tmp_path / "stats" / "train_step29999_rank0.json").touch()
    assert len(load_scene(first)) == 11
    (tmp_path / "stats" / "train_step29999_rank2.json").touch()
    message = refusal(load_scene, first)
    assert "ckpt_29999_rank1.pt, ckpt_29999_rank2.pt is missing" in message
    assert main(["info", str(first)]) == 2


def test_ranks_of_different_trainings_are_not_joined(tmp_path: Path) -> None:
    scene, first, second = two_ranks(tmp_path)
    save_gsplat(second, scene[10:], step=7)
    assert f"{second} does not belong to {first.name}" in refusal(load_scene, second)
    save_gsplat(second, scene_of(2, 11), step=29999)
    assert f"{second} does not belong to {first.name}" in refusal(load_scene, second)


def test_single_part_of_a_scene_is_not_bundled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, first, _ = two_ranks(tmp_path)
    assert main(["export", str(first), "-o", str(tmp_path / "a.progdf.zip")]) == 2
    assert "one of several parts of a scene; export the scene as a .ply" in capsys.readouterr().err
    assert not (tmp_path / "a.progdf.zip").exists()


def test_parts_of_grendel_are_joined(tmp_path: Path) -> None:
    scene = scene_of(1, 30)
    paths = []
    for rank in range(3):
        rows = slice(10 * rank, 10 * rank + 10)
        paths.append(write(tmp_path / f"point_cloud_rk{rank}_ws3.ply", table_of(scene[rows])))
    assert_same(load_scene(paths[1]), scene)
    paths[2].unlink()
    assert "point_cloud_rk2_ws3.ply is missing" in refusal(load_scene, paths[0])


@pytest.mark.parametrize("name", ["room_part_1_of_3.ply", "room-00001-of-00003.ply", "part2of2.ply"])
def test_parts_of_unknown_trainers_are_named(name: str, tmp_path: Path) -> None:
    assert "a name for part" in refusal(load_scene, write(tmp_path / name, table_of(scene_of(0, 9))))


@pytest.mark.parametrize("name", ["turn_1_of_25.ply", "point_cloud_7000.ply", "part_1_of_1.ply", "rank0.ply"])
def test_names_of_whole_scenes_are_not_parts(name: str, tmp_path: Path) -> None:
    assert len(load_scene(write(tmp_path / name, table_of(scene_of(0, 9))))) == 9
