"""List the core dependencies that have no wheel for a system and Python: pip compiles those on installation.

    python -m release.wheels [--python 3.11 3.14] [--system NAME …]

Needs uv, which resolves for another system; nothing is downloaded but metadata.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.tags import Tag, compatible_tags, cpython_tags, mac_platforms
from packaging.utils import InvalidWheelFilename, parse_wheel_filename

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class System:
    """A system that packages are resolved for."""

    target: str  # name of the system for `uv pip compile --python-platform`
    platforms: tuple[str, ...]  # platform tags of the wheels that it accepts
    supported: bool = True


def _linux(machine: str) -> System:
    minors = range(39, 4, -1)  # glibc 2.39 of Ubuntu 24.04 and older
    older = ("manylinux2014", "manylinux2010", "manylinux1")
    tags = [f"manylinux_2_{minor}_{machine}" for minor in minors] + [f"{name}_{machine}" for name in older]
    return System(f"{machine}-manylinux_2_39", (*tags, f"linux_{machine}"))


SYSTEMS = {
    "Linux x86-64": _linux("x86_64"),
    "Linux aarch64": _linux("aarch64"),
    "Windows x86-64": System("x86_64-pc-windows-msvc", ("win_amd64",)),
    "Windows arm64": System("aarch64-pc-windows-msvc", ("win_arm64",), supported=False),
    "macOS 14 Apple silicon": System("aarch64-apple-darwin", tuple(mac_platforms((14, 0), "arm64"))),
    "macOS 14 Intel": System("x86_64-apple-darwin", tuple(mac_platforms((14, 0), "x86_64")), supported=False),
}
"""Name → system."""

RESOLVER_VARIABLES = {"MACOSX_DEPLOYMENT_TARGET": "14.0"}  # uv's default is macOS 13, for older releases


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return 0, or 1 if a dependency cannot be had at all on a supported system."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", nargs="+", default=["3.11", "3.14"], help="Python versions")
    parser.add_argument("--system", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    options = parser.parse_args(argv)
    failed = False
    print(
        "| system | Python | torch | packages | compiled on installation |\n| --- | --- | --- | --- | --- |"
    )
    for name in options.system:
        for python in options.python:
            row = describe(SYSTEMS[name], python)
            failed |= row is None and SYSTEMS[name].supported
            print(f"| {name} | {python} | {row or 'no release | | '} |", flush=True)
    return int(failed)


def describe(system: System, python: str) -> str | None:
    """Return the cells of torch, the number of packages and those without a wheel; None without torch.

    Args:
        system: a value of `SYSTEMS`
        python: version, such as "3.14"
    """
    packages = resolve(system, python)
    if packages is None:
        return None
    tags = frozenset(accepted_tags(system, python))
    missing = [package["name"] for package in packages if not has_wheel(package, tags)]
    if "torch" in missing:  # has no sdist either
        return None
    versions = {package["name"]: package["version"] for package in packages}
    return f"{versions['torch']} | {len(packages)} | {', '.join(missing) or 'none'}"


def resolve(system: System, python: str) -> list[dict[str, Any]] | None:
    """Return the packages of an installation, as in a pylock.toml; None if they cannot be resolved."""
    with tempfile.TemporaryDirectory() as name:
        lock = Path(name) / "pylock.toml"
        command = ["uv", "pip", "compile", "-q", "--format", "pylock.toml", "-o", str(lock)]
        command += ["--python-platform", system.target, "--python-version", python]
        command.append(str(ROOT / "pyproject.toml"))
        environment = {**os.environ, **RESOLVER_VARIABLES}
        ended = subprocess.run(command, env=environment, capture_output=True, check=False)
        if ended.returncode != 0:
            reason = ended.stderr.decode(errors="replace").splitlines()
            print(*(line.strip() for line in reason if "Because" in line), file=sys.stderr)
            return None
        packages: list[dict[str, Any]] = tomllib.loads(lock.read_text(encoding="utf-8"))["packages"]
        return packages


def accepted_tags(system: System, python: str) -> Iterator[Tag]:
    """Yield the tags of the wheels that CPython of a version accepts on a system."""
    major, minor = map(int, python.split("."))
    yield from cpython_tags((major, minor), platforms=system.platforms)
    yield from compatible_tags((major, minor), f"cp{major}{minor}", system.platforms)


def has_wheel(package: dict[str, Any], tags: frozenset[Tag]) -> bool:
    """Return whether a package of a pylock.toml has a wheel with one of these tags."""
    for wheel in package.get("wheels", ()):
        file_name = wheel.get("name") or wheel["url"].rpartition("/")[2]
        try:
            _, _, _, found = parse_wheel_filename(file_name)
        except InvalidWheelFilename:
            continue
        if found & tags:
            return True
    return False


if __name__ == "__main__":
    sys.exit(main())
