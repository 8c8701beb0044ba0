"""Command `progdf render`: pictures, comparisons, contact sheets and films."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, check_not_an_input
from progdf.io.picture_camera import camera_chunk, check_camera_file, save_picture_camera
from progdf.rasterize.first_start import compile_with_bar
from progdf.terminal import print_line
from progdf.threads import one_thread
from viewer.camera import view_camera
from viewer.camera.view_camera import ViewCamera, bounds_of
from viewer.files import exports
from viewer.pictures import film
from viewer.pictures.compare import Comparer, draw_labels
from viewer.render.engine import ViewEngine, headless_engine
from viewer.state import timeline
from viewer.state.layers import describe_strengths, visible_edits
from viewer.state.snapshots import compare_sides
from viewer.state.view_state import MAX_AMPLIFIED, Comparison, Timeline, ViewState

from .open_stack import OpenStack, check_edit, open_stack, parse_number
from .options import RenderOptions
from .stack_options import parse
from .viewpoint import choose_camera

_PROGRESS_INTERVAL_S = 0.5
_LONGEST_S = 120.0  # maximum duration of a turntable
_SWEEP_S = 2.0  # duration of a slider's sweep from 0 to 1 and back
EXCLUSIVE_OPTIONS = ("sweep", "sheet", "split", "difference", "timeline", "turntable")
"""Options that choose the kind of picture; only one may be given."""


@one_thread()
def render(argv: Sequence[str]) -> int:
    """Run `progdf render`: one picture, a comparison, a contact sheet, a sweep or a film."""
    options: RenderOptions = parse(RenderOptions, argv, "progdf render")
    _check_output(options)
    films = options.sweep is not None or options.timeline or options.turntable is not None
    one_slider_moves = options.sweep is not None or options.sheet is not None
    opened = open_stack(options.stack, options.drawing, 0.0 if one_slider_moves else 1.0)
    check_not_an_input(options.out, opened.files)
    scene = opened.document.scene
    gdfs = opened.document.gdfs
    view = opened.view
    view = replace(view, compare=_comparison(options, view.compare))
    if options.alpha and (view.compare.mode != "off" or options.sheet is not None):
        raise ProgdfError("--alpha goes with a picture or a film; leave out comparisons and sheets")
    saved = None if opened.session is None else view.camera
    stored = opened.document.stored_camera
    framed = opened.document.framed_scene if opened.document.files else None
    if options.viewpoint.camera is None:
        compile_with_bar("draw")  # the first view is chosen by small pictures
    camera = choose_camera(options.viewpoint, scene, gdfs, saved, opened.up, stored, framed)
    if _is_single(options, view):
        check_camera_file(options.out)
    swept = _swept_layers(options, opened)
    if films:
        viewpoint = options.viewpoint
        view = film.with_strengths(view, dict.fromkeys(swept, 0.0))
        keys = opened.timeline if options.timeline else _film(options, opened, view, swept, camera)
        moves = options.timeline and timeline.camera_at(keys, 0) is not None
        if moves and (viewpoint.camera or viewpoint.orbit or viewpoint.frame):
            raise ProgdfError("--timeline moves the camera; leave out --camera, --orbit and --frame")
        with headless_engine(scene, gdfs, options.drawing.engine) as engine:
            print_line(film.write(options.out, keys, view, camera, engine, _say_frames(), options.alpha))
        return 0
    with headless_engine(scene, gdfs, options.drawing.engine) as engine:
        comparison = ""
        if swept:
            sheet = film.contact_sheet(swept, lambda state: engine.image(state, camera=camera), view)
            with atomic_write(options.out) as temporary_file:
                Image.fromarray(sheet).save(temporary_file)
        else:
            comparison = _render_still(options, opened, view, camera, engine)
        drawn_by = engine.draws_with
    each = "each " if swept else ""
    strengths = "" if swept else f": {describe_strengths(view)}"
    print_line(f"wrote {options.out} ({each}{camera.width}x{camera.height}, drawn by {drawn_by}){strengths}")
    if comparison:
        print_line(comparison)
    if (
        options.viewpoint.camera is None
        and saved is None
        and options.drawing.up == "auto"
        and not opened.document.detected_up.certain
    ):
        print_line(f"up is {opened.document.detected_up.reason}")
    if view.layers and not swept and not any(layer.strength for layer in view.layers):
        print_line(
            f"every slider is at 0, so this is the original; --set {view.layers[0].name}=1 shows an edit"
        )
    return 0


def _render_still(
    options: RenderOptions, opened: OpenStack, view: ViewState, camera: Camera, engine: ViewEngine
) -> str:
    """Write one picture with the comparison of `view`; return a line about the comparison."""
    origin = opened.document.scene.origin
    layers = None
    with contextlib.suppress(ProgdfError):  # the picture has the names of the edits alone
        layers = exports.picture_layers(opened.document, view)
    if options.alpha:
        picture = Image.fromarray(film.transparent_image(engine, view, camera))
        chunk = camera_chunk(camera, visible_edits(view), origin, opened.up, layers)
        with atomic_write(options.out) as temporary_file:
            picture.save(temporary_file, pnginfo=chunk)
        save_picture_camera(options.out, camera, origin, layers)
        return ""
    comparer = Comparer(engine, engine.ctx)
    comparer.sides = compare_sides(opened.snapshots, view)
    view = comparer.sides.right if comparer.sides else view
    try:
        image = comparer.image(view, camera=camera)
        single = _is_single(options, view)
        carried = camera_chunk(camera, visible_edits(view), origin, opened.up, layers) if single else None
        labelled = Image.fromarray(draw_labels(image, view.compare, comparer.labels(view)))
        with atomic_write(options.out) as temporary_file:
            labelled.save(temporary_file, pnginfo=carried)
        if single:
            save_picture_camera(options.out, camera, origin, layers)
            return ""
        if comparer.sides is None:
            return f"PSNR of edited against original {comparer.psnr:.2f} dB"
        return "PSNR of snapshot {1} against {0} {2:.2f} dB".format(*comparer.sides.names, comparer.psnr)
    finally:
        comparer.release()


def _comparison(options: RenderOptions, saved: Comparison) -> Comparison:
    """Return the requested comparison, or the session's."""
    if options.split is not None:
        problem = f"--split must be between 0 and 1, got {options.split}"
        return Comparison("split", divider=parse_number(options.split, 0.0, 1.0, problem))
    if options.difference is not None:
        amplify = options.difference
        problem = f"--difference must be between 1 and {MAX_AMPLIFIED:g}, got {amplify}"
        return Comparison("difference", amplify=parse_number(amplify, 1.0, MAX_AMPLIFIED, problem))
    return saved


