"""Script that runs third-party native code on untrusted files, with resource limits.

    python -P native_child.py MEMORY OUTPUT SECONDS convert FORMAT IN FORMAT OUT   scene, by gaussforge
    python -P native_child.py MEMORY OUTPUT SECONDS cameras FOLDER                 COLMAP model, by pycolmap

Native code may crash on a broken file, or trust a wrong length in it. A file of a few hundred bytes can keep
it busy for hours, and Ctrl-C does not interrupt it. The script therefore limits memory (bytes, on top of the
memory at the start), output (bytes) and processor time (seconds). It imports nothing from progdf, which would
take seconds. An error is one line on stderr, with exit status 3.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def _convert_scene(kind: str, source: str, to: str, target: str) -> None:
    """Convert a scene file to another format with gaussforge."""
    import gaussforge

    path = Path(source)
    converted = gaussforge.GaussForge().convert(path.read_bytes(), kind, to)
    if "data" not in converted:
        raise ValueError(str(converted.get("error", "it gives no scene")))
    Path(target).write_bytes(converted["data"])


def _print_cameras(folder: str) -> None:
    """Print the cameras of a COLMAP model as JSON to stdout."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    table = [
        {
            "name": image.name,
            "pose": image.cam_from_world().matrix().tolist(),
            "width": image.camera.width,
            "height": image.camera.height,
            "model": image.camera.model.name,
            "params": [float(number) for number in image.camera.params],
        }
        for _, image in sorted(model.images.items())
        if image.has_pose
    ]
    sys.stdout.write(json.dumps(table))


def _set_limits(memory: int, output: int, seconds: int) -> None:
    if sys.platform == "win32":  # has no such limits; only the timeout of the caller applies
        return
    import resource

    limits = {resource.RLIMIT_FSIZE: output, resource.RLIMIT_CPU: seconds, resource.RLIMIT_CORE: 0}
    with suppress(OSError):  # macOS has no /proc, and does not support RLIMIT_AS
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory
    for limit, maximum in limits.items():
        with suppress(ValueError, OSError):
            resource.setrlimit(limit, (maximum, maximum))


def run(limits: tuple[int, int, int], timeout: int, *words: str) -> subprocess.CompletedProcess[bytes]:
    """Run this script in a new process.

    Args:
        limits: memory in bytes, output in bytes, processor time in seconds
        timeout: wall-clock limit, seconds
        words: further arguments of the script, such as "cameras" and a folder

    Raises:
        TimeoutExpired: the process did not end in time.
    """
    command = [sys.executable, "-P", __file__, *map(str, limits), *words]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout, check=False
    )


if __name__ == "__main__":
    converts = sys.argv[4] == "convert"
    try:
        # imported before the limits, so that its own memory does not count
        __import__("gaussforge" if converts else "pycolmap")
        _set_limits(*map(int, sys.argv[1:4]))
        _convert_scene(*sys.argv[5:]) if converts else _print_cameras(*sys.argv[5:])
    except Exception as error:  # the caller reports it
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(3)
