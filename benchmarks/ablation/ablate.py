"""`python -m benchmarks ablate RUN …`: which part of the method is worth what, on one's own edits.

Every variant trains towards the run's own edited views and is judged by the same held-out ones, also at
strengths that it was not shown, with as many seeds as asked for. RUN/ablation holds ablation.json,
ablation.md and ablation.png, and of each variant its .gdf, so that one can feel the difference in the window.
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
from progdf.io.json_values import decode_json, plain
from trainer.fit.fit import drop_idle_attributes
from trainer.optimize.losses import Perceptual, describe_loss, perceptual_loss
from trainer.optimize.retime import smooth_course
from trainer.options import TrainOptions
from trainer.report.report import SHOWN, best_view, editor_strip, strip
from trainer.resolve import resolve_kind, use_threads
from trainer.run.record import reopen_run
from trainer.run.training import optimize_members, retime_trajectory
from trainer.setup import Pictures, whole_views
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, lock_folder, write_json
from trainer.store.state import StateFolder, interrupt_on_signals

from .judge import fit_variant, with_figures
from .options import AblateOptions
from .plot import plot_ablations
from .setup import AblationSetup, digest_of, edit_at_equal_strengths, make_ablation_setup, run_plan
from .table import Ablation, Outcome, VariantRow, row_line, sheet_of, table_of
from .variants import EQUAL, Variant, choose_variants, differing_variants, is_seeded

_WIDTH = 176  # of a picture in the sheet, pixels


def ablate(options: AblateOptions, quiet: bool = False) -> list[Ablation]:
    """Train and judge the variants that are not done yet, and write the table and the picture of each run.

    `options` may ask for one table and one picture of all runs as well.

    Args:
        options: see AblateOptions
        quiet: nothing on the screen

    Raises:
        ProgdfError: a folder is no finished run, its scene or a view is gone, a variant does not exist.
        KeyboardInterrupt: interrupted; the message says what is kept.
    """
    check_options(options)
    use_threads(options.threads)
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
    """Raises ProgdfError for what cannot be met, before an hour has been trained."""
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
    """The variants of one run."""
    run = reopen_run(root, options.scene)
    own = run_plan(run)
    kind = run.record.kind
    variants = differing_variants(own, kind, len(run.trajectory.strengths), run.scene.sh_degree)
    wanted = [
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
            for i, (variant, seed) in enumerate(wanted):
                home = _home(root, variant.name, seed)
                if _load_outcome(home, variant, seed, shared) is not None:
                    log.say(f"{home.name}: done before")
                    continue
                log.say(f"{home.name} ({i + 1} of {len(wanted)}): {variant.what}")
                try:
                    _run_variant(root, variant, seed, shared, quiet)
                except KeyboardInterrupt:
                    _publish(root, variants, shared)
                    raise KeyboardInterrupt(
                        f"{i} of {len(wanted)} variants are done and kept in {root}; "
                        "give the same command to go on"
                    ) from None
                outcome = _load_outcome(home, variant, seed, shared)
                assert outcome is not None
                log.say(f"{home.name}: {outcome.failed or row_line(VariantRow([outcome]))}")
            for state in root.glob("*/state"):
                StateFolder(state).end()
            return _publish(root, variants, shared)
        finally:
            log.close()


def _home(root: Path, name: str, seed: int) -> Path:
    """The folder of a variant with one seed."""
    return root / (f"{name}+{seed}" if seed else name)


def _run_variant(root: Path, variant: Variant, seed: int, shared: AblationSetup, quiet: bool) -> None:
    """Train and judge one variant, and keep what became of it."""
    folder = _home(root, variant.name, seed)
    folder.mkdir(exist_ok=True)
    plan = variant.plan(shared.plan, seed)
    perceptual = perceptual_loss()[0]
    optimization = resolve_kind(plan, shared.kind, plan.optimize.group_steps or 0)
    objective = describe_loss(optimization, perceptual.name)
    outcome = Outcome(variant.name, variant.what, variant.of, objective=objective)
    state = _state(root, variant, seed, shared)
    log = RunLog(folder / "log.txt", quiet)
    try:
        with variant.patched():
            trajectory = _record(variant, plan, shared, perceptual, state, log)
            field, asked = fit_variant(variant, trajectory, shared, plan, perceptual, state, log)
    except ProgdfError as error:
        if not isinstance(error.__cause__, FloatingPointError):
            raise
        _save_outcome(folder, replace(outcome, failed=str(error.__cause__)), (), variant, seed, shared)
        return
    finally:
        log.close()
    outcome = replace(outcome, seconds=round(_processor_seconds(state), 2))
    outcome = with_figures(outcome, field, shared, asked, perceptual_loss()[0])
    region = shared.run.region
    scene = shared.run.scene
    told = plain(replace(plan, name=variant.name))
    gdf = Gdf(variant.name, region, field, fingerprint(scene), plan.editor.editor, told)
    save_gdf(folder / f"{variant.name}.gdf", gdf)
    pictures = strip(shared.evaluator, field, shared.columns, _WIDTH)
    _save_outcome(folder, outcome, pictures, variant, seed, shared)


def _state(root: Path, variant: Variant, seed: int, shared: AblationSetup) -> StateFolder:
    """Where the variant's optimization goes on where it was stopped, or another's that it shares stands."""
    home = _home(root, variant.trains_as, seed)
    home.mkdir(exist_ok=True)
    state = StateFolder(home / "state")
    begun = {"digest": digest_of(shared, variant, seed, optimization=True)}
    if state.identity() != begun:
        state.begin(begun)
    return state


def _record(
    variant: Variant,
    plan: TrainOptions,
    shared: AblationSetup,
    perceptual: Perceptual,
    state: StateFolder,
    log: RunLog,
) -> Trajectory:
    """The variant's trajectory."""
    optimization = resolve_kind(plan, shared.kind, plan.optimize.group_steps or 0)
    setup = whole_views(shared.setup) if optimization.as_printed else shared.setup
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
    trajectory, _ = drop_idle_attributes(smooth_course(trajectory), choosing, not optimization.as_printed)
    return retime_trajectory(trajectory, setup, optimization, log)


