"""Tests of `python -m benchmarks ablate`: applicable variants, shared work and reuse of finished rows."""

from __future__ import annotations

import json
import pkgutil
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

import benchmarks.ablation.ablate
from benchmarks.__main__ import ablate as ablate_command
from benchmarks.ablation.ablate import ablate
from benchmarks.ablation.options import AblateOptions
from benchmarks.ablation.setup import run_plan
from benchmarks.ablation.table import Ablation, Outcome, VariantRow, table_of
from benchmarks.ablation.variants import (
    _BY_NAME,
    VARIANTS,
    Variant,
    choose_variants,
    differing_variants,
    is_seeded,
    plan_values,
)
from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory
from progdf.formats.ply import load_ply
from progdf.gdf.file import load_gdf
from tests.helpers.blank_plots import blank_plots
from tests.helpers.trained import quick_options, train, write_bear
from trainer.options import OptimizeOptions, TrainOptions, apply_preset, with_values
from trainer.resolve import recorded_options, resolve
from trainer.run.record import reopen_run
from trainer.store.run_folder import RunFolder

ONLY = "base,2-keyframes,one-target,slider-time"


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> TrainOptions:
    """Return the options of a small bear run that is trained in a second or two."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder)
    options = quick_options(folder, steps=100, views=4, image_size=48)
    with blank_plots():
        train(options, quiet=True)
    return options


@pytest.fixture(scope="module")
def run(options: TrainOptions) -> Path:
    """Return the run's folder with an ablation of four variants in it."""
    ablate(AblateOptions((options.out,), only=ONLY, threads=1), quiet=True)
    return options.out


def _nothing_trains(*_: object, **__: object) -> tuple[Trajectory, object]:
    raise AssertionError("it trains again")


def _names(options: TrainOptions, *about: object) -> set[str]:
    return {variant.name for variant in differing_variants(resolve(options), *about)}  # type: ignore[arg-type]


@pytest.mark.slow
def test_ablation_lists_only_variants_that_change_the_run(options: TrainOptions) -> None:
    color = _names(options, "color", 4, 1)
    assert {"base", "2-keyframes", "one-target", "no-sh", "slider-stages", "descent", "paper"} <= color
    assert not {"slider-even", "no-groups"} & color
    descended = _names(with_values(options, perceptual_weight=0.1), "color", 4, 1)
    assert "no-lpips" in descended
    assert not {"descent", "descent-one-target", "descent-plain-clamps"} & descended, "it descends anyway"
    style = _names(options, "style", 4, 1)
    assert "sharpness-paper" in style
    geometry = _names(options, "geometry", 4, 1)
    assert "no-groups" in geometry
    assert not {"no-sizing", "no-interpolation"} & geometry
    assert not {"one-target", "slider-stages"} & _names(options, "color", 1, 1)
    assert "no-sh" not in _names(options, "color", 4, 0)
    without = with_values(options, perceptual_weight=0.0)
    assert "no-lpips" not in _names(without, "style", 4, 1)
    printed = _names(apply_preset(options, "paper"), "color", 4, 1)
    assert "paper-growth" in printed
    assert not {"descent", "rates-3dgs", "progressive-decay"} & printed, "parts of our descent"
    pinned = with_values(options, slider="stages")
    assert "equal-strengths" not in _names(pinned, "color", 4, 1), "where no strengths are chosen"


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_variant_differs_from_its_base_in_one_plan_value(variant: Variant, options: TrainOptions) -> None:
    """Allow only `paper` to differ in many values. It is the preset except for scene, views and steps."""
    own = with_values(options, sh="auto", perceptual_weight=0.1)
    other = next(one for one in VARIANTS if one.name == variant.of)
    now = plan_values(variant.plan(resolve(own)))
    then = plan_values(other.plan(resolve(own)))
    differ = {path for path in now if now[path] != then[path]}
    if variant.name == "paper":
        preset = plan_values(resolve(apply_preset(own, "paper")))
        parts = ("preset", "optimize.", "field.")
        differing = {path for path in now if path.startswith(parts) and now[path] != preset[path]}
        assert differing == {"optimize.steps"}
        assert now["field.size"] == "paper"
        assert now["optimize.steps"] == round(1500 / 800 * then["optimize.steps"])
    elif variant.name in ("base", "2-keyframes", "equal-strengths"):
        assert not differ
    else:
        assert differ <= set(variant.changes), "only what it says"
        assert len(variant.changes) == 1 or (variant.patches and not differ)


