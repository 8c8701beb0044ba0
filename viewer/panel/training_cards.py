"""Training, export and render jobs at the bottom of the panel: a strip that unfolds to one card per job."""

from __future__ import annotations

from collections.abc import Sequence

from imgui_bundle import imgui, imgui_ctx

from progdf.terminal import format_duration
from viewer.state.commands import Action, OnItem
from viewer.state.workspace import JobCard
from viewer.ui.context import PALETTE, SMALL_PX, Icon, Rgba, UiContext, u32
from viewer.ui.widgets import SEPARATOR_PX, card, elide, menu_items, right_edge, small, tip, wrapped_text

BAR_PX = 5.0  # height of a progress bar, at 1×
STRIP_PX = 28.0  # height of the strip, at 1×
_BUTTON_PAD_PX = 2.0  # above and below the text of a button, at 1×
_MENU = "menu of a training"
_DISCARD = "Discard…"
_NOTHING_WRITTEN = "No file will be written"


def height(jobs: Sequence[JobCard], ui: UiContext) -> float:
    """Return the height of the strip and its unfolded cards, in window pixels."""
    if not _visible_jobs(jobs):
        return 0.0
    storage = imgui.get_state_storage()
    cards = (
        storage.get_float(imgui.get_id(_HEIGHT_SLOT)) if storage.get_bool(imgui.get_id(_OPEN_SLOT)) else 0.0
    )
    gaps = 3 if cards else 2
    return float(STRIP_PX * ui.scale + gaps * imgui.get_style().item_spacing.y + cards) + SEPARATOR_PX


def draw(jobs: Sequence[JobCard], ui: UiContext, actions: list[Action]) -> None:
    """Draw the strip and its unfolded cards; a new failure or poor result unfolds it."""
    listed = _visible_jobs(jobs)
    storage = imgui.get_state_storage()
    if not listed:
        return
    is_open = imgui.get_id(_OPEN_SLOT)
    seen = imgui.get_id("seen failure")
    tall = imgui.get_id(_HEIGHT_SLOT)
    failed = max((job.number for job in listed if _calls_for_attention(job)), default=0)
    unseen = failed > storage.get_int(seen)
    if unseen:
        storage.set_bool(is_open, True)
    imgui.separator()
    if storage.get_bool(is_open):
        room = 0.5 * imgui.get_window_height()
        old_height = storage.get_float(tall)
        bar = 0
        if old_height < room:
            bar = imgui.WindowFlags_.no_scrollbar.value  # hidden while the cards grow
        imgui.begin_child("jobs", (0.0, max(min(old_height, room), 1.0)), 0, bar)
        slots = list[tuple[int, float]]()
        for number, job, gap in _rows(listed, ui.job_slots):
            top = imgui.get_cursor_pos_y()
            if job is None:
                imgui.dummy((1.0, gap - imgui.get_style().item_spacing.y))
            else:
                with imgui_ctx.push_id(str(number)):
                    actions += _card(job, ui)
            if unseen and number == failed:
                imgui.set_scroll_here_y(1.0)
            slots.append((number, imgui.get_cursor_pos_y() - top))
        needed = imgui.get_cursor_pos_y() - imgui.get_style().item_spacing.y
        pressed = imgui.HoveredFlags_.allow_when_blocked_by_active_item.value  # a press in a gap keeps it
        is_hovered = imgui.is_window_hovered(imgui.HoveredFlags_.child_windows.value | pressed)
        if is_hovered:
            needed = max(needed, old_height)  # the other buttons stay under the pointer as a card closes
        ui.job_slots = tuple(slots) if is_hovered else ()
        imgui.end_child()
        storage.set_float(tall, min(needed, room))
        if old_height == min(needed, room):  # the cards have their final heights
            storage.set_int(seen, failed)
    if _strip(listed, storage.get_bool(is_open), ui):
        storage.set_bool(is_open, not storage.get_bool(is_open))


def _rows(
    jobs: Sequence[JobCard], slots: Sequence[tuple[int, float]]
) -> list[tuple[int, JobCard | None, float]]:
    """Return the rows of the list: the cards, and a gap where a card has closed under the mouse.

    Args:
        jobs: jobs with a card
        slots: number and height of the rows while the mouse is over the list, else empty

    Returns:
        Number, job (None for a gap), and height in the last frame, in window pixels.
    """
    known = {job.number: job for job in jobs}
    heights = dict(slots)
    numbers = [*heights, *(number for number in known if number not in heights)]
    return [(number, known.get(number), heights.get(number, 0.0)) for number in numbers]


