"""The scene on the GPU, and the pass that draws it: project once a Gaussian, then blend back to front."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import ATTRIBUTES, Gaussians

from .layout import ORDER, PROJECTED, SPLAT_TEXTURES, SPLATS_PER_ROW
from .programs import load_program

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class _Place:
    """Where an attribute lies: the texture and the first of its float channels."""

    texture: str
    channel: int


_PLACES = {
    "means": _Place("mean_logit", 0),
    "logit_opacities": _Place("mean_logit", 3),
    "log_scales": _Place("log_scale", 0),
    "quats": _Place("quat", 0),
    "sh0": _Place("sh0", 0),
    "shN": _Place("shN", 0),
}
_SHOWN_SH = 15  # coefficients above degree 3 ride along in the scene and are not shown
_GAP = 4  # texture rows: uploading so many untouched ones costs less than another call


class SplatTextures:
    """The raw attributes of a scene in textures, with a copy in memory that partial uploads are taken from.

    Args:
        ctx: where they live
        count: N
        sh_coefficients: K of shN that are shown: 0, 3, 8 or 15
    """

    def __init__(self, ctx: moderngl.Context, count: int, sh_coefficients: int) -> None:
        self.count = count
        self.sh_coefficients = sh_coefficients
        self.rows = max(1, -(-count // SPLATS_PER_ROW))
        self._channels = {name: 4 for name in SPLAT_TEXTURES} | {"shN": 3 * max(1, sh_coefficients)}
        self._memory = {
            name: np.zeros((self.rows * SPLATS_PER_ROW, channels), np.float32)
            for name, channels in self._channels.items()
            if name != "shN" or sh_coefficients
        }
        self.textures: dict[str, moderngl.Texture] = {}
        for name in self._channels:
            size = (SPLATS_PER_ROW, self.rows)
            components = 4
            if name == "shN":
                size = (SPLATS_PER_ROW * sh_coefficients, self.rows) if sh_coefficients else (1, 1)
                components = 3
            texture = ctx.texture(size, components, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self.textures[name] = texture

    def write(
        self, scene: Gaussians, attributes: Iterable[str] = ATTRIBUTES, rows: NDArray[np.int64] | None = None
    ) -> int:
        """Upload what changed.

        Args:
            scene: the present values, N rows
            attributes: names of `ATTRIBUTES` that changed
            rows: sorted indices of the Gaussians that changed; None is all

        Returns:
            Bytes sent.
        """
        touched = []
        for attribute in attributes:
            place = _PLACES[attribute]
            if place.texture not in self._memory or (rows is not None and not len(rows)):
                continue
            source = getattr(scene, attribute).detach()
            if attribute == "shN":
                source = source[:, : self.sh_coefficients].flatten(1)
            values = source[:, None] if source.ndim == 1 else source
            target = torch.from_numpy(self._memory[place.texture])
            columns = target[: self.count, place.channel : place.channel + values.shape[1]]
            if rows is None:
                columns.copy_(values)
            else:
                index = torch.from_numpy(rows)
                columns[index] = values[index].to(columns.dtype)
            if place.texture not in touched:
                touched.append(place.texture)
        return sum(self._send(name, rows) for name in touched)

    def _send(self, name: str, rows: NDArray[np.int64] | None) -> int:
        texture, memory = self.textures[name], self._memory[name]
        sent = 0
        for first, last in [(0, self.rows)] if rows is None else row_runs(rows):
            part = memory[first * SPLATS_PER_ROW : last * SPLATS_PER_ROW]
            texture.write(part, viewport=(0, first, texture.width, last - first))
            sent += part.nbytes
        return sent

    def bind(self, program: moderngl.Program) -> None:
        """Make them what the samplers of `include/raw_splats.glsl` read."""
        for unit, (name, texture) in enumerate(self.textures.items()):
            texture.use(unit)
            program[name] = unit
        program["sh_coefficients"] = self.sh_coefficients

    def release(self) -> None:
        for texture in self.textures.values():
            texture.release()


def row_runs(rows: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Texture rows [first, last) that hold the Gaussians `rows` (sorted), near ones joined."""
    touched = rows // SPLATS_PER_ROW
    breaks = np.flatnonzero(np.diff(touched) > _GAP)
    firsts = touched[np.concatenate([[0], breaks + 1])]
    lasts = touched[np.concatenate([breaks, [len(touched) - 1]])]
    for first, last in zip(firsts, lasts, strict=True):
        yield int(first), int(last) + 1


