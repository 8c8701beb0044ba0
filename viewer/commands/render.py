"""The command `progdf render`: pictures, comparisons, contact sheets and films without a window."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.cli.options import parse_options
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.atomic import atomic_write, check_not_an_input
from progdf.io.picture_camera import camera_chunk
from progdf.terminal import print_line
from progdf.torch_threads import one_thread
from viewer.files import timeline_file
from viewer.pictures import film
from viewer.pictures.compare import Comparer, draw_labels
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state import facts, timeline
from viewer.state.layers import shown_edits
from viewer.state.snapshots import compare_sides
from viewer.state.view_state import Comparison, Timeline, ViewState

from . import arguments, opening
from .arguments import choose_camera
from .opening import OpenStack
from .options import RenderOptions

_SAY_EVERY_S = 0.5
ONE_OF = ("sweep", "sheet", "split", "difference", "timeline")
"""Options that each say what the picture is; only a timeline goes with a sheet."""


@one_thread()
def render(argv: Sequence[str]) -> int:
    """`progdf render`: one picture, a comparison, a contact sheet, a sweep or a film."""
    options = parse_options(
        RenderOptions, arguments.join_arguments(opening.drop_option_name(argv)), "progdf render"
    )
    _check_output(options)
    size = None if options.size is None else arguments.parse_size(options.size)
    one_moves = options.sweep is not None or (options.sheet is not None and options.timeline is None)
    found = opening.open_stack(options, unset=0.0 if one_moves else 1.0)
    check_not_an_input(options.out, found.files)
    scene, gdfs, view = found.document.scene, found.document.gdfs, found.view
    view = replace(view, compare=_comparison(options, view.compare))
    if options.alpha and (view.compare.mode != "off" or one_moves or options.timeline is not None):
        raise ProgdfError("--alpha goes with a single picture; leave out comparisons, sheets and films")
    saved = None if found.session is None else view.camera
    camera = choose_camera(options, scene, gdfs, size, saved, found.up)
    if options.timeline is not None:
        keys, count = _keys(options, found), _count(options.sheet)
        with _engine(scene, gdfs, options) as engine:
            print_line(film.write(options.out, keys, view, camera, engine, count, _say_frames()))
        return 0
    swept = _swept_layers(options, found)
    with _engine(scene, gdfs, options) as engine:
        if swept:
            _render_film(options, swept, view, camera, engine)
            told = ""
        else:
            told = _render_still(options, found, view, camera, engine)
        drawn_by = engine.draws_with
    each = "each " if options.sheet is not None else ""
    strengths = "" if swept else f": {arguments.describe_strengths(view)}"
    print_line(f"wrote {options.out} ({each}{camera.width}x{camera.height}, drawn by {drawn_by}){strengths}")
    if told:
        print_line(told)
    if (
        options.camera is None
        and saved is None
        and options.up == "auto"
        and not found.document.found_up.certain
    ):
        print_line(f"up is {found.document.found_up.reason}")
    if view.layers and not swept and not any(layer.strength for layer in view.layers):
        print_line(
            f"every slider is at 0, so this is the original; --set {view.layers[0].name}=1 shows an edit"
        )
    return 0


def _render_film(
    options: RenderOptions, swept: Sequence[str], view: ViewState, camera: Camera, engine: ViewEngine
) -> None:
    """An animation of one slider, or a contact sheet of one or two."""

    def picture(wanted: ViewState) -> film.Pixels:
        return film.to_pixels(engine.image(wanted, camera=camera))

    with atomic_write(options.out) as temporary_file:
        if options.sweep is not None:
            frames = (picture(moved) for moved in film.sweep(view, swept[0]))
            write = film.write_gif if options.out.suffix.lower() == ".gif" else film.write_mp4
            write(temporary_file, frames)
        elif len(swept) == 2:
            Image.fromarray(film.grid(swept[0], swept[1], picture, view)).save(temporary_file)
        else:
            Image.fromarray(film.contact_sheet(swept[0], picture, view)).save(temporary_file)


def _render_still(
    options: RenderOptions, found: OpenStack, view: ViewState, camera: Camera, engine: ViewEngine
) -> str:
    """One picture, compared as `view` asks; gives what to say about the comparison."""
    origin = found.document.scene.origin
    if options.alpha:
        picture = Image.fromarray(transparent_image(engine, view, camera))
        with atomic_write(options.out) as temporary_file:
            picture.save(temporary_file, pnginfo=camera_chunk(camera, shown_edits(view), origin, found.up))
        return ""
    where = found.document.recordings()
    missing = facts.obstacle(where)
    if view.compare.mode != "off" and view.compare.against == "recorded" and missing:
        raise ProgdfError(
            f"there is nothing recorded to compare with: {missing}; give the .gdf in its run folder"
        )
    comparer = Comparer(engine, engine.ctx, where)
    comparer.sides = compare_sides(found.snapshots, view)
    view = comparer.sides.right if comparer.sides else view
    try:
        image = comparer.image(view, camera=camera)
        # a comparison is no view that could be edited and trained on
        single = view.compare.mode == "off"
        carried = camera_chunk(camera, shown_edits(view), origin, found.up) if single else None
        labelled = Image.fromarray(draw_labels(image, view.compare, comparer.labels(view)))
        with atomic_write(options.out) as temporary_file:
            labelled.save(temporary_file, pnginfo=carried)
        if view.compare.mode == "off":
            return ""
        if comparer.against(view) == "original":
            return f"PSNR of edited against original {comparer.psnr:.2f} dB"
        if comparer.sides is not None:
            return "PSNR of snapshot {1} against {0} {2:.2f} dB".format(*comparer.sides.names, comparer.psnr)
        recorded = facts.describe(view, engine.gdfs, comparer.recordings)
        return f"PSNR of the field against what was recorded {comparer.psnr:.2f} dB ({recorded})"
    finally:
        comparer.release()


def _comparison(options: RenderOptions, saved: Comparison) -> Comparison:
    """What was asked for; else what the session shows."""
    asked = arguments.parse_comparison(options.split, options.difference)
    asked = saved if asked.mode == "off" else asked
    if options.against is None:
        return asked
    if asked.mode == "off":
        raise ProgdfError(f"--against {options.against} needs a comparison; add --split or --difference")
    return replace(asked, against=options.against)


def _keys(options: RenderOptions, found: OpenStack) -> Timeline:
    """The timeline that was asked for: of a file of its own, or of the session."""
    assert options.timeline is not None
    own = found.session is not None and options.timeline.exists() and options.timeline.samefile(found.session)
    keys = (
        found.view.timeline
        if own
        else timeline_file.load(options.timeline, found.view.layers, found.document.scene.origin)
    )
    if own and not keys.keys:
        raise ProgdfError(f"{options.timeline} has no keys on its timeline; set some with K in the window")
    if timeline.camera_at(keys, 0) is not None and (options.camera or options.orbit or options.frame):
        raise ProgdfError(f"{options.timeline} moves the camera; leave out --camera, --orbit and --frame")
    return keys


def _count(sheet: str | None) -> int:
    """How many pictures of a film a contact sheet shall show; 0 where none was asked for."""
    if sheet is None:
        return 0
    if not (sheet.isdecimal() and len(sheet) < 9) or not 1 <= int(sheet) <= film.MOST_SHOWN:
        most = film.MOST_SHOWN
        raise ProgdfError(f"--sheet {sheet} is not a number of pictures; give one from 1 to {most}")
    return int(sheet)


def _swept_layers(options: RenderOptions, found: OpenStack) -> list[str]:
    """Names of the layers whose sliders move in the picture: none, one or two."""
    if options.sweep is not None:
        return [_check_visible(found.layer(options.sweep), found.view, "--sweep")]
    if options.sheet is None:
        return []
    names = [_check_visible(found.layer(name), found.view, "--sheet") for name in options.sheet.split(",")]
    if len(names) > 2 or len(set(names)) < len(names):
        raise ProgdfError(f"--sheet {options.sheet} does not name one or two different edits; name those")
    return names


def _check_visible(name: str, view: ViewState, option: str) -> str:
    """`name`, when there is such an edit, and neither another that is alone nor its group at 0 hides it."""
    arguments.known_edit(name, view.layers, option)
    group = next(layer.group for layer in view.layers if layer.name == name)
    if any(known.name == group and not known.strength for known in view.groups):
        raise ProgdfError(f"{option} {name}: its group {group} is at 0, so nothing would change; raise that")
    alone = [layer.name for layer in view.layers if layer.solo]
    if alone and name not in alone:
        raise ProgdfError(f"{option} {name}: {alone[0]} is shown alone and hides it; show {name} alone too")
    return name


@contextmanager
def _engine(scene: Gaussians, gdfs: Sequence[Gdf], options: RenderOptions) -> Iterator[ViewEngine]:
    """An engine for pictures without a window; "auto" does without OpenGL where there is none."""
    ctx = None
    if options.engine != "cpu":
        try:
            ctx = headless_context()
        except ProgdfError:
            if options.engine == "gl":
                raise
    engine = ViewEngine(ctx, scene, gdfs, options.engine)
    try:
        yield engine
    finally:
        engine.release()
        if ctx is not None:
            ctx.release()


def _say_frames() -> film.Advance:
    """Tells a log, now and then, how far a film is; terminals see the result soon enough."""
    last = time.monotonic()

    def say(done: int, total: int) -> None:
        nonlocal last
        if not sys.stderr.isatty() and time.monotonic() - last >= _SAY_EVERY_S:
            last = time.monotonic()
            print(f"frame {done}/{total}", file=sys.stderr, flush=True)

    return say


def _check_output(options: RenderOptions) -> None:
    """Whether the file's name fits what goes into it."""
    suffix = options.out.suffix.lower()
    given = [name for name in ONE_OF if getattr(options, name) is not None]
    if len(given) > 1 and given != ["sheet", "timeline"]:
        raise ProgdfError(f"--{given[0]} and --{given[1]} cannot be combined; give only one of them")
    films = options.timeline is not None and options.sheet is None
    if films:
        film.check_output(options.out)
    if options.sweep is not None and suffix not in (".gif", ".mp4"):
        raise ProgdfError(f"{options.out} cannot hold an animation; --sweep writes a .gif or an .mp4")
    moves = options.sweep is not None or films
    if not moves and suffix in (".gif", ".mp4"):
        raise ProgdfError(f"{options.out} holds an animation; say which slider moves with --sweep NAME")
    if not moves and suffix != ".png":
        raise ProgdfError(f"{options.out} is not a .png file; pictures are written as .png")
    film.check_encoder(options.out)


def transparent_image(engine: ViewEngine, view: ViewState, camera: Camera) -> NDArray[np.uint8]:
    """The view with its coverage as alpha, colors not multiplied by it. [H,W,4]"""
    black = engine.image(replace(view, background=(0.0, 0.0, 0.0)), camera=camera).copy()
    white = engine.image(replace(view, background=(1.0, 1.0, 1.0)), camera=camera)
    return unmix(black, white)


def unmix(black: NDArray[np.float32], white: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Color and alpha of what gives these two pictures on black and on white. [H,W,3] twice -> [H,W,4]"""
    alpha = np.clip(1.0 - (white - black).mean(axis=-1, keepdims=True), 0.0, 1.0)
    color = np.clip(black / np.maximum(alpha, 1e-6), 0.0, 1.0)
    rgba: NDArray[np.uint8] = np.round(255.0 * np.concatenate([color, alpha], axis=-1)).astype(np.uint8)
    return rgba
