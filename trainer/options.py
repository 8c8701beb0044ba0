"""The options of the trainer's commands: nested parts, which go down to the functions as they are.

The command line is flat. `Fixed` fields are no option of it: a preset sets them, or `trainer.resolve`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from tyro.conf import Fixed

from progdf.cli.options import absent_option
from progdf.errors import ProgdfError
from progdf.field.neural import Size
from progdf.scene import UpChoice

EditKind = Literal["color", "style", "geometry"]
"""What an edit moves, which chooses learning rates and loss weights (docs/method.md 3)."""
Kind = Literal["auto", "color", "style", "geometry"]
Slider = Literal["auto", "even", "stages", "time"]
"""What slider values mean; auto becomes one of the others (`resolve_slider`)."""
Rates = Literal["kind", "3dgs", "gaussian-editor"]
Progressive = Literal["decay", "growth", "off"]
Sharpness = Literal["kind", "hinge", "paper", "off"]
Solver = Literal["descent", "colors"]
FieldLoss = Literal["parameters", "pictures"]
Over = Literal["mean", "sum"]
LiftRule = Literal["share", "paper"]
Bands = Literal["auto", "on", "off"]
Preset = Literal["default", "paper"]
Quantize = Literal["off", "nf4"]
Fill = Literal["none", "picture", "surface"]
Removal = Literal["auto", "never", "always"]
Device = Literal["auto", "cpu"]
Engine = Literal["auto", "cpu", "warp"]

DETECTOR = "IDEA-Research/grounding-dino-tiny"
SAM_MODEL = "facebook/sam-vit-base"
FieldKind = Literal["auto", "separable", "lossless", "neural"]

MAX_STAGES = 8
"""Strengths that an editor with a strength control is asked for if nobody says how many, at most."""

MAX_THREADS = 1024
"""More than any machine has: what --threads says at most."""
LARGEST_SEED = 2**32 - 1
"""What every generator of random numbers takes."""
VIEWS = 30
COLOR_VIEWS = (40, 48)
"""How many views are edited by default, and how many of an edit of colors: where these have up to one band of
directions, and where they have more (docs/experiments.md, Views)."""


@dataclass(frozen=True)
class RegionOptions:
    """What may change."""

    region: str
    """What may change: all, labels:FILE.npy:ID[,ID], box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, masks:DIR (one a
    camera), photomasks:DIR (of photographs), changed (where pictures: differ), text:"the man's shirt"; join
    by + -."""
    lift_rule: LiftRule = "share"
    """masks, text: a Gaussian's score is the share of its visible weight that lies in the masks, or, as the
    paper's, the share of its pixels, which leaves out many at borders and all that no view shows."""
    lift_threshold: Annotated[float | None, absent_option("FLOAT", "the rule's own")] = None
    """masks, text: minimum score of a member; by default .7 for share, .8 for paper."""
    detector: str = DETECTOR
    """text: id or folder of the GroundingDINO that finds objects; download it first."""
    sam_model: str = SAM_MODEL
    """text: id or folder of the SAM that outlines them; download it first."""
    box_threshold: float = 0.3
    """text: minimum detection confidence, 0 to 1; a lower one finds more, including false matches."""


