"""Layers that a picture shows: their files, found by its metadata, and the scene that they compose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.picture_camera import PictureLayer, PictureLayers
from progdf.io.session import sha256

from .added import extend
from .layer_paint import layer_of
from .layers import Gains
from .reference import compose_layers


@dataclass(frozen=True)
class OpenLayer:
    """Layer of a picture with its edit."""

    gdf: Gdf
    state: PictureLayer


def find_layer_files(layers: PictureLayers, picture: Path, scene: Path | None) -> list[Path]:
    """Return the files of the layers that a picture shows, in their order.

    A file is looked up from the folder of the scene, then by its name beside the scene and the picture.

    Args:
        layers: from the picture's metadata
        picture: the picture
        scene: file of the scene; None: unknown

    Raises:
        ProgdfError: files are missing, or differ from those that the picture shows.
    """
    beside = [picture.resolve().parent]
    if scene is not None:
        beside.insert(0, scene.resolve().parent)
    files = []
    missing = []
    changed = []
    for layer in layers.layers:
        name = PureWindowsPath(layer.file).name
        candidates = dict.fromkeys([beside[0] / layer.file, *(folder / name for folder in beside)])
        found = [file for file in candidates if file.is_file()]
        exact = next((file for file in found if sha256(file) == layer.sha256.lower()), None)
        if exact is not None:
            files.append(exact)
        elif found:
            changed.append(str(found[0]))
        else:
            missing.append(f"{layer.name} ({layer.file})")
    if missing:
        raise ProgdfError(
            f"{picture} shows layers whose files are missing: {', '.join(dict.fromkeys(missing))}; put them "
            "beside the scene, or take the view again"
        )
    if changed:
        raise ProgdfError(
            f"{picture} shows other versions of {', '.join(dict.fromkeys(changed))}; take the view again"
        )
    return files


def open_picture_layers(
    layers: PictureLayers, files: Sequence[Path], scene: Gaussians, scene_name: str
) -> list[OpenLayer]:
    """Load the edits of the layers that a picture shows. A file of several layers is loaded once.

    Args:
        layers: from the picture's metadata
        files: see `find_layer_files`
        scene: the original
        scene_name: its name in messages

    Raises:
        ProgdfError: see `load_gdf`.
    """
    gdfs = {file: load_gdf(file, scene, scene_name) for file in dict.fromkeys(files)}
    return [OpenLayer(gdfs[file], state) for file, state in zip(files, layers.layers, strict=True)]


def compose_picture(
    scene: Gaussians, layers: Sequence[OpenLayer], blend: str, further: Gdf | None = None
) -> Gaussians:
    """Return the scene as a picture shows it, with the rows that the layers add after its own.

    Args:
        scene: the original
        layers: the lowest first
        blend: blend rule
        further: edit on top of them, at strength 1

    Raises:
        ProgdfError: see `compose_layers` and `layer_of`.
    """
    stack = list(layers)
    if further is not None:
        stack.append(OpenLayer(further, PictureLayer(further.name, "", "", 1.0)))
    edits = {id(layer.gdf): layer.gdf for layer in stack}
    extended, converted = extend(scene, list(edits.values()))
    edits = dict(zip(edits, converted, strict=True))
    composed = []
    for layer in stack:
        state = layer.state
        gains = Gains(state.geometry, state.opacity, state.color, state.texture)
        composed.append(layer_of(edits[id(layer.gdf)], state.strength, gains, state.paint, state.blend))
    return compose_layers(extended, composed, blend)
