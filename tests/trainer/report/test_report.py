"""Report: errors over the slider, readable plots, memory by stage."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import max_pool2d

from progdf.field import BakedField, fit_keyframes
from progdf.field.baked import identity_map
from progdf.field.trajectory import Trajectory
from progdf.gaussians import pack
from tests.helpers.trained import WHITE, Small, small
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import drop_idle_attributes
from trainer.optimize.losses import GradientL1
from trainer.report.measures import error_curves
from trainer.report.plots import LINES, Plot, draw_plot
from trainer.report.report import best_view, columns_of, editor_strip, strip, thumbnail
from trainer.store.progress import RunLog
from trainer.store.state import Saved
from trainer.views.crops import moving_attributes


def _judged(bear: Small) -> Evaluator:
    """Return an evaluator whose editor darkens everything, at strengths 0.5 and 1."""
    edited = {s: [view.image * (1 - 0.5 * s) for view in bear.views] for s in (0.5, 1.0)}
    return make_evaluator(bear.scene, bear.region, bear.views, edited, WHITE, 14)


def _darker(bear: Small, amount: float = 0.6) -> BakedField:
    """Return a field that darkens the region linearly."""
    end = torch.zeros(len(bear.region), 14)
    end[:, 11:] = -amount
    return fit_keyframes(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros_like(end), end]), 2)


def _color_count(picture: Image.Image, color: Sequence[int]) -> int:
    return int((np.abs(np.asarray(picture, dtype=int) - np.array(color)).max(axis=2) <= 12).sum())


def test_perfect_field_has_no_error_in_any_measure() -> None:
    bear = small(count=3)
    evaluator = _judged(bear)
    field = _darker(bear)
    truth = {s: evaluator.pictures(field.offsets(s)) for s in (0.3, 0.8)}
    shown = {"slider": evaluator.course(field)}
    found = error_curves(evaluator, shown, (0.3, 0.8), lambda s: truth[s], GradientL1())["slider"]
    assert found.s == (0.3, 0.8)
    assert found.psnr == (99.0, 99.0)
    assert found.ssim == pytest.approx((1.0, 1.0), abs=1e-5)  # single precision
    assert found.lpips == (0.0, 0.0)


def test_all_measures_rank_two_fields_alike() -> None:
    bear = small(count=3)
    evaluator = _judged(bear)
    shown = {name: evaluator.course(_darker(bear, by)) for name, by in (("near", 0.55), ("far", 0.2))}
    truth = evaluator.pictures(_darker(bear).offsets(1.0))
    found = error_curves(evaluator, shown, (1.0,), lambda _: truth, GradientL1())
    assert found["near"].psnr[0] > found["far"].psnr[0] + 6
    assert found["near"].ssim[0] > found["far"].ssim[0]
    assert found["near"].lpips[0] < found["far"].lpips[0]


def test_ssim_covers_the_region_and_nothing_beyond_its_windows() -> None:
    bear = small(count=3)
    unedited = {1.0: [view.image for view in bear.views]}
    evaluator = make_evaluator(bear.scene, bear.region, bear.views, unedited, WHITE, 14)
    truth = evaluator.pictures(_darker(bear).offsets(0.0))
    worse = [picture.clone() for picture in truth]
    worse[0] += 0.2 * torch.rand(worse[0].shape, generator=torch.Generator().manual_seed(0))
    # the window of a pixel at the region's border reaches 5 pixels beyond it
    reach = [max_pool2d(pixels[None, None].float(), 11, 1, 5)[0, 0] > 0 for pixels in evaluator.pixels]
    beyond = [torch.where(near[..., None], p, 1 - p) for p, near in zip(truth, reach, strict=True)]
    assert any(not torch.equal(a, b) for a, b in zip(beyond, truth, strict=True))
    assert evaluator.ssim(beyond, truth) == pytest.approx(1.0, abs=1e-5)
    assert evaluator.ssim(worse, truth) < 0.95
    assert evaluator.psnr(beyond, truth) == 99.0


def test_strips_show_one_view_at_five_strengths_and_gray_gaps() -> None:
    bear = small(count=3)
    evaluator = _judged(bear)
    columns = columns_of([(1.0, 1.0)])
    ours = strip(evaluator, _darker(bear), columns, 64)
    own = editor_strip(evaluator, columns, 64)
    assert len(ours) == len(own) == 5
    assert {picture.shape for picture in (*ours, *own)} == {ours[0].shape}
    assert torch.equal(ours[0], own[0])
    assert float(ours[4].mean()) < float(ours[2].mean()) < float(ours[0].mean())
    gray = (own[1] - own[1].mean()).abs() < 0.02
    assert float(gray.float().mean()) > 0.5
    assert int(evaluator.pixels[best_view(evaluator)].sum()) == max(int(p.sum()) for p in evaluator.pixels)


@pytest.mark.parametrize("size", [(40, 40), (20, 60), (90, 30)])
def test_thumbnail_has_the_requested_width_and_limited_height(size: tuple[int, int]) -> None:
    picture = thumbnail(torch.zeros(*size, 3), 80)
    assert picture.shape[1] == 80
    assert picture.shape[0] <= 100
    assert float((picture < 0.1).float().sum()) > 0


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_every_line_of_a_plot_is_drawn_in_its_color(scale: str) -> None:
    x = [i / 10 for i in range(11)]
    lines = {f"line {k}": (x, [0.1 + 0.2 * k + 0.05 * v for v in x]) for k in range(4)}
    picture = draw_plot(Plot("title", lines, "slider", scale), 400, 270)  # type: ignore[arg-type]
    assert picture.size == (400, 270)
    assert all(_color_count(picture, color) > 150 for color in LINES[:4])
    assert _color_count(picture, LINES[4]) == 0


def test_more_lines_than_colors_are_all_drawn() -> None:
    lines = {str(i): ([0.0, 1.0], [float(i), float(i)]) for i in range(len(LINES) + 2)}
    all_of_them, first = (draw_plot(Plot("t", dict(list(lines.items())[:n])), 900, 400) for n in (8, 6))
    for color in LINES[:2]:
        assert _color_count(all_of_them, color) > 1.2 * _color_count(first, color)


def test_gaps_zeros_and_empty_lines_do_not_break_a_plot() -> None:
    holes = ([0.0, 0.5, 1.0], [float("nan"), 0.0, 2.0])
    for scale in ("linear", "log"):
        draw_plot(Plot("t", {"holes": holes, "none": ([], [])}, scale=scale), 300, 200)  # type: ignore[arg-type]
    empty = draw_plot(Plot("t", {"none": ([], [])}), 300, 200)
    assert _color_count(empty, LINES[0]) == 0


def test_low_line_is_drawn_on_a_logarithmic_axis() -> None:
    lines = {"high": ([0.0, 1.0], [1.0, 0.5]), "low": ([0.0, 1.0], [1e-6, 3e-6])}
    assert _color_count(draw_plot(Plot("t", lines, scale="log"), 400, 270), LINES[1]) > 150


def test_wide_legend_continues_in_a_second_row() -> None:
    lines = {f"a name of some length {k}": ([0.0, 1.0], [k, k + 1.0]) for k in range(4)}
    picture = np.asarray(draw_plot(Plot("t", lines), 400, 270), dtype=int)
    for color in LINES[:4]:
        blot = (np.abs(picture - np.array(color)).max(axis=2) <= 12).sum(axis=1)
        assert np.nonzero(blot >= 10)[0].max() > 210, color  # the legend's, below the plot


PEAKS = """
import resource
from pathlib import Path
from progdf.system.processes import peak_mb
block = bytearray(128 << 20)
large = peak_mb()
del block
(line,) = [l for l in Path("/proc/self/status").read_text().splitlines() if l.startswith("VmHWM:")]
# the kernel counts pages in batches, so that two looks may differ a little
peaks = [large, peak_mb(), int(line.split()[1]) / 1024]
assert min(peaks) >= 128 and max(peaks) - min(peaks) <= 2, peaks
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_memory_peak_matches_the_system() -> None:
    # a separate process, whose peak is this block
    subprocess.run([sys.executable, "-c", PEAKS], check=True, timeout=600)


