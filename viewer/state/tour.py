"""Tour of the window in five steps. The user's own action finishes a step, or a button skips it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from .commands import Action, Plain, WithText
from .transient import Tour
from .workspace import Workspace, with_transient

_SHARES = ("export", "export_page", "render_picture", "render_film")
"""Dialogs that export something."""

STEPS: dict[str, Callable[[Workspace], object]] = {
    "move": lambda work: work.view.camera,
    "slide": lambda work: tuple(layer.strength for layer in work.view.layers),
    "scribble": lambda work: [strokes for strokes in work.transient.tool.strokes if len(strokes.beside)],
    "grade": lambda work: work.form_open and work.form.choice.setting == "grade",
    "share": lambda work: work.dialog is not None and work.dialog.kind in _SHARES,
}
"""Name of each step, and the value whose change finishes it."""
NAMES = (*STEPS,)
BUTTONS: dict[str, tuple[str, Action]] = {
    "scribble": ("Scribble", WithText("select_tool", "scribble")),
    "grade": ("New edit…", Plain("new_edit")),
    "share": ("Web page…", Plain("export_page")),
}
"""Label and command of the button of a step."""


def start(work: Workspace) -> Workspace:
    """Start the tour from its first step."""
    return _to_step(work, 0)


def follow(work: Workspace, held: bool) -> Workspace:
    """Go to the next step if the user has done the current one.

    Args:
        held: a mouse button is down, so that the action is not finished
    """
    tour = work.transient.tour
    if tour is None or held:
        return work
    return work if STEPS[NAMES[tour.step]](work) == tour.before else skip_step(work)


def skip_step(work: Workspace) -> Workspace:
    """Go to the next step; end the tour after the last one."""
    tour = work.transient.tour
    if tour is None or tour.step + 1 == len(STEPS):
        return end(work)
    return _to_step(work, tour.step + 1)


def end(work: Workspace) -> Workspace:
    """End the tour, so that no example starts it again."""
    return replace(with_transient(work, tour=None), layout=replace(work.layout, toured=True))


def _to_step(work: Workspace, step: int) -> Workspace:
    return with_transient(work, tour=Tour(step, STEPS[NAMES[step]](work)))
