"""The options of `progdf train` and `progdf fit`, as typed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from progdf.errors import ProgdfError
from progdf.field.neural import Bins, Inputs, Size
from progdf.field.ranks import NO_DIFFERENCE
from progdf.metrics.lpips import Net
from progdf.scene.up_axis import UpChoice

Slider = Literal["auto", "even", "stages", "time"]
"""What slider values mean; auto becomes one of the others (`settings.resolve_slider`)."""


Rates = Literal["kind", "3dgs"]


Progressive = Literal["warmup", "decay", "growth", "off"]


Preset = Literal["default", "paper"]

CLIP_MODEL = "openai/clip-vit-large-patch14"
DETECTOR, SAM_MODEL = "IDEA-Research/grounding-dino-tiny", "facebook/sam-vit-base"
FieldKind = Literal["auto", "separable", "keyframes", "lossless", "neural"]

NETWORK_OPTIONS: Mapping[str, Any] = {
    "fit": "after",
    "size": "tiny",
    "inputs": "own",
    "bins": "smooth",
    "code": 8,
    "picture_loss": 0.0,
}
"""Options of a neural field, and what they are where nothing is said."""

MOST_STAGES = 8
"""Strengths that an editor with a dial is asked for if nobody says how many, at most."""

MOST_THREADS = 1024
"""More than any machine has: what --threads says at most."""
MOST_STEPS = 1_000_000
"""Hours on any machine: what --steps says at most."""
LONGEST_NAME = 255
"""Bytes that every file system takes."""
LARGEST_SEED = 2**32 - 1
"""What every generator of random numbers takes."""
STAGE_STEPS = 40
"""A stage needs so many: with fewer each view is seen once or twice, and the next target is there before this
one is met. `QUICK_STAGES` are asked for then (docs/experiments.md, Stages)."""
VIEWS, MOST_VIEWS = 30, 40
"""How many views are edited by default, and how many of a dense region (see `trainer.setup.resolution`)."""
SMALLEST_VIEW = 32
"""Pixels of a view's longer side, at least."""
QUICK_STEPS, QUICK_STAGES, QUICK_VIEWS = 240, 4, 12


