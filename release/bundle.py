"""Build the desktop bundle of this system by PyInstaller, and try it.

    python -m release.bundle [--archive NAME] [--out build/bundle] [--try-only]

Needs an environment with the wheel of progdf-studio and PyInstaller, and none of the extras. With the bundle
alone it trains an edit of the example scene and writes its page. Build on the oldest Linux that it must
run on: the C library of that system is the minimum.
"""

from __future__ import annotations

import argparse
import compileall
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from py_compile import PycInvalidationMode

from .packages import MIN_PAGE_BYTES, ROOT, TRAINING

MAX_ARCHIVE_BYTES = 450_000_000
SOURCES = ("progdf", "trainer", "viewer", "shaders")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return 0, or 1 at the first failed step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--archive", help="name of the archive to write beside the bundle, without an ending")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bundle", help="folder of the bundle")
    parser.add_argument("--try-only", action="store_true", help="try the bundle that is there")
    options = parser.parse_args(argv)
    out = options.out.resolve()
    try:
        if not options.try_only:
            build(out)
        attempt(program_of(out))
        print(f"unpacked: {size_of(out / 'progdf-studio') / 1e6:.0f} MB")
        if options.archive:
            archive(out, options.archive)
    except (subprocess.CalledProcessError, ValueError, OSError) as error:
        print(f"failed: {error}\n{getattr(error, 'stdout', '') or ''}", file=sys.stderr)
        return 1
    return 0


def build(out: Path) -> None:
    """Build the bundle into a folder, and compile the Python sources in it."""
    shutil.rmtree(out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as work:
        # elsewhere than in the checkout, whose packages would hide the installed ones
        for name in ("program.py", "bundle.spec"):
            shutil.copyfile(ROOT / "release" / name, Path(work, name))
        command = [sys.executable, "-P", "-m", "PyInstaller", "--noconfirm", "--log-level", "WARN"]
        command += ["--distpath", str(out), "--workpath", str(Path(work, "build")), "bundle.spec"]
        subprocess.run(command, cwd=work, env=_environment(), check=True)
    folders = [path.parent for name in SOURCES for path in out.glob(f"**/{name}/__init__.py")]
    for folder in folders:
        compileall.compile_dir(folder, quiet=1, invalidation_mode=PycInvalidationMode.UNCHECKED_HASH)


def program_of(out: Path) -> Path:
    """Return the program of a built bundle."""
    return out / "progdf-studio" / ("progdf.exe" if sys.platform == "win32" else "progdf")


def attempt(program: Path) -> None:
    """Train an edit of the example scene with the bundle, and write its page.

    Raises:
        CalledProcessError: a step failed.
        ValueError: the page is too small to hold the scene.
    """
    example = next(program.parent.glob("**/bear.progdf/bear.compressed.ply"))
    with tempfile.TemporaryDirectory(prefix="progdf-bundle-") as name:
        folder = Path(name)
        shutil.copyfile(example, folder / "bear.ply")
        started = time.monotonic()
        _run([str(program), "train", "bear.ply", "--out", "blue", *TRAINING], folder)
        print(f"trained in {time.monotonic() - started:.0f} s, with the compilation of the kernels")
        _run([str(program), "export", "bear.ply", "blue/blue.gdf", "-o", "page.html"], folder)
        page_bytes = (folder / "page.html").stat().st_size
        if page_bytes < MIN_PAGE_BYTES:
            raise ValueError(f"the page has {page_bytes} bytes, less than the {MIN_PAGE_BYTES} of the scene")


def _run(command: Sequence[str], folder: Path) -> None:
    """Run the bundle with new caches."""
    subprocess.run(
        command,
        cwd=folder,
        env=_environment() | {"NUMBA_CACHE_DIR": str(folder / "kernels")},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=True,
        text=True,
        encoding="utf-8",
        errors="replace",
    )


def _environment() -> dict[str, str]:
    """Return the environment without settings of Python, such as a path to the checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def archive(out: Path, name: str) -> None:
    """Pack the bundle: a .zip for Windows, else a .tar.gz, of the .app on macOS.

    Raises:
        ValueError: the archive is larger than `MAX_ARCHIVE_BYTES`.
    """
    apps = list(out.glob("*.app"))
    kind = "zip" if sys.platform == "win32" else "gztar"
    content = apps[0].name if apps else "progdf-studio"
    packed = Path(shutil.make_archive(str(out / name), kind, out, content))
    print(f"{packed.name}: {packed.stat().st_size / 1e6:.0f} MB")
    if packed.stat().st_size > MAX_ARCHIVE_BYTES:
        raise ValueError(f"the archive is larger than {MAX_ARCHIVE_BYTES / 1e6:.0f} MB")


def size_of(folder: Path) -> int:
    """Return the size of all files of a folder, in bytes; links count nothing."""
    return sum(
        path.lstat().st_size for path in folder.rglob("*") if not path.is_dir() and not path.is_symlink()
    )


if __name__ == "__main__":
    sys.exit(main())
