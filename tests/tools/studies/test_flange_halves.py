"""Random halves of recorded scans judge each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.places import SHARED_DATA, needs
from weldcal.calibration.errors import TooFewPoses
from weldcal.tools.studies.flange.recorded import study_halves

FLANGE = SHARED_DATA / "flange"
pytestmark = needs(FLANGE)


def test_the_other_half_is_as_wrong_as_stated() -> None:
    found = study_halves(FLANGE / "aubo_i5_phoxi_s", draws=3, seed=1)
    assert found["scans"] == 9
    assert found["skipped"] == 0
    # three means of nine errors each know theirs to 10 %, and so do the stated ones
    assert found["new_mm"] == pytest.approx(found["stated_mm"], rel=0.45)
    assert found["inside"] >= 2


def test_a_few_scans_have_no_halves(tmp_path: Path) -> None:
    with pytest.raises(TooFewPoses, match="Halves need 16"):
        study_halves(FLANGE / "franka_phoxi_m")
