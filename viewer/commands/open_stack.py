"""Scene with its edits, or session, as the options of a command open it."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Protocol

from progdf.cli.info import kind_of
from progdf.color.edits import parse_color
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.placed import Placement, placement_of
from progdf.io.bundle import BUNDLE, unpack_bundle
from progdf.region import Region
from progdf.scene.regions import check_region, parse_region
from viewer.camera.view_camera import Vec3, find_scene_up, first_camera, with_up
from viewer.files import document, scenes, session
from viewer.files.document import Document
from viewer.state import layers as stacks
from viewer.state.facts import describe_loaded
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import OVERSHOOT, LayerState, SceneState, Timeline, ViewState

from .stack_options import NO_SCENE, DrawingOptions, StackOptions, is_number

_log = logging.getLogger(__name__)

_SET_BY_SESSION = ("gdfs", "region", "gain", "solo", "overshoot", "background")


class Named(Protocol):
    """Edit or layer, identified by its name."""

    @property
    def name(self) -> str:
        """Name, unique in a stack."""


@dataclass(frozen=True)
class OpenStack:
    """Opened scene and edits, and their drawing state."""

    document: Document
    view: ViewState  # drawing state; for a scene, the command sets the camera
    session: Path | None = None  # the session's file; None for a scene
    snapshots: tuple[SliderSnapshot, ...] = ()
    up_option: str = "auto"  # an axis, or "auto"
    warning: str = ""  # parts of the session that were not restored as saved

    @property
    def up(self) -> Vec3:
        """Up direction of the scene."""
        opened = self.document
        if self.up_option == "auto":
            return opened.detected_up.direction
        return find_scene_up(opened.scene, opened.gdfs, self.up_option).direction

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that were read."""
        files = (*(file.path for file in self.document.scene_files), self.session)
        return (*(path for path in files if path is not None), *self.document.gdf_paths)

    @property
    def timeline(self) -> Timeline:
        """Timeline of the session. Raises ProgdfError if it has no keys."""
        if not self.view.timeline.keys:
            raise ProgdfError(
                "--timeline: the timeline has no keys; set some with K in the window, and save a session"
            )
        return self.view.timeline

    def layer(self, name: str) -> str:
        """Return the name of the layer of this name, else of this edit's layer (sessions rename layers)."""
        named = {self.document.gdfs[layer.gdf].name: layer.name for layer in self.view.layers}
        return name if name in named.values() else named.get(name, name)


def open_stack(stack: StackOptions, drawing: DrawingOptions | None = None, unset: float = 0.0) -> OpenStack:
    """Open the scene, or the session, with its edits.

    Args:
        stack: the scene, or a session, and its edits
        drawing: up axis and background, of commands that draw
        unset: strength of a scene's edits without a --set

    Raises:
        ProgdfError: a file is missing or broken, an edit was made for another scene or given twice, an option
            names no edit, or it contradicts the session.
    """
    if stack.scene.name.endswith(BUNDLE):
        stack = replace(stack, scene=unpack_bundle(stack.scene))
    if stack.scene.is_file() and kind_of(stack.scene) == "session":
        return _open_session(stack, drawing)
    paths: dict[str, Path] = {}
    for path in stack.gdfs:  # only a session may contain an edit twice
        first = paths.setdefault(os.path.realpath(path), path)
        if first is not path:
            again = "" if first == path else f", first as {first}"
            raise ProgdfError(f"{path} was given twice{again}; give each edit once")
    view = ViewState(overshoot=stack.overshoot)
    if drawing is not None:
        view = replace(view, background=parse_background(drawing.background))
    opened, states = _open_scenes(stack)
    for text in stack.region:
        check_edit(text.partition("=")[0], opened.gdfs, "--region")
    notes = [note for gdf in opened.gdfs if (note := describe_loaded(gdf))]
    for note in notes:
        _log.warning(note)
    layers = stack_layers(opened.gdfs, stack, unset)
    up = drawing.up if drawing else "auto"
    view = with_blends(replace(view, layers=layers, scenes=states), stack.blend)
    return OpenStack(opened, view, up_option=up, warning="; ".join(notes))


