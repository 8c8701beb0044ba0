"""The viewer's benchmark on a scene small enough for a test: it runs, and its error column is true."""

from __future__ import annotations

from progdf.bench import Table
from viewer.bench import Case, rows, tables


def test_the_viewers_table_has_a_row_for_each_way_to_draw_with_its_error() -> None:
    results = rows([Case(600, 100, True)], steps=2, size=(64, 48))
    assert {result.drawn_by for result in results} >= {"cpu"}
    for result in results:
        assert len(result.slider) == len(result.orbit) == 2
        assert all(timing.changed == 100 for timing in result.slider)
        assert all(timing.changed == 0 for timing in result.orbit)
        assert result.psnr_db >= 65.0, "the early stop at 1e-4, in a picture of few pixels"
    (table,) = tables(results)
    assert isinstance(table, Table)
    assert len(table.rows) == len(results)
    assert all(len(row) == len(table.columns) for row in table.rows)
