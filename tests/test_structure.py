"""Tests of the layout's limits: packages, import cycles, order of folders, sizes and packaging."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest

from tests.helpers.sizes import Module, calls, dotted, functions, importers, modules, parse, with_tree

ROOT = Path(__file__).parents[1]
PACKAGES = ("progdf", "trainer", "viewer", "benchmarks")

# Modules that a package must not import. Only progdf ← trainer and progdf ← viewer are allowed.
FORBIDDEN = {
    "progdf": {"trainer", "viewer", "shaders", "benchmarks", "moderngl", "glfw", "imgui_bundle", "pyrr"},
    "trainer": {"viewer", "shaders", "benchmarks", "moderngl", "glfw", "imgui_bundle", "pyrr"},
    "viewer": {"trainer", "benchmarks", "diffusers", "transformers"},
}
ENTRY_POINT = ROOT / "progdf" / "__main__.py"  # its table of commands names all packages

# Order of the folders and top-level files of each package. Each imports only from earlier ones.
ORDER = {
    "progdf": """system quaternions sh gaussians similarity terminal errors threads region camera color
        metrics demo_scenes io rasterize surface painting field formats gdf scene compose fade pull tidy
        summary cli __init__ __main__""",
    "trainer": """__init__ options quality store views paint fill editors resolve regions
        motion optimize paper fit methods report preview run evaluate batch cli""",
    "viewer": "camera gl state jobs render web files widget __init__ pictures ui panel app commands",
    "benchmarks": """__init__ analytic_warps courses table ablation rasterizer training
        recorded_runs viewer colors layers files field edits sliders networks motion pictures spill
        editors __main__""",
}

MAX_FILES = 14
MAX_LINES = 600
# Longer files, each one algorithm whose parts call each other. These numbers only fall.
LONG_FILES = {
    "trainer/optimize/color_solver.py": 602,
}

MEASURED = ("progdf", "trainer", "viewer")
# Files with module names as text, which are imported on first use.
LAZY_TABLES = ("progdf/__init__.py", "progdf/__main__.py", "progdf/rasterize/engines.py")
MAX_IMPORTS = 0.073  # share of all lines
MAX_FILE_IMPORTS = 39  # import statements of one file; this ceiling only falls, to 25
MAX_SCRIPT_LINES = 1850  # JavaScript lines of the web page, counted like Python
MAX_FUNCTION_LINES = 80
MAX_POSITIONAL = 8
MIN_LINES = 80  # smallest module with a single importer; a smaller one belongs into its importer

# Entry points: small modules with a single importer that are no part of it.
SMALL = {"progdf.__main__"}

Graph = dict[str, set[str]]


def source_files() -> list[Path]:
    """Return all Python files of the packages, relative to the repository."""
    return sorted(path.relative_to(ROOT) for name in PACKAGES for path in (ROOT / name).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def place(path: Path) -> str:
    """Return the folder of a module inside its package, or the module itself at the top level."""
    return path.parts[1] if len(path.parts) > 2 else path.stem


def imported_modules(source: str, module: str, is_package: bool) -> list[tuple[int, str]]:
    """Return the line and absolute name of every import, including those for type checkers."""
    found: list[tuple[int, str]] = []
    home = module.split(".") if is_package else module.split(".")[:-1]

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            found.extend((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = home[: len(home) - node.level + 1] if node.level else []
            base += [node.module] if node.module else []
            found.extend((node.lineno, ".".join([*base, alias.name])) for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(parse(source))
    return found


def strings(source: str) -> set[str]:
    """Return every string constant with a dot. A dotted module name among them is a hidden import."""
    nodes = ast.walk(parse(source))
    return {
        n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str) and "." in n.value
    }


def import_graph(files: Mapping[Path, str]) -> Graph:
    """Return the modules that each module imports, from paths and their source."""
    names = {module_name(path) for path in files}
    graph: Graph = {}
    for path, source in files.items():
        module = module_name(path)
        targets = set()
        for _, name in imported_modules(source, module, path.stem == "__init__"):
            known = name if name in names else name.rpartition(".")[0]
            if known in names and known != module:
                targets.add(known)
        if path.as_posix() not in LAZY_TABLES:
            targets |= {text for text in strings(source) if text in names and text != module}
        graph[module] = targets
    return graph


def import_cycle(graph: Graph) -> list[str]:
    """Return the modules of one import cycle, or an empty list."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def forbidden_imports(source: str, package: str, where: str) -> list[str]:
    """Return the imports in `source` that its package must not make, as `where:line imports module`."""
    found = []
    for node in ast.walk(parse(source)):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            modules = [node.module or ""]
        else:
            continue
        found += [
            f"{where}:{node.lineno} imports {name}"
            for name in modules
            if name.split(".")[0] in FORBIDDEN[package]
        ]
    return found


