"""Tests of .cube color tables: values are read as written, and broken files are refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.field.baked import LATTICE, identity_map, lattice_colors
from progdf.field.grade import lattice_form, look_up, map_colors, mapped_lattice
from progdf.formats.cube import read_cube, write_cube
from progdf.gdf.file import read_gdf
from progdf.sh import C0, rgb_to_sh0

ROWS = "".join(f"{red} {green} {blue}\n" for red, green, blue in lattice_colors(2).tolist())


def written(folder: Path, text: str | bytes) -> Path:
    (folder / "look.cube").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "look.cube"


def some_table(side: int = 5) -> torch.Tensor:
    return torch.rand(side**3, 3, generator=torch.Generator().manual_seed(side))


def test_table_round_trip_is_exact_to_six_digits(tmp_path: Path) -> None:
    table = some_table(33)
    write_cube(tmp_path / "look.cube", table, 'a "look"\nof höhe')
    lines = (tmp_path / "look.cube").read_text().splitlines()
    assert lines[:2] == ['TITLE "a  look  of h he"', "LUT_3D_SIZE 33"]
    torch.testing.assert_close(read_cube(tmp_path / "look.cube"), table, atol=6e-7, rtol=0)


def test_written_table_is_clamped_to_display_colors(tmp_path: Path) -> None:
    write_cube(tmp_path / "look.cube", 3 * some_table() - 1, "")
    read = read_cube(tmp_path / "look.cube")
    assert (float(read.min()), float(read.max())) == (0.0, 1.0)


@pytest.mark.parametrize(
    "text",
    [
        f'TITLE "x"\nLUT_3D_SIZE 2\n{ROWS}',
        f"\ufeffLUT_3D_SIZE 2 # two\r\nDOMAIN_MIN 0 0 0\r\nDOMAIN_MAX 1.0 1 1\r\n\r\n{ROWS}".replace(
            "\n", "\r\n"
        ),
        f"# made by hand\nLUT_3D_SIZE 2\nLUT_3D_INPUT_RANGE 0.0 1.0\n# rows\n{ROWS}# the end\n\n",
    ],
)
def test_comments_marks_and_line_ends_are_ignored(tmp_path: Path, text: str) -> None:
    assert torch.equal(read_cube(written(tmp_path, text)), identity_map(LATTICE, 8))


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_tables_of_any_system_are_read(tmp_path: Path, ends: str, encoding: str) -> None:
    lines = (
        'TITLE "late # sun"',
        "# by hand, höhe",
        "LUT_3D_SIZE\t2",
        "",
        "\tDOMAIN_MIN\t0 0 0",
        *(f"\t{row}\t# a color".replace(" ", "\t", 2) for row in ROWS.splitlines()),
        "# the end",
    )
    text = ends.join(lines)
    assert torch.equal(read_cube(written(tmp_path, text.encode(encoding))), identity_map(LATTICE, 8))


def test_red_varies_fastest_in_the_rows() -> None:
    assert lattice_colors(3)[1].tolist() == [0.5, 0.0, 0.0]
    assert lattice_colors(3)[9].tolist() == [0.0, 0.0, 0.5]
    table = lattice_colors(3) * torch.tensor([1.0, 0.5, 0.25])
    color = torch.tensor([[0.3], [0.6], [0.8]])
    torch.testing.assert_close(look_up(color, table)[:, 0], torch.tensor([0.3, 0.3, 0.2]))


def test_table_of_another_domain_is_resampled(tmp_path: Path) -> None:
    table = read_cube(written(tmp_path, f"LUT_3D_SIZE 2\nDOMAIN_MIN -1 0 0\nDOMAIN_MAX 1 2 1\n{ROWS}"))
    expected = lattice_colors(65) * torch.tensor([0.5, 0.5, 1.0]) + torch.tensor([0.5, 0.0, 0.0])
    torch.testing.assert_close(table, expected, atol=1e-6, rtol=0)


def test_input_range_is_the_domain_of_all_channels(tmp_path: Path) -> None:
    table = read_cube(written(tmp_path, f"LUT_3D_SIZE 2\nLUT_3D_INPUT_RANGE -1 3\n{ROWS}"))
    torch.testing.assert_close(table, (lattice_colors(65) + 1.0) / 4.0, atol=1e-6, rtol=0)


def test_lookup_is_trilinear() -> None:
    table = some_table(4)
    draws = torch.Generator().manual_seed(2)
    colors = torch.rand(3, 50, generator=draws)
    cell = (3 * colors).floor().clamp_max(2).long()
    share = 3 * colors
    share = share - cell
    expected = torch.zeros(3, 50)
    for corner in range(8):
        step = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])[:, None]
        weight = torch.where(step == 1, share, 1 - share).prod(dim=0)
        red, green, blue = cell + step
        expected += weight * table[red + 4 * green + 16 * blue].T
    torch.testing.assert_close(look_up(colors, table), expected, atol=1e-6, rtol=0)


def test_colors_beyond_the_table_are_those_at_its_edge() -> None:
    table = some_table()
    sh0 = rgb_to_sh0(torch.tensor([[1.4, -0.2, 0.5], [1.0, 0.0, 0.5]]))
    found = map_colors(sh0[:, None], table, LATTICE)[:, 0] * C0 + 0.5
    torch.testing.assert_close(found[0], found[1])


def test_table_strength_is_linear_between_the_ends() -> None:
    form = lattice_form(some_table())
    colors = lattice_colors(9)
    ends = [mapped_lattice(form, s, 9) for s in (0.0, 1.0)]
    torch.testing.assert_close(ends[0], colors)
    torch.testing.assert_close(mapped_lattice(form, 0.3, 9), torch.lerp(ends[0], ends[1], 0.3))


BROKEN = {
    "empty": ("", "has no LUT_3D_SIZE"),
    "text": ("good morning\n", "a line 'good morning'"),
    "bytes": (bytes(range(256)) * 9, "look.cube has"),
    "huge": ("LUT_3D_SIZE 1000000000\n", "has LUT_3D_SIZE 1e.09; sizes of 2 to 129"),
    "infinite": ("LUT_3D_SIZE inf\n", "is followed by 'inf'"),
    "half": (f"LUT_3D_SIZE 2.5\n{ROWS}", "has LUT_3D_SIZE 2.5"),
    "1D": ("LUT_1D_SIZE 2\n0 0 0\n1 1 1\n", r"uses 'LUT_1D_SIZE' \(a table of one dimension\)"),
    "shaper": (f"LUT_1D_SIZE 2\nLUT_3D_SIZE 2\n0 0 0\n1 1 1\n{ROWS}", "uses 'LUT_1D_SIZE'"),
    "1D range": (f"LUT_1D_INPUT_RANGE 0 2\nLUT_3D_SIZE 2\n{ROWS}", "uses 'LUT_1D_INPUT_RANGE'"),
    "video": (f"LUT_3D_SIZE 2\nLUT_IN_VIDEO_RANGE\n{ROWS}", "uses 'LUT_IN_VIDEO_RANGE'"),
    "two domains": (
        f"LUT_3D_SIZE 2\nDOMAIN_MAX 2 2 2\nLUT_3D_INPUT_RANGE 0 1\n{ROWS}",
        "remove the wrong one",
    ),
    "twice": (f"LUT_3D_SIZE 2\nLUT_3D_SIZE 2\n{ROWS}", "a line 'LUT_3D_SIZE 2'"),
    "missing": (f"LUT_3D_SIZE 2\n{ROWS[:-10]}", "row|holds"),
    "more": (f"LUT_3D_SIZE 2\n{ROWS}0 0 0\n", "holds 9 rows of 3 numbers, LUT_3D_SIZE 2 needs 8 of 3"),
    "no rows": ("LUT_3D_SIZE 2\n", "needs 8 of 3"),
    "four": ("LUT_3D_SIZE 2\n" + "0 0 0 1\n" * 8, "holds 8 rows of 4"),
    "words": (
        f"LUT_3D_SIZE 2\n{ROWS[:20]}{'x' * 9999} 0 0\n{ROWS[20:]}",
        "has an invalid row '.*', expected 3",
    ),
    "two": (f"LUT_3D_SIZE 2\n0 0\n{ROWS[6:]}", "has an invalid row '0 0', expected 3 numbers"),
    "a word": (f"LUT_3D_SIZE 2\n0 0 nan0\n{ROWS[6:]}", "has an invalid row '0 0 nan0', expected 3 numbers"),
    "nan": (f"LUT_3D_SIZE 2\n0 0 nan\n{ROWS[12:]}", "a color that is not finite or beyond"),
    "inf": (f"LUT_3D_SIZE 2\n0 0 -inf\n{ROWS[12:]}", "a color that is not finite or beyond"),
    "domain": (f"LUT_3D_SIZE 2\nDOMAIN_MAX 1 0 1\n{ROWS}", "which is empty"),
    "blank": ("\n" * 300_000 + " " * 300_000, "has no LUT_3D_SIZE"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_table_is_refused_in_one_short_line(tmp_path: Path, name: str) -> None:
    text, reason = BROKEN[name]
    with pytest.raises(ProgdfError, match=reason) as refused:
        read_gdf(written(tmp_path, text))
    assert len(str(refused.value)) < 250
    assert "\n" not in str(refused.value)


def test_oversized_table_file_is_not_read(tmp_path: Path) -> None:
    with written(tmp_path, "LUT_3D_SIZE 2\n").open("r+b") as file:
        file.truncate(2 << 30)  # a sparse file, without bytes on the disk
    with pytest.raises(ProgdfError, match="is larger than 80 MB"):
        read_cube(tmp_path / "look.cube")
