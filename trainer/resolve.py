"""Checks of options, and values for open ones: once before the run, and again once the kind of edit is known.

Values that depend on the scene (up axis, number and size of the views, SH bands) are chosen where the scene
is available. Resolved options determine a result bit for bit, except for the content of files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch

from progdf.errors import ProgdfError
from progdf.io.atomic import is_portable
from progdf.metrics.image import NO_DIFFERENCE
from progdf.rasterize import set_threads
from progdf.rasterize.engines import choose_engine, engine_device
from progdf.system.processes import usable_cores
from trainer.editors import EDITORS, editor_row
from trainer.editors.instruct import parse_guidance
from trainer.editors.pictures import strengths_of
from trainer.options import EditKind
from trainer.store.memory import reuse_memory

from .options import (
    LARGEST_SEED,
    LARGEST_VIEW_PX,
    MAX_STAGES,
    MAX_THREADS,
    PRESETS,
    VIEWS,
    EditorOptions,
    Engine,
    FieldOptions,
    OptimizeOptions,
    Preset,
    RegionOptions,
    TrainOptions,
    check_ranges,
)

BLANK = TrainOptions(Path(), Path(), RegionOptions(""), EditorOptions(""))
"""Options of an empty command line."""

PERCEPTUAL_WEIGHT: Mapping[EditKind, float] = {"color": 0.1, "style": 0.3, "geometry": 0.3}
"""Default of --perceptual-weight by kind of edit."""
STAGES: Mapping[EditKind, int] = {"color": MAX_STAGES, "style": 1, "geometry": MAX_STAGES}
"""Default of --stages by kind of edit."""
COSTLY_STAGES: Mapping[EditKind, int] = {"color": 4, "style": 4, "geometry": 1}
"""The same for editors that run a model for every strength.

Their intermediate pictures of moving parts show the parts twice, so geometry has one stage.
"""

STAGE_STEPS = 40
"""Minimum number of steps per stage.

