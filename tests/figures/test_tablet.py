"""The tablet study: the sign of Eq. 20, and the slip in Table 8."""

from __future__ import annotations

import numpy as np
import pytest

from tests.figures.tablet.reproduce import compare_signs, dh_by_eq_20
from tests.worlds.tablet import published_touches
from weldcal.calibration.tablet.published import Sign

GATE_MM = 0.0015  # half the last printed digit is 0.005


def test_the_printed_sign_is_worse_than_no_correction() -> None:
    printed, none, corrected = compare_signs(published_touches())
    assert (printed.sign, none.sign, corrected.sign) == (Sign.PRINTED, Sign.NONE, Sign.CORRECTED)
    assert corrected.scaled_mm < 0.6 * none.scaled_mm < none.scaled_mm < 0.7 * printed.scaled_mm
    # reading the hand in whole millimetres leaves 1 / sqrt(12) per axis, less six unknowns of eighteen equations
    assert corrected.scaled_mm <= np.sqrt(1.0 / 12.0 * 12.0 / 18.0)
    assert printed.left_out_mm > none.left_out_mm > corrected.left_out_mm


def test_table_8_holds_only_with_the_translation_added_to_a_difference() -> None:
    slip, written, optimum = dh_by_eq_20(published_touches()).values()
    assert pytest.approx(7.11, abs=0.005) == slip.F
    assert written.f2 == pytest.approx(94.2, abs=0.05)
    assert pytest.approx(7.4675, abs=GATE_MM) == optimum.F
