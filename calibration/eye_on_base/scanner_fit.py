"""Fits a scanner correction to observations of the flange, from the robot's motion and from the hole circles."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.adjustment import Kind, Observed, Remainder, Unknowns, adjust, scanned, soft_l1
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
from weldcal.calibration.geometry.robust import MAD, chi2_share
from weldcal.calibration.geometry.se3 import as_transform, skew
from weldcal.models.arrays import Array

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
    own = size - 6 - terms
    basis, basis_n, slopes = shape.terms(c), shape.terms(c[has]), shape.slopes(c[has])
    c_n, lean = c[has], np.vecdot(c[has], m)
    leaning = np.swapaxes(-lean[:, None, None] * slopes, 1, 2)
    across = np.eye(3) - z[:, :, None] * z[:, None, :]
    circles = np.zeros((len(ratio), 1, size))
    circles[:, 0, 6 : 6 + terms], circles[:, 0, 6 + terms :] = ratio[:, None] * rows, -rows[:, :own]
    sloped, weight = np.moveaxis(slopes, 1, 2), 1.0 / vague[:, None]

    def linearised(at: Unknowns) -> tuple[Observed, ...]:
        X, change = at.poses[0], at.numbers[:terms].copy()
        change[0] = min(max(change[0], -LARGEST), LARGEST)
        J = np.zeros((len(b), 3, size))
        q, J[:, :, :6], J[:, :, 6 : 6 + terms] = scanned(X, c, basis, change)
        # a normal turns by the inverse transpose of the correction's derivative f 1 + c s' (Sherman-Morrison)
        s = sloped @ change
        seen = m.copy()
        seen[:, :2] -= s * (lean / (1.0 + basis_n @ change + np.vecdot(c_n[:, :2], s)))[:, None]
        seen = (seen / np.sqrt(np.vecdot(seen, seen))[:, None]) @ X[:3, :3].T
        tilt = np.zeros((len(z), 3, size))
        tilt[:, :, :3] = -skew(seen)
        tilt[:, :, 6 : 6 + terms] = X[:3, :2] @ leaning
        off = ratio * (rows @ (np.eye(terms)[0] + change)) - 1.0 - rows[:, :own] @ at.numbers[terms:]
        e_p = (q - b) * weight
        e_n = across @ (seen - z)[:, :, None]
        return (
            Observed(e_p.reshape(-1, 1), (J * weight[:, :, None]).reshape(-1, 1, size)),
            Observed(e_n.reshape(-1, 1), (across @ tilt).reshape(-1, 1, size)),
            Observed(off[:, None], circles),
        )

    found = adjust(
        Unknowns((np.asarray(start.GetAsMatrix4()),), np.zeros(size - 6)),
        linearised,
        (
            Kind(rank=1.0, loss=soft_l1, spread=_bounded, sigma=sigma_p),
            Kind(rank=2.0 / 3.0, loss=soft_l1, spread=_bounded, sigma=sigma_n),  # two numbers of a normal's three
            Kind(rank=1.0, loss=soft_l1, sigma=sigma_r),
        ),
        prior=np.diag(prior[6:] ** 2),
    )
    joint = found.covariance[: 6 + terms, : 6 + terms]
    change, (sigma_p, sigma_n, _) = found.at.numbers, found.sigmas
    return CorrectionEstimate(
        correction=correction_of(change[:terms], field),
        covariance=joint[6:, 6:],
        X_BC=as_transform(found.at.poses[0]),
        joint=joint,
        redundancy=found.spare[0],
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


def _bounded(left: Remainder) -> float:
    """By residuals (n, 1), half of it from their middle: a few wild ones do not set it."""
    e = np.sort(np.abs(left.e), axis=None)  # the median of the sorted ones takes a tenth of the time of np.median
    e = np.minimum(e, 2.0 * MAD * (e[(len(e) - 1) // 2] + e[len(e) // 2]))
    return math.sqrt(float(e @ e) / left.spare)


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
