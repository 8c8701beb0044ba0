"""Variants of the method for `python -m benchmarks ablate`: without one of its parts, or with another.

A variant differs from the variant named by `of` in one value of the plan, or in patches of the trainer's
modules. The reference is the run itself, the same edit by gradient descent over the views if the run solves
for colors, the paper's preset, or that preset with our field in place of its network.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar
from unittest import mock

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from trainer.editors import editor_row
from trainer.optimize.groups import GROUP_STEPS
from trainer.optimize.pgs import LEARNING_RATES
from trainer.optimize.retime import resolve_slider
from trainer.options import PRESETS, EditKind, FieldOptions, OptimizeOptions, Preset, TrainOptions
from trainer.paper import losses as paper_losses
from trainer.paper.descent import RATE_FACTORS, RATES_3DGS
from trainer.paper.losses import Exponent, Over, laplacian
from trainer.resolve import resolve_kind

from .objectives import PrintedSharpness, ProgressiveDecay, ProgressiveGrowth, ProgressiveSum

BASE = "base"
LINEAR = "2-keyframes"
EQUAL = "equal-strengths"
DESCENT = "descent"
PAPER = "paper"
PAPER_PGS = "paper-pgs"

_DESCENT_FOLDER = "trainer.optimize"
_PAPER_FOLDER = "trainer.paper"

Resolved = tuple[Preset, OptimizeOptions, FieldOptions | None, tuple[tuple[str, object], ...]]
"""Everything that determines a variant's result, apart from the inputs shared by all variants of a run."""

_T = TypeVar("_T")

# changes that take effect after the optimization
_POST_OPTIMIZATION = ("optimize.slider", "trainer.fit.fit._MIN_ATTRIBUTE_GAIN_DB")


@dataclass(frozen=True)
class Variant:
    """One row of the ablation."""

    name: str  # short name, for --only
    what: str  # the difference, in words
    # changed values of the plan, by path
    changes: Mapping[str, Any] = field(default_factory=dict)
    of: str = BASE  # name of the variant that it differs from
    linear: bool = False  # use a straight line from the original to the end instead of the recording
    # replaced objects of the trainer's modules, by dotted name
    patches: Mapping[str, object] = field(default_factory=dict)
    longer: float = 1.0  # factor of the other variant's number of steps

    @property
    def trains_as(self) -> str:
        """Name of the variant whose optimization it shares, or its own name."""
        shares = self.name != EQUAL and all(
            path in _POST_OPTIMIZATION for path in (*self.changes, *self.patches)
        )
        return self.of if shares else self.name

    @contextmanager
    def patched(self) -> Iterator[None]:
        """Patch the trainer's modules for this variant."""
        with ExitStack() as stack:
            for name, value in _all_patches(self).items():
                stack.enter_context(mock.patch(name, value))
            yield

    def plan(self, own: TrainOptions, seed: int = 0) -> TrainOptions:
        """Return the run's plan with the changes. `seed`: added to the run's seeds of views and network"""
        plan = _BY_NAME[self.of].plan(own) if self.of != self.name else own
        for path, value in self.changes.items():
            plan = _put(plan, path, value)
        if self.longer != 1.0:
            plan = _put(plan, "optimize.steps", round(self.longer * plan.optimize.steps))
        optimize = replace(plan.optimize, seed=plan.optimize.seed + seed)
        return replace(plan, optimize=optimize, field=replace(plan.field, seed=plan.field.seed + seed))


def plan_values(part: object, at: str = "") -> dict[str, Any]:
    """Return all values of a plan by path, such as "optimize.steps"."""
    values: dict[str, Any] = {}
    for name in (entry.name for entry in fields(part)):  # type: ignore[arg-type]
        value = getattr(part, name)
        values |= plan_values(value, f"{at}{name}.") if is_dataclass(value) else {at + name: value}
    return values


def _put(part: _T, path: str, value: object) -> _T:
    """Return a plan with another value at a path."""
    name, _, rest = path.partition(".")
    inner = _put(getattr(part, name), rest, value) if rest else value
    return replace(part, **{name: inner})  # type: ignore[type-var]


_PAPER_STEPS = PRESETS["paper"]["optimize"]["steps"] / OptimizeOptions.steps
"""Steps of the paper's preset over our default; a draft shortens both alike."""


def _as_printed() -> Mapping[str, Any]:
    """Return the paper's preset with its options of optimization and field that differ, except the steps."""
    parts = {"optimize": OptimizeOptions, "field": FieldOptions}
    return {"preset": "paper"} | {
        f"{part}.{name}": value
        for part, kind in parts.items()
        for name, value in PRESETS["paper"][part].items()
        if name != "steps" and value != getattr(kind, name)
    }


def _other(name: str, what: str, part: str, value: object, of: str = BASE) -> Variant:
    """Make a variant with another value of the optimization."""
    return Variant(name, what, {f"optimize.{part}": value}, of)