_OPEN_SLOT = "jobs are open"
_HEIGHT_SLOT = "height of the jobs"


def _visible_jobs(jobs: Sequence[JobCard]) -> list[JobCard]:
    """Return the jobs that have a card. A finished edit needs one only if it offers to continue."""
    return [job for job in jobs if job.status != "done" or job.warning or job.offer or not job.training]


def _is_failed(job: JobCard) -> bool:
    return job.status == "failed"


def _calls_for_attention(job: JobCard) -> bool:
    return _is_failed(job) or bool(job.warning or job.offer)


def _status_color(job: JobCard, otherwise: Rgba) -> Rgba:
    """Return the color of a job's status: red for a failure, amber for a poor result."""
    if _is_failed(job):
        return PALETTE.error
    return PALETTE.warning if job.warning else otherwise


def _strip(jobs: Sequence[JobCard], is_open: bool, ui: UiContext) -> bool:
    """Draw one line with the most important job and the number of others; return True if it was pressed."""
    order = ("failed", "running", "stopping", "done")
    job = min(jobs, key=lambda job: order.index(job.status) if job.status in order else len(order))
    start = imgui.get_cursor_pos()
    right = right_edge()
    tall = STRIP_PX * ui.scale
    (x, y), dot = imgui.get_cursor_screen_pos(), 4.0 * ui.scale
    pressed = imgui.invisible_button("strip", (imgui.get_content_region_avail().x, tall))
    tip("Show or hide the cards of all jobs")
    color = _status_color(job, PALETTE.accent if job.status == "running" else PALETTE.dim)
    imgui.get_window_draw_list().add_circle_filled((x + dot, y + tall / 2), dot, u32(color))
    end = (f"+{len(jobs) - 1}   " if len(jobs) > 1 else "") + (Icon.UNFOLDED if is_open else Icon.RAISED)
    left = job.seconds_left
    status = f"{_status(job)}  ·  {format_duration(left)}" if left is not None else _status(job)
    below = imgui.get_cursor_pos()
    sizes = [imgui.calc_text_size(text).x for text in (status, end)]
    top = start.y + (tall - imgui.get_text_line_height()) / 2
    imgui.set_cursor_pos((start.x + 4 * dot, top))
    imgui.text(elide(job.name, right - start.x - sum(sizes) - 8 * dot))
    for text, at in ((status, 0.0), (end, right - sizes[1])):
        imgui.same_line(at)
        imgui.text_disabled(text)
    imgui.set_cursor_pos(below)
    return bool(pressed)


def _card(job: JobCard, ui: UiContext) -> list[Action]:
    """Draw name, status, progress and buttons of a job, and its menu; return the requested actions."""
    word = _status(job)
    with card("card", PALETTE.card, ui):
        right = right_edge()
        wide = imgui.calc_text_size(word).x
        imgui.align_text_to_frame_padding()
        imgui.text(elide(job.name, right - wide - 16.0 * ui.scale))
        about = f"{job.name}\n{job.training}\n" if job.training else ""
        tip(f"{about}{job.out}")
        imgui.same_line(right - wide)
        imgui.text_colored(_status_color(job, PALETTE.dim), word)
        color = PALETTE.accent if job.status == "running" else PALETTE.faint
        _bar(job.share, _status_color(job, color), ui)
        menu = bool(about) and job.status != "queued"
        actions = _foot(job, right, menu, ui)
        right_click = imgui.is_mouse_clicked(imgui.MouseButton_.right.value) and imgui.is_window_hovered()
        if _MENU in actions or (menu and right_click):
            actions = []
            imgui.open_popup(_MENU)
        requested: list[Action] = [OnItem(name, job.number) for name in actions]
        items = (
            ("Show log…", OnItem("run_log", job.number), ""),
            (_DISCARD, OnItem("ask_discard", job.number), ""),
        )
        off = () if job.status in ("stopped", "failed") else (_DISCARD,)
        chosen = menu_items(_MENU, items, ui, off)
        return [*requested, *(action for action in chosen if action is not None)]


def _status(job: JobCard) -> str:
    if job.status == "running":
        return f"{100 * job.share:.0f} %" if job.share else ""
    return job.status.capitalize()


