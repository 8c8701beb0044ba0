"""Hostile checkpoints and .ply files of other trainers, for `fuzz.py`."""

from __future__ import annotations

import random
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from progdf.formats.ply_view import stored_view
from progdf.formats.scene_file import load_scene_with_report
from progdf.gaussians import ATTRIBUTES
from progdf.scene.up_axis import find_up
from tests.helpers.checkpoints import gsplat_tensors, nerfstudio_tensors
from tests.helpers.fuzz_changes import VALUES, Change, changed_bytes, changed_tensors
from tests.helpers.ply_files import scene_of, sharp_elements, table_of, write

Reader = tuple[str, Callable[[Path], Any], list[Change]]

COMMENTS = (
    "Vertical Axis: z",
    "vertical axis: 0 -1 0",
    "up_axis=-x",
    "Exported from Brush",
    "Vertical axis: 1e999 0 0",
)
FIELDS = ("filter_3D", "red", "green", "blue", "t", "beta", "scale_3", "label", "f_rest_9", "x ", "opacity_")
NUMBERS = (0.0, -1.0, 1.0, 2.0, 1e-30, 1e30, -1e300, float("nan"), float("inf"), 2.0**32)
PICKLE_PARTS = (b"\x80\x02", b"}q\x00", b"(", b"t", b"R", b"Q", b".", b"K\x00", b"J\xff\xff\xff\x7f", b"0")


def trainer_inputs(folder: Path, reader: str) -> dict[str, Reader]:
    """Return the requested reader like `fuzz.inputs`, or nothing if it is defined elsewhere."""
    makers = {"checkpoints": _checkpoints, "plys of trainers": _plys}
    return {reader: makers[reader](folder)} if reader in makers else {}


def silently(change: Change) -> Change:
    """Return a change that suppresses the warnings of the libraries that write its files."""

    def silent_change(rng: random.Random, path: Path) -> None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            change(rng, path)

    return silent_change


def _read(path: Path) -> None:
    """Read a scene, its report and its stored view, and check that every number is finite."""
    scene, report = load_scene_with_report(path)
    assert all("\n" not in line for line in report.lines())
    assert all(bool(getattr(scene, name).isfinite().all()) for name in ATTRIBUTES)
    camera = stored_view(path, scene.origin).camera
    assert camera is None or bool(camera.viewmat.isfinite().all())
    assert bool(find_up(scene, path=path).direction.isfinite().all())


def _checkpoints(folder: Path) -> Reader:
    scene = scene_of(1, 12)
    pipeline = {f"_model.{name}": tensor for name, tensor in nerfstudio_tensors(scene).items()}
    tables: list[dict[str, Any]] = [
        {"step": 1, "splats": gsplat_tensors(scene)},
        {"step": 1, "pipeline": pipeline, "optimizers": {"means": {"state": {0: torch.zeros(3)}}}},
    ]
    contents = []
    for i, table in enumerate(tables):
        torch.save(table, folder / f"{i}.pt")
        contents.append((folder / f"{i}.pt").read_bytes())

    @silently
    def change_tensors(rng: random.Random, path: Path) -> None:
        table = dict(rng.choice(tables))
        name = "splats" if "splats" in table else "pipeline"
        tensors: dict[str, Any] = changed_tensors(rng, table[name])
        for _ in range(rng.choice([0, 1, 1, 2])):
            key = rng.choice(sorted(tensors))
            if _is_plain(tensors[key]):
                tensors[key] = _special_tensor(rng, tensors[key])
        if rng.random() < 0.3:
            tensors[rng.choice(["features", "extra", "step", "a.b.means", "module.means"])] = rng.choice(
                VALUES
            )
        table[name] = rng.choice(VALUES) if rng.random() < 0.1 else tensors
        if rng.random() < 0.2:
            table[rng.choice(["splats", "app_module", "step", "more"])] = rng.choice(
                [table, tensors, *VALUES]
            )
        content: Any = (table, 7) if rng.random() < 0.05 else table
        torch.save(content, path)

    def change_pickle(rng: random.Random, path: Path) -> None:
        (folder / "good.pt").write_bytes(rng.choice(contents))
        with zipfile.ZipFile(folder / "good.pt") as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
        pickled = bytearray(entries[next(name for name in entries if name.endswith("data.pkl"))])
        for _ in range(rng.choice([1, 1, 2, 5])):
            at = rng.randrange(len(pickled))
            part = rng.choice([*PICKLE_PARTS, rng.randbytes(rng.choice([1, 2, 4]))])
            removed = rng.choice([0, len(part), len(part), 1, 30])
            pickled[at : at + removed] = part
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in entries.items():
                archive.writestr(name, bytes(pickled) if name.endswith("data.pkl") else content)

    bytes_of = [changed_bytes(content) for content in contents]
    return "x.pt", _read, [change_tensors, change_tensors, change_pickle, change_pickle, *bytes_of]


