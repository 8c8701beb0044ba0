"""Commands `progdf render` and `export`: pictures, comparisons, sheets and films; scenes and pages."""

from __future__ import annotations

import math
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from progdf.camera import Camera
from progdf.compose.added import remaining_rows
from progdf.errors import ProgdfError
from progdf.field.baked import GradeForm, lattice_colors, lattice_side
from progdf.field.grade import mapped_lattice
from progdf.formats import scene_file, usd
from progdf.formats.cube import SIDE, write_cube
from progdf.formats.cube import SUFFIX as CUBE
from progdf.gaussians import ZERO, Gaussians
from progdf.gdf.file import Gdf
from progdf.io.atomic import atomic_write, check_not_an_input
from progdf.io.bundle import BUNDLE, write_bundle
from progdf.io.cameras import read_camera
from progdf.io.picture_camera import camera_chunk
from progdf.metrics.image import NO_DIFFERENCE
from progdf.metrics.readback import ReadBack
from progdf.scene.strays import picture_difference
from progdf.terminal import file_size, format_count, print_line
from progdf.threads import one_thread
from viewer.camera import view_camera
from viewer.camera.view_camera import FARTHEST, LARGEST_SIDE, Vec3, ViewCamera, bounds_of
from viewer.files import session
from viewer.files.document import Document
from viewer.files.session import WindowSession
from viewer.files.web_page import PAGE, PageOptions, compose_view, write_page
from viewer.pictures import film
from viewer.pictures.compare import Comparer, draw_labels
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state import timeline
from viewer.state.layers import visible_edits, visible_layers
from viewer.state.snapshots import compare_sides
from viewer.state.view_state import MAX_AMPLIFIED, Comparison, Timeline, ViewState

from .options import (
    ExportOptions,
    OpenStack,
    RenderOptions,
    ViewpointOptions,
    check_edit,
    open_stack,
    parse_number,
)
from .stack_options import parse

DEFAULT_SIZE = (640, 480)
_PROGRESS_INTERVAL_S = 0.5
_LONGEST_S = 120.0  # maximum duration of a turntable
_SWEEP_S = 2.0  # duration of a slider's sweep from 0 to 1 and back
EXCLUSIVE_OPTIONS = ("sweep", "sheet", "split", "difference", "timeline", "turntable")
"""Options that choose the kind of picture; only one may be given."""


def export(argv: Sequence[str]) -> int:
    """Run `progdf export`: the edited scene for other programs, or with its sliders for a browser or a
    colleague."""
    options: ExportOptions = parse(ExportOptions, argv, "progdf export")
    out = options.out
    endings = (end for end in (CUBE, BUNDLE, PAGE) if out.name.lower().endswith(end))
    ending = next(endings, None) or scene_file.written_format(out)
    several = options.frames is not None or options.timeline
    if several and ending in (CUBE, BUNDLE, PAGE):
        raise ProgdfError(f"--frames and --timeline write one scene per frame, which {out.name} cannot hold")
    if options.frames is not None and not 2 <= options.frames <= scene_file.MAX_FRAMES:
        raise ProgdfError(f"--frames takes 2 to {scene_file.MAX_FRAMES} steps, not {options.frames}")
    if ending != PAGE and (options.page, options.up, options.background) != (PageOptions(), "auto", "white"):
        raise ProgdfError(f"{out} is not a web page; leave out the options of .html pages")
    if ending != ".glb" and options.glb_axes != "LUF":
        raise ProgdfError(f"{out} is not a .glb; leave out --glb-axes")
    drawing = options.drawing if ending == PAGE else None
    opened = open_stack(options.stack, drawing, unset=1.0)
    check_not_an_input(out, opened.files)
    if ending == PAGE:
        view = opened.view
        if opened.session is None:
            document = opened.document
            camera = view_camera.first_camera(document.original, up=opened.up, stored=document.stored_camera)
            view = replace(view, camera=camera)
        print_line(write_page(out, opened.document, view, opened.snapshots, options.page))
        return 0
    if ending == CUBE:
        return _export_cube(out, opened)
    if ending == BUNDLE:
        return _export_bundle(out, opened)
    if several:
        return _export_frames(options, opened)
    document = opened.document
    strengths = describe_strengths(opened.view)
    edited = _compose(opened.document, opened.view)
    read_back = scene_file.save_scene(out, edited, options.glb_axes)
    far = ", x y z as doubles (far from 0)" if document.scene.origin != ZERO and ending == ".ply" else ""
    how = "read back and compared" if ending == ".ply" else _describe_loss(out, edited, read_back)
    print_line(f"wrote {out}: {format_count(len(edited))}, {strengths}{far}; {how}")
    kind = "ply" if document.path is None else scene_file.scene_format(document.path)
    if ending == ".ply" and kind != "ply":
        print_line(f"{document.title} is a .{kind}, this is a plain .ply")
    return 0


