"""What a run will do with its field and its report: the options that these need, resolved once."""

from __future__ import annotations

from dataclasses import dataclass

from progdf.field.neural import Bins, Inputs, Size

from .options import CLIP_MODEL, FieldKind, Slider, TrainOptions
from .presets import CONSTANTS


@dataclass(frozen=True)
class NetworkPlan:
    """The network of a neural field.

    Args:
        joint: trained jointly with the optimization, not on the finished recording
        size, code: see `TrainOptions`
        inputs, bins: see `Constants`; a jointly trained one sees positions alone, as the end is not known yet
        picture_loss: weight of L1 + LPIPS between pictures of field and recording, ≥ 0
        draft: a third of the steps
        seed: of its weights and draws
    """

    joint: bool
    size: Size
    inputs: Inputs
    bins: Bins
    code: int
    picture_loss: float
    draft: bool
    seed: int


@dataclass(frozen=True)
class FieldPlan:
    """Which field is fitted.

    Args:
        kind: see `TrainOptions.field`
        target_psnr: worst PSNR over the slider that it should reach, dB
        bytes_budget: most bytes a member; None: as many as the target takes
        network: of a neural field
    """

    kind: FieldKind
    target_psnr: float
    bytes_budget: float | None
    network: NetworkPlan

    @property
    def joint(self) -> bool:
        """Whether a network is trained jointly with the optimization."""
        return self.kind == "neural" and self.network.joint


@dataclass(frozen=True)
class Texts:
    """What the pictures show before and after, in words, and which CLIP reads them; "" is not given.

    `asked`: whether a text was given for this; an instruction alone asks for nothing.
    """

    before: str
    after: str
    model: str
    asked: bool = False


@dataclass(frozen=True)
class Plan:
    """The end of a run: field, slider and report.

    Args:
        name: of the layer and of the .gdf file
        editor: `KIND:WHAT`
        slider: what slider values mean; "auto" is decided by the strengths that were recorded
        field: see `FieldPlan`
        texts: what CLIP is asked; a learned editor's instruction says what one sees after
    """

    name: str
    editor: str
    slider: Slider
    field: FieldPlan
    texts: Texts


def make_plan(options: TrainOptions) -> Plan:
    """The options, resolved. `options`: checked, see `resolve_options`"""
    joint, constants = options.fit == "joint", CONSTANTS[options.preset]
    network = NetworkPlan(
        joint,
        options.size,
        "position" if joint else constants.inputs,
        constants.bins,
        options.code,
        options.picture_loss,
        options.quick,
        options.seed,
    )
    kind, _, instruction = options.editor.partition(":")
    after = options.text_after or (instruction.strip().strip("\"'") if kind == "instruct" else "")
    return Plan(
        options.name,
        options.editor,
        options.slider,
        FieldPlan(options.field, options.target_psnr, options.bytes_budget, network),
        Texts(
            options.text_before,
            after,
            options.clip_model or CLIP_MODEL,
            bool(options.text_before or options.text_after),
        ),
    )
