"""The command `python -m benchmarks ablate RUN …`: the value of each part of the method on finished runs.

Every variant trains on the run's edited views and is evaluated on the same held-out views, also at strengths
that it was not trained on, with the requested number of seeds. RUN/ablation holds ablation.json, ablation.md
and ablation.png, and the .gdf of each variant to compare in the window.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.table import machine, put_tables
from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory
from progdf.gdf.file import Gdf, fingerprint, save_gdf
from progdf.io.atomic import atomic_write, make_folder
from progdf.io.images import read_picture, write_image
from progdf.io.json_values import decode_json, to_json
from trainer.fit.fit import drop_idle_attributes
from trainer.methods import METHODS
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.retime import smooth_course
from trainer.options import TrainOptions
from trainer.report.report import SHOWN, best_view, editor_strip, strip
from trainer.resolve import prepare_process, resolve_kind
from trainer.run.record import reopen_run
from trainer.run.training import optimize_members, retime_trajectory
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, lock_folder, write_json
from trainer.store.state import StateFolder, interrupt_on_signals
from trainer.views.boxes import Pictures

from .judge import fit_variant, with_figures
from .options import AblateOptions
from .plot import plot_ablations
from .setup import AblationSetup, digest_of, edit_at_equal_strengths, make_ablation_setup, run_plan
from .table import Ablation, Outcome, VariantRow, row_line, sheet_of, table_of
from .variants import EQUAL, Variant, choose_variants, differing_variants, is_seeded

_PICTURE_WIDTH = 176  # of one picture in the sheet, pixels


def ablate(options: AblateOptions, quiet: bool = False) -> list[Ablation]:
    """Train and evaluate the variants that are not done yet, and write the table and the picture of each run.

    `options` can request one table and one picture of all runs as well.

    Args:
        options: see `AblateOptions`
        quiet: print nothing

    Raises:
        ProgdfError: a folder is not a finished run, its scene or a view is missing, or a variant is unknown.
        KeyboardInterrupt: interrupted; the message names the folder of the finished variants.
    """
    check_options(options)
    prepare_process(options.threads)
    done = [_ablate_run(run, options, quiet) for run in options.runs]
    if options.markdown is not None:
        table = table_of(done, "The method part by part")
        filled = put_tables(options.markdown.read_text(encoding="utf-8"), [table])
        with atomic_write(options.markdown) as beside:
            beside.write_text(filled, encoding="utf-8")
    if options.plot is not None:
        write_image(options.plot, plot_ablations(done))
    return done


def check_options(options: AblateOptions) -> None:
    """Raise ProgdfError for invalid options, before any training."""
    if not options.runs:
        raise ProgdfError("ablate needs a run; give a folder that progdf train finished")
    if options.seeds < 1:
        raise ProgdfError(f"--seeds must be at least 1, got {options.seeds}")
    if options.scene is not None and len(options.runs) > 1:
        raise ProgdfError("--scene is of one run; give the runs one by one")
    if len({run.resolve() for run in options.runs}) < len(options.runs):
        raise ProgdfError("a run is given twice; name each once")
    if options.markdown is not None and not options.markdown.is_file():
        raise ProgdfError(f"{options.markdown} does not exist; check the name and the folder")
    if options.plot is not None and not options.plot.parent.is_dir():
        raise ProgdfError(f"the folder {options.plot.parent} does not exist; create it first")


def _ablate_run(root: Path, options: AblateOptions, quiet: bool) -> Ablation:
    """Train and evaluate the variants of one run."""
    run = reopen_run(root, options.scene)
    own = run_plan(run)
    kind = run.record.kind
    variants = differing_variants(own, kind, len(run.trajectory.strengths), run.scene.sh_degree)
    selected = [
        (variant, seed)
        for variant in choose_variants(variants, options.only)
        for seed in range(options.seeds if is_seeded(variant, own, kind) else 1)
    ]
    root = run.folder.root / "ablation"
    make_folder(root)
    with interrupt_on_signals(), lock_folder(RunFolder(root)):
        log = RunLog(root / "log.txt", quiet)
        try:
            shared = make_ablation_setup(run, own, kind, options.quick)
            for i, (variant, seed) in enumerate(selected):
                folder = _variant_folder(root, variant.name, seed)
                if _load_outcome(folder, variant, seed, shared) is not None:
                    log.say(f"{folder.name}: done before")
                    continue
                log.say(f"{folder.name} ({i + 1} of {len(selected)}): {variant.what}")
                try:
                    _run_variant(root, variant, seed, shared, quiet)
                except KeyboardInterrupt:
                    _publish(root, variants, shared)
                    raise KeyboardInterrupt(
                        f"{i} of {len(selected)} variants are finished and saved in {root}; "
                        "run the same command to continue"
                    ) from None
                outcome = _load_outcome(folder, variant, seed, shared)
                assert outcome is not None
                log.say(f"{folder.name}: {outcome.failed or row_line(VariantRow([outcome]))}")
            for state in root.glob("*/state"):
                StateFolder(state).end()
            return _publish(root, variants, shared)
        finally:
            log.close()


def _variant_folder(root: Path, name: str, seed: int) -> Path:
    """Return the folder of a variant with one seed."""
    return root / (f"{name}+{seed}" if seed else name)


def _run_variant(root: Path, variant: Variant, seed: int, shared: AblationSetup, quiet: bool) -> None:
    """Train and evaluate one variant, and save its outcome."""
    folder = _variant_folder(root, variant.name, seed)
    folder.mkdir(exist_ok=True)
    plan = variant.plan(shared.plan, seed)
    perceptual = perceptual_loss()[0]
    optimization = resolve_kind(plan, shared.kind, plan.optimize.group_steps or 0)
    with variant.patched():
        objective = METHODS[plan.preset].describe_loss(optimization, perceptual.name)
    outcome = Outcome(variant.name, variant.what, variant.of, objective=objective)
    state = _state(root, variant, seed, shared)
    log = RunLog(folder / "log.txt", quiet)
    try:
        with variant.patched():
            trajectory = _record(variant, plan, shared, perceptual, state, log)
            field, stage_values = fit_variant(variant, trajectory, shared, plan, perceptual, state, log)
    except ProgdfError as error:
        if not isinstance(error.__cause__, FloatingPointError):
            raise
        _save_outcome(folder, replace(outcome, failed=str(error.__cause__)), (), variant, seed, shared)
        return
    finally:
        log.close()
    outcome = replace(outcome, seconds=round(_processor_seconds(state), 2))
    outcome = with_figures(outcome, field, shared, stage_values, perceptual_loss()[0])
    region = shared.run.region
    scene = shared.run.scene
    recipe = to_json(replace(plan, name=variant.name))
    gdf = Gdf(variant.name, region, field, fingerprint(scene), plan.editor.editor, recipe)
    save_gdf(folder / f"{variant.name}.gdf", gdf)
    pictures = strip(shared.evaluator, field, shared.columns, _PICTURE_WIDTH)
    _save_outcome(folder, outcome, pictures, variant, seed, shared)


def _state(root: Path, variant: Variant, seed: int, shared: AblationSetup) -> StateFolder:
    """Return the state folder of the variant's optimization, which it may share with another variant."""
    folder = _variant_folder(root, variant.trains_as, seed)
    folder.mkdir(exist_ok=True)
    state = StateFolder(folder / "state")
    identity = {"digest": digest_of(shared, variant, seed, optimization=True)}
    if state.identity() != identity:
        state.begin(identity)
    return state


