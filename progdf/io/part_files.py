"""Scenes in several files: multi-GPU trainings write one file per GPU."""

from __future__ import annotations

import re
from pathlib import Path

from progdf.errors import ProgdfError

from .file_rules import unsupported_error

_GSPLAT_PART = re.compile(r"(?P<head>.*[_-]rank)(?P<part>\d{1,4})(?P<tail>\.(?:pt|pth|ckpt))", re.I | re.S)
"""File names of gsplat, such as ckpt_29999_rank0.pt. They do not state the number of ranks."""

_GRENDEL_PART = re.compile(
    r"(?P<head>.*_rk)(?P<part>\d{1,4})(?P<tail>_ws(?P<count>\d{1,4})\.ply)", re.I | re.S
)
"""File names of Grendel-GS, such as point_cloud_rk0_ws4.ply. `ws` is the world size."""

_NUMBERED_PART = re.compile(
    r"(?:.*[_\-. ])?(?:part|shard|chunk|rank)[_\-. ]?(\d{1,5})[_\-. ]?of[_\-. ]?(\d{1,5})(?:[_\-. ].*)?"
    r"|.*[_\-. ](\d{5})-of-(\d{5})(?:[_\-. ].*)?",
    re.I | re.S,
)
"""Names such as room_part_1_of_3.ply or room-00001-of-00003.ply, split by a user or an unknown program."""

_GSPLAT_STEP = re.compile(r"ckpt_(\d{1,9})_rank", re.I)  # name of a gsplat checkpoint, with its training step


def part_files(path: Path) -> list[Path]:
    """Return all files of the scene that a file belongs to, in the order of their numbers.

    Raises:
        ProgdfError: one of the files is missing, or the name is that of a part in an unknown scheme.
    """
    match = _GSPLAT_PART.fullmatch(path.name) or _GRENDEL_PART.fullmatch(path.name)
    if match is None:
        _refuse_numbered_part(path)
        return [path]
    head = match["head"]
    tail = match["tail"]
    ranks = _numbers_between(path.parent, head, tail) | {int(match["part"])}
    declared = match.groupdict().get("count")
    count = int(declared) if declared else max(ranks) + 1
    step = _GSPLAT_STEP.fullmatch(head)
    if step is not None:
        stem = f"train_step{int(step[1]):04d}_rank"  # gsplat writes a report per rank beside the checkpoints
        reports = _numbers_between(path.parent.parent / "stats", stem, ".json")
        count = max(count, 1 + max(reports, default=0))
    missing = [path.with_name(f"{head}{rank}{tail}") for rank in range(count) if rank not in ranks]
    if missing:
        names = ", ".join(file.name for file in missing[:4])
        more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
        raise ProgdfError(
            f"{path} is one of {count} parts of a scene, a file per GPU of its training, and {names}{more} "
            "is missing; put all parts into one folder"
        )
    return [path.with_name(f"{head}{rank}{tail}") for rank in range(count)]


def _numbers_between(folder: Path, head: str, tail: str) -> set[int]:
    """Return the numbers in the names HEAD<number>TAIL of a folder; empty if there is no such folder."""
    pattern = re.compile(re.escape(head) + r"(0|[1-9]\d{0,3})" + re.escape(tail))
    try:
        matches = [pattern.fullmatch(file.name) for file in folder.iterdir()]
    except OSError:
        return set()
    return {int(match[1]) for match in matches if match}


def _refuse_numbered_part(path: Path) -> None:
    match = _NUMBERED_PART.fullmatch(path.stem)
    if match is None:
        return
    part, count = (int(number) for number in match.groups() if number is not None)
    if count > 1:
        remedy = "join the parts with `splat-transform PART… out.ply`, or rename this one to open it alone"
        raise unsupported_error(path, f"a name for part {part} of {count}", remedy)