@dataclass(frozen=True)
class EditorOptions:
    """How the views are edited; what is left out is as the editor's model was made for."""

    editor: str
    """recolor:#rrggbb, tint:#rrggbb, stripes:#rrggbb, darken:AMOUNT, night, folder:DIR (edited views),
    photographs:EDITED,ORIGINALS (of what the cameras took), pictures:A.png[,B.png] (rendered, then changed in
    any program), decal:LOGO.png (laid on the surface), style:N (a painting, N from 0 to 25),
    instruct:"turn him into Batman", remove (the region is taken away; remove:A.png: as one of pictures: shows
    what was behind)."""
    model: Annotated[str, absent_option("STR", "what is here and fits")] = ""
    """instruct: id or folder of a diffusers pipeline; by default black-forest-labs/FLUX.2-klein-4B where it
    was downloaded and fits the graphics card, else timbrooks/instruct-pix2pix (the paper's)."""
    guidance: Annotated[str, absent_option("NUMBER[,NUMBER]", "the model's own")] = ""
    """instruct: how closely the instruction is followed and, after a comma, the picture, where the model
    supports that; by default the model's own values (paper: 7.5,1.5)."""
    edit_steps: Annotated[int | None, absent_option("INT", "the model's own")] = None
    """instruct: denoising steps per picture; by default the model's own number (paper: 20)."""
    edit_size: Annotated[int | None, absent_option("INT", "the model's own")] = None
    """style: longer side in pixels at which pictures are painted; larger makes finer strokes. instruct: side
    of a square of the area that is painted, whatever the proportions."""
    anchor: Annotated[Path | None, absent_option("PNG", "the model paints one")] = None
    """instruct: a painted picture of the scene that decides, taken in the window (Ctrl+F2); all views follow
    it."""
    quantize: Quantize = "off"
    """instruct: nf4 keeps the model's large parts in 4 bits, a quarter of the memory at some loss (pip
    install progdf-studio[quantize])."""
    device: Device = "auto"
    """instruct: auto is the graphics card that torch has, else the CPU for what is small; cpu is the CPU for
    anything, which takes hours a picture with a large model."""
    fill: Annotated[Fill | None, absent_option("{none,picture,surface}", "by the editor")] = None
    """remove, and pictures: that take something away: how holes are closed that it hid and no view shows:
    not at all, as the picture shows them, or with the colors around (surface). By default picture where there
    is one, else surface."""
    removal: Removal = "auto"
    """pictures: whether the region is taken away instead of recolored. auto: where most of what was painted
    is what the scene shows without it."""
    seed: Fixed[int] = 0  # of the noise, the same in every view
    cache: Fixed[Path | None] = None  # folder in which painted pictures are kept; None keeps nothing
    at: Annotated[str, absent_option("X,Y,SIZE[,ANGLE]", "none")] = ""
    """decal: its center and its longer side in pixels of --camera's picture, or all three in shares of it;
    then the degrees by which it is turned, counterclockwise."""
    camera: Annotated[Path | None, absent_option("PNG|JSON", "none")] = None
    """decal: from where it is laid on: a picture that progdf render wrote, or a file of one camera."""

    @property
    def family(self) -> str:
        """The kind of editor."""
        return self.editor.partition(":")[0]


@dataclass(frozen=True)
class TrainingViewOptions:
    """Which views are edited."""

    cameras: Annotated[Path | None, absent_option("PATH", "a rig that looks at the region")] = None
    """cameras.json, transforms.json or the folder of a COLMAP model; without it, a rig that looks at
    the region."""
    cameras_anyway: bool = False
    """Use --cameras although most of them do not show the scene, as those of another frame do not."""
    up: UpChoice = "auto"
    """The axis of the scene that is up. auto: from the cameras, else from the ground, else −y."""
    views: int = 0
    """How many views are edited, 3 to 96 (the paper's limit); every fifth is held out to measure with. 0: 30,
    for an edit of colors 40, or 48 where Gaussians look different from all sides."""
    image_size: int = 0
    """Longer side of the views in pixels; 0: 256, 512 for instruct. Those of an edit of colors serve pictures
    up to twice as large."""
    dense: Fixed[bool] = True  # an edit of colors gets more views; not what is painted one by one
    pictures: Fixed[tuple[Path, ...]] = ()  # changed pictures, whose cameras are the views, all to train on
    scene: Fixed[Path | None] = None  # its file, beside which there may be cameras that tell which way is up


