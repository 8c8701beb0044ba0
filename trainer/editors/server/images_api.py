"""Editor `api:"…"`: a model behind OpenAI's images API.

LocalAI, the server of stable-diffusion.cpp, vLLM-omni, LiteLLM and hosted services offer the same endpoint,
`POST URL/images/edits`. The API has no strength and no starting picture, so a server makes the finished edit
of each view. The key is read from the environment for each call. It is never stored or logged.

Some hosted models accept a few sizes only, and name them when they refuse another one. Pictures then go on a
canvas of the nearest size and are cut out again.
"""

from __future__ import annotations

import base64
import binascii
import http.client
import os
import re
import urllib.request
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from typing import Any
from urllib.parse import urlsplit

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from progdf.errors import ProgdfError
from progdf.system.packages import install_extra
from trainer.editors.cache import Recipe
from trainer.editors.instruct import sentence
from trainer.editors.painter import PaintRequest, RefusedError
from trainer.options import EditorOptions

from .calls import (
    BUSY_STATUSES,
    KEY,
    Address,
    BusyError,
    Waits,
    check_anchor,
    mask_png,
    one_line,
    persist,
    png,
    retry_after,
)

_CONNECT_TIMEOUT_S = 5.0  # wait for the answer that tells that a server is there
_MAX_PICTURE_BYTES = 1 << 26  # largest picture of a server
_SIZE = re.compile(r"\b(\d{2,5})\s*[x×]\s*(\d{2,5})\b")  # in the error messages of a server
_NO_CREDIT = "insufficient_quota"  # code of status 429 that waiting does not change
_REFUSALS = ("content_policy_violation", "moderation_blocked", "content_filter", "safety")


Size = tuple[int, int]
"""Width and height in pixels."""


class _SizeError(Exception):
    """A refused size, with the sizes that the server accepts."""

    def __init__(self, error: ProgdfError, sizes: tuple[Size, ...]) -> None:
        super().__init__(str(error))
        self.error = error
        self.sizes = sizes


def named_sizes(message: str, refused: Size) -> tuple[Size, ...]:
    """Return the sizes that an error message names, without the refused one."""
    found = [(int(width), int(height)) for width, height in _SIZE.findall(message)]
    return tuple(size for size in dict.fromkeys(found) if size != refused)


@dataclass(frozen=True)
class Canvas:
    """Canvas with a scaled picture in its middle."""

    picture: Size
    size: Size

    @property
    def inner(self) -> Size:
        """Width and height of the scaled picture."""
        scale = self._scale
        width, height = (max(1, round(scale * side)) for side in self.picture)
        return min(width, self.size[0]), min(height, self.size[1])

    @property
    def unused_share(self) -> float:
        """Share of the canvas beside the picture."""
        width, height = self.inner
        return 1.0 - width * height / (self.size[0] * self.size[1])

    @property
    def _scale(self) -> float:
        return min(canvas / side for canvas, side in zip(self.size, self.picture, strict=True))

    def place(self, picture: Tensor) -> Tensor:
        """Return a picture of any size on the canvas, continued by the colors of its edge. [H,W,C]"""
        width, height = self.inner
        left = (self.size[0] - width) // 2
        top = (self.size[1] - height) // 2
        scaled = _resize(picture, self.inner)
        sides = (left, self.size[0] - width - left, top, self.size[1] - height - top)
        return pad(scaled.permute(2, 0, 1)[None], sides, mode="replicate")[0].permute(1, 2, 0)

    def cut(self, canvas: Tensor) -> Tensor:
        """Return the picture on a canvas, at its own size. [H,W,C] -> [h,w,C]"""
        width, height = self.inner
        left = (self.size[0] - width) // 2
        top = (self.size[1] - height) // 2
        return _resize(canvas[top : top + height, left : left + width], self.picture)


def best_canvas(picture: Size, sizes: Sequence[Size]) -> Canvas:
    """Return the canvas with the smallest unused share; of equal ones, the first."""
    return min((Canvas(picture, size) for size in sizes), key=lambda canvas: round(canvas.unused_share, 6))


