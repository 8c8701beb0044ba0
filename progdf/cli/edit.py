"""The command `progdf edit SCENE … -o OUT`: change regions by hand, in a new scene or as an edit."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tyro.conf import UseAppendAction

from progdf.errors import ProgdfError
from progdf.formats.axes import GlbAxes
from progdf.formats.scene_file import load_scene, save_scene, scene_name, written_format
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.atomic import check_not_an_input
from progdf.io.json_values import check_text
from progdf.metrics.image import NO_DIFFERENCE
from progdf.pull.course import Handle, pull
from progdf.pull.cuts import Cuts
from progdf.pull.grips import with_grips
from progdf.region import union
from progdf.scene.regions import check_region, parse_region, read_numbers
from progdf.scene.strays import clean, find_strays, picture_difference
from progdf.similarity import AffineMotion, affine_motion
from progdf.terminal import format_count, group_digits, print_line, shorten
from progdf.tidy import Operation, Step, bake, mirror, similarity, tidy

from .options import absent_option, parse_options

Specs = Annotated[tuple[str, ...], UseAppendAction]

_PULL_FORM = "X,Y,Z,DX,DY,DZ[,FALLOFF][,turn=AXIS,DEGREES][,scale=FACTOR]"
MAX_DEGREES = 360.0
MAX_SCALE = 1000.0


@dataclass(frozen=True)
class EditOptions:
    """Remove, move, pull, rotate, scale or copy parts of a scene, as a new scene or as an edit with a slider.

    The scene file itself is never changed. REGION is written as for progdf train, except for forms that need
    pictures. The numbers of an option follow the last colon. All regions refer to the scene in the file.
    Overlapping regions are pulled, then mirrored, scaled, rotated and moved. Cleaning comes last.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Scene file: .ply, .spz, .splat, .ksplat, .sog, .glb or .gltf."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.ply|NAME.gdf")]
    """Scene file to write; or a .gdf whose slider goes from the scene (0) to the full change (1)."""
    clean: Annotated[bool, tyro.conf.FlagCreatePairsOff, absent_option(None)] = False
    """Remove floaters, needles, giants and invisible Gaussians; for a scene output only."""
    delete: Annotated[Specs, absent_option("REGION")] = ()
    """Remove the Gaussians of the region; holes, shadows and reflections stay."""
    mirror: Annotated[Specs, absent_option("REGION:AXIS")] = ()
    """Mirror the region about the mean of its centers; AXIS: x, y or z."""
    scale: Annotated[Specs, absent_option("REGION:FACTOR|FX,FY,FZ")] = ()
    """Scale the region about the mean of its centers, per axis with three factors; 0.001 to 1000."""
    rotate: Annotated[Specs, absent_option("REGION:AXIS,DEGREES")] = ()
    """Rotate the region about the mean of its centers; AXIS: x, y, z or a vector; −360 to 360 degrees."""
    move: Annotated[Specs, absent_option("REGION:DX,DY,DZ")] = ()
    """Move the region by an offset in world units."""
    pull: Annotated[Specs, absent_option(f"REGION:{_PULL_FORM}")] = ()
    """Pull, turn or scale the region at a point; the rest follows, within a radius FALLOFF or all of it."""
    hold: Annotated[Specs, absent_option("REGION")] = ()
    """Hold the region in place while others are pulled."""
    cut: Annotated[Specs, absent_option("REGION")] = ()
    """Cut the region off from all that it touches, so that a pull moves only one of them."""
    duplicate: Annotated[Specs, absent_option("REGION:DX,DY,DZ")] = ()
    """Add a copy of the region, moved by an offset in world units."""
    glb_axes: GlbAxes = "LUF"
    """Axes of a .glb: LUF (glTF's own) or RUB (OpenGL's, as in .spz and .usdc)."""


def main(argv: Sequence[str]) -> int:
    """Apply the requested steps and write the result.

    Raises:
        ProgdfError: no step is requested, the options are invalid, or no visible Gaussian would remain.
    """
    options = parse_options(EditOptions, argv, "progdf edit")
    makes_edit = options.out.suffix.lower() == ".gdf"
    pulls = _read_pulls(options)
    step_makers = _read_steps(options)
    if pulls is not None:
        step_makers = [pulls, *step_makers]
    if not options.clean and not step_makers:
        raise ProgdfError(
            "no change is requested; add at least one option, for example --clean or --delete REGION"
        )
    if not makes_edit:
        written_format(options.out)
    if options.out.suffix.lower() != ".glb" and options.glb_axes != "LUF":
        raise ProgdfError(f"{options.out} is not a .glb; leave out --glb-axes")
    if makes_edit and options.clean:
        raise ProgdfError("--clean has no slider; write a .ply, or leave --clean out")
    check_not_an_input(options.out, [options.scene])
    if makes_edit:
        check_text(f"{options.out.stem} {_instruction(options)}", "an edit")
    scene = load_scene(options.scene)
    steps = [make(scene) for make in step_makers]
    if makes_edit:
        return _write_edit(options, scene, steps)
    edited = bake(scene, steps)
    if steps:
        print_line("; ".join(_describe(step) for step in steps))
    edited = _clean(edited) if options.clean and len(edited) else edited
    if not len(edited):
        raise ProgdfError(f"no visible Gaussian of {options.scene} would remain; choose another region")
    read_back = save_scene(options.out, edited, options.glb_axes)
    notes = () if read_back is None else read_back.notes
    print_line("; ".join([f"wrote {options.out}: {format_count(len(edited))}", *notes]))
    if len(edited) < len(scene):
        old = shlex.quote(str(options.scene))
        new = shlex.quote(str(options.out))
        print_line(
            f"rows have new numbers: labels and edits of {scene_name(options.scene)} no longer fit; "
            f"carry an edit over with progdf rebind EDIT.gdf --from {old} --to {new} -o NEW.gdf"
        )
    return 0


