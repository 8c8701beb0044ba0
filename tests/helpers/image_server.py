"""A real HTTP server on this machine with the endpoint POST /v1/images/edits of OpenAI's images API.

Its model is a function of the picture, so that tests know every result. It can refuse pictures, ask callers
to wait, and give answers of other servers: addresses instead of pictures, halves, and other sizes.
"""

from __future__ import annotations

import base64
import io
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.parser import BytesParser
from email.policy import HTTP
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from PIL import Image


@dataclass(frozen=True)
class Call:
    """One call of the endpoint."""

    pictures: tuple[Image.Image, ...]
    fields: Mapping[str, str]  # model, prompt, size, …
    key: str  # the bearer token
    mask: Image.Image | None = None


@dataclass(frozen=True)
class Refusal:
    """An answer other than a picture."""

    status: int
    code: str
    message: str
    headers: Mapping[str, str] = field(default_factory=dict)


Answer = Image.Image | Refusal | Mapping[str, Any] | bytes
"""Answer of the model: a picture, a refusal, JSON, or the bytes of a whole answer."""


def swap_colors(picture: Image.Image) -> Image.Image:
    """Return the picture with red and blue exchanged."""
    red, green, blue = picture.convert("RGB").split()
    return Image.merge("RGB", (blue, green, red))


def png(picture: Image.Image) -> bytes:
    """Return the picture as a PNG file."""
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


@dataclass
class ImageServer:
    """A running server."""

    url: str
    calls: list[Call]
    files: dict[str, bytes]  # pictures that answers name by their address


@contextmanager
def image_server(
    model: Callable[[Call, int], Answer] = lambda call, i: swap_colors(call.pictures[0]),
) -> Iterator[ImageServer]:
    """Run a server while the context is open.

    Args:
        model: returns the answer to a call, from the call and the number of calls before it
    """
    state = ImageServer("", [], {})
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *values: object) -> None:
            """Print nothing."""

        def do_GET(self) -> None:
            content = state.files.get(self.path)
            self._send(200 if content else 404, content or b"", {"Content-Type": "image/png"})

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if self.path != "/v1/images/edits":
                self._send(404, b"{}", {"Content-Type": "application/json"})
                return
            call = _parse(self.headers["Content-Type"], body, self.headers.get("Authorization", ""))
            with lock:
                number = len(state.calls)
                state.calls.append(call)
            answer = model(call, number)
            headers = {"Content-Type": "application/json"}
            if isinstance(answer, Refusal):
                error = {"code": answer.code, "message": answer.message, "type": "refused"}
                self._send(
                    answer.status, json.dumps({"error": error}).encode(), {**headers, **answer.headers}
                )
                return
            if isinstance(answer, Image.Image):
                answer = {"created": 0, "data": [{"b64_json": base64.b64encode(png(answer)).decode()}]}
            self._send(200, answer if isinstance(answer, bytes) else json.dumps(answer).encode(), headers)

        def _send(self, status: int, content: bytes, headers: Mapping[str, str]) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}/v1"
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _parse(kind: str, body: bytes, key: str) -> Call:
    """Return the call of a multipart form."""
    message = BytesParser(policy=HTTP).parsebytes(f"Content-Type: {kind}\r\n\r\n".encode() + body)
    pictures = []
    fields = {}
    mask = None
    for part in message.iter_parts():
        name = str(part.get_param("name", header="content-disposition"))
        content = part.get_payload(decode=True)
        assert isinstance(content, bytes)
        if name in ("image", "image[]", "mask"):
            picture = Image.open(io.BytesIO(content))
            picture.load()
            if name == "mask":
                mask = picture
            else:
                pictures.append(picture)
        else:
            fields[name] = content.decode()
    return Call(tuple(pictures), fields, key, mask)