def _export_frames(options: ExportOptions, opened: OpenStack) -> int:
    """Write numbered files, or time samples of one file: steps up to the strengths, or frames of a
    timeline."""
    out = options.out
    document = opened.document
    rate = float(Timeline().fps)
    whole = scene_file.written_format(out) == usd.SUFFIX
    if not options.timeline:
        steps = np.linspace(0.0, 1.0, options.frames or 0).tolist()
        scenes = (_compose(document, opened.view, share, whole) for share in steps)
        what = f"steps from the original to {describe_strengths(opened.view)}"
    else:
        keys = _keys(opened)
        if not any(key.strengths for key in keys.keys):
            raise ProgdfError("--timeline: the timeline moves no slider, so all frames would be equal")
        steps = [*timeline.film_frames(keys)]
        rate = float(keys.fps)
        if options.frames is not None:
            steps = film.sheet_frames(keys, options.frames)
            rate *= (len(steps) - 1) / keys.length  # same duration
        if len(steps) > scene_file.MAX_FRAMES:
            raise ProgdfError(f"--timeline: the film has {len(steps)} frames; limit them with --frames N")
        states = (timeline.state_at(keys, frame, opened.view) for frame in steps)
        scenes = (_compose(document, state, 1.0, whole) for state in states)
        what = "frames of the timeline"
    for number in range(len(steps)):
        check_not_an_input(scene_file.frame_path(out, number), opened.files)
    paths = scene_file.save_frames(out, scenes, rate, options.glb_axes)
    ends = f"{paths[0]} to {paths[-1].name}" if len(paths) > 1 else paths[0]
    print_line(f"wrote {ends}: {len(steps)} {what}")
    return 0


def _compose(document: Document, view: ViewState, share: float = 1.0, whole: bool = False) -> Gaussians:
    """Return the scene at a share of the strengths, without rows that draw nothing, unless `whole`."""
    edited = compose_view(document.scene, document.gdfs, view, share)
    return edited if whole else edited[remaining_rows(document.original, edited)]


def _describe_loss(out: Path, edited: Gaussians, read_back: ReadBack | None) -> str:
    """Return the size of a written scene, and its largest shift and picture error when it is read back.

    Args:
        out: the file
        edited: the scene that was written
        read_back: the scene in the file; None for a .usdc, which is not read
    """
    size = f"{file_size(out.stat().st_size)}, {out.stat().st_size / len(edited):.1f} bytes each"
    if read_back is None:
        return f"{size}, exact float32"
    shift = "positions exact"
    if read_back.position_error:
        shift = f"positions within {read_back.position_error:.2g}"
    mean, worst = picture_difference(edited, read_back.scene)
    pictures = f"{mean:.1f} dB to it, {worst:.1f} at worst"
    if mean == NO_DIFFERENCE:
        pictures = "no pixel differs"
    return "; ".join([size, f"read back: {shift}, {pictures}", *read_back.notes])


def _export_bundle(out: Path, opened: OpenStack) -> int:
    """Write the scene, its edits and the session in one file."""
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        source = Path(folder) / "stack.session.json"
        session.save(source, WindowSession(opened.document, opened.view, opened.snapshots))
        count = write_bundle(out, source)
    print_line(f"wrote {out}: {file_size(out.stat().st_size)}, {count} files; open it with progdf view")
    return 0


