"""The commands `progdf view`, `progdf render` and `progdf export`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image
from plyfile import PlyData

from progdf.camera import Camera
from progdf.checkpoint import Gdf
from progdf.compose import compose
from progdf.errors import ProgdfError
from progdf.files import written_whole
from progdf.gaussians import ATTRIBUTES, Gaussians, normalize_quats
from progdf.load_report import counted
from progdf.ply import GEOMETRY, load_ply, save_ply

from . import arguments, film, session_arguments, timeline, timeline_file, timeline_film
from . import document as documents
from .camera_arguments import asked_camera
from .compare import Comparer
from .compare_labels import labelled
from .engine import Engine
from .headless import headless_context
from .layer_arguments import stack_of
from .options import ExportOptions, RenderOptions, StackOptions, ViewOptions
from .paint import layer_of
from .stack import shown
from .state import LayerState, ViewState
from .turntable import first_camera

ONE_OF = ("sweep", "sheet", "split", "difference", "timeline")
"""Options of `progdf render` that each say what the picture is."""
_BARE = {"--split": "0.5", "--difference": "4"}  # what an option without a value means


def view(argv: Sequence[str]) -> int:
    """`progdf view`: open the window and stay until it is closed."""
    options = tyro.cli(ViewOptions, args=_joined(argv), prog="progdf view")
    opened = session_arguments.from_session(options)
    from .app import run  # imgui and glfw, which render and export do without

    if opened is not None:
        kept = opened.session
        return run(kept.document, kept.view, session=opened.path, snapshots=kept.snapshots)
    document = documents.load(options.scene, options.gdfs)
    scene, gdfs = document.scene, document.gdfs
    state = ViewState(
        first_camera(scene),
        _layers(options, gdfs),
        options.blend,
        arguments.parse_background(options.background),
        overshoot=options.overshoot,
    )
    return run(document, state)


def render(argv: Sequence[str]) -> int:
    """`progdf render`: one picture, a sweep, or a contact sheet."""
    options = tyro.cli(RenderOptions, args=_joined(argv), prog="progdf render")
    _check_output(options)
    size = None if options.size is None else arguments.parse_size(options.size)
    background = arguments.parse_background(options.background)
    opened = session_arguments.from_session(options)
    if opened is None:
        scene, gdfs = _load(options.scene, options.gdfs)
        state = ViewState(layers=_layers(options, gdfs), blend=options.blend, background=background)
    else:
        document, state = opened.session.document, opened.session.view
        scene, gdfs = document.scene, document.gdfs
    layers = state.layers
    swept = _swept(options, gdfs)
    camera = asked_camera(options, scene, gdfs, size, None if opened is None else state.camera)
    comparison = arguments.parse_comparison(options.split, options.difference)
    if comparison.mode == "off":
        comparison = state.compare
    if options.timeline is not None:
        keys = timeline_file.load(options.timeline, layers)
        if timeline.camera_at(keys, 0) is not None and (options.camera or options.orbit):
            raise ProgdfError(f"{options.timeline} moves the camera; leave out --camera and --orbit")
        with _engine(scene, gdfs, options.engine) as engine:
            print(timeline_film.write(options.out, keys, state, camera, engine))
        return 0
    with _engine(scene, gdfs, options.engine) as engine, written_whole(options.out) as beside:

        def picture(wanted: ViewState) -> film.Pixels:
            return film.to_pixels(engine.image(wanted, camera=camera))

        if options.sweep is not None:
            frames = (picture(moved) for moved in film.sweep(state, swept[0]))
            write = film.write_gif if options.out.suffix.lower() == ".gif" else film.write_mp4
            write(beside, frames)
        elif len(swept) == 2:
            Image.fromarray(film.grid(swept[0], swept[1], picture, state)).save(beside)
        elif swept:
            Image.fromarray(film.contact_sheet(swept[0], picture, state)).save(beside)
        elif comparison.mode != "off":
            decibels = _compare(engine, replace(state, compare=comparison), camera, beside)
        else:
            Image.fromarray(picture(state)).save(beside)
        drawn_with = engine.draws_with
    each = "each " if options.sheet is not None else ""
    print(f"wrote {options.out} ({each}{camera.width}x{camera.height}, drawn by {drawn_with})")
    if comparison.mode != "off":
        print(f"PSNR of edited against original {decibels:.2f} dB")
    if gdfs and not swept and not any(layer.strength for layer in layers):
        print(f"every slider is at 0, so this is the original; --set {gdfs[0].name}=1 shows an edit")
    return 0


def export(argv: Sequence[str]) -> int:
    """`progdf export`: the edited scene as a .ply that any viewer opens."""
    options = tyro.cli(ExportOptions, args=_joined(argv), prog="progdf export")
    if options.out.suffix.lower() != ".ply":
        raise ProgdfError(f"{options.out} is not a .ply file; give the edited scene a name that ends in .ply")
    _check_not_an_input(options.out, (options.scene, *options.gdfs))
    scene, gdfs = _load(options.scene, options.gdfs)
    states = shown(ViewState(layers=_layers(options, gdfs)))
    layers = [layer_of(gdfs[state.gdf], state.strength, state.gains, state.paint) for state in states]
    edited = compose(scene, layers, options.blend)
    with written_whole(options.out) as beside:
        save_ply(beside, edited)
        _check_reloaded(edited, load_ply(beside))
        _check_by_plyfile(edited, beside)
    told = ", ".join(f"{state.name} {state.strength:g}" for state in states) or "no edits"
    print(f"wrote {options.out}: {counted(len(edited))}, {told}; read back and compared")
    return 0


def _load(scene_path: Path, gdf_paths: Sequence[Path]) -> tuple[Gaussians, tuple[Gdf, ...]]:
    scene = load_ply(scene_path)
    return scene, arguments.load_edits(gdf_paths, scene, scene_path)


def _compare(engine: Engine, view: ViewState, camera: Camera, path: Path) -> float:
    """Write the comparison that `view` asks for; gives the PSNR of its two pictures, dB."""
    comparer = Comparer(engine, engine.ctx)
    try:
        image = comparer.image(view, camera=camera)
        Image.fromarray(labelled(image, view.compare, comparer.labels(view))).save(path)
    finally:
        comparer.release()
    return comparer.psnr


def _layers(options: StackOptions, gdfs: Sequence[Gdf]) -> tuple[LayerState, ...]:
    return stack_of(gdfs, options.set, options.gain, options.solo, options.overshoot, options.paint)


def _swept(options: RenderOptions, gdfs: Sequence[Gdf]) -> list[str]:
    """Names of the edits whose sliders move in the picture: none, one or two."""
    if options.sweep is not None:
        return [_showing(arguments.known_edit(options.sweep, gdfs, "--sweep"), options, "--sweep")]
    if options.sheet is None:
        return []
    named = [arguments.known_edit(name, gdfs, "--sheet") for name in options.sheet.split(",")]
    names = [_showing(name, options, "--sheet") for name in named]
    if len(names) > 2 or len(set(names)) < len(names):
        raise ProgdfError(f"--sheet {options.sheet} does not name one or two different edits; name those")
    return names


def _showing(name: str, options: RenderOptions, option: str) -> str:
    """`name`, when its slider can show something: another edit that is alone hides it."""
    if options.solo and name not in options.solo:
        raise ProgdfError(f"{option} {name}: --solo {options.solo[0]} hides it; add --solo {name}")
    return name


@contextmanager
def _engine(scene: Gaussians, gdfs: Sequence[Gdf], draw: str) -> Iterator[Engine]:
    """An engine for pictures without a window; "auto" does without OpenGL where there is none."""
    ctx = None
    if draw != "cpu":
        try:
            ctx = headless_context()
        except ProgdfError:
            if draw == "gl":
                raise
    engine = Engine(ctx, scene, gdfs, draw)
    try:
        yield engine
    finally:
        engine.release()
        if ctx is not None:
            ctx.release()


def _check_output(options: RenderOptions) -> None:
    """Whether the file's name fits what goes into it."""
    suffix = options.out.suffix.lower()
    given = [name for name in ONE_OF if getattr(options, name) is not None]
    if len(given) > 1:
        raise ProgdfError(f"--{given[0]} and --{given[1]} were both given; give one of them")
    if options.timeline is not None:
        timeline_film.check_output(options.out)
    if options.sweep is not None and suffix not in (".gif", ".mp4"):
        raise ProgdfError(f"{options.out} cannot hold an animation; --sweep writes a .gif or an .mp4")
    moves = options.sweep is not None or options.timeline is not None
    if not moves and suffix in (".gif", ".mp4"):
        raise ProgdfError(f"{options.out} holds an animation; say which slider moves with --sweep NAME")
    if not moves and suffix != ".png":
        raise ProgdfError(f"{options.out} is not a .png file; pictures are written as .png")
    film.check_encoder(options.out)
    _check_not_an_input(options.out, (options.scene, *options.gdfs))