def upward_imports(package: str, order: list[str], files: Mapping[Path, str]) -> list[str]:
    """Return the imports inside a package that go against its order, as `module imports module`."""
    mine = {path: source for path, source in files.items() if path.parts[0] == package}
    places = {module_name(path): place(path) for path in mine}
    return [
        f"{module} imports {target}"
        for module, targets in import_graph(mine).items()
        for target in sorted(targets)
        if order.index(places[target]) > order.index(places[module])
    ]


@pytest.fixture(scope="module")
def sources() -> dict[Path, str]:
    return {path: (ROOT / path).read_text(encoding="utf-8") for path in source_files()}


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_packages_do_not_import_forbidden_modules(package: str, sources: dict[Path, str]) -> None:
    offending = [
        line
        for path, source in sources.items()
        if path.parts[0] == package and ROOT / path != ENTRY_POINT
        for line in forbidden_imports(source, package, path.as_posix())
    ]
    assert not offending, "\n".join(offending)


def test_package_check_names_a_forbidden_import() -> None:
    assert forbidden_imports("import viewer.app.app\n", "trainer", "trainer/x.py") == [
        "trainer/x.py:1 imports viewer.app.app"
    ]
    assert forbidden_imports("def f():\n    from trainer import pgs\n", "viewer", "viewer/y.py")


def test_modules_have_no_import_cycles(sources: dict[Path, str]) -> None:
    cycle = import_cycle(import_graph(sources))
    assert not cycle, " → ".join(cycle)


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_import_one_way(package: str, sources: dict[Path, str]) -> None:
    order = ORDER[package].split()
    found = {place(path) for path in sources if path.parts[0] == package}
    assert found == set(order), f"the order of {package} names other folders and files than there are"
    upward = upward_imports(package, order, sources)
    assert not upward, "\n".join(upward)


def test_import_checks_find_cycles_and_upward_imports() -> None:
    files = {
        Path("progdf/a/one.py"): "from progdf.b.two import x\n",
        Path("progdf/b/two.py"): "def f():\n    from ..a import one\n",
        Path("progdf/c/four.py"): "from progdf.b import three\n",
    }
    assert set(import_cycle(import_graph(files))) == {"progdf.a.one", "progdf.b.two"}
    assert upward_imports("progdf", ["b", "a", "c"], files) == ["progdf.b.two imports progdf.a.one"]
    files = {
        Path("progdf/b/three.py"): "if TYPE_CHECKING:\n    from progdf.c.four import y\n",
        Path("progdf/c/four.py"): "from progdf.b import three\n",
    }
    assert set(import_cycle(import_graph(files))) == {"progdf.b.three", "progdf.c.four"}, "type checkers' too"
    files = {
        Path("progdf/b/three.py"): 'importlib.import_module("progdf.c.four")\n',
        Path("progdf/c/four.py"): "from progdf.b import three\n",
    }
    assert set(import_cycle(import_graph(files))) == {"progdf.b.three", "progdf.c.four"}, "names in texts too"


def unsafe_starts(source: str, where: str) -> list[str]:
    """Return the starts of Python that would run modules of the current folder, as `where:line`."""
    tree = parse(source)
    safe = {
        word
        for words in ast.walk(tree)
        if isinstance(words, ast.List)
        for word, option in pairwise(words.elts)
        if isinstance(option, ast.Constant) and option.value in ("-P", "-I")
    }
    found = []
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        starts = any(name.split(".")[0] in ("multiprocessing", "runpy") for name in names)
        starts |= "ProcessPoolExecutor" in names or "executable" in names
        if isinstance(node, ast.Attribute):
            starts = node.attr == "executable" and node not in safe
            starts |= node.attr.startswith(("exec", "spawn", "posix_spawn")) and is_os(node.value)
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            starts = Path(node.value).name in ("python", "python3", "python.exe", "progdf.exe")
        if starts:
            found.append(f"{where}:{node.lineno}")  # type: ignore[attr-defined]
    return found


