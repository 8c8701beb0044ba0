"""Editor `api:"…"`: pictures edited by a model that a server runs, through OpenAI's images API.

LocalAI, the server of stable-diffusion.cpp, vLLM-omni, LiteLLM and hosted services offer the same endpoint,
`POST URL/images/edits`. The API has no strength and no starting picture, so a server makes the finished edit
of each view. References make the views agree (`trainer.run.agree`). The key is read from the environment for
each call. It is never stored or logged.
"""

from __future__ import annotations

import base64
import binascii
import http.client
import io
import ipaddress
import os
import tempfile
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.images import read_picture, to_picture
from progdf.io.picture_camera import find_picture_camera
from progdf.terminal import escape_text, format_count, shorten
from trainer.options import VIEWS, EditKind, EditorOptions
from trainer.views.view import View

from .adapters import paint_size
from .base import EditorInput
from .cache import PictureCache, Recipe
from .instruct import sentence
from .painter import FramePainter, RefusedError

KEY = "OPENAI_API_KEY"
"""Environment variable of the server's key. A server on this machine may need none."""

_SIZE_PX = 1024  # default side of a square with the area of a picture, pixels
_RETRIES = 5  # after a failed call; the package waits as long as the server asks
_MAX_PICTURE_BYTES = 1 << 26  # largest picture of a server
_REFUSALS = ("content_policy_violation", "moderation_blocked", "content_filter", "safety")
# added to the prompt if there are reference pictures
_FOLLOW = (
    "{prompt}\n\nEdit the first picture only, and keep its camera and framing. The second picture shows, "
    "blurred, how the edited object looks from there. The last picture shows the finished edit from another "
    "side. Match its colors and details."
)


@dataclass(frozen=True)
class Server:
    """Model of a server."""

    url: str
    model: str
    timeout: float  # seconds for one call

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

    def edit(self, pictures: Sequence[Tensor], prompt: str, size: tuple[int, int]) -> Tensor:
        """Return the edited first picture, at its size. [H,W,3] each -> [H,W,3] 0..1

        Args:
            pictures: the picture to edit, then references
            prompt: the instruction
            size: width and height of the first picture, pixels

        Raises:
            RefusedError: the server's content filter refuses the picture.
            ProgdfError: the server cannot be reached, refuses the call or returns no usable picture.
        """
        import openai

        files = [(f"{i}.png", _png(picture), "image/png") for i, picture in enumerate(pictures)]
        arguments: dict[str, Any] = {
            "model": self.model,
            "prompt": prompt,
            "image": files[0] if len(files) == 1 else files,
            "size": f"{size[0]}x{size[1]}",
            "n": 1,
        }
        client = openai.OpenAI(
            base_url=self.url,
            api_key=os.environ.get(KEY) or "none",
            timeout=self.timeout,
            max_retries=_RETRIES,
        )
        with client:
            try:
                answer = client.images.edit(**arguments)
            except openai.APIStatusError as error:
                raise self._explain(error) from error
            except openai.APITimeoutError as error:
                raise self._fault(
                    f"does not answer within {self.timeout:g} seconds; allow more with --edit-timeout"
                ) from error
            except (openai.APIConnectionError, openai.OpenAIError) as error:
                reason = error.__cause__ or error
                raise self._fault(f"cannot be reached ({_line(reason)}); check --api-url") from error
            except ValueError as error:  # not JSON
                raise self._fault(f"gave no valid answer ({_line(error)}); check --api-url") from error
            data = getattr(answer, "data", None)
            text = getattr(data[0], "b64_json", None) if data else None
            if data and text is None and getattr(data[0], "url", None):
                content = self._fetch(str(data[0].url))
            elif text:
                try:
                    content = base64.b64decode(text, validate=True)
                except binascii.Error as error:
                    raise self._fault("returned half a picture; try again") from error
            else:
                raise self._fault("returned no picture; check --api-url and --model")
        return self._read(content, size)

    def _fetch(self, url: str) -> bytes:
        """Return the content of a picture's address. The key is not sent there."""
        schemes = ("http", "https") if self.is_local else ("https",)
        if urlsplit(url).scheme not in schemes:
            expected = " or ".join(f"{scheme}://" for scheme in schemes)
            raise self._fault(
                f"returned an address that does not begin with {expected}: {shorten(escape_text(url))}"
            )
        try:
            with urllib.request.urlopen(url, timeout=self.timeout) as answer:
                content: bytes = answer.read(_MAX_PICTURE_BYTES + 1)
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise self._fault(f"returned an address without a picture ({_line(error)})") from error
        if len(content) > _MAX_PICTURE_BYTES:
            raise self._fault("returned a picture of more than 64 MB")
        return content

    def _read(self, content: bytes, size: tuple[int, int]) -> Tensor:
        """Return the picture of a file's content at a width and height, whose proportions it must have."""
        with tempfile.TemporaryDirectory(prefix="progdf-served-") as folder:
            path = Path(folder, "picture.png")
            path.write_bytes(content)
            try:
                return read_picture(path, size)
            except ProgdfError as error:
                reason = str(error).replace(f"{path} ", "").replace(str(path), "")
                raise self._fault(f"returned a picture that cannot be used: {reason}") from error

    def _explain(self, error: Any) -> Exception:
        """Return the error of a refused call."""
        body = error.body if isinstance(error.body, dict) else {}
        message = _line(body.get("message") or error.message)
        code = str(body.get("code") or "")
        if error.status_code in (400, 403) and any(word in f"{code} {message}".lower() for word in _REFUSALS):
            return RefusedError(f"the content filter of {self.host} refuses it: {message}")
        advice = {
            401: f"set {KEY} to a valid key",
            403: f"set {KEY} to a key that may use this model",
            404: "check --api-url and --model",
            429: "wait, or use fewer --edit-workers",
        }.get(error.status_code, "check --model and --api-references")
        return self._fault(f"refuses the call with status {error.status_code} ({message}); {advice}")

    def _fault(self, text: str) -> ProgdfError:
        return ProgdfError(f"api: {self.host} {text}")


