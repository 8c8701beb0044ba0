"""Hostile inputs for every reader: `python -m tests.fuzz READER COUNT SEED FOLDER` tells what got through.

Bytes are flipped, cut, doubled and put in; values of JSON are replaced by what no program writes, with the
checksums made to fit. Each input must give an object or a ProgdfError of one line, within a few seconds and a
gigabyte. Failures are printed, one a line, and their inputs are kept in FOLDER.
"""

from __future__ import annotations

import copy
import json
import random
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from PIL import Image

from progdf.camera_files import load_cameras, save_cameras
from progdf.checkpoint import _checksum, load_gdf, save_gdf
from progdf.errors import ProgdfError
from progdf.gdf_head import head_checksum
from progdf.info import _DESCRIBE, kind_of
from progdf.npy import open_npy
from progdf.pictures import open_picture
from progdf.ply import load_ply, save_ply
from progdf.tensor_file import table_of, write_tensors
from progdf.trajectory import load_trajectory, save_trajectory
from tests.edits import curved_field, edit_of, some_rows
from tests.hostile import JSON_TEXTS
from tests.ply_files import camera_element, face_element, scene_of, write
from tests.ply_files import table_of as columns_of
from tests.scenes import orbit_camera, random_gaussians
from tests.sessions import bear_files, saved_session
from tests.stacks import recording_of
from trainer.state import StateFolder
from viewer import session, timeline_file

SECONDS, BYTES = 10, 1 << 30
"""What one input may take, at most."""

VALUES: list[Any] = [
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        7,
        2**31,
        2**63,
        -(2**70),
        1e-300,
        1e300,
        0.5,
        "",
        "a",
        "means",
        "\0",
        "/",
    ),
    *("\x1b[2J\n", "ä" * 300, "9" * 5000, [], {}, [[]], [0] * 5000, {"a": {"b": []}}, "../../../etc/passwd"),
]
"""In place of what a file holds."""

Change = Callable[[random.Random, Path], None]
"""Writes another input to a path."""


def changed_bytes(content: bytes) -> Change:
    """Damage as of disks and downloads."""

    def change(rng: random.Random, path: Path) -> None:
        data = bytearray(content)
        for _ in range(rng.choice([1, 1, 1, 2, 6])):
            at = (
                rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(min(len(data), 400) + 1)
            )
            length = rng.choice([1, 1, 2, 4, 8, 100])
            kind = rng.randrange(6)
            if kind == 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            elif kind == 1:
                data[at : at + length] = rng.choice([b"\xff", b"\0", b"9", b"["]) * length
            elif kind == 2:
                data[at:at] = rng.randbytes(length)
            elif kind == 3:
                data[at:at] = data[at : at + 50 * length]
            elif kind == 4:
                del data[at : at + length]
            else:
                del data[at:]
        path.write_bytes(bytes(data))

    return change


