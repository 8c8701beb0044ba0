"""Threads that make several pictures at the same time, and end early in order."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from queue import Empty, SimpleQueue
from threading import Thread
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

from progdf.terminal import format_count

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@runtime_checkable
class StoppableEditor(Protocol):
    """Editor whose calls run outside of this process."""

    @property
    def keeps_running(self) -> bool:
        """True if calls that have begun are worth waiting for, as they are paid for."""
        ...

    def stop(self) -> None:
        """End the waits between calls, and all calls that are not worth waiting for. It makes none again."""
        ...


class CallPool:
    """Pool of daemon threads, as a context.

    If the block fails or is interrupted, calls that have not begun are dropped and the editor is stopped. The
    pool then waits for the calls that have begun, so that their pictures are kept. A second interruption
    leaves them.

    Args:
        workers: number of threads
        editor: stopped if it is a `StoppableEditor`
    """

    def __init__(self, workers: int, editor: object) -> None:
        self._workers = workers
        self._editor = editor
        self._calls: list[Future[Any]] = []

    def map(self, function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
        """Yield the results of all items in order. The calls begin at once."""
        calls: list[Future[_Result]] = []
        pending = SimpleQueue[tuple[Future[_Result], _Item]]()
        for item in items:
            call: Future[_Result] = Future()
            calls.append(call)
            pending.put((call, item))
        self._calls += calls

        def work() -> None:
            while not pending.empty():
                try:
                    call, item = pending.get_nowait()
                except Empty:  # another thread took the last item
                    return
                if not call.set_running_or_notify_cancel():
                    continue
                try:
                    call.set_result(function(item))
                except BaseException as error:
                    call.set_exception(error)

        for _ in range(min(self._workers, len(calls))):
            Thread(target=work, daemon=True).start()
        return (call.result() for call in calls)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            return
        begun = [call for call in self._calls if not call.cancel() and not call.done()]
        if isinstance(self._editor, StoppableEditor):
            self._editor.stop()
            if begun and self._editor.keeps_running and not isinstance(error, Exception):
                count = format_count(len(begun), "picture")
                line = f"waiting for {count} that the server is making; press Ctrl-C again to leave them"
                print(line, file=sys.stderr)
        wait(begun)