def _record(
    variant: Variant,
    plan: TrainOptions,
    shared: AblationSetup,
    perceptual: Perceptual,
    state: StateFolder,
    log: RunLog,
) -> Trajectory:
    """Optimize a variant and return its trajectory."""
    optimization = resolve_kind(plan, shared.kind, plan.optimize.group_steps or 0)
    method = METHODS[plan.preset]
    setup = method.box_views(shared.setup, shared.edited)
    with _count_processor_seconds(state), log.stage("optimize"):
        trajectory, *_ = optimize_members(
            plan,
            optimization,
            setup,
            _targets(variant, plan, shared),
            perceptual,
            state,
            log,
        )
    choosing, _ = shared.evaluators(trajectory.offsets)[0].halves()
    trajectory, _ = drop_idle_attributes(smooth_course(trajectory), choosing, method.cleans)
    return retime_trajectory(trajectory, setup, optimization.slider, method.cleans, log)


def _targets(variant: Variant, plan: TrainOptions, shared: AblationSetup) -> Pictures:
    """Return the edited views that a variant is trained on."""
    if plan.optimize.stages == 1:
        return {1.0: shared.edited[1.0]}
    return edit_at_equal_strengths(shared) if variant.name == EQUAL else shared.edited


@contextmanager
def _count_processor_seconds(state: StateFolder) -> Iterator[None]:
    """Save the block's processor time, summed over all calls, in the state.

    A block that finished in an earlier call keeps its time.
    """
    saved = state.load("processor")
    begun = time.process_time()
    done = False
    try:
        yield
        done = True
    finally:
        if saved is None or not saved.values["done"]:
            spent = _processor_seconds(state) + time.process_time() - begun
            state.save("processor", {}, {"seconds": spent, "done": done})


