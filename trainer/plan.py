"""What a run will do: the options, resolved once into parts; below, each function is given its own.

What the kind of the edit decides is resolved by `plan_optimization`, as a trial may have to find the kind.
What the scene decides (the axis that is up, the number and size of the views, the SH bands) is found where
the scene is looked at. A plan is all that the bits of a result depend on, but for the files that it names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from trainer.editors import GIVEN, UNTOLD, VIEW_BY_VIEW
from trainer.editors.base import EditKind, EditorSettings
from trainer.editors.pictures import picture_paths
from trainer.fit.network import NetworkPlan
from trainer.optimize.objective import LossWeights, Sharpness
from trainer.optimize.settings import Optimization
from trainer.report.clip import Texts
from trainer.segmenters.base import SegmenterSettings
from trainer.setup.resolution import ViewSettings

from .option_checks import check_name, check_options, guidance_of
from .options import (
    MOST_STAGES,
    QUICK_STAGES,
    QUICK_STEPS,
    QUICK_VIEWS,
    STAGE_STEPS,
    Bands,
    FieldKind,
    LiftRule,
    Norm,
    Progressive,
    Rates,
    Slider,
    TrainOptions,
)
from .presets import CONSTANTS, Refinements

PERCEPTUAL_WEIGHT: Mapping[EditKind, float] = {"color": 0.1, "style": 0.3, "geometry": 0.3}
SHARPNESS: Mapping[EditKind, Sharpness] = {"color": "off", "style": "hinge", "geometry": "off"}
SHARPNESS_WEIGHT: Mapping[Sharpness, float] = {"hinge": 0.1, "paper": 1.0, "off": 0.0}
PROGRESSIVE_WEIGHT = 5.0  # λ2 of the paper
STAGES: Mapping[EditKind, int] = {"color": MOST_STAGES, "style": 1, "geometry": MOST_STAGES}


@dataclass(frozen=True)
class RegionPlan:
    """What may change.

    Args:
        region: as typed
        lift_rule, lift_threshold: how masks vote, see `lift.score`; None: the rule's own threshold
        segmenter: finds what text:"…" names
    """

    region: str
    lift_rule: LiftRule
    lift_threshold: float | None
    segmenter: SegmenterSettings


@dataclass(frozen=True)
class EditorPlan:
    """Who edits the views.

    Args:
        editor: `KIND:WHAT`
        the others: see `EditorSettings`
    """

    editor: str
    model: str
    guidance: float | None
    image_guidance: float | None
    edit_steps: int | None
    edit_size: int | None
    graded: bool
    seed: int

    @property
    def family(self) -> str:
        """The KIND."""
        return self.editor.partition(":")[0]

    @property
    def knows_kind(self) -> bool:
        """Whether the editor knows what its pictures move."""
        return self.family not in UNTOLD

    def settings(self, kept: Path) -> EditorSettings:
        """For the editor's factory. `kept`: folder in which painted pictures are kept"""
        return EditorSettings(
            self.model,
            self.guidance,
            self.image_guidance,
            self.edit_steps,
            self.seed,
            self.edit_size,
            self.graded,
            kept,
        )


@dataclass(frozen=True)
class OptimizationPlan:
    """What is asked of the optimization, before it is known what the edit moves; see `plan_optimization`.

    Args:
        kind: what moves; None: what the editor knows, or else a trial finds
        steps: over all stages
        stages: strengths that an editor with a dial is asked for; None: by kind and steps
        group_steps: steps per strength in which parts move as wholes first; None: a trial finds
        sh: whether the SH bands beyond DC are trained; auto: where they show
        perceptual_weight: None: by kind
        progressive, progressive_norm: the progressive constraint
        reedit_every: steps between two edits of the current renders; 0: none
        rates, perceptual_every, sharpness, raw, whole, joint, refinements: see `Constants`
        seed: order of the views
        few: the views are a handful of changed pictures, see `picture_solver`
    """

    kind: EditKind | None
    steps: int
    stages: int | None
    group_steps: int | None
    sh: Bands
    perceptual_weight: float | None
    progressive: Progressive
    progressive_norm: Norm
    reedit_every: int
    rates: Rates
    perceptual_every: int
    sharpness: Literal["kind"] | Sharpness
    raw: bool
    whole: bool
    joint: bool
    seed: int
    refinements: Refinements = Refinements()
    few: bool = False


@dataclass(frozen=True)
class FieldPlan:
    """Which field is fitted.

    Args:
        field: its kind, see `TrainOptions.field`
        target_psnr: worst PSNR over the slider that it should reach, dB
        bytes_budget: most bytes a member; None: as many as the target takes
        network: of a neural field
    """

    field: FieldKind
    target_psnr: float
    bytes_budget: float | None
    network: NetworkPlan