def _write_edit(options: EditOptions, scene: Gaussians, steps: Sequence[Step]) -> int:
    gdf = tidy(scene, steps, options.out.stem, _instruction(options), cameras=())
    save_gdf(options.out, gdf)
    print_line("; ".join(_describe(step) for step in steps))
    print_line(
        f"wrote {options.out}: an edit with a slider; see it with progdf view {options.scene} {options.out}"
    )
    return 0


def _instruction(options: EditOptions) -> str:
    """Return the step options as typed, which the edit stores as its instruction."""
    parts = ["edit"]
    for name in ("delete", "pull", "hold", "cut", "mirror", "scale", "rotate", "move", "duplicate"):
        parts += [f"--{name} {spec}" for spec in getattr(options, name)]
    return " ".join(parts)


def _describe(step: Step) -> str:
    """Return a description of a step for the user: region, number of Gaussians and action."""
    actions = {"remove": "removed", "transform": "transformed", "duplicate": "copied", "pull": "pulled"}
    text = f"{shorten(step.region.name)}: {format_count(len(step.region))} {actions[step.does]}"
    return text if step.course is None else f"{text} ({step.course.describe()})"


def _read_steps(options: EditOptions) -> list[Callable[[Gaussians], Step]]:
    """Return functions that create the steps for a scene, in the order of execution.

    Raises:
        ProgdfError: the numbers of an option are invalid, or a region is invalid for any scene.
    """
    forms: tuple[tuple[str, str, Callable[[str], AffineMotion | None]], ...] = (
        ("mirror", "X, REGION:Y or REGION:Z", _parse_mirror),
        ("scale", f"FACTOR or REGION:FX,FY,FZ, {1 / MAX_SCALE:g} to {MAX_SCALE:g}", _parse_scale),
        ("rotate", "AXIS,DEGREES", _parse_rotation),
        ("move", "DX,DY,DZ", _parse_shift),
        ("duplicate", "DX,DY,DZ", _parse_shift),
    )
    step_makers = []
    for name, form, read in forms:
        for text in getattr(options, name):
            spec, _, numbers = text.rpartition(":")
            motion = read(numbers)
            if motion is None or not spec:
                ending = "axis" if name == "mirror" else "numbers"
                raise ProgdfError(
                    f"'{shorten(text)}' has no usable {ending} at its end; write --{name} REGION:{form}"
                )
            step_makers.append(_maker("duplicate" if name == "duplicate" else "transform", spec, motion))
    step_makers += [_maker("remove", spec, None) for spec in options.delete]
    return step_makers


@dataclass(frozen=True)
class _PullNumbers:
    """Numbers of a pull as written."""

    point: Sequence[float]  # world units. [3]
    shift: tuple[float, float, float]  # world units
    falloff: float | None
    turn: tuple[float, float, float] | None  # axis times angle in radians
    scale: float


def _read_pulls(options: EditOptions) -> Callable[[Gaussians], Step] | None:
    """Return a function that creates the one step of all pulls; None without pulls.

    Raises:
        ProgdfError: as for `_read_steps`.
    """
    parsed = []
    for text in options.pull:
        spec, _, typed = text.rpartition(":")
        if not spec:
            raise ProgdfError(f"'{shorten(text)}' names no region; write --pull REGION:{_PULL_FORM}")
        try:
            parsed.append((spec, _parse_pull(typed)))
        except ValueError as error:
            raise ProgdfError(f"'{shorten(text)}': {error}; write --pull REGION:{_PULL_FORM}") from None
    for spec in [*(spec for spec, _ in parsed), *options.hold, *options.cut]:
        check_region(spec)
    if parsed:
        return partial(_pull_step, parsed, options.hold, options.cut)
    if options.hold:
        raise ProgdfError("--hold has nothing to hold against; add --pull REGION:X,Y,Z,DX,DY,DZ")
    if options.cut:
        raise ProgdfError("--cut takes effect in pulls only; add --pull REGION:X,Y,Z,DX,DY,DZ")
    return None


