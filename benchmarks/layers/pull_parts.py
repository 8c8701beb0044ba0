"""The benchmark `pull-parts`: rigid edges, holes, time and memory of pulled parts of real objects.

Each pull is written by `progdf edit`, like a user's, and its edit is measured.

    python -m benchmarks pull-parts --scenes playbot_31k.ply tarot.splat plant.ply

The bear is made here. The playbot needs playbot_31k_labels.npy beside it. Pulls of scenes that are not given
are left out.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_closing
from torch import Tensor

from benchmarks.table import Table
from progdf.camera import Camera, intrinsics, look_at
from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf
from progdf.pull.graph import NodeGraph, build_graph
from progdf.rasterize.engines import render

Floats = NDArray[np.float64]

SCENES = ("playbot_31k.ply", "tarot.splat", "plant.ply")
"""Names of the scene files that have pulls."""
BEAR_GAUSSIANS = 60_000
SIZE = 480
"""Width and height of the pictures for counting holes, pixels."""
AZIMUTHS = (20.0, 110.0, 200.0, 290.0)
"""Azimuths of the cameras that count holes, degrees."""
_ELEVATION = 10.0  # of the camera, degrees
_FIELD_OF_VIEW = 0.6  # radians
_MAX_HOLE_SHARE = 0.01  # radius of the largest hole that is counted, in widths of the picture
_COVERED = 0.5  # opacity of a covered pixel
_RIGID = 0.02  # a node is rigid if the lengths of all its edges at strength 1 differ by less
_MOVED_SPACINGS = 0.5  # a rigid edge counts if it moves by so many node spacings

# The program, and its peak memory and processor time on the last line. The status file starts at 0, unlike
# getrusage, whose figure starts at that of the parent.
_MEASURED = """
import sys, time
from progdf.__main__ import main
status = main(sys.argv[1:])
seconds = time.process_time()
try:
    lines = open("/proc/self/status").read().splitlines()
    peak = [line.split()[1] for line in lines if line.startswith("VmHWM:")][0]
except OSError:
    peak = "nan"
print(f"measured {seconds} {peak}")
sys.exit(status)
"""


@dataclass(frozen=True)
class PartPull:
    """One pull of a scene."""

    name: str
    scene: str  # name of the scene file; bear.ply is made
    options: tuple[str, ...]  # of `progdf edit`; {} is the folder of the scene


PULLS = (
    PartPull(
        "head",
        "playbot_31k.ply",
        (
            *("--pull", "labels:{}/playbot_31k_labels.npy:1:-0.01,-1.08,0.11,0.4,0.12,0"),
            *("--hold", "box:-1,-0.45,-1,1,1,1"),
        ),
    ),
    PartPull(
        "corner",
        "tarot.splat",
        ("--pull", "all:0.09,-0.393,0.266,0.06,-0.12,0.08,0.3", "--hold", "box:-1,-0.1,-1,1,1,1"),
    ),
    PartPull(
        "arm",
        "bear.ply",
        ("--pull", "file:{}/arm.npy:0.6,0.42,0.3,0.35,0.5,0.1", "--hold", "box:-5,0.95,-5,5,5,5"),
    ),
    PartPull("nose", "bear.ply", ("--pull", "all:0,1.44,0.6,0,0,0.3,0.35")),
    PartPull("leaf", "plant.ply", ("--pull", "all:0.254,-0.243,0.212,-0.05,-0.15,0.03,0.2")),
)


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure the pulls of the bear and of the given scenes.

    Raises:
        ProgdfError: a scene has no pull, or `progdf edit` fails.
    """
    files = {path.name: path for path in scenes}
    for name in files:
        if name not in SCENES:
            raise ProgdfError(f"{name} has no pull; give {', '.join(SCENES)} or none")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        files["bear.ply"] = make_bear(folder)
        rows = [_row(case, files[case.scene], folder) for case in PULLS if case.scene in files]
    note = (
        "Written by `progdf edit` and measured in the finished edit. Edges lead between the nodes of the "
        "part, which are means of its Gaussians; lengths are per length at rest. Rigid: edges between nodes "
        f"that move by {_MOVED_SPACINGS:g} node spacings or more and all of whose edges keep their length at "
        f"strength 1 within {_RIGID:.0%}; - if there are none. Blend: the mean of strengths 0 and 1. "
        "Holes: open pixels of the part alone that a "
        f"disc with a radius of {_MAX_HOLE_SHARE:.0%} of the picture closes, per covered pixel, the worst of "
        "four sides; gaps between leaves count at 0 as well. Seconds: processor time with start and reading. "
        "Memory: peak of the command."
    )
    return [Table.of("pull-parts", "Pulled parts", rows, note)]


def make_bear(folder: Path) -> Path:
    """Write the demo bear and the rows of its left arm; return the scene's file."""
    demo = bear(BEAR_GAUSSIANS, 0)
    save_ply(folder / "bear.ply", demo.gaussians)
    arms = demo.members("arms")
    np.save(folder / "arm.npy", arms[demo.gaussians.means[arms, 0] > 0.0].numpy())
    return folder / "bear.ply"


