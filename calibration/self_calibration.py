"""The scanner's own scale error, from the robot's motion and from the flange's hole circle; believed where they agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.stats import chi2

from weldcal.calibration.holes import HolePattern
from weldcal.calibration.observation import Observation
from weldcal.calibration.rigid import exp_rotation, skew
from weldcal.calibration.scanner_model import ScannerCorrection
from weldcal.calibration.solve import CalibrationEstimate, HeldOut, SolveConfig, estimate_eye_on_base
from weldcal.calibration.validation import position_errors, tilt_errors
from weldcal.models.errors import InputError

Array = NDArray[np.float64]

_LEAST_POSES = 8  # nine unknowns, and as many held-out errors as make a comparison
_LEAST_PATTERNS = 6
_FEWEST_PATTERNS = 3  # below eight poses, where the hole circle alone decides
_FEW_RATIO_SIGMA = 1.2e-3  # of one hole circle's size
_USUAL = np.array([2e-3, 1.5e-2, 1.5e-2])  # what scanners are off in scale and gradient (1/m)
_STARTS = 30  # random starts of an estimate: these sightings are cleared of gross outliers
_BLIND_SCALE = 2e-3  # a scale known worse than this is as good as unknown: scanners are right to 0.2 %
_BLIND_GRADIENT = 2e-2
# how far a hole circle may differ from what motion shows: the maker's pitch circle is trusted to 25 micrometres on 50 mm,
# and a circle sees a distortion of higher order in one place, motion sees it over the whole field
_CIRCLE_OWN = np.array([5e-4, 3e-3, 3e-3])
_RATIO_SIGMA, _RATIO_DOF = 1e-3, 6.0  # what is expected of a hole circle's size before any is seen, and its weight
_EVIDENT = 0.999  # probability that the correction is not zero by chance
_CONTRADICT = 0.99  # probability beyond which two sources that differ so much do contradict each other
_GAIN = 0.95  # of the held-out error that must be left at most: a correction that gains less is not worth its unknowns


@dataclass(frozen=True, eq=False)
class CorrectionEstimate:
    """A correction and the covariance (3, 3) of (scale, gx, gy), in 1 and 1/m."""

    correction: ScannerCorrection
    covariance: Array

    @property
    def values(self) -> Array:
        """(scale, gx, gy)."""
        return np.array([self.correction.scale, *self.correction.gradient_per_m])

    @property
    def sigma(self) -> Array:
        """One standard deviation of (scale, gx, gy)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """The verdict. ``accepted`` is None where the scanner is taken as it is; ``sentence`` says why, or what was found;
    ``worth_saying`` where a reader of the result should know it. ``held_out_m`` and ``held_out_tilt_rad`` (n,) are errors
    of each pose under a correction and a calibration that never saw it; NaN where they were not needed."""

    accepted: ScannerCorrection | None
    motion: CorrectionEstimate | None
    holes: CorrectionEstimate | None
    held_out_m: Array
    held_out_tilt_rad: Array
    sentence: str
    worth_saying: bool


