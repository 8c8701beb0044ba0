"""Tests of the documents: valid links, valid command lines, and every option documented."""

from __future__ import annotations

import contextlib
import io
import re
import runpy
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.__main__ import BENCHES
from benchmarks.__main__ import main as benchmarks
from progdf.__main__ import COMMANDS
from progdf.__main__ import main as progdf
from progdf.compose.reference import Layer, compose_layers
from progdf.field.baked import END_TYPES
from progdf.gdf.file import save_gdf
from tests.helpers.documents import DOCUMENTS as PAGES
from tests.helpers.documents import blocks, command_examples
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.paths import ROOT
from tests.helpers.scenes import ball
from tests.helpers.sizes import PACKAGES, modules

FOLDERS = ("lab", "tutorials")
DOCUMENTS = [
    *PAGES,
    *(path for name in FOLDERS for path in sorted((ROOT / "docs" / name).glob("*.md")) if path not in PAGES),
]
OWN_BENCHMARKS = ("ablate", "regret", "training-stages")
"""Benchmarks with options of their own."""

MAX_README_LINES = 150


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def examples_of(*words: str) -> list[Any]:
    """Return the documented command lines that begin with these words, as parameters of a test."""
    found = [example for example in command_examples() if tuple(example.words[: len(words)]) == words]
    return [pytest.param(example.words, id=example.title) for example in found]


def help_of(run: Callable[[Sequence[str]], int], *command: str) -> str:
    """Return the output of `--help`."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        run([*command, "--help"])
    return printed.getvalue()


@cache
def mentioned_options(command: str) -> frozenset[str]:
    """Return all options that a command's help mentions."""
    text = help_of(progdf, command) if command in COMMANDS else help_of(benchmarks, *command.split()[1:])
    return frozenset(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", text))


def own_options(command: str) -> set[str]:
    """Return the options that a command's help explains, without the `--no-` forms."""
    heads = re.findall(r"^\W*?(-.*?)(?:  |$)", help_of(progdf, command).replace("│", " "), re.MULTILINE)
    found = {option for head in heads for option in re.findall(r"--[a-z][a-z-]*", head)}
    return found - {"--help"}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_existing_files_and_headings(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if target.startswith("https://"):
            continue
        file, _, heading = target.partition("#")
        linked = (path.parent / file).resolve() if file else path
        assert linked.exists(), f"{path.name} links to {target}"
        if heading:
            assert heading in anchors(linked.read_text()), f"{path.name} links to {target}"


@pytest.mark.parametrize("words", examples_of("progdf"))
def test_documented_command_has_its_options(words: list[str]) -> None:
    command = words[1]
    if command == "--version":
        return
    assert command in COMMANDS
    given = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
    assert given <= mentioned_options(command)


@pytest.mark.parametrize("words", examples_of("python", "-m", "benchmarks"))
def test_documented_benchmark_has_its_options(words: list[str]) -> None:
    name = words[3]
    own_command = name in OWN_BENCHMARKS
    command = f"benchmarks {name}" if own_command else "benchmarks"
    assert {word for word in words if word.startswith("--")} <= mentioned_options(command)
    assert own_command or name == "page" or name in BENCHES


def test_documented_benchmark_exists() -> None:
    known = {*BENCHES, "page", *OWN_BENCHMARKS}
    for path in DOCUMENTS:
        named = re.findall(r"`python -m benchmarks ([\w-]+)", path.read_text(encoding="utf-8"))
        assert set(named) <= known, path.name


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_option_of_a_command_is_documented(command: str) -> None:
    text = (ROOT / "docs" / "cli.md").read_text()
    documented = set(re.findall(r"--[a-z][a-z-]*", text))
    documented |= {"--" + option.removeprefix("--no-") for option in documented}
    missing = {o for o in own_options(command) if o not in documented and not o.startswith("--no-")}
    assert not missing


def test_every_documented_option_exists() -> None:
    known = {option for command in COMMANDS for option in mentioned_options(command)} | {
        "--version",
        "--no-deps",
        "--regenerate-screenshots",
    }
    for name in ("", *OWN_BENCHMARKS):
        known |= mentioned_options(f"benchmarks {name}".strip())
    documented = {o for path in DOCUMENTS for o in re.findall(r"`(--[a-z][a-z-]*)", path.read_text())}
    assert documented <= known


def test_readme_is_one_page_and_the_sdist_holds_the_documents() -> None:
    assert (ROOT / "README.md").read_text().count("\n") <= MAX_README_LINES
    assert '"docs"' in (ROOT / "pyproject.toml").read_text()


def test_docstrings_cite_existing_documents_and_sections() -> None:
    for package in ("progdf", "trainer", "viewer", "shaders", "benchmarks"):
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix not in (".py", ".vert", ".frag", ".glsl"):
                continue
            source = " ".join(path.read_text().replace("#", " ").split())
            for cited, rest in re.findall(r"(\w[\w/.-]*\.md\b)(.{0,60})", source):
                whole = ("ablation.md", "docs/benchmarks.md", "docs/paper.md", "docs/speed-and-error.md")
                assert cited == "ablation.md" or (ROOT / cited).is_file(), f"{path.name} cites {cited}"
                if cited in whole or rest[:1] in (")", ".", ";", '"'):  # the whole document is cited
                    continue
                headings = re.findall(r"^##+ (.*)$", (ROOT / cited).read_text(), re.MULTILINE)
                wanted = rest.removeprefix(",").strip()
                assert any(wanted.startswith((h, h.partition(".")[0])) for h in headings), (
                    path.name,
                    cited,
                    rest,
                )


@pytest.mark.parametrize("end_type", END_TYPES)
def test_documented_reader_reads_a_written_gdf(tmp_path: Path, end_type: torch.dtype) -> None:
    scene = ball(60)
    members = some_rows(scene, 20)
    gdf = edit_of(scene, members, curved_field(20, end_type=end_type))
    save_gdf(tmp_path / "edit.gdf", gdf)
    reader: dict[str, Any] = {}
    (code,) = blocks((ROOT / "docs" / "file-format.md").read_text(), "python")
    exec(code, reader)
    header, rows, tensors = reader["read_gdf"](tmp_path / "edit.gdf")
    assert header["scene"]["count"] == 60
    assert rows.tolist() == members.tolist()
    for strength in (0.0, 0.37, 1.0):
        edited = compose_layers(scene, [Layer(gdf, strength)])
        for name in header["field"]["attributes"]:
            before = getattr(scene, name)[members]
            after = getattr(edited, name)[members]
            found = before.numpy() + reader["offsets"](tensors, name, strength).reshape(before.shape)
            np.testing.assert_allclose(found, after.numpy(), atol=1e-6)


def test_readme_figures_match_their_pages() -> None:
    figures = runpy.run_path(str(ROOT / "assets" / "figures.py"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("<!-- figure ") >= 5
    assert figures["with_figures"](text) == text, "run python assets/figures.py"


def test_the_picture_of_the_packages_has_every_folder() -> None:
    picture = (ROOT / "docs" / "architecture.svg").read_text(encoding="utf-8")
    folders = {
        module.path.parts[1]
        for package in PACKAGES
        for module in modules(package)
        if len(module.path.parts) > 2
    }
    assert {folder for folder in folders if f">{folder}/<" not in picture} == set()