def _descended(name: str, what: str, path: str, value: object, of: str = DESCENT) -> Variant:
    """Make a variant with another part of our descent. `path`: below trainer.optimize"""
    return Variant(name, what, of=of, patches={f"{_DESCENT_FOLDER}.{path}": value})


def _reading(name: str, what: str, path: str, value: object, of: str = PAPER_PGS) -> Variant:
    """Make a variant with another reading of the paper. `path`: below trainer.paper"""
    return Variant(name, what, of=of, patches={f"{_PAPER_FOLDER}.{path}": value})


_ALL_3DGS = dict.fromkeys(LEARNING_RATES, RATES_3DGS)
_NO_FACTORS = dict.fromkeys(RATE_FACTORS, 1.0)


def _signed(image: Tensor) -> Tensor:
    """Return the signed L_render; its gradient is 0 except at the boundary of the picture."""
    return -laplacian(image.mean(dim=2)).mean()


def _magnitude(image: Tensor) -> Tensor:
    return -laplacian(image.mean(dim=2)).abs().mean()


def _absolute_change(moved: Tensor, previous: Tensor, step: int, exponent: Exponent, over: Over) -> Tensor:
    signed_step = step if exponent == "growth" else -step
    factor: float = 0.05 * 1.1 ** (signed_step / 50)
    return factor * (moved - previous.detach()).abs().sum()


_PLAIN_CLAMPS = {"trainer.views.crops.clamp_towards": torch.clamp}

VARIANTS = (
    Variant(BASE, "the run's own options", of=BASE),
    Variant(LINEAR, "a straight line in raw parameters to the same end", linear=True),
    _other("one-target", "no stages: the full edit is the only target", "stages", 1),
    Variant(EQUAL, "stages at equal strengths instead of equal changes"),
    Variant("slider-stages", "the editor's own strengths, even in between", {"optimize.slider": "stages"}),
    Variant("slider-even", "even over the whole slider", {"optimize.slider": "even"}),
    Variant("slider-time", "proportional to the optimizer's steps", {"optimize.slider": "time"}),
    _other("no-sh", "view-dependent color unchanged", "sh", "off"),
    _other("with-sh", "view-dependent color trained in any case", "sh", "on"),
    Variant("plain-clamps", "plain clamps: no gradient back into the range", patches=_PLAIN_CLAMPS),
    Variant(
        "no-pruning",
        "attributes without visible benefit kept",
        patches={"trainer.fit.fit._MIN_ATTRIBUTE_GAIN_DB": -math.inf},
    ),
    _other("no-groups", "no rigid motion of parts first", "group_steps", 0),
    _other(DESCENT, "gradient descent instead of solving for colors", "color_solver", False),
    _other("descent-one-target", "no stages", "stages", 1, DESCENT),
    _descended("rates-3dgs", "the learning rates of 3DGS", "pgs.LEARNING_RATES", _ALL_3DGS),
    _descended("no-damping", "barely visible members not damped", "pgs.EPSILON", 0.0),
    Variant(
        "no-interpolation",
        "a stage's own target from its first step",
        of=DESCENT,
        patches={f"{_DESCENT_FOLDER}.pgs.RAMP_SHARE": 0.0, f"{_DESCENT_FOLDER}.pgs.SINGLE_RAMP_SHARE": 0.0},
    ),
    _descended("no-slowing", "no short steps at a stage's end", "pgs._decay", lambda *_: 1.0),
    _descended("no-sizing", "step size independent of a stage's path length", "pgs.REFERENCE_CHANGE", 0.0),
    _descended("no-running-mean", "iterates recorded without averaging", "pgs.SMOOTHING", 0.0),
    Variant(
        "descent-plain-clamps",
        "plain clamps: no gradient back into the range",
        of=DESCENT,
        patches=_PLAIN_CLAMPS,
    ),
    _other("no-lpips", "L1 only", "perceptual_weight", 0.0, DESCENT),
    _descended("sharpness-paper", "L_render of the paper", "pgs.Objective", PrintedSharpness),
    _descended("progressive-growth", "the constraint tightening", "pgs.Objective", ProgressiveGrowth),
    _descended("progressive-decay", "the constraint loosening", "pgs.Objective", ProgressiveDecay),
    _descended("growth-sum", "over all members' sum", "pgs.Objective", ProgressiveSum, "progressive-growth"),
    Variant(PAPER, "the paper's preset with its network", _as_printed(), longer=_PAPER_STEPS),
    _reading(
        "paper-gdf-no-sharpness",
        "no L_render in the network's loss",
        "losses.FIELD_SHARPNESS_WEIGHT",
        0.0,
        PAPER,
    ),
    Variant(PAPER_PGS, "our field in place of the network", {"field.field": "auto"}, PAPER),
    _reading("paper-no-sharpness", "no L_render", "losses.SHARPNESS_WEIGHT", 0.0),
    _reading("paper-signed", "L_render signed, as printed", "losses.sharpness", _signed),
    _reading("paper-magnitude", "L_render of magnitudes", "losses.sharpness", _magnitude),
    _reading("paper-progressive-off", "no progressive constraint", "losses.PROGRESSIVE_WEIGHT", 0.0),
    _reading("paper-growth", "the constraint tightening, as printed", "losses.EXPONENT", "growth"),
    _reading("paper-sum", "the constraint over all members' sum", "losses.OVER", "sum"),
    _reading(
        "paper-absolutes",
        "the constraint as a sum of absolute values",
        "losses.progressive_change",
        _absolute_change,
    ),
    Variant(
        "paper-weights",
        "L1 and LPIPS with ten times the weight, as in GaussianEditor",
        of=PAPER_PGS,
        patches={
            f"{_PAPER_FOLDER}.losses.PROGRESSIVE_WEIGHT": paper_losses.PROGRESSIVE_WEIGHT / 10,
            f"{_PAPER_FOLDER}.losses.SHARPNESS_WEIGHT": paper_losses.SHARPNESS_WEIGHT / 10,
        },
    ),
    _reading("paper-rates-3dgs", "the learning rates of 3DGS", "descent.RATE_FACTORS", _NO_FACTORS),
    _reading(
        "paper-sum-3dgs",
        "the learning rates of 3DGS, too",
        "descent.RATE_FACTORS",
        _NO_FACTORS,
        "paper-sum",
    ),
)

