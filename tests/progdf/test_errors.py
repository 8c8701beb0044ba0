"""Tests of error texts in the window: no command line in any of our errors."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import progdf
from progdf.__main__ import COMMANDS
from progdf.errors import without_commands
from progdf.gaussians import Gaussians
from tests.helpers.scenes import random_gaussians

ROOT = Path(progdf.__file__).resolve().parents[1]
TYPED = re.compile(rf"(?<![\w/.-])--[a-z]|pip install|hf download|progdf ({'|'.join(COMMANDS)})\b")


def raised_texts(package: str) -> Iterator[str]:
    """Yield the messages of a package's exceptions, with their values as X."""
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                for text in node.exc.args:
                    if isinstance(text, ast.JoinedStr):
                        yield "".join(
                            str(part.value) if isinstance(part, ast.Constant) else "X" for part in text.values
                        )
                    elif isinstance(text, ast.Constant) and isinstance(text.value, str):
                        yield text.value


def test_window_errors_contain_no_command_line() -> None:
    texts = [text for package in ("progdf", "trainer", "viewer") for text in raised_texts(package)]
    assert len([text for text in texts if TYPED.search(text)]) > 80, "there are such"
    for text in texts:
        shown = without_commands(text)
        assert not TYPED.search(shown), shown
        assert shown.strip() or not text.strip(), text
        if shown == text:
            continue
        assert TYPED.search(text), text
        assert not re.search(r"[,;:] *$|; (or|and) ", shown) or text.endswith(": "), shown


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        ("--threads must be between 0 and 9, got -1", "threads must be between 0 and 9, got -1"),
        ("no place; change more, or name the region with --region", "no place; change more"),
        ("it is long; pip install progdf-studio[clip]; close others", "it is long; close others"),
        ("none is seen; give --image-size or --views more", "none is seen"),
        ("x is no run of progdf train; give --out another folder", "x is no run of ProGDF"),
        (
            "a.ply does not exist; give another, or draw one",
            "a.ply does not exist; give another, or draw one",
        ),
        ("/work/a--b.ply is damaged; load it again", "/work/a--b.ply is damaged; load it again"),
    ],
)
def test_window_errors_keep_the_cause_and_manual_remedies(error: str, shown: str) -> None:
    assert without_commands(error) == shown


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda scene, path: progdf.save_scene(scene, path), "save_scene(path, scene)"),
        (lambda scene, path: progdf.save_ply(scene, path), "save_ply(path, scene)"),
        (lambda scene, path: progdf.load_scene(scene), "load_scene(path)"),
        (lambda scene, path: progdf.load_ply(scene), "load_ply(path)"),
        (lambda scene, path: progdf.load_gdf(scene, path), "load_gdf(path, scene)"),
        (lambda scene, path: progdf.save_gdf(scene, path), "save_gdf(path, gdf)"),
        (lambda scene, path: progdf.load_cameras(scene), "load_cameras(path)"),
        (lambda scene, path: progdf.compose_layers([], scene), "compose_layers(scene, layers)"),
        (lambda scene, path: progdf.render(path, scene), "render(scene, camera)"),
    ],
)
def test_swapped_arguments_name_the_right_call(
    call: Callable[[Gaussians, Path], object], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(TypeError, match=re.escape(expected)):
        call(random_gaussians(3, seed=1), tmp_path / "scene.ply")