@dataclass(frozen=True)
class TrainOptions:
    """Edit a region of a scene and write its .gdf file.

    Where a default differs from ProGDF (AAAI 2025), it measured better.
    """

    scene: tyro.conf.Positional[Path]
    """The scene: a .ply (also compressed), .spz, .splat, .ksplat or .sog."""
    out: Path
    """Folder of the run; made if need be."""
    region: str
    """What may change: all, labels:FILE.npy:ID[,ID], box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, masks:DIR (one a
    camera), photomasks:DIR (of photographs), text:"the man's shirt"; join by + -."""
    editor: str
    """recolor:#rrggbb, tint:#rrggbb, stripes:#rrggbb, darken:AMOUNT, night, folder:DIR (edited views),
    photographs:EDITED,ORIGINALS (of what the cameras took), style:N (a painting, N from 0 to 25),
    instruct:"turn him into Batman"."""
    lift_rule: Literal["share", "count", "paper"] = "share"
    """masks, text: a Gaussian's score is the share of its visible weight that lies in the masks, the share of
    its pixels, or the paper's printed sum, which selects nothing at the paper's threshold."""
    lift_threshold: float | None = None
    """masks, text: least score of a member; by default .7 for share, .8 for count and paper."""
    detector: str = DETECTOR
    """text: id or folder of the GroundingDINO that finds things, downloaded before."""
    sam_model: str = SAM_MODEL
    """text: id or folder of the SAM that outlines them, downloaded before."""
    box_threshold: float = 0.3
    """text: confidence that a find needs, 0 to 1; lower finds more, also what is not meant."""
    model: str = ""
    """instruct: id or folder of a diffusers pipeline; empty: timbrooks/instruct-pix2pix (the paper's)."""
    guidance: float | None = None
    """instruct: how closely the sentence is followed; by default as the model was made for (paper: 7.5)."""
    image_guidance: float | None = None
    """instruct: how closely the picture is followed, where the model knows it (paper: 1.5)."""
    edit_steps: int | None = None
    """instruct: denoising steps per picture; by default as the model was made for (paper: 20)."""
    edit_seed: int = 0
    """instruct: seed of the noise, which is the same in every view."""
    edit_size: int | None = None
    """style, instruct: longer side in pixels at which pictures are painted; larger makes finer strokes."""
    confine: Literal["auto", "yes", "no"] = "auto"
    """Put back what the editor changed outside the region; auto: unless --kind is geometry."""
    reedit_every: int = 0
    """style, instruct: every so many steps, edit the current renders again and go on towards those."""
    preset: Preset = "default"
    """Values of the options below, where the command line gives none: paper is the paper's trainer as it is
    printed. In Python: trainer.presets.under_preset."""
    name: str = ""
    """Name of the layer and of the .gdf file; the folder's name if empty."""
    cameras: Path | None = None
    """cameras.json, transforms.json or the folder of a COLMAP model; without it, a rig that looks at
    the region."""
    up: UpChoice = "auto"
    """The axis of the scene that is up. auto: as the cameras are held, or as a ground lies, or −y."""
    views: int = 0
    """How many views are edited, 3 to 96 (the paper's limit); every fifth is held out to measure with. 0: 30,
    or 40 for an edit of colors whose members are dense."""
    image_size: int = 0
    """Longer side of the views in pixels; 0: 256, or up to 384 for an edit of colors whose members are so
    dense that most have less than a pixel."""
    steps: int = 800
    """Optimiser steps over all stages (paper: 1500-2000 towards the finished edit alone)."""
    kind: Literal["auto", "colour", "style", "geometry"] = "auto"
    """What the edit moves; sets learning rates and loss weights. auto: as the editor knows; for folder:,
    photographs: and instruct: all are tried on a few small views, and the log says which was best."""
    group_steps: int | None = None
    """geometry: first the connected parts of the region are moved as wholes, in so many steps per strength
    or twice as many; 0: every Gaussian finds its own way, which bends well but smears what moves far. By
    default 120 or 0, whichever a short trial finds better."""
    follow: bool = True
    """colour: members that no training view shows take on what their neighbours along the surface do, so that
    they keep no old colour for whoever looks from elsewhere."""
    stages: int = 0
    """Strengths that an editor with a dial is asked for; 0: 8, or 4 for fewer than 320 steps, but 1 for a
    style, which is the paper's way, towards the end alone. instruct is asked for strengths, by rising
    guidance, only if more than 1 are asked for here: each is another pass over the views."""
    sh: Literal["auto", "on", "off"] = "auto"
    """Colours that change with the direction one looks from: trained, and kept where leaving them out would
    cost 0.1 dB (on), left as they are (off), or trained unless the edit is of colours and the region's own
    hardly change with the view (auto)."""
    rates: Rates = "kind"
    """Learning rates: as the kind of edit needs, with short steps on the last stretch; or 3DGS's own, flat,
    for all attributes (paper), which hardly move in 600 steps."""
    perceptual: Net = "alex"
    """style, geometry: LPIPS through AlexNet, or VGG16, with which a run takes more than twice as long and is
    no better."""
    perceptual_weight: float | None = None
    """Weight of LPIPS beside L1; by default .3 for style and geometry (paper: 1). An edit of colors is solved
    for, all views at once; a weight makes it descend view by view instead."""
    perceptual_every: int = 2
    """style, geometry: LPIPS is paid for every so many steps (paper: 1)."""
    progressive: Progressive = "off"
    """The paper's progressive constraint (eq. 5): as a warm-up of the learning rate, or as the loss that it
    is, which lets go of the steps (decay) or tightens (growth). As a loss it freezes the edit."""
    progressive_weight: float = 5.0
    """Weight of the progressive constraint as a loss (paper: 5)."""
    sharpness: Literal["auto", "hinge", "paper", "off"] = "auto"
    """Sharpness of the renders: not less than the target's (hinge), or the printed term, which pulls at no
    pixel but the rim's (paper). auto: hinge for style, off for colour and geometry."""
    sharpness_weight: float | None = None
    """Weight of the sharpness; by default .1 for hinge, 1 for paper."""
    recording: Literal["smooth", "raw"] = "smooth"
    """Record a running mean of the parameters whenever the pictures have moved, and drop jitter; or the bare
    iterates at even steps (paper), between which the slider's steps differ far more."""
    slider: Slider = "auto"
    """Slider values. even: equal steps look equally large, and an editor with a dial is asked for pictures
    that do; stages: s is the editor's own strength, even in between; time: the optimiser's. auto: even, but
    stages where folder: has pictures of several strengths."""
    field: FieldKind = "auto"
    """Kind of field; auto keeps the smallest separable or keyframe one that meets --target-psnr; lossless
    keeps every recording."""
    fit: Literal["after", "joint"] = NETWORK_OPTIONS["fit"]
    """neural: trained on the finished recording, or step by step while it is made (paper); what it sees is
    then --inputs position."""
    size: Size = NETWORK_OPTIONS["size"]
    """neural: numbers in the network, 17 thousand, .5 million or 6 million (paper, a quarter of an hour)."""
    inputs: Inputs = NETWORK_OPTIONS["inputs"]
    """neural: what the network sees, the position alone (paper), or also what the Gaussian looks like and
    where it ends: 38 dB instead of 34 at no cost."""
    bins: Bins = NETWORK_OPTIONS["bins"]
    """neural: the slider's ten bins, interpolated, or hard (paper), between which the edit jumps."""
    code: int = NETWORK_OPTIONS["code"]
    """neural: a byte each for so many learned numbers per Gaussian, which tell what its place does not."""
    picture_loss: float = NETWORK_OPTIONS["picture_loss"]
    """neural: weight of L1 + LPIPS between pictures of field and recording (paper: 1), in the last steps."""
    target_psnr: float = 40.0
    """The field's worst PSNR against the recorded trajectory over the slider, on held-out views, dB."""
    bytes_budget: float | None = None
    """Bytes per Gaussian of the region that the field may take; the best one within is kept, whatever its
    PSNR. Not for neural."""
    quick: bool = False
    """A draft in a third of the time: 240 steps in 4 stages, 12 views."""
    seed: int = 0
    """Order of the views; the same seed gives the same files."""
    threads: int = 0
    """CPU threads; 0 takes all cores. More than there are idle cores is slower."""
    text_before: str = ""
    """What the views show before the edit, as "a bear"; with --text-after, CLIP directional similarity is
    measured (ViT-L/14; pip install progdf-studio[clip])."""
    text_after: str = ""
    """What they show after it, as "a golden bear"; instruct: its sentence, if nothing is given."""
    clip_model: str = CLIP_MODEL
    """Id or folder of the CLIP model, downloaded before."""
    resume: bool = False
    """Go on with a run that was stopped in this folder; its result is that of a run that was not."""
    save_every: float = 10.0
    """Seconds between saves of the run's state, more where saving takes long; 0: after every step."""


