"""Tests of Ctrl+C in places where Python ignores exceptions."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import weakref
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

import pytest

from progdf.__main__ import main
from progdf.system.processes import handle_signals
from trainer.store.state import defer_signals, interrupt_on_signals

pytestmark = [pytest.mark.skipif(os.name == "nt", reason="needs signals that wake the main thread")]
WAIT_S = 60.0  # the signal ends the wait, or this timeout ends a failing test


class Thing:
    """Object that calls a function when it is deleted."""

    def __init__(self, callback: Callable[[], object]) -> None:
        self.callback = callback

    def __del__(self) -> None:
        self.callback()


class Plain:
    """Object that supports weak references."""


def in_weakref_callback(function: Callable[[], object]) -> None:
    thing = Plain()
    reference = weakref.ref(thing, lambda _: function())
    del thing
    assert reference() is None


def in_two_weakref_callbacks(function: Callable[[], object]) -> None:
    in_weakref_callback(lambda: in_weakref_callback(function))


def in_del(function: Callable[[], object]) -> None:
    Thing(function)


def in_ctypes_callback(function: Callable[[], object]) -> None:
    ctypes.CFUNCTYPE(None)(function)()


PLACES = [in_weakref_callback, in_two_weakref_callbacks, in_del, in_ctypes_callback]


def interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def work(place: Callable[[Callable[[], object]], None], number: int) -> None:
    """Raise a signal inside the callback, then continue."""
    place(lambda: signal.raise_signal(number))
    threading.Event().wait(WAIT_S)
    pytest.fail("the signal is lost")


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("place", PLACES)
def test_lost_interrupt_is_delivered_again(
    place: Callable[[Callable[[], object]], None], number: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with handle_signals((signal.SIGINT, signal.SIGTERM), interrupt), pytest.raises(KeyboardInterrupt):
        work(place, number)
    assert "ignored" not in capfd.readouterr().err


@pytest.mark.usefixtures("default_signals")
def test_interrupt_lost_twice_is_delivered_again() -> None:
    lost = 0

    def twice(number: int, frame: FrameType | None) -> None:
        nonlocal lost
        lost += 1
        if lost == 2:
            in_del(lambda: interrupt(number, frame))
        else:
            raise KeyboardInterrupt

    with handle_signals((signal.SIGINT,), twice), pytest.raises(KeyboardInterrupt):
        work(in_del, signal.SIGINT)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("command", ["info", "view"])
def test_command_ends_by_a_lost_interrupt(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("progdf.cli.info.main", lambda argv: work(in_weakref_callback, signal.SIGINT))
    monkeypatch.setattr("viewer.commands.view.main", lambda argv: work(in_weakref_callback, signal.SIGINT))
    assert main([command, "scene.ply"]) == 130
    assert capsys.readouterr().err == "progdf: interrupted\n"


@pytest.mark.usefixtures("default_signals")
def test_training_ends_by_a_lost_interrupt() -> None:
    with interrupt_on_signals(), pytest.raises(KeyboardInterrupt):
        work(in_weakref_callback, signal.SIGINT)


@pytest.mark.usefixtures("default_signals")
def test_second_interrupt_of_a_step_is_not_lost() -> None:
    def interrupt_twice() -> None:
        with defer_signals() as stopped:
            signal.raise_signal(signal.SIGINT)
            assert stopped()
            work(in_weakref_callback, signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        interrupt_twice()


@pytest.mark.usefixtures("default_signals")
def test_other_ignored_exceptions_are_still_reported(capfd: pytest.CaptureFixture[str]) -> None:
    reported = []

    def hook(unraisable: object) -> None:
        reported.append(unraisable)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.unraisablehook", hook)
        with handle_signals((signal.SIGINT,), interrupt):
            in_del(lambda: 1 // 0)
    assert len(reported) == 1
