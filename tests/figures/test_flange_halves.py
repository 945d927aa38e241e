"""Random halves of recorded scans judge each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.figures.flange.recorded import usable_scans
from tests.places import SHARED_DATA, needs
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, solve_jointly
from weldcal.calibration.eye_on_base.solve import SolveConfig
from weldcal.calibration.eye_on_base.validation import mean_interval, position_errors
from weldcal.models.errors import InputError
from weldcal.systems.runner import no_progress

FLANGE = SHARED_DATA / "flange"
pytestmark = needs(FLANGE)

LEAST_HALVES = 16
"""Scans of a recording from which on its halves are calibrated; eight are the least with a choice of the scanner's
correction."""


def study_halves(folder: Path, draws: int = 20, seed: int = 0) -> dict[str, Any]:
    """Calibrate from ``draws`` random halves of a dataset, choices included, and measure on the others.

    Deterministic for ``seed``.

    Returns means of the stated held-out error and of the error on the other half (mm), how many of the latter lie in
    the interval (95 %) that the first half states, and how many halves fixed no calibration (``skipped``).

    Raises InputError for a folder that is none, TooFewPoses for fewer than sixteen usable scans.
    """
    good, patterns, _ = usable_scans(
        folder, LEAST_HALVES, f"Halves need {LEAST_HALVES} usable scans and more", seed, no_progress, 0.1
    )
    half, rows, skipped = len(good) // 2, [], 0
    for k in range(draws):
        order = np.random.default_rng([seed, k]).permutation(len(good))
        ours, others = ([good[i] for i in part] for part in (order[:half], order[half:]))
        try:
            X_BC, correction = solve_jointly(ours, patterns, seed=seed)
            new_scans = [corrected_observation(correction, o) for o in others]
            config = SolveConfig(seed=seed, allow_coplanar=True)
            errors = estimate_jointly(ours, patterns, config=config)[0].held_out.position_m
        except InputError:
            skipped += 1
            continue
        interval = mean_interval(errors)
        new = float(np.mean(position_errors(X_BC, new_scans)))
        within = interval is not None and interval[0] < new < interval[1]
        rows.append((float(np.nanmean(errors)), new, float(within)))
    table = np.array(rows).reshape(-1, 3)
    stated, new = (float(1e3 * table[:, k].mean()) if len(table) else float("nan") for k in (0, 1))
    inside = int(table[:, 2].sum())
    return {"draws": draws, "scans": half, "stated_mm": stated, "new_mm": new, "inside": inside, "skipped": skipped}


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
