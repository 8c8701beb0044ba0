"""The method without one of its parts, or with another: what `python -m benchmarks ablate` trains again.

A variant differs in one value of the plan from another one, which `of` names: from the run's own options,
from the same edit descended view by view where those solve for its colors, from the paper's preset, or from
that with our field in place of its network.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from progdf.errors import ProgdfError
from trainer.editors import COSTLY_DIAL, GIVEN
from trainer.editors.base import EditKind
from trainer.fit.network import NetworkPlan
from trainer.optimize.settings import GROUP_STEPS, Optimization, resolve_slider
from trainer.options import Slider, TrainOptions
from trainer.plan import Plan, make_plan, plan_optimization
from trainer.presets import PRESETS, apply_preset

BASE, LINEAR, EQUAL = "base", "2-keyframes", "equal-strengths"
DESCENT, PAPER, PAPER_PGS = "descent", "paper", "paper-pgs"

Resolved = tuple[Optimization, Slider, NetworkPlan | None]
"""All that decides a variant's bits, but for what all variants of a run share."""

_T = TypeVar("_T")

_AFTERWARDS = ("slider", "optimization.refinements.prunes")  # the optimization knows nothing of these


@dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Args:
        name: short, as --only takes it
        what: what is different, in words
        changes: values of the plan in place of the other variant's, by their paths
        of: name of that variant
        linear: the slider goes straight from the original to the end, whatever was recorded
        longer: how many times the other variant's steps it takes
    """

    name: str
    what: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    of: str = BASE
    linear: bool = False
    longer: float = 1.0

    @property
    def trains_as(self) -> str:
        """Name of the variant whose optimization it shares."""
        return self.of if all(path in _AFTERWARDS for path in self.changes) else self.name

    def plan(self, own: Plan, seed: int = 0) -> Plan:
        """The run's plan with what is different. `seed`: is added to the run's own, of views and network"""
        plan = _BY_NAME[self.of].plan(own) if self.of != self.name else own
        for path, value in self.changes.items():
            plan = _put(plan, path, value)
        if self.longer != 1.0:
            plan = _put(plan, "optimization.steps", round(self.longer * plan.optimization.steps))
        if not seed:
            return plan
        network = replace(plan.field.network, seed=plan.field.network.seed + seed)
        optimization = replace(plan.optimization, seed=plan.optimization.seed + seed)
        return replace(plan, optimization=optimization, field=replace(plan.field, network=network))


def plan_values(part: object, at: str = "") -> dict[str, Any]:
    """All values of a plan by their paths, as "optimization.steps"."""
    found: dict[str, Any] = {}
    for name in (entry.name for entry in fields(part)):  # type: ignore[arg-type]
        value = getattr(part, name)
        found |= plan_values(value, f"{at}{name}.") if is_dataclass(value) else {at + name: value}
    return found


def _put(part: _T, path: str, value: object) -> _T:
    """A plan with another value at a path."""
    name, _, rest = path.partition(".")
    inner = _put(getattr(part, name), rest, value) if rest else value
    return replace(part, **{name: inner})  # type: ignore[type-var]


_PAPER_STEPS = PRESETS["paper"]["steps"] / TrainOptions.steps
"""Its steps over ours: a draft shortens both alike."""


def _as_printed() -> Mapping[str, Any]:
    """What the paper's preset asks of optimization, slider and field, but for the number of steps."""
    options = TrainOptions(Path("scene.ply"), Path("run"), region="all", editor="night")
    default, paper = plan_values(make_plan(options)), plan_values(make_plan(apply_preset(options, "paper")))
    return {
        path: value
        for path, value in paper.items()
        if value != default[path]
        and path != "optimization.steps"
        and path.partition(".")[0] in ("optimization", "slider", "field")
    }


def _without(name: str, what: str, part: str, of: str = BASE) -> Variant:
    """Without one of `Refinements`."""
    return Variant(name, what, {f"optimization.refinements.{part}": False}, of)


def _other(name: str, what: str, part: str, value: object, of: str = BASE) -> Variant:
    """With another value of the optimization's plan."""
    return Variant(name, what, {f"optimization.{part}": value}, of)


