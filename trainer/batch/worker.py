"""What a worker process does: look at a scene's jobs before the start, and train one job after another."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError, is_out_of_memory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.atomic import LOCK, atomic_write, cache_folder, hold_lock, is_locked
from progdf.io.cameras import load_cameras
from progdf.io.images import to_picture
from progdf.rasterize import render
from trainer.options import TrainOptions
from trainer.resolve import resolve
from trainer.run.run import RunResult, Shared, check_command, select_region, train
from trainer.store.pretrained import keep_models
from trainer.store.run_folder import RunFolder
from trainer.views.view import BACKGROUND

from .jobs import Job

PREVIEW = "preview.jpg"
"""Of a run's folder: the edit at one half and at 1, side by side."""
PREVIEW_SIDE = 144

_LOCK_WAIT_S = 600.0  # a lost node's worker may still be writing
_URL = re.compile(r"\b(s3|gs|gcs|az|abfs|https?|hf|file):/+([^\s:,+]+)")  # a Path has one slash of the two

Status = Literal["done", "failed", "stopped", "memory"]


@dataclass(frozen=True)
class Outcome:
    """How a job ended."""

    key: str  # of the job
    status: Status  # stopped: by Ctrl-C; memory: it took more than there was
    reason: str = ""  # why it is not done, in one line
    seconds: float = 0.0  # from begin to end, of the last attempt
    cpu_seconds: float = 0.0  # of all threads, of the last attempt
    host: str = ""  # the machine
    attempts: int = 1  # how often it was begun
    members: int | None = None  # Gaussians of the region


@dataclass(frozen=True)
class Finding:
    """What a look at a job's scene tells before the start."""

    key: str  # of the job
    fault: str = ""  # why it cannot be trained, in one line
    gaussians: int = 0  # of the scene
    members: int = 0  # of the region; 0 where only a network can tell


@cache
def _shared() -> Shared:
    """What this process's jobs have in common; models and weights stay loaded from here on."""
    keep_models()
    return Shared()


def inspect_scene(jobs: Sequence[Job]) -> list[Finding]:
    """Look at everything that jobs of one scene name, as far as it can be seen without training."""
    findings = []
    for job in jobs:
        with chdir(job.folder):
            try:
                findings.append(_inspect(job))
            except (ProgdfError, OSError, ImportError) as error:
                findings.append(Finding(job.key, " ".join(str(error).split())))
    return findings


def _inspect(job: Job) -> Finding:
    options = resolve(_with_local_files(job.options))
    out = options.out
    check_command(replace(options, resume=(out / "state").is_dir() or (out / "report.json").is_file()))
    scene = _scene(options)
    if "text:" in options.region.region:
        return Finding(job.key, "", len(scene), 0)
    region, _ = select_region(options, scene, True, _shared())
    return Finding(job.key, "", len(scene), len(region))


def _scene(options: TrainOptions) -> Gaussians:
    return _shared().get("scene", options.scene.resolve(), lambda: load_scene(options.scene))


def run_job(job: Job) -> Outcome:
    """Train a job in this process, or go on with it where it was stopped; a finished one is left as it is."""
    begun, processor = time.perf_counter(), time.process_time()

    def outcome(status: Status, reason: str = "", members: int | None = None) -> Outcome:
        seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - processor
        line = " ".join(reason.split())
        host = socket.gethostname()
        return Outcome(job.key, status, line, seconds, cpu_seconds, host, members=members)

    try:
        with chdir(job.folder):
            _forget_peak_memory()
            options = _with_local_files(job.options)
            folder = RunFolder(options.out)
            if is_locked(folder.root / LOCK):
                with hold_lock(folder.root / LOCK, _LOCK_WAIT_S):
                    pass
            resume = folder.state.path.is_dir() or folder.report.is_file()
            result = train(replace(options, resume=resume), quiet=True, shared=_shared())
            scene = _scene(options)
            gdf = load_gdf(result.gdf, scene)
            if not (folder.root / PREVIEW).is_file():
                _write_preview(result, gdf, scene)
        return outcome("done", members=len(gdf.region))
    except KeyboardInterrupt as interrupt:
        return outcome("stopped", str(interrupt))
    except (ProgdfError, OSError) as error:
        return outcome("failed", str(error))
    except Exception as error:
        if is_out_of_memory(error):
            return outcome("memory", "out of memory")
        return outcome("failed", f"internal error: {type(error).__name__}: {error}")


def _write_preview(result: RunResult, gdf: Gdf, scene: Gaussians) -> None:
    """The edit at one half and at 1, from the held-out view that shows most of the region."""
    folder = result.folder
    cameras = {camera.name: camera for camera in load_cameras(folder.cameras, scene.origin)}

    def shown(name: str) -> float:
        with Image.open(folder.view("mask", name)) as mask:
            return float(np.asarray(mask, dtype=np.float32).mean())

    camera = cameras[max(result.report["views"]["edit"], key=shown)]
    scale = PREVIEW_SIDE / max(camera.width, camera.height)
    small = camera.resize(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    with torch.no_grad():
        pictures = [
            render(compose_layers(scene, [Layer(gdf, s)]), small, background=BACKGROUND).image
            for s in (0.5, 1.0)
        ]
    with atomic_write(folder.root / PREVIEW) as temporary_file:
        to_picture(torch.cat(pictures, dim=1)).save(temporary_file, format="JPEG", quality=88)


def _forget_peak_memory() -> None:
    """Linux: the peak that report.json tells is this job's, not that of the jobs before."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _with_local_files(options: TrainOptions) -> TrainOptions:
    """The options with files of s3://, gs:// and the like copied to this machine, once."""
    cameras = options.views.cameras
    return replace(
        options,
        scene=Path(_fetch(str(options.scene))),
        region=replace(options.region, region=_fetch(options.region.region)),
        editor=replace(options.editor, editor=_fetch(options.editor.editor)),
        views=replace(options.views, cameras=None if cameras is None else Path(_fetch(str(cameras)))),
    )


def _fetch(text: str) -> str:
    return _URL.sub(lambda url: _local_copy(f"{url[1]}://{'/' * (url[1] == 'file')}{url[2]}"), text)


def _local_copy(url: str) -> str:
    import fsspec

    folder = cache_folder() / "batch"
    try:
        return str(fsspec.open_local(f"filecache::{url}", filecache={"cache_storage": str(folder)}))
    except ImportError as error:
        raise ProgdfError(f"{url}: {error}") from error
    except (OSError, ValueError) as error:
        raise ProgdfError(f"{url} cannot be read ({error})") from error