@pytest.mark.parametrize(
    "part", ["EPSILON", "LEARNING_RATES", "RAMP_SHARE", "REFERENCE_CHANGE", "SMOOTHING", "_decay"]
)
def test_every_refinement_has_a_variant_without_it(part: str) -> None:
    assert any(f"trainer.optimize.pgs.{part}" in variant.patches for variant in VARIANTS)


@pytest.mark.parametrize("variant", [v for v in VARIANTS if v.patches], ids=lambda variant: variant.name)
def test_variant_patches_existing_names_and_restores_them(variant: Variant) -> None:
    def values() -> list[object]:
        return [pkgutil.resolve_name(name) for name in variant.patches]

    before = values()
    with variant.patched():
        assert values() == list(variant.patches.values())
    assert values() == before


def test_seed_reaches_descent_and_network_but_no_solved_variant(
    options: TrainOptions,
) -> None:
    plan = resolve(options)
    seeded = {v.name for v in differing_variants(plan, "color", 4, 1) if is_seeded(v, plan, "color")}
    assert {"descent", "no-lpips", "paper", "paper-pgs"} <= seeded
    assert not {"base", "one-target", "no-sh", "plain-clamps", "equal-strengths"} & seeded
    later = plan_values(next(v for v in VARIANTS if v.name == "paper").plan(plan, 2))
    assert (later["optimize.seed"], later["field.seed"], later["editor.seed"]) == (2, 2, 0)


def test_unknown_and_ineffective_variants_have_separate_errors(options: TrainOptions) -> None:
    variants = differing_variants(resolve(options), "color", 4, 1)
    assert [v.name for v in choose_variants(variants, "no-sh, base")] == ["base", "no-sh"]
    with pytest.raises(ProgdfError, match="'warmup' does not exist; choose of base,"):
        choose_variants(variants, "base,warmup")
    with pytest.raises(ProgdfError, match="'no-groups' makes no difference to this run; "):
        choose_variants(variants, "no-groups")
    with pytest.raises(ProgdfError, match="--only ' ,' names no variant; choose of base,"):
        choose_variants(variants, " ,")


