"""The options of `progdf train` and `progdf fit`, as typed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from progdf.field.neural import Size
from progdf.scene.up_axis import UpChoice

Slider = Literal["auto", "even", "stages", "time"]
"""What slider values mean; auto becomes one of the others (`trainer.optimize.settings.resolve_slider`)."""
Rates = Literal["kind", "3dgs"]
Progressive = Literal["warmup", "decay", "growth", "off"]
FieldLoss = Literal["parameters", "pictures"]
Norm = Literal["squares", "absolutes"]
LiftRule = Literal["share", "count", "paper"]
Bands = Literal["auto", "on", "off"]
Preset = Literal["default", "paper"]

DETECTOR, SAM_MODEL = "IDEA-Research/grounding-dino-tiny", "facebook/sam-vit-base"
FieldKind = Literal["auto", "separable", "keyframes", "lossless", "neural"]

NETWORK_OPTIONS: Mapping[str, Any] = {
    "size": "tiny",
    "field_loss": "parameters",
}
"""Options of a neural field, and what they are where nothing is said."""

MOST_STAGES = 8
"""Strengths that an editor with a strength control is asked for if nobody says how many, at most."""

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
    """Folder of the run; created if needed."""
    region: str
    """What may change: all, labels:FILE.npy:ID[,ID], box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, masks:DIR (one a
    camera), photomasks:DIR (of photographs), changed (where pictures: differ), text:"the man's shirt"; join
    by + -."""
    editor: str
    """recolor:#rrggbb, tint:#rrggbb, stripes:#rrggbb, darken:AMOUNT, night, folder:DIR (edited views),
    photographs:EDITED,ORIGINALS (of what the cameras took), pictures:A.png[,B.png] (rendered, then changed in
    any program), style:N (a painting, N from 0 to 25), instruct:"turn him into Batman"."""
    lift_rule: LiftRule = "share"
    """masks, text: a Gaussian's score is the share of its visible weight that lies in the masks, the share of
    its pixels, or the paper's printed sum, which selects nothing at the paper's threshold."""
    lift_threshold: float | None = None
    """masks, text: minimum score of a member; by default .7 for share, .8 for count and paper."""
    detector: str = DETECTOR
    """text: id or folder of the GroundingDINO that finds objects; download it first."""
    sam_model: str = SAM_MODEL
    """text: id or folder of the SAM that outlines them; download it first."""
    box_threshold: float = 0.3
    """text: minimum detection confidence, 0 to 1; a lower one finds more, including false matches."""
    model: str = ""
    """instruct: id or folder of a diffusers pipeline; empty: timbrooks/instruct-pix2pix (the paper's)."""
    guidance: str = ""
    """instruct: how closely the instruction is followed and, after a comma, the picture, where the model
    supports that; by default the model's own values (paper: 7.5,1.5)."""
    edit_steps: int | None = None
    """instruct: denoising steps per picture; by default the model's own number (paper: 20)."""
    edit_size: int | None = None
    """style, instruct: longer side in pixels at which pictures are painted; larger makes finer strokes."""
    reedit_every: int = 0
    """style, instruct: every N steps, edit the current renders again and train towards those; 0: never."""
    preset: Preset = "default"
    """Values of the options below, where the command line gives none: paper is the paper's trainer as it is
    printed. In Python: trainer.presets.apply_preset."""
    name: str = ""
    """Name of the layer and of the .gdf file; the folder's name if empty."""
    cameras: Path | None = None
    """cameras.json, transforms.json or the folder of a COLMAP model; without it, a rig that looks at
    the region."""
    up: UpChoice = "auto"
    """The axis of the scene that is up. auto: from the cameras, else from the ground, else −y."""
    views: int = 0
    """How many views are edited, 3 to 96 (the paper's limit); every fifth is held out to measure with. 0: 30,
    or 40 for an edit of colors whose members are dense."""
    image_size: int = 0
    """Longer side of the views in pixels; 0: 256, or up to 384 for an edit of colors whose members are so
    dense that most have less than a pixel."""
    steps: int = 800
    """Optimizer steps over all stages (paper: 1500-2000 towards the finished edit alone)."""
    kind: Literal["auto", "color", "style", "geometry"] = "auto"
    """What the edit moves; sets learning rates and loss weights. auto: as the editor knows; for folder:,
    photographs: and instruct: all are tried on a few small views, and the log says which was best."""
    group_steps: int | None = None
    """geometry: first the connected parts of the region are moved as rigid wholes, in this many steps per
    strength or twice as many; 0: every Gaussian finds its own way, which bends well but smears what moves
    far. By default 120 or 0, whichever a short trial finds better."""
    stages: int = 0
    """Number of strengths that an editor with a strength control is asked for; 0: 8, or 4 for fewer than 320
    steps, but 1 for a style, which is the paper's way, towards the end alone. instruct is asked for
    strengths, by rising guidance, only if more than 1 are asked for here: each is another pass over the
    views."""
    sh: Bands = "auto"
    """Colors that change with the direction one looks from: trained, and kept where leaving them out would
    cost 0.1 dB (on), left as they are (off), or trained unless the edit is of colors and the region's own
    hardly change with the view (auto)."""
    perceptual_weight: float | None = None
    """Weight of LPIPS beside L1; by default .3 for style and geometry (paper: 1). An edit of colors is solved
    for, all views at once; a weight makes it descend view by view instead."""
    progressive: Progressive = "off"
    """The paper's progressive constraint (eq. 5): as a warm-up of the learning rate, or as a loss that lets
    go of the steps (decay) or tightens (growth, the printed exponent)."""
    progressive_norm: Norm = "squares"
    """How that loss measures a step, of which the paper says nothing: squares spread the change over the run
    and cost 1.6 to 4.6 dB, absolutes freeze the edit."""
    slider: Slider = "auto"
    """Slider values. even: equal steps look equally large, and an editor with a strength control is asked for
    pictures that do; stages: s is the editor's own strength, even in between; time: the optimizer's. auto:
    even, but stages where folder: has pictures of several strengths."""
    field: FieldKind = "auto"
    """Kind of field; auto keeps the smallest separable one that meets --target-psnr; lossless
    keeps every recording."""
    size: Size = NETWORK_OPTIONS["size"]
    """neural: numbers in the network, 17 thousand, .5 million or 6 million (paper, a quarter of an hour)."""
    field_loss: FieldLoss = NETWORK_OPTIONS["field_loss"]
    """neural: what it is trained on: the recorded offsets, or pictures of them (the paper's L1 + LPIPS and
    sharpness; about .3 s a step with the network of 6 million)."""
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
    """CPU threads; 0 takes all cores. More threads than idle cores are slower."""
    text_before: str = ""
    """What the views show before the edit, such as "a bear"; with --text-after, CLIP directional similarity
    is measured (ViT-L/14; pip install progdf-studio[clip])."""
    text_after: str = ""
    """What they show after it, such as "a golden bear"; instruct: its sentence, if nothing is given."""
    resume: bool = False
    """Continue a run that was stopped in this folder; the result is the same as without the stop."""


@dataclass(frozen=True)
class FitOptions:
    """Refit the field of a run to its recorded trajectory; nothing is optimized again."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote."""
    field: FieldKind = "auto"
    """Kind of field; auto keeps the smallest separable one that meets --target-psnr; lossless
    keeps every recording."""
    size: Size = NETWORK_OPTIONS["size"]
    """neural: numbers in the network, 17 thousand, .5 million or 6 million (paper, a quarter of an hour)."""
    field_loss: FieldLoss = NETWORK_OPTIONS["field_loss"]
    """neural: what it is trained on: the recorded offsets, or pictures of them (the paper's L1 + LPIPS and
    sharpness; about .3 s a step with the network of 6 million)."""
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
    threads: int = 0
    """CPU threads; 0 takes all cores."""