@dataclass(frozen=True)
class FitOptions:
    """Refit the field of a run to its recorded trajectory; nothing is optimised again."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote."""
    field: FieldKind = "auto"
    """Kind of field; auto keeps the smallest separable or keyframe one that meets --target-psnr; lossless
    keeps every recording."""
    size: Size = NETWORK_OPTIONS["size"]
    """neural: numbers in the network, 17 thousand, .5 million or 6 million (paper, a quarter of an hour)."""
    inputs: Inputs = NETWORK_OPTIONS["inputs"]
    """neural: what the network sees, the position alone (paper), or also what the Gaussian looks like and
    where it ends: 38 dB instead of 34 at no cost."""
    bins: Bins = NETWORK_OPTIONS["bins"]
    """neural: the slider's ten bins, interpolated, or hard (paper), between which the edit jumps."""
    code: int = NETWORK_OPTIONS["code"]
    """neural: a byte each for so many learned numbers per Gaussian, which tell what its place does not."""
    picture_loss: float = NETWORK_OPTIONS["picture_loss"]
    """neural: weight of L1 + LPIPS between pictures of field and recording (paper: 1), in the last steps."""
    target_psnr: float = 40.0
    """The field's worst PSNR against the recorded trajectory over the slider, on held-out views, dB."""
    bytes_budget: float | None = None
    """Bytes per Gaussian of the region that the field may take; the best one within is kept, whatever its
    PSNR. Not for neural."""
    scene: Path | None = None
    """Where the scene is now, if it has moved since the run."""
    text_before: str = ""
    """As for progdf train; the run's own, if nothing is given."""
    text_after: str = ""
    """As for progdf train; the run's own, if nothing is given."""
    clip_model: str = ""
    """As for progdf train; the run's own, if nothing is given."""
    threads: int = 0
    """CPU threads; 0 takes all cores."""