def _bar(share: float, color: Rgba, ui: UiContext) -> None:
    """Draw the progress bar."""
    x, y = imgui.get_cursor_screen_pos()
    wide = imgui.get_content_region_avail().x
    tall = BAR_PX * ui.scale
    imgui.dummy((wide, tall))
    for reach, ink in ((1.0, PALETTE.field), (share, color)):
        if reach:
            end = (x + max(reach * wide, tall), y + tall)
            imgui.get_window_draw_list().add_rect_filled((x, y), end, u32(ink), tall / 2)


def _foot(job: JobCard, right: float, menu: bool, ui: UiContext) -> list[str]:
    """Draw the current step, or the error, and the buttons at the right."""
    buttons = list(_BUTTONS.get((job.status, bool(job.training)), ()))
    if job.keepable:
        buttons.insert(0, _KEEP)
    if job.status == "stopping" and job.sends_pictures:
        buttons.append(_LEAVE_PICTURES)
    if job.offer:
        buttons = [*_OFFER_BUTTONS, *buttons]
    if menu:
        buttons.append((Icon.MENU, _MENU, "Log, discard (right-click)"))
    with imgui_ctx.push_font(None, SMALL_PX):
        around = 2 * imgui.get_style().frame_padding.x
        widths = [imgui.calc_text_size(text).x + around for text, _, _ in buttons]
    if _calls_for_attention(job):
        lines = [job.error or job.warning, job.offer]
        wrapped_text("\n".join(line for line in lines if line), _status_color(job, PALETTE.text))
        small(" ", PALETTE.dim)
    else:
        line = _status_text(job)
        if job.elsewhere:
            line = f"For {job.elsewhere}  ·  {line}"
        small(line, PALETTE.dim, right - imgui.get_cursor_pos_x() - sum(widths) - 6.0 * ui.scale)
        tip(line)
    actions = []
    x = right - sum(widths)
    imgui.push_style_color(imgui.Col_.button, (0.0, 0.0, 0.0, 0.0))
    pad = _BUTTON_PAD_PX * ui.scale
    imgui.push_style_var(imgui.StyleVar_.frame_padding, (imgui.get_style().frame_padding.x, pad))
    for (text, action, help_), wide in zip(buttons, widths, strict=True):
        imgui.same_line(x)
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() - pad)  # its text is in line with the step
        with imgui_ctx.push_font(None, SMALL_PX):
            if imgui.button(f"{text}##{action}"):
                actions.append(action)
        if help_:
            tip(help_)
        x += wide
    imgui.pop_style_var()
    imgui.pop_style_color()
    return actions


def _status_text(job: JobCard) -> str:
    match job.status:
        case "running":
            left = job.seconds_left
            words = ["Ready; writing the report" if job.delivered else job.label]
            words += [f"{format_duration(left)} left"] if left is not None else []
            words += [f"loss {job.loss}"] if job.loss else []
            return "  ·  ".join(words)
        case "queued":
            return "Waiting for the previous job"
        case "stopping":
            if job.sends_pictures:
                return "Waiting for the server"
            return "Saving the state" if job.training else _NOTHING_WRITTEN
        case "done":
            return ""
    if job.delivered:
        return "Ready; the report is incomplete"
    return f"{100 * job.share:.0f} % done" if job.share else "Can be resumed"


_STOP_HELP = "Stop; the run can be resumed later, and a finished layer stays"
_KEEP = ("Keep as it is", "keep_run", "Make a layer of the newest recording; Resume can still finish the run")
_LEAVE_PICTURES = ("Stop now", "stop_run", "Leave the pictures that the server is making, paid or not")
_CANCEL = ("Cancel", "stop_run", "Remove it from the queue")
_CLOSE = ("Close", "close_run", "Remove the card; files are kept")
_OFFER_BUTTONS = (
    (
        "Continue all around",
        "carry_on",
        "Train again, with the color map on parts that the picture does not show",
    ),
    ("From behind", "look_behind", "Show the continued edit from behind"),
)
_BUTTONS = {
    ("running", True): (("Stop", "stop_run", _STOP_HELP),),
    ("running", False): (("Stop", "stop_run", _NOTHING_WRITTEN),),
    ("queued", True): (_CANCEL,),
    ("queued", False): (_CANCEL,),
    ("stopped", True): (("Resume", "resume_run", "Continue from the saved progress"),),
    ("failed", True): (("Retry", "resume_run", "Start again, from the saved progress if there is any"),),
    ("failed", False): (_CLOSE,),
    ("done", True): (_CLOSE,),
    ("done", False): (("Show in folder", "show_file", ""), ("Copy path", "copy_path", ""), _CLOSE),
}
"""Text, action and tooltip of the buttons. Keys: status, and True for a training."""