def changed_value(rng: random.Random, value: Any) -> Any:
    """A JSON value with one to three places of it replaced, removed or doubled."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.choice([1, 1, 2, 3])):
        inner, place = None, None
        found = value
        while isinstance(found, dict | list) and found and rng.random() < 0.8:
            inner, place = found, rng.choice(list(found) if isinstance(found, dict) else range(len(found)))
            found = inner[place]
        other = copy.deepcopy(rng.choice(VALUES))  # which may be put into itself
        if inner is None or place is None:
            value = other if rng.random() < 0.2 else value
        elif (kind := rng.randrange(6)) == 0:
            del inner[place]
        elif kind == 1 and isinstance(inner, dict):
            inner[rng.choice(["extra", "", "a" * 5000, "\x1b"])] = other
        elif kind == 2 and isinstance(inner, list):
            inner.append(inner[place])
        elif kind == 3 and isinstance(found, int | float):
            inner[place] = rng.choice([-found, found * 1e30, found + 1, str(found), [found]])
        else:
            inner[place] = other
    return value


def changed_json(content: bytes) -> Change:
    """Damage as by somebody who knows the form: other values, and now and then what is no JSON at all."""

    def change(rng: random.Random, path: Path) -> None:
        text = json.dumps(changed_value(rng, json.loads(content)))
        if rng.random() < 0.1:
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(list(JSON_TEXTS.values())) + text[at + 1 :]
        path.write_text(text)

    return change


def changed_tensors(rng: random.Random, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors of which one has other numbers, another type, shape or name, or is gone."""
    tensors = dict(tensors)
    name = rng.choice(sorted(tensors))
    tensor = tensors.pop(name)
    kind = rng.randrange(7)
    if kind == 0:
        tensors[name] = tensor[: len(tensor) // 2] if tensor.ndim else tensor
    elif kind == 1:
        tensors[name] = tensor.to(
            rng.choice([torch.float64, torch.int8, torch.uint8, torch.int64, torch.float16])
        )
    elif kind == 2:
        tensors[name] = tensor.reshape(
            rng.choice([(-1,), (1, -1), (-1, 1)]) if tensor.numel() else tensor.shape
        )
    elif kind == 3:
        tensors[name] = tensor.clone()
        tensors[name].reshape(-1)[: rng.choice([1, 5, 10**6])] = rng.choice([0, -1, 1, 100])
    elif kind == 4 and tensor.is_floating_point():
        filled = tensor.clone().reshape(-1)
        filled[: rng.choice([1, 10**6])] = rng.choice([3e38, -3e38, float("nan"), float("inf"), 1e-40])
        tensors[name] = filled.reshape(tensor.shape)
    elif kind == 5:
        tensors["extra"] = tensor
    return tensors


def changed_gdf(content: bytes) -> Change:
    """An edit with another header or other tensors, signed as if progdf had written it."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["progdf"])
    tensors = safetensors.torch.load(content)

    def change(rng: random.Random, path: Path) -> None:
        text = json.dumps(changed_value(rng, header) if rng.random() < 0.7 else header)
        found = changed_tensors(rng, tensors) if rng.random() < 0.5 else tensors
        found = {name: tensor.contiguous() for name, tensor in found.items()}
        metadata = {"progdf": text, "sha256": _checksum(text, found)}
        if rng.random() < 0.7:
            metadata["header_sha256"] = head_checksum(text, table_of(found))
        path.write_bytes(safetensors.torch.save(found, metadata))

    return change


def changed_parts(content: bytes, key: str) -> Change:
    """A tensor file with another JSON text among its metadata, or other tensors, its checksum made to fit."""
    size = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8 : 8 + size])["__metadata__"]
    metadata.pop("crc32", None)
    tensors = safetensors.torch.load(content)

    def change(rng: random.Random, path: Path) -> None:
        told = metadata
        if rng.random() < 0.6:
            told = {**metadata, key: json.dumps(changed_value(rng, json.loads(metadata[key])))}
        found = changed_tensors(rng, tensors) if rng.random() < 0.6 else tensors
        write_tensors(path, found, told, checksum=rng.random() < 0.8)

    return change


def read_info(path: Path) -> None:
    """All lines of `progdf info`."""
    for line in _DESCRIBE[kind_of(path)](path):
        assert isinstance(line, str)


def read_gdf(path: Path) -> None:
    """The edit, which must not move anything to where no number is."""
    gdf = load_gdf(path)
    for s in (0.0, 0.5, 1.0):
        assert bool(gdf.field.offsets(s).isfinite().all())


def read_state(path: Path) -> None:
    """A part of a stopped run."""
    StateFolder(path.parent).load(path.stem)


def inputs(folder: Path) -> dict[str, tuple[str, Callable[[Path], Any], list[Change]]]:
    """By reader: the file's name, the reader, and what is done to a good file."""
    scene = random_gaussians(40, seed=1, sh_degree=1)
    edit = edit_of(scene, some_rows(scene, 12), curved_field(12, channels=14 + 9))
    edit = replace(edit, options={"name": "shirt", "steps": 600}, report={"a": {"b": [1.0, 2.0]}, "c": None})
    save_gdf(folder / "a.gdf", edit)
    save_ply(folder / "a.ply", scene_of(1, count=6))
    write(
        folder / "b.ply",
        columns_of(scene_of(0, 5)),
        text=True,
        before=[camera_element()],
        after=[face_element()],
    )
    write(folder / "c.ply", columns_of(scene_of(0, 5)), byte_order=">", before=[face_element()])
    plys = [changed_bytes((folder / f"{name}.ply").read_bytes()) for name in "abc"]
    save_cameras(folder / "own.json", [orbit_camera(), orbit_camera()])
    eye = np.eye(4).tolist()
    frame = {"file_path": "a.png", "transform_matrix": eye}
    nerf = {"fl_x": 50.0, "w": 64, "h": 48, "k1": 0.1, "camera_model": "OPENCV", "frames": [frame, frame]}
    inria = [
        {"img_name": "a", "width": 64, "height": 48, "position": [0, 0, 1], "rotation": np.eye(3).tolist(),
         "fx": 50.0, "fy": 50.0}
    ]  # fmt: skip
    camera_files = [(folder / "own.json").read_bytes(), json.dumps(nerf).encode(), json.dumps(inria).encode()]
    timeline = {
        "progdf_timeline": 1, "fps": 24, "length": 72, "ping_pong": False,
        "keys": [{"frame": 0, "strengths": {}, "camera": {"pivot": [0, 1, 0], "distance": 4}}, {"frame": 9}],
    }  # fmt: skip
    np.save(folder / "a.npy", np.arange(40, dtype=np.float32))
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (20, 30, 3), np.uint8)).save(folder / "a.png")
    save_trajectory(
        folder / "t.safetensors",
        recording_of(edit),
        {"members": edit.region.members, "score": edit.region.score},
        {"scene": "a.ply", "held_out": ["a"], "background": [1, 1, 1], "options": {"name": "a"}},
    )
    state = StateFolder(folder / "state")
    state.begin({"options": {"steps": 4}, "scene": "", "cameras": None, "threads": 1, "torch": "2"})
    state.save("part", {"a": torch.arange(4.0)}, {"pgs": {"step": 3}, "list": [1, 2.5]})
    (folder / "s").mkdir()
    saved = saved_session(bear_files(folder / "s"))
    read: Callable[[Path], bytes] = Path.read_bytes

    def both(content: bytes) -> list[Change]:
        return [changed_json(content), changed_json(content), changed_bytes(content)]

    gdf, parts = read(folder / "a.gdf"), read(folder / "t.safetensors")
    part = read(folder / "state" / "part.safetensors")
    return {
        "ply": ("x.ply", load_ply, plys),
        "gdf": ("x.gdf", read_gdf, [changed_gdf(gdf), changed_gdf(gdf), changed_bytes(gdf)]),
        "session": ("s/x.session.json", session.open_session, both(read(saved))),
        "timeline": ("x.json", lambda p: timeline_file.load(p, ()), both(json.dumps(timeline).encode())),
        "cameras": ("x.json", load_cameras, [c for content in camera_files for c in both(content)]),
        "npy": ("x.npy", open_npy, [changed_bytes(read(folder / "a.npy"))]),
        "png": ("x.png", open_picture, [changed_bytes(read(folder / "a.png"))]),
        "trajectory": (
            "x.safetensors",
            load_trajectory,
            [changed_parts(parts, "about"), changed_bytes(parts)],
        ),
        "state": ("state/x.safetensors", read_state, [changed_parts(part, "values"), changed_bytes(part)]),
        "run.json": (
            "state/run.json",
            lambda p: StateFolder(p.parent).identity(),
            both(read(folder / "state" / "run.json")),
        ),
        "info": (
            "s/x",
            read_info,
            [
                *plys,
                changed_gdf(gdf),
                changed_gdf(gdf),
                *both(read(saved)),
                *both(json.dumps(timeline).encode()),
            ],
        ),
    }


