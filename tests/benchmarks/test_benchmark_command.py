"""Tests of `python -m benchmarks`: outputs are checked before anything is measured."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.__main__ import main
from benchmarks.table import Table, Wall, busy_share, machine, today
from progdf.errors import ProgdfError


@pytest.mark.parametrize("option", ["--json", "--plots", "--markdown"])
def test_benchmark_with_an_unwritable_output_is_not_started(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.__main__.BENCHES", {"field": "nowhere:begun"})
    with pytest.raises(ProgdfError, match="does not exist; "):
        main(["field", option, str(tmp_path / "no" / "f.x")])


def test_broken_scene_stops_the_benchmark_before_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "scene.ply"
    broken.write_text("ply\n")
    monkeypatch.setattr(command, "_function", lambda name: pytest.fail(f"{name} was begun"))
    with pytest.raises(ProgdfError, match=r"scene\.ply"):
        main(["page", "--scenes", str(broken)])


def test_unknown_benchmark_error_lists_the_known_ones() -> None:
    with pytest.raises(ProgdfError, match=r"unknown benchmark 'speed'; use one of training, .*ablate"):
        main(["speed"])


def _table(**_: object) -> list[Table]:
    return [Table("hard", "A table", ("case", Wall("ms"), "processor ms"), (("one", "7", "5"),), "A note.")]


@pytest.mark.parametrize(("busy", "ms"), [(0.0, "7"), (0.5, "–")])
def test_wall_times_are_omitted_on_a_busy_machine(
    busy: float, ms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "BENCHES", {"hard": "here"})
    monkeypatch.setattr(command, "_function", lambda path: _table)
    shares = iter((0.0, busy))  # busy share before and after the measurement
    monkeypatch.setattr(command, "busy_share", lambda: next(shares))
    page = tmp_path / "page.md"
    page.write_text(
        "a\n<!-- bench machine -->\n<!-- end machine -->\n<!-- bench hard -->\nx\n<!-- end hard -->\nb\n"
    )
    main(["hard", "--markdown", str(page)])
    text = page.read_text()
    assert f"| one | {ms} | 5 |" in text
    assert "A note. Made by `python -m benchmarks hard`" in text
    assert text.count(today()) == 2
    assert ("other processes used 50 % of the cores" in text) == (busy > 0)
    assert f"<!-- bench machine -->\n{machine()}\n<!-- end machine -->" in text


def test_busy_share_sees_loops_in_other_processes() -> None:
    """Run a loop on every core, which leaves half of each core."""
    loop = [sys.executable, "-c", "while True: pass"]
    children = [subprocess.Popen(loop) for _ in range(os.cpu_count() or 1)]
    try:
        assert busy_share() > 0.3
    finally:
        for child in children:
            child.kill()
            child.wait()


@pytest.mark.slow
def test_page_runs_exactly_the_benchmarks_with_markers(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[str] = []
    monkeypatch.setattr(command, "_function", lambda path: lambda **_: requested.append(path) or [])
    monkeypatch.setattr(command, "atomic_write", lambda path: pytest.fail("nothing was measured"))
    with pytest.raises(ProgdfError, match="unknown benchmark 'page'"):
        main(["page", "hard"])
    main(["page"])
    assert requested == [command.BENCHES[name] for name in command.PAGE]
    text = (command.ROOT / "docs" / "speed-and-error.md").read_text()
    named = set(re.findall(r"<!-- bench ([\w-]+) -->", text))
    stages = {"training-edits", "training-stages", "training-scaling"}  # need captures that are not shipped
    assert named == {"machine", "compose", "coarse", "lists", "strays", *stages, *command.PAGE}