def _parse_pull(text: str) -> _PullNumbers:
    """Return the numbers of a pull.

    Raises:
        ValueError: a number is missing or out of range, or an option is unknown; the message names it.
    """
    plain, *named = re.split(r",(?=[a-z]+=)", text.strip().lower())
    options = dict[str, str]()
    for part in named:
        name, _, value = part.partition("=")
        if name not in ("turn", "scale"):
            raise ValueError(f"{name} is not an option of a pull")
        if name in options:
            raise ValueError(f"{name} is given twice")
        options[name] = value
    numbers = read_numbers(plain)
    if len(numbers) not in (6, 7):
        raise ValueError("6 or 7 finite numbers must follow the region")
    falloff = numbers[6] if len(numbers) == 7 else None
    if falloff is not None and falloff <= 0.0:
        raise ValueError(f"the radius FALLOFF must be above 0, got {falloff:g}")
    turn: tuple[float, float, float] | None = None
    if "turn" in options:
        rotation = _parse_rotation(options["turn"])
        if rotation is None:
            raise ValueError(
                f"turn needs an axis (x, y, z or three numbers) and at most {MAX_DEGREES:g} degrees, "
                f"got {options['turn']}"
            )
        x, y, z = rotation.turn.tolist()
        turn = (x, y, z)
    factors = read_numbers(options.get("scale", "1"))
    if len(factors) != 1 or factors[0] <= 0.0:
        raise ValueError(f"scale must be one number above 0, got {options['scale']}")
    return _PullNumbers(numbers[:3], (numbers[3], numbers[4], numbers[5]), falloff, turn, factors[0])


def _pull_step(
    parsed: Sequence[tuple[str, _PullNumbers]], holds: Sequence[str], cuts: Sequence[str], scene: Gaussians
) -> Step:
    """Return the one step of all pulls.

    Raises:
        ProgdfError: a region is invalid, or the pull is refused.
    """
    handles = []
    for spec, numbers in parsed:
        x, y, z = (value - origin for value, origin in zip(numbers.point, scene.origin, strict=True))
        region = parse_region(spec, scene, say=print_line)
        handles.append(Handle(region, (x, y, z), numbers.shift, numbers.falloff, numbers.turn, numbers.scale))
    held = [parse_region(spec, scene, say=print_line) for spec in holds]
    hold = reduce(union, held) if held else None
    separated = [parse_region(spec, scene, say=print_line).mask.numpy() for spec in cuts]
    between = Cuts(tuple(separated))
    course = pull(scene, with_grips(scene, handles, hold, between)[0], hold, cuts=between)
    if cuts and not course.cut_count:
        print_line(f"note: --cut {shorten(cuts[0])} has no effect: it touches nothing that could be pulled")

    return Step("pull", course.region, course=course)


def _maker(does: Operation, spec: str, motion: AffineMotion | None) -> Callable[[Gaussians], Step]:
    check_region(spec)
    return lambda scene: Step(does, parse_region(spec, scene, say=print_line), motion)


def _parse_shift(text: str) -> AffineMotion | None:
    numbers = read_numbers(text)
    return similarity(shift=numbers) if len(numbers) == 3 else None


def _parse_mirror(text: str) -> AffineMotion | None:
    axis = text.strip().lower()
    return mirror("xyz".index(axis)) if axis in ("x", "y", "z") else None


def _parse_scale(text: str) -> AffineMotion | None:
    factors = read_numbers(text)
    if len(factors) not in (1, 3) or not all(1 / MAX_SCALE <= factor <= MAX_SCALE for factor in factors):
        return None
    if len(factors) == 1:
        return similarity(scale=factors[0])
    still = torch.zeros(3, dtype=torch.float64)
    return affine_motion(torch.diag(torch.tensor(factors, dtype=torch.float64)), still)


def _parse_rotation(text: str) -> AffineMotion | None:
    axis, _, degrees = text.rpartition(",")
    axes = {"x": "1,0,0", "y": "0,1,0", "z": "0,0,1"}
    direction = read_numbers(axes.get(axis.strip().lower(), axis))
    angle = read_numbers(degrees)
    if len(direction) != 3 or not any(direction) or len(angle) != 1 or abs(angle[0]) > MAX_DEGREES:
        return None
    unit = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    return similarity(turn=(math.radians(angle[0]) * unit).tolist())


def _clean(scene: Gaussians) -> Gaussians:
    """Remove strays from a scene; print their kinds and the difference in rendered pictures."""
    strays = find_strays(scene)
    if not len(strays.rows):
        print_line("clean: there are no strays")
        return scene
    edited = clean(scene, strays)
    print_line(
        f"clean: {group_digits(len(strays.rows))} of {format_count(len(scene))} removed: {strays.describe()}"
    )
    mean, worst = picture_difference(scene, edited) if len(edited) else (0.0, 0.0)
    if worst >= NO_DIFFERENCE:
        print_line("rendered views: no pixel differs")
    else:
        print_line(
            f"rendered views: {mean:.1f} dB to the original on average, {worst:.1f} dB in the worst one"
        )
    return edited
