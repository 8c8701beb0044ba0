"""Editor `command:PROGRAM …`: views edited by any program with a command line.

    command:magick {input} -modulate 100,{100..30} {output}

The program runs once for each view and strength, without a shell. It reads a PNG of the view and writes a
picture of the same proportions. A program whose arguments do not contain the strength makes the finished edit
only.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import IO

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import read_picture, write_image
from progdf.system.processes import kill_group
from progdf.terminal import escape_text, format_duration
from trainer.options import EditKind, EditorOptions
from trainer.store.run_folder import from_bytes, to_bytes
from trainer.views.view import View

from .base import EditorInput
from .cache import PictureCache, Recipe
from .style import cross_fade

ATTEMPTS = 3
"""Number of times that a call is made before its failure ends the run."""

_ERROR_LINES = 3  # last lines of a failed program's output that its error quotes
_FIXED_WORDS = ("input", "output", "mask", "strength", "percent", "prompt", "seed", "view")
_PLACEHOLDER = re.compile(r"\{\{|\}\}|\{([^{}]*)\}")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})")


@dataclass(frozen=True)
class Command:
    """Arguments of a program, with placeholders."""

    words: tuple[str, ...]

    @property
    def program(self) -> str:
        """Name or path of the program."""
        return self.words[0]

    @property
    def has_strength(self) -> bool:
        """True if the arguments depend on the strength."""
        return any(name in ("strength", "percent") or _RANGE.fullmatch(name) for name in self.names)

    @property
    def names(self) -> list[str]:
        """Names of the placeholders, as written between braces."""
        found = [match[1] for word in self.words for match in _PLACEHOLDER.finditer(word)]
        return [name for name in found if name is not None]

    def fill(self, values: Mapping[str, str], strength: float) -> list[str]:
        """Return the arguments of one call.

        Args:
            values: values of all placeholders that do not depend on the strength
            strength: 0 to 1
        """
        values = {**values, "strength": f"{strength:g}", "percent": f"{100 * strength:g}"}

        def value(match: re.Match[str]) -> str:
            name = match[1]
            if name is None:
                return match[0][0]
            between = _RANGE.fullmatch(name)
            if between is None:
                return values[name]
            first, last = float(between[1]), float(between[2])
            return f"{first + strength * (last - first):g}"

        return [_PLACEHOLDER.sub(value, word) for word in self.words]


def parse_command(text: str) -> Command:
    """Parse the text after `command:`. Quotes group words as in a shell; nothing else is special.

    Raises:
        ProgdfError: a quote is not closed, a placeholder is unknown, or {input} or {output} is missing.
    """
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise ProgdfError(f"command: {str(error).lower()} in {text}; close every quote") from None
    if not words:
        raise ProgdfError("command: needs a program; write command:'PROGRAM {input} {output}'")
    command = Command(words)
    for name in command.names:
        if name not in _FIXED_WORDS and not _RANGE.fullmatch(name):
            known = " ".join(f"{{{word}}}" for word in _FIXED_WORDS)
            raise ProgdfError(
                f"command: {{{name}}} is not a placeholder; use {known} or {{A..B}}, "
                "and write {{ and }} for braces"
            )
    for name in ("input", "output"):
        if name not in command.names:
            raise ProgdfError(
                f"command: {{{name}}} is missing; write command:'{command.program} … {{input}} {{output}}'"
            )
    return command


def check_command_editor(what: str, options: EditorOptions) -> Command:
    """Return the command of `command:…` after checking that its program exists. Nothing is run.

    Raises:
        ProgdfError: see `parse_command`; or the program is missing, or --prompt and {prompt} do not match.
    """
    command = parse_command(what)
    if shutil.which(command.program) is None:
        raise ProgdfError(f"command: {command.program} is not a program here; install it, or give its path")
    uses_prompt = "prompt" in command.names
    if uses_prompt and not options.prompt:
        raise ProgdfError("command: {prompt} needs a text; add --prompt TEXT")
    if options.prompt and not uses_prompt:
        raise ProgdfError("--prompt has no effect without {prompt} in the command; add it, or leave it out")
    if options.strengths_by == "blend" and command.has_strength:
        raise ProgdfError(
            "--strengths-by blend is for programs without a strength; leave it out, or remove "
            "{strength}, {percent} and {A..B} from the command"
        )
    return command


class CallFailedError(Exception):
    """A call of a program that gave no usable picture."""


class Programs:
    """Running programs, each with all programs that it starts."""

    def __init__(self) -> None:
        self.stopped = False
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = Lock()

    def run(self, words: Sequence[str], timeout: float) -> str:
        """Run a program without a shell and return what it wrote to its output and error streams.

        Args:
            words: the program and its arguments
            timeout: seconds after which it is ended

        Raises:
            CallFailedError: it cannot be started, exits with another status than 0, exceeds the time limit or
                is stopped.
        """
        with tempfile.TemporaryFile() as stream:  # a pipe stays open if a child outlives the program
            process = self._start(words, stream)
            try:
                status = process.wait(timeout)
            except subprocess.TimeoutExpired as error:
                _end(process)
                raise CallFailedError(
                    f"it takes more than {timeout:g} seconds; allow more with --edit-timeout"
                ) from error
            finally:
                with self._lock:
                    self._running.discard(process)
            stream.seek(0, os.SEEK_SET)
            output = stream.read().decode("utf-8", errors="replace")
        if status != 0:
            raise CallFailedError(f"it ended with status {status}{_quote(output)}")
        return output

    def _start(self, words: Sequence[str], stream: IO[bytes]) -> subprocess.Popen[bytes]:
        """Start a program as the head of a group of its own."""
        with self._lock:
            if self.stopped:
                raise CallFailedError("it is stopped")
            try:
                process = subprocess.Popen(
                    words, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True
                )
            except OSError as error:
                raise CallFailedError(str(error)) from error
            self._running.add(process)
            return process

    def stop(self) -> None:
        """End all running programs, and start no further one."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a running program and all programs that it started, and wait for its end."""
    kill_group(process)
    process.wait()


