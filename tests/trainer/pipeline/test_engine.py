"""Which engine draws a run's steps: the same edit from each, and a run keeps to the one it began with."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.rasterize import engines
from progdf.rasterize.engines import choose_engine
from tests.helpers.drawn import NEEDS_WARP
from tests.helpers.trained import quick_options, train


@NEEDS_WARP
@pytest.mark.parametrize(
    "asked",
    [
        {"kind": "style", "steps": 24, "stages": 1},
        {"steps": 40, "stages": 2},
        pytest.param(
            {"kind": "geometry", "group_steps": 10, "steps": 16, "stages": 1}, marks=pytest.mark.slow
        ),
    ],
    ids=["style", "color", "geometry"],
)
def test_a_run_on_warp_ends_at_the_cpu_engine_s_digits(folder: Path, asked: dict[str, object]) -> None:
    ends = []
    for engine in ("cpu", "warp"):
        out = f"{engine}-{asked.get('kind', 'color')}"
        options = quick_options(folder, out, part="scarf", views=4, image_size=48, engine=engine, **asked)
        ends.append(train(options))
    cpu, warp = ends
    # a step's gradients differ by 1e-5 of the largest, and Adam takes what hardly shows for as much
    assert warp.report["edit"]["psnr_to_views"] == pytest.approx(
        cpu.report["edit"]["psnr_to_views"], abs=0.02
    )
    assert warp.report["edit"]["lpips_to_views"] == pytest.approx(
        cpu.report["edit"]["lpips_to_views"], abs=2e-4
    )
    difference = (warp.trajectory.end - cpu.trajectory.end).norm() / cpu.trajectory.end.norm()
    assert float(difference) < 0.01


def test_auto_is_warp_where_there_is_a_card_and_warp_and_else_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for card, installed, chosen in ((True, True, "warp"), (True, False, "cpu"), (False, True, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda card=card: card)
        monkeypatch.setattr(engines, "find_spec", lambda name, there=installed: object() if there else None)
        assert choose_engine("auto") == chosen
        assert choose_engine("cpu") == "cpu"


def test_a_run_goes_on_with_the_engine_that_it_began_with(folder: Path) -> None:
    asked = {"views": 4, "image_size": 48, "steps": 16, "stages": 1, "part": "scarf"}
    train(quick_options(folder, "kept", **asked))
    with pytest.raises(ProgdfError, match="was started with --engine cpu, not warp"):
        train(quick_options(folder, "kept", engine="warp", resume=True, **asked))
