"""One splitter: the mark between cells is that of most lines, and a comma inside of a cell is a decimal comma."""

from __future__ import annotations

from pathlib import Path

import pytest

from weldcal.models.text_tables import cells_of, lines_of, separator_of
from weldcal.models.workpieces.seam_input import read_polyline


@pytest.mark.parametrize(
    ("lines", "mark", "cells"),
    [
        (["a,b,c", "1,2,3"], ",", ["1", "2", "3"]),
        (["a;b;c", "1,5;2;-,5"], ";", ["1.5", "2", "-.5"]),
        (["a\tb\tc", "1,5\t2,0\t"], "\t", ["1.5", "2.0", ""]),
        (["a b c", "1,5  2,5 3e-2"], " ", ["1.5", "2.5", "3e-2"]),
        (["a,b,c", "1, 2, 3"], ",", ["1", "2", "3"]),
        (["a,b,note", "1,2,moved; again", "1,2,seen; once"], ",", ["1", "2", "seen; once"]),
        (["Poses, robot 1", "a;b", "1,5;2", "1;2"], ";", ["1", "2"]),
        (["a,b", "1,2", "3,4", "1 2"], ",", ["1", "2"]),
        (["a,b", '1,"x, y"'], ",", ["1", "x, y"]),
        (["a,b", '1,"x'], ",", ["1", '"x']),
    ],
)
def test_the_mark_is_that_of_most_lines(lines: list[str], mark: str, cells: list[str]) -> None:
    assert separator_of(lines) == mark
    assert cells_of(lines[-1], mark) == cells


def test_lines_keep_their_numbers() -> None:
    assert list(lines_of("\ufeffa\r\n\r# b\n\n c", ("#",))) == [(1, "a"), (5, " c")]


def test_a_seam_with_decimal_commas_is_no_table_of_twice_as_many_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x;y;z\n0,5;1,5;2,5\n1,5;1,5;2,5\n")
    points, directions = read_polyline(tmp_path / "a.csv")
    assert points.tolist() == [[0.5, 1.5, 2.5], [1.5, 1.5, 2.5]]
    assert directions is None
