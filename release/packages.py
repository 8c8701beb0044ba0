"""Build the sdist and the wheel, and try them in empty environments.

    python -m release.packages [--python PYTHON …] [--installer pip|uv|uv-tool|pipx …] [--out dist]
    python -m release.packages --build-only
    python -m release.packages --wheel dist/….whl [--python PYTHON …]

1. Build the sdist, and the wheel from the unpacked sdist.
2. Check both with twine, and that the wheel equals the one from the checkout.
3. Per Python and installer: install the wheel with its dependencies, train an edit of the example scene, and
   write it as a page. Caches are new, so the training also compiles the kernels.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXAMPLE = "viewer/examples/bear.progdf/bear.compressed.ply"
TRAINING = (
    "--region",
    "subject",
    "--editor",
    "recolor:#3060d0",
    "--quick",
    "--report",
    "none",
    "--seed",
    "0",
)
MIN_PAGE_BYTES = 100_000  # a page without its scene is smaller

INHERITED = (
    *("PATH", "HOME", "LANG", "TMPDIR", "SYSTEMROOT", "USERPROFILE", "LOCALAPPDATA"),
    *("SSL_CERT_FILE", "SSL_CERT_DIR", "HTTPS_PROXY", "NO_PROXY"),
)
"""Environment variables that an empty environment inherits, besides those of pip and uv."""


@dataclass(frozen=True)
class Trial:
    """Result of one installation."""

    python: str  # version, such as "3.14.2"
    installer: str
    install_s: float
    train_s: float  # includes the compilation of the kernels
    page_bytes: int

    def row(self) -> str:
        """Return the result as a row of a Markdown table."""
        page = f"{self.page_bytes / 1e6:.1f} MB"
        return (
            f"| {self.python} | {self.installer} | {self.install_s:.0f} s | {self.train_s:.0f} s | {page} |"
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return 0, or 1 at the first failed step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters to install into")
    parser.add_argument(
        "--installer", nargs="+", default=["pip"], choices=sorted(INSTALLERS), help="installers to try"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the built packages")
    parser.add_argument("--wheel", type=Path, help="try this wheel instead of building")
    parser.add_argument("--build-only", action="store_true", help="build and check, install nothing")
    options = parser.parse_args(argv)
    try:
        wheel = options.wheel or build(options.out)
        if options.build_only:
            return 0
        print("| Python | installer | install | train | page |\n| --- | --- | --- | --- | --- |", flush=True)
        for python in options.python:
            for installer in options.installer:
                print(attempt(wheel, python, installer).row(), flush=True)
    except (subprocess.CalledProcessError, ValueError, OSError) as error:
        print(f"failed: {error}\n{getattr(error, 'stdout', '') or ''}", file=sys.stderr)
        return 1
    return 0


def build(out: Path) -> Path:
    """Build sdist and wheel into a folder, check them, and return the wheel.

    Raises:
        CalledProcessError: a build failed, or twine refuses a package.
        ValueError: the wheel from the sdist differs from the wheel of the checkout.
    """
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob("*.whl"), *out.glob("*.tar.gz")):
        old.unlink()
    run([sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(out.resolve())], ROOT)
    (sdist,) = out.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        (unpacked,) = folder.iterdir()
        run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out.resolve())], unpacked)
        run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", name], ROOT)
        (wheel,) = out.glob("*.whl")
        check_same_files(wheel, folder / wheel.name)
    run([sys.executable, "-m", "twine", "check", "--strict", str(sdist), str(wheel)], ROOT)
    return wheel


def check_same_files(first: Path, second: Path) -> None:
    """Raise ValueError unless two wheels hold the same files, byte for byte."""
    contents = []
    for path in (first, second):
        with zipfile.ZipFile(path) as archive:
            contents.append({info.filename: info.CRC for info in archive.infolist()})
    different = sorted(dict(contents[0].items() ^ contents[1].items()))
    if different:
        raise ValueError(f"the wheel of the sdist differs in {', '.join(different[:5])}")


def attempt(wheel: Path, python: str, installer: str) -> Trial:
    """Install a wheel into an empty environment, train an edit there and write its page.

    Args:
        wheel: the built wheel
        python: interpreter to install for
        installer: key of `INSTALLERS`

    Raises:
        CalledProcessError: a step failed.
        ValueError: the page is too small to hold the scene.
    """
    with tempfile.TemporaryDirectory(prefix="progdf-package-") as name:
        folder = Path(name)
        version = run([python, "-c", "import platform; print(platform.python_version())"], folder).strip()
        started = time.monotonic()
        program = str(INSTALLERS[installer](wheel.resolve(), python, folder))
        install_s = time.monotonic() - started
        run([program, "--version"], folder)
        with zipfile.ZipFile(wheel) as archive:
            (folder / "bear.ply").write_bytes(archive.read(EXAMPLE))
        started = time.monotonic()
        run([program, "train", "bear.ply", "--out", "blue", *TRAINING], folder)
        train_s = time.monotonic() - started
        run([program, "export", "bear.ply", "blue/blue.gdf", "-o", "page.html"], folder)
        page_bytes = (folder / "page.html").stat().st_size
        if page_bytes < MIN_PAGE_BYTES:
            raise ValueError(f"the page has {page_bytes} bytes, less than the {MIN_PAGE_BYTES} of the scene")
        return Trial(version, installer, install_s, train_s, page_bytes)


def _install_pip(wheel: Path, python: str, folder: Path) -> Path:
    run([python, "-m", "venv", "venv"], folder)
    run([str(_scripts(folder / "venv") / "python"), "-m", "pip", "install", "-q", str(wheel)], folder)
    return _scripts(folder / "venv") / "progdf"


def _install_uv(wheel: Path, python: str, folder: Path) -> Path:
    run(["uv", "venv", "-q", "--python", python, "venv"], folder)
    run(["uv", "pip", "install", "-q", "--python", str(folder / "venv"), str(wheel)], folder)
    return _scripts(folder / "venv") / "progdf"


def _install_uv_tool(wheel: Path, python: str, folder: Path) -> Path:
    run(["uv", "tool", "install", "-q", "--python", python, str(wheel)], folder)
    return folder / "bin" / "progdf"


def _install_pipx(wheel: Path, python: str, folder: Path) -> Path:
    run([sys.executable, "-m", "pipx", "install", "-q", "--python", python, str(wheel)], folder)
    return folder / "bin" / "progdf"


INSTALLERS: dict[str, Callable[[Path, str, Path], Path]] = {
    "pip": _install_pip,
    "uv": _install_uv,
    "uv-tool": _install_uv_tool,
    "pipx": _install_pipx,
}
"""Name → function that installs a wheel for an interpreter inside a folder and returns the program."""


def _scripts(venv: Path) -> Path:
    return venv / ("Scripts" if os.name == "nt" else "bin")


def run(command: Sequence[str], folder: Path) -> str:
    """Run a command in a folder, with the folder's own caches. Return its output.

    Raises:
        CalledProcessError: it failed; `stdout` has both streams.
    """
    known = {name: value for name, value in os.environ.items() if name.upper() in INHERITED}
    known |= {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "UV_"))}
    own = {
        "XDG_CACHE_HOME": str(folder / "cache"),
        "PIP_CACHE_DIR": os.environ.get("PIP_CACHE_DIR") or str(Path.home() / ".cache" / "pip"),
        "UV_CACHE_DIR": os.environ.get("UV_CACHE_DIR") or str(Path.home() / ".cache" / "uv"),
        "UV_TOOL_DIR": str(folder / "tools"),
        "UV_TOOL_BIN_DIR": str(folder / "bin"),
        "PIPX_HOME": str(folder / "pipx"),
        "PIPX_BIN_DIR": str(folder / "bin"),
        "PIPX_DEFAULT_BACKEND": "pip",
    }
    program = shutil.which(command[0]) or command[0]
    ended = subprocess.run(
        [program, *command[1:]],
        cwd=folder,
        env={**known, **own},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        check=True,
    )
    return ended.stdout


if __name__ == "__main__":
    sys.exit(main())