@dataclass(frozen=True)
class OptimizeOptions:
    """How the members are optimized."""

    steps: int = 800
    """Optimizer steps over all stages (paper: 1500-2000 towards the finished edit alone). An edit of colors
    takes an eighth of these iterations a strength at most, and ends where other views gain little."""
    kind: Kind = "auto"
    """What the edit moves; sets learning rates and loss weights. auto: as the editor knows; for folder:,
    photographs: and instruct: all are tried on a few small views, and the log says which was best."""
    group_steps: Annotated[int | None, absent_option("INT", "chosen by a trial")] = None
    """geometry: first the connected parts of the region are moved as rigid wholes, in this many steps per
    strength or twice as many; 0: every Gaussian finds its own way, which bends well but smears what moves
    far. By default 120 or 0, whichever a short trial finds better."""
    stages: int = 0
    """Number of strengths that an editor with a strength control is asked for; 0: as many as the course of an
    edit of colors bends; else 8, or 4 for fewer than 320 steps, but 1 for a style, which is the paper's way,
    towards the end alone; instruct: 4, each another pass over the views, but 1 where parts move."""
    sh: Bands = "auto"
    """Colors that change with the direction one looks from: trained, and kept where leaving them out would
    cost 0.1 dB (on, auto), or left as they are (off); those of an edit of colors follow its map, and get a
    residual where that takes a twentieth of the error away (on, auto)."""
    perceptual_weight: Annotated[float | None, absent_option("FLOAT", "by the kind of edit")] = None
    """Weight of LPIPS beside L1; by default .3 for style and geometry (paper: 1). An edit of colors is solved
    for, all views at once; a weight makes it descend view by view instead."""
    progressive: Progressive = "off"
    """The paper's progressive constraint (eq. 5), a loss that lets go of the steps (decay, as its text says)
    or tightens (growth, the printed exponent)."""
    progressive_over: Over = "mean"
    """What that loss takes of the members' squared steps, of which the paper says nothing: their mean, or
    their sum, which holds an edit back the more, the more members it has."""
    rates: Rates = "kind"
    """Learning rates: as the kind of edit needs; or, of all attributes, those of 3DGS, which hardly move in
    600 steps, or as GaussianEditor multiplies these, 5 times for means and colors, twice for all else."""
    slider: Slider = "auto"
    """Slider values. even: equal steps look equally large, and an editor with a strength control is asked for
    pictures that do; stages: s is the editor's own strength, even in between; time: the optimizer's. auto:
    even, but stages where folder: has pictures of several strengths."""
    grow: float = 0.0
    """style, folder, photographs, instruct: how many Gaussians may be added where the region has none to show
    the edit, such as a hat on a head, as a share of the region's, 0 to 1. They are where a trial finds that
    other views gain more than a tenth of the error. What moves would be grown anew; so none by default."""
    engine: Engine = "auto"
    """What draws the steps: cpu; or warp (extra gpu), where the steps stay on a CUDA card, or, slowly and for
    tests, on a CPU that stands in for one. auto: warp, if there is a card and it is installed; else cpu."""
    perceptual_every: Fixed[int] = 2  # LPIPS is paid for every so many steps
    # Of the renders: not less than the target's, or the printed term, which pulls at no pixel but the rim's.
    sharpness: Fixed[Sharpness] = "kind"
    # As the paper has it: Adam without a floor, the same rate for all steps and stages, recordings every 100
    # steps with their jitter, losses of whole pictures, every attribute kept, a network trained jointly.
    as_printed: Fixed[bool] = False
    color_solver: Fixed[bool] = True  # an edit of colors is solved for, all views at once, where it can be
    ema: Fixed[bool] = True  # a running mean of the parameters is recorded, not the bare iterates
    target_ramp: Fixed[bool] = True  # a stage's target moves from the last stage's pictures to its own
    seed: Fixed[int] = 0  # order of the views
    solver: Fixed[Solver] = "descent"  # filled in once the kind is known, see `resolve_kind`


@dataclass(frozen=True)
class FieldOptions:
    """Which field is fitted to the recording."""

    field: FieldKind = "auto"
    """Kind of field; auto is a grade for edits of colors, else separable, each the smallest that adds at most
    a tenth to the error which the edit has against its editor; lossless keeps every recording."""
    size: Size = "tiny"
    """neural: numbers in the network, 17 thousand, .5 million or 6 million (paper, a quarter of an hour)."""
    field_loss: FieldLoss = "parameters"
    """neural: what it is trained on: the recorded offsets, or pictures of them (the paper's L1 + LPIPS and
    sharpness; about .3 s a step with the network of 6 million)."""
    target_psnr: Annotated[float | None, absent_option("FLOAT", "a tenth of the edit's own error")] = None
    """The field's worst PSNR against the recorded trajectory over the slider, on held-out views, dB, in place
    of that rule. Lower values make smaller files; train also leaves out more SH of single Gaussians."""
    as_printed: Fixed[bool] = (
        False  # a network sees positions alone, through hard bins of the slider, with no codes
    )
    draft: Fixed[bool] = False  # a network takes a third of its steps
    seed: Fixed[int] = 0  # of its weights and draws


