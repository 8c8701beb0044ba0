"""Folders with small files under every name that the documents use."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.blank_plots import blank_plots
from tests.helpers.documented_files import train_documented_runs, write_documented_files


@pytest.fixture(scope="session", autouse=True)
def plots() -> Iterator[None]:
    """Leave out the plots of reports, which take half of the time of a small run."""
    with blank_plots():
        yield


@pytest.fixture(scope="session")
def documented_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the template of the folder in which the documented commands run."""
    folder = tmp_path_factory.mktemp("documented")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_documented_files()
    return folder


@pytest.fixture(scope="session")
def documented_runs(documented_files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the template with finished runs in place of bare .gdf files."""
    folder = tmp_path_factory.mktemp("trained") / "documented"
    shutil.copytree(documented_files, folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train_documented_runs()
    return folder


@pytest.fixture
def here(documented_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a copy of `documented_files` as the current folder."""
    return _enter_copy(documented_files, tmp_path, monkeypatch)


@pytest.fixture
def beside_runs(documented_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a copy of `documented_runs` as the current folder."""
    return _enter_copy(documented_runs, tmp_path, monkeypatch)


def _enter_copy(template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "typed"
    shutil.copytree(template, folder)
    monkeypatch.chdir(folder)
    return folder