def self_calibrate(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    rigid_held_out_m: Array,
    *,
    seed: int = 0,
) -> SelfCalibration:
    """Decide on a scanner correction from good sightings (n) and the hole patterns seen in them (by id).

    It is accepted only if robot motion and hole circle each determine it and do not contradict each other, if it is
    not zero by chance, and if errors on poses that neither correction nor calibration saw fall below
    ``rigid_held_out_m`` (n,), those of the calibration without it. Deterministic for ``seed``. Raises nothing for data
    that decide nothing: the sentence says what they lack.
    """
    n = len(observations)
    nothing = np.full(n, np.nan)

    def refused(why: str, said: bool = False) -> SelfCalibration:
        return SelfCalibration(None, motion, holes, nothing, nothing, why, said)

    motion: CorrectionEstimate | None = None
    holes: CorrectionEstimate | None = None
    if n < _LEAST_POSES:
        few = _from_few(observations, patterns, rigid_held_out_m, seed)
        if few is not None:
            return few
        return refused(f"No scanner correction: {n} poses do not determine one; take {_LEAST_POSES} or more.")
    motion = from_motion(observations, {}, seed=seed)
    if motion.sigma[0] > _BLIND_SCALE or float(motion.sigma[1:].max()) > _BLIND_GRADIENT:
        return refused(
            "No scanner correction: the positions vary too little for one (its scale would be known to "
            f"{1e2 * motion.sigma[0]:.2f} %); spread the poses over the field of view and in depth."
        )
    holes = from_holes(observations, patterns)
    asked = f"the robot's motion asks for a scale of {_percent(motion)}"
    if holes is None:
        evident = _distance(motion.values, motion.covariance) > _EVIDENT
        return refused(
            f"No scanner correction: {asked}, but the flange's hole circle is not seen in enough scans to confirm it.",
            evident,
        )
    both = f"{asked}, the flange's hole circle for {_percent(holes)}"
    difference = motion.values - holes.values
    spread = motion.covariance + holes.covariance + np.diag(_CIRCLE_OWN**2)
    if float(chi2.cdf(difference @ np.linalg.solve(spread, difference), 3)) > _CONTRADICT:
        return refused(f"No scanner correction: {both}; they contradict each other.", True)
    together = from_motion(observations, patterns, seed=seed)
    if _distance(together.values, together.covariance) < _EVIDENT:
        return refused(f"No scanner correction is needed: {both}, which may be chance.")
    held_out, tilt = _held_out(observations, patterns, seed)
    known = np.isfinite(held_out) & np.isfinite(rigid_held_out_m)
    before, after = (float(np.mean(e[known])) if known.any() else np.nan for e in (rigid_held_out_m, held_out))
    if not after < _GAIN * before:
        return refused(
            f"No scanner correction: {both}, but held-out errors do not fall with one (mean {1e3 * before:.3f} mm without,"
            f" {1e3 * after:.3f} mm with).",
            True,
        )
    return SelfCalibration(
        together.correction,
        motion,
        holes,
        held_out,
        tilt,
        f"The scanner is corrected: {both}; held-out errors fall from {1e3 * before:.3f} to {1e3 * after:.3f} mm (mean). "
        "X_BC belongs to scans that are corrected so.",
        True,
    )


def from_few_holes(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern]
) -> CorrectionEstimate | None:
    """Correction from the hole circles of few scans, held towards none by what scanners are usually off; None below three."""
    A, ratio = _circles([patterns[o.id] for o in observations if o.id in patterns])
    if len(ratio) < _FEWEST_PATTERNS:
        return None
    inverse = np.linalg.inv(A.T @ A / _FEW_RATIO_SIGMA**2 + np.diag(1.0 / _USUAL**2))
    v = inverse @ (A.T @ (1.0 / ratio - 1.0)) / _FEW_RATIO_SIGMA**2
    return CorrectionEstimate(_correction(v), np.asarray(inverse))


def _from_few(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], rigid_held_out_m: Array, seed: int
) -> SelfCalibration | None:
    """The verdict below eight poses: the hole circles alone, believed where errors at poses left out of correction and
    calibration fall; None where they do not."""
    holes = from_few_holes(observations, patterns)
    n = len(observations)
    if holes is None or n < 4:
        return None
    errors, tilts = np.full((2, n), np.nan)
    config = SolveConfig(seed=seed, leave_one_out=False, hypotheses=_STARTS, min_poses=3, allow_coplanar=True)
    for i, o in enumerate(observations):
        rest = [other for other in observations if other is not o]
        found = from_few_holes(rest, patterns)
        correction = ScannerCorrection() if found is None else found.correction
        try:
            X = estimate_eye_on_base([correction.observation(other) for other in rest], config).X_BC
        except InputError:
            return None
        seen = [correction.observation(o)]
        errors[i], tilts[i] = float(position_errors(X, seen)[0]), float(tilt_errors(X, seen)[0])
    before, after = float(np.mean(rigid_held_out_m)), float(np.mean(errors))
    if not after < _GAIN * before:
        return None
    return SelfCalibration(
        holes.correction,
        None,
        holes,
        errors,
        tilts,
        f"The scanner is corrected by the flange's hole circle alone, as {n} poses are too few for the robot's motion to "
        f"confirm it: {_percent(holes)}; held-out errors fall from {1e3 * before:.3f} to {1e3 * after:.3f} mm (mean). X_BC "
        "belongs to scans that are corrected so.",
        True,
    )


