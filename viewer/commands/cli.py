"""The commands `progdf view` and `progdf export`; `progdf render` is in render.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from progdf.cli.options import parse_options
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.formats.load_report import format_count
from progdf.formats.ply import save_ply_checked
from progdf.formats.scene_file import scene_format
from progdf.gaussians import ZERO
from progdf.io.atomic import check_not_an_input
from progdf.terminal import print_line
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera
from viewer.files.document import empty
from viewer.state.layers import visible_layers
from viewer.state.paint import layer_of
from viewer.state.view_state import ViewState

from . import arguments, opening
from .options import NO_SCENE, ExportOptions, ViewOptions


@one_thread()
def view(argv: Sequence[str]) -> int:
    """`progdf view`: open the window and stay until it is closed."""
    options = parse_options(
        ViewOptions, arguments.join_arguments(opening.drop_option_name(argv)), "progdf view"
    )
    found = (
        opening.open_stack(options) if options.scene != NO_SCENE else opening.OpenStack(empty(), ViewState())
    )
    from viewer.app.app import run  # imgui and glfw, which render and export do without

    state = found.view if found.session is not None else replace(found.view, grid=True)
    if found.session is None and options.scene != NO_SCENE:
        state = replace(state, camera=first_camera(found.document.scene, up=found.up))
    return run(
        found.document,
        state,
        session=found.session,
        snapshots=found.snapshots,
        draw=options.engine,
        warning=found.warning,
    )


def export(argv: Sequence[str]) -> int:
    """`progdf export`: the edited scene as a .ply that any viewer opens."""
    options = parse_options(
        ExportOptions, arguments.join_arguments(opening.drop_option_name(argv)), "progdf export"
    )
    if options.out.suffix.lower() != ".ply":
        raise ProgdfError(f"{options.out} is not a .ply file; give the edited scene a name that ends in .ply")
    found = opening.open_stack(options, unset=1.0)
    check_not_an_input(options.out, found.files)
    gdfs, states = found.document.gdfs, visible_layers(found.view)
    layers = [layer_of(gdfs[state.gdf], state.strength, state.gains, state.paint) for state in states]
    edited = compose_layers(found.document.scene, layers, found.view.blend)
    save_ply_checked(options.out, edited)
    far = ", x y z as doubles as it is far from 0" if found.document.scene.origin != ZERO else ""
    strengths = arguments.describe_strengths(found.view)
    print_line(f"wrote {options.out}: {format_count(len(edited))}, {strengths}{far}; read back and compared")
    source = found.document.path
    if source is not None and (kind := scene_format(source)) != "ply":
        print_line(f"{found.document.title} is a .{kind}, this is a plain .ply")
    return 0
