"""Screenshots of new edits, the menu and the start page on a software GPU."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app.main_view import MainView
from viewer.app.parts.start import EXAMPLE_TITLES
from viewer.files.document import empty
from viewer.jobs.child import Progress
from viewer.jobs.job_queue import Delivery, QueuedTask, job_card
from viewer.jobs.training import EditOrder
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.commands import Action, OnItem
from viewer.state.forms import TYPED, DeliverOptions, NewEdit
from viewer.state.transient import StartFile
from viewer.state.view_state import ViewState
from viewer.state.workspace import Dialog, JobCard, with_transient
from viewer.ui.splash import MINIMUM_SIZE_PX

Compare = Callable[[str, np.ndarray], None]
SMALLEST = (1024, 640)
pytestmark = [pytest.mark.gl, pytest.mark.usefixtures("software_gpu")]


def test_screenshot_of_the_start_page_with_recent_files(screenshot: Compare) -> None:
    context = headless_context()
    document = empty()
    engine = ViewEngine(context, document.scene, (), "cpu")
    main_view = MainView(context, engine, document.facts(), ViewState())
    pixels = np.full((252, 336, 3), (96, 120, 150), np.uint8)
    texture = context.texture((336, 252), 3, pixels.tobytes(), alignment=1)
    names = ("bear.ply", "garden.session.json", "a scene with a name that is too long.spz")
    lines = ("just now  ·  ~/scenes", "Moved?  ·  ~/scenes", "3 days ago  ·  ~/work")
    recent = tuple(
        StartFile(Path("/scenes") / name, texture.glo * (i < 2), line=lines[i], missing=i == 1)
        for i, name in enumerate(names)
    )
    examples = tuple(StartFile(path, texture.glo, *about) for path, about in EXAMPLE_TITLES.items())
    main_view.store.replace(with_transient(main_view.work, start_files=recent, examples=examples))
    try:
        screenshot("ui_start_page", Rig(main_view, SMALLEST, 1.0).image())
    finally:
        main_view.close()
        engine.release()
        context.release()


def test_screenshot_of_the_menu(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7, 0.5), SMALLEST) as hand:
        hand.main_view.store.replace(with_transient(hand.main_view.work, recent=(Path("/scenes/bear.ply"),)))
        hand.click(999.0, 20.0)
        hand.move(880.0, 400.0)
        hand.frame(3)
        screenshot("ui_menu", hand.image()[:320, 640:])


def test_screenshot_of_the_new_edit_form(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7), SMALLEST) as hand:
        form = NewEdit(
            TYPED, "sphere:0,0,0,1", editor=6, name="painted", error="the region holds no Gaussian"
        )
        hand.main_view.store.replace(replace(hand.main_view.work, form=form))
        hand.key("Ctrl+N")
        screenshot("ui_new_edit", hand.image()[:, 700:])


def test_screenshot_of_run_cards_and_a_film(screenshot: Compare) -> None:
    order = EditOrder(Path("bear.ply"), Path("/scenes/bear.edits/blue"), "blue", "all", "recolor:#3060d0")
    running = QueuedTask(1, order, "running", Progress(0.45, "Training", "0.0114"), 20.0)
    line = "region 'sphere:99,99,99,1' holds no Gaussian"
    jobs = (
        running,
        QueuedTask(2, replace(order, name="gold")),
        QueuedTask(3, replace(order, name="night"), "stopped", Progress(0.6)),
        QueuedTask(4, replace(order, name="nowhere"), "failed", error=line),
    )
    film = Delivery("Film film.mp4", Path("/scenes/film.mp4"), (), Path("film.log"), Path("bear.ply"))
    frames = Progress(30 / 96, "frame 30 of 96")
    with rig(first_view(bear(), 0.7), SMALLEST) as hand:
        hand.main_view.store.replace(
            replace(
                hand.main_view.work,
                jobs=tuple(map(job_card, (*jobs, QueuedTask(5, film, "running", frames, 10.0)))),
            )
        )
        hand.settle()
        hand.frame(3)
        screenshot("ui_training", hand.image()[:, 700:])


def test_screenshot_of_the_film_question(screenshot: Compare) -> None:
    with rig(first_view(bear(), 0.7), SMALLEST) as hand:
        options = DeliverOptions(1280, 720, moves="scarf", can_move=("scarf",))
        hand.main_view.messages.ask(Dialog("render_film", "/scenes/bear_edited.mp4", options=options))
        hand.frame(4)
        screenshot("ui_film", hand.image()[:420, :720])


def test_screenshot_of_two_failures_with_whole_buttons(screenshot: Compare) -> None:
    film = Delivery("Film film.mp4", Path("/scenes/film.mp4"), (), Path("film.log"), Path("bear.ply"))
    line = "no frame could be written: the disk takes no more, free some space"
    jobs = tuple(QueuedTask(number, replace(film), "failed", error=line) for number in (1, 2))
    with rig(first_view(bear(), 0.7), MINIMUM_SIZE_PX) as hand:
        for count in (1, 2):
            hand.main_view.store.replace(
                replace(hand.main_view.work, jobs=tuple(map(job_card, jobs[:count])))
            )
            hand.main_view.wake()
            hand.settle()
        screenshot("ui_failures", hand.image()[:, 330:])
        closes = [
            y
            for y in range(MINIMUM_SIZE_PX[1] - 120, MINIMUM_SIZE_PX[1] - 60, 2)
            if not hand.click(MINIMUM_SIZE_PX[0] - 60.0, float(y))
            and hand.main_view.take_requests() == (OnItem("close_run", 2),)
        ]
        assert closes[-1] - closes[0] >= 12, "one hits it anywhere"


def test_closed_card_leaves_a_gap_until_the_mouse_leaves(software_gpu: None) -> None:
    film = Delivery("Film film.mp4", Path("/scenes/film.mp4"), (), Path("film.log"), Path("bear.ply"))
    cards = tuple(job_card(QueuedTask(number, film, "failed", error="no space")) for number in (1, 2, 3))

    def closed_by(hand: Rig, jobs: tuple[JobCard, ...], y: float) -> tuple[Action, ...]:
        hand.main_view.store.replace(replace(hand.main_view.work, jobs=jobs))
        hand.main_view.wake()
        hand.settle()
        hand.click(SMALLEST[0] - 60.0, y)
        return hand.main_view.take_requests()

    with rig(first_view(bear(), 0.7), SMALLEST) as hand:
        found = {closed_by(hand, cards, float(y)): float(y) for y in range(342, 468, 6)}
        first, second = (found[(OnItem("close_run", number),)] for number in (1, 2))
        assert closed_by(hand, cards, first) == (OnItem("close_run", 1),)
        assert closed_by(hand, cards[1:], first) == (), "the second card has not moved here"
        assert closed_by(hand, cards[1:], second) == (OnItem("close_run", 2),)
        hand.move(100.0, 100.0)
        hand.settle()
        assert hand.main_view.ui.job_slots == ()


def test_second_click_on_the_stop_button_resumes(software_gpu: None) -> None:
    order = EditOrder(Path("bear.ply"), Path("/scenes/bear.edits/blue"), "blue", "all", "recolor:#3060d0")
    running = QueuedTask(1, order, "running", Progress(0.45, "Training", "0.0114"), 20.0)
    with rig(first_view(bear(), 0.7), SMALLEST) as hand:
        hand.main_view.store.replace(replace(hand.main_view.work, jobs=(job_card(running),)))
        hand.settle()
        hand.click(SMALLEST[0] - 150.0, SMALLEST[1] - 55.0)  # opens the strip of jobs
        hand.settle()

        def asked(job: QueuedTask, x: float, y: float) -> tuple[str, ...]:
            hand.main_view.store.replace(replace(hand.main_view.work, jobs=(job_card(job),)))
            hand.settle()
            hand.click(x, y)
            return hand.main_view.take_requests()

        box = hand.box("stop_run")
        corners = itertools.product((box.left + 2.0, box.right - 2.0), (box.top + 2.0, box.bottom - 2.0))
        stops = [corner for corner in corners if asked(running, *corner) == (OnItem("stop_run", 1),)]
        assert len(stops) == 4
        found = {asked(replace(running, status="stopped"), x, y) for x, y in stops}
        assert found == {(OnItem("resume_run", 1),)}
