"""Scenes of one view: their files, and the merged Gaussians in which each scene has its own rows.

The merged scene holds the rows of all scenes, one after the other, each at its placement. A hidden scene
keeps its rows, with an opacity of 0. Row numbers therefore never change while scenes are placed, shown or
hidden. Edits stay bound to the file of their scene. `placed_edit` carries one to the merged scene, and
`own_edit` carries it back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin, concatenate
from progdf.gdf.file import Gdf, fingerprint
from progdf.gdf.placed import Placement, Target, carry_edit, check_rounding, place_scene
from progdf.io.atomic import numbered_names
from viewer.state.selection import SelectionState, take_rows
from viewer.state.view_state import MAX_SCENES, SceneState, ViewState

HIDDEN_LOGIT = -1e4
"""Opacity logit of the rows of hidden scenes. No edit makes them visible."""


@dataclass(frozen=True)
class SceneFile:
    """Scene as in its file."""

    title: str
    gaussians: Gaussians
    path: Path | None = None


@dataclass(frozen=True)
class OwnScene:
    """Scene on which a run trains, with its own rows and coordinates; see `Document.own_scene`."""

    file: SceneFile
    rows: slice  # its rows in the merged scene
    placement: Placement = Placement()
    origin: Origin = ZERO  # origin of the merged scene

    @property
    def path(self) -> Path:
        """File of the scene. Raises ProgdfError if there is none."""
        if self.file.path is None:
            raise ProgdfError("the scene has no file yet; open one first")
        return self.file.path

    @property
    def count(self) -> int:
        """Number of its Gaussians."""
        return len(self.file.gaussians)

    def selection(self, state: SelectionState, total: int) -> SelectionState:
        """Return a selection of the merged scene, with `total` rows, as one of this scene."""
        if self.rows == slice(0, total):
            return state
        return take_rows(state, total, np.arange(self.rows.start, self.rows.stop))

    def camera(self, camera: Camera) -> Camera:
        """Return a camera of the merged scene as a camera of this scene, with the same picture."""
        own = self.file.gaussians.origin
        if self.placement == Placement() and own == self.origin:
            return camera
        to_merged = torch.eye(4, dtype=torch.float64)
        to_merged[:3, :3] = self.placement.factor * self.placement.rotation
        here = torch.tensor(own, dtype=torch.float64)
        there = torch.tensor(self.origin, dtype=torch.float64)
        to_merged[:3, 3] = to_merged[:3, :3] @ here + self.placement.offset - there
        viewmat = camera.viewmat.double() @ to_merged
        viewmat[:3] /= self.placement.factor
        return replace(camera, viewmat=viewmat.to(camera.viewmat))


def rows_of(files: Sequence[SceneFile], scene: int) -> slice:
    """Return the rows of a scene among the merged rows."""
    first = sum(len(file.gaussians) for file in files[:scene])
    return slice(first, first + len(files[scene].gaussians))


def state_of(states: Sequence[SceneState], scene: int) -> SceneState:
    """Return the state of a scene. One that the view does not list is hidden."""
    hidden = SceneState(scene, "", visible=not states and scene == 0)
    return next((state for state in states if state.scene == scene), hidden)


def merge(files: Sequence[SceneFile], states: Sequence[SceneState]) -> Gaussians:
    """Return the merged scene, relative to the origin of the first one.

    Scenes with a lower SH degree get bands of zeros.

    Raises:
        ProgdfError: a scene is placed too far away, see `check_rounding`.
    """
    first = files[0].gaussians
    bands = max(file.gaussians.shN.shape[1] for file in files)
    parts = []
    for scene, file in enumerate(files):
        state = state_of(states, scene)
        part = place_scene(file.gaussians, state.placement, first.origin, bands)
        if state.placement != Placement():
            check_rounding(part, state.name)
        if not state.visible:
            part = replace(part, logit_opacities=torch.full_like(part.logit_opacities, HIDDEN_LOGIT))
        parts.append(part)
    return concatenate(parts)


def hidden_rows(files: Sequence[SceneFile], states: Sequence[SceneState]) -> Tensor:
    """Return the merged rows of hidden scenes. [N] bool"""
    masks = [
        torch.full((len(file.gaussians),), not state_of(states, scene).visible)
        for scene, file in enumerate(files)
    ]
    return torch.cat(masks)


def placed_edit(
    gdf: Gdf, files: Sequence[SceneFile], scene: int, placement: Placement, merged: Gaussians
) -> Gdf:
    """Return an edit of a scene as an edit of the merged scene.

    Raises:
        ProgdfError: see `carry_edit`.
    """
    first = rows_of(files, scene).start
    bands = files[scene].gaussians.shN.shape[1]
    if gdf.added is not None:  # added rows never have more SH bands than their scene
        gdf = replace(gdf, added=replace(gdf.added, shN=gdf.added.shN[:, :bands]))
    target = Target(fingerprint(merged), merged.origin, merged.shN.shape[1], lambda rows: rows + first)
    return carry_edit(gdf, placement, target)


def own_edit(gdf: Gdf, files: Sequence[SceneFile], scene: int, placement: Placement) -> Gdf:
    """Return an edit of the merged scene as an edit of the scene that holds all of its members.

    Raises:
        ProgdfError: see `carry_edit`; or a member belongs to another scene.
    """
    own = files[scene].gaussians
    rows = rows_of(files, scene)

    def find(merged: Tensor) -> Tensor:
        is_own = (merged >= rows.start) & (merged < rows.stop)
        return torch.where(is_own, merged - rows.start, -1)

    if bool((find(gdf.region.members) < 0).any()):
        raise ProgdfError(f"{gdf.name} changes several scenes; an edit belongs to one")
    return carry_edit(gdf, placement.inverse, Target(fingerprint(own), own.origin, own.shN.shape[1], find))


def first_states(title: str) -> tuple[SceneState, ...]:
    """Return the states of a view with one scene."""
    return (SceneState(0, title),)


def add_state(view: ViewState, title: str, added: str, scene: int, placement: Placement) -> ViewState:
    """Return the view with one more scene.

    Args:
        view: the view
        title: name of the document's first scene
        added: name of the new scene; it gets a number if another one has it
        scene: its index in the document
        placement: its placement

    Raises:
        ProgdfError: there are too many scenes.
    """
    states = view.scenes or first_states(title)
    if len(states) >= MAX_SCENES:
        raise ProgdfError(f"a view holds at most {MAX_SCENES} scenes; remove one first")
    taken = {state.name for state in states}
    name = next(name for name in numbered_names(added) if name not in taken)
    return replace(view, scenes=(*states, SceneState(scene, name, placement=placement)))


def change_state(view: ViewState, index: int, state: SceneState) -> ViewState:
    """Return the view with another state of the scene at an index of its list."""
    states = list(view.scenes)
    states[index] = state
    return replace(view, scenes=tuple(states))
