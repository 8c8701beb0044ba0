"""What lies under the mouse: the picture, and where in it the cursor is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from viewer.camera.view_camera import ViewCamera, to_camera
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
    """

    engine: ViewEngine
    facts: SceneFacts
    shown: ViewState
    area: Area
    ui: UiContext
    now: float

    @property
    def size(self) -> tuple[int, int]:
        """The picture's width and height in framebuffer pixels."""
        density = imgui.get_io().display_framebuffer_scale
        return max(round(self.area.width * density.x), 1), max(round(self.area.height * density.y), 1)

    @property
    def cursor(self) -> tuple[float, float]:
        """Where the mouse is, in pixels of the picture."""
        mouse, density = imgui.get_io().mouse_pos, imgui.get_io().display_framebuffer_scale
        return mouse.x * density.x, mouse.y * density.y

    def camera(self, camera: ViewCamera) -> Camera:
        """`camera` as it takes the picture."""
        return to_camera(camera, *self.size)

    @property
    def scene(self) -> Gaussians:
        """What the picture shows, without what is hidden; valid until another strength is drawn."""
        scene, hidden = self.engine.gaussians(self.shown), self.shown.selection.hidden
        if hidden == NOBODY:
            return scene
        drawn = torch.from_numpy(np.where(unpack(hidden, len(scene)), np.float32(-np.inf), np.float32(0.0)))
        return replace(scene, logit_opacities=scene.logit_opacities + drawn)
