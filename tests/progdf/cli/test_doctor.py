"""Tests of `progdf doctor` on healthy and broken set-ups, each in processes of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from progdf.cli import doctor
from progdf.cli.doctor import GAUSSIANS, ball_of_gaussians, examine
from progdf.formats.ply import load_ply


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


def test_a_broken_package_is_named(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scene.parent / "torch.py").write_text("raise ImportError('torch is built for another processor')")
    monkeypatch.setenv("PYTHONPATH", str(scene.parent), prepend=":")
    finding = doctor._drawing(scene)
    assert finding.verdict == "FAILED"
    assert "torch is built for another processor" in finding.text


def test_a_cache_that_cannot_be_written_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    blocked = tmp_path / "file" / "cache"
    monkeypatch.setattr(doctor, "cache_folder", lambda: blocked)
    cache, state = doctor._folders()
    assert cache.verdict == "note"
    assert f"{blocked} cannot be written" in cache.text
    assert state.verdict == "ok"


def test_a_crash_is_a_failure_with_its_signal() -> None:
    crashed = doctor.Outcome(-11, 0.1, "", "")
    assert doctor._judge("OpenGL", crashed, "").text == "ended by signal 11"


@pytest.mark.slow
def test_a_healthy_machine_passes() -> None:
    findings = {finding.subject: finding for finding in examine()}
    assert {"drawing", "OpenGL", "training", "card", "packages", "memory"} <= set(findings)
    assert [finding.line() for finding in findings.values() if finding.verdict == "FAILED"] == []
