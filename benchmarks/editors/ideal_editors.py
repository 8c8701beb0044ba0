"""The benchmark `ideal-editors`: agreement and sliders of text edits, with a model whose edits are known.

The ideal model knows twelve equally good edits of a bear, and the noise of each call decides between them. It
is called as `command:`, `api:`, `comfy:` and `instruct:` call their models. The trainer turns the pictures
into an edit. Held-out views compare its slider with the nearest of the twelve edits at the same degree.
Figures are means over several seeds of that noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import bear
from progdf.field import BakedField
from progdf.field.baked import interpolate
from progdf.field.separable import fit_keyframes
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import load_gdf
from progdf.io.images import write_image
from progdf.metrics.image import decibels
from progdf.region import from_mask
from tests.helpers.ideal_painter import Edit, IdealPainter, finished_edits, hue_edits, phase_edits
from tests.helpers.trained import Small
from trainer.editors.cache import PictureCache
from trainer.editors.painter import PaintRequest
from trainer.editors.style import StyleEditor
from trainer.fit.slider_uniformity import STEPS as UNIFORM_STEPS
from trainer.fit.slider_uniformity import equalize_slider
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainingViewOptions, TrainOptions
from trainer.resolve import resolve
from trainer.run.agree import Fit, PaintCache, agree_views
from trainer.run.run import train
from trainer.store.progress import RunLog
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import View, render_view

from ..table import Table

GAUSSIANS = 2000
VIEWS = 16
SIZE = 56  # pixels
CHOICES = 12
SEEDS = (0, 10, 20)  # of the model's noise; a view that is painted again takes the next one

DEGREES = (0.25, 0.5, 0.75)
PROMPTS = {"a hint of it": 0.2, "half of it": 0.45, "most of it": 0.8}
"""Weaker prompts, and the degrees that the ideal model makes of them."""

FAMILIES: Mapping[str, Callable[[Small, int], list[Edit]]] = {"hue": hue_edits, "stripes": phase_edits}


@dataclass(frozen=True)
class Way:
    """One way to call the model, and one rule for the degrees in between."""

    editor: str
    degrees: str  # "own strength", "prompts", "end only" or "end only, cross-faded"
    references: int = 0
    starts: bool = False  # the model can start from a picture
    agrees: bool = True  # the views are made to agree
    alike: bool = False  # every view shows the first ideal edit


WAYS = (
    Way("limit: one edit in all views", "own strength", agrees=False, alike=True),
    Way("`command:`, each view alone", "own strength", agrees=False),
    Way("`command:`, each view alone", "end only", agrees=False),
    Way("`api:`, `comfy:` without references", "prompts"),
    Way("`api:`, `comfy:` without references", "end only"),
    Way("`comfy:` with two references", "own strength", 2),
    Way("`api:`, `comfy:` with two references", "prompts", 2),
    Way("`api:`, `comfy:` with two references", "end only", 2),
    Way("`api:`, `comfy:` with two references", "end only, cross-faded", 2),
    Way("`instruct:` with two references and a second round", "own strength", 2, starts=True),
)


@dataclass
class PromptPainter(IdealPainter):
    """Ideal model that makes weaker edits of some prompts."""

    weaker: Mapping[str, Sequence[Tensor]] = field(default_factory=dict)  # prompt → edits, see `choices`

    def paint(self, request: PaintRequest) -> Tensor:
        """See `FramePainter.paint`."""
        choices = self.weaker.get(request.prompt)
        if choices is None:
            return super().paint(request)
        self.calls += 1
        return IdealPainter(self.views, choices, self.references).paint(replace(request, prompt=""))


@dataclass(frozen=True)
class Subject:
    """Scene on disk with the views of its runs, and the ideal edits of them."""

    folder: Path
    scene: Gaussians
    setup: TrainingSetup
    edits: Sequence[Edit]

    @property
    def case(self) -> Small:
        """Views of the run."""
        return Small(self.scene, self.setup.region, tuple(self.setup.views))


@dataclass(frozen=True)
class SliderFigures:
    """Figures of one way; PSNR in dB to the nearest ideal edit in held-out views."""

    calls: int
    agreement: float | None  # of the colors that fit the agreed views best; None if they do not agree
    end: float  # at strength 1
    between: tuple[float, ...]  # at `DEGREES`
    uniformity: float  # smallest over largest of 20 visible steps, 0 to 1


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure all ways with both families of edits."""
    rows = []
    with TemporaryDirectory() as temporary:
        for family in FAMILIES:
            subject = prepare(Path(temporary, family), FAMILIES[family])
            for number, way in enumerate(WAYS):
                folder = Path(temporary, family, str(number))
                figures = mean_figures([measure(subject, way, folder / str(seed), seed) for seed in SEEDS])
                rows.append(
                    {
                        "edit": family,
                        "editor": way.editor,
                        "degrees": way.degrees,
                        "calls": str(figures.calls),
                        "agreement": "–" if figures.agreement is None else f"{figures.agreement:.1f}",
                        "1": f"{figures.end:.1f}",
                        **{
                            name: f"{psnr:.1f}"
                            for name, psnr in zip(("¼", "½", "¾"), figures.between, strict=True)
                        },
                        "evenness": f"{figures.uniformity:.2f}",
                    }
                )
    note = (
        "PSNR in dB over the region's pixels of held-out views. agreement: the colors that fit the painted "
        f"views best, against the nearest of {CHOICES} ideal edits. 1: the trained slider likewise; ¼, ½ and "
        "¾ against that edit at the same share of its visible change. evenness: the smallest of "
        f"{UNIFORM_STEPS} visible steps over the largest. Means of {len(SEEDS)} seeds. {VIEWS} views of "
        f"{SIZE} pixels, {GAUSSIANS} Gaussians. Own strengths are requested at ¼, ½, ¾ and 1."
    )
    return [Table.of("ideal-editors", "Text edits with an ideal model", rows, note)]


