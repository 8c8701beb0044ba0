"""A bear with two hand-made edits for tests of the viewer: a green scarf, and growing golden ears."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from progdf.demo_scenes import DemoScene
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.trajectory import Trajectory
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint, save_gdf
from progdf.region import Region
from progdf.sh import rgb_to_sh0
from tests.helpers.demo_scenes import bear
from viewer.camera.view_camera import ViewCamera, first_camera
from viewer.state.view_state import LayerState, ViewState

NODES = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])
# a change of color, and one of geometry and color
SCARF = 0
EARS = 1
GREEN = (0.10, 0.62, 0.24)
GOLD = (0.90, 0.66, 0.15)


@dataclass(frozen=True)
class Stack:
    """A scene and its edits."""

    demo: DemoScene
    gdfs: tuple[Gdf, ...]

    @property
    def scene(self) -> Gaussians:
        return self.demo.gaussians

    @cached_property
    def first_camera(self) -> ViewCamera:
        return first_camera(self.scene, self.demo.cameras)

    def save(self, folder: Path) -> list[Path]:
        """Save bear.ply, scarf.gdf and ears.gdf in `folder`. Return their paths in this order."""
        paths = [folder / "bear.ply", *(folder / f"{gdf.name}.gdf" for gdf in self.gdfs)]
        save_ply(paths[0], self.scene)
        for path, gdf in zip(paths[1:], self.gdfs, strict=True):
            save_gdf(path, gdf)
        return paths


EDITS = (
    *(
        "jacket blue",
        "jacket rust",
        "helmet gold",
        "helmet stripes",
        "gloves",
        "boots",
        "visor",
        "dusk",
        "wet road",
    ),
    *("tank chrome", "tank flames", "seat", "wheel glow", "mirror", "exhaust", "lamp", "silk scarf", "plate"),
    *("copper fork", "grips"),
)


def many_edits(stack: Stack, count: int = len(EDITS)) -> tuple[Stack, ViewState]:
    """Return the stack with up to 20 named edits, alternating between scarf and ears, all at strength 0.5."""
    gdfs = tuple(replace(stack.gdfs[i % 2], name=name) for i, name in enumerate(EDITS[:count]))
    view = view_of(stack)
    layers = tuple(LayerState(i, gdf.name, 0.5) for i, gdf in enumerate(gdfs))
    return Stack(stack.demo, gdfs), replace(view, layers=layers, dynamic_resolution="off")


def recording_of(gdf: Gdf) -> Trajectory:
    """Return a possible recording of this edit. At intermediate strengths it moves farther than the field."""
    s = torch.tensor(gdf.field.recorded)
    rows = [(1.0 + 0.5 * float(x) * (1.0 - float(x))) * gdf.field.offsets(float(x)) for x in s]
    ends = (len(s) - 1,)
    return Trajectory(s, torch.stack(rows).half(), rows[-1], torch.arange(len(s)), ends, (1.0,))


def bear_stack(size: int = 4000) -> Stack:
    """Return a deterministic scene with two edits. Their recorded strengths are uneven, as in a real run."""
    demo = bear(size)
    scene = demo.gaussians
    scarf = demo.members("scarf")
    ears = demo.members("ears")
    center = scene.means[ears].mean(0)
    return Stack(
        demo,
        (
            _gdf(scene, "scarf", scarf, "recolor:#1a9e3d", {"sh0": _towards(scene, scarf, GREEN)}),
            _gdf(
                scene,
                "ears",
                ears,
                "grow",
                {
                    "sh0": _towards(scene, ears, GOLD),
                    "means": 0.35 * (scene.means[ears] - center),
                    "log_scales": torch.full((len(ears), 3), 0.3),
                },
            ),
        ),
    )


def _towards(scene: Gaussians, members: Tensor, rgb: tuple[float, float, float]) -> Tensor:
    return 0.9 * (rgb_to_sh0(torch.tensor(rgb)) - scene.sh0[members])


def _gdf(scene: Gaussians, name: str, members: Tensor, instruction: str, offsets: dict[str, Tensor]) -> Gdf:
    """Return an edit whose offsets grow linearly, with an extra swing of a tenth at strength 0.5."""
    score = torch.zeros(len(scene))
    score[members] = 1.0
    coefficients = torch.stack([NODES, torch.sin(torch.pi * NODES).round(decimals=6)], dim=1)
    coefficients[-1] = torch.tensor([1.0, 0.0])
    attributes = {
        attribute: AttributeBases(
            end_offset=full,
            residual_basis=(0.1 * full)[None].half(),
            scale=torch.ones(2, full.shape[1]),
            coefficients=coefficients.clone(),
        )
        for attribute, full in offsets.items()
    }
    field = BakedField("separable", NODES, attributes, 14, recorded=(0.0, 0.12, 0.31, 0.5, 0.74, 1.0))
    return Gdf(name, Region(name, members, score), field, fingerprint(scene), instruction)


def view_of(stack: Stack, scarf: float = 0.0, ears: float = 0.0) -> ViewState:
    """Return a front view of the bear's head and scarf with its edits at these strengths."""
    layers = (LayerState(SCARF, "scarf", scarf), LayerState(EARS, "ears", ears))
    camera = replace(stack.first_camera, pivot=(0.0, 0.75, 0.2), distance=5.5)
    return ViewState(camera=camera, layers=layers)