def apply_self_calibration(
    observations: list[Observation],
    rigid: CalibrationEstimate,
    patterns: Mapping[str, HolePattern],
    *,
    seed: int = 0,
    wanted: bool = True,
) -> tuple[SelfCalibration | None, list[Observation], CalibrationEstimate]:
    """The verdict on the scanner (None where it is not ``wanted``), the sightings as corrected by it, and their estimate.

    ``rigid`` is the estimate without a correction. Held-out errors of the one returned come from corrections, too, that
    never saw the pose; its covariance is that of X_BC for the correction as it is.
    """
    if not wanted:
        return None, observations, rigid
    good = [o for o, keep in zip(observations, rigid.inliers, strict=True) if keep]
    scanner = self_calibrate(good, patterns, rigid.held_out.position_m[rigid.inliers], seed=seed)
    if scanner.accepted is None:
        return scanner, observations, rigid
    corrected = [scanner.accepted.observation(o) for o in observations]
    estimate = estimate_eye_on_base(corrected, SolveConfig(seed=seed))
    position, tilt = estimate.held_out.position_m.copy(), estimate.held_out.tilt_rad.copy()
    position[rigid.inliers], tilt[rigid.inliers] = scanner.held_out_m, scanner.held_out_tilt_rad
    return scanner, corrected, replace(estimate, held_out=HeldOut(position, tilt))