def test_resumed_run_keeps_the_memory_peak_of_its_first_session(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", quiet=True)
    log.restore(Saved({}, {"seconds": {}, "total": 0.0, "memory": 1 << 21}))
    assert log.peak_mb() == 1 << 21
    log.close()


def test_evaluator_accepts_narrow_offsets_for_a_scene_with_more_bands() -> None:
    bear = small(count=3)
    edited = {1.0: [view.image for view in bear.views]}
    wide = pack(bear.scene[bear.region.members], with_shN=True).shape[1]
    assert wide > 14
    evaluator = make_evaluator(bear.scene, bear.region, bear.views, edited, WHITE, wide)
    offsets = _darker(bear).offsets(1.0)
    narrow = make_evaluator(bear.scene, bear.region, bear.views, edited, WHITE, 14)
    for a, b in zip(evaluator.pictures(offsets), narrow.pictures(offsets), strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_idle_attributes_are_dropped_only_within_the_total_allowance() -> None:
    """Use two attributes worth 0.07 dB each and a third without effect.

    Only one of the two may be dropped, because both exceed the total allowance. The third is dropped as well.
    """

    class Judging(Evaluator):
        """Evaluator that loses 0.07 dB for each of the two attributes that is missing."""

        def pictures(self, offsets: Tensor) -> list[Tensor]:
            missing = 2 - sum(bool(offsets[:, c].any()) for c in (slice(0, 3), slice(6, 10)))
            return [torch.full((1, 1, 3), 0.1 * 10 ** (0.07 * missing / 20))]

    end = torch.zeros(2, 14)
    end[:, [0, 6, 12]] = 1.0
    trajectory = Trajectory(
        torch.tensor([0.0, 1.0]),
        torch.stack([torch.zeros(2, 14), end]).half(),
        end,
        torch.tensor([0, 1]),
        (1,),
        (1.0,),
    )
    pixels = [torch.ones(1, 1, dtype=torch.bool)]
    evaluator = Judging(torch.zeros(2, 14), [], pixels, {1.0: [torch.zeros(1, 1, 3)]}, ["a"])
    kept, costs = drop_idle_attributes(trajectory, evaluator)
    assert costs == {"quats": 0.07, "means": 0.07, "sh0": 0.0}
    moving = moving_attributes(kept.end)
    assert ("means" in moving) != ("quats" in moving)
    assert "sh0" not in moving


def test_grade_keeps_bands_that_its_map_leaves_unchanged() -> None:
    """Check that a grade and its recording keep all bands of the scene; without a map only DC remains."""

    class Judging(Evaluator):
        def pictures(self, offsets: Tensor) -> list[Tensor]:
            return [torch.zeros(1, 1, 3)]

    end = torch.zeros(2, 23)
    end[:, 11] = 1.0
    offsets = torch.stack([torch.zeros(2, 23), end]).half()
    steps = torch.tensor([0, 1])
    maps = identity_map(1)[None]
    trajectory = Trajectory(torch.tensor([0.0, 1.0]), offsets, end, steps, (1,), (1.0,), maps, 1)
    pixels = [torch.ones(1, 1, dtype=torch.bool)]
    evaluator = Judging(torch.zeros(2, 23), [], pixels, {1.0: [torch.zeros(1, 1, 3)]}, ["a"])
    kept, _ = drop_idle_attributes(trajectory, evaluator)
    assert kept.end.shape == (2, 23)
    without, _ = drop_idle_attributes(replace(trajectory, maps=None), evaluator, prunes=False)
    assert without.end.shape == (2, 14)
