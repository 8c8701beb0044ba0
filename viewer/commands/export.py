"""Command `progdf export`: the edited scene as a file, as frames, as a bundle, as a .cube or as a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from progdf.errors import ProgdfError
from progdf.formats import scene_file, usd
from progdf.formats.cube import SUFFIX as CUBE
from progdf.gaussians import ZERO
from progdf.io.atomic import check_not_an_input
from progdf.io.bundle import BUNDLE
from progdf.terminal import format_count, print_line
from viewer.camera import view_camera
from viewer.files.edited_scene import compose, describe_loss, save_bundle, save_cube
from viewer.files.session import WindowSession
from viewer.files.web_page import PAGE, PAGE_ASPECT, PageOptions, write_page
from viewer.pictures import film
from viewer.state import timeline
from viewer.state.layers import describe_strengths
from viewer.state.view_state import Timeline, ViewState

from .open_stack import OpenStack, open_stack
from .options import ExportOptions
from .stack_options import parse


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
        view = _view_of_scene(opened, PAGE_ASPECT)
        print_line(write_page(out, opened.document, view, opened.snapshots, options.page))
        return 0
    if ending == CUBE:
        print_line(save_cube(out, opened.document, opened.view))
        return 0
    if ending == BUNDLE:
        view = _view_of_scene(opened)
        print_line(save_bundle(out, WindowSession(opened.document, view, opened.snapshots)))
        return 0
    if several:
        return _export_frames(options, opened)
    document = opened.document
    strengths = describe_strengths(opened.view)
    edited = compose(opened.document, opened.view)
    read_back = scene_file.save_scene(out, edited, options.glb_axes)
    far = ", x y z as doubles (far from 0)" if document.scene.origin != ZERO and ending == ".ply" else ""
    how = "read back and compared" if ending == ".ply" else describe_loss(out, edited, read_back)
    print_line(f"wrote {out}: {format_count(len(edited))}, {strengths}{far}; {how}")
    kind = "ply" if document.path is None else scene_file.scene_format(document.path)
    if ending == ".ply" and kind != "ply":
        print_line(f"{document.title} is a .{kind}, this is a plain .ply")
    return 0


def _view_of_scene(opened: OpenStack, aspect: float = 1.5) -> ViewState:
    """Return the view of a session, else that of its strengths with the first camera of the scene.

    Args:
        opened: the scenes and edits
        aspect: width / height of the part of the picture that holds the scene's subject
    """
    if opened.session is not None:
        return opened.view
    document = opened.document
    stored = document.stored_camera
    camera = view_camera.first_camera(document.framed_scene, aspect=aspect, up=opened.up, stored=stored)
    return replace(opened.view, camera=camera)


def _export_frames(options: ExportOptions, opened: OpenStack) -> int:
    """Write numbered files, or time samples of one file: steps up to the strengths, or frames of a
    timeline."""
    out = options.out
    document = opened.document
    rate = float(Timeline().fps)
    whole = scene_file.written_format(out) == usd.SUFFIX
    if not options.timeline:
        steps = np.linspace(0.0, 1.0, options.frames or 0).tolist()
        scenes = (compose(document, opened.view, share, whole) for share in steps)
        what = f"steps from the original to {describe_strengths(opened.view)}"
    else:
        keys = opened.timeline
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
        scenes = (compose(document, state, 1.0, whole) for state in states)
        what = "frames of the timeline"
    for number in range(len(steps)):
        check_not_an_input(scene_file.frame_path(out, number), opened.files)
    paths = scene_file.save_frames(out, scenes, rate, options.glb_axes)
    ends = f"{paths[0]} to {paths[-1].name}" if len(paths) > 1 else paths[0]
    print_line(f"wrote {ends}: {len(steps)} {what}")
    return 0
