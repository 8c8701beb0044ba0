"""Manual edits: a selection is removed, moved or copied, each as a layer with a slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.added import rows_on
from progdf.compose.layer_paint import layer_of
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import UNSEEN_LOGIT, Gdf, save_gdf
from progdf.gdf.motions import PartMotions
from progdf.pull.live import edit_in_progress, write_move
from progdf.region import Region, from_mask
from progdf.scene.subject import ground_height
from progdf.similarity import AffineMotion, affine_motion
from progdf.system.equality import equal_fields
from progdf.tidy import Step, leave_paint, tidy
from viewer.app.messages import Requests
from viewer.app.parts.making import LayerMaker, Progress
from viewer.camera.view_camera import Vec3
from viewer.files.document import Document, DocumentStore
from viewer.render.engine import ViewEngine
from viewer.state import paint, selection
from viewer.state.layers import visible_layers, with_paint
from viewer.state.transient import Gizmo, PlacedPart
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import Store, with_transient

_MAX_POINTS = 5000  # points of a part that decide on its base
_NAMES = {"remove": "removed", "transform": "moved", "duplicate": "copy"}
_INSTRUCTIONS = {"remove": "remove", "transform": "move", "duplicate": "copy"}


@dataclass(frozen=True)
class _Selected:
    """Selected Gaussians of the scene, and selected paint."""

    __eq__ = equal_fields

    region: Region  # Gaussians of the original
    leaves_paint: bool  # paint lies on them, and none of it is selected
    loose_paint: NDArray[np.bool_]  # selected paint that lies on other Gaussians. [N]
    # returns the Gaussians of a copy: the selected ones and their selected paint, under the visible layers
    copied: Callable[[], Gaussians]


def select_parts(document: Document, view: ViewState) -> _Selected:
    """Return the selected Gaussians, and the selected paint.

    Raises:
        ProgdfError: nothing is selected.
    """
    count = len(document.original)
    mask = selection.unpack(view.selection.members, len(document.scene))
    if not mask.any():
        raise ProgdfError("nothing is selected; select a part of the scene first")
    own = mask.copy()
    own[count:] = False
    painting = {layer.gdf for layer in view.layers}
    lying = np.zeros_like(own)
    for gdf in painting:
        lying[rows_on(document.gdfs[gdf], torch.from_numpy(own)).numpy()] = True
    paint_rows = mask & ~own
    return _Selected(
        region=from_mask("selection", torch.from_numpy(own[:count].copy())),
        leaves_paint=bool(lying.any()) and not bool((lying & mask).any()),
        loose_paint=paint_rows & ~lying,
        copied=cache(partial(_copy_source, document, view, own, paint_rows)),
    )


def _copy_source(
    document: Document, view: ViewState, own: NDArray[np.bool_], paint_rows: NDArray[np.bool_]
) -> Gaussians:
    """Return the selected Gaussians and the selected paint under the visible layers.

    Rows that the layers hide are left out. Layers whose paint lies on the object but is not selected are not
    applied.

    Args:
        document: the open document
        view: its layers
        own, paint_rows: selected Gaussians of the original, and selected rows that edits add. [N] each
    """
    layers = []
    for layer in visible_layers(view):
        gdf = document.gdfs[layer.gdf]
        paint_on_object = rows_on(gdf, torch.from_numpy(own)).numpy()
        is_left_behind = len(paint_on_object) > 0 and not paint_rows[paint_on_object].any()
        if not is_left_behind:
            layers.append(layer_of(gdf, layer.strength, layer.gains, layer.paint, layer.blend))
    composed = compose_layers(document.scene, layers, view.blend)
    is_drawn = (composed.logit_opacities >= UNSEEN_LOGIT).numpy()
    keeps_opacity = (composed.logit_opacities == document.scene.logit_opacities).numpy()
    copied_own = own & (is_drawn | keeps_opacity)
    copied_paint = paint_rows & is_drawn
    return composed[torch.from_numpy(np.flatnonzero(copied_own | copied_paint))]


def _motion(gizmo: Gizmo) -> AffineMotion:
    """Return the motion of the selection that the handles show, about their pivot."""
    linear = torch.from_numpy(gizmo.matrix[:3, :3].copy())
    offset = torch.tensor(gizmo.pivot_at, dtype=torch.float64)
    moved = linear @ offset + torch.from_numpy(gizmo.matrix[:3, 3].copy())
    pivot = torch.tensor(gizmo.center, dtype=torch.float64) + offset
    return affine_motion(linear, moved - offset, pivot)


def _placed_part(moved: Gaussians, document: Document, selected: Region, up: Vec3) -> PlacedPart:
    """Return the geometry of the moved Gaussians.

    Args:
        moved: the Gaussians to move or copy
        document: the open document
        selected: the selection, which does not count as surroundings
        up: up axis of the view
    """
    means = moved.means.double()
    some = means[:: len(means) // _MAX_POINTS + 1]
    x, y, z = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0).tolist()
    unit = (x, y, z)
    scene = document.original
    logits = scene.logit_opacities.clone()
    logits[selected.members] = -torch.inf
    rest = replace(scene, logit_opacities=logits)
    return PlacedPart(
        (some - means.mean(dim=0)).numpy(), unit, ground_height(scene, torch.tensor(unit).float()), rest
    )


class TidyActions:
    """Layers that remove, move or copy the selection.

    Args:
        store: state of the window
        documents: the open document
        maker: makes the layers
        engine: returns the engine that draws the window; None without a window
        place_scene: places the scene whose Gaussians are all moved; returns False if the moved Gaussians are
            not those of one of several scenes
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        maker: LayerMaker,
        engine: Callable[[], ViewEngine] | None = None,
        place_scene: Callable[[Region, AffineMotion], bool] = lambda region, motion: False,
    ) -> None:
        self._engine = engine
        self._place_scene = place_scene
        self._store = store
        self._documents = documents
        self._maker = maker
        self._selected: _Selected | None = None  # the Gaussians being moved or copied
        self._live: Gdf | None = None  # preview of a move, whose offsets are written in place
        # scene of the preview, and its members before the move, packed. [M,C]
        self._rows: tuple[Gaussians, Tensor] | None = None

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about the selection and the handles that move it, by name."""
        return {
            "remove_selected": lambda _: self._begin("remove"),
            "move_selected": lambda _: self._begin("transform"),
            "duplicate_selected": lambda _: self._begin("duplicate"),
            "place": self._place,
            "keep_placed": self._keep,
            "put_back": self._put_back,
        }

    def leave_scene(self) -> None:
        """Drop the handles and measured points when another scene opens."""
        self._selected = self._live = self._rows = None
        self._store.replace(with_transient(self._store.get(), gizmo=None, measure=None))

    def _begin(self, does: str) -> None:
        self._maker.check_free()
        document = self._documents.get()
        selected = select_parts(document, self._store.get().view)
        if len(selected.region):
            document.scene_with(selected.region.members)
        if does == "remove":
            self._remove(selected)
            return
        if does == "transform" and not len(selected.region):
            raise ProgdfError("only paint is selected, and it moves with its object; copy it, or select both")
        kind: Literal["transform", "duplicate"] = "duplicate" if does == "duplicate" else "transform"
        moved = document.original[selected.region.members]
        if kind == "duplicate":
            moved = selected.copied()
        if not len(moved):
            raise ProgdfError("the layers hide everything that is selected; make it visible to copy it")
        center = moved.means.double().mean(dim=0)
        self._selected = selected
        self._live = self._rows = None
        at = (float(center[0]), float(center[1]), float(center[2]))
        part = _placed_part(moved, document, selected.region, self._store.get().view.camera.up)
        self._set_gizmo(Gizmo(kind, at, np.eye(4), part=part))
        self._store.wake()

    def _remove(self, selected: _Selected) -> None:
        """Add a layer that removes the selection, and erase selected paint that lies elsewhere."""
        document = self._documents.get()
        view = self._store.get().view
        count = len(document.original)
        for index, layer in enumerate(view.layers):
            gdf = document.gdfs[layer.gdf]
            painted = paint.erase_rows(layer.paint, gdf, document.scene, count, selected.loose_paint)
            if painted != layer.paint and layer.locked:
                raise ProgdfError(f"{layer.name} is locked; unlock it to erase its paint")
            view = with_paint(view, index, painted)
        if not len(selected.region):
            view = replace(view, selection=selection.select_none(view.selection))
        self._store.change(view)
        if len(selected.region):
            self._add("remove", [Step("remove", selected.region)], selected.leaves_paint)

    def _steps(self) -> list[Step]:
        gizmo = self._store.get().transient.gizmo
        selected = self._selected
        if not isinstance(gizmo, Gizmo) or selected is None:
            return []
        copied = selected.copied() if gizmo.does == "duplicate" else None
        return [Step(gizmo.does, selected.region, _motion(gizmo), copied)]

    def _place(self, _: None) -> None:
        """Show the moved or copied selection at the position of the handles."""
        if steps := self._steps():
            document = self._documents.get()
            if steps[0].does == "transform":
                self._place_moved(document, steps[0])
                return
            gdf = tidy(document.original, steps, _NAMES["duplicate"], only_end=True)
            live = (LayerState(len(document.edits), gdf.name, 1.0),)
            self._documents.replace(document, (gdf,), live)

    def _place_moved(self, document: Document, step: Step) -> None:
        """Show the moved selection. After the first time, only its own Gaussians are composed again."""
        scene = document.original
        members = step.region.members
        motion = step.motion
        assert motion is not None, "a move has a motion"
        if self._rows is None or self._rows[0] is not scene:
            self._rows = scene, pack(scene[members], with_shN=scene.sh_degree > 0).float()
        rows = self._rows[1]
        motions = None  # without layers below, offsets alone do, in a third of the time
        if visible_layers(self._store.get().view):
            motions = PartMotions(torch.zeros(len(members), dtype=torch.int64), ((motion,),))
        live = self._live
        engine = None if self._engine is None else self._engine()
        is_drawn = (
            live is not None
            and engine is not None
            and len(engine.gdfs) > 0
            and engine.gdfs[-1].field is live.field
            and torch.equal(live.region.members, members)
            and (live.motions is None) == (motions is None)
        )
        if live is not None and engine is not None and is_drawn:
            write_move(live, rows, motion)
            engine.touch(engine.gdfs[-1], motions)
            self._store.wake()
            return
        gdf = edit_in_progress(scene, members.numpy(), rows.shape[1], _NAMES[step.does])
        gdf = replace(gdf, motions=motions)
        if self._selected is not None and self._selected.leaves_paint:
            gdf = leave_paint(gdf)
        write_move(gdf, rows, motion)
        self._documents.replace(document, (gdf,), (LayerState(len(document.edits), gdf.name, 1.0),))
        self._live = gdf

    def _keep(self, _: None) -> None:
        gizmo = self._store.get().transient.gizmo
        steps = self._steps()
        if isinstance(gizmo, Gizmo) and steps and (gizmo.does == "duplicate" or gizmo.is_moved):
            if gizmo.does == "transform" and self._place_scene(steps[0].region, _motion(gizmo)):
                self._end()
                return
            self._add(steps[0].does, steps, self._selected is not None and self._selected.leaves_paint, gizmo)
        self._end()

    def _put_back(self, _: None) -> None:
        moved = self._selected is not None
        self._end()
        if moved:
            self._documents.replace(self._documents.get())

    def _end(self) -> None:
        self._selected = self._live = self._rows = None
        self._set_gizmo(None)
        self._store.wake()

    def _set_gizmo(self, gizmo: Gizmo | None) -> None:
        self._store.replace(with_transient(self._store.get(), gizmo=gizmo))

    def _add(self, does: str, steps: Sequence[Step], leaves_paint: bool, gizmo: Gizmo | None = None) -> None:
        """Begin to make the edit, which becomes a layer on top; after a failure, `gizmo` is shown again."""
        original = self._documents.get().original
        selected = self._selected

        def make(name: str, path: Path, progress: Progress) -> None:
            instruction = _INSTRUCTIONS[does]
            gdf = tidy(
                original,
                steps,
                name,
                instruction,
                cameras=(),
                leaves_paint=leaves_paint,
                progress=progress,
            )
            save_gdf(path, gdf)

        def done(is_ready: bool) -> None:
            if is_ready or gizmo is None:
                return
            if self._store.get().transient.gizmo is None:
                self._selected = selected
                self._set_gizmo(gizmo)
            else:
                self._documents.replace(self._documents.get())  # without the preview

        self._maker.begin(_NAMES[does], make, done)
