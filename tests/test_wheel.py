"""Tests of the wheel in a fresh environment: contents, extras, and an exported page."""

from __future__ import annotations

import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from progdf import save_ply
from progdf.gdf.file import save_gdf
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.scenes import random_gaussians

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PACKAGES = ("progdf", "trainer", "viewer", "shaders")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def fresh(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the script folder of an environment with the wheel and this environment's dependencies."""
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    run([sys.executable, "-m", "venv", "--without-pip", str(folder)], folder.parent)
    names = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", names))
    # a path in a .pth file does not follow the .pth files there, which may name a checkout
    (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    programs = Path(sysconfig.get_path("scripts", "venv", names))
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python"), "install"]
    run([*pip, "-q", "--no-deps", "--no-index", "--force-reinstall", str(wheel)], folder.parent)
    return programs


def run(command: Sequence[str], folder: Path) -> str:
    """Run a command in a folder without access to the checkout. Return its output."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def scene_and_edit(folder: Path) -> list[str]:
    scene = random_gaussians(60, seed=3, sh_degree=1)
    save_ply(folder / "scene.ply", scene)
    save_gdf(
        folder / "shirt.gdf", edit_of(scene, some_rows(scene, 20), curved_field(20, channels=23), "shirt")
    )
    return ["scene.ply", "shirt.gdf"]


def test_wheel_holds_exactly_the_files_of_the_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        text = archive.read(metadata).decode()
        (entries,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        assert "progdf = progdf.__main__:main" in archive.read(entries).decode().splitlines()
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file())
    ours = {
        path.relative_to(ROOT).as_posix() for path in files if path.suffix not in (".pyc", ".nbi", ".nbc")
    }
    assert packed == ours
    kinds = {Path(name).suffix for name in packed}
    assert {".py", ".vert", ".frag", ".glsl", ".js", ".html", ".css", ".typed"} <= kinds | {
        Path(n).name for n in packed
    }
    assert "Name: progdf-studio\n" in text
    targets = re.findall(r"\]\(([^)]+)\)|(?:src|href)=\"([^\"]+)", text.partition("\n\n")[2])
    assert targets, "the description is the README"
    assert [target for target in targets if not "".join(target).startswith("https://")] == []
    assert set(re.findall(r"^Provides-Extra: (.*)$", text, re.MULTILINE)) == set(
        PROJECT["optional-dependencies"]
    )


@pytest.mark.slow  # contents and command name of the wheel are tested in every run
def test_installed_wheel_runs_its_command(fresh: Path, tmp_path: Path) -> None:
    code = "import progdf, viewer.web.page, shaders; print(progdf.__file__, viewer.web.page.__file__)"
    for file in run([str(fresh / "python"), "-P", "-c", code], tmp_path).split():
        assert Path(file).is_relative_to(fresh.parent), "from the wheel, not from the checkout"
    assert run([str(fresh / "progdf"), "--version"], tmp_path).split()[-1] == PROJECT["version"]
    assert "export" in run([str(fresh / "progdf"), "--help"], tmp_path)
    given = scene_and_edit(tmp_path)
    assert "read back and compared" in run([str(fresh / "progdf"), "export", *given, "-o", "a.ply"], tmp_path)


def test_extras_are_installable_and_messages_name_existing_extras() -> None:
    extras = PROJECT["optional-dependencies"]
    for name, packages in extras.items():
        assert packages, name
        for text in packages:
            requirement = Requirement(text)
            if name in ("quantize", "qwen"):  # needs a graphics card or another torch version
                continue
            try:
                found = importlib.metadata.version(requirement.name)
            except importlib.metadata.PackageNotFoundError:
                continue
            assert found in requirement.specifier, f"{name}: {text}, and {found} is installed"
    sources = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    sources += [ROOT / "README.md", ROOT / "Makefile", *(ROOT / "docs").rglob("*.md")]
    texts = [path.read_text(encoding="utf-8") for path in sources]
    named = {n for text in texts for n in re.findall(r"progdf-studio\[([a-z,]+)\]", text)}
    named |= {n for text in texts for n in re.findall(r"install_extra\(['\"](\w+)", text)}
    named |= {n for text in texts for n in re.findall(r"EXTRAS := (.*)", text)}
    assert {n for group in named for n in group.split(",")} <= set(extras)
    assert any("progdf-studio[" in text for text in texts)


@pytest.mark.slow
def test_page_exported_by_the_wheel_opens_in_a_browser(fresh: Path, tmp_path: Path, browser: Any) -> None:
    given = scene_and_edit(tmp_path)
    assert "page.html" in run([str(fresh / "progdf"), "export", *given, "-o", "page.html"], tmp_path)
    tab = browser.new_page()
    complaints: list[str] = []
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.goto((tmp_path / "page.html").as_uri())
    tab.wait_for_selector("body.drawn", timeout=20_000)
    assert tab.evaluate("progdf.view.layers.map((layer) => layer.name)") == ["shirt"]
    assert complaints == []
    tab.close()
