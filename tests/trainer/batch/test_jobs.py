"""Batch catalogues: options of jobs, sweeps, cost estimates and reported faults."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from progdf.errors import ProgdfError
from trainer.batch.jobs import BatchJob, estimate_cost, read_catalogue
from trainer.cli import train_options
from trainer.resolve import resolve

SHOES = """
[defaults]
views = 12
[[scenes]]
path = "shoes/left.ply"
up = "-y"
[[scenes.edits]]
name = "blue"
region = "labels:left.npy:1"
editor = "recolor:#3060d0"
[[scenes.edits]]
name = "night"
region = "all"
editor = "night"
image-size = 128
[[scenes]]
path = "shoes/right.ply"
[[scenes.edits]]
name = "blue"
region = "labels:right.npy:1"
editor = "recolor:#3060d0"
views = 20
"""


def read(folder: Path, text: str) -> tuple[list[BatchJob], list[str]]:
    (folder / "catalogue.toml").write_text(text, encoding="utf-8")
    return read_catalogue(folder / "catalogue.toml", folder / "runs")


def test_job_merges_options_of_catalogue_scene_and_edit(tmp_path: Path) -> None:
    jobs, faults = read(tmp_path, SHOES)
    assert not faults
    assert [job.key for job in jobs] == ["left/blue", "left/night", "right/blue"]
    assert [job.options.views.views for job in jobs] == [12, 12, 20]
    assert [job.options.views.up for job in jobs] == ["-y", "-y", "auto"]
    assert [job.options.views.image_size for job in jobs] == [0, 128, 0]
    assert jobs[2].options.scene == Path("shoes/right.ply")
    assert jobs[2].options.out == tmp_path / "runs" / "right" / "blue"
    assert {job.folder for job in jobs} == {tmp_path}


def test_sweep_makes_every_combination(tmp_path: Path) -> None:
    jobs, faults = read(tmp_path, SHOES + '\n[sweep]\nsteps = [400, 800]\nslider = ["even", "stages"]')
    assert not faults
    names = [job.key for job in jobs if job.key.startswith("left/blue")]
    assert names == [f"left/blue,steps={n},slider={s}" for n in (400, 800) for s in ("even", "stages")]
    assert len(jobs) == 12
    assert [job.options.optimize.steps for job in jobs[:4]] == [400, 400, 800, 800]


@pytest.mark.parametrize("more", ["", "preset = 'paper'\n", "quick = true\nperceptual-weight = 0.5\n"])
def test_job_command_reproduces_its_options(tmp_path: Path, more: str) -> None:
    for job in read(tmp_path, SHOES.replace("views = 12", more + "seed = 3"))[0]:
        words = shlex.split(job.command)
        assert words[:2] == ["progdf", "train"]
        assert resolve(train_options(words[2:])) == resolve(job.options)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("views = 12", "view = 12", "left/blue: it has an unknown key 'view'; did you mean 'views'?"),
        ("views = 12", "views = 'many'", "views is 'many', expected int"),
        ("views = 12", "views = 2", "left/blue: --views must be between 3 and 96, got 2"),
        ("views = 12", "preset = 'mine'", "there is no preset 'mine'"),
        ("views = 12", "preset = []", "there is no preset []"),
        ("views = 12", "out = 'here'", "it has an unknown key 'out'"),
        ('region = "all"', "", "left/night: region is missing"),
        ('name = "night"', 'name = "BLUE"', "left/blue: 2 jobs have this name"),
        ('path = "shoes/right.ply"', 'path = "other/left.ply"', "left/blue: 2 jobs have this name"),
        ('name = "night"', 'name = "a/b"', "'a/b' is not a valid layer name"),
        ('name = "night"', "", "an edit of left has no name"),
        ('path = "shoes/left.ply"', "", "each of [[scenes]] needs a path"),
        ("[defaults]", "[default]", "an unknown key 'default'; did you mean 'defaults'?"),
        ("[defaults]", "[sweep]", "[sweep] views must be a list of values"),
    ],
)
def test_fault_is_one_line_that_names_its_location(tmp_path: Path, old: str, new: str, fault: str) -> None:
    _, faults = read(tmp_path, SHOES.replace(old, new, 1))
    assert any(fault in line for line in faults), faults
    assert all("\n" not in line for line in faults)


def test_all_faults_are_reported_together(tmp_path: Path) -> None:
    text = SHOES.replace('region = "all"', "").replace("views = 20", "views = 1").replace("up =", "upp =")
    assert len(read(tmp_path, text)[1]) == 3


@pytest.mark.parametrize(
    "text", ["", "scenes = 3", "[[scenes]]\npath = 'a.ply'", "defaults = []", "x = [" * 9000]
)
def test_invalid_catalogue_is_a_one_line_error(tmp_path: Path, text: str) -> None:
    try:
        jobs, faults = read(tmp_path, text)
    except ProgdfError as error:
        jobs = []
        faults = [str(error)]
    assert not jobs
    assert len(faults) == 1


def test_cost_estimate_grows_with_scene_members_and_pixels(tmp_path: Path) -> None:
    options = read(tmp_path, SHOES)[0][0].options
    larger = replace(options, views=replace(options.views, image_size=512))
    small, many, large = (
        estimate_cost(*given)
        for given in ((options, 10_000, 500), (options, 900_000, 90_000), (larger, 10_000, 500))
    )
    for cost in (many, large):
        assert cost.seconds > small.seconds
        assert cost.memory > small.memory
        assert cost.disk > small.disk


def test_too_many_jobs_are_refused_before_any_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(*_: object) -> None:
        raise AssertionError("a job is built")

    monkeypatch.setattr("trainer.batch.jobs.make_options", build)
    sweep = f"\n[sweep]\nseed = {[*range(400)]}\nsteps = {[*range(400, 557)]}"
    jobs, (fault,) = read(tmp_path, SHOES + sweep)
    assert not jobs
    assert "188 400 jobs (3 edits × 400 of seed × 157 of steps), at most 100 000 are allowed" in fault


def test_huge_number_of_jobs_is_a_one_line_error(tmp_path: Path) -> None:
    names = ("seed", "steps", "views", "stages", "threads", "image-size")
    sweep = "\n[sweep]\n" + "\n".join(f"{name} = {[1] * 1000}" for name in names)
    jobs, (fault,) = read(tmp_path, SHOES + sweep)
    assert not jobs
    assert "3 000 000 000 000 000 000 jobs" in fault
