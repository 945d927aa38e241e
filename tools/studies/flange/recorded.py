"""Calibrations of recorded scans: the worth of each ingredient, and the errors with few scans."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from scipy.stats import chi

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.corrected_estimate import apply_self_calibration
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn, calibrate_from_few
from weldcal.calibration.eye_on_base.observations import corrected_observation, see_flanges
from weldcal.calibration.eye_on_base.scanner_fit import from_holes, from_motion
from weldcal.calibration.eye_on_base.self_calibration import held_out_errors
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors, tilt_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.systems.runner import Progress, no_progress

LEAST = 12
SIZES = (1, 2, 3, 4, 6, 8, 12)
KEPT = 4  # scans that at least are left to judge by
_DRAWS = 2000


@dataclass(frozen=True)
class Ingredient:
    """One way to calibrate, every scan left out in turn: errors (n,) m and tilts (n,) rad; ``floor_m`` is the median error that the
    spread of arm and scanner about this model leaves even where it is known exactly."""

    name: str
    position_m: Array
    tilt_rad: Array
    floor_m: float

    def median_sigma_m(self, seed: int = 0) -> float:
        """How well so many errors tell their median (bootstrap standard deviation, m)."""
        return median_sigma(self.position_m, seed)


def median_sigma(values: Array, seed: int) -> float:
    """Bootstrap standard deviation of the median of values (n,)."""
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
    seen = see_flanges(data, standard, seed=seed, tell=lambda done: progress("fitting flanges", share * done))
    if len(seen.observations) < least:
        raise TooFewPoses(f"{refusal}, and there are {len(seen.observations)}.")
    config = SolveConfig(seed=seed, allow_coplanar=allow_coplanar, leave_one_out=False)
    rough = estimate_eye_on_base(seen.observations, config)
    good = [o for o, keep in zip(seen.observations, rough.inliers, strict=True) if keep]
    return good, dict(seen.patterns), rough.X_BC


def study_ingredients(folder: Path, seed: int = 0, progress: Progress = no_progress) -> list[Ingredient]:
    """Step by step on one dataset of scans. Raises InputError for a folder that is none, TooFewPoses below twelve usable scans."""
    refusal = f"The comparison leaves every scan out in turn: it needs {LEAST} usable scans"
    good, patterns, _ = usable_scans(folder, LEAST, refusal, seed, progress, 0.5)
    if len(good) < LEAST:
        raise TooFewPoses(f"{refusal}, and there are {len(good)}.")
    rows = []
    for k, (name, normals) in enumerate((("centres, scanner as it is", False), ("and face normals", True))):
        progress(name, 0.5 + 0.05 * k)
        config = SolveConfig(seed=seed, use_normals=normals)
        e = estimate_eye_on_base(good, config)
        tilt = e.held_out.tilt_rad if normals else _tilts(good, config)
        rows.append(Ingredient(name, e.held_out.position_m, tilt, _floor(e.sigma_position_m)))
    progress("hole circle alone", 0.6)
    if from_holes(good, patterns) is not None:
        rows.append(_holes_alone(good, patterns, seed))
    names = ("scale and gradient, hole circle and motion", "and bends of order 2", "and bends of order 3")
    for order, name in enumerate(names, 1):
        progress(name, 0.55 + 0.12 * order)
        position, tilt = held_out_errors(good, patterns, seed, order)
        sigma = from_motion(good, patterns, seed=seed, order=order, usual=True).sigma_position_m
        rows.append(Ingredient(name, position, tilt, _floor(sigma)))
    return rows


def _floor(sigma_m: float) -> float:
    return float(sigma_m * chi.median(3))


def _tilts(good: Sequence[Observation], config: SolveConfig) -> Array:
    """Held-out tilts of calibrations by centres alone."""
    once = SolveConfig(seed=config.seed, use_normals=False, leave_one_out=False)
    return np.array(
        [float(tilt_errors(estimate_eye_on_base([p for p in good if p is not o], once).X_BC, [o])[0]) for o in good]
    )


def _holes_alone(good: Sequence[Observation], patterns: Mapping[str, HolePattern], seed: int) -> Ingredient:
    """The correction from the hole circle, no robot in it; then as with an exact scanner."""
    config = SolveConfig(seed=seed, leave_one_out=False)
    errors, tilts = np.full((2, len(good)), np.nan)
    sigma = 0.0
    for k, o in enumerate(good):
        rest = [p for p in good if p is not o]
        found = from_holes(rest, patterns)
        correction = ScannerCorrection() if found is None else found.correction
        e = estimate_eye_on_base([corrected_observation(correction, p) for p in rest], config)
        seen = [corrected_observation(correction, o)]
        errors[k], tilts[k] = float(position_errors(e.X_BC, seen)[0]), float(tilt_errors(e.X_BC, seen)[0])
        sigma += e.sigma_position_m / len(good)
    return Ingredient("scale and gradient, hole circle alone", errors, tilts, _floor(sigma))


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
    which is known from a calibration with all scans. Raises InputError for a folder that is none, TooFewPoses where nothing remains."""
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
    rigid = estimate_eye_on_base(used, SolveConfig(seed=seed, allow_coplanar=True))
    scanner, _, estimate = apply_self_calibration(used, rigid, patterns, seed=seed, nested=False)
    accepted = None if scanner is None else scanner.accepted
    return estimate.X_BC, ScannerCorrection() if accepted is None else accepted