_BY_NAME = {variant.name: variant for variant in VARIANTS}


def differing_variants(plan: TrainOptions, kind: EditKind, stages: int, sh_degree: int) -> list[Variant]:
    """Return the variants that differ from a run and from each other.

    Args:
        plan: the run's plan
        kind: attributes that the edit changes
        stages: number of strengths of the editor's pictures
        sh_degree: SH degree of the scene
    """
    staged = ("one-target", "descent-one-target", EQUAL, "slider-stages", "slider-even", "no-interpolation")
    even = plan.optimize.slider == "even"
    row = editor_row(plan.editor)
    equalized = even and not row.external and not row.slow_strengths
    idle = {
        *(() if stages > 1 else staged),
        *(() if equalized else (EQUAL,)),
        *(() if sh_degree > 0 else ("no-sh", "with-sh")),
        *(("no-interpolation", "no-sizing") if kind == "geometry" else ("no-groups",)),
    }
    seen: list[Resolved] = []
    found = []
    for variant in VARIANTS:
        resolved = _resolve(variant, plan, kind, stages)
        if variant.linear or (variant.name not in idle and resolved not in seen):
            found.append(variant)
            seen.append(resolved)
    return found


def is_seeded(variant: Variant, plan: TrainOptions, kind: EditKind) -> bool:
    """Return True if a seed changes a variant; solving for colors uses all views at once and no seed."""
    _, optimization, network, _ = _resolve(variant, plan, kind, 1)
    return network is not None or optimization.solver == "descent"


def choose_variants(variants: Sequence[Variant], only: str) -> list[Variant]:
    """Return the variants named by `only`, in their own order, or all.

    Raises:
        ProgdfError: a variant does not exist or makes no difference to this run, or `only` has no name.
    """
    names = {name.strip() for name in only.split(",") if name.strip()}
    known = {variant.name for variant in variants}
    if only and not names:
        raise ProgdfError(f"--only '{only}' names no variant; choose of {','.join(v.name for v in variants)}")
    for name in sorted(names - known):
        about = "makes no difference to this run" if name in _BY_NAME else "does not exist"
        raise ProgdfError(f"the variant '{name}' {about}; choose of {','.join(v.name for v in variants)}")
    return [variant for variant in variants if not names or variant.name in names]


def _resolve(variant: Variant, own: TrainOptions, kind: EditKind, stages: int) -> Resolved:
    """Return the options that determine a variant's result, with unused options set to fixed values."""
    plan = variant.plan(own)
    groups = GROUP_STEPS if plan.optimize.group_steps is None else plan.optimize.group_steps
    slider = resolve_slider(plan.optimize.slider, (1.0,) * stages)
    optimization = replace(resolve_kind(plan, kind, groups), slider=slider, color_solver=True)
    changes = (*_all_patches(variant).items(), *([(EQUAL, True)] if variant.name == EQUAL else []))
    if optimization.solver != "descent":
        optimization = replace(optimization, perceptual_weight=0.0)
    unused = _DESCENT_FOLDER if plan.preset == "paper" else _PAPER_FOLDER
    changes = tuple(change for change in changes if not change[0].startswith(unused))
    network = plan.field if plan.field.field == "neural" else None
    return plan.preset, optimization, network, changes


def _all_patches(variant: Variant) -> Mapping[str, object]:
    """Return a variant's patches together with those of the variant that it differs from."""
    if variant.of == variant.name:
        return variant.patches
    return {**_all_patches(_BY_NAME[variant.of]), **variant.patches}
