"""Hostile inputs for every reader: `python -m tests.helpers.fuzz READER[,READER…] COUNT SEED FOLDER`.

Bytes are flipped, cut, doubled and inserted. Values of JSON are replaced by others that no program writes,
with matching checksums. Each input must give an object or a ProgdfError of one line, within a few seconds
and 1 GB. Failures are printed, one per line, and their inputs are kept in FOLDER/READER.
"""

from __future__ import annotations

import json
import random
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import ExifTags, Image

from progdf.cli.info import describe
from progdf.errors import ProgdfError
from progdf.field.baked import lattice_colors
from progdf.field.trajectory import load_trajectory, save_trajectory
from progdf.formats.cube import read_cube, write_cube
from progdf.formats.ply import load_ply, save_ply
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import read_picture
from progdf.io.json_values import to_json
from progdf.io.tensors import open_npy
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.fuzz_changes import Change, changed_bytes, changed_gdf, changed_json, changed_parts
from tests.helpers.fuzz_folders import COSTLY, more_inputs
from tests.helpers.fuzz_trainers import trainer_inputs
from tests.helpers.ply_files import camera_element, face_element, scene_of, write
from tests.helpers.ply_files import table_of as columns_of
from tests.helpers.scenes import orbit_camera, random_gaussians
from tests.helpers.sessions import bear_files, saved_session
from tests.helpers.stacks import recording_of
from trainer.store.state import StateFolder
from viewer.files import region_files, session
from viewer.state.selection import SelectionState, add_region, select

SECONDS = 10  # time limit of one input
BYTES = 1 << 30  # memory limit of one input


def read_info(path: Path) -> None:
    """Read all lines of `progdf info`."""
    for line in describe(path):
        assert isinstance(line, str)


def read_gdf(path: Path) -> None:
    """Read an edit and check that its offsets are finite."""
    gdf = load_gdf(path)
    for s in (0.0, 0.5, 1.0):
        assert bool(gdf.field.offsets(s).isfinite().all())


def use_session(path: Path) -> None:
    """Rename and save the regions of a session. It must touch only region files of its folder."""

    def others() -> dict[Path, int]:
        files = (file for file in path.parents[1].rglob("*") if file.is_file())
        return {file: file.stat().st_mtime_ns for file in files if not file.match("s/*.region.npy")}

    before = others()
    opened = session.open_session(path)
    state = opened.view.selection
    total = len(opened.document.scene)
    for i, region in enumerate(state.regions):
        region_files.region_file(region, total)
        state = region_files.rename_region(state, i, f"{region.name} {i}", total)
    assert others() == before


def read_state(path: Path) -> None:
    """Read a part of a stopped run."""
    StateFolder(path.parent).load(path.stem)


def inputs(folder: Path, reader: str) -> dict[str, tuple[str, Callable[[Path], Any], list[Change]]]:
    """Return the file name, the reader function and the changes of a valid file for each reader."""
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
    write_cube(folder / "a.cube", lattice_colors(3), "colors")
    np.save(folder / "a.npy", np.arange(40, dtype=np.float32))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    noise = np.random.default_rng(1).integers(0, 255, (20, 30, 3), np.uint8)
    pictures = [folder / f"a.{suffix}" for suffix in ("png", "jpg", "webp", "tiff", "gif")]
    for path in pictures:
        Image.fromarray(noise).save(path, **({} if path.suffix == ".gif" else {"exif": exif}))
    for path in (folder / "deep.png", folder / "deep.tiff"):
        Image.fromarray(noise[..., 0].astype(np.uint16) * 257).save(path)
        pictures.append(path)
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
    opened = session.open_session(saved)
    table = json.loads(saved.read_text())
    mask = np.arange(len(opened.document.scene)) % 3 == 0
    regions = add_region(select(SelectionState(), mask), "third", folder / "s" / "third.region.npy")
    table["view"]["selection"] = to_json(replace(regions, hidden=regions.members))
    saved.write_text(json.dumps(table))
    read: Callable[[Path], bytes] = Path.read_bytes

    def both(content: bytes) -> list[Change]:
        return [changed_json(content), changed_json(content), changed_bytes(content)]

    gdf = read(folder / "a.gdf")
    parts = read(folder / "t.safetensors")
    part = read(folder / "state" / "part.safetensors")
    return {
        **more_inputs(folder, reader),
        **trainer_inputs(folder, reader),
        "ply": ("x.ply", load_ply, plys),
        "gdf": ("x.gdf", read_gdf, [changed_gdf(gdf), changed_gdf(gdf), changed_bytes(gdf)]),
        "session": ("s/x.session.json", use_session, both(read(saved))),
        "cameras": ("x.json", load_cameras, [c for content in camera_files for c in both(content)]),
        "cube": ("x.cube", read_cube, [changed_bytes(read(folder / "a.cube"))]),
        "npy": ("x.npy", open_npy, [changed_bytes(read(folder / "a.npy"))]),
        "pictures": ("x.png", read_picture, [changed_bytes(read(path)) for path in pictures]),
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
            ],
        ),
    }


READ_AT_ONCE = (
    "bundles",
    "ply",
    "gdf",
    "session",
    "cameras",
    "cube",
    "npy",
    "pictures",
    "trajectory",
    "state",
    "run.json",
    "info",
    "compressed",
    "ksplat",
    "splat",
    "sog",
    "sog1",
    "sog1 table",
    "sog1 image",
    "zip",
    "gz",
    "masks",
    "labels",
    "members",
    "glb",
    "gltf",
    "colmap text",
    "checkpoints",
    "plys of trainers",
)
READERS = (*READ_AT_ONCE, *COSTLY)


def failures(reader: str, count: int, seed: int, folder: Path) -> Iterator[str]:
    """Yield each failure as one line, and keep its input."""
    name, read, changes = inputs(folder, reader)[reader]

    def late(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, late)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + BYTES, resource.RLIM_INFINITY))
    path = folder / name
    for i in range(count):
        rng = random.Random(f"{seed} {reader} {i}")
        rng.choice(changes)(rng, path)
        signal.alarm(SECONDS * (10 if reader in COSTLY else 1))
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
            copy = folder / f"kept-{reader}-{seed}-{i}{path.suffix}"
            copy.write_bytes(path.read_bytes())
            yield f"{reader} {i}: {' '.join(wrong.split())}"


def fuzz_readers(readers: Sequence[str], count: int, seed: int, folder: Path) -> Iterator[str]:
    """Yield the failures of several readers, each with its own folder and its own memory limit."""
    for reader in readers:
        own_folder = folder / reader
        own_folder.mkdir(parents=True, exist_ok=True)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        yield from failures(reader, count, seed, own_folder)


if __name__ == "__main__":
    torch.set_num_threads(1)
    for line in fuzz_readers(sys.argv[1].split(","), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])):
        print(line, flush=True)