@dataclass(frozen=True)
class TextOptions:
    """What CLIP is asked; of fit and evaluate the run's own texts, if nothing is given."""

    text_before: Annotated[str, absent_option("STR", "none; of fit and evaluate the run's own")] = ""
    """What the views show before the edit, such as "a bear"; with --text-after, CLIP directional similarity
    is measured (ViT-L/14; pip install progdf-studio[clip])."""
    text_after: Annotated[str, absent_option("STR", "none; of fit and evaluate the run's own")] = ""
    """What they show after it, such as "a golden bear": a description, never an instruction."""
    asked: Fixed[bool] = False  # whether a text was given for this; an instruction alone asks for nothing


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class TrainOptions:
    """Edit a region of a scene and write its .gdf file.

    Where a default differs from ProGDF (AAAI 2025), it measured better.
    """

    scene: tyro.conf.Positional[Path]
    """The scene: a .ply (also compressed), .spz, .splat, .ksplat, .sog, .glb or .gltf."""
    out: Path
    """Folder of the run; created if needed."""
    region: RegionOptions
    editor: EditorOptions
    preset: Preset = "default"
    """Values of the options below, where the command line gives none: paper is the paper's trainer, in the
    readings that work. In Python: trainer.options.apply_preset."""
    name: Annotated[str, absent_option("STR", "the folder's name")] = ""
    """Name of the layer and of the .gdf file; the folder's name if empty."""
    views: TrainingViewOptions = TrainingViewOptions()
    optimize: OptimizeOptions = OptimizeOptions()
    field: FieldOptions = FieldOptions()
    texts: TextOptions = TextOptions()
    quick: bool = False
    """A draft in a third of the time: 240 steps, in 4 stages where colors are not solved for, 12 views."""
    seed: int = 0
    """Order of the views; the same seed gives the same files."""
    threads: int = 0
    """CPU threads; 0 takes all cores. More threads than idle cores are slower."""
    resume: bool = False
    """Continue a run that was stopped in this folder; the result is the same as without the stop."""

    @property
    def edit(self) -> dict[str, str]:
        """What identifies the edit: a run folder holds runs of one."""
        return {
            "scene": str(self.scene.resolve()),
            "region": self.region.region,
            "editor": self.editor.editor,
        }


PRESETS: Mapping[Preset, Mapping[str, Mapping[str, Any]]] = {
    "default": {},
    # the trainer of ProGDF (AAAI 2025), what it leaves open in the readings that work (docs/paper.md)
    "paper": {
        "region": {"lift_rule": "paper"},
        "views": {"views": 96, "image_size": 256},
        "optimize": {
            "steps": 1500,
            "stages": 1,
            "group_steps": 0,
            "perceptual_weight": 1.0,
            "progressive": "decay",
            "progressive_over": "mean",
            "sh": "off",
            "slider": "time",
            "rates": "gaussian-editor",
            "perceptual_every": 1,
            "sharpness": "paper",
            "as_printed": True,
            "color_solver": False,
            "ema": False,
            "target_ramp": False,
        },
        "field": {"field": "neural", "size": "paper", "field_loss": "pictures", "as_printed": True},
    },
}
"""Values of options that belong together, by part. What the command line says itself goes before them."""


def apply_preset(options: TrainOptions, preset: Preset) -> TrainOptions:
    """The options with a preset's values in the fields that it names; `replace` what should differ."""
    parts = {part: replace(getattr(options, part), **values) for part, values in PRESETS[preset].items()}
    return replace(options, preset=preset, **parts)


def flat_values(part: Any) -> Iterator[tuple[str, bool, Any]]:
    """All values of options in order: name, whether it is typed, value."""
    for field in fields(part):
        value = getattr(part, field.name)
        if is_dataclass(value):
            yield from flat_values(value)
        else:
            yield field.name, not str(field.type).startswith("Fixed"), value


_Options = TypeVar("_Options")


def with_values(options: _Options, **values: object) -> _Options:
    """The options with other values of some fields, each in the part that has it."""
    changes: dict[str, Any] = {}
    for name in (field.name for field in fields(options)):  # type: ignore[arg-type]
        part = getattr(options, name)
        if is_dataclass(part):
            inner = {field.name for field in fields(part)} & values.keys()
            changes[name] = with_values(part, **{key: values[key] for key in inner})
        elif name in values:
            changes[name] = values[name]
    return replace(options, **changes)  # type: ignore[type-var]


