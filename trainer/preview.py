"""`progdf preview`: serve previews of edits to the window, by JSON lines in and out.

    {"number": 3, "out": "3.png", "region": "all", "editor": "recolor:#3060d0", "strength": 0.7,
     "background": [1, 1, 1], "viewmat": [[…]], "K": [[…]], "width": 640, "height": 480}
    {"number": 3, "error": "", "made": "grade", "note": "trains close to this", "near": "close", "models": []}

If one color map can represent the edit, the answer is a grade, 3.gdf beside 3.png, for every strength and
camera. Otherwise it is the editor's own picture of the view. The editor "grade" only requests the region's
main colors, and 3.npz beside 3.png: its rows, a sample of its colors with its shares of their pixels, and the
view. If the request of a picture has `estimate`, an answer "near" follows: it estimates how close training
will come to the picture. A request is skipped if a later one has arrived. `model` paints a prompt; another
`seed` gives another painting. With `seed` -1 nothing is painted; `note` names the model and device, and
`models` the models on this machine. The process ends when its input ends.
"""

from __future__ import annotations

import queue
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
import tyro
from torch import Tensor

from progdf.camera import Camera
from progdf.cli.options import parse_options
from progdf.color.edits import hex_color
from progdf.color.palette import find_palette
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.gdf.file import Gdf, save_gdf
from progdf.io.images import write_image
from progdf.region import Region, whole_scene
from progdf.scene.regions import parse_region
from trainer.editors import check_new_editor, editor_row, make_editor
from trainer.editors.adapters import models_here
from trainer.editors.base import EditorInput, ImageEditor
from trainer.editors.instruct import InstructEditor, instruct
from trainer.editors.server.editor import check_served
from trainer.fit.draft import DraftViews, draft_grade, draft_views
from trainer.options import EditorOptions, RegionOptions, TrainingViewOptions
from trainer.regions.from_pictures import RegionRequest, region_kinds
from trainer.report.agreement import measure_agreement
from trainer.views.setup import make_training_setup, render_thumbnails
from trainer.views.view import View, make_view, with_near_plane

Nearness = Literal["", "close", "roughly", "far"]
"""Expected difference of the trained edit from its preview; "" if it is not known."""

NEAR_NOTES: Mapping[Nearness, str] = {
    "": "",
    "close": "trains close to this",
    "roughly": "trains roughly like this",
    "far": "will not look like this",
}
"""Notes in the form of a new edit."""

CLOSE_DB = 28.0
"""Smallest estimated PSNR at which differences from the preview are hardly visible."""
ROUGH_DB = 22.0
"""Smallest PSNR of a draft at which the trained edit resembles its preview."""

_VISIBLE_CHANGE = 0.05  # difference of a channel above which a pixel counts as changed
_ESTIMATE_VIEWS = 8  # edited views of an estimate
_ESTIMATE_SIDE_PX = 112  # their longer side, pixels

_Row3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]
_Side = Annotated[int, msgspec.Meta(ge=1, le=4096)]


@dataclass(frozen=True)
class PreviewOptions:
    """Serve previews of edits, as grades or as pictures, for the window."""

    scene: tyro.conf.Positional[Path]
    """Scene file."""


class PreviewRequest(msgspec.Struct, frozen=True):
    """Requested edit: output path, region, editor, and viewing camera.

    `viewmat` is relative to the scene's origin, which is the same in the window and in this process.
    """

    number: int
    out: str
    region: str
    editor: str
    strength: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
    background: _Row3
    viewmat: tuple[_Row4, _Row4, _Row4, _Row4]
    K: tuple[_Row3, _Row3, _Row3]
    width: _Side
    height: _Side
    model: str = ""
    api_url: str = ""
    prompt: str = ""
    seed: int = 0
    estimate: bool = False  # also estimate how close training will come to a picture


class PreviewAnswer(msgspec.Struct):
    """Answer with the request's number and the kind of output, or the reason for a failure in `error`,
    otherwise ""."""

    number: int
    error: str = ""
    made: Literal["picture", "grade", "note", "palette", "near"] = "picture"
    note: str = ""
    near: Nearness = ""  # for a grade and an estimate
    models: list[str] = msgspec.field(default_factory=list)
    follows: bool = False  # training on the prompt can follow this picture
    palette: list[str] = msgspec.field(default_factory=list)  # the region's main colors, #rrggbb


