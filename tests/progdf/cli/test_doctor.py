"""Tests of `progdf doctor` on healthy and broken set-ups, each in processes of their own."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Never

import pytest

from progdf.cli import doctor
from progdf.cli.doctor import GAUSSIANS, ball_of_gaussians, examine
from progdf.formats.ply import load_ply
from progdf.io.atomic import cache_folder


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "ball.ply"
    path.write_text(ball_of_gaussians(GAUSSIANS), encoding="ascii")
    return path


def test_the_test_scene_is_a_unit_ball(scene: Path) -> None:
    ball = load_ply(scene)
    assert len(ball) == GAUSSIANS
    assert ball.means.norm(dim=1).sub(1.0).abs().max() < 1e-5


def test_no_display_is_no_failure(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    finding = doctor._window(scene)
    assert finding.verdict == "note"
    assert "all commands except view work" in finding.text


def test_a_dead_display_is_named(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":9876")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    finding = doctor._window(scene)
    assert finding.verdict == "FAILED"
    assert "no window can be opened here" in finding.text


def test_a_display_that_never_answers_is_named(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":9876")
    monkeypatch.setattr(doctor, "START_LIMIT_S", 0.001)
    finding = doctor._window(scene)
    assert finding.verdict == "FAILED"
    assert "not finished after" in finding.text


def test_missing_drivers_fail_opengl_alone(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(scene.parent))
    assert doctor._opengl(scene).verdict == "FAILED"
    assert doctor._drawing(scene).verdict == "ok"


STUBS = {
    "torch": "raise ImportError('torch is built for another processor')",
    "numpy": "raise RuntimeError('no such instruction')",
    "msgspec": "import os\nos.abort()",
    "scipy": "raise SystemExit(3)",
}
"""Broken packages, each as the code of a module in its place."""


@pytest.fixture
def break_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Return a function that replaces a package by one of `STUBS` in child processes."""

    def replace_by_stub(name: str) -> None:
        (tmp_path / f"{name}.py").write_text(STUBS[name], encoding="utf-8")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")

    return replace_by_stub


def test_a_broken_package_is_named(scene: Path, break_package: Callable[[str], None]) -> None:
    break_package("torch")
    finding = doctor._drawing(scene)
    assert finding.verdict == "FAILED"
    assert finding.text.startswith(
        "the package torch cannot be imported (ImportError: torch is built for another processor); "
    )


@pytest.mark.parametrize(
    ("package", "fault"),
    [
        ("numpy", "RuntimeError: no such instruction"),
        ("msgspec", "ended by signal 6"),
        ("scipy", "SystemExit: 3"),
    ],
)
def test_packages_that_cannot_be_imported_are_listed(
    package: str, fault: str, break_package: Callable[[str], None]
) -> None:
    break_package(package)
    modules = ["plyfile", package, "safetensors"] if package != "numpy" else ["scipy.linalg", "plyfile"]
    assert doctor._import_faults(modules) == {package: fault}


def test_the_packages_line_says_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_requirements", lambda: [("numpy", ""), ("a-package", ""), ("x", "extra")])
    monkeypatch.setattr(doctor, "_import_faults", lambda modules: dict.fromkeys(modules, "it is old"))
    missing, broken = doctor._packages()
    assert (missing.verdict, missing.text) == (
        "FAILED",
        "a-package missing; install progdf-studio with pip again",
    )
    assert broken.text.startswith("the package numpy cannot be imported (it is old); ")
    monkeypatch.setattr(doctor, "_requirements", lambda: [("numpy", "")])
    monkeypatch.setattr(doctor, "_import_faults", lambda modules: {})
    (fine,) = doctor._packages()
    assert fine.verdict == "ok"


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(28, "No space left on device", "/tmp/x"), "/tmp/x: No space left on device"),
        (ValueError("odd"), "ValueError: odd"),
    ],
)
def test_a_check_that_fails_does_not_end_the_report(
    error: Exception, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> Never:
        raise error

    fine = doctor.Finding("ok", "packages", "fine")
    for name in ("_system", "_extras", "_processor", "_memory", "_folder"):
        monkeypatch.setattr(doctor, name, fail)
    monkeypatch.setattr(doctor, "_packages", lambda: [fine])
    monkeypatch.setattr(doctor, "_tests", lambda: fail())
    assert doctor.main([]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines.pop(1) == fine.line()
    assert lines.pop() == "7 failed; a bug report needs all lines above"
    subjects = ("progdf", "extras", "processor", "memory", "cache", "state", "temporary")
    assert lines == [doctor.Finding("FAILED", subject, text).line() for subject in subjects]


@pytest.mark.parametrize("fails", ["TemporaryDirectory", "write_text"])
def test_tests_without_a_scene_run_on_a_full_disk(fails: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> Never:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((doctor.tempfile, fails) if fails == "TemporaryDirectory" else (Path, fails)), fail)
    for name in ("_window", "_card"):
        monkeypatch.setattr(doctor, name, lambda _, name=name: doctor.Finding("ok", name, ""))
    full, *others = doctor._tests()
    assert (full.verdict, full.subject) == ("FAILED", "temporary")
    assert full.text.endswith("cannot be written: No space left on device")
    assert [finding.subject for finding in others] == ["_window", "_card"]


def test_a_missing_platformdirs_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "platformdirs", None)
    (finding,) = doctor._check("cache", lambda: [doctor._folder("cache", cache_folder())])
    assert finding.verdict == "FAILED"
    assert finding.text.startswith("the package platformdirs cannot be imported (")


def test_a_cache_that_cannot_be_written_is_noted(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    blocked = tmp_path / "file" / "cache"
    cache = doctor._folder("cache", blocked)
    assert cache.verdict == "note"
    assert f"{blocked} cannot be written" in cache.text
    assert doctor._folder("state", tmp_path / "state").verdict == "ok"


def test_a_crash_is_a_failure_with_its_signal() -> None:
    crashed = doctor.Outcome(-11, 0.1, "", "")
    assert doctor._judge("OpenGL", crashed, "").text == "ended by signal 11"


@pytest.mark.slow
def test_a_healthy_machine_passes() -> None:
    findings = {finding.subject: finding for finding in examine()}
    assert {"drawing", "OpenGL", "training", "card", "packages", "memory"} <= set(findings)
    assert [finding.line() for finding in findings.values() if finding.verdict == "FAILED"] == []
