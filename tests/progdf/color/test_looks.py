"""Names of looks."""

from __future__ import annotations

import pytest

from progdf.color.grade import parse_grade
from progdf.color.looks import BUILT_IN, describe_look


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ("exposure=-1.00", "Darker"),
        ("temperature=0.35,shadows=0.60", "Open shadows, warm"),
        ("temperature=-0.30,contrast=-0.20,tint=0.10", "Cool, low contrast"),
        ("wheel_shadows=210:0.40:0", "Toned"),
        ("#ff0000=#0000ff", "Recolored"),
        ("curve=0.30:0.20", "Curve"),
    ],
)
def test_look_is_named_after_its_strongest_effects(settings: str, name: str) -> None:
    assert describe_look(parse_grade(settings)) == name


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_grade_has_a_name(name: str) -> None:
    described = describe_look(parse_grade(BUILT_IN[name]))
    assert described[:1].isupper()
    assert len(described) < 40