def _is_single(options: RenderOptions, view: ViewState) -> bool:
    """Return whether the output is one picture of one camera, which can be edited and trained on."""
    is_film = options.sweep is not None or options.timeline or options.turntable is not None
    return not is_film and options.sheet is None and view.compare.mode == "off"


def _check_output(options: RenderOptions) -> None:
    """Check that the file's name fits its content."""
    suffix = options.out.suffix.lower()
    given = [name for name in EXCLUSIVE_OPTIONS if getattr(options, name) not in (None, False)]
    if len(given) > 1:
        raise ProgdfError(f"--{given[0]} and --{given[1]} cannot be combined; give only one of them")
    if options.sweep is not None or options.turntable is not None or options.timeline:
        film.check_output(options.out, options.alpha)
    elif suffix in film.ANIMATIONS:
        raise ProgdfError(f"{options.out} holds an animation; add --sweep NAME or --turntable 4")
    elif suffix != ".png":
        raise ProgdfError(f"{options.out} is not a .png file; pictures are written as .png")
    film.check_encoder(options.out)


def _film(
    options: RenderOptions, opened: OpenStack, view: ViewState, swept: Sequence[str], camera: Camera
) -> Timeline:
    """Return a film of sliders from 0 to 1 and back, or of one orbit around the scene from the given
    camera."""
    if options.turntable is None:
        gdfs = [layer.gdf for layer in view.layers if layer.name in swept]
        return timeline.slider_film(view, gdfs, Timeline().fps, _SWEEP_S)
    problem = f"--turntable must be 1 to {_LONGEST_S:g} seconds, got {options.turntable}"
    seconds = parse_number(options.turntable, 1.0, _LONGEST_S, problem)
    scene = opened.document.original
    around = view_camera.from_camera(ViewCamera(up=opened.up), camera, bounds_of(scene))
    return timeline.turntable(around, Timeline().fps, seconds)


def _swept_layers(options: RenderOptions, opened: OpenStack) -> list[str]:
    """Return the names of the layers whose sliders move in the picture: none, one or two."""
    if options.sweep == "all" and opened.view.layers and "all" not in [l.name for l in opened.view.layers]:
        return [_check_visible(layer.name, opened.view, "--sweep") for layer in opened.view.layers]
    if options.sweep is not None:
        return [_check_visible(opened.layer(options.sweep), opened.view, "--sweep")]
    if options.sheet is None:
        return []
    names = [_check_visible(opened.layer(name), opened.view, "--sheet") for name in options.sheet.split(",")]
    if len(names) > 2 or len(set(names)) < len(names):
        raise ProgdfError(f"--sheet {options.sheet} does not name one or two different edits; name those")
    return names


def _check_visible(name: str, view: ViewState, option: str) -> str:
    """Return `name` if such an edit exists and is hidden neither by a solo layer nor by its group at 0."""
    check_edit(name, view.layers, option)
    group = next(layer.group for layer in view.layers if layer.name == name)
    if any(known.name == group and not known.strength for known in view.groups):
        raise ProgdfError(f"{option} {name}: its group {group} is at 0, so nothing would change; raise it")
    solo_layers = [layer.name for layer in view.layers if layer.solo]
    if solo_layers and name not in solo_layers:
        raise ProgdfError(
            f"{option} {name}: {solo_layers[0]} is shown alone and hides it; show {name} alone too"
        )
    return name


def _say_frames() -> film.Advance:
    """Return a progress callback that prints to logs; a terminal gets no lines."""
    last = time.monotonic()

    def say(done: int, total: int) -> None:
        nonlocal last
        if not sys.stderr.isatty() and time.monotonic() - last >= _PROGRESS_INTERVAL_S:
            last = time.monotonic()
            print(f"frame {done}/{total}", file=sys.stderr, flush=True)

    return say
