"""Run as a script of its own: one scene file through gaussforge into another format, within bounds.

    python -P gaussforge_child.py FORMAT IN FORMAT OUT MEMORY OUTPUT SECONDS

Its native code reads files of strangers, so it works in a process that may crash, and that has no more
memory, output and time than it is given (bytes, bytes, seconds of processor time). Nothing of progdf is
imported, as that would take seconds. What is wrong is one line on stderr, exit 3.
"""

from __future__ import annotations

import io
import json
import sys
import zipfile
from contextlib import suppress
from pathlib import Path


def _bundle(meta: Path) -> bytes:
    """An unpacked .sog as the archive that it would be: meta.json and the images that it names.

    Raises:
        ValueError: an image is no regular file of the folder: a pipe is waited for, a link may lead out.
    """
    table = json.loads(meta.read_bytes())
    named = [name for part in table.values() if isinstance(part, dict) for name in part.get("files", ())]
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as out:
        out.writestr("meta.json", meta.read_bytes())
        for name in dict.fromkeys(map(str, named)):
            if Path(name).name != name:
                raise ValueError("meta.json names images outside its folder")
            image = meta.parent / name
            if image.is_symlink() or not image.is_file():
                raise ValueError(f"{name} is missing, a link or no regular file")
            out.writestr(name, image.read_bytes())
    return archive.getvalue()


def main(kind: str, source: str, to: str, target: str, memory: int, output: int, seconds: int) -> None:
    import gaussforge

    if sys.platform != "win32":  # which has no such limits: the time limit of the caller has to do there
        import resource

        limits = (
            (resource.RLIMIT_AS, memory),
            (resource.RLIMIT_FSIZE, output),
            (resource.RLIMIT_CPU, seconds),
            (resource.RLIMIT_CORE, 0),
        )
        for limit, most in limits:
            with suppress(ValueError, OSError):  # macOS takes no RLIMIT_AS
                resource.setrlimit(limit, (most, most))
    path = Path(source)
    content = _bundle(path) if path.name.lower() == "meta.json" else path.read_bytes()
    converted = gaussforge.GaussForge().convert(content, kind, to)
    if "data" not in converted:
        raise ValueError(str(converted.get("error", "it gives no scene")))
    Path(target).write_bytes(converted["data"])


if __name__ == "__main__":
    try:
        main(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4], *map(int, sys.argv[5:8]))
    except Exception as error:  # reported by the caller
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(3)