def resolve_options(options: TrainOptions) -> TrainOptions:
    """The options with `quick` and the name worked in, and checked.

    Raises:
        ProgdfError: a number that makes no sense.
    """
    if options.quick:
        options = replace(
            options,
            steps=min(options.steps, QUICK_STEPS),
            stages=min(options.stages, QUICK_STAGES),
            views=min(options.views or QUICK_VIEWS, QUICK_VIEWS),
        )
    name = checked_name(options.name or options.out.resolve().name)
    check_ranges(
        ("--views", options.views or VIEWS, 3, 96),
        ("--image-size", options.image_size or SMALLEST_VIEW, SMALLEST_VIEW, 2048),
        ("--stages", options.stages, 0, 16),
        ("--group-steps", options.group_steps, 0, 10_000),
        ("--seed", options.seed, 0, LARGEST_SEED),
        ("--edit-seed", options.edit_seed, 0, LARGEST_SEED),
        ("--threads", options.threads, 0, MOST_THREADS),
        ("--perceptual-every", options.perceptual_every, 1, 1000),
        ("--guidance", options.guidance, 1, 100),
        ("--image-guidance", options.image_guidance, 1, 100),
        ("--edit-steps", options.edit_steps, 1, 1000),
        ("--edit-size", options.edit_size, 32, 4096),
        ("--lift-threshold", options.lift_threshold, 0, 1),
        ("--box-threshold", options.box_threshold, 0, 1),
        ("--reedit-every", options.reedit_every, 0, 100_000),
    )
    stages = options.stages or MOST_STAGES
    if not 4 * stages <= options.steps <= MOST_STEPS:
        raise ProgdfError(
            f"--steps must be between {4 * stages} and {MOST_STEPS} for {stages} stages, got {options.steps}"
        )
    for what, weight in (
        ("--perceptual-weight", options.perceptual_weight),
        ("--progressive-weight", options.progressive_weight),
        ("--sharpness-weight", options.sharpness_weight),
    ):
        if weight is not None and not 0 <= weight < math.inf:
            raise ProgdfError(f"{what} must be 0 or more, got {weight}")
    if not 0 <= options.save_every < math.inf:
        raise ProgdfError(f"--save-every must be 0 or more seconds, got {options.save_every}")
    _check_editor_options(options)
    check_network_options(options)
    return replace(options, name=name)


def checked_name(name: str) -> str:
    """The name of a layer and its file, if it can be one.

    Raises:
        ProgdfError: it cannot.
    """
    if not name or name.startswith(".") or not name.isprintable() or {"/", "\\"} & set(name):
        raise ProgdfError(
            f"'{name}' is not a valid layer name; choose one with --name, for example --name shirt"
        )
    if len(f"{name}.gdf".encode()) > LONGEST_NAME:
        raise ProgdfError(f"the name '{name[:20]}…' is too long for a file; choose another one with --name")
    return name


def check_ranges(*ranges: tuple[str, float | None, float, float]) -> None:
    """Raises ProgdfError at the first value outside its range.

    Args:
        ranges: the option, its value or None where it has none, the least and the largest that is right
    """
    for what, value, low, high in ranges:
        if value is not None and not low <= value <= high:
            raise ProgdfError(f"{what} must be between {low} and {high}, got {value}")


def _check_editor_options(options: TrainOptions) -> None:
    """No option is passed over in silence: one that the editor does not know is refused."""
    kind = options.editor.partition(":")[0]
    of_instruct = ("model", "guidance", "image_guidance", "edit_steps", "edit_seed")
    of_painters = ("edit_size", "reedit_every")
    for names, kinds in ((of_instruct, ("instruct",)), (of_painters, ("style", "instruct"))):
        for name in names:
            said = getattr(options, name) != getattr(TrainOptions, name)
            if said and kind not in kinds:
                option = "--" + name.replace("_", "-")
                raise ProgdfError(f"{option} does not apply to {kind}; it is for {' and '.join(kinds)}")


def check_network_options(options: TrainOptions | FitOptions) -> None:
    """Options of the field that make sense, and those of a network only where there is one.

    Raises:
        ProgdfError: one does not.
    """
    if not 0 < options.target_psnr <= NO_DIFFERENCE:
        raise ProgdfError(
            f"--target-psnr must be above 0 and at most {NO_DIFFERENCE:g} dB, which stands for no "
            f"difference, got {options.target_psnr:g}"
        )
    for name, default in NETWORK_OPTIONS.items():
        option = "--" + name.replace("_", "-")
        if options.field != "neural" and getattr(options, name, default) != default:
            raise ProgdfError(f"{option} does not apply to --field {options.field}; add --field neural")
    if options.bytes_budget is not None:
        if options.field in ("neural", "lossless"):
            raise ProgdfError(f"--bytes-budget does not apply to --field {options.field}; leave one out")
        if not 1 <= options.bytes_budget < math.inf:
            raise ProgdfError(f"--bytes-budget must be at least 1 byte, got {options.bytes_budget:g}")
    if not 0 <= options.code <= 64:
        raise ProgdfError(f"--code must be between 0 and 64, got {options.code}")
    if not 0 <= options.picture_loss < math.inf:
        raise ProgdfError(f"--picture-loss must be 0 or more, got {options.picture_loss}")


def plain_options(options: TrainOptions) -> dict[str, Any]:
    """The options that the result depends on or came from, as JSON values."""
    return {
        name: str(v) if isinstance(v, Path) else v
        for name, v in asdict(options).items()
        if name not in ("resume", "save_every")
    }