def test_file_named_like_the_ablation_folder_is_refused(options: TrainOptions, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(options.out, copy, ignore=shutil.ignore_patterns("ablation"))
    (copy / "ablation").touch()
    with pytest.raises(ProgdfError, match="ablation is a file; give the name of a folder"):
        ablate(AblateOptions((copy,), threads=1), quiet=True)


def test_run_plan_is_read_back_unchanged(options: TrainOptions) -> None:
    resolved = with_values(recorded_options(resolve(options)), group_steps=0)
    assert run_plan(reopen_run(options.out)) == resolved, "with what the run found out"


def test_every_variant_has_a_table_row_a_picture_row_and_a_gdf(options: TrainOptions, run: Path) -> None:
    found = json.loads((run / "ablation" / "ablation.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in found["variants"]] == ONLY.split(",")
    markdown = (run / "ablation" / "ablation.md").read_text(encoding="utf-8")
    assert all(f"| {name} |" in markdown for name in ONLY.split(","))
    with Image.open(run / "ablation" / "ablation.png") as picture:
        assert picture.width > 5 * 176
        assert picture.height > 5 * 100
    scene = load_ply(options.scene)
    for name in ONLY.split(","):
        gdf = load_gdf(run / "ablation" / name / f"{name}.gdf", scene)
        assert not torch.equal(compose_layers(scene, [Layer(gdf, 1.0)]).sh0, scene.sh0)
    assert not list((run / "ablation").glob("*/state"))


def test_slider_variants_share_one_optimization_and_endpoint(run: Path) -> None:
    rows = json.loads((run / "ablation" / "ablation.json").read_text(encoding="utf-8"))["variants"]
    base, linear, plain, by_time = rows
    assert base["psnr"] == by_time["psnr"] == plain["psnr"], "the end is solved for whatever the way"
    assert linear["between"] != base["between"]
    assert by_time["between"] == base["between"], "judged where each shows it"
    assert by_time["uniformity"] < base["uniformity"]
    assert "continuing at step 4 of 4" in (run / "ablation/slider-time/log.txt").read_text(encoding="utf-8")
    assert "going on" not in (run / "ablation/one-target/log.txt").read_text(encoding="utf-8")


def test_variants_are_evaluated_at_untrained_strengths(run: Path) -> None:
    rows = json.loads((run / "ablation" / "ablation.json").read_text(encoding="utf-8"))["variants"]
    for row in rows:
        assert set(row["between"]) == {"0.25", "0.5", "0.75"}
    assert rows[0]["between"]["0.5"] > rows[2]["between"]["0.5"] + 3  # stages improve these strengths


def test_finished_variants_are_reused_until_edited_views_change(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", _nothing_trains)
    (again,) = ablate(AblateOptions((run,), only="base,one-target", threads=1), quiet=True)
    assert [row.first.name for row in again.rows] == ONLY.split(",")
    name = reopen_run(run).record.held_out[0]
    path = RunFolder(run).view("edited", name)
    content = path.read_bytes()
    try:
        with Image.open(path) as opened:
            Image.new("RGB", opened.size, "red").save(path)
        with pytest.raises(AssertionError, match="trains again"):
            ablate(AblateOptions((run,), only="base", threads=1), quiet=True)
    finally:
        path.write_bytes(content)


def test_interrupted_ablation_resumes_after_finished_variants(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = benchmarks.ablation.ablate.optimize_members

    def interrupted(*arguments: object, **more: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", interrupted)
    with pytest.raises(
        KeyboardInterrupt, match=r"1 of 2 variants are finished and saved in .*; run the same"
    ):
        ablate(AblateOptions((run,), only="base,no-sh", threads=1), quiet=True)
    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", real)
    (done,) = ablate(AblateOptions((run,), only="base,no-sh", threads=1), quiet=True)
    assert "no-sh" in [row.first.name for row in done.rows]


def test_failed_ablation_variant_is_reported_as_a_row(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> object:
        raise ProgdfError("training failed") from FloatingPointError("the loss is nan at step 7")

    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", broken)
    (done,) = ablate(AblateOptions((run,), only="paper", threads=1), quiet=True)
    assert done.rows[-1].failed == "the loss is nan at step 7"
    markdown = (run / "ablation" / "ablation.md").read_text(encoding="utf-8")
    assert "paper: the loss is nan at step 7." in markdown


def test_ablate_refuses_a_folder_without_a_finished_run(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ProgdfError, match="give a folder that progdf train finished"):
            ablate_command([str(folder)])
    assert not list(tmp_path.iterdir())


def test_ablate_table_fits_a_terminal(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", _nothing_trains)
    assert ablate_command([str(run), "--only", "base", "--threads", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert any(line.startswith("2-keyframes ") for line in lines)
    assert not any("…" in line for line in lines)


def test_failed_row_shows_dashes_and_its_reason_below() -> None:
    rows = [VariantRow([Outcome("paper", "as printed", "base", failed="the loss is nan")])]
    table = table_of([Ablation("robot", "title", "note", rows, "LPIPS")], "title")
    assert set(table.rows[0][4:]) == {"–"}
    assert len(table.rows[0]) == len(table.columns)
    assert "paper: the loss is nan." in table.note


def test_quick_ablation_uses_fewer_strengths_and_separate_results(
    options: TrainOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(options.out, copy, ignore=shutil.ignore_patterns("ablation"))
    requested: list[OptimizeOptions] = []

    def noted(_: TrainOptions, wanted: OptimizeOptions, *__: object, **more: object) -> object:
        requested.append(wanted)
        raise ProgdfError("enough") from FloatingPointError("enough")

    monkeypatch.setattr(benchmarks.ablation.ablate, "optimize_members", noted)
    monkeypatch.setattr("benchmarks.ablation.setup.QUICK_STEPS", 40)
    monkeypatch.setattr("benchmarks.ablation.setup.QUICK_STAGES", 2)
    ablate(AblateOptions((copy,), only="base", quick=True, threads=1), quiet=True)
    assert (requested[0].steps, requested[0].stages) == (40, 2)


@pytest.mark.slow
def test_only_seeded_variants_get_one_row_per_seed(options: TrainOptions, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    picture = tmp_path / "all.png"
    page = tmp_path / "page.md"
    shutil.copytree(options.out, copy, ignore=shutil.ignore_patterns("ablation"))
    page.write_text("<!-- bench ablation -->\n<!-- end ablation -->\n", encoding="utf-8")
    only = "base,equal-strengths,descent"
    requested = AblateOptions((copy,), only=only, seeds=2, markdown=page, plot=picture, threads=1)
    (done,) = ablate(requested, quiet=True)
    assert [len(row.outcomes) for row in done.rows] == [1, 1, 2]
    base, equal, descent = (row.outcomes for row in done.rows)
    assert base[0].between != equal[0].between
    assert descent[0].psnr != descent[1].psnr
    written = page.read_text(encoding="utf-8")
    assert "| descent | base | gradient descent instead of solving for colors | 2 | " in written
    assert " ± " in written
    with Image.open(picture) as opened:
        assert opened.width > 800


@pytest.mark.slow
def test_network_variant_is_trained_and_saved(
    options: TrainOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(options.out, copy, ignore=shutil.ignore_patterns("ablation"))
    paper = next(variant for variant in VARIANTS if variant.name == "paper")
    small = replace(paper, changes={**paper.changes, "field.size": "tiny"})
    monkeypatch.setitem(_BY_NAME, "paper", small)
    monkeypatch.setattr(
        "benchmarks.ablation.variants.VARIANTS",
        tuple(small if variant is paper else variant for variant in VARIANTS),
    )
    (done,) = ablate(AblateOptions((copy,), only="paper,paper-gdf-no-sharpness", threads=1), quiet=True)
    first, second = (row.first for row in done.rows)
    assert first.objective == second.objective
    assert first.psnr == second.psnr, "the end is the recorded one"
    gdfs = [
        load_gdf(copy / "ablation" / name / f"{name}.gdf", load_ply(options.scene))
        for name in ("paper", "paper-gdf-no-sharpness")
    ]
    networks = [gdf.field.origin.network for gdf in gdfs if gdf.field.origin is not None]
    assert [network.shape.inputs for network in networks] == ["position", "position"]
    weights = [network.tensors["heads.weight"] for network in networks]
    assert bool(weights[0].any())
    assert not torch.equal(*weights)


def test_invalid_ablate_options_fail_before_training(run: Path, tmp_path: Path) -> None:
    for requested, message in (
        (AblateOptions(()), "ablate needs a run"),
        (AblateOptions((run,), seeds=0), "--seeds must be at least 1, got 0"),
        (AblateOptions((run, run)), "a run is given twice"),
        (AblateOptions((run, tmp_path), scene=run), "--scene is of one run"),
        (AblateOptions((run,), markdown=tmp_path / "page.md"), "does not exist"),
        (AblateOptions((run,), plot=tmp_path / "no" / "all.png"), "does not exist; create it first"),
    ):
        with pytest.raises(ProgdfError, match=message):
            ablate(requested, quiet=True)