def _resize(picture: Tensor, size: Size) -> Tensor:
    """Return a picture at a width and height. [H,W,C]"""
    planes = picture.permute(2, 0, 1)[None].float()
    if planes.shape[-2:] != (size[1], size[0]):
        planes = interpolate(planes, (size[1], size[0]), mode="bicubic", antialias=True)
    return torch.clamp(planes[0].permute(1, 2, 0), 0.0, 1.0)


def _place_on_canvas(request: PaintRequest, canvas: Canvas) -> PaintRequest:
    """Return a request whose pictures are on a canvas."""
    mask = None if request.mask is None else canvas.place(request.mask[..., None])[..., 0]
    references = [canvas.place(picture) for picture in request.references]
    return replace(request, picture=canvas.place(request.picture), references=references, mask=mask)


@dataclass(frozen=True)
class ImagesApi:
    """Model of a server with OpenAI's images API."""

    address: Address
    model: str
    timeout: float  # seconds for one call
    references: int = 2  # reference pictures that one call accepts
    sends_mask: bool = False
    _sizes: list[Size] = field(default_factory=list, repr=False)  # sizes the server accepts; none: any

    has_strength = False

    @property
    def recipe(self) -> Recipe:
        """See `ImageModel.recipe`."""
        recipe: dict[str, str | int | float | None] = {"model": self.model}
        if self.sends_mask:
            recipe["mask"] = "region"
        return recipe

    @property
    def name(self) -> str:
        """See `ImageModel.name`."""
        return f"model {self.model}"

    def connect(self) -> None:
        """See `ImageModel.connect`. Any answer passes: only a picture would test the model, and it costs."""
        with suppress(BusyError):  # calls wait for a busy server
            self.address.request("", _CONNECT_TIMEOUT_S)

    def edit(self, request: PaintRequest, prompt: str, waits: Waits) -> Tensor:
        """See `ImageModel.edit`."""
        return persist(partial(self._edit_once, request, prompt), waits)

    def _edit_once(self, request: PaintRequest, prompt: str) -> Tensor:
        """Make one call, and another one if the server refuses the size and names those that it accepts.

        Raises:
            BusyError: the call may succeed if it is made again.
            RefusedError, ProgdfError: see `ImageModel.edit`.
        """
        height, width = request.picture.shape[:2]
        if not self._sizes:
            try:
                return self._call(request, prompt)
            except _SizeError as refused:
                self._sizes[:] = refused.sizes
        canvas = best_canvas((width, height), self._sizes)
        try:
            return canvas.cut(self._call(_place_on_canvas(request, canvas), prompt))
        except _SizeError as refused:
            raise refused.error from refused

    def _call(self, request: PaintRequest, prompt: str) -> Tensor:
        """Make one call at the size of the picture.

        Raises:
            _SizeError: the server refuses the size.
            BusyError, RefusedError, ProgdfError: see `_edit_once`.
        """
        import openai

        pictures = (request.picture, *request.references)
        files = [(f"{i}.png", png(picture), "image/png") for i, picture in enumerate(pictures)]
        height, width = request.picture.shape[:2]
        arguments: dict[str, Any] = {
            "model": self.model,
            "prompt": prompt,
            "image": files[0] if len(files) == 1 else files,
            "size": f"{width}x{height}",
            "n": 1,
        }
        if self.sends_mask and request.mask is not None:
            arguments["mask"] = ("mask.png", mask_png(request.mask), "image/png")
        client = openai.OpenAI(
            base_url=self.address.url,
            api_key=os.environ.get(KEY) or "none",
            timeout=self.timeout,
            max_retries=0,
            # a redirection would send the pictures to a machine that the user has not agreed to
            http_client=openai.DefaultHttpxClient(follow_redirects=False),
        )
        with client:
            try:
                answer = client.images.edit(**arguments)
            except openai.APIStatusError as error:
                raise self._explain(error, (width, height)) from error
            except openai.APITimeoutError as error:
                raise BusyError(self.address.slow(self.timeout)) from error
            except (openai.APIConnectionError, openai.OpenAIError) as error:
                raise self.address.unreachable(error.__cause__ or error) from error
            except ValueError as error:  # not JSON
                raise self.address.fault(
                    f"gave no valid answer ({one_line(error)}); check --api-url"
                ) from error
        return self.address.read_picture(self._content(answer), (width, height))

    def _content(self, answer: Any) -> bytes:
        """Return the content of the picture in an answer."""
        data = getattr(answer, "data", None)
        text = getattr(data[0], "b64_json", None) if data else None
        if text:
            try:
                return base64.b64decode(text, validate=True)
            except binascii.Error as error:
                raise self.address.fault("returned half a picture; try again") from error
        if data and getattr(data[0], "url", None):
            return self.fetch(str(data[0].url))
        raise self.address.fault("returned no picture; check --api-url and --model")

    def fetch(self, url: str) -> bytes:
        """Return the content of a picture's address. The key is not sent there.

        Raises:
            ProgdfError: the address is of another kind, has no picture, or has more than 64 MB.
        """
        schemes = ("http", "https") if self.address.is_local else ("https",)
        if urlsplit(url).scheme not in schemes:
            expected = " or ".join(f"{scheme}://" for scheme in schemes)
            raise self.address.fault(
                f"returned an address that does not begin with {expected}: {one_line(url)}"
            )
        try:
            with urllib.request.urlopen(url, timeout=self.timeout) as answer:
                content: bytes = answer.read(_MAX_PICTURE_BYTES + 1)
        except (OSError, ValueError, http.client.HTTPException) as error:
            raise self.address.fault(f"returned an address without a picture ({one_line(error)})") from error
        if len(content) > _MAX_PICTURE_BYTES:
            raise self.address.fault("returned a picture of more than 64 MB")
        return content

    def _explain(self, error: Any, size: Size) -> Exception:
        """Return the error of a refused call with a picture of this size."""
        body = error.body if isinstance(error.body, dict) else {}
        message = one_line(body.get("message") or error.message)
        code = str(body.get("code") or "")
        status = error.status_code
        if status in (400, 403) and any(word in f"{code} {message}".lower() for word in _REFUSALS):
            return RefusedError(f"the content filter of {self.address.host} refuses it: {message}")
        advice = {
            401: f"set {KEY} to a valid key",
            403: f"set {KEY} to a key that may use this model",
            404: "check --api-url and --model",
            429: "wait, or use fewer --edit-workers",
        }.get(status, "check --model and --api-references")
        if status >= 500:
            advice = "look at its log"
        if code == _NO_CREDIT:
            advice = "add credit to the account of the key"
        if 300 <= status < 400:
            advice = "it redirects to another address; check --api-url"
        reason = "" if message == f"Error code: {status}" else f" ({message})"
        fault = self.address.fault(f"refuses the call with status {status}{reason}; {advice}")
        if status in BUSY_STATUSES and code != _NO_CREDIT:
            return BusyError(fault, retry_after(error.response.headers))
        sizes = named_sizes(str(body.get("message") or error.message), size)
        if status in (400, 422) and sizes:
            return _SizeError(fault, sizes)
        return fault


def check_api(what: str, options: EditorOptions) -> ImagesApi:
    """Return the model of `api:"…"` after checking the options. Nothing is sent.

    Raises:
        ProgdfError: the instruction, the address, the model, the key or the package openai is missing.
    """
    if not sentence(what):
        raise ProgdfError('api: needs an instruction; write api:"turn him into a marble statue"')
    if find_spec("openai") is None:
        raise ProgdfError(f"api: needs the package openai; {install_extra('api')}")
    address = Address("api", options.api_url)
    address.check("http://127.0.0.1:8080/v1", KEY)
    if not options.model:
        raise ProgdfError("api: needs the name of the server's model; add --model NAME")
    check_anchor(options, options.api_references, "leave out --api-references 0")
    if not address.is_local and not os.environ.get(KEY):
        raise ProgdfError(f"api: {address.host} needs a key; set {KEY} in the environment")
    if not address.is_local and urlsplit(options.api_url).scheme == "http":
        raise ProgdfError(f"api: a key must not be sent to {address.host} unencrypted; use https://")
    return ImagesApi(address, options.model, options.edit_timeout, options.api_references, options.api_mask)
