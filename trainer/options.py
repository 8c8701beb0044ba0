"""Options of the trainer's commands, as nested dataclasses that are passed to functions unchanged.

The command line is flat. `Fixed` fields are not on it; a preset or `trainer.resolve` sets them.
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
from progdf.terminal import group_digits

EditKind = Literal["color", "style", "geometry"]
"""Attributes that an edit moves, which determine learning rates and loss weights (docs/method.md 3)."""
Kind = Literal["auto", "color", "style", "geometry"]
Slider = Literal["auto", "even", "stages", "time"]
"""Meaning of slider values; auto becomes one of the others (`resolve_slider`)."""
Solver = Literal["descent", "colors"]
FieldLoss = Literal["parameters", "pictures"]
LiftRule = Literal["share", "paper"]
Bands = Literal["auto", "on", "off"]
Preset = Literal["default", "paper"]
Quantize = Literal["off", "nf4"]
Fill = Literal["none", "picture", "smooth", "surface"]
Removal = Literal["auto", "never", "always"]
CarryOn = Literal["auto", "never", "always"]
StrengthsBy = Literal["editor", "blend"]
Device = Literal["auto", "cpu"]
Engine = Literal["auto", "cpu", "warp"]
Quality = Literal["small", "balanced", "best"]
"""Bytes against quality (trainer/quality.py)."""
ReportLevel = Literal["none", "short", "full"]
"""Extent of the report that follows the edit's file, ascending (docs/method.md 7)."""

DETECTOR = "IDEA-Research/grounding-dino-tiny"
SAM_MODEL = "facebook/sam-vit-base"
FieldKind = Literal["auto", "separable", "lossless", "neural"]

MAX_STAGES = 8
"""Maximum number of strengths requested by default from an editor with a strength control."""

MAX_THREADS = 1024
"""Maximum of --threads, more than any machine has."""
LARGEST_SEED = 2**32 - 1
"""Largest seed that every random number generator accepts."""
LARGEST_VIEW_PX = 2048
"""Largest longer side of the views, pixels."""
VIEWS = 30
"""Default number of edited views."""
REMOVAL_VIEWS = 24
"""Default number of views of a removal, in which holes are found and measured."""
COLOR_VIEWS = (40, 48)
"""Default number of views of a color edit: up to SH degree 1, and above (docs/lab/experiments.md, Views)."""


@dataclass(frozen=True)
class RegionOptions:
    """Region that may change, and how masks select it."""

    region: str
    """Gaussians that may change, as parts joined by + - &, such as text:"the man's shirt" (docs/cli.md)."""
    lift_rule: LiftRule = "share"
    """masks, text: score by the share of visible weight in the masks (share), or of pixels (paper)."""
    lift_threshold: Annotated[float | None, absent_option("FLOAT", "the rule's own")] = None
    """masks, text: minimum score of a member, 0 to 1; by default 0.7 for share, 0.8 for paper."""
    detector: str = DETECTOR
    """text: id or folder of the GroundingDINO model that finds objects; download it first."""
    sam_model: str = SAM_MODEL
    """text: id or folder of the SAM model that segments the found objects; download it first."""
    box_threshold: float = 0.3
    """text: minimum detection confidence, 0 to 1; lower finds more, including false matches."""


