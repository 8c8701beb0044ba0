"""Jobs in the panel, training and deliveries: a card each, with its progress and buttons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.jobs.job_queue import Job
from viewer.jobs.training import EditOrder, duration
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.widgets import card, elide, menu, right_edge, small, small_toggle, tip

BAR_PX = 5.0
STARVED = "Waits for the processor"
_MENU = "menu of a training"
_UNWRITTEN = "Nothing is written"


def draw(jobs: Sequence[Job], ui: UiContext, actions: list[str]) -> None:
    """One card a job, the next one at the bottom."""
    for job in jobs:
        if job.status != "done" or job.warning:
            imgui.push_id(job.number)
            actions += _card(_job_row(job), job.number, ui)
            imgui.pop_id()


@dataclass(frozen=True)
class _Row:
    """A card: its name and tip, the word at the right, the bar, the line below, its buttons and its menu."""

    name: str
    tip: str
    word: str
    share: float
    said: str
    failed: bool
    runs: bool
    buttons: tuple[tuple[str, str, str], ...]
    menu: tuple[tuple[str, str, bool], ...] = ()


def _job_row(job: Job) -> _Row:
    task, failed = job.task, job.status == "failed" or bool(job.warning)
    about = str(task.out)
    if isinstance(task, EditOrder):
        about = f"{task.name}\n{task.editor} on {task.region}\n{task.out}"
    line = (
        (job.error or job.warning)
        if failed
        else f"For {job.elsewhere}  ·  " * bool(job.elsewhere) + _status_text(job)
    )
    runs = job.status == "running" and not job.starved
    items = ("Show log…", "run_log", True), ("Discard…", "ask_discard", job.status in ("stopped", "failed"))
    row = _Row(task.name, about, _status(job), job.progress.share, line, failed, runs, _buttons(job))
    return replace(row, menu=items) if isinstance(task, EditOrder) and job.status != "queued" else row


def _card(row: _Row, number: int, ui: UiContext) -> list[str]:
    with card("card", PALETTE.card, ui):
        right = right_edge()
        wide = imgui.calc_text_size(row.word).x
        imgui.align_text_to_frame_padding()
        imgui.text(elide(row.name, right - wide - 16.0 * ui.scale))
        tip(row.tip)
        imgui.same_line(right - wide)
        imgui.text_colored(imgui.ImVec4(*(PALETTE.error if row.failed else PALETTE.dim)), row.word)
        _bar(row, ui)
        actions = _foot(row, right, ui) + _menu(row, ui)
        return [f"{action}:{number}" for action in actions]


def _status(job: Job) -> str:
    if job.status in ("running", "elsewhere"):
        return f"{100 * job.progress.share:.0f} %" if job.progress.share else ""
    return job.status.capitalize()


def _bar(row: _Row, ui: UiContext) -> None:
    """How far it is."""
    x, y = imgui.get_cursor_screen_pos()
    wide, tall = imgui.get_content_region_avail().x, BAR_PX * ui.scale
    imgui.dummy(imgui.ImVec2(wide, tall))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(x + wide, y + tall)
    canvas.add_rect_filled(imgui.ImVec2(x, y), end, u32(PALETTE.field), tall / 2)
    color = PALETTE.error if row.failed else PALETTE.accent if row.runs else PALETTE.faint
    if row.share:
        reached = imgui.ImVec2(x + max(row.share * wide, tall), y + tall)
        canvas.add_rect_filled(imgui.ImVec2(x, y), reached, u32(color), tall / 2)


def _foot(row: _Row, right: float, ui: UiContext) -> list[str]:
    """What it does, or why it failed; at the right its buttons."""
    imgui.push_font(None, SMALL_PX)
    more = (Icon.MENU, _MENU, "Log, discard (right-click)")
    buttons = (*row.buttons, more) if row.menu else row.buttons
    widths = [imgui.calc_text_size(text).x + 12.0 * ui.scale for text, _, _ in buttons]
    imgui.pop_font()
    if row.failed:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(imgui.ImVec4(*PALETTE.error), row.said)
        imgui.pop_text_wrap_pos()
        small(" ", PALETTE.dim)
    else:
        small(row.said, PALETTE.dim, right - imgui.get_cursor_pos_x() - sum(widths) - 6.0 * ui.scale)
        tip(row.said)
    actions: list[str] = []
    x = right - sum(widths)
    for (text, action, help_), wide in zip(buttons, widths, strict=True):
        imgui.same_line(x)
        if small_toggle(action, text, False, wide, ui):
            if action == _MENU:
                imgui.open_popup(_MENU)
            else:
                actions.append(action)
        if help_:
            tip(help_)
        x += wide
    return actions


def _menu(row: _Row, ui: UiContext) -> list[str]:
    """What is seldom wanted, and what cannot be undone."""
    actions = []
    right = imgui.is_mouse_clicked(imgui.MouseButton_.right.value)
    if row.menu and right and imgui.is_window_hovered():
        imgui.open_popup(_MENU)
    with menu(_MENU, ui) as is_open:
        for name, action, can in row.menu if is_open else ():
            if imgui.menu_item(name, "", False, can)[0]:
                actions.append(action)
    return actions


def _status_text(job: Job) -> str:
    progress = job.progress
    match job.status:
        case "running" if job.starved:
            return STARVED
        case "running":
            left = job.seconds_left
            finds = isinstance(job.task, EditOrder) and job.task.region == "changed"
            starting = "Finding what changed" if finds else "Starting"
            words = [progress.label or starting]
            words += [f"{duration(left)} left"] if left is not None else []
            words += [f"loss {progress.loss}"] if progress.loss else []
            return "  ·  ".join(words)
        case "queued":
            return "Waits for the one before"
        case "stopping":
            return "Saving what is done" if isinstance(job.task, EditOrder) else _UNWRITTEN
        case "elsewhere":
            return "Trains in another window"
    return f"{100 * progress.share:.0f} % is done" if progress.share else "Can go on where it was"


def _buttons(job: Job) -> tuple[tuple[str, str, str], ...]:
    """Text, action and help."""
    trains = isinstance(job.task, EditOrder)
    match job.status:
        case "running":
            return (
                ("Stop", "stop_run", "Stop; it can be resumed, also another day" if trains else _UNWRITTEN),
            )
        case "queued":
            return (("Cancel", "stop_run", "Take it off the queue"),)
        case "stopped":
            return (("Resume", "resume_run", "Go on where it was stopped"),)
        case "failed" if trains:
            return (("Retry", "resume_run", "Try again"),)
        case "failed":
            return (("Close", "close_run", ""),)
        case "done":
            return (("Close", "close_run", "Takes the card away; the edit stays"),)
    return ()
