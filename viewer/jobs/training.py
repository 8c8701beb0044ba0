"""Training from the window: the form of a new edit, its command line, and the files of a run.

The trainer is another program (`progdf train`). This module knows only its command line and its files:

    SCENE.edits/NAME/              the run's folder, see `progdf train --out`
    SCENE.edits/NAME.train.json    the order, so that a stopped run can be resumed in a later session
    SCENE.edits/NAME.train.log     its output
    SCENE.edits/NAME.train.lock    locked by the window that has it in its queue: it alone writes these files
    SCENE.edits/NAME.region.npy    the selection that it edits
    SCENE.edits/NAME.draft.gdf     a grade: the layer's file until the edit is written
    SCENE.edits/NAME.kept.gdf      the newest recording of a stopped run that was kept as a layer

The last two stay, because a session may refer to them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import torch

from progdf.errors import ProgdfError
from progdf.field.separable import fit_keyframes
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.io import atomic
from progdf.io.json_values import convert_json, read_json, to_json
from progdf.io.picture_camera import layers_in_picture
from progdf.io.tensors import read_tensors
from progdf.region import Region
from progdf.terminal import group_digits

from .child import Progress

# suffixes of the files beside a run's folder
ORDER = ".train.json"
LOG = ".train.log"
WINDOW_LOCK = ".train.lock"
DRAFT = ".draft.gdf"
KEPT = ".kept.gdf"

_FILLED = " filled"  # end of the name of a run that fills the hole of a removal


class _Paint(msgspec.Struct):
    pixels: int = 0  # number of painted pixels
    summary: str = ""  # the reproduced share of the paint, one line
    warning: str = ""  # the same if too little was reproduced, "" if enough was


class _CarryOn(msgspec.Struct):
    offered: bool = False  # the color map may continue over parts that no picture shows
    explained: float = 0.0  # share of the visible change that it explains, 0 to 1
    unchanged: int = 0  # Gaussians of the region that no picture shows


class _Report(msgspec.Struct):
    """Part of RUN/report.json: the result of a finished run on painted pictures."""

    paint: _Paint | None = None
    carry_on: _CarryOn | None = None


@dataclass(frozen=True)
class EditOrder:
    """Training run: its options and its files."""

    scene: Path  # file of the scene
    out: Path  # the run's folder
    name: str  # name of the layer
    region: str  # value of `progdf train --region`
    editor: str  # value of `progdf train --editor`
    quick: bool = True  # train with --quick
    threads: int = 0  # CPU threads; 0 for all
    model: str = ""  # diffusion model for a sentence; "" selects one that fits
    api_url: str = ""  # address of a server that receives pictures, "" for none
    prompt: str = ""  # text for a workflow, "" for its own
    anchor: str = ""  # file of an edited picture that is the reference of all views, "" for none
    at: str = ""  # for a decal: its position in the camera's picture
    camera: str = ""  # file of that camera
    carry_on: str = ""  # value of `progdf train --carry-on`, "" for its default
    replaces: str = ""  # file of the edit whose layer the result replaces, "" for a new layer
    hole_of: str = ""  # name of the removal whose hole it fills, "" for other runs

    def arguments(self, resumes: bool = False) -> list[str]:
        """Return the command-line arguments after `progdf`."""
        words = ["train", str(self.scene), f"--out={self.out}", f"--region={self.region}"]
        words += [f"--editor={self.editor}", f"--name={self.name}", f"--threads={self.threads}"]
        given = {"model": self.model, "anchor": self.anchor, "at": self.at, "camera": self.camera}
        given |= {"carry-on": self.carry_on, "api-url": self.api_url, "prompt": self.prompt}
        words += [f"--{name}={value}" for name, value in given.items() if value]
        if self.api_url:
            words.append("--yes")  # the user has agreed in the window, see `consent`
        if self.quick:
            words.append("--quick")
        if resumes:
            words.append("--resume")
        return words

    @property
    def title(self) -> str:
        """Title of its card."""
        return f"Fill the hole of “{self.hole_of}”" if self.hole_of else self.name

    @property
    def fills(self) -> bool:
        """True for a run that fills the hole of a removal."""
        return self.editor == "remove" and bool(self.replaces)

    @property
    def sends_pictures(self) -> bool:
        """True if a server makes its pictures, which may be paid."""
        return bool(self.api_url)

    @property
    def result(self) -> Path:
        """File of the trained edit."""
        return self.out / f"{self.name}.gdf"

    @property
    def is_delivered(self) -> bool:
        """True if the trained edit is complete, while its report may still be running."""
        return os.path.isfile(self.result) and os.path.isfile(self.out / "report.json")

    @property
    def draft(self) -> Path:
        """File of the edit before training, if a grade alone represents it; may be absent."""
        return self._beside(DRAFT)

    @property
    def kept_edit(self) -> Path:
        """File of the recording that was kept as a layer; may be absent."""
        return self._beside(KEPT)

    @property
    def drafts(self) -> tuple[Path, ...]:
        """Files of layers that the trained edit replaces; each may be absent."""
        return self.draft, self.kept_edit

    @property
    def log(self) -> Path:
        """Output of the run."""
        return self._beside(LOG)

    @property
    def is_begun(self) -> bool:
        """True if the run has saved a state that it can resume from."""
        return os.path.isfile(self.out / "state" / "run.json")  # False if it may not be read

    @property
    def is_keepable(self) -> bool:
        """True if it has a recording that is not a layer yet, and may become one.

        A draft stays anyway. A run that replaces the layer of another one leaves that layer.
        """
        recording = self.newest_recording()
        has_layer = self.draft.exists() or self.is_delivered or bool(self.replaces)
        if recording is None or has_layer or self.paints_over_layers:
            return False
        return not _is_newer(self.kept_edit, recording)

    @property
    def paints_over_layers(self) -> bool:
        """True if its pictures show other layers, to which its recordings are relative."""
        kind, _, files = self.editor.partition(":")
        if kind != "pictures":
            return False
        names = [files] if os.path.isfile(files) else files.split(",")
        with contextlib.suppress(ProgdfError):
            return any(layers_in_picture(name) is not None for name in names)
        return False

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
        """Remove an unfinished run and its order. An edit that is written stays; only its report is given up.

        Raises:
            ProgdfError: it cannot be removed, and is unchanged.
        """
        run = self.out / "state" / "run.json"
        if self.out.is_symlink() or run.parent.is_symlink():
            raise ProgdfError(f"{self.out} is behind a link, which is not followed; remove the link")
        try:
            run.unlink(missing_ok=True)  # first: the remaining files alone are not a run
        except OSError as error:
            reason = error.strerror or error
            raise ProgdfError(f"{self.out} cannot be removed ({reason}); check its permissions") from error
        if self.result.exists():
            shutil.rmtree(run.parent, ignore_errors=True)
            return
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
        return self._paint().warning

    def summary(self) -> str:
        """Return the reproduced share of the paint in one line, "" for a run without painted pictures."""
        paint = self._paint()
        return paint.summary if paint.pixels else ""

    def offer(self) -> str:
        """Return a line about the continuation that the finished run offers, "" for none."""
        found = self._report().carry_on
        if found is None or not found.offered:
            return ""
        return (
            f"One color map explains {100 * found.explained:.0f} % of the change. It can also color "
            f"{group_digits(found.unchanged)} splats that the picture does not show, as a guess."
        )

    @property
    def behind(self) -> Path:
        """Picture from behind of the offered continuation, with its camera; may be absent."""
        return self.out / "behind.png"

    def _paint(self) -> _Paint:
        """Return the result of the finished run on painted pictures."""
        return self._report().paint or _Paint()

    def _report(self) -> _Report:
        try:
            return read_json(self.out / "report.json", _Report)
        except ProgdfError:
            return _Report()

    def newest_recording(self) -> Path | None:
        """Return the file of the last saved recording; None if there is none."""
        folder = self.out / "state" / "recordings"
        with contextlib.suppress(OSError):
            names = [entry.name for entry in os.scandir(folder) if entry.name[:1].isdigit()]
            return folder / max(names) if names else None
        return None

    def recorded_edit(self, recording: Path, scene: Gaussians) -> Gdf | None:
        """Return a recording as an edit of the scene that ends in the recorded state at strength 1.

        None while the file is being written, or if it belongs to another scene.
        """
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


def _is_newer(file: Path, other: Path) -> bool:
    """Return whether both files exist and the first is newer."""
    try:
        return file.stat().st_mtime_ns > other.stat().st_mtime_ns
    except OSError:
        return False


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
        return any(run.with_name(run.name + suffix).exists() for suffix in ("", ORDER, DRAFT, KEPT))

    return free_path(folder, name, is_taken=is_taken)


def filled_run(removal: Path) -> Path:
    """Return a free folder for the run that fills the hole of a removal, beside its file."""
    return free_run(removal.parent, f"{removal.stem}{_FILLED}")


def unfilled_edit(filled: Path) -> Path | None:
    """Return the file of the unfilled removal that a filled one replaced; None if it is missing."""
    name, is_filled, _ = filled.parent.name.rpartition(_FILLED)
    removal = filled.parent.with_name(f"{name}.gdf")
    return removal if is_filled and os.path.isfile(removal) else None


def free_path(
    folder: Path, name: str, suffix: str = "", is_taken: Callable[[Path], bool] = Path.exists
) -> Path:
    """Return NAME with a suffix, or NAME-2, NAME-3 … if that is taken."""
    return next(p for n in atomic.numbered_names(name, suffix) if not is_taken(p := folder / n))


def finished_edit(draft: Path) -> Path | None:
    """Return the edit trained from a draft after a session was saved with the draft; None if there is
    none."""
    name = draft.name.removesuffix(DRAFT).removesuffix(KEPT)
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
    """Return whether a folder is writable. Folders that are read-only for all count as read-only for root."""
    try:
        return bool(folder.stat().st_mode & 0o222) and os.access(folder, os.W_OK)
    except OSError:
        return False


def spare_threads() -> int:
    """Return the number of threads for a child: all but one, which the window needs."""
    return max(1, (os.cpu_count() or 2) - 1)