With fewer, each view is used once or twice, and the next target starts before the current one is reached.
Then at most `QUICK_STAGES` stages are used (docs/lab/experiments.md, Stages).
"""

# maximum numbers with --quick
QUICK_STEPS = 240
QUICK_STAGES = 4
QUICK_VIEWS = 12
_MAX_STEPS = 1_000_000  # takes hours on any machine
_MAX_NAME_BYTES = 255  # accepted by every file system
_MIN_VIEW_PX = 32  # longer side of a view


def resolve(options: TrainOptions) -> TrainOptions:
    """Return the options, checked and with dependent values filled in.

    Raises:
        ProgdfError: an option is invalid.
    """
    check_options(options)
    quick = options.quick
    optimize = options.optimize
    row = editor_row(options.editor)
    views = options.views.views or row.views
    text = options.editor.text
    stages = min(optimize.stages, QUICK_STAGES) if quick else optimize.stages
    texts = options.texts
    model = options.editor.model
    if not model and row.model is not None:
        model = row.model()
    pictures = row.files(text) if row.sets_views else ()
    # if only the full edit is given, the trainer chooses the path to it
    has_free_path = not row.external or (pictures and all(len(strengths_of(path)) == 1 for path in pictures))
    return replace(
        options,
        name=check_name(options.name or options.out.resolve().name),
        editor=replace(options.editor, seed=options.seed, model=model),
        views=replace(
            options.views,
            cameras=options.views.cameras or row.cameras(text),
            views=min(views or QUICK_VIEWS, QUICK_VIEWS) if quick else views,
            fills=row.run == "trained" and row.knows_kind and not row.external,
            dense=not quick and not row.per_view and options.optimize.color_solver,
            image_size=options.views.image_size or row.image_size,
            pictures=pictures,
            scene=options.scene,
        ),
        optimize=replace(
            optimize,
            steps=min(optimize.steps, QUICK_STEPS) if quick else optimize.steps,
            stages=stages,
            engine=cast(Engine, choose_engine(optimize.engine)),
            # no GPU has solved for colors yet, so auto leaves them on the CPU
            colors_on_gpu=optimize.engine == "warp",
            slider="even" if optimize.slider == "auto" and has_free_path else optimize.slider,
            seed=options.seed,
        ),
        field=replace(options.field, draft=quick, seed=options.seed),
        texts=replace(texts, asked=bool(texts.text_before or texts.text_after)),
    )


def recorded_options(options: TrainOptions) -> TrainOptions:
    """Return resolved options without the output folder and the settings that do not affect the result."""
    usual = EditorOptions("")
    editor = replace(
        options.editor,
        edit_workers=usual.edit_workers,
        edit_timeout=usual.edit_timeout,
        price_per_call=usual.price_per_call,
        yes=usual.yes,
    )
    return replace(options, out=Path(), editor=editor, quick=False, threads=0, report="full", resume=False)


def resolve_kind(
    options: TrainOptions, kind: EditKind, group_steps: int, grow: float = 0.0
) -> OptimizeOptions:
    """Return the optimization options for an edit of this kind, fully resolved.

    The effect of each default alone is in docs/lab/experiments.md, Terms and options of a descent.

    Args:
        options: resolved, see `resolve`
        kind: attributes that move
        group_steps: requested or found by a trial run; without effect if nothing moves
        grow: maximum number of added rows, as a share of the members; found by a trial run
    """
    optimize = options.optimize
    # without a GPU, warp is for tests of the steps only
    uses_gpu = optimize.colors_on_gpu and engine_device(optimize.engine).type != "cpu"
    # only colors change, and no option needs a descent view by view
    solves_colors = kind == "color" and optimize.color_solver and not optimize.perceptual_weight
    weight = optimize.perceptual_weight
    stages = optimize.stages
    if not stages:
        stages_by_kind = COSTLY_STAGES if editor_row(options.editor).slow_strengths else STAGES
        stages = stages_by_kind[kind]
        if optimize.steps < STAGE_STEPS * stages:
            stages = min(stages, QUICK_STAGES)
    return replace(
        optimize,
        kind=kind,
        stages=stages,
        group_steps=group_steps if kind == "geometry" else 0,
        grow=grow,
        # only a color edit may leave the SH bands unchanged
        sh="on" if optimize.sh == "auto" and kind != "color" else optimize.sh,
        perceptual_weight=PERCEPTUAL_WEIGHT[kind] if weight is None else weight,
        solver="colors" if solves_colors else "descent",
        engine="cpu" if solves_colors and not uses_gpu else optimize.engine,
    )


def check_options(options: TrainOptions) -> None:
    """Reject invalid options, and options that would have no effect.

    Raises:
        ProgdfError: a value out of range, or an option that does not apply to the editor or the field.
    """
    region = options.region
    editor = options.editor
    optimize = options.optimize
    check_ranges(
        ("--views", options.views.views or VIEWS, 3, 96),
        ("--image-size", options.views.image_size or _MIN_VIEW_PX, _MIN_VIEW_PX, LARGEST_VIEW_PX),
        ("--stages", optimize.stages, 0, 16),
        ("--group-steps", optimize.group_steps, 0, 10_000),
        ("--grow", optimize.grow, 0, 1),
        ("--seed", options.seed, 0, LARGEST_SEED),
        ("--threads", options.threads, 0, MAX_THREADS),
        ("--edit-steps", editor.edit_steps, 1, 1000),
        ("--edit-size", editor.edit_size, 32, 4096),
        ("--api-references", editor.api_references, 0, 2),
        ("--price-per-call", editor.price_per_call, 0, 1e6),
        ("--edit-workers", editor.edit_workers, 1, 64),
        ("--edit-timeout", editor.edit_timeout, 1, 86_400),
        ("--lift-threshold", region.lift_threshold, 0, 1),
        ("--box-threshold", region.box_threshold, 0, 1),
    )
    stages = optimize.stages or MAX_STAGES
    if not 4 * stages <= optimize.steps <= _MAX_STEPS:
        least = 4 * stages
        most = _MAX_STEPS
        raise ProgdfError(
            f"--steps must be between {least} and {most} for {stages} stages, got {optimize.steps}"
        )
    weight = optimize.perceptual_weight
    if weight is not None and not 0 <= weight < math.inf:
        raise ProgdfError(f"--perceptual-weight must be 0 or more, got {weight}")
    _check_editor_options(editor, optimize)
    if optimize.grow and (optimize.kind == "color" or options.field.field == "neural"):
        raise ProgdfError("--grow adds nothing to an edit of colors alone, nor to a network; leave it out")
    check_field_options(options.field, options.preset)
    parse_guidance(editor.guidance)


def check_name(name: str) -> str:
    """Return the name of a layer and its file, if valid.

    Raises:
        ProgdfError: the name is invalid.
    """
    is_printable_name = (
        bool(name) and name.isprintable() and not (name.startswith(".") or {"/", "\\"} & set(name))
    )
    if not is_printable_name or not is_portable(name):
        reason = ", as Windows cannot have a file of that name" if is_printable_name else ""
        raise ProgdfError(
            f"'{name}' is not a valid layer name{reason}; choose one with --name, for example --name shirt"
        )
    if len(f"{name}.gdf".encode()) > _MAX_NAME_BYTES:
        raise ProgdfError(f"the name '{name[:20]}…' is too long for a file; choose another one with --name")
    return name


def _check_editor_options(editor: EditorOptions, optimize: OptimizeOptions) -> None:
    """Reject options that do not apply to the editor."""
    row = editor_row(editor)
    if row.sets_views and optimize.kind not in ("auto", "color"):
        raise ProgdfError(
            f"--kind {optimize.kind} does not apply to pictures: few views do not show the depth of a part; "
            "give more as folder:DIR, with their cameras in --cameras"
        )
    if row.run == "removed" and not editor.text and editor.fill == "picture":
        raise ProgdfError("--fill picture needs a picture of the background; write --editor remove:A.png")
    if optimize.grow and not row.per_view:
        kinds = [kind for kind, other in EDITORS.items() if other.per_view]
        raise ProgdfError(f"--grow does not apply to {editor.family}; it is for {' and '.join(kinds)}")
    for name in dict.fromkeys(name for other in EDITORS.values() for name in other.options):
        if getattr(editor, name) != getattr(EditorOptions, name) and name not in row.options:
            kinds = [kind for kind, other in EDITORS.items() if name in other.options]
            option = "--" + name.replace("_", "-")
            raise ProgdfError(f"{option} does not apply to {editor.family}; it is for {' and '.join(kinds)}")
    if editor.removal == "never" and editor.fill is not None:
        raise ProgdfError("--fill closes holes of a removal; leave out --removal never, or --fill")


def check_field_options(options: FieldOptions, preset: Preset = "default") -> None:
    """Check the options of the field. Options of a network need a network, unless a preset sets them.

    Raises:
        ProgdfError: an option is invalid.
    """
    if options.target_psnr is not None and not 0 < options.target_psnr <= NO_DIFFERENCE:
        raise ProgdfError(
            f"--target-psnr must be above 0 and at most {NO_DIFFERENCE:g} dB, which stands for no "
            f"difference, got {options.target_psnr:g}"
        )
    by_preset = PRESETS[preset].get("field", {})
    for name in ("size", "field_loss"):
        defaults = (getattr(FieldOptions, name), by_preset.get(name))
        if options.field != "neural" and getattr(options, name) not in defaults:
            option = "--" + name.replace("_", "-")
            raise ProgdfError(f"{option} does not apply to --field {options.field}; add --field neural")


def prepare_process(threads: int) -> None:
    """Set the number of threads of torch and the rasterizer, 0 for all cores; and see `reuse_memory`."""
    reuse_memory()
    count = count_threads(threads)
    torch.set_num_threads(count)
    set_threads(count)


def count_threads(threads: int) -> int:
    """Return the number of threads; 0 becomes the number of cores.

    Raises:
        ProgdfError: negative, or more than any machine has.
    """
    if not 0 <= threads <= MAX_THREADS:
        raise ProgdfError(f"--threads must be between 0 and {MAX_THREADS}, got {threads}")
    return threads or usable_cores()
