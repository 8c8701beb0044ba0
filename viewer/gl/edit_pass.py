"""The edit pass: strengths → attributes on the GPU, straight into the textures that the scene is drawn from.

Bases lie in textures; a new strength sends a few numbers a layer, and one pass writes the texels of the
members into all attribute textures at once. `progdf.compose` is its reference, and a test compares the two.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.compose.layers import BLENDS, Layer
from progdf.compose.plan import FlatWeights, plan_rows
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf

from .edit_packing import pack_edits, pack_stack, spans_of
from .layout import PLACES, SPLAT_TEXTURES, SPLATS_PER_ROW, TARGETS
from .programs import load_program
from .scene_textures import SplatTextures
from .texel_list import TexelList, capacity

_SH = TARGETS.index("shN")
_KEPT = 32
"""Sets of edits whose spans are kept; a handful is in use while one drags."""


@dataclass(frozen=True)
class _EditPlan:
    """What is drawn over when some edits change, and which edits have a part in it."""

    rows: NDArray[np.int64]
    edits: frozenset[int]
    spans: int
    buffer: moderngl.Buffer
    base: moderngl.VertexArray
    sh: moderngl.VertexArray

    def release(self) -> None:
        for held in (self.base, self.sh, self.buffer):
            held.release()


class EditPassError(ProgdfError):
    """The edit pass cannot run here; the CPU can."""


class EditPass:
    """Writes the members of edits into the textures of a scene.

    Args:
        ctx: where the textures live
        textures: of the scene, filled with its original attributes; `editable` where an edit moves shN
        scene: the original
        gdfs: every edit that may appear in the stack

    Raises:
        EditPassError: the edits are too large for a texture, or this driver cannot draw into the scene's.
    """

    def __init__(
        self, ctx: moderngl.Context, textures: SplatTextures, scene: Gaussians, gdfs: Sequence[Gdf]
    ) -> None:
        self.ctx, self._textures = ctx, textures
        self._members = [gdf.region.members.numpy() for gdf in gdfs]
        self._moved = [frozenset(gdf.field.attributes) for gdf in gdfs]
        self._packed = pack_edits(scene, gdfs)
        if self._packed.texels > capacity(ctx):
            raise EditPassError("the edits are too large for a texture of this GPU")
        self._base_target = _framebuffer(ctx, [textures.textures[name] for name in SPLAT_TEXTURES])
        self._sh_target: moderngl.Framebuffer | None = None
        if self._packed.originals[_SH] >= 0:
            self._sh_target = _framebuffer(ctx, [textures.textures["shN"]])
        self._lists = {
            "edit_floats": TexelList(ctx, 4, "f4"),
            "edit_levels": TexelList(ctx, 4, "i1"),
            "edit_places": TexelList(ctx, 1, "i4"),
            "edit_weights": TexelList(ctx, 1, "f4"),
            "edit_layers": TexelList(ctx, 4, "i4"),
            "edit_numbers": TexelList(ctx, 4, "f4"),
        }
        self._lists["edit_floats"].write(self._packed.floats)
        self._lists["edit_levels"].write(self._packed.levels)
        self._lists["edit_places"].write(self._packed.places)
        self._base = load_program(ctx, "edit.vert", "edit.frag")
        self._sh = load_program(ctx, "edit.vert", "edit_sh.frag")
        self._plans: dict[frozenset[int], _EditPlan] = {}
        self._weights = FlatWeights()  # those in `edit_weights`

    def run(
        self, stack: Sequence[tuple[int, Layer]], blend: str, changed: frozenset[int]
    ) -> NDArray[np.int64]:
        """Bring the members of the changed edits up to date.

        Args:
            stack: active layers with the indices of their edits, the lowest first
            blend: one of `BLENDS`
            changed: see `progdf.compose.layers.changed_edits`

        Returns:
            Sorted indices of the Gaussians that were written. [M]
        """
        plan = self._plan(changed)
        attributes = {name for edit in plan.edits for name in self._moved[edit]}
        if not plan.spans:
            return plan.rows
        self._send([(edit, layer) for edit, layer in stack if edit in plan.edits])
        self.ctx.enable_only(moderngl.NOTHING)
        for program in (self._base, self._sh):
            program["layer_count"] = sum(edit in plan.edits for edit, _ in stack)
            program["blend"] = BLENDS.index(blend)
            program["size"] = (SPLATS_PER_ROW, self._textures.rows)
            for unit, (name, texels) in enumerate(self._lists.items()):
                texels.use(unit)
                program[name] = unit
        if attributes - {"shN"}:
            self._draw_base(plan, attributes)
        if self._sh_target is not None and "shN" in attributes:
            self._draw_sh(plan, self._sh_target)
        return plan.rows

    def read(self, texture_rows: Sequence[int]) -> dict[str, NDArray[np.float32]]:
        """Attributes back from some rows of the scene's textures; all that some edit moves.

        Args:
            texture_rows: each of `layout.SPLATS_PER_ROW` Gaussians, the last one's tail being empty

        Returns:
            By attribute, the Gaussians of these rows in turn; of shN the coefficients that are shown. [·,c]
        """
        found = {}
        for name in sorted({name for moved in self._moved for name in moved}):
            place = PLACES[name]
            target, attachment = self._base_target, TARGETS.index(place.texture)
            if name == "shN":
                if self._sh_target is None:
                    continue
                target, attachment = self._sh_target, 0
            texels = np.zeros((len(texture_rows) * target.width, 4), np.float32)
            for i, row in enumerate(texture_rows):
                packed = target.read((0, row, target.width, 1), 4, attachment=attachment, dtype="f4")
                texels[i * target.width : (i + 1) * target.width] = np.frombuffer(packed, np.float32).reshape(
                    -1, 4
                )
            columns = texels[:, place.component : place.component + place.components]
            found[name] = columns.reshape(len(texture_rows) * SPLATS_PER_ROW, -1)
        return found

    def release(self) -> None:
        """Give everything back but the scene's textures."""
        self.ctx.detect_framebuffer(0).use()  # moderngl must not bind a deleted one again
        if self._sh_target is not None:
            self._sh_target.release()
        for plan in self._plans.values():
            plan.release()
        for texels in self._lists.values():
            texels.release()
        for held in (self._base_target, self._base, self._sh):
            held.release()

    def _send(self, stack: Sequence[tuple[int, Layer]]) -> None:
        """The stack's strengths, and its painted weights where they are others than those of before."""
        if self._weights.update([layer for _, layer in stack]):
            self._lists["edit_weights"].write(self._weights.flat)
        layers, numbers = pack_stack(self._packed, stack, self._weights.begins)
        self._lists["edit_layers"].write(layers.view("<i4"))
        self._lists["edit_numbers"].write(numbers)

    def _draw_base(self, plan: _EditPlan, attributes: Collection[str]) -> None:
        """All attributes but shN; textures in which nothing moves are masked."""
        moved = {PLACES[name].texture for name in attributes}
        wanted = [name in moved for name in SPLAT_TEXTURES]
        target = self._base_target
        target.color_mask = tuple((want,) * 4 for want in wanted)  # type: ignore[assignment]
        target.use()
        target.viewport = (0, 0, *target.size)
        self._base["originals"] = self._packed.originals[:_SH]
        self._base["wanted"] = tuple(map(int, wanted))
        plan.base.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=plan.spans)

    def _draw_sh(self, plan: _EditPlan, target: moderngl.Framebuffer) -> None:
        target.use()
        target.viewport = (0, 0, *target.size)
        self._sh["original"] = self._packed.originals[_SH]
        self._sh["sh_coefficients"] = self._packed.sh_coefficients
        plan.sh.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=plan.spans)

    def _plan(self, changed: frozenset[int]) -> _EditPlan:
        if changed not in self._plans:
            if len(self._plans) >= _KEPT:
                for plan in self._plans.values():
                    plan.release()
                self._plans.clear()
            found = plan_rows(self._members, changed)
            spans = spans_of(found.rows, self._packed.slots)
            buffer = self.ctx.buffer(spans.tobytes() or bytes(spans.itemsize))
            base, sh = (
                self.ctx.vertex_array(program, [(buffer, "4i/i", "span")])
                for program in (self._base, self._sh)
            )
            self._plans[changed] = _EditPlan(found.rows, found.edits, len(spans), buffer, base, sh)
        return self._plans[changed]


def _framebuffer(ctx: moderngl.Context, textures: Sequence[moderngl.Texture]) -> moderngl.Framebuffer:
    try:
        return ctx.framebuffer(list(textures))
    except moderngl.Error as error:
        raise EditPassError(f"this GPU does not draw into float32 textures: {error}") from None