def _check_not_an_input(out: Path, inputs: Sequence[Path]) -> None:
    for path in inputs:
        if out.exists() and path.exists() and os.path.samefile(out, path):
            raise ProgdfError(f"{out} is one of the files to read; choose another name for the result")


def _check_reloaded(written: Gaussians, read: Gaussians) -> None:
    """Raises ProgdfError where the file gives back anything but what was written into it."""
    for name in ATTRIBUTES:
        expected, found = getattr(written, name), getattr(read, name)
        if name == "quats":
            same = torch.allclose(normalize_quats(expected), found, rtol=0.0, atol=1e-6)
        else:
            same = torch.equal(expected, found)
        if not same:
            raise ProgdfError(f"the written file does not give back its {name}; check the disk and try again")


def _check_by_plyfile(written: Gaussians, path: Path) -> None:
    """The same by a reader that is not ours, as other programs will read the file."""
    vertex = PlyData.read(path)["vertex"]
    for name, columns in GEOMETRY.items():
        found = np.stack([vertex[column] for column in columns], axis=1)
        if not np.array_equal(found, getattr(written, name).reshape(len(written), -1).numpy()):
            raise ProgdfError(f"plyfile reads other {name} than were written; check the disk and try again")


def _joined(argv: Sequence[str]) -> list[str]:
    """`--orbit -30,15` as `--orbit=-30,15`: what begins with a minus would be taken for an option.

    `--split` and `--difference` without a number get theirs.
    """
    joined: list[str] = []
    for argument in session_arguments.without_name(argv):
        if joined and joined[-1] == "--orbit":
            joined[-1] = f"--orbit={argument}"
        elif joined and joined[-1] in _BARE and arguments.is_number(argument):
            joined[-1] = f"{joined[-1]}={argument}"
        else:
            joined.append(argument)
    return [f"{argument}={_BARE[argument]}" if argument in _BARE else argument for argument in joined]
