"""Run as a script of its own: the cameras of a COLMAP model as JSON on stdout, within bounds.

    python -P colmap_child.py FOLDER MEMORY SECONDS

pycolmap believes what a file says of its own length: a few hundred bytes keep it busy for hours, where no
Ctrl-C reaches. So it works in a process with so much memory (bytes, beyond what it has when it begins) and
processor time (seconds). Nothing of progdf is imported, as that would take seconds. A broken model: exit 3.
"""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path


def main(folder: str, memory: int, seconds: int) -> None:
    import pycolmap

    if sys.platform != "win32":  # which has no such limits: the time limit of the caller has to do there
        import resource

        with suppress(OSError, ValueError):  # macOS has no /proc, and takes no RLIMIT_AS
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            most = pages * resource.getpagesize() + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    model = pycolmap.Reconstruction(folder)
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    table = [
        {
            "name": image.name,
            "pose": image.cam_from_world().matrix().tolist(),
            "K": image.camera.calibration_matrix().tolist(),
            "width": image.camera.width,
            "height": image.camera.height,
            "model": image.camera.model.name,
            "params": [float(number) for number in image.camera.params],
        }
        for image in images
    ]
    sys.stdout.write(json.dumps(table))


if __name__ == "__main__":
    try:
        main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
    except Exception as error:  # reported by the caller
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(3)
