"""Calibrations from few of the recorded scans, judged on the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from tests.figures.harness import Run, figure
from tests.places import SHARED_DATA
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import statistics
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn, calibrate_from_few
from weldcal.calibration.eye_on_base.joint_fit import solve_jointly
from weldcal.calibration.eye_on_base.observations import fit_flanges
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.render import fixed

SIZES = (1, 2, 3, 4, 6, 8, 12)
KEPT = 4  # scans that at least are left to judge by
_DRAWS = 2000


def median_sigma(values: Array, seed: int = 0) -> float:
    """Return the bootstrap standard deviation of the median of values (n,)."""
    draws = np.random.default_rng(seed).choice(values, (_DRAWS, len(values)))
    return float(np.median(draws, axis=1).std())


def usable_scans(
    folder: Path, least: int, refusal: str, seed: int, progress: Progress, share: float, *, allow_coplanar: bool = False
) -> tuple[list[Observation], dict[str, HolePattern], RigidTransform]:
    """Observations of a dataset without outliers, the hole patterns by their ids, and a rough X_BC.

    Raises InputError for a folder that is no dataset, TooFewPoses with `refusal` below `least` scans.
    """
    data = load_dataset(folder)
    standard = get_flange(data.header.flange)
    seen = fit_flanges(data, standard, seed=seed, tell=lambda done: progress("fitting flanges", share * done))
    if len(seen.observations) < least:
        raise TooFewPoses(f"{refusal}, and there are {len(seen.observations)}.")
    config = SolveConfig(seed=seed, allow_coplanar=allow_coplanar, leave_one_out=False)
    rough = estimate_eye_on_base(seen.observations, config)
    good = [o for o, keep in zip(seen.observations, rough.inliers, strict=True) if keep]
    return good, dict(seen.patterns), rough.X_BC


@dataclass(frozen=True)
class Draws:
    """Calibrations from ``scans`` random scans each: median error (m) and tilt (rad) on the unused scans.

    NaN where no normals are known; how many were refused, and the share of the others that corrected the scanner.
    """

    scans: int
    position_m: Array
    tilt_rad: Array
    refused: int
    corrected: float


def study_few_scans(
    folder: Path, draws: int = 60, seed: int = 0, sizes: Sequence[int] = SIZES, progress: Progress = no_progress
) -> list[Draws]:
    """Return one row a size, as long as KEPT scans remain.

    From one scan the pose rests on the turn of the drilled holes about the flange's axis, which is known from a
    calibration with all scans. Raises InputError for a folder that is none, TooFewPoses where nothing remains.
    """
    refusal = f"Draws need {ENOUGH + KEPT} usable scans and more"
    good, patterns, X_rough = usable_scans(folder, ENOUGH + KEPT, refusal, seed, progress, 0.3, allow_coplanar=True)
    known = any(o.id in patterns and patterns[o.id].turn_known for o in good)
    turn = axis_turn(good, patterns, X_rough)[0] if known else None
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
            judged = [corrected_observation(correction, o) for o in kept]
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
    return solve_jointly(used, patterns, seed=seed)


@figure("flange-few", "calibrations from few of the recorded scans, judged on the scans that were not used")
def few(run: Run) -> None:
    """Calibrate from 1, 2, 3, 4, 6, 8 or 12 scans of the AUBO, or of the dataset --data."""
    folder = run.data or SHARED_DATA / "flange" / "aubo_i5_phoxi_s"
    rows = []
    for r in study_few_scans(folder, run.size(6, 60), run.seed, progress=run.progress):
        if len(r.position_m) > 1:
            of = statistics(1e3 * r.position_m, "median", "p95")
            median = f"{of['median']:.3f} ± {1e3 * median_sigma(r.position_m):.3f}"
            tilt = fixed(float(np.degrees(np.median(r.tilt_rad))), 3)
            rows.append((str(r.scans), median, f"{of['p95']:.3f}", tilt, f"{100 * r.corrected:.0f} %", str(r.refused)))
    run.table("", ("scans", "median mm", "95 % mm", "tilt deg", "scanner corrected", "draws refused"), rows)
