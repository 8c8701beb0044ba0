"""Edit optimization: it reaches the target, records snapshots, moves nothing else and is reproducible."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices, pack
from progdf.rasterize import render
from tests.helpers.trained import WHITE, Small, course, masked_psnr, small
from trainer.editors import make_editor
from trainer.optimize.pgs import ParameterSnapshot, learning_rates, optimize, p95_change
from trainer.options import EditorOptions
from trainer.views.crops import crop_scene
from trainer.views.view import crop


def run(case: Small, steps: int = 40, **more: object) -> tuple[Tensor, list[ParameterSnapshot]]:
    """Return the original rows and the recordings of an optimization."""
    wanted = course(case, steps, **more)
    return wanted[0], list(optimize(*wanted))


def test_members_reach_the_edited_views() -> None:
    case = small("body")
    original, found = run(case, steps=60)
    edited = case.scene.replace_rows(case.region.members, original + found[-1].offsets)
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    for view in case.views:
        target = editor.edit(view, 1.0)
        inside = view.mask > 0.5
        before = masked_psnr(view.image, target, inside)
        after = masked_psnr(render(edited, view.camera).image.clamp(0, 1), target, inside)
        assert after > 28.0
        assert after > before + 12.0


def test_distance_to_the_finished_edit_falls() -> None:
    _, found = run(small("body"))
    assert found[-1].means["left"] < 0.25 * found[0].means["left"]


def test_each_stage_ends_with_a_recording_and_steps_ascend() -> None:
    _, found = run(small("body"))
    assert [snapshot.step for snapshot in found if snapshot.ends_stage] == [40, 80]
    steps = [snapshot.step for snapshot in found]
    assert steps == sorted(set(steps))
    assert len(found) >= 8


def test_first_steps_start_from_the_original() -> None:
    _, found = run(small("body"), snapshots=10_000)
    assert float(found[0].offsets.abs().max()) < 0.1 * float(found[-1].offsets.abs().max())


def test_color_edit_moves_only_colors() -> None:
    _, found = run(small("body"))
    for name, columns in attribute_slices(found[-1].offsets.shape[1]).items():
        moved = bool(found[-1].offsets[:, columns].any())
        assert moved == (name in ("sh0", "shN")), name


def test_same_seed_repeats_the_bits_and_another_seed_differs() -> None:
    case = small("body")
    first, again, other = (run(case, steps=12, seed=seed)[1][-1].offsets for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_nonfinite_loss_stops_the_run() -> None:
    case = small("body")
    broken = replace(case, views=tuple(replace(v, image=v.image * float("nan")) for v in case.views))
    with pytest.raises(FloatingPointError, match="step"):
        run(broken, steps=3)


def test_crop_matches_the_render_of_the_composed_scene() -> None:
    case = small("body")
    view = case.views[0]
    rows = pack(case.scene[case.region.members], with_shN=True)
    random = torch.Generator().manual_seed(0)
    rows = rows + 0.05 * torch.randn(rows.shape, generator=random)
    prepared = crop_scene(case.scene, case.region.members, view.camera, view.box, WHITE)
    image = prepared.render(rows)
    whole = render(case.scene.replace_rows(case.region.members, rows), view.camera).image.clamp(0, 1)
    assert torch.allclose(image, crop(whole, view.box), atol=1e-5)
    assert torch.allclose(prepared.original.clamp(0, 1), crop(view.image, view.box), atol=1e-6)


def test_geometry_rates_cover_everything_and_scale_with_the_region() -> None:
    small_rates, large_rates = (learning_rates("geometry", 14, extent) for extent in (1.0, 10.0))
    assert bool((small_rates > 0).all())
    means = attribute_slices(14)["means"]
    assert torch.allclose(large_rates[means], 10 * small_rates[means])
    assert torch.equal(large_rates[3:], small_rates[3:])


def test_step_size_follows_the_largest_changes_not_the_mean() -> None:
    before = torch.zeros(10, 10, 3)
    target = torch.full((10, 10, 3), 0.02)
    target[:1, :, 1] = 0.5  # a tenth of the pixels changes a lot
    target[5:] = 0.0  # half of the pixels stay
    assert p95_change([target], [before]) == pytest.approx(0.5)
    assert p95_change([before], [before]) == 0.0
    strip = torch.full((20, 10, 3), 0.1)
    strip[0, :2] = 1.0  # 1 % of the pixels must not count
    assert p95_change([strip], [torch.zeros(20, 10, 3)]) == pytest.approx(0.1)
