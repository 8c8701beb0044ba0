"""How two pictures are compared: the choices, and switching between them."""

from __future__ import annotations

from dataclasses import replace

from .view_state import AGAINST, ViewState


def toggle_mode(view: ViewState, mode: str) -> ViewState:
    """`mode` on, or off where it was on."""
    mode = "off" if view.compare.mode == mode else mode
    return replace(view, compare=replace(view.compare, mode=mode))


def toggle_against(view: ViewState) -> ViewState:
    """Against the recording instead of the original, or back; where nothing is compared, side by side."""
    compare = view.compare
    if compare.mode == "off":
        return replace(view, compare=replace(compare, mode="split", against="recorded"))
    against = AGAINST[1 - AGAINST.index(compare.against)]
    return replace(view, compare=replace(compare, against=against))
