"""More inputs for `fuzz.py`: converted scenes, COLMAP models, masks, compiled kernels, run folders."""

from __future__ import annotations

import contextlib
import gzip
import importlib.util
import os
import random
import shutil
import signal
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene
from progdf.io.bundle import unpack_bundle
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.session import SessionFile, read_session
from progdf.rasterize.cpu import jit
from progdf.scene.regions import parse_region
from tests.helpers.fuzz_changes import Change, changed_bytes, changed_glb, changed_json, changed_parts
from tests.helpers.gltf_files import gltf_with_everything
from tests.helpers.hostile import NPY_HEADERS
from tests.helpers.hostile import npy as write_npy
from tests.helpers.scene_files import write_compressed_ply, write_ksplat, write_scene, write_sog1, write_zip
from tests.helpers.scenes import orbit_camera, random_gaussians
from tests.helpers.trained import quick_options, train, write_bear
from trainer.options import FitOptions, RegionOptions, TrainingViewOptions, TrainOptions
from trainer.regions.from_pictures import RegionRequest, region_kinds
from trainer.run.finish import refit
from trainer.store.state import PeriodicSave

Reader = tuple[str, Callable[[Path], Any], list[Change]]

FILES_OF_RUNS = {
    "resume run.json": "state/run.json",
    "resume training": "state/training.safetensors",
    "resume region": "state/region.safetensors",
    "resume recordings": "state/recordings/000000.safetensors",
    "fit trajectory": "trajectory.safetensors",
    "fit cameras": "cameras.json",
    "fit report": "report.json",
}
"""Files damaged in a run folder before `progdf train --resume` or `progdf fit`."""

GLTF_READERS = ("glb", "gltf", "spz in glb")

CONVERTED = ("spz", "splat", "sog", "sog1", "ksplat", "compressed", "zip", "gz")
"""Kinds of scene files whose bytes are changed."""

COSTLY = ("spz", "spz in glb", "colmap", "kernels", *FILES_OF_RUNS)
"""Readers that take about one second per input."""

KERNEL = """
from progdf.rasterize.cpu.jit import kernel

@kernel(cache=True)
def twice(number):
    return 2 * number
"""


def more_inputs(folder: Path, reader: str) -> dict[str, Reader]:
    """Return the requested reader like `fuzz.inputs`, or nothing if it is defined elsewhere."""
    makers: dict[str, Callable[[Path], Reader]] = {
        **{kind: partial(_converted, kind) for kind in CONVERTED},
        **{kind: partial(_sog_folder, kind) for kind in ("sog1 table", "sog1 image")},
        "bundles": _bundles,
        **{kind: partial(_gltf, kind) for kind in GLTF_READERS},
        "colmap": partial(_colmap, False),
        "colmap text": partial(_colmap, True),
        "masks": _masks,
        "labels": partial(_numbers, "labels:{}:1"),
        "members": partial(_numbers, "file:{}"),
        "kernels": _kernels,
        **{name: partial(_run, name) for name in FILES_OF_RUNS},
    }
    return {reader: makers[reader](folder)} if reader in makers else {}


def _converted(kind: str, folder: Path) -> Reader:
    scene = random_gaussians(60, seed=2, sh_degree=1 if kind in ("spz", "ksplat") else 0)
    ending = {"compressed": "ply", "sog1": "sog", "gz": "ply.gz"}.get(kind, kind)
    good = folder / f"good.{ending}"
    if kind == "compressed":
        write_compressed_ply(good, scene)
    elif kind == "ksplat":
        write_ksplat(good, scene, level=1)
    elif kind == "sog1":
        write_sog1(good, random_gaussians(60, seed=2, sh_degree=1))
    elif kind in ("zip", "gz"):
        save_ply(folder / "plain.ply", scene)
        content = (folder / "plain.ply").read_bytes()
        if kind == "gz":
            good.write_bytes(gzip.compress(content))
        else:
            write_zip(good, {"a/scene.ply": content, "b.txt": b"x"})
    else:
        write_scene(good, scene)

    def read(path: Path) -> None:
        found = load_scene(path)
        for tensor in (found.means, found.log_scales, found.quats, found.logit_opacities, found.sh0):
            assert bool(tensor.isfinite().all())

    return f"x.{ending}", read, [changed_bytes(good.read_bytes())]


