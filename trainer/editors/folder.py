"""Edited views made elsewhere: any tool that reads and writes pictures can be the editor.

    folder:DIR     DIR/view_000.png …                the finished edit, strength 1
                   DIR/0.25/view_000.png … DIR/0.5/… further strengths, a subfolder each

Files are named as the run names its views (see RUN/views/original); another size is scaled to the view's.
`photographs:EDITED,ORIGINALS` is the same with edited copies of the photographs that the cameras took, and
these photographs themselves, under the same names; what the lenses bent is straightened first, as the views
are straight. A scene is never as sharp as its photographs: what is trained towards is the render plus the
change of the photograph, or all that the reconstruction missed would be taken for the edit. Without the
originals the two cannot be told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import read_picture
from progdf.lens import undistort
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.views.view import View

_EDITED = "put the edited copies of RUN/views/original/*.png there, under the same names"
_TAKEN = "put the photographs there, under the names that the cameras have"
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True)
class FolderEditor:
    """Reads edited views from one folder per strength.

    Args:
        folders: strength → folder
        stages: the strengths, ascending
        bent: the pictures were taken through the views' lenses and are to be straightened
        originals: where the unedited photographs lie, if the views are to be changed as these were; else the
            pictures are taken as they are
    """

    folders: dict[float, Path]
    stages: tuple[float, ...]
    kind: EditKind = "style"
    confined: bool = False
    bent: bool = False
    originals: Path | None = None

    @property
    def warning(self) -> str | None:
        """What the person should know before training, if anything."""
        if not self.bent or self.originals is not None:
            return None
        return (
            "photographs: without the unedited photographs, what the scene shows otherwise than they do is "
            "trained as part of the edit; name their folder too, photographs:EDITED,ORIGINALS"
        )

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`; ProgdfError where the picture is missing, broken or of another shape."""
        if strength == 0.0:
            return view.image
        if strength not in self.folders:
            raise ValueError(f"no folder holds strength {strength:g}; there are {list(self.stages)}")
        picture, shown = self._read_undistorted(self.folders[strength], view)
        if self.originals is not None:
            picture = (view.image + picture - self._read_undistorted(self.originals, view)[0]).clamp(0.0, 1.0)
        return torch.where(shown[..., None], picture, view.image)

    def _read_undistorted(self, where: Path, view: View) -> tuple[Tensor, Tensor]:
        """A picture at its view's size, straight, and which of its pixels were taken. [H,W,3], [H,W] bool"""
        camera = view.camera
        path, size = _picture(where, camera.name, self.bent), (camera.width, camera.height)
        picture = read_picture(path, size, calibrated=self.bent)
        if not self.bent or camera.lens is None:
            return picture, torch.ones_like(picture[..., 0], dtype=torch.bool)
        return undistort(picture, camera.K, camera.lens)


def folder_of(what: str) -> Path:
    """The DIR of `folder:DIR`; ProgdfError where there is no such folder."""
    if not what:
        raise ProgdfError("folder: needs a folder; write folder:DIR with the edited views in DIR")
    root = Path(what).expanduser()
    if not root.is_dir():
        raise ProgdfError(f"{root} is not a folder; {_EDITED}")
    return root


def photograph_folders(what: str) -> tuple[Path, Path | None]:
    """EDITED and ORIGINALS of `photographs:EDITED,ORIGINALS`; ProgdfError where one is no folder."""
    edited, comma, originals = what.rpartition(",")
    names = [edited, originals] if comma and not Path(what).expanduser().is_dir() else [what]
    roots = [Path(name).expanduser() for name in names]
    for name, root in zip(names, roots, strict=True):
        if not name:
            raise ProgdfError("photographs: needs a folder; write photographs:EDITED,ORIGINALS")
        if not root.is_dir():
            raise ProgdfError(f"{root} is not a folder; {_TAKEN}")
    return roots[0], roots[1] if len(roots) > 1 else None


def folder(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], options: EditorOptions
) -> FolderEditor:
    """`folder:DIR`: see the module's head. Every view's picture is looked for before training starts."""
    return _make_editor(folder_of(what), views)


def _make_editor(root: Path, views: Sequence[View], bent: bool = False) -> FolderEditor:
    folders: dict[float, Path] = {}
    for child in sorted(root.iterdir()):
        strength = _strength(child.name)
        if child.is_dir() and strength is not None:
            if not 0.0 < strength <= 1.0:
                raise ProgdfError(f"{child} is named for a strength outside 0..1; name it 0.25, 0.5, … or 1")
            folders[strength] = child
    if 1.0 not in folders:
        folders[1.0] = root
    editor = FolderEditor(folders, tuple(sorted(folders)), bent=bent)
    for strength in editor.stages:
        for view in views:
            _picture(folders[strength], view.camera.name, bent)
    return editor


def photographs(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], options: EditorOptions
) -> FolderEditor:
    """`photographs:EDITED,ORIGINALS` or `photographs:EDITED`: see the module's head."""
    edited, originals = photograph_folders(what)
    if originals is not None:
        for view in views:
            _picture(originals, view.camera.name, bent=True)
    return replace(_make_editor(edited, views, bent=True), originals=originals)


def _strength(name: str) -> float | None:
    try:
        value = float(name)
    except ValueError:
        return None
    return value if torch.isfinite(torch.tensor(value)) else None


def _picture(where: Path, name: str, bent: bool) -> Path:
    for suffix in SUFFIXES:
        if (where / f"{name}{suffix}").is_file():
            return where / f"{name}{suffix}"
    raise ProgdfError(f"{where} has no picture {name}.png; {_TAKEN if bent else _EDITED}")
