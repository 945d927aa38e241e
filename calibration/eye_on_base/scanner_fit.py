"""Fits a scanner correction to observations of the flange, from the robot's motion and from the hole circles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import (
    LARGEST,
    LOOSE,
    TERMS,
    ScannerCorrection,
    correction_of,
    expected_factors,
)
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import MAD, chi2_share, cross_rows, rotation_of
from weldcal.calibration.geometry.se3 import skew
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

LEAST_PATTERNS = 6
STARTS = 30  # random starts of an estimate: these observations are cleared of gross outliers
_MARGIN_M = 0.03  # a face reaches so far about its centre: there, too, a bend was seen
_USUAL_SPREAD_M = 1e-4  # a choice: between a good arm (0.05 mm) and the recorded ones (0.15 mm); it only weighs scans
# how far a hole circle may differ from what motion shows: the maker's pitch circle is trusted to 25 micrometres on 50
# mm, and a circle sees a distortion of higher order in one place, motion sees it over the whole field
CIRCLE_OWN = np.array([5e-4, 3e-3, 3e-3])
_RATIO_SIGMA, _RATIO_DOF = 1e-3, 6.0  # what is expected of a hole circle's size before any is seen, and its weight


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionEstimate:
    """A correction and the covariance (K, K) of its factors, in 1 and 1/m and so on.

    ``X_BC`` and ``joint`` (6 + K, 6 + K), where the robot's motion took part, are the camera's pose that goes with it
    and the covariance of both: rotation on the base side about the camera origin, its displacement, factors. The sigmas
    are the spread of positions and normals about them (per axis), ``redundancy`` how many spare numbers the former was
    found from.
    """

    correction: ScannerCorrection
    covariance: Array
    X_BC: RigidTransform | None = None
    joint: Array | None = None
    redundancy: float = 1e6
    sigma_position_m: float = 0.0
    sigma_normal_rad: float = 0.0

    @property
    def values(self) -> Array:
        """The factors (K,)."""
        return self.correction.values

    @property
    def sigma(self) -> Array:
        """One standard deviation of each."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def certainty(self) -> float:
        """Probability that the correction is not zero by chance."""
        v = self.values - np.eye(len(self.values))[0]
        return chi2_share(v @ np.linalg.solve(self.covariance, v), len(v))


def from_motion(
    observations: Sequence[Observation],
    patterns: Mapping[str, HolePattern],
    *,
    seed: int = 0,
    order: int = 1,
    usual: bool = False,
    start: RigidTransform | None = None,
) -> CorrectionEstimate:
    """Fit correction and camera pose together to observations (n >= 3) and robot poses.

    With ``patterns`` the hole circles' nominal size is fitted, too.

    The observations are cleared of gross outliers. ``order`` 1 to 3 is the highest power of x and y in the factor. With
    ``usual`` it is held to what scanners are usually off, which lets few poses say as much as they know. Gauss-Newton
    over the 9, 12 or 16 unknowns, reweighted (soft L1 beyond two sigma). Each kind of datum counts by its own spread,
    found from the residuals over its own redundancy. ``start`` is a camera pose near by, as from the same observations
    and one more: it saves the search for one. Raises TooFewPoses below three and, without ``start``, what
    estimate_eye_on_base raises.
    """
    if len(observations) < 3:
        raise TooFewPoses("A scanner correction needs at least three usable poses; add poses.")
    sigma_p, sigma_n = 1e-4, 1e-3
    if start is None:
        config = SolveConfig(seed=seed, leave_one_out=False, hypotheses=STARTS, min_poses=3, allow_coplanar=True)
        rigid = estimate_eye_on_base(tuple(observations), config)
        start, sigma_p, sigma_n = rigid.X_BC, max(rigid.sigma_position_m, 1e-6), max(rigid.sigma_normal_rad, 1e-6)
    c = np.array([o.p_CR for o in observations])
    b = np.array([o.p_BR for o in observations])
    has = np.array([o.n_C is not None for o in observations])
    m = np.array([o.n_C for o in observations if o.n_C is not None]).reshape(-1, 3)
    z = np.array([o.n_B for o in observations])[has]
    terms = TERMS[order]
    field = (
        *(c[:, 0].min() - _MARGIN_M, c[:, 0].max() + _MARGIN_M),
        *(c[:, 1].min() - _MARGIN_M, c[:, 1].max() + _MARGIN_M),
    )
    shape = correction_of(np.zeros(terms), field)
    rows, ratio = _circles([patterns[o.id] for o in observations if o.id in patterns], shape)
    # a scan that shows little of the flange counts for less: its own noise beside a usual spread of robot and scanner
    own_noise = np.array(
        [0.0 if o.center_covariance is None else np.trace(o.center_covariance) / 3.0 for o in observations]
    )
    vague = np.sqrt(1.0 + own_noise / _USUAL_SPREAD_M**2)
    sigma_r = _ratio_sigma(rows[:, :3], ratio)
    size = 6 + terms + (3 if len(ratio) else 0)  # with circles: three for what is their own, see CIRCLE_OWN
    prior = np.zeros(size)
    prior[6 : 6 + terms] = 1.0 / expected_factors(terms, float(np.median(c[:, 2])), usual)
    prior[6 + terms :] = 1.0 / CIRCLE_OWN[: size - 6 - terms]
    found = _gauss_newton(
        *(c, b, vague, shape.terms(c)),  # a correction is linear in its factors
        *(c[has], m, z, shape.terms(c[has]), shape.slopes(c[has])),
        *(rows, ratio, prior, start.rotation().matrix().copy(), np.array(start.translation())),
        *(sigma_p, sigma_n, sigma_r),
    )
    R, p, change, information, redundancy, sigma_p, sigma_n = found
    pivot = b.mean(axis=0)
    inverse = np.linalg.inv(information)[: 6 + terms, : 6 + terms]
    T = np.eye(6 + terms)
    T[3:6, :3] = -skew(p - pivot)
    X_BC = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
    joint: Array = np.asarray(T @ inverse @ T.T, dtype=np.float64)
    return CorrectionEstimate(
        correction=correction_of(change[:terms], field),
        covariance=joint[6:, 6:],
        X_BC=X_BC,
        joint=joint,
        redundancy=redundancy,
        sigma_position_m=float(sigma_p),
        sigma_normal_rad=float(sigma_n),
    )