def _sog_folder(kind: str, folder: Path) -> Reader:
    """Change the table of an unpacked SOG of version 1, or damage one of its images."""
    unpacked = write_sog1(folder / "robot", random_gaussians(60, seed=2, sh_degree=1))
    images = {path.name: path.read_bytes() for path in sorted(unpacked.glob("*.webp"))}

    def change_image(rng: random.Random, path: Path) -> None:
        for name, content in images.items():
            (unpacked / name).write_bytes(content)
        name = rng.choice(list(images))
        changed_bytes(images[name])(rng, unpacked / name)
        path.write_bytes((unpacked / name).read_bytes())

    def read(_: Path) -> None:
        found = load_scene(unpacked)
        assert bool(found.means.isfinite().all())

    if kind == "sog1 image":
        return "x.webp", read, [change_image]
    return "robot/meta.json", read, [changed_json((unpacked / "meta.json").read_bytes())]


def _bundles(folder: Path) -> Reader:
    """Damage bundles, and folders of earlier openings."""
    session = b'{"progdf_session": 1, "scene": {"file": "a.ply", "sha256": ""}}' + b" " * 400
    contents = []
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    for method in methods:
        with zipfile.ZipFile(folder / "good.zip", "w", method) as archive:
            archive.writestr("a.session.json", session)
            archive.writestr("a.ply", random.Random(1).randbytes(600))
        contents.append((folder / "good.zip").read_bytes())
    unpacked = folder / "x.progdf"

    def change(rng: random.Random, path: Path) -> None:
        shutil.rmtree(unpacked, ignore_errors=True)
        content = rng.choice(contents)
        if rng.random() < 0.7:
            changed_bytes(content)(rng, path)
            return
        path.write_bytes(contents[rng.randrange(2)])
        unpack_bundle(path)
        file = rng.choice(sorted(unpacked.iterdir()))
        kind = rng.randrange(4)
        if kind == 0:
            file.write_bytes(rng.randbytes(64))
        elif kind == 1:
            file.rename(unpacked / rng.choice(["b.session.json", "b.json", "b", "a.autosave.session.json"]))
        elif kind == 2:
            file.unlink()
        else:
            file.unlink()
            file.mkdir()

    def read(path: Path) -> None:
        opened = unpack_bundle(path)
        assert opened.parent == unpacked
        read_session(opened, SessionFile)

    return "x.progdf.zip", read, [change]


def _gltf(kind: str, folder: Path) -> Reader:
    """Change a file with nested nodes, instances, sparse rows, indices, linear colors, and maybe an .spz."""
    builder = gltf_with_everything()
    if kind == "spz in glb":
        write_scene(folder / "good.spz", random_gaussians(20, seed=2, sh_degree=1), 3)
        view = builder.view((folder / "good.spz").read_bytes())
        name = "KHR_gaussian_splatting_compression_spz_2"
        builder.mesh(builder.primitive({}, extensions={name: {"bufferView": view}}))
        builder.nodes({"mesh": 1}, {"mesh": 1, "scale": [2, 2, 2]}, roots=(0, 1))
    suffix = ".gltf" if kind == "gltf" else ".glb"
    good = builder.write(folder / f"good{suffix}", "x.bin" if kind == "gltf" else None)
    (folder / "x.bin").write_bytes(builder.data)
    content = good.read_bytes()

    def read(path: Path) -> None:
        found = load_scene(path)
        for tensor in (
            found.means,
            found.log_scales,
            found.quats,
            found.logit_opacities,
            found.sh0,
            found.shN,
        ):
            assert bool(tensor.isfinite().all())

    of_json = changed_json(content) if kind == "gltf" else changed_glb(content)
    return f"x{suffix}", read, [of_json, of_json, of_json, changed_bytes(content)]


def _colmap(text: bool, folder: Path) -> Reader:
    """Damage one file of a COLMAP model."""
    from tests.progdf.io.test_colmap import views, write_model

    good = write_model(folder / "good", views(), text=text)
    names = ["cameras.txt", "images.txt"] if text else [path.name for path in sorted(good.iterdir())]

    def change(rng: random.Random, path: Path) -> None:
        name = rng.choice(names)
        changed_bytes((good / name).read_bytes())(rng, path)
        where = name.encode()
        path.write_bytes(len(where).to_bytes(2, "little") + where + path.read_bytes())

    def read(path: Path) -> None:
        content = path.read_bytes()
        end = 2 + int.from_bytes(content[:2], "little")
        name = content[2:end].decode()
        shutil.rmtree(folder / "m", ignore_errors=True)
        shutil.copytree(good, folder / "m")
        (folder / "m" / name).write_bytes(content[end:])
        for camera in load_cameras(folder / "m"):
            assert bool(camera.viewmat.isfinite().all())

    return "x.colmap", read, [change]


