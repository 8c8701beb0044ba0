"""Run as a script of its own, within bounds: what native code of others makes of a stranger's files.

    python -P native_child.py MEMORY OUTPUT SECONDS convert FORMAT IN FORMAT OUT   a scene by gaussforge
    python -P native_child.py MEMORY OUTPUT SECONDS cameras FOLDER                 a COLMAP model by pycolmap

Such code may crash on a broken file, or believe what it says of its own length: a few hundred bytes keep it
busy for hours, where no Ctrl-C reaches. So it works in a process with so much memory (bytes, beyond what it
has when it begins), output (bytes) and processor time (seconds). Nothing of progdf is imported, as that would
take seconds. What is wrong is one line on stderr, exit 3.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def _convert(kind: str, source: str, to: str, target: str) -> None:
    """Write a scene in another format."""
    import gaussforge

    path = Path(source)
    converted = gaussforge.GaussForge().convert(path.read_bytes(), kind, to)
    if "data" not in converted:
        raise ValueError(str(converted.get("error", "it gives no scene")))
    Path(target).write_bytes(converted["data"])


def _cameras(folder: str) -> None:
    """Write the cameras of a COLMAP model as JSON to stdout."""
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


def _limit(memory: int, output: int, seconds: int) -> None:
    if sys.platform == "win32":  # which has no such limits: the time limit of the caller has to do there
        return
    import resource

    limits = {resource.RLIMIT_FSIZE: output, resource.RLIMIT_CPU: seconds, resource.RLIMIT_CORE: 0}
    with suppress(OSError):  # macOS has no /proc, and takes no RLIMIT_AS
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory
    for limit, most in limits.items():
        with suppress(ValueError, OSError):
            resource.setrlimit(limit, (most, most))


def run(limits: tuple[int, int, int], timeout: int, *words: str) -> subprocess.CompletedProcess[bytes]:
    """Run this script: memory, output and seconds of processor time, how long to wait, what it shall do.

    Raises:
        TimeoutExpired: it did not end.
    """
    command = [sys.executable, "-P", __file__, *map(str, limits), *words]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout, check=False
    )


if __name__ == "__main__":
    converts = sys.argv[4] == "convert"
    try:
        __import__("gaussforge" if converts else "pycolmap")  # its own memory does not count
        _limit(*map(int, sys.argv[1:4]))
        _convert(*sys.argv[5:]) if converts else _cameras(*sys.argv[5:])
    except Exception as error:  # reported by the caller
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(3)