@dataclass(frozen=True)
class Plan:
    """A run, from the scene to the report.

    Args:
        scene: its file
        name: of the layer and of the .gdf file
        region, editor, views, optimization: see their classes
        slider: what slider values mean; auto: stages where pictures of several strengths are given, else even
        field: see `FieldPlan`
        texts: what CLIP is asked
    """

    scene: Path
    name: str
    region: RegionPlan
    editor: EditorPlan
    views: ViewSettings
    optimization: OptimizationPlan
    slider: Slider
    field: FieldPlan
    texts: Texts

    @property
    def edit(self) -> dict[str, str]:
        """What identifies the edit: a run folder holds runs of one."""
        return {
            "scene": str(self.scene.resolve()),
            "region": self.region.region,
            "editor": self.editor.editor,
        }


def make_plan(options: TrainOptions) -> Plan:
    """The options, checked and resolved.

    Raises:
        ProgdfError: one makes no sense.
    """
    check_options(options)
    constants, quick = CONSTANTS[options.preset], options.quick
    steps, views, stages = options.steps, options.views, options.stages
    if quick:
        steps, views = min(steps, QUICK_STEPS), min(views or QUICK_VIEWS, QUICK_VIEWS)
        stages = min(stages, QUICK_STAGES)
    family, _, what = options.editor.partition(":")
    joint = constants.joint and options.field == "neural"
    return Plan(
        options.scene,
        check_name(options.name or options.out.resolve().name),
        RegionPlan(
            options.region,
            options.lift_rule,
            options.lift_threshold,
            SegmenterSettings(options.detector, options.sam_model, options.box_threshold),
        ),
        EditorPlan(
            options.editor,
            options.model,
            *guidance_of(options.guidance),
            options.edit_steps,
            options.edit_size,
            graded=stages > 1,
            seed=options.seed,
        ),
        ViewSettings(
            options.cameras,
            options.up,
            views or None,
            options.image_size or None,
            dense=not quick and family not in VIEW_BY_VIEW,
            pictures=picture_paths(what) if family == "pictures" else (),
            scene=options.scene,
        ),
        OptimizationPlan(
            None if options.kind == "auto" else options.kind,
            steps,
            stages or None,
            options.group_steps,
            options.sh,
            options.perceptual_weight,
            options.progressive,
            options.progressive_norm,
            options.reedit_every,
            constants.rates,
            constants.perceptual_every,
            constants.sharpness,
            constants.raw,
            constants.whole,
            joint,
            options.seed,
            constants.refinements,
            few=family == "pictures",
        ),
        "even" if options.slider == "auto" and family not in GIVEN else options.slider,
        FieldPlan(
            options.field,
            options.target_psnr,
            options.bytes_budget,
            NetworkPlan(
                options.size,
                constants.inputs,
                constants.bins,
                constants.code,
                options.field_loss,
                quick,
                options.seed,
            ),
        ),
        Texts(
            options.text_before,
            options.text_after or (what.strip().strip("\"'") if family == "instruct" else ""),
            bool(options.text_before or options.text_after),
        ),
    )


def plan_optimization(asked: OptimizationPlan, kind: EditKind, group_steps: int) -> Optimization:
    """What the plan means for an edit of this kind.

    What each of the defaults gives, alone, is in docs/experiments.md, Terms and options of a descent.

    Args:
        asked: see `OptimizationPlan`
        kind: what the edit moves
        group_steps: as asked, or as a trial found; without effect where nothing moves
    """
    sharpness = SHARPNESS[kind] if asked.sharpness == "kind" else asked.sharpness
    weights = LossWeights(
        PERCEPTUAL_WEIGHT[kind] if asked.perceptual_weight is None else asked.perceptual_weight,
        asked.perceptual_every,
        asked.progressive,
        PROGRESSIVE_WEIGHT,
        sharpness,
        SHARPNESS_WEIGHT[sharpness],
        asked.progressive_norm,
    )
    most = STAGES[kind]
    solves_colors = (
        kind == "color"  # colors alone change, and nothing is asked for that only a descent view by view has
        and asked.refinements.solves
        and asked.rates == "kind"
        and asked.progressive == "off"
        and sharpness == "off"
        and not asked.perceptual_weight
        and not asked.raw
        and not asked.joint
        and not asked.reedit_every
    )
    few = asked.few and solves_colors
    return Optimization(
        kind,
        asked.steps,
        asked.stages or min(most, QUICK_STAGES if asked.steps < STAGE_STEPS * most else most),
        group_steps if kind == "geometry" else 0,
        # only an edit of colors may leave the bands alone
        "on" if asked.sh == "auto" and kind != "color" else asked.sh,
        weights,
        asked.rates,
        asked.raw,
        # by their own pictures alone nothing but colors would pay
        replace(asked.refinements, prunes=False, propagates=False) if few else asked.refinements,
        solves_colors=solves_colors,
        seed=asked.seed,
        few=few,
    )
