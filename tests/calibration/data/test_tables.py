"""A table's row that does not fit its header is refused with its line; nothing is shifted, dropped or overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from weldcal.calibration.data.checks import read_rows
from weldcal.models.errors import InputError


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a,b\n1,2\n# note\n\n1,2,3\n", "line 5: 3 cells, and the header names 2 columns"),
        ("a,b\n0,5,2\n", "decimal commas need semicolons or tabs"),
        ("a,b,A\n1,2,3\n", "two columns 'a'"),
        ("a,b\n1," + "7" * 200_000 + "\n", "line 2, has a cell of more than 131072 characters"),
        ('a,b\n1,"2\n3,4\n', "cannot be read"),
        (",".join(f"c{k}" for k in range(300)) + "\n", "300 columns, more than 200"),
    ],
)
def test_a_row_that_does_not_fit_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        read_rows(tmp_path / "a.csv")
    assert len(str(caught.value)) < 300


def test_empty_cells_beyond_the_header_and_decimal_commas_between_semicolons_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("a;b;;\n0,5;2;;\n7\n")
    names, rows = read_rows(tmp_path / "a.csv")
    assert names[:2] == ["a", "b"]
    assert [(row["a"], row["b"]) for row in rows] == [("0.5", "2"), ("7", "")]
