"""The form of a new edit as data: what it asks the trainer for, and what it says is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from trainer.cli import train_options
from trainer.editors import CHECKS, EDITORS
from trainer.editors.style import STYLES as TRAINED_STYLES
from viewer.jobs.new_edit import (
    ALL,
    CHANGED,
    STYLES,
    TYPED,
    NewEdit,
    missing_package,
    with_editor,
    with_picture,
)
from viewer.jobs.new_edit import EDITORS as CHOICES
from viewer.jobs.training_job import EditOrder

KINDS = [choice.kind for choice in CHOICES]


def form(kind: str, **changes: Any) -> NewEdit:
    return replace(NewEdit(editor=KINDS.index(kind)), **changes)


def test_every_editor_of_the_form_is_one_of_the_trainer() -> None:
    assert set(KINDS) <= set(EDITORS)


@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind not in ("instruct", "folder", "pictures", "style")]
)
def test_what_the_form_asks_for_is_what_the_trainer_takes(kind: str) -> None:
    word, _, what = form(kind).spec.partition(":")
    assert word == kind
    CHECKS[kind](what)
    CHECKS[kind](form(kind, amount=0.98, through_hues=True).spec.partition(":")[2])


def test_the_trainer_has_as_many_paintings_as_the_form() -> None:
    assert TRAINED_STYLES == STYLES


def test_an_editor_says_what_is_missing_before_it_can_train() -> None:
    assert "Type what" in form("instruct").obstacle or "pip install" in form("instruct").obstacle
    assert "folder" in form("folder").obstacle
    assert form("folder", folder="edited").obstacle == ""
    assert "pictures" in form("pictures").obstacle
    assert form("pictures", pictures="/a.png, /b.png").spec == "pictures:/a.png,/b.png"
    assert "region" in form("recolor", region=TYPED).obstacle
    unknown = replace(CHOICES[0], package="no_such_package_at_all", extra="more")
    assert missing_package(unknown) == "Recolor needs more: pip install progdf-studio[more]"


def test_changed_pictures_find_their_own_region() -> None:
    found = with_editor(NewEdit(), KINDS.index("pictures"))
    assert found.region == CHANGED
    assert with_editor(found, 0).region == ALL
    assert with_editor(NewEdit(region="hands"), KINDS.index("pictures")).region == "hands"


def test_a_dropped_picture_is_ready_to_train_and_a_further_one_comes_beside_it() -> None:
    first = with_picture(form("recolor", region="hands", pictures="old.png"), Path("a/helmet.png"), True)
    assert (first.spec, first.region) == (f"pictures:{Path.cwd()}/a/helmet.png", CHANGED)
    assert first.layer_name == "helmet"
    second = with_picture(replace(first, region="hands"), Path("b.png"), True)
    assert (second.pictures, second.region) == ("a/helmet.png, b.png", "hands")
    assert with_picture(second, Path("b.png"), True).pictures == second.pictures
    assert with_picture(second, Path("c.png"), False).pictures == "c.png"


def test_a_name_is_one_that_a_file_can_have() -> None:
    assert form("recolor").layer_name == "recolor"
    assert form("recolor", region="hands").layer_name == "hands recolor"
    assert form("night", name=" ../a\\b ").layer_name == "-a-b"
    assert form("style", style=7).layer_name == "style 7"


def test_an_order_is_a_command_line_that_the_trainer_reads_back() -> None:
    order = EditOrder(Path("a b.ply"), Path("out/-x"), "-x", "all-sphere:0,0,0,1", "night:0.70", True, 1)
    options = train_options(order.arguments(resume=True)[1:])
    assert (options.scene, options.out, options.name) == (order.scene, order.out, order.name)
    assert (options.region, options.editor) == (order.region, order.editor)
    assert options.quick
    assert options.resume
    assert options.threads == 1
