"""The whole application on a window of glfw's null platform, without a screen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.helpers.sessions import MAKING_S
from viewer.app.app import App
from viewer.files.document import Document
from viewer.state.view_state import ViewState
from viewer.ui.keys import Keys, Press


@contextmanager
def null_platform() -> Iterator[None]:
    """Give glfw a platform without a screen for the next window, or skip the test if there is none."""
    from viewer.ui.window import glfw

    glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_NULL)
    if not glfw.init():
        pytest.skip("glfw has no null platform here")
    glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
    try:
        yield
    finally:
        glfw.init_hint(glfw.PLATFORM, glfw.ANY_PLATFORM)


@contextmanager
def null_app(document: Document, view: ViewState, folder: Path) -> Iterator[App]:
    """Open the application on `document` and draw its first frame. Its memory is saved in `folder`."""
    from viewer.ui.splash import Splash
    from viewer.ui.window import Window

    with null_platform():
        window = Window(Splash("test", (900, 640)))
    app = App(window, document, view)
    app.parts.maker.patience_s = MAKING_S
    app.draw()
    yield app
    app.close()
    window.splash.close()


def press(app: App, *chords: str) -> None:
    """Send keys to the window, one frame for each."""
    for chord in chords:
        app.window.take_keys = lambda c=chord: Keys((Press(c),))  # type: ignore[method-assign]
        app.main_view.wake()
        app.draw()
        app.window.take_keys = lambda: Keys()  # type: ignore[method-assign]
        for _ in range(3):
            app.draw()
