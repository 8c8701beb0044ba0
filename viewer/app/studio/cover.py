"""A picture that lies over the view, as long as one looks from where it was made."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.camera.view_camera import ViewCamera
from viewer.state.view_state import ViewState
from viewer.ui import overlay
from viewer.ui.context import UiContext


@dataclass(frozen=True)
class Cover:
    """A picture, and where it belongs.

    Args:
        texture: its GL name
        camera: where one looks from
        size: of the view, pixels
        name: what is said above it
    """

    texture: int
    camera: ViewCamera
    size: tuple[int, int]
    name: str = ""


def draw(cover: Cover, view: ViewState, size: tuple[int, int], area: overlay.Area, ui: UiContext) -> None:
    """Draw it over the view, where it belongs there."""
    if (cover.camera, cover.size) != (view.camera, size) or view.compare.mode != "off":
        return
    corners = imgui.ImVec2(0.0, 0.0), imgui.ImVec2(area.width, area.height)
    imgui.get_background_draw_list().add_image(imgui.ImTextureRef(cover.texture), *corners)
    overlay.banner(cover.name, area, ui)