def _open_scenes(stack: StackOptions) -> tuple[Document, tuple[SceneState, ...]]:
    """Return the scenes with their edits, and the states of the scenes; none for a single scene at its place.

    An edit belongs to the last scene before it that it fits, or else to another one.
    """
    paths = [stack.scene]
    gdfs: list[Path] = []
    near: list[int] = []
    for path in stack.gdfs:
        if kind_of(path) == "scene":
            paths.append(path)
        else:
            gdfs.append(path)
            near.append(len(paths) - 1)
    files = [document.load_file(path) for path in paths]
    owners = [document.find_owner(path, files, at) for path, at in zip(gdfs, near, strict=True)]
    opened = document.load_stack(files, gdfs, _placing(stack.region), owners)
    view = ViewState(scenes=scenes.first_states(files[0].title))
    for index, file in enumerate(files[1:], 1):
        view = scenes.add_state(view, files[0].title, file.title, index, Placement())
    placed = place_scenes(view.scenes, stack.place)
    if len(files) == 1 and not stack.place:
        placed = ()
    return opened.arrange(placed), placed


def place_scenes(states: tuple[SceneState, ...], texts: Sequence[str]) -> tuple[SceneState, ...]:
    """Return the scenes at the placements of options `NAME=X,Y,Z[,RX,RY,RZ[,SCALE]]`.

    Raises:
        ProgdfError: there is no such scene, or a number is missing or out of range.
    """
    for text in texts:
        name, _, numbers = text.rpartition("=")
        found = [i for i, state in enumerate(states) if name in (state.name, Path(state.name).stem)]
        if not found:
            names = ", ".join(state.name for state in states) or "none, as only one scene is open"
            raise ProgdfError(f"--place {text}: there is no scene of that name; the scenes are {names}")
        values = [float(number) if is_number(number) else math.nan for number in numbers.split(",")]
        if len(values) not in (3, 6, 7) or not all(map(math.isfinite, values)):
            raise ProgdfError(f"--place {text}: write NAME=X,Y,Z, then degrees RX,RY,RZ, then a scale")
        changed = list(states)
        changed[found[0]] = replace(states[found[0]], placement=placement_of(values))
        states = tuple(changed)
    return states


def open_view(stack: StackOptions, drawing: DrawingOptions) -> tuple[session.WindowSession, Path | None]:
    """Return the initial state of `progdf view`, and the session's file."""
    if stack.scene == NO_SCENE:
        return session.WindowSession(document.empty(), ViewState(grid=True)), None
    opened = open_stack(stack, drawing)
    state = opened.view
    if opened.session is None:
        stored = opened.document.stored_camera
        framed = opened.document.framed_scene if opened.document.files else opened.document.scene
        camera = first_camera(framed, up=opened.up, stored=stored)
        state = replace(state, grid=True, camera=camera)
    return session.WindowSession(opened.document, state, opened.snapshots, opened.warning), opened.session


def _placing(texts: Sequence[str]) -> document.RegionChooser:
    """Return the function that gives an edit its region from `--region NAME=REGION`; check the syntax now."""
    specs: dict[str, str] = {}
    for text in texts:
        name, equals, spec = text.partition("=")
        if not equals or not name or name in specs:
            again = "names an edit twice" if name in specs else "has no NAME=REGION"
            raise ProgdfError(
                f"--region {text} {again}; write for each edit --region NAME=all or another region"
            )
        check_region(spec)
        specs[name] = spec

    def place(scene: Gaussians, index: int, name: str) -> Region | None:
        return parse_region(specs[name], scene) if name in specs else None

    return place


def _open_session(stack: StackOptions, drawing: DrawingOptions | None) -> OpenStack:
    """Open a session with the strengths and the blend rule of the options."""
    for part in (stack, drawing) if drawing is not None else (stack,):
        for field in fields(part):
            if field.name in _SET_BY_SESSION and getattr(part, field.name) != field.default:
                given = "an edit was given" if field.name == "gdfs" else f"--{field.name} was given"
                raise ProgdfError(
                    f"{given} with the session {stack.scene.name}, which already sets it; leave it out"
                )
    saved = session.open_session(stack.scene)
    up = drawing.up if drawing else "auto"
    opened = OpenStack(saved.document, saved.view, stack.scene, saved.snapshots, up, saved.warning)
    settings = [
        f"{opened.layer(name)}{equals}{s}" for name, equals, s in (t.rpartition("=") for t in stack.set)
    ]
    strengths = parse_strengths(saved.view.layers, settings, stacks.largest_strength(saved.view))
    layers = tuple(replace(l, strength=strengths.get(l.name, l.strength)) for l in saved.view.layers)
    rules = [
        f"{opened.layer(name)}{equals}{rule}"
        for name, equals, rule in (t.rpartition("=") for t in stack.blend)
    ]
    view = with_blends(replace(saved.view, layers=layers), rules)
    if stack.place:
        view = replace(view, scenes=place_scenes(view.scenes, stack.place))
        opened = replace(opened, document=opened.document.arrange(view.scenes))
    if up != "auto":  # otherwise the session's own
        view = replace(view, camera=with_up(view.camera, opened.up))
    return replace(opened, view=view)