def run_options(folder: Path, run: Path) -> TrainOptions:
    """Return the options of a run whose pictures are in its folder `edited`.

    Args:
        folder: folder with scene and labels
        run: folder of pictures and run
    """
    return TrainOptions(
        folder / "scene.ply",
        run / "run",
        RegionOptions(f"labels:{folder / 'labels.npy'}:1"),
        EditorOptions(f"folder:{run / 'edited'}"),
        views=TrainingViewOptions(views=VIEWS, image_size=SIZE),
        optimize=OptimizeOptions(kind="color", slider="even"),
    )


def prepare(folder: Path, family: Callable[[Small, int], list[Edit]]) -> Subject:
    """Write the scene and return it with its views and ideal edits."""
    folder.mkdir(parents=True)
    demo = bear(GAUSSIANS)
    mask = torch.zeros(GAUSSIANS, dtype=torch.bool)
    mask[demo.members("body")] = True
    save_ply(folder / "scene.ply", demo.gaussians)
    np.save(folder / "labels.npy", mask.to(torch.uint8).numpy())
    scene = load_ply(folder / "scene.ply")
    region = from_mask("body", mask)
    setup = make_training_setup(resolve(run_options(folder, folder)).views, scene, region)
    subject = Subject(folder, scene, setup, ())
    return replace(subject, edits=family(subject.case, CHOICES))


def mean_figures(figures: Sequence[SliderFigures]) -> SliderFigures:
    """Return the means of the figures of one way with several seeds."""
    agreements = [one.agreement for one in figures if one.agreement is not None]
    return SliderFigures(
        calls=round(fmean(one.calls for one in figures)),
        agreement=fmean(agreements) if agreements else None,
        end=fmean(one.end for one in figures),
        between=tuple(map(fmean, zip(*(one.between for one in figures), strict=True))),
        uniformity=fmean(one.uniformity for one in figures),
    )


def measure(subject: Subject, way: Way, folder: Path, seed: int) -> SliderFigures:
    """Paint the views in one way, train the edit, and compare its slider with the ideal edits.

    Args:
        subject: scene, views and ideal edits
        way: way to call the model
        folder: new folder of pictures and run
        seed: seed of the model's noise
    """
    painter = _painter(subject, way)
    fit = _paint(subject, way, painter, folder, seed)
    result = train(run_options(subject.folder, folder), quiet=True)
    gdf = load_gdf(result.gdf, subject.scene)
    shown = gdf.field
    if way.degrees == "end only, cross-faded":
        end = gdf.field.offsets(1.0)
        line = fit_keyframes(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros_like(end), end]), 2)
        shown = equalize_slider(line, subject.setup)[0]
    return _compare(subject, painter.calls, shown, fit)