def _is_plain(value: object) -> bool:
    if not isinstance(value, Tensor) or value.layout != torch.strided:
        return False
    return not value.is_meta and not value.is_quantized and value.numel() < 10_000


def _special_tensor(rng: random.Random, tensor: Tensor) -> Any:
    """Return a tensor of another kind, which torch saves unchanged."""
    kind = rng.randrange(10)
    if kind == 0:
        return torch.nn.Parameter(tensor) if tensor.is_floating_point() else tensor
    if kind == 1:
        return tensor.to_sparse() if tensor.ndim else tensor
    if kind == 2:
        return tensor.to("meta")
    if kind == 3:
        return torch.zeros(1).expand(rng.choice([(12, 3), (10**9, 3), (12,), (2**40,)]))
    if kind == 4:
        return tensor.to(rng.choice([torch.complex64, torch.bool, torch.bfloat16, torch.float8_e4m3fn]))
    if kind == 5:
        return torch.quantize_per_tensor(tensor.float(), 0.1, 0, torch.quint8)
    if kind == 6 and tensor.ndim:
        return tensor[None] if rng.random() < 0.5 else tensor[:0]
    if kind == 7:
        return tensor.reshape(-1)[:1].squeeze()
    if kind == 8:
        return tensor.tolist()
    return tensor.as_strided(tensor.shape, [0] * tensor.ndim)


def _plys(folder: Path) -> Reader:
    good = write(folder / "good.ply", table_of(scene_of(1, 12)), after=sharp_elements(12))
    text = write(folder / "text.ply", table_of(scene_of(0, 12)), text=True, after=sharp_elements(12))

    @silently
    def change(rng: random.Random, path: Path) -> None:
        columns: dict[str, Any] = {
            n: values.copy() for n, values in table_of(scene_of(rng.choice([0, 1]), 12)).items()
        }
        for name in rng.sample(sorted(columns), rng.choice([0, 0, 1, 3])):
            columns[name] = columns[name].astype(rng.choice(["u1", "f8", "i4", "u2"]))
        if rng.random() < 0.4:
            for i in range(3):
                columns.pop(f"f_dc_{i}")
            columns |= {name: _column(rng) for name in ("red", "green", "blue")}
        for name in rng.sample(FIELDS, rng.choice([0, 1, 2])):
            columns[name.strip()] = _column(rng)
        elements: dict[str, Any] = {}
        for name in rng.sample(
            ["extrinsic", "intrinsic", "image_size", "color_space", "frame"], rng.randrange(4)
        ):
            count = rng.choice([0, 1, 2, 9, 12, 16])
            elements[name] = np.array([rng.choice(NUMBERS) for _ in range(count)])
        after = sharp_elements(12, **elements)
        rng.shuffle(after)
        write(path, columns, text=rng.random() < 0.5, after=after[: rng.randrange(8)])
        comments = "".join(f"\ncomment {line}" for line in rng.sample(COMMENTS, rng.randrange(3)))
        path.write_bytes(path.read_bytes().replace(b"\nelement", comments.encode() + b"\nelement", 1))

    return (
        "x.ply",
        _read,
        [change, change, changed_bytes(good.read_bytes()), changed_bytes(text.read_bytes())],
    )


def _column(rng: random.Random) -> np.ndarray:
    """Return twelve numbers of a random type, some of them extreme."""
    values = [rng.choice([*NUMBERS, 0.5, 0.25, 200.0]) for _ in range(12)]
    return np.array(values).astype(rng.choice(["u1", "f4", "f4", "f8", "u2", "i4"]))