def stack_layers(gdfs: Sequence[Gdf], stack: StackOptions, unset: float = 0.0) -> tuple[LayerState, ...]:
    """Return one layer per edit, the lowest first, at `unset` or the strength of its `--set`.

    Raises:
        ProgdfError: there is no such edit or kind of gain, or a number is outside its range.
    """
    strengths = parse_strengths(gdfs, stack.set, OVERSHOOT if stack.overshoot else 1.0)
    layers = {g.name: LayerState(i, g.name, strengths.get(g.name, unset)) for i, g in enumerate(gdfs)}
    for text in stack.gain:
        name, kind, gain = _parse_gain(text, gdfs, stack.overshoot)
        layers[name] = stacks.with_slider_value(layers[name], kind, gain, max(1.0, gain))
    for name in stack.solo:
        check_edit(name, gdfs, "--solo")
        layers[name] = replace(layers[name], solo=True)
    return tuple(layers.values())


def with_blends(view: ViewState, texts: Sequence[str]) -> ViewState:
    """Return the view with the blend rules of options `RULE`, for all layers, and `NAME=RULE`, for one.

    Raises:
        ProgdfError: there is no such layer.
    """
    for text in texts:
        name, equals, rule = text.rpartition("=")
        if not equals:
            view = replace(view, blend=rule)
            continue
        check_edit(name, view.layers, "--blend")
        layers = (replace(layer, blend=rule) if layer.name == name else layer for layer in view.layers)
        view = replace(view, layers=tuple(layers))
    return view


def parse_strengths(edits: Sequence[Named], settings: Sequence[str], most: float) -> dict[str, float]:
    """Return the strengths of settings `NAME=S`, from 0 to `most`.

    Raises:
        ProgdfError: there is no edit NAME, or S is not a number in this range.
    """
    strengths = {}
    for setting in settings:
        name, equals, text = setting.rpartition("=")
        if not equals or not name:
            example = edits[0].name if edits else "NAME"
            raise ProgdfError(f"--set {setting} is not NAME=S; write, for example, --set {example}=0.7")
        problem = f"--set {setting}: the strength '{text}' is not a number from 0 to {most:g}"
        strengths[check_edit(name, edits, "--set")] = parse_number(text, 0.0, most, problem)
    return strengths


def check_edit(name: str, edits: Sequence[Named], option: str) -> str:
    """Return `name` if an edit has it.

    Raises:
        ProgdfError: none has; the message lists the edits.
    """
    if name in {edit.name for edit in edits}:
        return name
    if not edits:
        raise ProgdfError(f"{option} {name}: no .gdf file was given; name one after the scene")
    names = f"{'is' if len(edits) == 1 else 'are'} {', '.join(edit.name for edit in edits)}"
    raise ProgdfError(f"{option} {name}: there is no edit of that name; there {names}")


def _parse_gain(text: str, gdfs: Sequence[Gdf], overshoot: bool) -> tuple[str, str, float]:
    """Return name, kind and number of `NAME:KIND=G`."""
    kinds = stacks.SLIDERS[1:]
    layer, equals, number = text.rpartition("=")
    name, colon, kind = layer.rpartition(":")
    if not equals or not colon or not name:
        example = gdfs[0].name if gdfs else "NAME"
        raise ProgdfError(f"--gain {text} is not a gain; write NAME:KIND=G, for example {example}:color=0.5")
    check_edit(name, gdfs, "--gain")
    if kind not in kinds:
        raise ProgdfError(f"--gain {text}: there is no gain '{kind}'; the gains are {', '.join(kinds)}")
    upper = stacks.largest_value(ViewState(overshoot=overshoot), kind)
    problem = f"--gain {text}: the gain '{number}' is not a number from 0 to {upper:g}"
    return name, kind, parse_number(number, 0.0, upper, problem)


def parse_number(text: str, low: float, high: float, problem: str) -> float:
    """Return a number from `low` to `high`; raise ProgdfError with `problem` for other text."""
    number = float(text) if is_number(text) else math.nan
    if not low <= number <= high:
        raise ProgdfError(problem)
    return number


def parse_background(text: str) -> Vec3:
    """Return the color of `#rrggbb`, "white" or "black", 0..1.

    Raises:
        ProgdfError: it is not a color.
    """
    red, green, blue = parse_color({"white": "#ffffff", "black": "#000000"}.get(text.lower(), text)).tolist()
    return red, green, blue