def _export_cube(out: Path, opened: OpenStack) -> int:
    """Write the color map of one grade as a .cube file, at its strength and its color gain."""
    states = visible_layers(opened.view)
    forms = [opened.document.gdfs[state.gdf].field.origin for state in states]
    form = forms[0] if forms else None
    if len(forms) != 1 or not isinstance(form, GradeForm):
        raise ProgdfError(f"{out} holds the color map of one grade; give one edit that is a grade")
    (state,) = states
    side = SIDE if form.degree else lattice_side(form.table.shape[1])
    same = lattice_colors(side)
    table = same + state.gains.color * (mapped_lattice(form, state.strength, side) - same)
    write_cube(out, table, state.name)
    parts = {"mask": form.mask is not None, "residual": len(form.residual), "paint": state.paint}
    left_out = "".join(f"; its {name} is left out" for name, part in parts.items() if part)
    print_line(f"wrote {out}: {side}³ colors, {describe_strengths(opened.view)}{left_out}")
    return 0


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
    camera = choose_camera(options.viewpoint, scene, gdfs, saved, opened.up, stored)
    swept = _swept_layers(options, opened)
    if films:
        viewpoint = options.viewpoint
        view = film.with_strengths(view, dict.fromkeys(swept, 0.0))
        keys = _keys(opened) if options.timeline else _film(options, opened, view, swept, camera)
        moves = options.timeline and timeline.camera_at(keys, 0) is not None
        if moves and (viewpoint.camera or viewpoint.orbit or viewpoint.frame):
            raise ProgdfError("--timeline moves the camera; leave out --camera, --orbit and --frame")
        with _engine(scene, gdfs, options) as engine:
            print_line(film.write(options.out, keys, view, camera, engine, _say_frames(), options.alpha))
        return 0
    with _engine(scene, gdfs, options) as engine:
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
    if options.alpha:
        picture = Image.fromarray(film.transparent_image(engine, view, camera))
        with atomic_write(options.out) as temporary_file:
            picture.save(temporary_file, pnginfo=camera_chunk(camera, visible_edits(view), origin, opened.up))
        return ""
    comparer = Comparer(engine, engine.ctx)
    comparer.sides = compare_sides(opened.snapshots, view)
    view = comparer.sides.right if comparer.sides else view
    try:
        image = comparer.image(view, camera=camera)
        # a comparison cannot be edited and trained on
        single = view.compare.mode == "off"
        carried = camera_chunk(camera, visible_edits(view), origin, opened.up) if single else None
        labelled = Image.fromarray(draw_labels(image, view.compare, comparer.labels(view)))
        with atomic_write(options.out) as temporary_file:
            labelled.save(temporary_file, pnginfo=carried)
        if view.compare.mode == "off":
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


def _keys(opened: OpenStack) -> Timeline:
    """Return the session's timeline."""
    if not opened.view.timeline.keys:
        raise ProgdfError(
            "--timeline: the timeline has no keys; set some with K in the window, and save a session"
        )
    return opened.view.timeline


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


@contextmanager
def _engine(scene: Gaussians, gdfs: Sequence[Gdf], options: RenderOptions) -> Iterator[ViewEngine]:
    """Create an engine for pictures without a window; "auto" works without OpenGL if there is none."""
    ctx = None
    if options.drawing.engine != "cpu":
        try:
            ctx = headless_context()
        except ProgdfError:
            if options.drawing.engine == "gl":
                raise
    engine = ViewEngine(ctx, scene, gdfs, options.drawing.engine)
    try:
        yield engine
    finally:
        engine.release()
        if ctx is not None:
            ctx.release()


def _say_frames() -> film.Advance:
    """Return a progress callback that prints to logs; a terminal gets no lines."""
    last = time.monotonic()

    def say(done: int, total: int) -> None:
        nonlocal last
        if not sys.stderr.isatty() and time.monotonic() - last >= _PROGRESS_INTERVAL_S:
            last = time.monotonic()
            print(f"frame {done}/{total}", file=sys.stderr, flush=True)

    return say


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


def describe_strengths(view: ViewState) -> str:
    """Return the visible layers with their strengths as text."""
    return ", ".join(f"{layer.name} {layer.strength:g}" for layer in visible_layers(view)) or "no edits"