def _row(case: PartPull, path: Path, folder: Path) -> dict[str, str]:
    out = folder / f"{case.name}.gdf"
    options = [word.format(path.parent) for word in case.options]
    command = [sys.executable, "-P", "-c", _MEASURED, "edit", str(path), *options, "-o", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode:
        raise ProgdfError(f"progdf edit failed on {path.name}: {run.stderr.strip()}")
    _, seconds, peak = run.stdout.splitlines()[-1].split()
    nodes, strengths = re.findall(r"(\d+) nodes, solved at (\d+) strengths", run.stdout)[0]
    scene = load_scene(path)
    gdf = load_gdf(out, scene)
    half, blend, stretch = _edge_lengths(scene, gdf)
    holes = _hole_shares(scene, gdf)
    return {
        "pull": case.name,
        "scene": path.name,
        "Gaussians": f"{len(gdf.region.members)}",
        "nodes": nodes,
        "strengths": strengths,
        "rigid edges at 0.5, p1 / p99": _range(half),
        "blend of both ends": _range(blend),
        "all edges at 1, p1 / p99": _range(stretch),
        "holes at 0 / 1, %": f"{100.0 * holes[0]:.3f} / {100.0 * holes[1]:.3f}",
        "edit, s": f"{float(seconds):.1f}",
        "peak memory, MB": f"{1024 * float(peak) / 1e6:.0f}",
    }


def _range(values: Floats) -> str:
    if not len(values):
        return "-"
    low, high = np.quantile(values, [0.01, 0.99])
    return f"{low:.3f} / {high:.3f}"


def _edge_lengths(scene: Gaussians, gdf: Gdf) -> tuple[Floats, Floats, Floats]:
    """Return lengths per length at rest: rigid edges at 0.5 and in a blend of both ends, all edges at 1."""
    members = gdf.region.members
    graph = build_graph(scene[members])
    rest, half, end = (
        _node_positions(compose_layers(scene, [Layer(gdf, strength)]), members, graph)
        for strength in (0.0, 0.5, 1.0)
    )
    lengths = _lengths(rest, graph)
    stretch = _lengths(end, graph) / lengths
    moved = np.linalg.norm(end - rest, axis=1) > _MOVED_SPACINGS * graph.spacing
    change = np.zeros(len(rest))
    np.maximum.at(change, graph.starts, np.abs(stretch - 1.0))
    np.maximum.at(change, graph.ends, np.abs(stretch - 1.0))
    is_rigid = (change < _RIGID) & moved
    rigid = is_rigid[graph.starts] & is_rigid[graph.ends]
    blend = _lengths(0.5 * (rest + end), graph)
    return _lengths(half, graph)[rigid] / lengths[rigid], blend[rigid] / lengths[rigid], stretch


def _node_positions(composed: Gaussians, members: Tensor, graph: NodeGraph) -> Floats:
    """Return the means of the Gaussians of each node. [n,3]"""
    means = composed.means[members].double().numpy()
    counts = np.bincount(graph.node_of)
    positions: Floats = np.stack([np.bincount(graph.node_of, column) for column in means.T], axis=1)
    return positions / counts[:, None]


def _lengths(positions: Floats, graph: NodeGraph) -> Floats:
    lengths: Floats = np.linalg.norm(positions[graph.ends] - positions[graph.starts], axis=1)
    return lengths


def _hole_shares(scene: Gaussians, gdf: Gdf) -> tuple[float, float]:
    """Return the largest share of hole pixels from four sides at strengths 0 and 1."""
    shares = []
    for strength in (0.0, 1.0):
        composed = compose_layers(scene, [Layer(gdf, strength)])
        added = torch.arange(len(scene), len(composed))
        part = composed[torch.cat([gdf.region.members, added])]
        shares.append(max(_hole_share(part, azimuth) for azimuth in AZIMUTHS))
    return shares[0], shares[1]


def _hole_share(part: Gaussians, azimuth: float) -> float:
    """Return the share of hole pixels of a part from one side, 0 to 1."""
    opened = 1.0 - render(part, _camera(part, azimuth)).transmittance.numpy()
    covered = opened > _COVERED
    radius = max(1, round(_MAX_HOLE_SHARE * SIZE))
    padded = np.pad(covered, 2 * radius)
    closed = binary_closing(padded, iterations=radius)[2 * radius : -2 * radius, 2 * radius : -2 * radius]
    holes = closed & ~covered
    return float(holes.sum()) / max(1, int(covered.sum()))


def _camera(part: Gaussians, azimuth: float) -> Camera:
    """Return a camera that sees a part fill most of the picture; the up axis is that of y, up or down."""
    low, high = part.means.double().quantile(torch.tensor([0.01, 0.99], dtype=torch.float64), dim=0)
    center = 0.5 * (low + high)
    distance = 0.6 * float((high - low).norm()) / np.tan(0.5 * _FIELD_OF_VIEW)
    angle = np.deg2rad(azimuth)
    tilt = np.deg2rad(_ELEVATION)
    back = torch.tensor(
        [np.sin(angle) * np.cos(tilt), np.sin(tilt), np.cos(angle) * np.cos(tilt)], dtype=torch.float64
    )
    viewmat = look_at(center + distance * back, center, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    return Camera(viewmat, intrinsics(_FIELD_OF_VIEW, SIZE, SIZE), SIZE, SIZE)
