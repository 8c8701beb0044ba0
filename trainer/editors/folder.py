"""Edited views made elsewhere: any tool that reads and writes pictures can be the editor.

    folder:DIR     DIR/view_000.png …                the finished edit, strength 1
                   DIR/0.25/view_000.png … DIR/0.5/… further strengths, a subfolder each

Files are named as the run names its views (see RUN/views/original); another size is scaled to the view's.
`photographs:DIR` is the same with edited copies of the photographs that the cameras took, named as these;
what the lenses bent is straightened first, as the views are straight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.lens import straightened
from progdf.region import Region
from trainer.editors.base import EditKind, EditorSettings
from trainer.pictures import read_picture
from trainer.views import View

_REMEDY = "put the edited copies of RUN/views/original/*.png there, under the same names"
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True)
class FolderEditor:
    """Reads edited views from one folder per strength.

    Args:
        folders: strength → folder
        stages: the strengths, ascending
        bent: the pictures were taken through the views' lenses and are to be straightened
    """

    folders: dict[float, Path]
    stages: tuple[float, ...]
    kind: EditKind = "style"
    confined: bool = False
    bent: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`; ProgdfError where the picture is missing, broken or of another shape."""
        if strength == 0.0:
            return view.image
        if strength not in self.folders:
            raise ValueError(f"no folder holds strength {strength:g}; there are {list(self.stages)}")
        camera = view.camera
        path = _picture(self.folders[strength], camera.name)
        picture = read_picture(path, size=(camera.width, camera.height))
        if not self.bent or camera.lens is None:
            return picture
        straight, shown = straightened(picture, camera.K, camera.lens)
        return torch.where(shown[..., None], straight, view.image)


def folder_of(what: str) -> Path:
    """The DIR of `folder:DIR`; ProgdfError where there is no such folder."""
    if not what:
        raise ProgdfError("folder: names no folder; write folder:DIR with the edited views in DIR")
    root = Path(what).expanduser()
    if not root.is_dir():
        raise ProgdfError(f"{root} is not a folder; {_REMEDY}")
    return root


def folder(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> FolderEditor:
    """`folder:DIR`: see the module's head. Every view's picture is looked for before training starts."""
    root = folder_of(what)
    folders: dict[float, Path] = {}
    for child in sorted(root.iterdir()):
        strength = _strength(child.name)
        if child.is_dir() and strength is not None:
            if not 0.0 < strength <= 1.0:
                raise ProgdfError(f"{child} is named for a strength outside 0..1; name it 0.25, 0.5, … or 1")
            folders[strength] = child
    if 1.0 not in folders:
        folders[1.0] = root
    editor = FolderEditor(folders, tuple(sorted(folders)))
    for strength in editor.stages:
        for view in views:
            _picture(folders[strength], view.camera.name)
    return editor


def photographs(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> FolderEditor:
    """`photographs:DIR`: see the module's head."""
    return replace(folder(what, scene, region, views, settings), bent=True)


def _strength(name: str) -> float | None:
    try:
        value = float(name)
    except ValueError:
        return None
    return value if torch.isfinite(torch.tensor(value)) else None


def _picture(where: Path, name: str) -> Path:
    for suffix in SUFFIXES:
        if (where / f"{name}{suffix}").is_file():
            return where / f"{name}{suffix}"
    raise ProgdfError(f"{where} has no picture {name}.png; {_REMEDY}")