class Previewer:
    """Maker of the previews of one scene. Data that consecutive requests share is cached.

    Args:
        path: the scene's file
        cache: folder for the pictures of generative editors
    """

    def __init__(self, path: Path, cache: Path) -> None:
        self.scene = load_scene(path)
        self._path = path
        self._cache = cache
        self._region = lru_cache(maxsize=4)(self._find_region)
        self._view = lru_cache(maxsize=2)(self._make_view)
        self._editor = lru_cache(maxsize=2)(self._make_editor)
        self._nearness = lru_cache(maxsize=64)(self._estimate)
        self._draft: tuple[str, DraftViews | None] = "", None  # region of the last draft, and its views

    def grade(self, request: PreviewRequest) -> Gdf | None:
        """Return the edit as a grade; None if no grade can represent it.

        Raises:
            ProgdfError: invalid region or editor.
        """
        options = _options(request)
        check_new_editor(options)
        if not editor_row(options).color_function:
            return None
        views = self._views(request)
        return None if views is None else draft_grade(views, options, options.family)

    def palette(self, request: PreviewRequest) -> list[str]:
        """Return the main visible colors of the region, #rrggbb; empty if it is not visible.

        For the window, it saves the region's rows, the colors of its visible pixels with their shares, and
        the view with the region's own colors and its mask.

        Raises:
            ProgdfError: invalid region.
        """
        views = self._views(request)
        members = self._region(request.region).members
        rgb = torch.zeros(0, 3)
        shares = torch.zeros(0)
        if views is not None:
            visible = [(sample, sample.mask > 0.0) for sample in views.glances]
            rgb = torch.cat([sample.inside[pixels] for sample, pixels in visible])
            shares = torch.cat([sample.mask[pixels] for sample, pixels in visible])
        view = self._view(_seen(request))
        np.savez(
            Path(request.out).with_suffix(".npz"),
            rows=members.numpy(),
            colors=rgb.numpy(),
            shares=shares.numpy(),
            image=view.image.numpy(),
            inside=view.inside.numpy(),
            mask=view.mask.numpy(),
        )
        return [hex_color(color) for color in find_palette(rgb, shares).tolist()]

    def _views(self, request: PreviewRequest) -> DraftViews | None:
        if self._draft[0] != request.region:
            region = self._region(request.region)
            views = draft_views(TrainingViewOptions(scene=self._path), self.scene, region)
            self._draft = request.region, views
        return self._draft[1]

    def picture(self, request: PreviewRequest) -> Tensor:
        """Return the view as edited. [H,W,3], 0 to 1

        A picture with other surroundings is confined to the region, as training confines it.

        Raises:
            ProgdfError: invalid region or editor.
        """
        seen = _seen(request)
        view = self._view(seen)
        if not bool((view.mask > 0.0).any()):
            return view.image
        options = replace(_options(request), seed=max(0, request.seed), cache=self._cache)
        editor = self._editor(options, seen)
        edited = editor.edit(view, request.strength)
        background = torch.tensor(request.background)
        if not editor.is_confined and _repaints_surroundings(view, edited, background):
            return view.confine(edited)
        return edited

    def nearness(self, request: PreviewRequest) -> Nearness:
        """Estimate how close training will come to the editor's picture; "" for editors that are too slow.

        The estimate is the error of the best colors for a few small edited views (`measure_agreement`). It is
        "" too for editors of external pictures, and for scenes that surround their cameras.

        Raises:
            ProgdfError: invalid region or editor.
        """
        row = editor_row(EditorOptions(request.editor))
        if row.external or row.slow_strengths or row.run != "trained":
            return ""
        return self._nearness(request.region, request.editor)

    def _estimate(self, spec: str, editor: str) -> Nearness:
        region = self._region(spec)
        size = TrainingViewOptions(
            scene=self._path, views=_ESTIMATE_VIEWS, image_size=_ESTIMATE_SIDE_PX, dense=False
        )
        try:
            setup = make_training_setup(size, self.scene, region)
        except ProgdfError:  # a scene that surrounds its cameras has no rig
            return ""
        options = EditorOptions(editor)
        glances = partial(render_thumbnails, size, self.scene, region)
        painter = make_editor(options, self.scene, region, setup.views, glances)
        edited = [painter.edit(view, 1.0) for view in setup.views]
        count = len(setup.train)
        found = measure_agreement(setup, edited[:count], edited[count:] or edited)
        if found.psnr >= CLOSE_DB:
            return "close"
        return "roughly" if found.agree else "far"

    def note(self, request: PreviewRequest) -> str:
        """Return a note on the model that would paint a prompt, its device and its memory.

        Raises:
            ProgdfError: see `check_instruct`.
        """
        return self._painter(request).note

    def follows(self, request: PreviewRequest) -> bool:
        """Return True if the editor's model takes a prompt and a reference picture."""
        row = editor_row(EditorOptions(request.editor))
        if row.sends_pictures:
            return check_served(_options(request)).references > 0
        paints = row.model is not None
        return paints and self._painter(request).references > 0

    def _painter(self, request: PreviewRequest) -> InstructEditor:
        options = EditorOptions(request.editor, model=request.model)
        region = whole_scene(self.scene)
        return instruct(EditorInput(options.text, self.scene, region, (), options))

    def _find_region(self, spec: str) -> Region:
        request = RegionRequest(
            RegionOptions(spec), TrainingViewOptions(scene=self._path), _no_masks, quiet=True
        )
        return parse_region(spec, self.scene, kinds=region_kinds(request))

    def _make_view(self, seen: PreviewRequest) -> View:
        K = torch.tensor(seen.K)
        viewmat = torch.tensor(seen.viewmat)
        (camera,) = with_near_plane([Camera(viewmat, K, seen.width, seen.height, "view")], self.scene)
        return make_view(self.scene, self._region(seen.region), camera, torch.tensor(seen.background))

    def _make_editor(self, options: EditorOptions, seen: PreviewRequest) -> ImageEditor:
        check_new_editor(options)
        region = self._region(seen.region)
        glances = partial(render_thumbnails, TrainingViewOptions(scene=self._path), self.scene, region)
        return make_editor(options, self.scene, region, [self._view(seen)], glances)


