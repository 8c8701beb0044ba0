"""Notebook widget: the web page in a cell, `viewer.Widget`, built on anywidget.

Needs the extra `jupyter` (`pip install progdf-studio[jupyter]`).
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, SupportsFloat

import torch
from PIL.Image import Image

from progdf.compose.layer_paint import encode
from progdf.compose.layers import DEFAULT_BLEND, Layer, check_layers
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf, verify
from progdf.io.images import to_picture
from progdf.io.json_values import convert_json, to_json
from progdf.system.packages import install_extra

from .camera.view_camera import LARGEST_SIDE, ViewCamera, first_camera
from .files.document import Document
from .files.web_page import (
    PAGE_ASPECT,
    PageOptions,
    camera_json,
    first_state,
    picture,
    still_picture,
    write_page,
)
from .state.layers import largest_strength
from .state.view_state import LayerState, ViewState
from .web.container import pack
from .web.page import PageTexts, build_widget

try:
    import anywidget
    import traitlets
except ImportError as error:
    raise ProgdfError(f"viewer.Widget needs anywidget; {install_extra('jupyter')}") from error

_SNAPSHOT_SIZE = 720, 480  # width and height of the picture where no script runs, px


class RefusedError(ProgdfError, traitlets.TraitError):
    """Invalid value for a widget's trait. The trait keeps its earlier value."""


class Values(dict[str, Any]):
    """Strengths or camera of a widget. Setting an entry updates the drawn scene."""

    def __init__(self, values: Mapping[str, Any], widget: Widget, trait: str) -> None:
        super().__init__(values)
        self._widget = widget
        self._trait = trait

    def __setitem__(self, name: str, value: Any) -> None:
        self.update({name: value})

    def __ior__(self, values: Any) -> Values:  # type: ignore[misc, override]
        self.update(values)
        return self

    def update(self, *values: Any, **more: Any) -> None:
        """Set the given entries, or raise RefusedError and leave all entries unchanged."""
        self._widget.set_trait(self._trait, dict(*values, **more))
        super().update(getattr(self._widget, self._trait))

    def _refuse(self, *_: Any) -> Any:
        raise RefusedError(f"entries of {self._trait} cannot be added or removed; set an existing entry")

    __delitem__ = pop = popitem = clear = setdefault = _refuse


