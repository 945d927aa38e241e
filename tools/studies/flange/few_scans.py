"""Errors of calibrations from few scans: random draws of a recorded dataset, judged on the scans that were not drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn, calibrate_from_few
from weldcal.calibration.eye_on_base.scanner_model import ScannerCorrection
from weldcal.calibration.eye_on_base.self_calibration import apply_self_calibration
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.studies.flange.ingredients import median_sigma, usable_scans

Array = NDArray[np.float64]

SIZES = (1, 2, 3, 4, 6, 8, 12)
KEPT = 4  # scans that at least are left to judge by


@dataclass(frozen=True)
class Draws:
    """Calibrations from ``scans`` random scans each: median error (m) and tilt (rad; NaN where no normals are known) of every draw on
    the scans that it did not use, how many were refused, and the share of the others that corrected the scanner."""

    scans: int
    position_m: Array
    tilt_rad: Array
    refused: int
    corrected: float

    def median_sigma_m(self, seed: int = 0) -> float:
        """How well so many draws tell their median (bootstrap standard deviation, m); that all are of the same scans is not in it."""
        return median_sigma(self.position_m, seed)


def study_few_scans(
    folder: Path, draws: int = 60, seed: int = 0, sizes: Sequence[int] = SIZES, progress: Progress = no_progress
) -> list[Draws]:
    """One row a size, as far as KEPT scans remain. From one scan the pose rests on the turn of the drilled holes about the flange's axis,
    which a calibration from all scans told before. Raises InputError for a folder that is none, TooFewPoses where nothing remains."""
    refusal = f"Draws need {ENOUGH + KEPT} usable scans and more"
    good, patterns, X_rough = usable_scans(folder, ENOUGH + KEPT, refusal, seed, progress, 0.3, allow_coplanar=True)
    turn = axis_turn(good, patterns, X_rough)[0] if any(o.id in patterns for o in good) else None
    sizes = [n for n in sizes if n <= len(good) - KEPT and (n > 1 or turn is not None)]
    rng = np.random.default_rng(seed)
    rows = []
    for k, n in enumerate(sizes):
        errors, tilts, corrected = [], [], 0
        first = [i for i, o in enumerate(good) if n > 1 or o.id in patterns]
        for d in range(draws):
            progress(f"{n} scans", 0.3 + 0.7 * (k + d / draws) / len(sizes))
            drawn = set(rng.choice(first, n, replace=False).tolist())
            used, kept = ([o for i, o in enumerate(good) if (i in drawn) == mine] for mine in (True, False))
            try:
                X, correction = _calibrated(used, patterns, turn, seed)
            except InputError:
                continue
            judged = [correction.observation(o) for o in kept]
            errors.append(float(np.median(position_errors(X, judged))))
            tilt = tilt_errors(X, judged)
            tilts.append(float(np.median(tilt[np.isfinite(tilt)])) if np.isfinite(tilt).any() else float("nan"))
            corrected += correction != ScannerCorrection()
        rows.append(Draws(n, np.array(errors), np.array(tilts), draws - len(errors), corrected / max(len(errors), 1)))
    return rows


def _calibrated(
    used: list[Observation], patterns: Mapping[str, HolePattern], turn: float | None, seed: int
) -> tuple[RigidTransform, ScannerCorrection]:
    """As `weldcal calibrate` does it with so many."""
    if len(used) < ENOUGH:
        alone = len(used) == 1
        return calibrate_from_few(used, patterns, turn if alone else None, seed=seed).X_BC, ScannerCorrection()
    rigid = estimate_eye_on_base(used, SolveConfig(seed=seed, allow_coplanar=True))
    scanner, _, estimate = apply_self_calibration(used, rigid, patterns, seed=seed)
    accepted = None if scanner is None else scanner.accepted
    return estimate.X_BC, ScannerCorrection() if accepted is None else accepted
