"""The method without one of its parts, or with another: what `python -m benchmarks ablate` trains again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from trainer.editors.base import EditKind
from trainer.optimize.settings import GROUP_STEPS, Optimization, resolve_slider
from trainer.options import Slider, TrainOptions
from trainer.plan import Plan, make_plan, plan_optimization
from trainer.presets import apply_preset

BASE, LINEAR = "base", "2-keyframes"


@dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Args:
        name: short, as --only takes it
        what: what is different, in words
        changes: values of the optimization's plan in place of the run's
        slider: in place of the run's
        linear: the slider goes straight from the original to the end, whatever was recorded
    """

    name: str
    what: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    slider: Slider | None = None
    linear: bool = False

    @property
    def trains_as(self) -> str:
        """Name of the variant whose optimization it shares: the slider is laid over what was recorded."""
        return self.name if self.changes else BASE

    def plan(self, own: Plan) -> Plan:
        """The run's plan with what is different."""
        optimization = replace(own.optimization, **self.changes)
        return replace(own, optimization=optimization, slider=self.slider or own.slider)


def _as_printed() -> Mapping[str, Any]:
    """What the paper's preset asks of the optimization, but for the number of steps."""
    options = TrainOptions(Path("scene.ply"), Path("run"), region="all", editor="night")
    default, paper = make_plan(options).optimization, make_plan(apply_preset(options, "paper")).optimization
    return {
        name: value
        for name, value in vars(paper).items()
        if value != getattr(default, name) and name != "steps"
    }


VARIANTS = (
    Variant(BASE, "the run's own options"),
    Variant(LINEAR, "a straight line to the same end: 2 keyframes", linear=True),
    Variant("one-target", "no stages: towards the finished edit alone", {"stages": 1}),
    Variant("progressive-off", "no progressive constraint", {"progressive": "off"}),
    Variant("progressive-warmup", "the constraint as a warm-up", {"progressive": "warmup"}),
    *(
        Variant(
            f"progressive-{way}-{norm}",
            f"the constraint on {norm} of steps, {does}",
            {"progressive": way, "progressive_norm": norm},
        )
        for way, does in (("growth", "tightening, as printed"), ("decay", "letting go"))
        for norm in ("squares", "absolutes")
    ),
    Variant("sharpness-off", "no sharpness term", {"sharpness": "off"}),
    Variant("sharpness-hinge", "as sharp as the target", {"sharpness": "hinge"}),
    Variant("sharpness-paper", "the printed sharpness", {"sharpness": "paper"}),
    Variant("no-lpips", "L1 alone", {"perceptual_weight": 0.0}),
    Variant("no-sh", "view-dependent color left as it is", {"sh": "off"}),
    Variant("no-groups", "parts are not moved as wholes first", {"group_steps": 0}),
    Variant("slider-stages", "the editor's own strengths, even in between", slider="stages"),
    Variant("slider-even", "even over the whole slider", slider="even"),
    Variant("slider-time", "the optimizer's time", slider="time"),
    Variant("paper", "all as the paper prints it", _as_printed(), "time"),
)


def differing_variants(plan: Plan, kind: EditKind, stages: int, sh_degree: int) -> list[Variant]:
    """The variants that differ from a run.

    Args:
        plan: the run's own
        kind: what the edit moves
        stages: how many strengths the editor was asked for
        sh_degree: of the scene
    """
    idle = {
        *(() if stages > 1 else ("one-target", "slider-stages", "slider-even")),
        *(() if sh_degree > 0 else ("no-sh",)),
        *(() if kind == "geometry" else ("no-groups",)),
    }
    own = _resolve(plan, kind, stages)
    return [
        variant
        for variant in VARIANTS
        if variant.name not in idle
        and (variant.name in (BASE, LINEAR) or _resolve(variant.plan(plan), kind, stages) != own)
    ]


def choose_variants(variants: Sequence[Variant], only: str) -> list[Variant]:
    """Those that `only` names, in their own order, or all.

    Raises:
        ProgdfError: a name that is none, or that makes no difference to this run; or no name but commas.
    """
    names = {name.strip() for name in only.split(",") if name.strip()}
    known = {variant.name for variant in variants}
    if only and not names:
        raise ProgdfError(f"--only '{only}' names no variant; choose of {','.join(v.name for v in variants)}")
    for name in sorted(names - known):
        about = "makes no difference to this run" if name in {v.name for v in VARIANTS} else "does not exist"
        raise ProgdfError(f"the variant '{name}' {about}; choose of {','.join(v.name for v in variants)}")
    return [variant for variant in variants if not names or variant.name in names]


def _resolve(plan: Plan, kind: EditKind, stages: int) -> tuple[Optimization, Slider]:
    """All that decides a variant's bits; weights that nothing pays are as good as none."""
    asked = plan.optimization
    groups = GROUP_STEPS if asked.group_steps is None else asked.group_steps
    found = plan_optimization(asked, kind, groups)
    if found.solves_colors:
        found = replace(found, weights=replace(found.weights, perceptual=0.0))
    return found, resolve_slider(plan.slider, (1.0,) * stages)