def _processor_seconds(state: StateFolder) -> float:
    """Return the processor seconds so far."""
    saved = state.load("processor")
    return float(saved.values["seconds"]) if saved is not None else 0.0


def _save_outcome(
    folder: Path,
    outcome: Outcome,
    pictures: Sequence[Tensor],
    variant: Variant,
    seed: int,
    shared: AblationSetup,
) -> None:
    """Write the outcome of a variant; outcome.json comes last, as it marks the variant as done."""
    if pictures:
        write_image(folder / "strip.png", torch.cat(list(pictures), dim=1))
    write_json(folder / "outcome.json", {"digest": digest_of(shared, variant, seed), **asdict(outcome)})


def _load_outcome(folder: Path, variant: Variant, seed: int, shared: AblationSetup) -> Outcome | None:
    """Return a variant's outcome of an earlier call; None if it is not done or has other inputs."""
    try:
        found = decode_json((folder / "outcome.json").read_bytes())
        if found.pop("digest") != digest_of(shared, variant, seed):
            return None
        return Outcome(**found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _load_row(root: Path, variant: Variant, shared: AblationSetup) -> VariantRow | None:
    """Return the finished seeds of a variant, starting with the run's own; None if that is not done."""
    outcomes: list[Outcome] = []
    while (
        found := _load_outcome(
            _variant_folder(root, variant.name, len(outcomes)), variant, len(outcomes), shared
        )
    ) is not None:
        outcomes.append(found)
    return VariantRow(outcomes) if outcomes else None


def _publish(root: Path, variants: Sequence[Variant], shared: AblationSetup) -> Ablation:
    """Write the table and the picture of all finished variants."""
    rows = [row for variant in variants if (row := _load_row(root, variant, shared)) is not None]
    plan = shared.plan
    setup = shared.setup
    evaluator = shared.evaluator
    size = setup.held_out[0].camera
    note = (
        f"{plan.editor.editor}, {plan.optimize.steps} steps in {len(shared.edited)} stages, "
        f"{len(setup.train)} views to train on and {len(setup.held_out)} "
        f"to measure with, {size.width}x{size.height} pixels, {len(shared.run.region)} members."
    )
    measure = perceptual_loss()[0].name
    title = f"{plan.name}: {plan.editor.editor}, part by part"
    done = Ablation(plan.name, title, note, rows, "LPIPS" if measure.startswith("lpips") else measure)
    strips = {
        row.first.name: read_picture(root / row.first.name / "strip.png").chunk(len(SHOWN), dim=1)
        for row in rows
        if not row.failed
    }
    editor = [
        (image * 255).round() / 255 for image in editor_strip(evaluator, shared.columns, _PICTURE_WIDTH)
    ]
    caption = f"held-out view {evaluator.names[best_view(evaluator)]}; PSNR to the editor's own pictures"
    write_image(root / "ablation.png", sheet_of(editor, rows, strips, shared.columns, title, caption))
    with atomic_write(root / "ablation.md") as beside:
        beside.write_text(table_of([done], title).markdown() + "\n", encoding="utf-8")
    outcomes: list[Mapping[str, Any]] = [asdict(outcome) for row in rows for outcome in row.outcomes]
    about = {"machine": machine(), "note": note, "perceptual": measure, "plan": to_json(plan)}
    write_json(root / "ablation.json", {**about, "variants": outcomes})
    return done