def choose_camera(
    viewpoint: ViewpointOptions,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    saved: ViewCamera | None,
    up: Vec3 | None = None,
    stored: Camera | None = None,
) -> Camera:
    """Return the requested camera, the session's, the one stored in the scene's file, or a frame of the
    scene.

    Args:
        viewpoint: the requested viewpoint
        scene: the original
        gdfs: its edits, which --frame may name
        saved: camera of a session
        up: unit vector that is up in the scene; None estimates it
        stored: camera stored in the scene's file

    Raises:
        ProgdfError: options that contradict each other or name nothing.
    """
    size = None if viewpoint.size is None else parse_size(viewpoint.size)
    if viewpoint.camera is not None and viewpoint.orbit is not None:
        raise ProgdfError("--camera and --orbit cannot be combined; give only one of them")
    if viewpoint.camera is not None:
        if viewpoint.frame is not None:
            raise ProgdfError("--camera and --frame cannot be combined; give only one of them")
        camera = read_camera(viewpoint.camera, scene.origin)
        return camera if size is None else fit_camera(camera, size)
    width, height = size or DEFAULT_SIZE
    aspect = width / height
    view = saved or view_camera.first_camera(scene, aspect=aspect, up=up, stored=stored)
    if viewpoint.orbit is not None:
        view = parse_orbit(viewpoint.orbit, view)
    if viewpoint.frame is not None or (viewpoint.orbit is not None and saved is None):
        view = _frame_on(view, viewpoint.frame, scene, gdfs, aspect)
        if viewpoint.orbit is not None:  # an explicit distance overrides the fit
            view = parse_orbit(viewpoint.orbit, view)
    return view_camera.to_camera(view, width, height)


def _frame_on(
    view: ViewCamera, name: str | None, scene: Gaussians, gdfs: Sequence[Gdf], aspect: float
) -> ViewCamera:
    """Return a camera with the same direction, fitted to the subject of --frame."""
    if name is None:
        return view_camera.fit_subject(view, scene, aspect)
    if name == "all" and name not in [gdf.name for gdf in gdfs]:
        return view_camera.frame(view, bounds_of(scene), aspect)
    check_edit(name, gdfs, "--frame")
    (members,) = (gdf.region.members for gdf in gdfs if gdf.name == name)
    return view_camera.fit(view, scene[members], aspect)


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of `WxH` in pixels.

    Raises:
        ProgdfError: it is not a size, or a side is not 1 to `LARGEST_SIDE`.
    """
    width, cross, height = text.lower().partition("x")
    if not cross or not all(re.fullmatch(r"[0-9]{1,9}", side) for side in (width, height)):
        raise ProgdfError(f"--size {text} is not a size; write it as WIDTHxHEIGHT, for example 640x480")
    size = int(width), int(height)
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise ProgdfError(f"--size {text} cannot be drawn; each side may be 1 to {LARGEST_SIDE} pixels")
    return size


def parse_orbit(text: str, framed: ViewCamera) -> ViewCamera:
    """Return the camera of `AZIMUTH,ELEVATION[,DISTANCE]`: degrees, degrees above the horizon, world units.

    Args:
        text: the option's value
        framed: shows the scene; gives the pivot, the up axis, and the default distance

    Raises:
        ProgdfError: it is not two or three finite numbers, or a number is outside its range.
    """
    right = "write AZIMUTH,ELEVATION or AZIMUTH,ELEVATION,DISTANCE, for example --orbit 30,15"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ProgdfError(f"--orbit {text} is not a list of numbers; {right}") from None
    if len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise ProgdfError(f"--orbit {text} is not two or three numbers; {right}")
    if not -90 <= numbers[1] <= 90:
        raise ProgdfError(
            f"--orbit {text}: the elevation must be between -90 and 90 degrees, got {numbers[1]:g}"
        )
    distance = numbers[2] if len(numbers) == 3 else framed.distance
    if not 0 < distance <= FARTHEST:
        raise ProgdfError(
            f"--orbit {text}: the distance must be above 0 and at most {FARTHEST:g}, got {distance:g}"
        )
    return replace(framed, azimuth=numbers[0], elevation=numbers[1], distance=distance)


def fit_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the same view in another size, undistorted: same height of the scene, sides cut or widened."""
    width, height = size
    scale = height / camera.height
    K = camera.K * scale
    K[2, 2] = 1.0
    K[0, 2] = width / 2 + (camera.K[0, 2] - camera.width / 2) * scale
    return replace(camera, K=K, width=width, height=height)