class Widget(anywidget.AnyWidget):
    """Scene with its layers and their sliders. Changes in Python and in the browser update each other.

    Raises ProgdfError for a layer that was made for another scene and for invalid numbers, names and blend
    rules. Raises TypeError for a scene that is not `Gaussians` and a layer that is neither `Layer` nor `Gdf`.
    """

    _esm = build_widget()
    _markup = traitlets.Unicode().tag(sync=True)
    scene = traitlets.Bytes(help="scene data for the browser, see `viewer.web.container.pack`").tag(sync=True)
    strengths = traitlets.Dict(help="slider values by layer name; omitted layers are unchanged").tag(
        sync=True
    )
    hidden = traitlets.List(traitlets.Unicode(), help="names of hidden layers").tag(sync=True)
    blend = traitlets.Unicode(DEFAULT_BLEND, help="blend rule, one of `BLENDS`").tag(sync=True)
    camera = traitlets.Dict(
        help="`ViewCamera` as a dict (pivot, distance, azimuth, elevation, fov_y, up); omitted: unchanged"
    ).tag(sync=True)
    height = traitlets.Int(480, min=100, max=4000, help="px").tag(sync=True)

    def __init__(
        self,
        scene: Gaussians,
        layers: Sequence[Layer | Gdf] = (),
        *,
        title: str = "",
        credit: str = "",
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        blend: str = DEFAULT_BLEND,
        quality: Literal["exact", "compact"] = "compact",
        height: int = 480,
    ) -> None:
        """Pack the scene for the browser.

        Args:
            scene: the original
            layers: lowest layer first; a bare `Gdf` is a layer at strength 1
            title: text above the sliders
            credit: text below the sliders; addresses become links
            background: rgb behind the scene, 0 to 1
            blend: one of `BLENDS`
            quality: "exact" (float32) or "compact" (8 and 16 bits, a third of the size)
            height: height of the cell, 100 to 4000 px
        """
        stack = _stack(scene, layers, blend)
        original = _drawable(scene)
        edits = tuple[Gdf, ...]()
        for layer in stack:
            name = Document("", original, edits).free_name(layer.gdf.name)
            edits = (*edits, replace(layer.gdf, name=name))
        self._document = Document(title or "scene", original, edits)
        view = ViewState(
            camera=first_camera(original, aspect=PAGE_ASPECT),
            layers=tuple(_state(i, edits[i].name, layer) for i, layer in enumerate(stack)),
            blend=blend,
            background=background,
            overshoot=any(layer.strength > 1.0 for layer in stack),
        )
        self._view = convert_json(to_json(view), ViewState)  # raises ValueError for numbers out of range
        still = still_picture(self._document.scene, self._document.gdfs, self._view, side=480)
        state, _ = first_state(self._document, self._view)
        super().__init__(
            _markup=PageTexts(title, credit, background, still).markup,
            scene=pack(self._document.scene, self._document.gdfs, quality, 3, state).data,
            strengths={layer.name: layer.strength for layer in self._view.layers},
            hidden=[layer.name for layer in self._view.layers if not layer.enabled],
            blend=blend,
            camera=camera_json(self._view.camera),
            height=height,
        )

    def snapshot(self, width: int = 960, height: int = 640) -> Image:
        """Render the current strengths and camera with the CPU engine.

        Args:
            width: columns of the image, 1 to `LARGEST_SIDE`
            height: rows of the image, 1 to `LARGEST_SIDE`

        Raises:
            ProgdfError: a side is out of range.
        """
        if not all(1 <= side <= LARGEST_SIDE for side in (width, height)):
            raise ProgdfError(
                f"{width} × {height} cannot be drawn; each side may be 1 to {LARGEST_SIDE} pixels"
            )
        view = self._present()
        return to_picture(picture(self._document.scene, self._document.gdfs, view, (width, height)))

    def to_html(
        self,
        path: str | Path,
        *,
        title: str = "",
        credit: str = "",
        quality: Literal["exact", "compact"] = "compact",
    ) -> str:
        """Write a standalone web page with the current strengths and camera.

        Args:
            path: output file (.html)
            title: text above the sliders, "" for the scene's name
            credit: author and license of the scene, below the sliders; addresses become links
            quality: "exact" for float32; "compact" for 8 and 16 bits, at a third of the size

        Returns:
            One line that describes the contents of the page.

        Raises:
            ProgdfError: see `write_page`.
        """
        options = PageOptions(quality=quality, title=title or None, credit=credit)
        return write_page(Path(path), self._document, self._present(), (), options)

    def _present(self) -> ViewState:
        layers = tuple(
            replace(layer, strength=self.strengths[layer.name], enabled=layer.name not in self.hidden)
            for layer in self._view.layers
        )
        camera = convert_json(self.camera, ViewCamera)
        return replace(self._view, layers=layers, blend=self.blend, camera=camera)

    @traitlets.validate("strengths", "hidden", "blend", "camera")
    def _check(self, proposal: Mapping[str, Any]) -> Any:
        checks: dict[str, Callable[[Any], Any]] = {
            "strengths": self._merge_strengths,
            "hidden": self._check_names,
            "blend": _check_blend,
            "camera": self._merge_camera,
        }
        try:
            return checks[proposal["trait"].name](proposal["value"])
        except ValueError as error:
            raise RefusedError(str(error)) from None

    def _merge_strengths(self, given: Mapping[str, Any]) -> Values:
        values = {layer.name: layer.strength for layer in self._view.layers} | self.strengths
        max_strength = largest_strength(self._view)
        for name in self._check_names(list(given)):
            strength = given[name]  # also a scalar of numpy or torch
            if not isinstance(strength, SupportsFloat) or not 0.0 <= float(strength) <= max_strength:
                raise ProgdfError(
                    f"the strength of {name} is {strength!r:.40}; use a number, 0 to {max_strength:g}"
                )
            values[name] = float(strength)
        return Values(values, self, "strengths")

    def _merge_camera(self, given: Mapping[str, Any]) -> Values:
        known = camera_json(self._view.camera) | self.camera
        return Values(camera_json(convert_json(known | dict(given), ViewCamera, closed=True)), self, "camera")

    def _check_names(self, names: list[str]) -> list[str]:
        known = [layer.name for layer in self._view.layers]
        for name in names:
            if name not in known:
                raise ProgdfError(f"there is no layer {name}; there are {', '.join(known) or 'none'}")
        return names

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        """Add a still image for notebook viewers that run no widgets."""
        data, about = super()._repr_mimebundle_(**kwargs)  # type: ignore[misc]
        file = io.BytesIO()
        self.snapshot(*_SNAPSHOT_SIZE).save(file, "JPEG", quality=85)
        return {**data, "image/jpeg": base64.b64encode(file.getvalue()).decode()}, about


def _check_blend(blend: str) -> str:
    check_layers((), blend)
    return blend


def _stack(scene: Gaussians, layers: Sequence[Layer | Gdf], blend: str) -> list[Layer]:
    """Return the validated layers of a scene. Raises TypeError or ProgdfError for invalid ones."""
    if not isinstance(scene, Gaussians):
        raise TypeError(f"the scene is {type(scene).__name__}, expected Gaussians, see progdf.load_scene")
    stack = []
    for layer in layers:
        if not isinstance(layer, Layer | Gdf):
            raise TypeError(f"a layer is {type(layer).__name__}, expected Layer or Gdf, see progdf.load_gdf")
        stack.append(Layer(layer) if isinstance(layer, Gdf) else layer)
        verify(stack[-1].gdf, scene)
    check_layers(stack, blend)
    return stack


def _drawable(scene: Gaussians) -> Gaussians:
    """Return the scene as float32 on the CPU without gradients. Raises ProgdfError if it is not finite."""
    plain_scene = scene.to("cpu", torch.float32)
    tensors = {name: getattr(plain_scene, name).detach() for name in ATTRIBUTES}
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise ProgdfError(f"the scene cannot be shown: {name} holds NaN or infinity")
    return replace(plain_scene, **tensors)


def _state(index: int, name: str, layer: Layer) -> LayerState:
    paint = "" if layer.weights is None else encode(layer.weights.numpy())
    return LayerState(index, name, layer.strength, layer.enabled, layer.gains, paint=paint)