READERS = (
    "ply",
    "gdf",
    "session",
    "timeline",
    "cameras",
    "npy",
    "png",
    "trajectory",
    "state",
    "run.json",
    "info",
)


def failures(reader: str, count: int, seed: int, folder: Path) -> Iterator[str]:
    """What got through, a line each; the inputs are kept."""
    name, read, changes = inputs(folder)[reader]

    def late(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, late)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + BYTES, taken + BYTES))
    path = folder / name
    for i in range(count):
        rng = random.Random(f"{seed} {reader} {i}")
        rng.choice(changes)(rng, path)
        signal.alarm(SECONDS)
        try:
            read(path)
            wrong = ""
        except ProgdfError as refused:
            wrong = "" if "\n" not in str(refused) else f"of two lines: {refused!r}"
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            wrong = f"{type(error).__name__}: {str(error)[:100]} ({Path(last.filename).name}:{last.lineno})"
        signal.alarm(0)
        if wrong:
            kept = folder / f"kept-{reader}-{seed}-{i}{path.suffix}"
            kept.write_bytes(path.read_bytes())
            yield f"{reader} {i}: {' '.join(wrong.split())}"


if __name__ == "__main__":
    torch.set_num_threads(1)
    for line in failures(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])):
        print(line, flush=True)
