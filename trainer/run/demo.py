"""`progdf demo`: make a scene, train edits, render pictures of the sliders, and open the window."""

from __future__ import annotations

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
from progdf.system.desktop import has_display
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
"""Function that paints on a picture [H,W,3]: picture, camera, coverage of named parts [H,W] -> picture."""

STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Strengths at which sliders.png and hero.png show the edits."""

MAX_GAUSSIANS = 5_000_000
"""Maximum of --size, the size of large trained scenes."""
_HERO_HEIGHT = 400  # pixels
_CAMERA_OFFSETS = (-4, 3, 6)  # side views, in cameras from the picture's camera; cameras are 11 degrees apart


@dataclass(frozen=True)
class DemoEdit:
    """Edit of the demo: its name, the parts that it may change, and its editor."""

    name: str
    parts: tuple[str, ...] = ()
    editor: str = ""
    # makes the changed picture that the edit is trained on; the region is then found from the picture
    paint: Paint | None = None


@dataclass(frozen=True)
class Effort:
    """Training effort of an edit, see `TrainOptions`."""

    views: int
    image_size: int
    steps: int


@dataclass(frozen=True)
class DemoPlan:
    """Scene of the demo and its edits."""

    make: Callable[[int, int], DemoScene]  # size and seed -> the scene
    size: int  # default number of Gaussians
    view: int  # index of the scene's camera for the pictures
    inside: bool  # train from the scene's own cameras, as the interior is not visible from outside
    draft: Effort  # with --quick
    full: Effort  # without --quick
    # two edits without common Gaussians, one that overlaps at least one of them, and optional others
    edits: tuple[DemoEdit, ...]


_FUR_PARTS = ("body", "head", "ears", "arms", "legs")
SHOWS = {
    "bear": DemoPlan(
        bear,
        size=24_000,
        view=2,
        inside=False,
        draft=Effort(views=10, image_size=160, steps=160),
        full=Effort(views=24, image_size=256, steps=480),
        edits=(
            # A small palette of warm against cold: fur and a red accent in front of a cold sky. Gold is the
            # warm extreme. Frost removes all warmth except the scarf's. Petrol is the complement of red,
            # reached through plum.
            DemoEdit("scarf", ("scarf",), "recolor:#1b6972"),
            DemoEdit("gold", _FUR_PARTS, "recolor:#d0921a"),
            DemoEdit("frost", (*_FUR_PARTS, "grass"), "recolor:#e3eefa"),
            DemoEdit("panda", paint=paint_panda),
        ),
    ),
    "room": DemoPlan(
        room,
        size=40_000,
        view=0,
        inside=True,
        # a view from inside shows only a part, so the room needs more views, and more steps to visit each
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
    """Make a scene, train edits of it, write pictures, and open the window if there is a display."""

    scene: Literal["bear", "room"] = "bear"
    """Scene to make: a bear in the grass, shown from all sides, or a room, shown from inside."""
    size: Annotated[int | None, absent_option("COUNT", "24000 for the bear, 40000 for the room")] = None
    """Number of Gaussians."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """Folder for the scene, the edits and the pictures; created if needed."""
    quick: bool = False
    """Draft in a third of the time: fewer and smaller views, fewer steps."""
    seed: int = 0
    """Random seed of the scene and of the training."""
    threads: int = 0
    """CPU threads (0: all cores)."""
    window: bool = True
    """Open the window at the end, if there is a display."""


def main(argv: Sequence[str]) -> int:
    """Run the demo.

    Raises:
        ProgdfError: an option is out of range.
    """
    options = parse_options(DemoOptions, argv, "progdf demo")
    _check(options)
    begun = time.perf_counter()
    show = SHOWS[options.scene]
    scene = show.make(show.size if options.size is None else options.size, options.seed)
    write_scene(options.out, scene)
    print_line(f"{options.scene}: {len(scene.gaussians)} Gaussians in {options.out / 'scene.ply'}")
    gdfs = {
        name: load_gdf(path, scene.gaussians) for name, path in _train_edits(options, show, scene).items()
    }
    print()
    for picture in write_pictures(options.out, scene, gdfs, show.view):
        print_line(f"look at {picture}")
    command = [
        "view",
        str(options.out / "scene.ply"),
        *(str(_gdf_path(options.out, edit)) for edit in show.edits),
    ]
    command += ["--background", hex_color(scene.background)]
    print(f"\ndone in {time.perf_counter() - begun:.0f} s; drag the sliders:")
    print_line(f"  progdf {shlex.join(command)}")
    sys.stdout.flush()
    if options.window and has_display():
        return _open_window(command)
    return 0


def _open_window(command: Sequence[str]) -> int:
    """Open the window in another process and return its exit status.

    The trainer and the viewer share nothing but files.
    """
    return subprocess.run([sys.executable, "-P", "-m", "progdf", *command], check=False).returncode


def _check(options: DemoOptions) -> None:
    """Raise a ProgdfError for a number out of range, before anything is made or written."""
    if options.size is not None and options.size > MAX_GAUSSIANS:
        raise ProgdfError(f"--size must be at most {MAX_GAUSSIANS}, got {options.size}")
    check_ranges(("--seed", options.seed, 0, LARGEST_SEED), ("--threads", options.threads, 0, MAX_THREADS))


def write_scene(folder: Path, scene: DemoScene) -> None:
    """Write scene.ply, labels.npy ([N] uint8) and cameras.json. Create the folder if needed.

    Raises:
        ProgdfError: the folder cannot be created or written to.
    """
    make_folder(folder)
    save_ply(folder / "scene.ply", scene.gaussians)
    with atomic_write(folder / "labels.npy") as temporary_file:
        np.save(temporary_file, scene.labels.numpy())
    save_cameras(folder / "cameras.json", scene.cameras, scene.gaussians.origin)


def write_pictures(folder: Path, scene: DemoScene, gdfs: Mapping[str, Gdf], view: int) -> list[Path]:
    """Render the effect of the sliders: each slider alone, one enlarged, and the edit made from one picture.

    Args:
        folder: contains scene.ply and receives the pictures
        scene: provides cameras and background
        gdfs: the edits by name
        view: index of the camera

    Returns:
        Paths of sliders.png and hero.png, and for an edit made from a changed picture one-picture.png: the
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
            views = shot(_HERO_HEIGHT, {}), read_picture(folder / f"{name}.png", (_HERO_HEIGHT, _HERO_HEIGHT))
            sides = [shot(_HERO_HEIGHT, {name: 1.0}, view + turn) for turn in _CAMERA_OFFSETS]
            pictures.append(("one-picture", torch.cat([*views, *sides], dim=1)))
    written = []
    for name, image in pictures:
        written.append(folder / f"{name}.png")
        write_image(written[-1], image)
    return written