def is_os(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id == "os"


def test_started_python_runs_no_code_of_the_current_folder(sources: dict[Path, str]) -> None:
    unsafe = [where for path, source in sources.items() for where in unsafe_starts(source, path.as_posix())]
    assert not unsafe, f"give -P: {unsafe}"
    assert sum("sys.executable" in source for source in sources.values()) >= 5, "and these were looked at"


@pytest.mark.parametrize(
    "code",
    [
        'run([sys.executable, "-m", "progdf"])',
        'words = [sys.executable, *options, "-P"]',
        "run(command, executable=sys.executable)",
        "from sys import executable",
        "import multiprocessing.pool",
        'os.execv(path, ["-P"])',
        'run(["python3", "-P"])',
    ],
)
def test_check_of_started_python_sees_each_way(code: str) -> None:
    assert unsafe_starts(code, "x.py") == ["x.py:1"]
    assert unsafe_starts('run([sys.executable, "-P", "-m", "progdf"])', "x.py") == []


# Position of the scene's origin among the arguments of functions that read or write cameras.
ORIGIN_AT = {
    "load_cameras": 1,
    "read_camera": 1,
    "load_cameras_with_report": 1,
    "camera_in_picture": 1,
    "save_cameras": 2,
    "cameras_to_json": 2,
    "camera_chunk": 2,
    "find_picture_camera": 2,
    "stored_picture_camera": 2,
    "save_picture_camera": 2,
    "picture_cameras": 2,
    "rendered_cameras": 2,
}


def calls_without_origin(source: str, where: str) -> list[str]:
    """Return the calls that would confuse a camera of the world with a camera of the scene."""
    found = []
    for node in ast.walk(parse(source)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func).rpartition(".")[2]
            given = len(node.args) > ORIGIN_AT.get(name, -1) or any(k.arg == "origin" for k in node.keywords)
            found += [] if given else [f"{where}:{node.lineno} {name}"]
    return found


def test_camera_files_are_read_and_written_with_the_scene_origin(sources: dict[Path, str]) -> None:
    assert [
        line for path, source in sources.items() for line in calls_without_origin(source, str(path))
    ] == []


def test_origin_check_sees_a_call_without_origin() -> None:
    assert calls_without_origin("load_cameras(path)\nx.read_camera(text, scene.origin)", "a.py") == [
        "a.py:1 load_cameras"
    ]


def test_folders_hold_a_limited_number_of_files(sources: dict[Path, str]) -> None:
    # an `__init__` with only a docstring does not count
    filled = [path for path, source in sources.items() if len(parse(source).body) > 1]
    files = Counter(path.parent.as_posix() for path in filled)
    shaders = Counter(path.parent.as_posix() for path in (ROOT / "shaders").rglob("*.*"))
    full = sorted(folder for folder, count in (files + shaders).items() if count > MAX_FILES)
    assert not full, f"more than {MAX_FILES} files: {full}"


def test_files_have_a_limited_number_of_lines(sources: dict[Path, str]) -> None:
    lengths = {path.as_posix(): source.count("\n") for path, source in sources.items()}
    long = sorted(name for name, lines in lengths.items() if lines > LONG_FILES.get(name, MAX_LINES))
    assert not long, f"more than {MAX_LINES} lines: {long}"


def preset_tests(source: str, where: str) -> list[str]:
    """Return the comparisons with the preset "paper", as `where:line`."""
    return [
        f"{where}:{node.lineno}"
        for node in ast.walk(parse(source))
        if isinstance(node, ast.Compare) and re.search(r"preset\b.*'paper'", ast.unparse(node))
    ]


def test_trainer_dispatches_by_preset_only_through_its_table(sources: dict[Path, str]) -> None:
    asking = [
        line
        for path, source in sources.items()
        if path.parts[0] == "trainer"
        for line in preset_tests(source, path.as_posix())
    ]
    assert not asking, f"give `METHODS` of trainer/methods.py another field: {asking}"
    assert preset_tests('if plan.preset == "paper":\n    pass\n', "x.py") == ["x.py:1"]


def test_page_does_not_import_the_window(sources: dict[Path, str]) -> None:
    """Check that the page needs only the library and the shaders, so that a notebook can show it too."""
    graph = import_graph(sources)
    page = [module for module in graph if module.startswith("viewer.web")]
    assert page
    others = {target for module in page for target in graph[module] if not target.startswith("viewer.web")}
    assert {target.split(".")[0] for target in others} == {"progdf"}


def test_page_script_keeps_its_line_budget() -> None:
    files = sorted((ROOT / "viewer" / "web" / "src").glob("*.js"))
    lines = [line.strip() for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    code = [line for line in lines if line and not line.startswith(("//", "import "))]
    assert 0 < len(code) <= MAX_SCRIPT_LINES
    assert max(map(len, lines)) <= 130


@pytest.fixture(scope="module")
def measured() -> dict[str, list[Module]]:
    return {package: modules(package) for package in MEASURED}


def test_imports_are_a_small_share_of_all_lines(measured: dict[str, list[Module]]) -> None:
    lines = sum(module.lines for group in measured.values() for module in group)
    imports = sum(module.imports for group in measured.values() for module in group)
    assert imports <= MAX_IMPORTS * lines, f"{imports / lines:.1%} of all lines are imports"


def test_files_have_a_limited_number_of_imports(measured: dict[str, list[Module]]) -> None:
    counts = {
        module.path.as_posix(): sum(
            isinstance(node, ast.Import | ast.ImportFrom) for node in module.tree.body
        )
        for group in measured.values()
        for module in group
    }
    wide = {name: count for name, count in counts.items() if count > MAX_FILE_IMPORTS}
    assert not wide, f"more than {MAX_FILE_IMPORTS} imports in a file: {wide}"


def test_small_module_with_one_importer_belongs_to_it(measured: dict[str, list[Module]]) -> None:
    everything = {dotted(module.path): module for group in measured.values() for module in group}
    alone = {
        name: users
        for name, users in importers(everything).items()
        if len(users) == 1 and everything[name].lines < MIN_LINES and name not in SMALL
    }
    assert not alone, "\n".join(f"{name} belongs into {next(iter(users))}" for name, users in alone.items())


def test_functions_fit_on_a_screen(measured: dict[str, list[Module]]) -> None:
    sizes = [size for group in measured.values() for module in group for size in functions(module)]
    assert not [where for size, where in sizes if size > MAX_FUNCTION_LINES]


def test_calls_with_many_arguments_use_keywords(measured: dict[str, list[Module]]) -> None:
    everything = [*measured.values(), modules("benchmarks")]
    wide = [call for group in everything for module in group for call in calls(module)]
    # compiled kernels take their arrays by position, and a table of ranges has one row per argument
    plain = [
        (size, where) for size, where in wide if "rasterize/cpu" not in where and "check_ranges" not in where
    ]
    assert not [where for size, where in plain if size > MAX_POSITIONAL]


def test_functions_are_verbs_or_nouns_never_bare_participles(measured: dict[str, list[Module]]) -> None:
    bare = [
        where
        for group in measured.values()
        for module in group
        for _, where in functions(module)
        if re.fullmatch(
            r"_?(?!around|ground|field)[a-z]+(ed|ept|eld|own|ound)", where.rsplit(" ", 1)[1].lstrip("_")
        )
    ]
    assert not bare


def test_documented_module_tree_is_up_to_date() -> None:
    page = (ROOT / "docs" / "modules.md").read_text(encoding="utf-8")
    assert page == with_tree(page), "run python -m tests.helpers.sizes --tree"


def test_builders_draw_the_same_numbers_on_every_processor() -> None:
    """Check that helpers avoid torch's normal numbers, whose last bits differ between processors."""
    drawing = re.compile(r"torch\.(rand|normal)|\.(normal_|uniform_)\(")
    builders = sorted((ROOT / "tests" / "helpers").glob("*.py"))
    assert builders
    assert [path.name for path in builders if drawing.search(path.read_text(encoding="utf-8"))] == []


def test_wheel_and_sdist_hold_the_right_packages() -> None:
    targets = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["packages"] == ["progdf", "viewer", "trainer", "shaders"]
    assert {"benchmarks", "tests", "assets", "docs", "README.md", "LICENSE"} <= set(
        targets["sdist"]["include"]
    )


FRESH = f"""
import importlib, json, pkgutil, sys
import progdf, progdf.rasterize
found = {{"compilers": sorted({{"numba", "llvmlite"}} & set(sys.modules))}}
import trainer
for package in (progdf, trainer):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
found["windows"] = sorted({{name.split(".")[0] for name in sys.modules}} & {FORBIDDEN["trainer"]!r})
import viewer.commands.export, viewer.commands.render
found["interfaces"] = [name for name in sys.modules if "imgui" in name or name == "glfw"]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, list[str]], Path]:
    """Return what imports alone load in a separate process, and its folder for compiled kernels."""
    cache = tmp_path_factory.mktemp("fresh") / "cache"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    run = subprocess.run(
        [sys.executable, "-c", FRESH], capture_output=True, text=True, cwd=ROOT, env=environment
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout), cache


def test_importing_progdf_does_not_load_the_compiler(fresh: tuple[dict[str, list[str]], Path]) -> None:
    assert fresh[0]["compilers"] == []


def test_progdf_and_trainer_load_no_window_system(fresh: tuple[dict[str, list[str]], Path]) -> None:
    assert fresh[0]["windows"] == []


def test_headless_rendering_needs_no_interface_library(
    fresh: tuple[dict[str, list[str]], Path],
) -> None:
    assert fresh[0]["interfaces"] == []


def test_importing_the_kernels_writes_nothing(fresh: tuple[dict[str, list[str]], Path]) -> None:
    assert not fresh[1].exists()
