"""Calls of a server: its address, errors that name it, repeated calls, and the pictures of its answers."""

from __future__ import annotations

import email.utils
import http.client
import io
import ipaddress
import os
import socket
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import TypeVar
from urllib.parse import urlsplit

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO
from progdf.io.images import read_picture, to_picture
from progdf.io.picture_camera import find_picture_camera
from progdf.terminal import escape_text, format_duration, shorten
from trainer.editors.base import Waiting
from trainer.options import EditorOptions

KEY = "OPENAI_API_KEY"
"""Environment variable of a server's key. A server on this machine may need none."""

RETRIES = 5
"""Number of times that a failed call is made again."""

BUSY_STATUSES = (408, 409, 425, 429, 500, 502, 503, 504)
"""Statuses after which the same call may succeed."""

_FIRST_WAIT_S = 0.5  # wait before the first retry if the server names none; doubled for each further one
_MAX_BACKOFF_S = 8.0
_MAX_WAIT_S = 120.0  # longest wait that a server may ask for
_MIN_REPORTED_WAIT_S = 1.0  # shorter waits are not noticed
_MAX_ANSWER_BYTES = 1 << 26  # largest answer of a server
_Result = TypeVar("_Result")


class BusyError(Exception):
    """A failed call that may succeed if it is made again.

    Args:
        error: the error if no retry is left
        wait_s: seconds that the server asks to wait; None: it names none
    """

    def __init__(self, error: ProgdfError, wait_s: float | None = None) -> None:
        super().__init__(str(error))
        self.error = error
        self.wait_s = wait_s


@dataclass(frozen=True)
class Waits:
    """Waits between the calls of a server."""

    stop: Event  # ends them; set if the run is stopped
    report: Waiting = nullcontext  # reports a wait

    def wait(self, seconds: float, is_named: bool) -> None:
        """Wait until the seconds are over or the run is stopped.

        Args:
            seconds: duration
            is_named: the server asks for this duration
        """
        if seconds < _MIN_REPORTED_WAIT_S:
            self.stop.wait(seconds)
            return
        text = "The server asks to wait" if is_named else "The server is busy. Next call in"
        with self.report(f"{text} {format_duration(seconds)}"):
            self.stop.wait(seconds)


def persist(call: Callable[[], _Result], waits: Waits) -> _Result:
    """Return the result of a call that is made again after a `BusyError`.

    Args:
        call: makes the call once
        waits: waits between two calls

    Raises:
        ProgdfError: the last call failed, or the run is stopped.
    """
    for number in range(RETRIES + 1):
        if waits.stop.is_set():
            break
        try:
            return call()
        except BusyError as busy:
            if number == RETRIES:
                raise busy.error from busy
            backoff = min(_FIRST_WAIT_S * 2**number, _MAX_BACKOFF_S)
            is_named = busy.wait_s is not None
            waits.wait(backoff if busy.wait_s is None else min(busy.wait_s, _MAX_WAIT_S), is_named)
    raise ProgdfError("the calls of the server are stopped")


def retry_after(headers: Mapping[str, str]) -> float | None:
    """Return the seconds that the header Retry-After asks to wait, at least 0; None without a valid one."""
    text = headers.get("Retry-After") or headers.get("retry-after") or ""
    try:
        return max(0.0, float(text))
    except ValueError:
        pass
    try:
        return max(0.0, email.utils.parsedate_to_datetime(text).timestamp() - time.time())
    except (TypeError, ValueError):
        return None


