"""Tests of the release scripts: versions that must agree, and wheels that fit a system."""

from __future__ import annotations

import re
import tomllib
import zipfile
from pathlib import Path

import pytest

from progdf import __version__
from release.packages import check_same_files
from release.wheels import SYSTEMS, accepted_tags, has_wheel
from tests.helpers.paths import ROOT


def test_version_is_the_same_in_every_file() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert project["version"] == __version__
    assert f"\nversion: {__version__}\n" in citation
    first = re.search(r"^## \[(.+?)\]", changes, re.MULTILINE)
    assert first is not None
    assert first[1] == __version__


@pytest.mark.parametrize("name", ["ci.yml", "release.yml"])
def test_workflows_install_everything_that_builds(name: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    needed = {re.split("[<>=]", line)[0] for line in project["build-system"]["requires"]}
    workflow = (ROOT / ".github" / "workflows" / name).read_text(encoding="utf-8")
    (line,) = (line for line in workflow.splitlines() if "pip install" in line and "hatchling" in line)
    assert needed <= set(line.split())


@pytest.mark.parametrize(
    ("wheel", "systems"),
    [
        ("a-1-py3-none-any.whl", set(SYSTEMS)),
        ("a-1-cp314-cp314-manylinux_2_28_aarch64.whl", {"Linux aarch64"}),
        ("a-1-cp314-cp314-manylinux2014_x86_64.manylinux_2_17_x86_64.whl", {"Linux x86-64"}),
        ("a-1-cp38-abi3-macosx_11_0_arm64.whl", {"macOS 14 Apple silicon"}),
        ("a-1-cp314-cp314-macosx_15_0_arm64.whl", set()),
        ("a-1-cp314-cp314-musllinux_1_2_x86_64.whl", set()),
        ("a-1-cp313-cp313-win_amd64.whl", set()),
        ("a-1-py3-none-win_amd64.whl", {"Windows x86-64"}),
    ],
)
def test_wheels_are_matched_to_systems(wheel: str, systems: set[str]) -> None:
    package = {"name": "a", "version": "1", "wheels": [{"url": f"https://example.org/x/{wheel}"}]}
    fitting = {
        name
        for name, system in SYSTEMS.items()
        if has_wheel(package, frozenset(accepted_tags(system, "3.14")))
    }
    assert fitting == systems


def test_package_without_wheels_is_compiled() -> None:
    tags = frozenset(accepted_tags(SYSTEMS["Linux aarch64"], "3.11"))
    assert not has_wheel({"name": "moderngl", "version": "5", "sdist": {}}, tags)


def test_wheels_that_differ_are_named(tmp_path: Path) -> None:
    for name, text in (("a", "1"), ("b", "1"), ("c", "2")):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("progdf/x.py", text)
    check_same_files(tmp_path / "a", tmp_path / "b")
    with pytest.raises(ValueError, match=r"progdf/x\.py"):
        check_same_files(tmp_path / "a", tmp_path / "c")
