"""What lies under the mouse: the picture, and where in it the cursor is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from viewer.camera.view_camera import ViewCamera, half_camera, half_scale, to_camera
from viewer.render.engine import ViewEngine
from viewer.state.selection import NOBODY, unpack
from viewer.state.view_state import ViewState
from viewer.state.workspace import SceneFacts

from .context import UiContext
from .overlay import Area


@dataclass(frozen=True)
class PointerContext:
    """What lies under the mouse in one frame.

    Args:
        engine: draws the picture
        facts: of the open scene
        shown: what the picture shows: the state, or the original while its key is held
        area: the part of the window that shows it
        ui: fonts and scale
        now: seconds on the main view's clock
        half: side by side, the one that the mouse is in, or was in when its drag began: 0 left, 1 right
    """

    engine: ViewEngine
    facts: SceneFacts
    shown: ViewState
    area: Area
    ui: UiContext
    now: float
    half: int = 0

    @property
    def is_beside(self) -> bool:
        """Whether the picture is two pictures of half the width."""
        return self.shown.compare.mode == "beside"

    @property
    def scale(self) -> float:
        """How large things are in the picture, of what they are where it has all of the area."""
        return half_scale(*self.size) if self.is_beside else 1.0

    @property
    def left(self) -> int:
        """The column in framebuffer pixels at which the picture under the mouse begins."""
        return self.half * (self.size[0] // 2) if self.is_beside else 0

    @property
    def size(self) -> tuple[int, int]:
        """The picture's width and height in framebuffer pixels."""
        density = imgui.get_io().display_framebuffer_scale
        return max(round(self.area.width * density.x), 1), max(round(self.area.height * density.y), 1)

    @property
    def cursor(self) -> tuple[float, float]:
        """Where the mouse is, in pixels of the picture."""
        mouse, density = imgui.get_io().mouse_pos, imgui.get_io().display_framebuffer_scale
        return mouse.x * density.x - self.left, mouse.y * density.y

    def camera(self, camera: ViewCamera) -> Camera:
        """`camera` as it takes the picture."""
        whole = to_camera(camera, *self.size)
        return half_camera(whole) if self.is_beside else whole

    @property
    def scene(self) -> Gaussians:
        """What the picture shows, without what is hidden; valid until another strength is drawn."""
        scene, hidden = self.engine.gaussians(self.shown), self.shown.selection.hidden
        if hidden == NOBODY:
            return scene
        drawn = torch.from_numpy(np.where(unpack(hidden, len(scene)), np.float32(-np.inf), np.float32(0.0)))
        return replace(scene, logit_opacities=scene.logit_opacities + drawn)
