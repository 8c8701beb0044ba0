"""Card of the tour, at the lower right of the picture."""

from __future__ import annotations

from imgui_bundle import imgui, imgui_ctx

from viewer.state.commands import Action, Plain, WithText
from viewer.state.workspace import STEP_NAMES, Workspace, end_tour, follow_tour, skip_step

from .context import PALETTE, SMALL_PX, UiContext
from .keys import shortcut
from .widgets import accent_button, plate

WIDE_PX = 272.0
"""Width at 1×."""
_EDGE_PX = 8.0  # distance from the picture's edges, at 1×
_PAD_PX = 16.0  # padding, at 1×
_TEXTS = {
    "move": ("Move", "Drag in the picture to orbit. The right button pans, the wheel zooms."),
    "slide": ("Slide", "Drag a slider in the panel. At 0 is the original, at 1 the whole edit."),
    "scribble": (
        "Scribble",
        "Choose Scribble{key}. Stroke the head, then the scarf with Ctrl. It selects the head.",
    ),
    "grade": ("Grade", "Open a new edit{key} and choose the editor Grade. Its sliders act at once."),
    "share": ("Share", "Export a web page{key}: one file, with your sliders, for any browser."),
}
_BUTTONS: dict[str, tuple[str, Action]] = {
    "scribble": ("Scribble", WithText("select_tool", "scribble")),
    "grade": ("New edit…", Plain("new_edit")),
    "share": ("Web page…", Plain("export_page")),
}
"""Label and command of the button of a step."""
_KEYS = {"scribble": "select_tool:scribble", "grade": "new_edit", "share": "export_page"}


def draw(work: Workspace, right: float, bottom: float, ui: UiContext) -> tuple[Workspace, Action | None]:
    """Draw the current step of the tour, if it runs, or the next one if the user has done it.

    Args:
        work: the state to show and change
        right: right edge of the picture, window pixels
        bottom: lower edge of the free part of the picture, window pixels
        ui: fonts and scale

    Returns:
        The workspace; the action of the step's button, None for none.
    """
    work = follow_tour(work, imgui.is_any_mouse_down())
    running = work.transient.tour
    if running is None:
        return work, None
    name = STEP_NAMES[running.step]
    title, text = _TEXTS[name]
    key = shortcut(_KEYS[name]) if name in _KEYS else ""
    text = text.format(key=f" ({key})" if key else "")
    edge = _EDGE_PX * ui.scale
    requested = None
    size = (min(WIDE_PX * ui.scale, right - 2 * edge), 0.0)
    with plate("tour", (right - edge, bottom - edge), ui, (1.0, 1.0), _PAD_PX, size):
        count = f"{running.step + 1} of {len(STEP_NAMES)}"
        with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
            imgui.text(title)
        with imgui_ctx.push_font(None, SMALL_PX):
            imgui.same_line(size[0] - _PAD_PX * ui.scale - imgui.calc_text_size(count).x)
            imgui.text_disabled(count)
        with imgui_ctx.push_text_wrap_pos(0.0):
            imgui.text_colored(PALETTE.text, text)
        imgui.dummy((0.0, 2.0 * ui.scale))
        if imgui.button("Skip"):
            work = end_tour(work)
        if name in _BUTTONS:
            label, action = _BUTTONS[name]
            imgui.same_line()
            if imgui.button(label):
                requested = action
        next_text = "Done" if running.step + 1 == len(STEP_NAMES) else "Next"
        wide = imgui.calc_text_size(next_text).x + 4 * imgui.get_style().frame_padding.x
        imgui.same_line(size[0] - _PAD_PX * ui.scale - wide)
        if accent_button(next_text, (wide, 0.0)):
            work = skip_step(work)
    return work, requested
