"""`progdf demo`: a scene of our own, trained edits, pictures of what the sliders do, and the window."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from progdf.camera import Camera
from progdf.cli.options import absent_option, parse_options
from progdf.color.edits import hex_color
from progdf.compose.reference import Layer, compose_layers
from progdf.demo_scenes import DemoScene, bear, paint_panda, room
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, save_ply
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.atomic import atomic_write, make_folder
from progdf.io.cameras import save_cameras
from progdf.io.images import contact_sheet, read_picture, to_picture, write_image
from progdf.io.picture_camera import camera_chunk
from progdf.rasterize import render
from progdf.terminal import print_line
from trainer.options import (
    LARGEST_SEED,
    MAX_THREADS,
    EditorOptions,
    OptimizeOptions,
    RegionOptions,
    TrainingViewOptions,
    TrainOptions,
    check_ranges,
)
from trainer.store.state import StateFolder

Paint = Callable[[Tensor, Camera, Callable[[tuple[str, ...]], Tensor]], Tensor]
STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
MAX_GAUSSIANS = 5_000_000
"""As many as large trained scenes have: what --size says at most."""
_HERO_HEIGHT = 400
_TURNS = (-4, 3, 6)  # cameras from the one of the picture, 11 degrees each


@dataclass(frozen=True)
class DemoEdit:
    """One edit of the demo: what it is called, which parts it may change, how."""

    name: str
    parts: tuple[str, ...] = ()
    editor: str = ""
    # makes a changed picture of the scene, of which the edit is then made: picture, its camera, how much of
    # each pixel named parts are -> picture; its parts are found
    paint: Paint | None = None


@dataclass(frozen=True)
class Effort:
    """How much training an edit gets, see `TrainOptions`."""

    views: int
    image_size: int
    steps: int


@dataclass(frozen=True)
class Show:
    """What the demo does with one scene."""

    make: Callable[[int, int], DemoScene]  # size and seed -> the scene
    size: int  # Gaussians if nobody says how many
    view: int  # which of the scene's cameras takes the pictures
    # whether the edits are trained from the scene's own cameras, as one cannot see in from outside
    inside: bool
    draft: Effort  # the effort of --quick
    full: Effort  # the effort otherwise
    # two edits that share no Gaussian, one that meets one of them at least, and more
    edits: tuple[DemoEdit, ...]


_COAT = ("body", "head", "ears", "arms", "legs")
SHOWS = {
    "bear": Show(
        bear,
        size=24_000,
        view=2,
        inside=False,
        draft=Effort(views=10, image_size=160, steps=160),
        full=Effort(views=24, image_size=256, steps=480),
        edits=(
            # Few hues, warm against cold: fur and one red accent before a cold sky. Gold is the warm end,
            # frost takes all warmth but the scarf's, and petrol, red's opposite, is reached by way of plum.
            DemoEdit("scarf", ("scarf",), "recolor:#1b6972"),
            DemoEdit("gold", _COAT, "recolor:#d0921a"),
            DemoEdit("frost", (*_COAT, "grass"), "recolor:#e3eefa"),
            DemoEdit("panda", paint=paint_panda),
        ),
    ),
    "room": Show(
        room,
        size=40_000,
        view=0,
        inside=True,
        # from inside each view shows a part only: more of them, and more steps to come round to each
        draft=Effort(views=16, image_size=160, steps=200),
        full=Effort(views=30, image_size=256, steps=560),
        edits=(
            DemoEdit("rug", ("rug",), "recolor:#3a55b4"),
            DemoEdit("walls", ("walls",), "recolor:#e0a458"),
            DemoEdit(
                "dusk",
                ("walls", "rug", "floor", "ceiling", "table", "stool", "ball", "picture"),
                "tint:#4f6fd8",
            ),
        ),
    ),
}


@dataclass(frozen=True)
class DemoOptions:
    """Make a scene, train edits of it, write pictures, open the window if there is a display."""

    scene: Literal["bear", "room"] = "bear"
    """A bear in the grass to look at from all around, or a room to stand in."""
    size: Annotated[int | None, absent_option("COUNT", "24000 for the bear, 40000 for the room")] = None
    """Number of Gaussians."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """Folder for the scene, the edits and the pictures; created if needed."""
    quick: bool = False
    """A draft in a third of the time: fewer views, smaller, fewer steps."""
    seed: int = 0
    """Random seed of the scene and of the training."""
    threads: int = 0
    """CPU threads; 0 takes all cores."""
    window: bool = True
    """Open the window at the end, where there is a display."""


def main(argv: Sequence[str]) -> int:
    """Run the demo. Raises ProgdfError for options that cannot be met."""
    options = parse_options(DemoOptions, argv, "progdf demo")
    _check(options)
    begun = time.perf_counter()
    show = SHOWS[options.scene]
    scene = show.make(show.size if options.size is None else options.size, options.seed)
    write_scene(options.out, scene)
    print_line(f"{options.scene}: {len(scene.gaussians)} Gaussians in {options.out / 'scene.ply'}")
    gdfs = {name: load_gdf(path, scene.gaussians) for name, path in _train(options, show, scene).items()}
    print()
    for picture in write_pictures(options.out, scene, gdfs, show.view):
        print_line(f"look at {picture}")
    command = ["view", str(options.out / "scene.ply"), *(str(_gdf(options.out, edit)) for edit in show.edits)]
    command += ["--background", hex_color(scene.background)]
    print(f"\ndone in {time.perf_counter() - begun:.0f} s; drag the sliders:")
    print_line(f"  progdf {shlex.join(command)}")
    sys.stdout.flush()
    if options.window and _has_display():
        return _open_window(command)
    return 0


def _open_window(command: Sequence[str]) -> int:
    """Another process, as the trainer and the viewer share nothing but files; the exit status."""
    return subprocess.run([sys.executable, "-P", "-m", "progdf", *command], check=False).returncode


def _check(options: DemoOptions) -> None:
    """Raises ProgdfError for a number that cannot be, before anything is made or written."""
    if options.size is not None and options.size > MAX_GAUSSIANS:
        raise ProgdfError(f"--size must be at most {MAX_GAUSSIANS}, got {options.size}")
    check_ranges(("--seed", options.seed, 0, LARGEST_SEED), ("--threads", options.threads, 0, MAX_THREADS))


def write_scene(folder: Path, scene: DemoScene) -> None:
    """Write scene.ply, labels.npy ([N] uint8) and cameras.json; the folder is made if need be.

    Raises:
        ProgdfError: the folder cannot be made or written to.
    """
    make_folder(folder)
    save_ply(folder / "scene.ply", scene.gaussians)
    with atomic_write(folder / "labels.npy") as temporary_file:
        np.save(temporary_file, scene.labels.numpy())
    save_cameras(folder / "cameras.json", scene.cameras, scene.gaussians.origin)


def write_pictures(folder: Path, scene: DemoScene, gdfs: Mapping[str, Gdf], view: int) -> list[Path]:
    """Write what sliders do: each alone, in large, and of one picture.

    Args:
        folder: where scene.ply lies and the pictures go
        scene: its cameras and background
        gdfs: the edits by name
        view: which camera

    Returns:
        sliders.png, hero.png, and for an edit made of a changed picture one-picture.png: the
        render, the picture, and the edit from three sides
    """
    gaussians = load_ply(folder / "scene.ply")

    def shot(height: int, strengths: Mapping[str, float], view: int = view) -> Tensor:
        camera = scene.cameras[view]
        layers = [Layer(gdfs[name], strength) for name, strength in strengths.items()]
        sized = camera.resize(round(height * camera.width / camera.height), height)
        with torch.no_grad():
            return render(compose_layers(gaussians, layers), sized, background=scene.background).image

    names = list(gdfs)
    sliders = contact_sheet(
        [[shot(300, {name: strength}) for strength in STRENGTHS] for name in names],
        names,
        [f"{strength:.0%}" for strength in STRENGTHS],
        "One slider per edit",
        "  ·  ".join(f"{name}: {gdf.instruction}" for name, gdf in gdfs.items()),
    )
    hero = torch.cat([shot(_HERO_HEIGHT, {names[2]: strength}) for strength in STRENGTHS], dim=1)
    pictures = [("sliders", sliders), ("hero", hero)]
    for name in names:
        if (folder / f"{name}.png").is_file():
            given = shot(_HERO_HEIGHT, {}), read_picture(folder / f"{name}.png", (_HERO_HEIGHT, _HERO_HEIGHT))
            sides = [shot(_HERO_HEIGHT, {name: 1.0}, view + turn) for turn in _TURNS]
            pictures.append(("one-picture", torch.cat([*given, *sides], dim=1)))
    written = []
    for name, image in pictures:
        written.append(folder / f"{name}.png")
        write_image(written[-1], image)
    return written


def _train(options: DemoOptions, show: Show, scene: DemoScene) -> dict[str, Path]:
    """Train the edits; their .gdf files by name. A demo that was stopped goes on where it was."""
    from .resume import find_run  # only now: `--help` and the pictures need none of it
    from .run import train

    for edit in show.edits:
        if edit.paint is not None:
            _paint_picture(options.out / f"{edit.name}.png", scene, scene.cameras[show.view], edit.paint)
    runs = {edit.name: _train_options(options, show, scene, edit) for edit in show.edits}
    here = {name: find_run(run) for name, run in runs.items()}
    for number, edit in enumerate(show.edits, 1):
        how = f"{edit.editor} on {', '.join(edit.parts)}" if edit.paint is None else f"{edit.name}.png"
        print(f"\n{number} of {len(show.edits)}: {edit.name}: {how}", flush=True)
        out = options.out / edit.name
        goes_on = "stopped" in here.values() and here[edit.name] != "nothing"
        if not goes_on:
            StateFolder(out / "state").clear()  # of a demo with other options
        try:
            train(replace(runs[edit.name], resume=goes_on))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"what is done is kept in {options.out}; give the same command again to go on"
            ) from None
    return {edit.name: _gdf(options.out, edit) for edit in show.edits}


def _train_options(options: DemoOptions, show: Show, scene: DemoScene, edit: DemoEdit) -> TrainOptions:
    """How one edit is trained."""
    ids = ",".join(str(scene.label_names.index(part)) for part in edit.parts)
    folder = options.out
    effort = show.draft if options.quick else show.full
    painted = edit.paint is not None
    return TrainOptions(
        scene=folder / "scene.ply",
        out=folder / edit.name,
        region=RegionOptions("changed" if painted else f"labels:{folder / 'labels.npy'}:{ids}"),
        editor=EditorOptions(f"pictures:{folder / f'{edit.name}.png'}" if painted else edit.editor),
        views=TrainingViewOptions(
            cameras=folder / "cameras.json" if show.inside else None,
            views=effort.views,
            image_size=0 if painted and not options.quick else effort.image_size,
        ),
        optimize=OptimizeOptions(steps=effort.steps),
        seed=options.seed,
        threads=options.threads,
    )


def _paint_picture(path: Path, scene: DemoScene, camera: Camera, paint: Paint) -> None:
    """Write the scene as `camera` shows it, changed by hand; the .png carries the camera."""
    gaussians = scene.gaussians

    def cover(parts: tuple[str, ...]) -> Tensor:
        colors = torch.zeros(len(gaussians), 3).index_fill(0, scene.members(*parts), 1.0)
        return render(gaussians, camera, (0.0, 0.0, 0.0), colors=colors).image[..., 0].clamp(0, 1)

    with torch.no_grad():
        picture = render(gaussians, camera, scene.background).image.clamp(0, 1)
        painted = to_picture(paint(picture, camera, cover))
    with atomic_write(path) as temporary_file:
        painted.save(temporary_file, pnginfo=camera_chunk(camera, origin=scene.gaussians.origin))


def _gdf(folder: Path, edit: DemoEdit) -> Path:
    return folder / edit.name / f"{edit.name}.gdf"


def _has_display() -> bool:
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