def _targets(variant: Variant, plan: TrainOptions, shared: AblationSetup) -> Pictures:
    """The edited views that a variant is trained on."""
    if plan.optimize.stages == 1:
        return {1.0: shared.edited[1.0]}
    return edit_at_equal_strengths(shared) if variant.name == EQUAL else shared.edited


@contextmanager
def _count_processor_seconds(state: StateFolder) -> Iterator[None]:
    """Keep beside a state what processor time it took, all sessions together; a look at what is done takes
    none."""
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
    """Seconds so far."""
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
    """Write what became of a variant; the figures last, as they tell that it is done."""
    if pictures:
        write_image(folder / "strip.png", torch.cat(list(pictures), dim=1))
    write_json(folder / "outcome.json", {"digest": digest_of(shared, variant, seed), **asdict(outcome)})


def _load_outcome(folder: Path, variant: Variant, seed: int, shared: AblationSetup) -> Outcome | None:
    """What became of a variant in an earlier call; None where it was not done, or on other ground."""
    try:
        found = decode_json((folder / "outcome.json").read_bytes())
        if found.pop("digest") != digest_of(shared, variant, seed):
            return None
        return Outcome(**found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _load_row(root: Path, variant: Variant, shared: AblationSetup) -> VariantRow | None:
    """The seeds of a variant that are done, from the run's own on; None where that is not."""
    outcomes: list[Outcome] = []
    while (
        found := _load_outcome(_home(root, variant.name, len(outcomes)), variant, len(outcomes), shared)
    ) is not None:
        outcomes.append(found)
    return VariantRow(outcomes) if outcomes else None


def _publish(root: Path, variants: Sequence[Variant], shared: AblationSetup) -> Ablation:
    """Table and picture of all that is done."""
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
    editor = [(image * 255).round() / 255 for image in editor_strip(evaluator, shared.columns, _WIDTH)]
    caption = f"held-out view {evaluator.names[best_view(evaluator)]}; PSNR to the editor's own pictures"
    write_image(root / "ablation.png", sheet_of(editor, rows, strips, shared.columns, title, caption))
    with atomic_write(root / "ablation.md") as beside:
        beside.write_text(table_of([done], title).markdown() + "\n", encoding="utf-8")
    outcomes: list[Mapping[str, Any]] = [asdict(outcome) for row in rows for outcome in row.outcomes]
    about = {"machine": machine(), "note": note, "perceptual": measure, "plan": plain(plan)}
    write_json(root / "ablation.json", {**about, "variants": outcomes})
    return done
