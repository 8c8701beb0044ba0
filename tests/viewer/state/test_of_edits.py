"""Actions on one layer that use its edit: repeat, limit to the selection, and select."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from progdf.compose import layer_paint
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.state import selection
from viewer.state.actions import perform
from viewer.state.commands import OnItem, Plain
from viewer.state.forms import ALL, TYPED
from viewer.state.selection import NamedRegion
from viewer.state.workspace import SceneFacts, Workspace
from viewer.ui import key_list

pytestmark = pytest.mark.gl
SCARF = 0
EARS = 1


@pytest.fixture(scope="module")
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.5, 0.5)) as hand:
        yield hand


def of_edit(facts: SceneFacts, instruction: str, spec: str) -> SceneFacts:
    """Return facts in which the scarf's edit has this instruction and region spec."""
    row = replace(facts.rows[SCARF], instruction=instruction, region_spec=spec)
    return replace(facts, rows=(row, *facts.rows[1:]))


def selecting(work: Workspace, rows: np.ndarray, count: int) -> Workspace:
    mask = np.zeros(count, bool)
    mask[rows] = True
    return replace(work, view=replace(work.view, selection=selection.select(work.view.selection, mask)))


def test_again_opens_the_form_with_the_settings_of_the_edit(hand: Rig) -> None:
    work = hand.main_view.work
    facts = of_edit(hand.main_view.facts, "recolor:#1b6972,path=hue", "labels:parts.npy:5")
    form = perform(work, OnItem("again", SCARF), facts)
    assert (form.form_open, form.form_opening) == (True, True)
    assert form.form.spec == "recolor:#1b6972,path=hue"
    assert (form.form.region, form.form.typed_region) == (TYPED, "labels:parts.npy:5")
    assert form.form.name == work.view.layers[SCARF].name
    everywhere = perform(work, OnItem("again", SCARF), of_edit(facts, "night:0.40", "all")).form
    assert (everywhere.region, everywhere.spec) == (ALL, "night:0.40")
    rows = facts.rows[work.view.layers[SCARF].gdf].members
    mask = np.zeros(facts.count, bool)
    mask[rows] = True
    regions = (NamedRegion("hands", Path("/scenes/hands.region.npy"), selection.pack(mask), len(rows)),)
    view = replace(work.view, selection=replace(work.view.selection, regions=regions))
    named = of_edit(facts, "tint:#ff0000", "file:/scenes/blue.region.npy")
    assert perform(replace(work, view=view), OnItem("again", SCARF), named).form.region == "hands"


def test_closed_form_keeps_its_settings_but_not_its_name(hand: Rig) -> None:
    facts = of_edit(hand.main_view.facts, "tint:#ff0000", "all")
    work = perform(hand.main_view.work, OnItem("again", SCARF), facts)
    assert work.form.name == work.view.layers[SCARF].name
    closed = perform(work, Plain("new_edit"), facts)
    opened = perform(closed, Plain("new_edit"), facts)
    assert (closed.form_open, opened.form_open, opened.form.name) == (False, True, "")
    assert opened.form.spec == work.form.spec


def test_new_grade_opens_the_form_with_a_grade(hand: Rig) -> None:
    work = hand.main_view.work
    opened = perform(work, Plain("new_grade"), hand.main_view.facts)
    assert (opened.form_open, opened.form.choice.kind) == (True, "grade")
    assert perform(opened, Plain("new_grade"), hand.main_view.facts).form_open


def test_clipped_colors_are_marked_in_the_form_of_a_grade(hand: Rig) -> None:
    facts = hand.main_view.facts
    marked = perform(hand.main_view.work, Plain("clipping"), facts)
    assert (marked.form_open, marked.form.choice.kind, marked.form.clipping) == (True, "grade", True)
    assert not perform(marked, Plain("clipping"), facts).form.clipping
    assert any(
        key == "J in a grade" and "clipped" in text for topic in key_list.topics() for key, text in topic.rows
    )


def test_again_ignores_edits_that_no_form_editor_made(hand: Rig) -> None:
    work = hand.main_view.work
    for instruction in (
        "edit --scale head:2",
        "decal:logo.png",
        "style:99",
        "recolor:#nothex",
        "grade:x",
        "",
    ):
        assert (
            perform(work, OnItem("again", SCARF), of_edit(hand.main_view.facts, instruction, "all")) == work
        )


def test_layer_is_limited_to_the_selection_and_can_be_reduced_again(hand: Rig) -> None:
    facts = hand.main_view.facts
    work = hand.main_view.work
    row = facts.rows[SCARF]
    assert perform(work, OnItem("limit_to_selection", SCARF), facts) == work, "nothing is selected"
    half = row.members[::2]
    third = row.members[::3]
    work = perform(selecting(work, half, facts.count), OnItem("limit_to_selection", SCARF), facts)
    weights = layer_paint.decode(work.view.layers[SCARF].paint, row.count)
    assert weights is not None
    assert row.members[weights.numpy() == 1.0].tolist() == half.tolist()
    assert work.view.layers[EARS].paint == layer_paint.FULL
    work = perform(selecting(work, third, facts.count), OnItem("limit_to_selection", SCARF), facts)
    weights = layer_paint.decode(work.view.layers[SCARF].paint, row.count)
    assert weights is not None
    assert row.members[weights.numpy() == 1.0].tolist() == row.members[::6].tolist()


def test_select_painted_selects_the_painted_members(hand: Rig) -> None:
    facts = hand.main_view.facts
    work = hand.main_view.work
    row = facts.rows[SCARF]

    def selected(work: Workspace) -> list[int]:
        found = perform(replace(work, focus=SCARF), Plain("select_painted"), facts).view.selection
        return np.flatnonzero(selection.unpack(found.members, facts.count)).tolist()

    assert selected(work) == row.members.tolist(), "all of its region where nothing is painted"
    weights = np.linspace(0.0, 1.0, row.count, dtype=np.float32)
    layers = (replace(work.view.layers[SCARF], paint=layer_paint.encode(weights)), work.view.layers[EARS])
    half = row.members[np.round(255 * weights) >= 127.5]
    assert selected(replace(work, view=replace(work.view, layers=layers))) == half.tolist()
