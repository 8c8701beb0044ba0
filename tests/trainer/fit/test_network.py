"""Options of the network of --field neural."""

from __future__ import annotations

from pathlib import Path

import pytest

from progdf.errors import ProgdfError
from tests.helpers.trained import quick_options
from trainer.options import FitOptions, with_values
from trainer.resolve import check_field_options, check_options


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"size": "small"}, "--size does not apply to --field auto; add --field neural"),
        (
            {"field_loss": "pictures", "field": "separable"},
            "--field-loss does not apply to --field separable",
        ),
    ],
)
def test_unused_network_options_are_refused(folder: Path, changed: dict[str, object], message: str) -> None:
    with pytest.raises(ProgdfError, match=message):
        check_options(quick_options(folder, **changed))


def test_refit_checks_its_options_too(folder: Path) -> None:
    with pytest.raises(ProgdfError, match="--size does not apply"):
        check_field_options(with_values(FitOptions(folder), size="small").field)
