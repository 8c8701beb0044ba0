"""`python -m benchmarks`: what cannot be written down is not measured."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.__main__ import main
from progdf.errors import ProgdfError


@pytest.mark.parametrize("option", ["--json", "--plot", "--markdown"])
def test_a_benchmark_that_could_not_be_written_down_is_not_begun(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.__main__.BENCHES", {"field": "nowhere:begun"})
    with pytest.raises(ProgdfError, match="does not exist; "):
        main(["field", option, str(tmp_path / "no" / "f.x")])


def test_an_unknown_benchmark_is_named_with_those_there_are() -> None:
    with pytest.raises(ProgdfError, match=r"unknown benchmark 'speed'; use one of rasterize, .*ablate"):
        main(["speed"])