VARIANTS = (
    Variant(BASE, "the run's own options", of=BASE),
    Variant(LINEAR, "a straight line to the same end: 2 keyframes", linear=True),
    _other("one-target", "no stages: towards the finished edit alone", "stages", 1),
    _without(EQUAL, "asked at equal strengths, not for equal changes", "asks_evenly"),
    Variant("slider-stages", "the editor's own strengths, even in between", {"slider": "stages"}),
    Variant("slider-even", "even over the whole slider", {"slider": "even"}),
    Variant("slider-time", "the optimizer's time", {"slider": "time"}),
    _other("no-sh", "view-dependent color left as it is", "sh", "off"),
    _other("with-sh", "view-dependent color trained in any case", "sh", "on"),
    _without("plain-clamps", "clamps pass no gradient that leads back", "leads_back"),
    _without("no-propagation", "members that no view shows left alone", "propagates"),
    _without("no-pruning", "attributes kept that do not pay", "prunes"),
    _other("no-groups", "parts are not moved as wholes first", "group_steps", 0),
    _without(DESCENT, "view by view, where colors are solved for", "solves"),
    _other("descent-one-target", "no stages", "stages", 1, DESCENT),
    _other("rates-3dgs", "the learning rates of 3DGS", "rates", "3dgs", DESCENT),
    _without("no-damping", "members that hardly show not held still", "damps", DESCENT),
    _without("no-interpolation", "a stage's own target from its first step", "ramps", DESCENT),
    _without("no-slowing", "no short steps at a stage's end", "slows", DESCENT),
    _without("no-sizing", "steps not sized by a stage's way", "sizes", DESCENT),
    _without("no-running-mean", "the bare iterates recorded", "averages", DESCENT),
    _without("descent-plain-clamps", "clamps pass no gradient that leads back", "leads_back", DESCENT),
    _other("no-lpips", "L1 alone", "perceptual_weight", 0.0, DESCENT),
    _other("sharpness-off", "no L_render", "sharpness", "off", DESCENT),
    _other("sharpness-hinge", "L_render: as sharp as the target", "sharpness", "hinge", DESCENT),
    _other("sharpness-paper", "L_render as printed", "sharpness", "paper", DESCENT),
    _other("progressive-off", "no progressive constraint", "progressive", "off", DESCENT),
    _other("progressive-warmup", "the constraint as a warm-up", "progressive", "warmup", DESCENT),
    _other("progressive-growth", "the constraint tightening, as printed", "progressive", "growth", DESCENT),
    _other("progressive-decay", "the constraint letting go", "progressive", "decay", DESCENT),
    *(
        _other(f"{way}-absolutes", "its steps as sums of absolutes", "progressive_norm", "absolutes", of)
        for way, of in (("growth", "progressive-growth"), ("decay", "progressive-decay"))
    ),
    Variant(PAPER, "the paper's preset with its network", _as_printed(), longer=_PAPER_STEPS),
    Variant(
        "paper-gdf-no-sharpness",
        "no L_render in the network's loss",
        {"field.network.sharpness": False},
        PAPER,
    ),
    Variant(PAPER_PGS, "our field in place of the network", {"field.field": "auto"}, PAPER),
    _other("paper-no-sharpness", "no L_render", "sharpness", "off", PAPER_PGS),
    _other("paper-progressive-off", "no progressive constraint", "progressive", "off", PAPER_PGS),
)

_BY_NAME = {variant.name: variant for variant in VARIANTS}


def differing_variants(plan: Plan, kind: EditKind, stages: int, sh_degree: int) -> list[Variant]:
    """The variants that differ from a run and from each other.

    Args:
        plan: the run's own
        kind: what the edit moves
        stages: how many strengths the editor was asked for
        sh_degree: of the scene
    """
    staged = ("one-target", "descent-one-target", EQUAL, "slider-stages", "slider-even", "no-interpolation")
    asked = plan.slider == "even" and plan.editor.family not in (*GIVEN, *COSTLY_DIAL)
    idle = {
        *(() if stages > 1 else staged),
        *(() if asked else (EQUAL,)),
        *(() if sh_degree > 0 else ("no-sh", "with-sh")),
        *(("no-interpolation", "no-sizing") if kind == "geometry" else ("no-groups",)),
        *(() if kind == "color" else ("no-propagation",)),
    }
    seen: list[Resolved] = []
    found = []
    for variant in VARIANTS:
        resolved = _resolve(variant.plan(plan), kind, stages)
        if variant.linear or (variant.name not in idle and resolved not in seen):
            found.append(variant)
            seen.append(resolved)
    return found


def is_seeded(variant: Variant, plan: Plan, kind: EditKind) -> bool:
    """Whether a seed changes a variant: not where colors are solved for, all views at once."""
    optimization, _, network = _resolve(variant.plan(plan), kind, 1)
    return network is not None or not optimization.solves_colors


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
        about = "makes no difference to this run" if name in _BY_NAME else "does not exist"
        raise ProgdfError(f"the variant '{name}' {about}; choose of {','.join(v.name for v in variants)}")
    return [variant for variant in variants if not names or variant.name in names]


def _resolve(plan: Plan, kind: EditKind, stages: int) -> Resolved:
    """What a plan comes to; weights that nothing pays are as good as none."""
    asked = plan.optimization
    groups = GROUP_STEPS if asked.group_steps is None else asked.group_steps
    found = plan_optimization(asked, kind, groups)
    if found.solves_colors:
        does = replace(found.refinements, damps=True, ramps=True, slows=True, sizes=True, averages=True)
        found = replace(found, weights=replace(found.weights, perceptual=0.0), refinements=does)
    else:
        found = replace(found, refinements=replace(found.refinements, solves=True))
    network = plan.field.network if plan.field.field == "neural" else None
    return found, resolve_slider(plan.slider, (1.0,) * stages), network
