"""Editor of views by a model that a server runs.

A server has no starting picture, and most have no strength. References make the views agree
(`trainer.run.agree`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Event
from typing import Protocol

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.terminal import format_count
from trainer.editors.adapters import paint_size
from trainer.editors.base import EditorInput
from trainer.editors.cache import PictureCache, Recipe
from trainer.editors.instruct import sentence
from trainer.editors.painter import FramePainter, PaintRequest
from trainer.options import VIEWS, EditKind, EditorOptions
from trainer.views.view import View

from .calls import Address, Waits
from .comfy import check_comfy
from .images_api import check_api

_SIZE_PX = 1024  # default side of a square with the area of a picture, pixels
# added to the prompt if there are reference pictures
_FOLLOW = (
    "{prompt}\n\nEdit the first picture only, and keep its camera and framing. The second picture shows, "
    "blurred, how the edited object looks from there.{last} Match its colors and details."
)
_LAST = " The last picture shows the finished edit from another side."


class ImageModel(Protocol):
    """Model of a server."""

    @property
    def address(self) -> Address:
        """Address of the server."""
        ...

    @property
    def name(self) -> str:
        """Name of the model, for messages."""
        ...

    @property
    def references(self) -> int:
        """Number of reference pictures that one call accepts."""
        ...

    @property
    def has_strength(self) -> bool:
        """True if the model heeds `PaintRequest.strength`."""
        ...

    @property
    def recipe(self) -> Recipe:
        """All inputs of a picture except its request and its prompt."""
        ...

    def connect(self) -> None:
        """Check that the server answers, if that costs nothing.

        Raises:
            ProgdfError: it does not, or cannot run the model.
        """
        ...

    def edit(self, request: PaintRequest, prompt: str, waits: Waits) -> Tensor:
        """Return the edited picture, at its size. -> [H,W,3] 0..1

        Args:
            request: the picture and its references
            prompt: the instruction; "": the model's own
            waits: waits between two calls

        Raises:
            RefusedError: a content filter refuses the picture.
            ProgdfError: the server cannot be reached, refuses the call or returns no usable picture.
        """
        ...


@dataclass(frozen=True)
class ServedEditor(FramePainter):
    """Editor of views by a served model. In each view it paints the region and its surroundings."""

    scene: Gaussians
    prompt: str  # the instruction; "": the model's own
    model: ImageModel
    options: EditorOptions
    kept: PictureCache
    stages: tuple[float, ...] = (1.0,)
    kind: EditKind = "style"
    is_confined: bool = False
    waits: Waits = field(default_factory=lambda: Waits(Event()), repr=False)
    _renders: dict[str, Tensor] = field(default_factory=dict, repr=False)

    has_start = False

    @property
    def has_strength(self) -> bool:  # type: ignore[override]
        """See `FramePainter.has_strength`."""
        return self.model.has_strength

    @property
    def size(self) -> int:
        """See `FramePainter.size`."""
        return self.options.edit_size or _SIZE_PX

    @property
    def references(self) -> int:
        """See `FramePainter.references`."""
        return self.model.references

    @property
    def degrees(self) -> tuple[str, ...]:
        """See `FramePainter.degrees`."""
        return split_degrees(self.options.degrees)

    @property
    def workers(self) -> int:
        """See `FramePainter.workers`."""
        return self.options.edit_workers

    @property
    def recipe(self) -> Recipe:
        """See `FramePainter.recipe`."""
        return {self.model.address.editor: self.prompt, **self.model.recipe, "size": self.size}

    @property
    def note(self) -> str:
        """See `FramePainter.note`."""
        return f"pictures are sent to {self.model.address.host}, {self.model.name}"

    def paint_size(self, width: float, height: float) -> tuple[int, int]:
        """See `FramePainter.paint_size`."""
        return paint_size(width, height, self.size)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`. Views are edited one by one; `trainer.run.agree` makes them agree."""
        if strength == 0.0:
            return view.image
        seed = self.options.seed
        recipe = {**self.recipe, "strength": strength, "seed": seed}
        painted = self.kept.picture(
            view.camera.name,
            self.original(view),
            recipe,
            lambda picture: self.paint(PaintRequest(picture, strength=strength, seed=seed)),
            "" if strength == 1.0 else f"{strength:g}",
        )
        return self.paste(view, painted)

    def paint(self, request: PaintRequest) -> Tensor:
        """See `FramePainter.paint`.

        Raises:
            RefusedError: a content filter refuses the picture.
            ProgdfError: see `ImageModel.edit`.
        """
        prompt = request.prompt or self.prompt
        if request.references and prompt:
            last = _LAST if len(request.references) > 1 else ""
            prompt = _FOLLOW.format(prompt=prompt, last=last)
        return self.model.edit(request, prompt, self.waits)

    @property
    def keeps_running(self) -> bool:
        """See `StoppableEditor.keeps_running`."""
        return True

    def stop(self) -> None:
        """See `StoppableEditor.stop`."""
        self.waits.stop.set()


def api(given: EditorInput) -> ServedEditor:
    """Return the editor of `api:"…"`. Nothing is sent yet."""
    return _make_editor(given, check_api(given.what, given.options), sentence(given.what))


def comfy(given: EditorInput) -> ServedEditor:
    """Return the editor of `comfy:WORKFLOW.json` after checking that the server has its nodes."""
    model = check_comfy(given.what, given.options)
    model.connect()
    return _make_editor(given, model, given.options.prompt or model.workflow.prompt)


def _make_editor(given: EditorInput, model: ImageModel, prompt: str) -> ServedEditor:
    options = given.options
    stages = () if model.has_strength else (1.0,)
    waits = Waits(Event(), given.waiting)
    return ServedEditor(given.scene, prompt, model, options, PictureCache(options.cache), stages, waits=waits)


def split_degrees(text: str) -> tuple[str, ...]:
    """Return the prompts of --degrees, none for "".

    Raises:
        ProgdfError: a prompt is empty.
    """
    if not text:
        return ()
    prompts = tuple(part.strip() for part in text.split("|"))
    if not all(prompts):
        raise ProgdfError(f"--degrees '{text}' has an empty prompt; write TEXT or TEXT|TEXT")
    return prompts


def check_served(options: EditorOptions) -> ImageModel:
    """Return the model of `api:` or `comfy:` after checking the options. Nothing is sent.

    Raises:
        ProgdfError: a prompt of --degrees is empty; see also `check_api` and `check_comfy`.
    """
    split_degrees(options.degrees)
    check = check_comfy if options.family == "comfy" else check_api
    return check(options.text, options)


def explain_sending(options: EditorOptions, views: int, stages: int = 1) -> str:
    """Return where the pictures of a run are sent, how many calls it makes, and what they cost if known.

    Args:
        options: options of `api:` or `comfy:`
        views: number of views; 0: the default
        stages: number of strengths that are requested from a model with a strength
    """
    model = check_served(options)
    degrees = len(split_degrees(options.degrees))
    calls = (views or VIEWS) * (stages if model.has_strength else 1 + degrees)
    cost = f", about {calls * options.price_per_call:.2f} in all" if options.price_per_call else ""
    host = model.address.host
    return (
        f"{format_count(calls, 'picture')} of the scene and your instruction are sent to {host} "
        f"({model.name}), one call each{cost}"
    )