def _train_edits(options: DemoOptions, show: DemoPlan, scene: DemoScene) -> dict[str, Path]:
    """Train the edits, continue a stopped demo, and return their .gdf files by name."""
    from .resume import find_run  # late import: `--help` and the pictures do not need it
    from .run import train

    for edit in show.edits:
        if edit.paint is not None:
            _paint_picture(options.out / f"{edit.name}.png", scene, scene.cameras[show.view], edit.paint)
    runs = {edit.name: _train_options(options, show, scene, edit) for edit in show.edits}
    found = {name: find_run(run) for name, run in runs.items()}
    for number, edit in enumerate(show.edits, 1):
        description = (
            f"{edit.editor} on {', '.join(edit.parts)}" if edit.paint is None else f"{edit.name}.png"
        )
        print(f"\n{number} of {len(show.edits)}: {edit.name}: {description}", flush=True)
        out = options.out / edit.name
        resumes = "stopped" in found.values() and found[edit.name] != "nothing"
        if not resumes:
            StateFolder(out / "state").clear()  # left by a demo with other options
        try:
            train(replace(runs[edit.name], resume=resumes))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"the progress is saved in {options.out}; repeat the command to continue"
            ) from None
    return {edit.name: _gdf_path(options.out, edit) for edit in show.edits}


def _train_options(options: DemoOptions, show: DemoPlan, scene: DemoScene, edit: DemoEdit) -> TrainOptions:
    """Return the training options of one edit."""
    ids = ",".join(str(scene.label_names.index(part)) for part in edit.parts)
    folder = options.out
    effort = show.draft if options.quick else show.full
    painted = edit.paint is not None
    return TrainOptions(
        scene=folder / "scene.ply",
        out=folder / edit.name,
        region=RegionOptions("changed" if painted else f"labels:{folder / 'labels.npy'}:{ids}"),
        editor=EditorOptions(
            f"pictures:{folder / f'{edit.name}.png'}" if painted else edit.editor,
            carry_on="always" if painted else "auto",  # a panda all around, not from the front alone
        ),
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
    """Write a render of the scene from `camera`, changed by `paint`. The .png file carries the camera."""
    gaussians = scene.gaussians

    def cover(parts: tuple[str, ...]) -> Tensor:
        colors = torch.zeros(len(gaussians), 3).index_fill(0, scene.members(*parts), 1.0)
        return render(gaussians, camera, (0.0, 0.0, 0.0), colors=colors).image[..., 0].clamp(0, 1)

    with torch.no_grad():
        picture = render(gaussians, camera, scene.background).image.clamp(0, 1)
        painted = to_picture(paint(picture, camera, cover))
    with atomic_write(path) as temporary_file:
        painted.save(temporary_file, pnginfo=camera_chunk(camera, origin=scene.gaussians.origin))


def _gdf_path(folder: Path, edit: DemoEdit) -> Path:
    return folder / edit.name / f"{edit.name}.gdf"