@dataclass(frozen=True)
class EditorOptions:
    """Editor of the views. Options left out use the defaults of the editor's model."""

    editor: str
    """Editor of the views, such as recolor:#3060d0, style:14 or instruct:"a golden bear" (docs/cli.md)."""
    model: Annotated[str, absent_option("STR", "a model on this machine that fits")] = ""
    """instruct: id or folder of a diffusers pipeline; api: name of the server's model (docs/cli.md)."""
    guidance: Annotated[str, absent_option("NUMBER[,NUMBER]", "the model's own")] = ""
    """instruct: guidance of the text and, after a comma, of the image if supported (paper: 7.5,1.5)."""
    edit_steps: Annotated[int | None, absent_option("INT", "the model's own")] = None
    """instruct: denoising steps per picture, 1 to 1000 (paper: 20)."""
    edit_size: Annotated[int | None, absent_option("INT", "the model's own")] = None
    """style: longer side of the paintings; others: side of the painted square; 32 to 4096 pixels."""
    anchor: Annotated[Path | None, absent_option("PNG", "the model paints one")] = None
    """Picture of one view (Ctrl+F2), edited by you, used as the reference of all views (docs/cli.md)."""
    quantize: Quantize = "off"
    """instruct: nf4 loads large parts in 4 bits, with a quarter of the memory and a small loss."""
    device: Device = "auto"
    """instruct: auto is the GPU, or the CPU for small models; cpu is the CPU for any model."""
    fill: Annotated[Fill | None, absent_option("{none,picture,smooth,surface}", "by the editor")] = None
    """remove, pictures: fill holes from the picture, the surface around them (smooth: no texture), or not."""
    removal: Removal = "auto"
    """pictures: remove the region instead of recoloring it (always, never, or as the picture suggests)."""
    carry_on: CarryOn = "auto"
    """pictures: apply the color map to parts that no picture shows (always, never, auto: if it fits)."""
    prompt: Annotated[str, absent_option("TEXT", "none")] = ""
    """command: text for its {prompt}; comfy: text of the node titled prompt."""
    strengths_by: StrengthsBy = "editor"
    """command: a program without a strength makes the finished edit; blend cross-fades to it."""
    edit_workers: int = 1
    """command, api, comfy: simultaneous calls, 1 to 64."""
    edit_timeout: float = 300.0
    """command, api, comfy: seconds after which a call is ended and made again, 1 to 86400."""
    api_url: Annotated[str, absent_option("URL", "none")] = ""
    """api: address of OpenAI's images API, with its key in OPENAI_API_KEY; comfy: address of ComfyUI."""
    api_references: int = 2
    """api: reference pictures that the model accepts beside the view, 0 to 2."""
    api_mask: bool = False
    """api: send the region as the mask of the call, if the model takes one."""
    degrees: Annotated[str, absent_option("TEXT|TEXT", "none")] = ""
    """api, comfy: prompts for weaker edits, separated by |; the pictures give their strengths."""
    price_per_call: float = 0.0
    """api, comfy: price of one call, in any currency, from which the cost of the run is estimated."""
    yes: bool = False
    """api, comfy: send pictures to another machine without asking."""
    seed: Fixed[int] = 0  # seed of the noise, the same in every view
    cache: Fixed[Path | None] = None  # folder for painted pictures; None saves none
    at: Annotated[str, absent_option("X,Y,SIZE[,ANGLE]", "none")] = ""
    """decal: center and longer side, in pixels or shares of --camera's picture; rotation in degrees."""
    camera: Annotated[Path | None, absent_option("PNG|JSON", "none")] = None
    """decal: camera that projects it, as a picture written by progdf render or a file of one camera."""

    @property
    def family(self) -> str:
        """Kind of editor, the part before the colon."""
        return self.editor.partition(":")[0]

    @property
    def text(self) -> str:
        """Text of the editor, the part after the colon."""
        return self.editor.partition(":")[2]


@dataclass(frozen=True)
class TrainingViewOptions:
    """Views to edit."""

    cameras: Annotated[Path | None, absent_option("PATH", "a rig that looks at the region")] = None
    """cameras.json, transforms.json or COLMAP folder; without it, a rig that looks at the region."""
    cameras_anyway: bool = False
    """Use --cameras even if most of them do not show the scene."""
    up: UpChoice = "auto"
    """Up axis of the scene; auto uses the cameras, else the ground, else −y."""
    views: int = 0
    """Number of edited views, 3 to 96, a fifth of them held out (0: 30; color edits 40 or 48)."""
    image_size: int = 0
    """Longer side of the views in pixels, 32 to 2048 (0: by the region's detail; instruct 512)."""
    dense: Fixed[bool] = True  # more views for color edits, unless each is painted separately
    fills: Fixed[bool] = True  # the region fills the views of a rig; False leaves room for moving parts
    pictures: Fixed[tuple[Path, ...]] = ()  # changed pictures, whose cameras are the views, all to train on
    scene: Fixed[Path | None] = None  # scene file, beside which cameras may define the up axis