def _painter(subject: Subject, way: Way) -> PromptPainter:
    choices = finished_edits(subject.case, subject.edits)
    painter = PromptPainter(subject.setup.views, choices, way.references)
    painter.has_start = way.starts
    painter.has_strength = way.degrees == "own strength"
    if way.degrees == "prompts":
        painter.degrees = tuple(PROMPTS)
        painter.weaker = {
            prompt: finished_edits(subject.case, subject.edits, degree) for prompt, degree in PROMPTS.items()
        }
    return painter


def _paint(subject: Subject, way: Way, painter: PromptPainter, folder: Path, seed: int) -> Fit | None:
    """Write the pictures of all views at their strengths. Return the colors that fit agreed views best."""
    folder.mkdir(parents=True)
    fit = None
    requested: tuple[float, ...] = (*DEGREES, 1.0) if way.degrees == "own strength" else (1.0,)
    if way.agrees:
        easel = PaintCache(painter, {}, PictureCache(None), seed)  # type: ignore[arg-type]
        style = StyleEditor(lambda picture: picture, {}, PictureCache(None))
        agreed = agree_views(easel, subject.setup, style, RunLog(folder / "agree.txt", quiet=True))
        edit: Edit = agreed.edit
        fit = agreed.fit
        requested = (*agreed.prompts, 1.0) if way.degrees == "prompts" else requested
    elif way.alike:
        edit = subject.edits[0]
    else:

        def edit(view: View, strength: float) -> Tensor:
            return painter.paint(PaintRequest(view.image, strength=strength, seed=seed))

    for strength in requested:
        place = folder / "edited" / (f"{strength:g}" if len(requested) > 1 else "")
        for view in subject.setup.views:
            write_image(place / f"{view.camera.name}.png", edit(view, strength))
    return fit


def _compare(subject: Subject, calls: int, shown: BakedField, fit: Fit | None) -> SliderFigures:
    """Compare a slider with the nearest ideal edit in held-out views."""
    setup = subject.setup
    members = setup.region.members
    pixels = [view.mask > 0.05 for view in setup.held_out]
    rows = pack(subject.scene[members], with_shN=shown.channels > BASE_CHANNELS)

    def slider(strength: float) -> Tensor:
        edited = subject.scene.replace_rows(members, rows + shown.offsets(strength))
        pictures = [render_view(edited, view.camera, setup.background) for view in setup.held_out]
        return _pixels([picture.clamp(0, 1) for picture in pictures], pixels)

    def ideal(edit: Edit, degree: float) -> Tensor:
        return _pixels([edit(view, degree) for view in setup.held_out], pixels)

    def psnr(a: Tensor, b: Tensor) -> float:
        return decibels(float((a - b).square().mean()))

    end = slider(1.0)
    nearest = max(subject.edits, key=lambda edit: psnr(ideal(edit, 1.0), end))
    even = torch.linspace(0, 1, UNIFORM_STEPS + 1, dtype=torch.float64)
    course = [ideal(nearest, float(s)) for s in even]
    steps = (
        torch.tensor([0.0, *(float((b - a).abs().mean()) for a, b in pairwise(course))]).double().cumsum(0)
    )
    degrees = interpolate(torch.tensor(DEGREES, dtype=torch.float64), steps / steps[-1], even)
    between = tuple(
        psnr(slider(s), ideal(nearest, float(degree))) for s, degree in zip(DEGREES, degrees, strict=True)
    )
    shown_steps = [float((b - a).abs().mean()) for a, b in pairwise([slider(float(s)) for s in even])]
    uniformity = min(shown_steps) / max(shown_steps)
    agreement = None
    if fit is not None:
        fitted = _pixels([fit.render(view.camera) for view in setup.held_out], pixels)
        agreement = max(psnr(fitted, ideal(edit, 1.0)) for edit in subject.edits)
    return SliderFigures(calls, agreement, psnr(end, ideal(nearest, 1.0)), between, uniformity)


def _pixels(pictures: Sequence[Tensor], shown: Sequence[Tensor]) -> Tensor:
    """Return the pixels of some pictures. [P,3]"""
    return torch.cat([picture[mask] for picture, mask in zip(pictures, shown, strict=True)])
