"""The command `progdf doctor`: print what a bug report needs, and test drawing, training and a window.

Each test runs a command of this program in a process of its own. A driver that crashes, or a package that
cannot be imported, then fails one test and leaves the others running. For the same reason this module imports
the standard library only, except for folders and option parsing.
"""

from __future__ import annotations

import importlib
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import Literal

from progdf.io.atomic import cache_folder, state_folder
from progdf.system.desktop import has_display
from progdf.system.packages import DISTRIBUTION, broken_package, import_fault, install_again
from progdf.system.processes import usable_cores
from progdf.terminal import escape_text, file_size, format_count, print_line

COMPILE_LIMIT_S = 300.0
"""Time limit of a test that draws or trains, in seconds: the first one may compile kernels."""

START_LIMIT_S = 60.0
"""Time limit of the tests of window and card, in seconds: a display or a driver may never answer."""

GAUSSIANS = 600
"""Number of Gaussians of the test scene."""

LOW_MEMORY = 2 << 30
"""Available memory in bytes below which the report warns: training a large region takes 2 GB."""

LOW_SPACE = 1 << 30
"""Free disk space in bytes below which the report warns."""

VARIABLES = (
    *("OMP_WAIT_POLICY", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_CPU_NAME"),
    *("CUDA_VISIBLE_DEVICES", "LIBGL_ALWAYS_SOFTWARE", "MESA_LOADER_DRIVER_OVERRIDE"),
)
"""Environment variables that change speed or the choice of a driver."""

MODULES = {"pillow": "PIL"}
"""Required packages whose module has another name."""

_TRAINING = ("--region", "all", "--editor", "recolor:#3060d0", "--quick", "--report", "none", "--seed", "0")

Verdict = Literal["ok", "note", "FAILED"]


@dataclass(frozen=True)
class DoctorOptions:
    """Print what a bug report needs, and test drawing, training and a window, in about 20 seconds."""


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    verdict: Verdict
    subject: str  # part of the set-up, one word or two
    text: str  # what was found; for a failure also the reason

    def line(self) -> str:
        """Return the line as printed."""
        return f"{self.verdict:<7}{self.subject:<11}{self.text}"


@dataclass(frozen=True)
class Outcome:
    """Result of a command that ran in a process of its own."""

    status: int  # exit status; negative: ended by that signal
    seconds: float  # wall time
    output: str  # standard output
    reason: str  # last line of standard error, "" if there is none


def main(argv: Sequence[str]) -> int:
    """Run `progdf doctor`; return 0, or 2 if a test failed."""
    if argv:  # `--help` and errors; the parser itself needs a package that may be broken
        from .options import parse_options

        parse_options(DoctorOptions, argv, "progdf doctor")
    failures = 0
    for finding in examine():
        print_line(finding.line())
        failures += finding.verdict == "FAILED"
    if failures:
        print_line(f"{failures} failed; a bug report needs all lines above")
        return 2
    print_line("everything that was tested works")
    return 0


def examine() -> Iterator[Finding]:
    """Yield the findings in the order of the report; the tests come last."""
    yield from _check("progdf", lambda: [_system()])
    yield from _check("packages", _packages)
    yield from _check("extras", lambda: [_extras()])
    yield from _check("processor", lambda: [_processor()])
    yield from _check("memory", lambda: [_memory()])
    yield from _check("cache", lambda: [_folder("cache", cache_folder())])
    yield from _check("state", lambda: [_folder("state", state_folder())])
    yield from _check("temporary", _tests)


def _check(subject: str, check: Callable[[], Iterable[Finding]]) -> Iterator[Finding]:
    """Yield the findings of a check. If it fails itself, that is its finding, and the next ones run."""
    try:
        yield from check()
    except Exception as error:
        if package := broken_package(error):
            yield Finding("FAILED", subject, _import_failure(package, import_fault(error)))
        elif isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            yield Finding("FAILED", subject, f"{where}{error.strerror or error}")
        else:
            yield Finding("FAILED", subject, import_fault(error))


def _tests() -> Iterator[Finding]:
    """Yield the findings of the tests. Most share a scene in a temporary folder."""
    with ExitStack() as stack:
        tests: tuple[Callable[[Path], Finding], ...] = (_drawing, _opengl, _window, _training, _card)
        scene = Path()
        try:
            folder = tempfile.TemporaryDirectory(prefix="progdf-doctor-", ignore_cleanup_errors=True)
            scene = Path(stack.enter_context(folder)) / "ball.ply"
            scene.write_text(ball_of_gaussians(GAUSSIANS), encoding="ascii")
        except OSError as error:
            where = scene.parent if scene.name else "a temporary folder"
            reason = error.strerror or error
            yield Finding("FAILED", "temporary", f"{where} cannot be written: {reason}")
            tests = (_window, _card)
        for test in tests:
            yield test(scene)


def _system() -> Finding:
    own_version = _version_of(DISTRIBUTION) or "not installed"
    python = f"Python {platform.python_version()}"
    return Finding("ok", "progdf", f"{own_version}, {python}, {platform.platform()}")


def _packages() -> Iterator[Finding]:
    """Report the versions of the required packages; a missing or a broken one is a failure."""
    names = [name for name, extra in _requirements() if not extra]
    versions = {name: _version_of(name) for name in names}
    missing = [name for name, found in versions.items() if found is None]
    faults = _import_faults([MODULES.get(name, name.replace("-", "_")) for name in names if versions[name]])
    if missing:
        yield Finding("FAILED", "packages", f"{', '.join(missing)} missing; {install_again()}")
    for package, fault in faults.items():
        yield Finding("FAILED", "packages", _import_failure(package, fault))
    if not missing and not faults:
        yield Finding("ok", "packages", ", ".join(f"{name} {found}" for name, found in versions.items()))


def _import_faults(modules: Sequence[str]) -> dict[str, str]:
    """Import modules in a process of its own. Return the packages that cannot be imported, and why."""
    made = _run("import-test", *modules, limit_s=START_LIMIT_S)
    results = [line.split(" ", 2) for line in made.output.splitlines()]
    faults = {package: fault for _, package, fault in results if fault != "ok"}
    if len(results) < len(modules):  # a module ended the process
        faults.setdefault(modules[len(results)], _ending(made))
    return faults


def import_packages(argv: Sequence[str]) -> int:
    """Run the internal command `import-test`: import the named modules, and print a line for each.

    A line has the module, the package at fault and the reason, or twice the module and ok.
    """
    for name in argv:
        package = name
        fault = "ok"
        try:
            importlib.import_module(name)
        except BaseException as error:  # a package may raise SystemExit
            package = broken_package(error) or name
            fault = import_fault(error)
        print(escape_text(f"{name} {package} {fault}"), flush=True)  # now, as the next one may crash
    return 0


def _import_failure(package: str, fault: str) -> str:
    return f"the package {package} cannot be imported ({fault}); {install_again()}"


def _extras() -> Finding:
    """Report which optional parts are complete."""
    parts: dict[str, list[str]] = {}
    for name, extra in _requirements():
        if extra and extra != "dev":
            parts.setdefault(extra, []).append(name)
    installed = [extra for extra, names in parts.items() if all(map(_version_of, names))]
    absent = [extra for extra in parts if extra not in installed]
    return Finding(
        "ok", "extras", f"{', '.join(installed) or 'none'}; not installed: {', '.join(absent) or 'none'}"
    )


def _requirements() -> list[tuple[str, str]]:
    """Return the packages that this one asks for, each with its extra or ""."""
    try:
        lines = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return []
    found = []
    for line in lines:
        name = re.split(r"[ ;<>=!~\[(]", line, maxsplit=1)[0]
        extra = re.search(r"extra == ['\"](.+?)['\"]", line)
        found.append((name, extra.group(1) if extra else ""))
    return found


def _version_of(name: str) -> str | None:
    """Return the version of an installed package, None if it is missing; nothing is imported."""
    try:
        return version(name) if metadata(name) else None
    except PackageNotFoundError:
        return None


def _processor() -> Finding:
    name = platform.processor() or platform.machine()
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        model = re.search(
            r"^model name\s*:\s*(.+)$", listing.read_text(encoding="utf-8", errors="replace"), re.MULTILINE
        )
        name = model.group(1) if model else name
    settings = [f"{key}={os.environ[key]}" for key in VARIABLES if key in os.environ]
    return Finding("ok", "processor", ", ".join([f"{name}, {usable_cores()} usable cores", *settings]))


def _memory() -> Finding:
    """Report the available memory where the system tells it."""
    listing = Path("/proc/meminfo")
    if not listing.is_file():
        return Finding("note", "memory", "this system does not tell how much is available")
    values = dict(re.findall(r"^(\w+):\s+(\d+) kB", listing.read_text(encoding="ascii"), re.MULTILINE))
    available = int(values.get("MemAvailable", 0)) * 1024
    text = f"{file_size(available)} of {file_size(int(values.get('MemTotal', 0)) * 1024)} available"
    if available < LOW_MEMORY:
        return Finding("note", "memory", f"{text}; large regions need 2 GB")
    return Finding("ok", "memory", text)


def _folder(subject: str, folder: Path) -> Finding:
    """Report a folder that the program writes, with the free space."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    except OSError as error:
        return Finding("note", subject, f"{folder} cannot be written: {error.strerror or error}")
    text = f"{folder}, {file_size(free)} free"
    if free < LOW_SPACE:
        return Finding("note", subject, f"{text}; a run with its pictures may need more")
    return Finding("ok", subject, text)


def _drawing(scene: Path) -> Finding:
    """Test the engine that trains and draws on the processor; the first call compiles its kernels."""
    made = _run("render", scene, "-o", scene.with_name("cpu.png"), "--engine", "cpu", "--size", "96x96")
    return _judge("drawing", made, f"{format_count(GAUSSIANS)} on the processor")


def _opengl(scene: Path) -> Finding:
    """Test OpenGL without a window."""
    made = _run("render", scene, "-o", scene.with_name("gl.png"), "--engine", "gl", "--size", "96x96")
    return _judge("OpenGL", made, f"{format_count(GAUSSIANS)} without a window")


def _window(scene: Path) -> Finding:
    """Test a window. A machine without a display is no failure: the other commands work on it."""
    made = _run("window-test", limit_s=START_LIMIT_S)
    if made.status == 2 and not has_display():
        return Finding("note", "window", "no display here; all commands except view work")
    return _judge("window", made, made.output.strip())


def _training(scene: Path) -> Finding:
    made = _run("train", scene, "--out", scene.with_name("run"), *_TRAINING)
    return _judge("training", made, "a recolor was trained and written")


def _card(scene: Path) -> Finding:
    """Report the CUDA card that torch finds."""
    made = _run("card-test", limit_s=START_LIMIT_S)
    return _judge("card", made, made.output.strip())


def describe_card(argv: Sequence[str]) -> int:
    """Run the internal command `card-test`: compute on the CUDA card that torch finds, and print its name."""
    import torch

    if not torch.cuda.is_available():
        print_line("none that torch can use; training runs on the processor")
        return 0
    torch.ones(8, device="cuda").sum().item()
    properties = torch.cuda.get_device_properties(0)
    engine = "with warp-lang" if _version_of("warp-lang") else "warp-lang is missing: install the extra gpu"
    print_line(f"{properties.name}, {file_size(properties.total_memory)}, {engine}")
    return 0


def _judge(subject: str, made: Outcome, success: str) -> Finding:
    if made.status == 0:
        return Finding("ok", subject, f"{success}, {made.seconds:.1f} s")
    return Finding("FAILED", subject, _ending(made))


def _ending(made: Outcome) -> str:
    """Return the reason for which a process failed."""
    ending = f"ended by signal {-made.status}" if made.status < 0 else f"exit status {made.status}"
    return made.reason.removeprefix("progdf: ") or ending


def _run(*arguments: str | Path, limit_s: float = COMPILE_LIMIT_S) -> Outcome:
    """Run a command of this program in a process of its own."""
    line = [sys.executable, "-P", "-m", "progdf", *map(str, arguments)]
    begun = time.perf_counter()
    try:
        made = subprocess.run(
            line, stdin=subprocess.DEVNULL, capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired as error:
        output = (error.stdout or b"").decode(errors="replace")
        return Outcome(-1, limit_s, output, f"not finished after {limit_s:.0f} s")
    except OSError as error:
        return Outcome(-1, 0.0, "", f"no process can be started: {error.strerror or error}")
    errors = made.stderr.decode(errors="replace").strip().splitlines()
    output = made.stdout.decode(errors="replace")
    return Outcome(made.returncode, time.perf_counter() - begun, output, errors[-1] if errors else "")


def ball_of_gaussians(count: int) -> str:
    """Return a 3DGS .ply file in ASCII with a colored ball of radius 1, made by the standard library alone.

    Args:
        count: number of Gaussians, spread evenly over the sphere along a Fibonacci spiral
    """
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format ascii 1.0", f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in names), "end_header"]
    log_scale = math.log(0.6 * math.sqrt(4.0 * math.pi / count))
    for row in range(count):
        y = 1.0 - (2.0 * row + 1.0) / count
        ring = math.sqrt(1.0 - y * y)
        turn = row * math.pi * (3.0 - math.sqrt(5.0))
        position = f"{ring * math.cos(turn):.6f} {y:.6f} {ring * math.sin(turn):.6f}"
        color = position  # each axis has its own channel
        lines.append(f"{position} {color} 3.0 {log_scale:.6f} {log_scale:.6f} {log_scale:.6f} 1 0 0 0")
    return "\n".join([*lines, ""])