@dataclass(frozen=True)
class Answer:
    """Answer of a server."""

    status: int
    content: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Address:
    """Address of a server."""

    editor: str  # word before the colon in `--editor`, which begins every error
    url: str

    @property
    def host(self) -> str:
        """Host and port."""
        return urlsplit(self.url).netloc

    @property
    def is_local(self) -> bool:
        """True if the server runs on this machine."""
        name = urlsplit(self.url).hostname or ""
        try:
            return ipaddress.ip_address(name).is_loopback
        except ValueError:
            return name == "localhost"

    def fault(self, text: str) -> ProgdfError:
        """Return an error about the server."""
        return ProgdfError(f"{self.editor}: {self.host} {text}")

    def check(self, example: str, key: str) -> None:
        """Check the address before anything is sent.

        Args:
            example: a valid address, for the error
            key: name of the key's environment variable; "": the server has none

        Raises:
            ProgdfError: the address is missing, is not of HTTP, or holds a password.
        """
        try:
            parts = urlsplit(self.url)
            has_host = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:  # such as a port that is no number
            has_host = False
        if not has_host:
            raise ProgdfError(
                f"{self.editor}: needs the address of a server; add --api-url, for example {example}"
            )
        if parts.username or parts.password or parts.query:
            remedy = f"set {key} in the environment" if key else "leave it out"
            raise ProgdfError(f"--api-url must hold no key and no password; {remedy}")

    def request(self, path: str, timeout: float, body: bytes | None = None, kind: str = "") -> Answer:
        """Send one request to the server.

        Args:
            path: path below the address
            timeout: seconds without an answer after which the request fails
            body: content of a POST; None: a GET
            kind: media type of the body

        Raises:
            BusyError: the server is busy, does not answer in time or cannot be reached.
            ProgdfError: nothing listens at the address, or the answer is larger than 64 MB.
        """
        url = self.url.rstrip("/") + path
        headers = {"Content-Type": kind} if kind else {}
        request = urllib.request.Request(url, data=body, headers=headers)
        try:
            with _OPENER.open(request, timeout=timeout) as stream:
                answer = Answer(stream.status, stream.read(_MAX_ANSWER_BYTES + 1), dict(stream.headers))
        except urllib.error.HTTPError as error:
            with error:
                answer = Answer(error.code, error.read(_MAX_ANSWER_BYTES), dict(error.headers))
        except TimeoutError as error:
            raise BusyError(self.slow(timeout)) from error
        except (OSError, ValueError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", error)
            if isinstance(reason, TimeoutError):
                raise BusyError(self.slow(timeout)) from error
            raise self.unreachable(reason) from error
        if answer.status in BUSY_STATUSES:
            text = one_line(answer.content[:400].decode("utf-8", "replace"))
            advice = "wait, or use fewer --edit-workers" if answer.status == 429 else "look at its log"
            refusal = self.fault(f"refuses the call with status {answer.status} ({text}); {advice}")
            raise BusyError(refusal, retry_after(answer.headers))
        if len(answer.content) > _MAX_ANSWER_BYTES:
            raise self.fault("returned more than 64 MB; ask for smaller pictures with --edit-size")
        return answer

    def slow(self, timeout: float) -> ProgdfError:
        """Return the error of a call that takes too long."""
        return self.fault(f"does not answer within {timeout:g} seconds; allow more with --edit-timeout")

    def unreachable(self, reason: object) -> ProgdfError | BusyError:
        """Return the error of a call without a connection.

        A machine that refuses the connection has no server at this address, and an unknown name has no
        machine, so waiting is of no use.
        """
        fault = self.fault(f"cannot be reached ({one_line(reason)}); check --api-url")
        cause = reason if isinstance(reason, BaseException) else None
        while cause is not None:
            is_unknown_name = isinstance(cause, socket.gaierror) and cause.errno == socket.EAI_NONAME
            if is_unknown_name or isinstance(cause, ConnectionRefusedError):
                return fault
            cause = cause.__cause__
        return BusyError(fault)

    def read_picture(self, content: bytes, size: tuple[int, int]) -> Tensor:
        """Return a picture of the server at a width and height, whose proportions it must have. [H,W,3]

        Raises:
            ProgdfError: the content is no picture, or has other proportions.
        """
        with tempfile.TemporaryDirectory(prefix="progdf-served-") as folder:
            path = Path(folder, "picture.png")
            path.write_bytes(content)
            try:
                return read_picture(path, size)
            except ProgdfError as error:
                reason = str(error).replace(f"{path} ", "").replace(str(path), "")
                raise self.fault(f"returned a picture that cannot be used: {reason}") from error


class _SameHost(urllib.request.HTTPRedirectHandler):
    """Refusal of redirections: pictures go to the given address only."""

    def redirect_request(
        self, req: object, fp: object, code: int, msg: str, headers: object, newurl: str
    ) -> None:
        """Follow no redirection; urllib then raises the status as an error."""


_OPENER = urllib.request.build_opener(_SameHost)


def one_line(reason: object) -> str:
    """Return a text of a server or an error, on one line and shortened, without the key that it may quote."""
    text = " ".join(str(reason).split())
    key = os.environ.get(KEY, "")
    if key:
        text = text.replace(key, "(key)")
    return shorten(escape_text(text), 160)


def png(picture: Tensor) -> bytes:
    """Return a picture as a PNG file. [H,W,3]"""
    file = io.BytesIO()
    to_picture(picture).save(file, "PNG")
    return file.getvalue()


def mask_png(mask: Tensor) -> bytes:
    """Return a region as a PNG file: white on black, and transparent inside. [H,W]

    OpenAI's API edits transparent pixels. ComfyUI's LoadImage makes transparent pixels the mask, and
    LoadImageMask reads the red channel.
    """
    inside = (mask > 0.0).float()[..., None]
    picture = to_picture(inside.expand(-1, -1, 3))
    picture.putalpha(to_picture((1.0 - inside).expand(-1, -1, 3)).getchannel(0))
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def check_anchor(options: EditorOptions, references: int, remedy: str) -> None:
    """Check that --anchor has a camera, and that the model accepts reference pictures.

    Raises:
        ProgdfError: one of the two is missing.
    """
    if options.anchor is None:
        return
    find_picture_camera(options.anchor, origin=ZERO)
    if not references:
        raise ProgdfError(f"--anchor is a reference picture; {remedy}")