class SplatRenderer:
    """Draws a scene into an RGBA32F texture; row 0 of it is the first row of the picture.

    Transmittance is not cut at 1e-4 as the CPU engine does: blending runs from the back and cannot know what
    will cover a pixel. The difference is at most 1e-4 of the brightest hidden colour.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._project = load_program(ctx, "project.vert", varyings=PROJECTED.names or ())
        self._splat = load_program(ctx, "splat.vert", "splat.frag")
        self._scene: SplatTextures | None = None
        self._order = self._projected = None
        self._project_vao = self._splat_vao = None
        self._capacity = 0
        self._drawn = 0
        self._target: moderngl.Framebuffer | None = None

    def upload(self, scene: Gaussians) -> int:
        """Take a whole scene; gives the bytes sent."""
        count, coefficients = len(scene), min(int(scene.shN.shape[1]), _SHOWN_SH)
        if self._scene is None or (self._scene.count, self._scene.sh_coefficients) != (count, coefficients):
            if self._scene is not None:
                self._scene.release()
            self._scene = SplatTextures(self.ctx, count, coefficients)
            self._reserve(count)
        return self._scene.write(scene)

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> int:
        """Take the changed attributes of the changed rows (sorted); gives the bytes sent."""
        assert self._scene is not None, "upload comes first"
        return self._scene.write(scene, attributes, rows)

    def set_order(self, order: NDArray[np.uint32]) -> None:
        """Which Gaussians are drawn, farthest first; see `viewer.sort`."""
        self._drawn = len(order)
        if self._drawn:
            self._order.write(np.ascontiguousarray(order, ORDER))

    def draw(self, camera: Camera, background: Rgb, antialiased: bool = False) -> moderngl.Texture:
        """Draw with the uploaded scene and order.

        Args:
            camera: its size is the picture's
            background: linear rgb behind everything
            antialiased: as in `progdf.rasterize`

        Returns:
            premultiplied rgb over the background, and 1 − transmittance. RGBA32F, kept until the next draw
        """
        size = (camera.width, camera.height)
        if self._target is None or self._target.size != size:
            self._release_target()
            texture = self.ctx.texture(size, 4, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._target = self.ctx.framebuffer([texture])
        target = self._target
        target.use()  # also for the transform feedback: without a framebuffer it writes zeros
        target.clear(*background, 0.0)
        if self._drawn and self._scene is not None:
            self._scene.bind(self._project)
            _set_camera(self._project, camera)
            self._project["antialiased"] = antialiased
            self._project_vao.transform(self._projected, moderngl.POINTS, vertices=self._drawn)
            self.ctx.enable_only(moderngl.BLEND)
            self.ctx.blend_equation = moderngl.FUNC_ADD
            self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
            self._splat["size"] = size
            self._splat_vao.render(moderngl.TRIANGLES, vertices=3, instances=self._drawn)
        return target.color_attachments[0]

    def _reserve(self, count: int) -> None:
        if count <= self._capacity:
            return
        self._release_buffers()
        self._capacity = count
        self._order = self.ctx.buffer(reserve=count * ORDER.itemsize, dynamic=True)
        self._projected = self.ctx.buffer(reserve=count * PROJECTED.itemsize, dynamic=True)
        self._project_vao = self.ctx.vertex_array(self._project, [(self._order, "1u", "splat")])
        self._splat_vao = self.ctx.vertex_array(
            self._splat, [(self._projected, vertex_format(PROJECTED) + "/i", *(PROJECTED.names or ()))]
        )

    def _release_target(self) -> None:
        if self._target is not None:
            self._target.color_attachments[0].release()
            self._target.release()
            self._target = None

    def _release_buffers(self) -> None:
        for held in (self._project_vao, self._splat_vao, self._order, self._projected):
            if held is not None:
                held.release()

    def release(self) -> None:
        """Give everything back; the renderer is of no use afterwards."""
        self._release_target()
        self._release_buffers()
        if self._scene is not None:
            self._scene.release()
        self._project.release()
        self._splat.release()


def vertex_format(dtype: np.dtype[Any]) -> str:
    """moderngl's words for a dtype of float32 fields, e.g. "2f 3f 1f 4f"."""
    widths = (int(np.prod(dtype[name].shape, dtype=int)) for name in dtype.names or ())
    return " ".join(f"{width}f" for width in widths)


def _set_camera(program: moderngl.Program, camera: Camera) -> None:
    """The uniforms of project.vert; see there."""
    viewmat = camera.viewmat.double().numpy()
    # not −Rᵀt: a viewmat's rotation is one only within rounding, and coordinates may be large
    eye = np.linalg.solve(viewmat[:3, :3], -viewmat[:3, 3])
    high = eye.astype(np.float32)
    K = camera.K.double().numpy()
    program["rotation"].write(np.ascontiguousarray(viewmat[:3, :3].T, np.float32))
    program["eye_high"].write(high)
    program["eye_low"].write((eye - high).astype(np.float32))
    program["intrinsics"] = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    program["size"] = (float(camera.width), float(camera.height))
