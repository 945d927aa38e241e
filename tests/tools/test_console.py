"""The printed rows of a result."""

from __future__ import annotations

import pytest

from weldcal.tools import console


@pytest.mark.parametrize(
    ("value", "text"),
    [(-48213456.7, "-48,213,457"), (1234.5, "1,234"), (999.4, "999"), (0.01234, "0.0123"), (1e15, "1e+15"), (float("inf"), "inf")],
)  # fmt: skip
def test_a_large_number_has_no_exponent(value: float, text: str) -> None:
    assert console.rows({"clock_offset_ms": value}) == {"clock_offset_ms": text}
