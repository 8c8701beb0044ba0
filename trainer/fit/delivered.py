"""Delivered edit of a run in its saved state: a stopped report is completed without another fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from progdf.field import Candidate
from progdf.field.baked import SliderRemap
from progdf.field.trajectory import Trajectory
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from trainer.store.state import StateFolder

from .fit import Fitted, fit_baselines

_PART = "fitted"
_PLAIN_EDIT = "fitted.gdf"
_SHARPENED_EDIT = "sharpened.gdf"


@dataclass(frozen=True)
class DeliveredEdit:
    """Edit as written to NAME.gdf, with everything of its fit that the report needs."""

    gdf: Gdf  # edit of the scene that was trained on, without discs for fine paint
    sharpened: Gdf | None  # the same edit with these discs; None if it needs none
    trajectory: Trajectory  # the recording, which ends at the edit
    remap: SliderRemap  # from the trajectory's slider to the edit's
    chosen: Candidate  # the field of `gdf`, with its errors against the trajectory
    baselines: Mapping[str, Candidate]  # keyframe fields by name, on the trajectory's slider

    @staticmethod
    def of(
        gdf: Gdf, sharpened: Gdf | None, trajectory: Trajectory, remap: SliderRemap, fitted: Fitted
    ) -> DeliveredEdit:
        """Return the delivered edit of a fit."""
        chosen = Candidate(gdf.field, fitted.chosen.curve, fitted.chosen.label)
        return DeliveredEdit(gdf, sharpened, trajectory, remap, chosen, fitted.baselines)

    @property
    def shipped_trajectory(self) -> Trajectory:
        """The recording on the slider of the edit."""
        return replace(self.trajectory, s=self.remap(self.trajectory.s).float())


def save_delivered(state: StateFolder, edit: DeliveredEdit) -> None:
    """Save a delivered edit. The baselines are made again from the trajectory.

    Raises:
        OSError, ProgdfError: the disk is full or the folder is gone.
    """
    save_gdf(state.path / _PLAIN_EDIT, edit.gdf)
    if edit.sharpened is not None:
        save_gdf(state.path / _SHARPENED_EDIT, edit.sharpened)
    values = {
        "sharpened": edit.sharpened is not None,
        "chosen": _errors(edit.chosen),
        "baselines": {name: _errors(found) for name, found in edit.baselines.items()},
    }
    state.save(_PART, {"old": edit.remap.old, "new": edit.remap.new}, values)


def load_delivered(state: StateFolder, scene: Gaussians, trajectory: Trajectory) -> DeliveredEdit | None:
    """Return the delivered edit of a stopped run; None if its edit is not written.

    Args:
        state: saved state of the run
        scene: the scene that was trained on
        trajectory: the recorded trajectory

    Raises:
        ProgdfError: the state is damaged.
    """
    saved = state.load(_PART)
    if saved is None:
        return None
    with state.restore_part(_PART):
        gdf = load_gdf(state.path / _PLAIN_EDIT, scene)
        sharpened = load_gdf(state.path / _SHARPENED_EDIT, scene) if saved.values["sharpened"] else None
        remap = SliderRemap(saved.tensors["old"], saved.tensors["new"])
        curve, label = _curve(saved.values["chosen"])
        baselines = dict[str, Candidate]()
        for name, field in fit_baselines(trajectory).items():
            baselines[name] = Candidate(field, *_curve(saved.values["baselines"][name]))
        if gdf.field.attributes:
            trajectory = replace(trajectory, end=gdf.field.offsets(1.0))
        chosen = Candidate(gdf.field, curve, label)
        return DeliveredEdit(gdf, sharpened, trajectory, remap, chosen, baselines)


def _errors(candidate: Candidate) -> dict[str, Any]:
    return {"psnr": list(candidate.curve), "label": candidate.label}


def _curve(values: Mapping[str, Any]) -> tuple[tuple[float, ...], str]:
    return tuple(float(psnr) for psnr in values["psnr"]), str(values["label"])
