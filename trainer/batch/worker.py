"""Worker process: checks the jobs of a scene before the start, and trains one job after another."""

from __future__ import annotations

import os
import pickle
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch
from PIL import Image

from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError, is_out_of_memory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import load_gdf
from progdf.io.atomic import LOCK, atomic_write, hold_lock, is_locked
from progdf.io.images import to_picture
from progdf.rasterize import render
from progdf.system.processes import signal_main_thread
from trainer.options import TrainOptions
from trainer.resolve import resolve
from trainer.run.command import check_command, select_region
from trainer.run.finish import RunResult
from trainer.run.run import train
from trainer.store.pretrained import LastValueCache, keep_models
from trainer.store.run_folder import RunFolder, read_run_cameras
from trainer.views.view import BACKGROUND

from .jobs import BatchJob
from .report import PREVIEW, JobRow, Status, finished_row

_PREVIEW_SIDE = 144  # longer side of one preview picture, pixels
_LOCK_WAIT_S = 600.0  # a lost node's worker may still be writing


@dataclass(frozen=True)
class Finding:
    """Result of checking a job before the start."""

    key: str  # key of the job
    fault: str = ""  # reason why it cannot be trained, in one line
    gaussians: int = 0  # number of Gaussians in the scene
    members: int = 0  # number of Gaussians in the region; 0 if a network has to find it


@cache
def _shared_parts() -> LastValueCache:
    """Return the cache shared by this process's jobs; models and weights stay loaded from now on."""
    keep_models()
    return LastValueCache()


def inspect_scene(jobs: Sequence[BatchJob]) -> list[Finding]:
    """Check everything that the jobs of one scene refer to, without training."""
    findings = []
    for job in jobs:
        with chdir(job.folder):
            try:
                findings.append(_inspect(job))
            except (ProgdfError, OSError, ImportError) as error:
                findings.append(Finding(job.key, " ".join(str(error).split())))
    return findings


def _inspect(job: BatchJob) -> Finding:
    options = resolve(job.options)
    check_command(replace(options, resume=_is_begun(RunFolder(options.out))))
    scene = _scene(options)
    if "text:" in options.region.region:
        return Finding(job.key, "", len(scene), 0)
    region, _ = select_region(options, scene, True, _shared_parts())
    return Finding(job.key, "", len(scene), len(region))


def _scene(options: TrainOptions) -> Gaussians:
    return _shared_parts().get("scene", options.scene.resolve(), lambda: load_scene(options.scene))


def run_job(job: BatchJob) -> JobRow:
    """Train or resume a job in this process; a finished job stays unchanged."""
    begun = time.perf_counter()
    cpu_begun = time.process_time()
    try:
        with chdir(job.folder):
            _train(job)
            row = finished_row(job)
    except KeyboardInterrupt as interrupt:
        row = JobRow(job.key, "stopped", str(interrupt))
    except (ProgdfError, OSError) as error:
        row = JobRow(job.key, "failed", str(error))
    except Exception as error:
        status: Status = "memory" if is_out_of_memory(error) else "failed"
        row = JobRow(job.key, status, f"{type(error).__name__}: {error}")
    return replace(
        row,
        reason=" ".join(row.reason.split()),
        seconds=row.seconds or round(time.perf_counter() - begun, 2),
        cpu_seconds=round(time.process_time() - cpu_begun, 2),
        host=socket.gethostname(),
    )


def _train(job: BatchJob) -> None:
    with suppress(OSError):  # Linux: report.json then has this job's peak memory, not an earlier job's
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    options = job.options
    folder = RunFolder(job.options.out)
    if is_locked(folder.root / LOCK):
        with hold_lock(folder.root / LOCK, _LOCK_WAIT_S):
            pass
    result = train(replace(options, resume=_is_begun(folder)), quiet=True, shared=_shared_parts())
    if not (folder.root / PREVIEW).is_file():
        _write_preview(result, _scene(options))


def _is_begun(folder: RunFolder) -> bool:
    return folder.state.path.is_dir() or folder.report.is_file()


def _write_preview(result: RunResult, scene: Gaussians) -> None:
    """Draw the edit at strengths 0.5 and 1 in the held-out view that shows most of the region."""
    folder = result.folder
    gdf = load_gdf(result.gdf, scene)
    held_out = result.report["views"]["edit"]
    cameras = {camera.name: camera for camera in read_run_cameras(folder, held_out, scene.origin)}

    def coverage(name: str) -> float:
        with Image.open(folder.view("mask", name)) as mask:
            return float(np.asarray(mask, dtype=np.float32).mean())

    camera = cameras[max(held_out, key=coverage)]
    scale = _PREVIEW_SIDE / max(camera.width, camera.height)
    small = camera.resize(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    with torch.no_grad():
        pictures = [
            render(edited_scene(scene, gdf, s), small, background=BACKGROUND).image for s in (0.5, 1.0)
        ]
    with atomic_write(folder.root / PREVIEW) as temporary_file:
        to_picture(torch.cat(pictures, dim=1)).save(temporary_file, format="JPEG", quality=88)


@dataclass(frozen=True)
class Lost:
    """Result of a task whose worker, node or machine ended."""

    reason: str
    from_memory: bool = False  # it ended because memory ran out


def serve() -> None:
    """Serve as a worker without Ray: pickled tasks from stdin, results to the original stdout."""
    tasks = os.fdopen(os.dup(0), "rb")
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    queue = SimpleQueue[Any]()

    def read() -> None:
        try:
            with suppress(EOFError):
                while True:
                    queue.put(pickle.load(tasks))
        finally:  # the batch has ended, or its version differs: save the state of the running job
            signal_main_thread()
            queue.put(None)  # if the signal is ignored

    with suppress(KeyboardInterrupt, BrokenPipeError):
        threading.Thread(target=read, daemon=True).start()
        while (task := queue.get()) is not None:
            function, argument = task
            try:
                result = function(argument)
            except Exception as error:
                result = Lost(f"{type(error).__name__}: {error}")
            pickle.dump(result, results)
            results.flush()
