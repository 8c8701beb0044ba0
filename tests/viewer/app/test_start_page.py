"""Start page: examples, recent files, mouse and keyboard."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.io.atomic import state_folder
from tests.helpers.null_app import null_app, null_platform
from tests.helpers.ui_rig import Rig, bear
from viewer.app import app as application
from viewer.app.main_view import MainView
from viewer.app.parts.start import EXAMPLE_TITLES
from viewer.files import document as documents
from viewer.files.document import empty
from viewer.files.user_files import describe_age, keep_thumbnail, read_recent, remember_recent
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.commands import Plain, WithText
from viewer.state.transient import StartFile
from viewer.state.view_state import ViewState
from viewer.state.workspace import with_transient
from viewer.ui.splash import Splash

pytestmark = pytest.mark.gl
LARGEST = 6 << 20
"""Maximum size of all examples in the wheel, bytes."""


@pytest.fixture
def window(tmp_path: Path) -> Iterator[application.App]:
    with null_app(empty(), ViewState(), tmp_path) as app:
        turn(app)
        yield app


def turn(app: application.App) -> None:
    app._wait_times()
    app.main_view.wake()
    app.draw()


@pytest.fixture
def hand() -> Iterator[Rig]:
    """Yield a start page with the examples in a window of 900x640 points."""
    context = headless_context()
    document = empty()
    engine = ViewEngine(context, document.scene, (), "cpu")
    main_view = MainView(context, engine, document.facts(), ViewState())
    recent = (StartFile(Path("/scenes/bear.ply")), StartFile(Path("/scenes/gone.ply"), missing=True))
    examples = tuple(StartFile(path) for path in EXAMPLE_TITLES)
    main_view.store.replace(with_transient(main_view.work, start_files=recent, examples=examples))
    yield Rig(main_view, (900, 640), 1.0)
    main_view.close()
    engine.release()
    context.release()


def type_keys(hand: Rig, *keys: imgui.Key) -> None:
    """Send keys to imgui itself."""
    for key in keys:
        for down in (True, False):
            hand.modifier(key, down)
    hand.settle()


@pytest.mark.slow
@pytest.mark.parametrize("bundle", [*EXAMPLE_TITLES], ids=lambda path: path.name.partition(".")[0])
def test_example_opens_with_its_edits(window: application.App, bundle: Path, tmp_path: Path) -> None:
    window.main_view.messages.request(WithText("example", str(bundle)))
    turn(window)
    turn(window)
    assert not window.main_view.at_start
    layers = window.main_view.work.view.layers
    assert len(layers) >= 3
    assert any(layer.strength > 0.0 for layer in layers), "and shows one"
    assert window.documents.get().path is not None
    assert window.documents.get().path.is_relative_to(tmp_path), "a copy of the user's own"
    assert not window.parts.file_actions.has_unsaved


def test_examples_are_complete_and_small() -> None:
    folder = next(iter(EXAMPLE_TITLES)).parent
    assert {path.name.partition(".")[0] for path in folder.iterdir()} == {
        path.name.partition(".")[0] for path in EXAMPLE_TITLES
    }
    assert sum(path.stat().st_size for path in folder.iterdir()) <= LARGEST


def test_single_click_opens_an_example(hand: Rig) -> None:
    hand.click(605.0, 160.0)  # the second example
    assert hand.main_view.take_requests() == (WithText("example", str([*EXAMPLE_TITLES][1])),)


def test_arrows_and_enter_open_examples_and_recent_files(hand: Rig) -> None:
    right = imgui.Key.right_arrow
    down = imgui.Key.down_arrow
    enter = imgui.Key.enter
    first, second, _ = EXAMPLE_TITLES
    type_keys(hand, enter)
    assert hand.main_view.take_requests() == (WithText("example", str(first)),), (
        "the first card has the keyboard"
    )
    type_keys(hand, right, enter)
    assert hand.main_view.take_requests() == (WithText("example", str(second)),)
    type_keys(hand, imgui.Key.left_arrow, down, enter)
    assert hand.main_view.take_requests() == (WithText("open_file", "/scenes/bear.ply"),)
    type_keys(hand, imgui.Key.delete)
    assert hand.main_view.take_requests() == (WithText("forget_file", "/scenes/bear.ply"),)
    type_keys(hand, right, enter)
    assert hand.main_view.take_requests() == (Plain("open"),), "what is gone is looked for"


def test_missing_file_is_marked_and_can_be_removed(tmp_path: Path) -> None:
    files = [tmp_path / "here.ply", tmp_path / "gone.ply"]
    for file in files:
        file.touch()
    remember_recent(files)
    keep_thumbnail(files[0], np.zeros((12, 16, 3), np.uint8))
    files[1].unlink()
    with null_app(empty(), ViewState(), tmp_path) as app:
        turn(app)
        gone, here = app.main_view.work.transient.start_files
        assert (gone.path.name, gone.missing, here.missing) == ("gone.ply", True, False)
        assert gone.line.startswith("Moved?")
        assert here.line.startswith("just now  ·  ")
        assert app.main_view.work.transient.recent == (files[0],), "questions offer what is there"
        app.main_view.messages.request(WithText("forget_file", str(gone.path)))
        turn(app)
        turn(app)
        assert [file.path for file in app.main_view.work.transient.start_files] == [files[0]]
    assert read_recent(missing=True) == (files[0],)


def test_file_age_is_described_in_words() -> None:
    ages = {30.0: "just now", 300.0: "5 min ago", 7300.0: "2 h ago", 9e4: "yesterday", 1e6: "11 days ago"}
    assert {seconds: describe_age(seconds) for seconds in ages} == ages
    assert describe_age(1e7) == "3 months ago"


def test_thumbnail_time_gives_the_age_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "bear.ply"
    file.touch()
    remember_recent([file])
    keep_thumbnail(file, np.zeros((12, 16, 3), np.uint8))
    (picture,) = (state_folder() / "thumbnails").iterdir()
    os.utime(picture, (time.time() - 3 * 86_400.0,) * 2)
    with null_app(empty(), ViewState(), tmp_path) as app:
        turn(app)
        assert app.main_view.work.transient.start_files[0].line.startswith("3 days ago")


def test_splash_is_shown_while_a_scene_is_read(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bear().save(tmp_path)
    load, shown = documents.load, list[float]()

    def load_slowly(path: Path) -> documents.Document:
        time.sleep(0.5)
        return load(path)

    def splash(_: Splash, text: str, __: float) -> None:
        assert text == "Opening bear.ply …"
        shown.append(time.perf_counter() - begun)

    monkeypatch.setattr(documents, "load", load_slowly)
    monkeypatch.setattr(Splash, "draw", splash)
    begun = time.perf_counter()
    window.parts.file_actions.open(tmp_path / "bear.ply")
    assert window.documents.get().title == "bear.ply"
    assert len(shown) >= 3
    assert shown[0] < 0.3


def test_first_start_counts_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    texts: list[str] = []
    is_drawn = threading.Event()

    def compile_kernels(_: str, report: Callable[[int, int], None]) -> None:
        report(1, 2)
        assert is_drawn.wait(60.0)

    def note_text(_: Splash, text: str, __: float) -> None:
        texts.append(text)
        if "1 of 2" in text:
            is_drawn.set()

    monkeypatch.setattr(application, "needs_kernels", lambda _: True)
    monkeypatch.setattr(application, "compile_rasterizer", compile_kernels)
    monkeypatch.setattr(Splash, "draw", note_text)
    monkeypatch.setattr(application.App, "loop", lambda _: None)
    with null_platform():
        assert main(["view"]) == 0
    assert "Compiling kernels 1 of 2 …" in texts


def test_invalid_file_or_option_opens_no_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_window(*_: object) -> None:
        raise ProgdfError("no window")

    monkeypatch.setattr("viewer.ui.splash.Splash", no_window)
    assert main(["view", str(tmp_path / "no.ply")]) == 2
    assert "no.ply" in capsys.readouterr().err
    (tmp_path / "broken.ply").write_text("ply")
    assert main(["view", str(tmp_path / "broken.ply")]) == 2
    assert "broken.ply" in capsys.readouterr().err, "what is wrong with the file comes first"
    assert main(["view", "--background"]) == 2
    assert "--background" in capsys.readouterr().err
