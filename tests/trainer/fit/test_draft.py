"""Drafts: a grade fitted before training, close to the editor's pictures or absent."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from progdf.compose.reference import Layer, compose_layers
from progdf.demo_scenes import MIN_ROOM_GAUSSIANS, room
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.region import from_mask
from tests.helpers.trained import WHITE, masked_psnr, small
from trainer.editors import make_editor
from trainer.fit import draft
from trainer.fit.draft import DraftViews, draft_grade, draft_views
from trainer.options import EditorOptions, TrainingViewOptions
from trainer.run.edited_views import edit_views
from trainer.store.run_folder import RunFolder
from trainer.views.view import render_view


@cache
def views() -> DraftViews:
    case = small("body")
    found = draft_views(TrainingViewOptions(), case.scene, case.region)
    assert found is not None
    return found


def drafted(editor: str, folder: Path) -> Gdf:
    """Return the draft of an edit of the bear's body, saved and loaded like in the window."""
    made = draft_grade(views(), EditorOptions(editor), "blue")
    assert made is not None
    save_gdf(folder / "draft.gdf", made)
    return load_gdf(folder / "draft.gdf", small("body").scene)


GRADE = "grade:exposure=-0.8,saturation=0.4"
PALETTE = "grade:#b97a30=#3060d0,#e0c898,curve=0.3:0.25+0.7:0.8"


@pytest.mark.parametrize("spec", ["recolor:#3060d0", "tint:#3060d0", "darken:0.6", "night", GRADE, PALETTE])
def test_draft_matches_its_editor_at_every_strength(spec: str, tmp_path: Path) -> None:
    case = small("body")
    gdf = drafted(spec, tmp_path)
    editor = make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    edited = render_view(compose_layers(case.scene, [Layer(gdf, 1.0)]), case.views[0].camera, WHITE)
    mask = case.views[0].mask > 0.05
    target = editor.edit(case.views[0], 1.0)
    before = masked_psnr(case.views[0].image, target, mask)
    assert masked_psnr(edited, target, mask) > before + 10.0, "a tenth of the change, as its rule has it"
    shown = [
        render_view(compose_layers(case.scene, [Layer(gdf, s)]), case.views[0].camera, WHITE)[mask]
        for s in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    steps = [float((b - a).abs().mean()) for a, b in pairwise(shown)]
    assert min(steps) > 0.6 * max(steps), "equal steps look equally large"


def test_draft_reports_its_error_and_is_small(tmp_path: Path) -> None:
    gdf = drafted("recolor:#3060d0", tmp_path)
    assert gdf.report["draft"]["psnr"] > 25.0
    assert (tmp_path / "draft.gdf").stat().st_size < 6000


def test_edit_that_a_color_map_cannot_carry_has_no_draft(monkeypatch: pytest.MonkeyPatch) -> None:
    assert draft_grade(views(), EditorOptions("stripes:#20a040"), "stripes") is None
    monkeypatch.setattr(draft, "MAX_UNEXPLAINED_SHARE", 1e-5)
    monkeypatch.setattr(draft, "ROUNDING", 0.0)
    assert draft_grade(views(), EditorOptions("recolor:#3060d0"), "blue") is None


def test_manual_grade_always_has_a_draft(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draft, "MAX_UNEXPLAINED_SHARE", 1e-5)
    monkeypatch.setattr(draft, "ROUNDING", 0.0)
    made = draft_grade(views(), EditorOptions(GRADE), "grade")
    assert made is not None
    assert made.report["draft"]["psnr"] > 25.0


def test_region_without_visible_members_has_no_draft() -> None:
    case = small("body")
    hidden = replace(case.scene, logit_opacities=torch.full_like(case.scene.logit_opacities, -30.0))
    assert draft_views(TrainingViewOptions(), hidden, case.region) is None


def test_indoor_scene_without_cameras_is_drafted_from_free_places() -> None:
    scene = room(MIN_ROOM_GAUSSIANS).gaussians
    region = from_mask("all", torch.ones(len(scene), dtype=torch.bool))
    views = draft_views(TrainingViewOptions(), scene, region)
    assert views is not None
    assert draft_grade(views, EditorOptions("tint:#c08040"), "tint") is not None


def test_no_extra_strengths_request_no_pictures(tmp_path: Path) -> None:
    """Cover a slider that is already even with one recording."""
    case = small("body")
    editor = make_editor(EditorOptions(GRADE), case.scene, case.region, case.views)
    assert edit_views(2, case.views, (), RunFolder(tmp_path), True, lambda *_: None, editor.course) == {}
