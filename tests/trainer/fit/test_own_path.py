"""Path of a single-target edit: straight unless the recording is closer to the editor at strength 0.5."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from progdf.field.trajectory import Trajectory
from progdf.gaussians import attribute_slices, pack
from tests.helpers.trained import WHITE, small
from trainer.fit.fit import choose_path
from trainer.options import EditKind
from trainer.views.setup import TrainingSetup
from trainer.views.view import View, render_view


@cache
def setup() -> TrainingSetup:
    case = small("scarf")
    return TrainingSetup(case.scene, case.region, case.views[:3], case.views[3:], WHITE)


def way(bend: float, attribute: str = "sh0") -> Trajectory:
    """Return a path to another color or position that is `bend` off the straight line at strength 0.5."""
    rows = pack(setup().scene[setup().region.members], with_shN=False)
    column = attribute_slices(rows.shape[1])[attribute].start
    offsets = torch.zeros(3, *rows.shape)
    offsets[1, :, column] = 0.4 + bend
    offsets[2, :, column] = 0.8
    strengths = torch.tensor([0.0, 0.5, 1.0])
    return Trajectory(strengths, offsets.half(), offsets[2], torch.tensor([0, 5, 10]), (2,), (1.0,))


def same(trajectory: Trajectory) -> Trajectory:
    return trajectory


@dataclass(frozen=True)
class Halfway:
    """Editor whose picture at strength 0.5 is the scene with these offsets."""

    offsets: Tensor
    stages: tuple[float, ...] = ()
    kind: EditKind = "style"
    is_confined: bool = True

    def edit(self, view: View, strength: float) -> Tensor:
        assert strength == 0.5, "no other picture is needed"
        members = setup().region.members
        rows = pack(setup().scene[members], with_shN=False) + self.offsets
        return render_view(setup().scene.replace_rows(members, rows), view.camera, WHITE)


def test_detour_matched_by_the_editor_is_kept() -> None:
    bent = way(0.6)
    kept, why = choose_path(bent, setup(), Halfway(bent.node(1)), False, same)
    assert kept is bent
    assert why.startswith("as recorded")


def test_detour_not_matched_by_the_editor_is_straightened() -> None:
    bent = way(0.6)
    kept, why = choose_path(bent, setup(), Halfway(0.5 * bent.end), False, same)
    assert len(kept) == 2
    assert torch.equal(kept.end, bent.end)
    assert torch.equal(kept.at(0.25), 0.25 * bent.end)
    assert kept.stage_ends == (1,)
    assert kept.stage_strengths == ((1.0, 1.0),)
    assert why.startswith("straight: PSNR to the editor's pictures at strength 0.5")


def test_path_is_straight_without_an_editor_picture_at_half_strength() -> None:
    bent = way(0.6)
    assert len(choose_path(bent, setup(), None, False, same)[0]) == 2
    assert len(choose_path(bent, setup(), Halfway(bent.end, stages=(1.0,)), False, same)[0]) == 2


def test_moving_parts_keep_their_path() -> None:
    turned = way(0.4, "means")
    assert choose_path(turned, setup(), None, True, same)[0] is turned


def test_discarded_path_is_not_retimed() -> None:
    def never(trajectory: Trajectory) -> Trajectory:
        raise AssertionError("re-timed in vain")

    assert len(choose_path(way(0.6), setup(), None, False, never)[0]) == 2