def from_holes(observations: Sequence[Observation], patterns: Mapping[str, HolePattern]) -> CorrectionEstimate | None:
    """Correction from the size of the hole circles alone, without the robot; None for fewer than six of them."""
    A, ratio = _circles([patterns[o.id] for o in observations if o.id in patterns], ScannerCorrection())
    if len(ratio) < LEAST_PATTERNS:
        return None
    # 1 / ratio is the stretch asked for; a weak prior holds a gradient that no circle shows
    sigma = _ratio_sigma(A, ratio)
    inverse = np.linalg.inv(A.T @ A / sigma**2 + np.diag(1.0 / LOOSE**2))
    v = inverse @ (A.T @ (1.0 / ratio - 1.0)) / sigma**2
    return CorrectionEstimate(correction=correction_of(v), covariance=np.asarray(inverse))


@compiled()
def _gauss_newton(
    c: Array,
    b: Array,
    vague: Array,
    basis: Array,
    c_n: Array,
    m: Array,
    z: Array,
    basis_n: Array,
    slopes: Array,
    rows: Array,
    ratio: Array,
    prior: Array,
    R: Array,
    p: Array,
    sigma_p: float,
    sigma_n: float,
    sigma_r: float,
) -> tuple[Array, Array, Array, Array, float, float, float]:
    """Return the loop of from_motion.

    Pose, change of the unknowns after it, information, redundancy of positions, both sigmas.

    Centres c, b (n, 3) with ``vague`` (n,) and the correction's terms (n, K); of those with a normal m (h, 3), z (h, 3)
    in the base, their centres, terms and ``slopes`` (h, K, 2); of k hole circles rows (k, K) and ratio (k,). ``prior``
    (6 + K or 9 + K,) are inverse sigmas. A normal turns by the inverse transpose of the correction's derivative f 1 + c
    s'; its linear part at the identity is what a small change of a factor does.
    """
    n, h, k, terms, size = len(b), len(z), len(ratio), basis.shape[1], len(prior)
    own = size - 6 - terms
    pivot = np.array([b[:, 0].mean(), b[:, 1].mean(), b[:, 2].mean()])
    change = np.zeros(size - 6)
    redundancy = 1.0
    information = np.eye(size)
    J = np.zeros((3 * n + 3 * h + k, size))
    e = np.zeros(len(J))
    e_p, e_n, tilt, turn = np.zeros(3 * n), np.zeros(3 * h), np.zeros((3, size)), np.zeros(3)
    s, seen = np.zeros(3), np.zeros(3)
    for count in range(40):
        values = change[:terms].copy()
        values[0] = 1.0 + min(max(change[0], -LARGEST), LARGEST)
        for i in range(n):
            factor = basis[i] @ values
            q = R @ (factor * c[i]) + p
            a = q - pivot
            along = R @ c[i]
            weight = 1.0 / (vague[i] * sigma_p)
            for x in range(3):
                row = 3 * i + x
                e_p[row] = (q[x] - b[i, x]) / vague[i]
                e[row] = e_p[row] / sigma_p
                J[row, 3 + x] = weight
                for t in range(terms):
                    J[row, 6 + t] = along[x] * basis[i, t] * weight
            cross_rows(J[3 * i : 3 * i + 3], a, weight)
        for i in range(h):
            factor = basis_n[i] @ values
            s[:] = 0.0
            for t in range(terms):
                s[0] += slopes[i, t, 0] * values[t]
                s[1] += slopes[i, t, 1] * values[t]
            lean = c_n[i] @ m[i]
            seen[:] = m[i] - s * (lean / (factor + c_n[i] @ s))  # Sherman-Morrison; its length does not count
            seen[:] = R @ (seen / np.sqrt(seen @ seen))
            cross_rows(tilt, seen, 1.0)
            for t in range(terms):
                turn[0], turn[1] = -lean * slopes[i, t, 0], -lean * slopes[i, t, 1]
                tilt[:, 6 + t] = R @ turn
            off = seen - z[i]
            off -= (off @ z[i]) * z[i]
            for x in range(3):
                e_n[3 * i + x] = off[x]
                e[3 * (n + i) + x] = off[x] / sigma_n
            for y in range(6 + terms):
                lengthwise = z[i] @ np.ascontiguousarray(tilt[:, y])
                for x in range(3):
                    J[3 * (n + i) + x, y] = (tilt[x, y] - lengthwise * z[i, x]) / sigma_n
        for i in range(k):
            row = 3 * (n + h) + i
            off_size = ratio[i] * (rows[i] @ values) - 1.0
            for t in range(terms):
                J[row, 6 + t] = ratio[i] * rows[i, t] / sigma_r
            for t in range(own):
                J[row, 6 + terms + t] = -rows[i, t] / sigma_r
                off_size -= rows[i, t] * change[terms + t]
            e[row] = off_size / sigma_r
        w = 1.0 / np.sqrt(1.0 + (e / 2.0) ** 2)
        weighted = J * w.reshape(-1, 1)
        information = J.T @ weighted + np.diag(prior**2)
        gradient = weighted.T @ e
        gradient[6:] += prior[6:] ** 2 * change
        step = -np.linalg.solve(information, gradient)
        dR = rotation_of(step[:3])
        R, p = dR @ R, dR @ (p - pivot) + pivot + step[3:6]
        change = change + step[6:]
        if count in (2, 4, 6, 8):  # robust spreads of what the unknowns leave, each kind by its own redundancy
            taken = ((J @ np.linalg.inv(information)) * weighted).sum(axis=1)
            redundancy = max(3.0 * n - taken[: 3 * n].sum(), 1.0)
            sigma_p = max(_spread(e_p, 3 * n) * np.sqrt(3 * n / redundancy), 1e-6)
            if h:
                left = max(2.0 * h - taken[3 * n : 3 * (n + h)].sum(), 1.0)
                sigma_n = max(_spread(e_n, 2 * h) * np.sqrt(2 * h / left), 1e-6)
        if count > 9 and np.sqrt(step @ step) < 1e-9:
            break
    return R, p, change, information, redundancy, sigma_p, sigma_n