@dataclass(frozen=True)
class ServedEditor(FramePainter):
    """Editor of views by a served model. In each view it paints the region and its surroundings."""

    scene: Gaussians
    prompt: str
    server: Server
    options: EditorOptions
    kept: PictureCache
    stages: tuple[float, ...] = (1.0,)
    kind: EditKind = "style"
    is_confined: bool = False
    _renders: dict[str, Tensor] = field(default_factory=dict, repr=False)

    has_start = False

    @property
    def size(self) -> int:
        """See `FramePainter.size`."""
        return self.options.edit_size or _SIZE_PX

    @property
    def references(self) -> int:
        """See `FramePainter.references`."""
        return self.options.api_references

    @property
    def workers(self) -> int:
        """See `FramePainter.workers`."""
        return self.options.edit_workers

    @property
    def recipe(self) -> Recipe:
        """See `FramePainter.recipe`."""
        return {"api": self.prompt, "model": self.server.model, "size": self.size}

    @property
    def note(self) -> str:
        """See `FramePainter.note`."""
        return f"pictures are sent to {self.server.host}, model {self.server.model}"

    def paint_size(self, width: float, height: float) -> tuple[int, int]:
        """See `FramePainter.paint_size`."""
        return paint_size(width, height, self.size)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`. Views are edited one by one; `trainer.run.agree` makes them agree."""
        if strength == 0.0:
            return view.image
        recipe = {**self.recipe, "strength": strength}
        return self.paste(view, self.kept.picture(view.camera.name, self.original(view), recipe, self.paint))

    def paint(
        self,
        picture: Tensor,
        references: Sequence[Tensor] = (),
        *,
        strength: float = 1.0,
        softness: float = 1.0,
        source: Tensor | None = None,
        seed: int | None = None,
    ) -> Tensor:
        """See `FramePainter.paint`.

        Raises:
            RefusedError: the server's content filter refuses the picture.
            ProgdfError: see `Server.edit`.
        """
        prompt = _FOLLOW.format(prompt=self.prompt) if references else self.prompt
        return self.server.edit([picture, *references], prompt, (picture.shape[1], picture.shape[0]))


def api(given: EditorInput) -> ServedEditor:
    """Return the editor of `api:"…"`. Nothing is sent yet."""
    server = check_api(given.what, given.options)
    options = given.options
    return ServedEditor(given.scene, sentence(given.what), server, options, PictureCache(options.cache))


def check_api(what: str, options: EditorOptions) -> Server:
    """Return the server of `api:"…"` after checking the options. Nothing is sent.

    Raises:
        ProgdfError: the instruction, the address, the model, the key or the package openai is missing.
    """
    if not sentence(what):
        raise ProgdfError('api: needs an instruction; write api:"turn him into a marble statue"')
    if find_spec("openai") is None:
        raise ProgdfError("api: needs the package openai; pip install progdf-studio[api]")
    parts = urlsplit(options.api_url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ProgdfError(
            "api: needs the address of a server; add --api-url, for example http://127.0.0.1:8080/v1"
        )
    if parts.username or parts.password or parts.query:
        raise ProgdfError(f"--api-url must hold no key and no password; set {KEY} in the environment")
    if not options.model:
        raise ProgdfError("api: needs the name of the server's model; add --model NAME")
    if options.anchor is not None:
        find_picture_camera(options.anchor, origin=ZERO)
        if not options.api_references:
            raise ProgdfError("--anchor is a reference picture; leave out --api-references 0")
    server = Server(options.api_url, options.model, options.edit_timeout)
    if not server.is_local and not os.environ.get(KEY):
        raise ProgdfError(f"api: {server.host} needs a key; set {KEY} in the environment")
    if not server.is_local and parts.scheme == "http":
        raise ProgdfError(f"api: a key must not be sent to {server.host} unencrypted; use https://")
    return server


def explain_sending(options: EditorOptions, views: int) -> str:
    """Return where the pictures of a run are sent, how many calls it makes, and what they cost if known.

    Args:
        options: options of `api:`
        views: number of views; 0: the default
    """
    server = check_api(options.text, options)
    calls = views or VIEWS
    cost = f", about {calls * options.price_per_call:.2f} in all" if options.price_per_call else ""
    return (
        f"{format_count(calls, 'picture')} of the scene and your instruction are sent to {server.host} "
        f"(model {server.model}), one call each{cost}"
    )


def _png(picture: Tensor) -> bytes:
    file = io.BytesIO()
    to_picture(picture).save(file, "PNG")
    return file.getvalue()


def _line(reason: object) -> str:
    return shorten(escape_text(" ".join(str(reason).split())), 160)
