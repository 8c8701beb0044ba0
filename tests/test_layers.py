"""The walls of the house: progdf ← trainer, progdf ← viewer, and nothing else."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FORBIDDEN = {
    "progdf": {"trainer", "viewer", "shaders", "moderngl", "glfw", "imgui_bundle", "pyrr"},
    "trainer": {"viewer", "shaders", "moderngl", "glfw", "imgui_bundle", "pyrr"},
    "viewer": {"trainer", "diffusers", "transformers"},
}
FRONT_DOOR = ROOT / "progdf" / "__main__.py"


def offending_imports(source: str, floor: str, where: str) -> list[str]:
    """Imports in `source` that its floor must not make, as `where:line imports module`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            modules = [node.module or ""]
        else:
            continue
        found += [
            f"{where}:{node.lineno} imports {name}"
            for name in modules
            if name.split(".")[0] in FORBIDDEN[floor]
        ]
    return found


@pytest.mark.parametrize("floor", sorted(FORBIDDEN))
def test_no_floor_imports_one_it_must_not_know(floor: str) -> None:
    offending = []
    for path in sorted((ROOT / floor).rglob("*.py")):
        if path != FRONT_DOOR:
            offending += offending_imports(
                path.read_text(encoding="utf-8"), floor, str(path.relative_to(ROOT))
            )
    assert not offending, "\n".join(offending)


def test_the_layer_test_names_an_offending_import() -> None:
    assert offending_imports("import viewer.app.app\n", "trainer", "trainer/x.py") == [
        "trainer/x.py:1 imports viewer.app.app"
    ]
    assert offending_imports("def f():\n    from trainer import pgs\n", "viewer", "viewer/y.py")


def test_progdf_and_trainer_load_no_window_system() -> None:
    code = (
        "import sys, pkgutil, importlib, progdf, trainer\n"
        "for package in (progdf, trainer):\n"
        "    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not module.name.endswith('__main__'): importlib.import_module(module.name)\n"
        f"print(sorted({{name.split('.')[0] for name in sys.modules}} & {FORBIDDEN['trainer']!r}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "[]"


def test_importing_progdf_does_not_compile_or_load_kernels() -> None:
    code = "import sys, progdf; print('numba' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.strip() == "False", run.stderr