def _masks(folder: Path) -> Reader:
    scene, cameras = random_gaussians(60, seed=2), [orbit_camera(azimuth=i) for i in range(3)]
    (folder / "masks").mkdir()
    save_cameras(folder / "cameras.json", [replace(c, name=f"v{i}") for i, c in enumerate(cameras)])
    mask = np.full((cameras[0].height, cameras[0].width), 255, np.uint8)
    for i in range(3):
        Image.fromarray(mask).save(folder / "masks" / f"v{i}.png")
    settings = RegionRequest(
        RegionOptions("masks"),
        TrainingViewOptions(folder / "cameras.json"),
        lambda: folder / "cache",
        quiet=True,
    )

    def read(path: Path) -> None:
        parse_region(f"masks:{path.parent}", scene, "a", region_kinds(settings))

    return "masks/v1.png", read, [changed_bytes((folder / "masks" / "v1.png").read_bytes())]


def _numbers(spec: str, folder: Path) -> Reader:
    scene = random_gaussians(60, seed=2)
    np.save(folder / "good.npy", np.arange(60) % 3 if "labels" in spec else np.arange(0, 60, 3))

    def claim(rng: random.Random, path: Path) -> None:
        write_npy(path, rng.choice(list(NPY_HEADERS.values())))

    changes = [changed_bytes((folder / "good.npy").read_bytes())] * 3
    return "x.npy", lambda path: parse_region(spec.format(path), scene, "a"), [*changes, claim]


def _kernels(folder: Path) -> Reader:
    """Truncate a file of the kernel cache, which must be recompiled."""
    (folder / "kernels.py").write_text(KERNEL)
    cache = folder / "cache"
    cache.mkdir()
    jit.kernel_cache = lambda: cache

    def twice() -> Callable[[int], int]:
        spec = importlib.util.spec_from_file_location("kernels", folder / "kernels.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found: Callable[[int], int] = module.twice
        return found

    assert twice()(4) == 8
    good = folder / "good"
    shutil.copytree(cache, good)
    files = [path.relative_to(good) for path in sorted(good.rglob("*.nb?"))]

    def change(rng: random.Random, path: Path) -> None:
        shutil.rmtree(cache)
        shutil.copytree(good, cache)
        name = rng.choice(files)
        content = (good / name).read_bytes()
        path.write_bytes(content[: rng.randrange(len(content))])
        shutil.copyfile(path, cache / name)

    def read(_: Path) -> None:
        assert twice()(4) == 8

    return "x", read, [change]


def _run(name: str, folder: Path) -> Reader:
    """Change one file of a stopped or finished run each time. Readers beside each other share the run."""
    resumes = name.startswith("resume")
    file = FILES_OF_RUNS[name]
    shared = folder.parent / ("stopped run" if resumes else "finished run")
    options = quick_options(shared, views=4, image_size=48, steps=64, stages=2)
    good = shared / "good"
    if not shared.exists():
        shared.mkdir()
        write_bear(shared, 400)
        _train(options, stops=resumes)
        options.out.rename(good)
    content = (good / file).read_bytes()
    changes: dict[str, list[Change]] = {".json": [changed_json(content)] * 3}
    if file.endswith(".safetensors"):
        key = "about" if file.startswith("trajectory") else "values"
        changes[".safetensors"] = [changed_parts(content, key)] * 3

    def read(path: Path) -> None:
        shutil.rmtree(options.out, ignore_errors=True)
        shutil.copytree(good, options.out)
        shutil.copyfile(path, options.out / file)
        if resumes:
            train(replace(options, resume=True), quiet=True)
        else:
            refit(FitOptions(options.out, threads=1), quiet=True)

    suffix = Path(file).suffix
    return f"x{suffix}", read, [*changes[suffix], changed_bytes(content)]


def _train(options: TrainOptions, stops: bool) -> None:
    """Train, or interrupt the training with Ctrl-C after the first recording."""
    done = PeriodicSave.step_done

    def step_done(self: PeriodicSave) -> None:
        if stops and (options.out / "state" / "recordings" / "000000.safetensors").is_file():
            os.kill(os.getpid(), signal.SIGINT)
        done(self)

    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(PeriodicSave, "step_done", step_done)
        patch.setattr("trainer.store.state.SAVE_EVERY", 0.0)
        train(options, quiet=True)
