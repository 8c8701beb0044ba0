"""Methods of the suite `sliders`: functions from an edit to a slider over Gaussians."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.io.atomic import atomic_write, make_folder
from progdf.io.cameras import save_cameras
from progdf.io.images import write_image
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from trainer.evaluate.opened import OpenedRun, open_run
from trainer.options import (
    EditorOptions,
    OptimizeOptions,
    RegionOptions,
    TrainingViewOptions,
    TrainOptions,
    apply_preset,
    with_values,
)
from trainer.run.resume import find_run
from trainer.run.run import train

from .edits import EditTask

Slider = Callable[[float], Gaussians]
"""Function from a strength, 0 to 1, to the edited scene."""

SliderMethod = Callable[[EditTask], Slider]
"""Method of the suite: a function from an edit to its slider."""

_PAPER_STEPS = 1500 / 800  # steps of the paper's training over those of the default one


def field(task: EditTask) -> Slider:
    """Train ProGDF Studio's field on the pictures; return its slider."""
    opened = _open_trained(_train_options(task, "field"))
    return lambda s: edited_scene(task.scene, opened.gdf, s)


def keyframes(task: EditTask) -> Slider:
    """Return a straight line to the full edit of `field`, raw or in OKLab, see `closest_keyframes`."""
    opened = _open_trained(_train_options(task, "field"))
    scene = opened.setup.scene  # with the rows that the edit adds
    members = opened.setup.region.members

    def slider(s: float) -> Gaussians:
        offsets = opened.keyframes.offsets(s)
        original = pack(scene[members], with_shN=offsets.shape[1] > BASE_CHANNELS)
        return scene.replace_rows(members, original + offsets)

    return slider


def matrix(task: EditTask) -> Slider:
    """Fit one affine color matrix per given strength; return a slider that interpolates between them.

    A pixel is linear in the members' colors. With the members' weight W in a pixel, their blended color D and
    the change of the picture Y, the matrix A [3,3] and the offset b [3] minimize Σ |D A + W b − Y|² over all
    pixels of all views.
    """
    weights = torch.cat([view.mask.flatten() for view in task.views]).double()
    colors = torch.cat([view.inside.reshape(-1, 3) for view in task.views]).double()
    visible = weights > 0
    design = torch.cat([colors[visible], colors.new_ones(int(visible.sum()), 1)], dim=1)
    design = design * weights[visible, None]  # [P,4]
    inverse = torch.linalg.pinv(design.T @ design, hermitian=True) @ design.T
    changes = {0.0: torch.zeros(4, 3, dtype=torch.float64)}
    for strength in sorted(task.pictures):
        pairs = zip(task.pictures[strength], task.views, strict=True)
        change = torch.cat([(picture - view.image).reshape(-1, 3) for picture, view in pairs])
        changes[strength] = inverse @ change[visible].double()
    part = task.scene[task.region.members]
    rgb = sh0_to_rgb(part.sh0)

    def slider(s: float) -> Gaussians:
        change = _interpolate(changes, s).to(rgb)
        sh0 = rgb_to_sh0(rgb + rgb @ change[:3] + change[3])
        shN = part.shN + part.shN @ change[:3]
        rows = pack(replace(part, sh0=sh0, shN=shN), with_shN=True)
        return task.scene.replace_rows(task.region.members, rows)

    return slider


def paper(task: EditTask) -> Slider:
    """Train as ProGDF (AAAI 2025) does, with its network; return its slider."""
    options = _train_options(task, "paper")
    options = with_values(
        apply_preset(options, "paper"),
        views=options.views.views,
        image_size=options.views.image_size,
        steps=round(task.effort.steps * _PAPER_STEPS),
    )
    opened = _open_trained(options)
    return lambda s: edited_scene(task.scene, opened.gdf, s)


METHODS: Mapping[str, SliderMethod] = {
    "field": field,
    "keyframes": keyframes,
    "matrix": matrix,
    "paper": paper,
}
"""Built-in methods by name."""


def find_methods(names: Sequence[str]) -> dict[str, SliderMethod]:
    """Return methods by name: built-in ones, or functions as `package.module:function`.

    A module is searched on the Python path and in the current folder.

    Raises:
        ProgdfError: there is no such method.
    """
    return {name: _find_method(name) for name in names}


def _find_method(name: str) -> SliderMethod:
    if name in METHODS:
        return METHODS[name]
    module_name, _, function_name = name.partition(":")
    if not module_name or not function_name:
        raise ProgdfError(
            f"unknown method '{name}'; use one of {', '.join(METHODS)}, or package.module:function"
        )
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        method: SliderMethod = getattr(importlib.import_module(module_name), function_name)
    except ImportError as error:
        raise ProgdfError(f"the method {name} cannot be imported ({error}); check the name") from error
    except AttributeError:
        raise ProgdfError(f"{module_name} has no function '{function_name}'; check the name") from None
    if not callable(method):
        raise ProgdfError(f"{name} is not a function; give a function from an EditTask to a slider")
    return method


def _train_options(task: EditTask, name: str) -> TrainOptions:
    """Write the pictures, cameras and members to the task's folder; return options to train on them."""
    given = task.folder / "given"
    cameras = [view.camera for view in task.views]
    make_folder(given)
    save_cameras(given / "cameras.json", cameras, task.scene.origin)
    with atomic_write(given / "members.npy") as temporary_file:
        np.save(temporary_file, task.region.members.numpy())
    for strength, pictures in task.pictures.items():
        for camera, picture in zip(cameras, pictures, strict=True):
            write_image(given / "edited" / f"{strength:g}" / f"{camera.name}.png", picture)
    return TrainOptions(
        scene=task.scene_file,
        out=task.folder / name,
        region=RegionOptions(f"file:{given / 'members.npy'}"),
        editor=EditorOptions(f"folder:{given / 'edited'}"),
        views=TrainingViewOptions(
            given / "cameras.json", views=len(cameras), image_size=task.effort.image_size
        ),
        # stages 0: one per strength in the folder; the slider value is the editor's strength
        optimize=OptimizeOptions(task.effort.steps, stages=0, slider="stages"),
        seed=task.seed,
        threads=task.threads,
        report="short",
    )


def _open_trained(options: TrainOptions) -> OpenedRun:
    """Train, unless the folder holds the same run already; return the run."""
    state = find_run(options)
    if state != "finished":
        train(replace(options, resume=state == "stopped"), quiet=True)
    return open_run(options.out)


def _interpolate(values: Mapping[float, Tensor], s: float) -> Tensor:
    """Interpolate linearly between values by strength; the last one holds beyond it."""
    strengths = sorted(values)
    s = min(max(s, strengths[0]), strengths[-1])
    after = next(i for i, strength in enumerate(strengths) if strength >= s and i > 0)
    low = strengths[after - 1]
    high = strengths[after]
    return torch.lerp(values[low], values[high], (s - low) / (high - low))