def from_motion(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], *, seed: int = 0
) -> CorrectionEstimate:
    """Correction and camera pose that together bring sightings (n >= 4) and robot poses to agree; with ``patterns``, the
    hole circles to their nominal size as well.

    The sightings are cleared of gross outliers. Gauss-Newton over nine unknowns, reweighted (soft L1 beyond two sigma);
    each kind of datum counts by its own spread, found from the residuals. Raises what estimate_eye_on_base raises.
    """
    rigid = estimate_eye_on_base(tuple(observations), SolveConfig(seed=seed, leave_one_out=False, hypotheses=_STARTS))
    c = np.array([o.p_CR for o in observations])
    b = np.array([o.p_BR for o in observations])
    has = np.array([o.n_C is not None for o in observations])
    m = np.array([o.n_C for o in observations if o.n_C is not None]).reshape(-1, 3)
    z = np.array([o.n_B for o in observations])[has]
    rows, ratio = _circles([patterns[o.id] for o in observations if o.id in patterns])
    sigma_p, sigma_n = max(rigid.sigma_position_m, 1e-6), max(rigid.sigma_normal_rad, 1e-6)
    sigma_r = _ratio_sigma(rows, ratio)
    size = 12 if len(ratio) else 9  # with circles: three for what is their own, see _CIRCLE_OWN
    prior = np.zeros(size)
    prior[6:9] = 1.0 / np.array([0.03, 0.3, 0.3])  # keeps poses on one spot solvable
    prior[9:] = 1.0 / _CIRCLE_OWN[: size - 9]
    R, p = rigid.X_BC.rotation().matrix(), np.asarray(rigid.X_BC.translation())
    pivot = b.mean(axis=0)
    change = np.zeros(size - 6)  # of scale and gradient, then the circles' own
    dof = max(1.0 - 9.0 / (3 * len(b) + 2 * len(m)), 0.1)
    information = np.eye(size)
    for k in range(40):
        correction = _correction(change[:3])
        q = correction.points(c) @ R.T + p
        e_p = q - b
        J_p = np.zeros((len(b), 3, size))
        J_p[:, :, :3], J_p[:, :, 3:6] = -skew(q - pivot), np.eye(3)
        J_p[:, :, 6:9] = (c @ R.T)[:, :, None] * np.column_stack([np.ones(len(c)), c[:, :2]])[:, None]
        e_n, J_n = _normal_rows(correction, c[has], m, z, R, size)
        own = change[3:] if len(ratio) else np.zeros(3)
        values = np.array([correction.scale, *correction.gradient_per_m])
        e_r = ratio * (rows @ values) - 1.0 - rows @ own
        J_r = np.hstack(
            [np.zeros((len(ratio), 6)), ratio[:, None] * rows, *([-rows] if len(ratio) else [np.zeros((0, 0))])]
        )
        if k in (4, 8):  # robust spreads of what nine unknowns leave
            sigma_p = max(_spread(e_p.ravel(), 3 * len(b)) / np.sqrt(dof), 1e-6)
            sigma_n = max(_spread(e_n.ravel(), 2 * len(m)) / np.sqrt(dof), 1e-6)
        J = np.vstack([J_p.reshape(-1, size) / sigma_p, J_n.reshape(-1, size) / sigma_n, J_r / sigma_r])
        e = np.concatenate([e_p.ravel() / sigma_p, e_n.ravel() / sigma_n, e_r / sigma_r])
        w = 1.0 / np.sqrt(1.0 + (e / 2.0) ** 2)
        information = J.T @ (w[:, None] * J) + np.diag(prior**2)
        unknown = np.concatenate([np.zeros(6), change])
        step = -np.linalg.solve(information, J.T @ (w * e) + prior**2 * unknown)
        dR = exp_rotation(step[:3]).matrix()
        R, p = dR @ R, dR @ (p - pivot) + pivot + step[3:6]
        change = change + step[6:]
        if k > 9 and float(np.linalg.norm(step)) < 1e-9:
            break
    return CorrectionEstimate(
        _correction(change[:3]), np.asarray(np.linalg.inv(information)[6:9, 6:9], dtype=np.float64)
    )


def _normal_rows(
    correction: ScannerCorrection, c: Array, m: Array, z: Array, R: Array, size: int
) -> tuple[Array, Array]:
    """Tilts (n, 3) of seen against stated normals, and their derivative (n, 3, size) by rotation and correction."""
    seen = correction.normals(c, m) @ R.T
    across = np.eye(3) - z[:, :, None] * z[:, None]
    J = np.zeros((len(z), 3, size))
    J[:, :, :3] = -skew(seen)
    for k, h in enumerate((1e-4, 1e-3, 1e-3)):
        step = np.zeros(3)
        step[k] = h
        values = np.array([correction.scale - 1.0, *correction.gradient_per_m]) + step
        J[:, :, 6 + k] = (_correction(values).normals(c, m) @ R.T - seen) / h
    return np.einsum("nij,nj->ni", across, seen - z), np.einsum("nij,njk->nik", across, J)


def from_holes(observations: Sequence[Observation], patterns: Mapping[str, HolePattern]) -> CorrectionEstimate | None:
    """Correction from the size of the hole circles alone, without the robot; None for fewer than six of them."""
    A, ratio = _circles([patterns[o.id] for o in observations if o.id in patterns])
    if len(ratio) < _LEAST_PATTERNS:
        return None
    # 1 / ratio is the stretch asked for; a weak prior holds a gradient that no circle shows
    prior = np.diag(1.0 / np.array([0.03, 0.3, 0.3]) ** 2)
    sigma = _ratio_sigma(A, ratio)
    inverse = np.linalg.inv(A.T @ A / sigma**2 + prior)
    v = inverse @ (A.T @ (1.0 / ratio - 1.0)) / sigma**2
    return CorrectionEstimate(_correction(v), np.asarray(inverse))