@dataclass(frozen=True)
class CommandEditor:
    """Editor that runs a program for each picture."""

    command: Command
    options: EditorOptions
    kept: PictureCache  # cache of the program's pictures, at the views' size
    slots: BoundedSemaphore  # limits the number of simultaneous calls
    programs: Programs
    stages: tuple[float, ...] = ()
    kind: EditKind = "style"
    is_confined: bool = False

    @property
    def recipe(self) -> Recipe:
        """All inputs of a picture except its view and its strength."""
        options = self.options
        return {"command": options.text, "prompt": options.prompt, "seed": options.seed}

    @property
    def fades(self) -> bool:
        """True if pictures between the original and the finished edit are cross-faded."""
        return not self.command.has_strength and self.options.strengths_by == "blend"

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`.

        Raises:
            ProgdfError: the program failed `ATTEMPTS` times.
        """
        if strength == 0.0:
            return view.image
        if self.fades and strength < 1.0:
            return cross_fade(view.image, self.edit(view, 1.0), strength)
        return self.kept.picture(
            view.camera.name,
            view.image,
            {**self.recipe, "strength": strength},
            lambda picture: self.call(view, strength),
            "" if strength == 1.0 else f"{strength:g}",
        )

    def call(self, view: View, strength: float) -> Tensor:
        """Run the program for one view, again if it fails. -> [H,W,3] 0..1

        Raises:
            ProgdfError: the program failed `ATTEMPTS` times.
        """
        with self.slots:
            for attempt in range(1, ATTEMPTS + 1):
                try:
                    return self._call_once(view, strength)
                except CallFailedError as error:
                    if self.programs.stopped:
                        raise ProgdfError(f"{self.command.program} is stopped") from error
                    if attempt == ATTEMPTS:
                        raise ProgdfError(
                            f"{self.command.program} failed {ATTEMPTS} times for the view "
                            f"{view.camera.name} at strength {strength:g}: {error}"
                        ) from error
        raise AssertionError("unreachable")

    def _call_once(self, view: View, strength: float) -> Tensor:
        """Run the program once for one view. -> [H,W,3] 0..1"""
        name = view.camera.name
        with tempfile.TemporaryDirectory(prefix="progdf-command-") as folder:
            paths = {word: Path(folder, f"{word}.png") for word in ("input", "mask", "output")}
            write_image(paths["input"], view.image)
            if "mask" in self.command.names:
                write_image(paths["mask"], view.mask)
            values = {word: str(path) for word, path in paths.items()}
            values |= {"prompt": self.options.prompt, "seed": str(self.options.seed), "view": name}
            words = self.command.fill(values, strength)
            output = self.programs.run(words, self.options.edit_timeout)
            self._keep_output(f"{name} at strength {strength:g}", output)
            if not paths["output"].is_file():
                raise CallFailedError(f"it wrote no picture to {{output}}{_quote(output)}")
            try:
                return read_picture(paths["output"], (view.camera.width, view.camera.height))
            except ProgdfError as error:
                raise CallFailedError(f"its picture cannot be used: {error}") from error

    @property
    def keeps_running(self) -> bool:
        """See `StoppableEditor.keeps_running`."""
        return False

    def stop(self) -> None:
        """See `StoppableEditor.stop`."""
        self.programs.stop()

    def _keep_output(self, call: str, output: str) -> None:
        """Append the messages of a call to the log of the program, beside its pictures."""
        if self.kept.folder is None or not output.strip():
            return
        self.kept.folder.mkdir(parents=True, exist_ok=True)
        with (self.kept.folder / "command.log").open("a", encoding="utf-8") as log:
            log.write(f"{call}:\n{output.rstrip()}\n")


def command(given: EditorInput) -> CommandEditor:
    """Return the editor of `command:…` after trying it on one view.

    Raises:
        ProgdfError: see `check_command_editor`; or the program fails, or changes nothing.
    """
    parsed = check_command_editor(given.what, given.options)
    options = given.options
    has_free_strength = parsed.has_strength or options.strengths_by == "blend"
    editor = CommandEditor(
        parsed,
        options,
        PictureCache(options.cache),
        BoundedSemaphore(options.edit_workers),
        Programs(),
        stages=() if has_free_strength else (1.0,),
    )
    if given.views:
        given.say(try_command(editor, given.views[0]))
    return editor


def try_command(editor: CommandEditor, view: View) -> str:
    """Run the program twice on one view, and return a line about its pictures for the log.

    The second picture is kept for the run, so that no unchanged one is.

    Raises:
        ProgdfError: the program fails, or does not change the view.
    """
    started = time.monotonic()
    first = from_bytes(to_bytes(editor.call(view, 1.0)))
    seconds = time.monotonic() - started
    program = editor.command.program
    original = from_bytes(to_bytes(view.image))
    if torch.equal(first, original):
        raise ProgdfError(f"{program} does not change the view {view.camera.name}; check its arguments")
    second = editor.edit(view, 1.0)
    difference = float((first - second).abs().max()) * 255
    line = f"{program}: a picture takes {format_duration(seconds)}"
    if difference == 0:
        return f"{line}, and is the same each time"
    return (
        f"{line}, and differs from call to call by up to {difference:.0f} of 255 levels: views may disagree; "
        "pass {seed} to the program if it has one"
    )


def _quote(output: str) -> str:
    """Return a colon and the last lines of a program's output, on one line; "" without output."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return ": " + escape_text(" / ".join(lines[-_ERROR_LINES:])) if lines else ""