@dataclass(frozen=True)
class OptimizeOptions:
    """Optimization of the members."""

    steps: int = 800
    """Optimizer steps over all stages; a color edit takes at most an eighth of them per strength."""
    kind: Kind = "auto"
    """Attributes that move; auto is the editor's kind, or the best of a trial run on small views."""
    group_steps: Annotated[int | None, absent_option("INT", "chosen by a trial")] = None
    """geometry: steps per strength that move connected parts as rigid wholes, 0 to 10000 (0: none)."""
    stages: int = 0
    """Number of strengths to request from the editor, 0 to 16 (0: chosen per edit, see docs/cli.md)."""
    sh: Bands = "auto"
    """View-dependent color (SH bands 1 to 3): train, and keep if worth 0.1 dB (on, auto), or skip (off)."""
    perceptual_weight: Annotated[float | None, absent_option("FLOAT", "by the kind of edit")] = None
    """Weight of LPIPS beside L1, 0 or more; by default 0.3 for style and geometry (paper: 1)."""
    slider: Slider = "auto"
    """Slider values: equal visible steps (even), editor strengths (stages), or optimizer time (time)."""
    grow: float = 0.0
    """Gaussians that may be added for new parts, such as a hat, as a share of the region's, 0 to 1."""
    engine: Engine = "auto"
    """Rasterizer for training: cpu, warp (CUDA, extra gpu), or auto."""
    colors_on_gpu: Fixed[bool] = False  # solve color edits there too: warp was named, see `resolve`
    color_solver: Fixed[bool] = True  # solve color edits over all views at once, if possible
    seed: Fixed[int] = 0  # order of the views
    solver: Fixed[Solver] = "descent"  # set once the kind is known, see `resolve_kind`


@dataclass(frozen=True)
class FieldOptions:
    """Field to fit to the recording."""

    field: FieldKind = "auto"
    """Kind of field; auto is the smallest grade or separable field that adds at most a tenth of the error."""
    size: Size = "tiny"
    """neural: parameters of the network, 17 thousand, 0.5 million or 6 million (paper, 15 minutes)."""
    field_loss: FieldLoss = "parameters"
    """neural: train on the recorded offsets, or on renders with the losses of the paper."""
    quality: Quality = "balanced"
    """Bytes against quality: small, balanced, or best (docs/benchmarks.md)."""
    target_psnr: Annotated[float | None, absent_option("FLOAT", "a tenth of the edit's own error")] = None
    """Minimum PSNR of the field to the trajectory, dB, instead of auto's rule; lower gives smaller files."""
    draft: Fixed[bool] = False  # train a network for a third of its steps
    seed: Fixed[int] = 0  # seed of the network's weights and samples


@dataclass(frozen=True)
class TextOptions:
    """Texts for CLIP; fit and evaluate use the run's own by default."""

    text_before: Annotated[str, absent_option("STR", "none; the run's own for fit and evaluate")] = ""
    """Text of the views before the edit, such as "a bear", for CLIP directional similarity (ViT-L/14)."""
    text_after: Annotated[str, absent_option("STR", "none; the run's own for fit and evaluate")] = ""
    """Text of the views after the edit, such as "a golden bear": a description, never an instruction."""
    asked: Fixed[bool] = False  # a text was given; an instruction alone does not request the measure


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class TrainOptions:
    """Edit a region of a scene and write its .gdf file.

    Where a default differs from ProGDF (AAAI 2025), it measured better.
    """

    scene: tyro.conf.Positional[Path]
    """Scene: .ply (also compressed), .spz, .splat, .ksplat, .sog, .glb or .gltf."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; created if needed."""
    region: RegionOptions
    editor: EditorOptions
    preset: Preset = "default"
    """Training method and option defaults; paper is the paper's trainer, in the readings that work."""
    name: Annotated[str, absent_option("STR", "the folder's name")] = ""
    """Name of the layer and of the .gdf file."""
    views: TrainingViewOptions = TrainingViewOptions()
    optimize: OptimizeOptions = OptimizeOptions()
    field: FieldOptions = FieldOptions()
    texts: TextOptions = TextOptions()
    quick: bool = False
    """Draft in a third of the time: 240 steps and 12 views; 4 stages if the color solver is not used."""
    seed: int = 0
    """Random seed, 0 to 2³² − 1; the same seed gives the same files."""
    threads: int = 0
    """CPU threads (0: all cores); more threads than idle cores are slower."""
    report: ReportLevel = "full"
    """Report after the .gdf is written: full, short (no LPIPS, CLIP or picture), or none."""
    resume: bool = False
    """Continue a stopped run in this folder, with the same result as without the stop."""

    @property
    def edit(self) -> dict[str, str]:
        """Identity of the edit; a run folder holds runs of a single edit."""
        return {
            "scene": str(self.scene.resolve()),
            "region": self.region.region,
            "editor": self.editor.editor,
        }