def _held_out(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], seed: int
) -> tuple[Array, Array]:
    """Errors (n,) m and tilts (n,) rad of each pose under correction and calibration made without it."""
    errors, tilts = np.full((2, len(observations)), np.nan)
    for i, o in enumerate(observations):
        rest = [other for other in observations if other is not o]
        try:
            X, correction = calibrate_corrected(rest, patterns, seed=seed)
        except InputError:
            continue
        seen = [correction.observation(o)]
        errors[i], tilts[i] = float(position_errors(X, seen)[0]), float(tilt_errors(X, seen)[0])
    return errors, tilts


def calibrate_corrected(
    observations: Sequence[Observation], patterns: Mapping[str, HolePattern], *, seed: int = 0
) -> tuple[RigidTransform, ScannerCorrection]:
    """Correction and camera pose from the same sightings, undecided: for cross-validation."""
    correction = from_motion(observations, patterns, seed=seed).correction
    corrected = [correction.observation(o) for o in observations]
    estimate = estimate_eye_on_base(corrected, SolveConfig(seed=seed, leave_one_out=False, hypotheses=_STARTS))
    return estimate.X_BC, correction


def _correction(change: Array) -> ScannerCorrection:
    limited = np.clip(change, -0.05, 0.05)
    return ScannerCorrection(1.0 + float(limited[0]), (float(change[1]), float(change[2])))


def _circles(patterns: Sequence[HolePattern]) -> tuple[Array, Array]:
    """Of k hole circles: derivative (k, 3) of their stretch by (scale, gx, gy), and measured over nominal size (k,).

    The stretch of a small circle is half the trace of the correction's derivative in the circle's plane.
    """
    c = np.array([p.center_C for p in patterns]).reshape(-1, 3)
    n = np.array([p.X_CR.rotation().matrix()[:, 2] for p in patterns]).reshape(-1, 3)
    in_plane = c - (c * n).sum(axis=1, keepdims=True) * n
    slope = np.stack([np.eye(3)[k] - n[:, k : k + 1] * n for k in (0, 1)], axis=1)
    bend = 0.5 * np.einsum("nki,ni->nk", slope, in_plane)
    return np.column_stack([np.ones(len(c)), c[:, :2] + bend]), np.array([p.ratio for p in patterns])


def _ratio_sigma(rows: Array, ratio: Array) -> float:
    """Spread of the measured sizes of hole circles about the best correction for them alone, and what is expected of
    it."""
    square, dof = 0.0, 0
    if len(ratio) > 3:
        left = 1.0 / ratio - rows @ np.linalg.lstsq(rows, 1.0 / ratio, rcond=1e-6)[0]
        square, dof = float((left**2).sum()), len(ratio) - 3
    return float(np.sqrt((square + _RATIO_DOF * _RATIO_SIGMA**2) / (dof + _RATIO_DOF)))


def _spread(e: Array, count: int) -> float:
    """Standard deviation of residuals, half of it from their middle: a few wild ones do not set it."""
    if count == 0:
        return 1.0
    limit = 4.0 * 1.4826 * float(np.median(np.abs(e)))
    return float(np.sqrt((np.minimum(np.abs(e), limit) ** 2).sum() / count))


def _distance(values: Array, covariance: Array) -> float:
    """Probability that a correction is not zero by chance."""
    v = values - np.array([1.0, 0.0, 0.0])
    return float(chi2.cdf(v @ np.linalg.solve(covariance, v), 3))


def _percent(e: CorrectionEstimate) -> str:
    gx, gy = (10.0 * g for g in e.correction.gradient_per_m)  # per cent per 100 mm
    return f"{1e2 * (e.correction.scale - 1.0):+.2f} % ({gx:+.2f} and {gy:+.2f} % per 100 mm along x and y)"