@compiled()
def _spread(e: Array, count: int) -> float:
    """Standard deviation of residuals, half of it from their middle: a few wild ones do not set it."""
    limit = 4.0 * MAD * np.median(np.abs(e))
    return np.sqrt((np.minimum(np.abs(e), limit) ** 2).sum() / count)  # type: ignore[no-any-return]


def _circles(patterns: Sequence[HolePattern], shape: ScannerCorrection) -> tuple[Array, Array]:
    """Of k hole circles.

    Derivative (k, K) of their stretch by the factors of ``shape``, and measured over nominal size (k,).

    The stretch of a small circle is half the trace of the correction's derivative in the circle's plane.
    """
    c = np.array([p.center_C for p in patterns]).reshape(-1, 3)
    n = np.array([p.X_CR.rotation().matrix()[:, 2] for p in patterns]).reshape(-1, 3)
    in_plane = c - (c * n).sum(axis=1, keepdims=True) * n
    bend = 0.5 * np.einsum("nki,ni->nk", shape.slopes(c), in_plane[:, :2])
    return shape.terms(c) + bend, np.array([p.ratio for p in patterns])


def _ratio_sigma(rows: Array, ratio: Array) -> float:
    """Estimate the spread of the measured sizes of hole circles about the best correction for them alone.

    The expected spread counts, too.
    """
    square, dof = 0.0, 0
    if len(ratio) > 3:
        left = 1.0 / ratio - rows @ np.linalg.lstsq(rows, 1.0 / ratio, rcond=1e-6)[0]
        square, dof = float((left**2).sum()), len(ratio) - 3
    return float(np.sqrt((square + _RATIO_DOF * _RATIO_SIGMA**2) / (dof + _RATIO_DOF)))