def check_ranges(*ranges: tuple[str, float | None, float, float]) -> None:
    """Raises ProgdfError at the first value outside its range.

    Args:
        ranges: the option, its value or None where it has none, the least and the largest that is right
    """
    for option, value, low, high in ranges:
        if value is not None and not low <= value <= high:
            raise ProgdfError(f"{option} must be between {low} and {high}, got {value}")


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class FitOptions:
    """Refit the field of a run to its recorded trajectory; nothing is optimized again."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote."""
    field: FieldOptions = FieldOptions()
    scene: Annotated[Path | None, absent_option("PATH", "where the run found it")] = None
    """Where the scene is now, if it has moved since the run."""
    texts: TextOptions = TextOptions()
    threads: int = 0
    """CPU threads; 0 takes all cores."""


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class EvaluateOptions:
    """Measure a finished run as papers do: one table, one picture, on views that training has not seen."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train or progdf batch wrote."""
    scene: Annotated[Path | None, absent_option("PATH", "where the run found it")] = None
    """Where the scene is now, if it has moved since the run."""
    texts: TextOptions = TextOptions()
    threads: int = 0
    """CPU threads; 0 takes all cores."""


@dataclass(frozen=True)
class ShowRegionOptions:
    """Show what a region selects in a scene, or keep it as a file for --region file:MEMBERS.npy."""

    scene: tyro.conf.Positional[Path]
    """The scene, a 3DGS .ply file."""
    spec: tyro.conf.Positional[str]
    """The region, as progdf train --region has it: box:…, lasso:…, masks:DIR, file:MEMBERS.npy, …"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """picture.png, in which the region is tinted and the rest is pale; or members.npy, its rows (int64)."""
    cameras: Annotated[Path | None, absent_option("PATH", "none")] = None
    """masks: their cameras, where DIR holds none; text: views in which to look for it."""
    cameras_anyway: bool = False
    """Use --cameras although most of them do not show the scene, as those of another frame do not."""
    camera: Annotated[str | None, absent_option("FILE[:INDEX]", "four sides")] = None
    """Look through a camera of this file, the first where no INDEX is given; without it the picture shows
    four sides."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480"
    """Pixels of the picture, or of each side; a camera's own if it is one."""
    up: UpChoice = "auto"
    """The axis of the scene that is up."""
    lift_rule: LiftRule = "share"
    """masks, text: as for progdf train."""
    lift_threshold: Annotated[float | None, absent_option("FLOAT", "the rule's own")] = None
    """masks, text: as for progdf train."""


@dataclass(frozen=True)
class WriteViewsOptions:
    """Write views of a scene and their cameras.json, to draw masks or edits on.

    Draw masks as OUT/NAME.png, white on black, for as many views as you like; then
    progdf train SCENE --cameras OUT/cameras.json --region masks:OUT
    """

    scene: tyro.conf.Positional[Path]
    """The scene, a 3DGS .ply file."""
    out: Path
    """Folder for original/NAME.png and cameras.json."""
    cameras: Annotated[Path | None, absent_option("PATH", "a rig around the scene")] = None
    """cameras.json, transforms.json or the folder of a COLMAP model; without it, a rig around the scene."""
    cameras_anyway: bool = False
    """Use --cameras although most of them do not show the scene, as those of another frame do not."""
    region: Annotated[str | None, absent_option("STR", "the whole scene")] = None
    """The rig looks at this region instead of the whole scene."""
    views: int = 12
    """How many views, at most; of more cameras, those that differ most."""
    image_size: int = 768
    """Longer side of the views in pixels."""
    up: UpChoice = "auto"
    """The axis of the scene that is up."""


@dataclass(frozen=True)
class BatchOptions:
    """Train every edit of a catalogue, side by side; finished runs are kept."""

    catalogue: tyro.conf.Positional[Path]
    """TOML: [defaults], [[scenes]] with a path, [[scenes.edits]] with a name, [sweep]; see docs/cli.md."""
    out: Path
    """Folder of the batch: OUT/SCENE/NAME/ are ordinary runs, OUT/batch.html and batch.csv tell of all."""
    workers: int = 0
    """Jobs at once; 0: as many as the cores allow. Without Ray (pip install progdf-studio[cluster]) one."""
    address: Annotated[str, absent_option("HOST:PORT|auto", "a cluster of this machine's cores")] = ""
    """A Ray cluster that runs, whose machines share OUT and the scenes."""
    resume: bool = False
    """Go on with the batch in OUT: finished runs are kept, stopped ones continued, the others begun."""
    only: Annotated[str, absent_option("PATTERN", "all")] = ""
    """Jobs whose SCENE/NAME or NAME matches, such as "shoes/*" or "blue*"."""
    keep_going: bool = False
    """Start although some jobs cannot be trained; these count as failed."""
    dry_run: bool = False
    """Check, print the jobs and what they will take, and train nothing."""
    json: bool = False
    """Events for programs, one JSON object a line, instead of text."""