def _options(request: PreviewRequest) -> EditorOptions:
    """Return the options of the request's editor."""
    return EditorOptions(request.editor, model=request.model, api_url=request.api_url, prompt=request.prompt)


def _repaints_surroundings(view: View, edited: Tensor, background: Tensor) -> bool:
    """Return True if most visible surroundings of the region are changed, as a filter of the picture does.

    New paint beside the region, such as a hat, leaves most of them unchanged.
    """
    rows, columns = torch.nonzero(view.mask > 0.0, as_tuple=True)
    box = torch.zeros_like(view.mask, dtype=torch.bool)
    box[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
    drawn = (view.image - background).abs().amax(dim=2) > _VISIBLE_CHANGE
    beside = box & drawn & (view.mask < 0.05)
    changed = (edited - view.image).abs().amax(dim=2) > _VISIBLE_CHANGE
    return int((beside & changed).sum()) > 0.5 * int(beside.sum())


def _seen(request: PreviewRequest) -> PreviewRequest:
    """Return the region, background and camera of a request, as a key of its view."""
    return msgspec.structs.replace(
        request,
        number=0,
        out="",
        editor="",
        strength=0.0,
        model="",
        api_url="",
        prompt="",
        seed=0,
        estimate=False,
    )


def draft_nearness(psnr: float) -> Nearness:
    """Return the expected difference of training from a preview, by the PSNR of a draft in dB."""
    if psnr >= CLOSE_DB:
        return "close"
    return "roughly" if psnr >= ROUGH_DB else "far"


def serve(argv: Sequence[str]) -> int:
    """Run `progdf preview`; return 0 at the end of its input. Raises ProgdfError for an invalid scene."""
    options = parse_options(PreviewOptions, argv, "progdf preview")
    with tempfile.TemporaryDirectory(prefix="progdf-preview-") as cache:
        previewer = Previewer(options.scene, Path(cache))
        lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=_read_lines, args=(lines,), daemon=True).start()
        while line := newest_line(lines):
            made = answer(previewer, line)
            _write(made)
            if made.made == "picture" and not made.error and lines.empty():
                later = estimate(previewer, line)
                if later is not None:
                    _write(later)
    return 0


def _write(made: PreviewAnswer) -> None:
    """Write an answer to standard output as a line of JSON."""
    sys.stdout.write(msgspec.json.encode(made).decode() + "\n")
    sys.stdout.flush()


def answer(previewer: Previewer, line: str) -> PreviewAnswer:
    """Write the requested output and return the answer, which also reports failures."""
    try:
        request = msgspec.json.decode(line, type=PreviewRequest)
    except msgspec.MsgspecError as error:
        return PreviewAnswer(-1, f"the request cannot be read: {error}")
    try:
        if request.editor == "grade":
            return PreviewAnswer(request.number, made="palette", palette=previewer.palette(request))
        draft = previewer.grade(request)
        if draft is not None:
            save_gdf(Path(request.out).with_suffix(".gdf"), draft)
            near = draft_nearness(draft.report["draft"]["psnr"])
            return PreviewAnswer(request.number, made="grade", note=NEAR_NOTES[near], near=near)
        if request.seed < 0:
            note = previewer.note(request)
            return PreviewAnswer(request.number, made="note", note=note, models=models_here())
        write_image(Path(request.out), previewer.picture(request))
        return PreviewAnswer(request.number, follows=previewer.follows(request))
    except (ProgdfError, OSError) as error:
        # after a failed prompt the user can choose another model
        models = models_here() if request.editor.startswith("instruct:") else []
        return PreviewAnswer(request.number, " ".join(str(error).split()), models=models)


def estimate(previewer: Previewer, line: str) -> PreviewAnswer | None:
    """Return the answer that follows a picture; None if it is not requested or not known."""
    request = msgspec.json.decode(line, type=PreviewRequest)
    if not request.estimate:
        return None
    try:
        near = previewer.nearness(request)
    except ProgdfError:  # the preview itself reports the failure
        return None
    if not near:
        return None
    return PreviewAnswer(request.number, made="near", note=NEAR_NOTES[near], near=near)


def _read_lines(lines: queue.SimpleQueue[str]) -> None:
    for line in sys.stdin:
        lines.put(line)
    lines.put("")


def newest_line(lines: queue.SimpleQueue[str]) -> str:
    """Return the last line received, "" at the end of the input; wait if there is none."""
    line = lines.get()
    while line and not lines.empty():
        line = lines.get()
    return line


def _no_masks() -> Path:
    raise ProgdfError("finding this region takes a while, so it has no preview")