PRESETS: Mapping[Preset, Mapping[str, Mapping[str, Any]]] = {
    "default": {},
    # the trainer of ProGDF (AAAI 2025), with the readings of its open points that work (docs/paper.md)
    "paper": {
        "region": {"lift_rule": "paper"},
        "views": {"views": 96, "image_size": 256},
        "optimize": {
            "steps": 1500,
            "stages": 1,
            "group_steps": 0,
            "perceptual_weight": 1.0,
            "sh": "off",
            "slider": "time",
            "color_solver": False,
        },
        "field": {"field": "neural", "size": "paper", "field_loss": "pictures"},
    },
}
"""Values of options that belong to a method, by part. Options on the command line override them."""


def apply_preset(options: TrainOptions, preset: Preset) -> TrainOptions:
    """Return the options with a preset and its values in the fields; use `replace` for deviations."""
    parts = {part: replace(getattr(options, part), **values) for part, values in PRESETS[preset].items()}
    return replace(options, preset=preset, **parts)


def flat_values(part: Any) -> Iterator[tuple[str, bool, Any]]:
    """Yield all values of options in order: name, True if it is on the command line, value."""
    for field in fields(part):
        value = getattr(part, field.name)
        if is_dataclass(value):
            yield from flat_values(value)
        else:
            yield field.name, not str(field.type).startswith("Fixed"), value


_Options = TypeVar("_Options")


def with_values(options: _Options, **values: object) -> _Options:
    """Return the options with other values of some fields, each in its part."""
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
    """Raise a ProgdfError at the first value outside its range.

    Args:
        ranges: the option, its value or None if it has none, the minimum and the maximum
    """
    for option, value, low, high in ranges:
        if value is not None and not low <= value <= high:
            limits = f"{_spell_number(low)} and {_spell_number(high)}"
            raise ProgdfError(f"{option} must be between {limits}, got {value}")


def _spell_number(number: float) -> str:
    """Return a number for a message: whole numbers without a fraction, large ones in groups of digits."""
    if number != int(number):
        return str(number)
    return group_digits(int(number)) if abs(number) >= 10_000 else str(int(number))


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class FitOptions:
    """Refit the field of a run to its recorded trajectory; nothing is optimized again."""

    run: tyro.conf.Positional[Path]
    """Folder of a run of progdf train."""
    field: FieldOptions = FieldOptions()
    scene: Annotated[Path | None, absent_option("PATH", "where the run found it")] = None
    """Current path of the scene, if it has moved since the run."""
    texts: TextOptions = TextOptions()
    report: ReportLevel = "full"
    """Report after the .gdf is written: full, short (no LPIPS, CLIP or picture), or none."""
    threads: int = 0
    """CPU threads (0: all cores)."""


@dataclass(frozen=True)
@tyro.conf.configure(tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed)
class EvaluateOptions:
    """Measure a finished run as papers do, or compare methods on edits with known pictures."""

    run: tyro.conf.Positional[Path]
    """Folder of a run of progdf train or progdf batch; with --suite a folder for its files."""
    suite: Annotated[Literal["sliders", "sliders-1"] | None, absent_option("sliders", "measure a run")] = None
    """Compare methods on ten edits with known pictures: the current suite, or its version 1."""
    methods: Annotated[tuple[str, ...], absent_option("NAME", "all; version 1 without paper")] = ()
    """--suite: field, keyframes, matrix, paper, or your own function as package.module:function."""
    seed: int = 0
    """--suite: random seed of the trainings, 0 to 2³² − 1."""
    scene: Annotated[Path | None, absent_option("PATH", "where the run found it")] = None
    """Current path of the scene, if it has moved since the run."""
    texts: TextOptions = TextOptions()
    threads: int = 0
    """CPU threads (0: all cores)."""


@dataclass(frozen=True)
class ShowRegionOptions:
    """Show the region of a scene, or save it as a file for --region file:MEMBERS.npy."""

    scene: tyro.conf.Positional[Path]
    """Scene: .ply (also compressed), .spz, .splat, .ksplat, .sog, .glb or .gltf."""
    spec: tyro.conf.Positional[str]
    """Region, as for progdf train --region: box:…, lasso:…, masks:DIR, file:MEMBERS.npy, …"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """picture.png with the region tinted and the remainder pale; or members.npy with its rows (int64)."""
    cameras: Annotated[Path | None, absent_option("PATH", "none")] = None
    """masks: cameras of the masks, if DIR has none; text: cameras of the searched views."""
    cameras_anyway: bool = False
    """Use --cameras even if most of them do not show the scene."""
    camera: Annotated[str | None, absent_option("FILE[:INDEX]", "four sides")] = None
    """Camera of the picture, from a file (INDEX 0 by default); without it, four sides."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480"
    """Size of each picture in pixels. With --camera, that camera's size is used."""
    up: UpChoice = "auto"
    """Up axis of the scene."""
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
    """Scene: .ply (also compressed), .spz, .splat, .ksplat, .sog, .glb or .gltf."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for original/NAME.png and cameras.json."""
    cameras: Annotated[Path | None, absent_option("PATH", "a rig around the scene")] = None
    """cameras.json, transforms.json or COLMAP folder; without it, a rig around the scene."""
    cameras_anyway: bool = False
    """Use --cameras even if most of them do not show the scene."""
    region: Annotated[str | None, absent_option("STR", "the whole scene")] = None
    """Region that the rig looks at, instead of the whole scene."""
    views: int = 12
    """Maximum number of views, 1 to 96; of more cameras, the most different ones."""
    image_size: int = 768
    """Longer side of the views in pixels, 32 to 4096."""
    up: UpChoice = "auto"
    """Up axis of the scene."""


@dataclass(frozen=True)
class BatchOptions:
    """Train every edit of a catalogue in parallel; finished runs are reused."""

    catalogue: tyro.conf.Positional[Path]
    """TOML: [defaults], [[scenes]] with a path, [[scenes.edits]] with a name, [sweep]; see docs/cli.md."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the batch: runs in OUT/SCENE/NAME/, summary in OUT/batch.html and batch.csv."""
    workers: int = 0
    """Parallel jobs (0: as many as the cores allow); more than 1 needs Ray, progdf-studio[cluster]."""
    address: Annotated[str, absent_option("HOST:PORT|auto", "a cluster of this machine's cores")] = ""
    """Running Ray cluster, whose machines share OUT and the scenes."""
    resume: bool = False
    """Continue the batch in OUT: reuse finished runs, resume stopped ones, start the others."""
    only: Annotated[str, absent_option("PATTERN", "all")] = ""
    """Jobs whose SCENE/NAME or NAME matches, such as "shoes/*" or "blue*"."""
    allow_commands: bool = False
    """Let the catalogue run programs and send pictures (command:, api:, comfy:); read it first."""
    keep_going: bool = False
    """Start even if some jobs cannot be trained; these count as failed."""
    dry_run: bool = False
    """Check, print the jobs and their expected work, and train nothing."""
    json: bool = False
    """Print events for programs, one JSON object per line, instead of text."""
