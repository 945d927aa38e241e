"""Finds a change of the camera's pose during the recording: the scanner, or the robot's base, was moved."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.adjustment import (
    Kind,
    Observed,
    Remainder,
    Unknowns,
    adjust,
    by_median,
    huber,
    huber_cost,
    scanned,
)
from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

FALSE_ALARM = 1e-4  # of recordings without a change in which one is named, by the F-test alone
LEAST_PART = 4  # poses before and after
_LEAST = 9  # poses in all: with fewer, 12 unknowns of two poses and 3 of the scanner leave nothing to test with
# sigmas per axis of one pose: a smaller shift is arm and scanner, which repeat no better over a field
_LARGER_THAN = 3.0
_LEAST_SHIFT_M = 1e-4  # a smaller one is within what arms repeat to, and no reason to refuse a recording
_SCANNER_ORDERS = ((14, 2), (_LEAST, 1))  # from how many poses on the scanner's own error is left open to which order
_USUAL = np.array([2e-3, 1.5e-2, 1.5e-2, 0.02, 0.02, 0.02])  # what the factors of a scanner are off (1, 1/m, 1/m^2)
_CANDIDATES = 60  # places looked at first
_FINER = 10  # times finer are the places near the best
_SAME_M, _SAME_RAD = 5e-3, 1e-2  # starts so near to each other lead to the same fit


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangePoint:
    """A change between two poses: ids of the last before and of the first after it; the two camera poses.

    The rms shift (m) of the flange centres that it makes, the spread per axis (m) with and without it, and the
    probability by chance.
    """

    index: int
    before: str
    after: str
    X_BC_before: RigidTransform
    X_BC_after: RigidTransform
    shift_m: float
    with_m: float
    without_m: float
    probability: float

    @property
    def rotation_rad(self) -> float:
        """Angle between the two camera poses."""
        turn = RotationMatrix(self.X_BC_before.rotation().inverse() @ self.X_BC_after.rotation())
        return float(abs(turn.ToAngleAxis().angle()))


def find_change(observations: Sequence[Observation]) -> ChangePoint | None:
    """The change of the camera's pose in observations (n) in the order of their recording; None where they show none.

    One camera pose is compared with two, for every place of a change that leaves four poses on either side. Both models
    leave the scanner's own error open, with a prior of its usual size. Otherwise a recording from near to far would
    take that error for a change. Centres only; Huber weights. A change is named under two conditions. The F-test,
    corrected for the number of places, gives it a probability by chance below FALSE_ALARM. And it shifts the centres
    by more than three sigmas of a single pose and 0.1 mm. Deterministic. Fewer than nine poses show none.
    """
    n = len(observations)
    if n < _LEAST:
        return None
    b = np.array([o.p_BR for o in observations])
    c = np.array([o.p_CR for o in observations])
    order = next(order for least, order in _SCANNER_ORDERS if n >= least)
    starts = _starts(observations)
    best: tuple[float, int, _Split] | None = None
    for X in starts:
        places = range(LEAST_PART, n - LEAST_PART + 1)
        step = max(1, len(places) // _CANDIDATES)
        fits = {k: _fit(b, c, X, k, order) for k in places[::step]}
        k = min(fits, key=lambda k: fits[k].loss)
        while step > 1:
            finer = max(1, step // _FINER)
            near = range(max(k - step + 1, places[0]), min(k + step, places[-1] + 1), finer)
            fits |= {i: _fit(b, c, X, i, order) for i in near if i not in fits}
            step, k = finer, min(fits, key=lambda k: fits[k].loss)
        if best is None or fits[k].loss < best[0]:
            best = (fits[k].loss, k, fits[k])
    if best is None:
        return None
    _, k, split = best
    single = min((_fit(b, c, X, None, order, split.sigma) for X in starts), key=lambda s: s.loss)
    at_split = _fit(b, c, split.X_before, k, order, split.sigma)
    free = 3 * n - 12 - TERMS[order]
    ratio = max(single.loss - at_split.loss, 0.0) / 6.0 / max(at_split.loss / free, 1e-12)
    probability = min(1.0, float(f_tail(ratio, 6, free)) * (n - 2 * LEAST_PART + 1))
    moved = (at_split.X_after @ at_split.X_before.inverse()).multiply(b.T).T - b
    shift = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    if probability > FALSE_ALARM or shift < max(_LARGER_THAN * at_split.sigma, _LEAST_SHIFT_M):
        return None
    return ChangePoint(
        index=k,
        before=observations[k - 1].id,
        after=observations[k].id,
        X_BC_before=at_split.X_before,
        X_BC_after=at_split.X_after,
        shift_m=shift,
        with_m=at_split.sigma,
        without_m=single.own_sigma,
        probability=probability,
    )


@dataclass(frozen=True, eq=False)
class _Split:
    """A fit: twice its Huber loss in units of sigma^2, the sigma (m) it was taken with, and its own."""

    X_before: RigidTransform
    X_after: RigidTransform
    loss: float
    sigma: float
    own_sigma: float


def _starts(observations: Sequence[Observation]) -> list[RigidTransform]:
    """Camera poses to begin with: from all poses, from the first and from the last of them.

    Those that can be estimated and that lead elsewhere than an earlier one.
    """
    n = len(observations)
    config = SolveConfig(leave_one_out=False, hypotheses=150, allow_coplanar=True)
    middle = np.mean([o.p_CR for o in observations], axis=0)
    out: list[RigidTransform] = []
    for part in (slice(None), slice(n // 2), slice(n // 2, None), slice(LEAST_PART), slice(-LEAST_PART, None)):
        try:
            X = estimate_eye_on_base(tuple(observations[part]), config).X_BC
        except InputError:
            continue
        if all(
            np.linalg.norm(X @ middle - Y @ middle) > _SAME_M
            or (X.rotation().inverse() @ Y.rotation()).ToAngleAxis().angle() > _SAME_RAD
            for Y in out
        ):
            out.append(X)
    return out


def _fit(
    b: Array, c: Array, start: RigidTransform, split: int | None, order: int, sigma: float | None = None
) -> _Split:
    """Fit camera poses before and from ``split`` on, and the scanner's factors, by reweighted Gauss-Newton.

    ``split`` None: one pose for all.

    ``sigma`` (m, an axis) is estimated from the residuals where it is not given.
    """
    n, terms = len(b), TERMS[order]
    basis = ScannerCorrection.unchanged(terms).terms(c)
    poses = 1 if split is None else 2
    free = max(3 * n - 6 * poses - terms, 3)

    def linearised(at: Unknowns) -> tuple[Observed]:
        J, q = np.zeros((n, 3, 6 * poses + terms)), np.zeros((n, 3))
        for i, part in enumerate((slice(0, split), slice(split, n))[:poses]):
            of = slice(6 * i, 6 * i + 6)
            q[part], J[part, :, of], J[part, :, 6 * poses :] = scanned(at.poses[i], c[part], basis[part], at.numbers)
        return (Observed(q - b, J),)

    def spread(left: Remainder) -> float:
        return by_median(left) * float(np.sqrt(3 * n / free))

    found = adjust(
        Unknowns((np.asarray(start.GetAsMatrix4()),) * poses, np.zeros(terms)),
        linearised,
        (Kind(rank=3, loss=huber, spread=spread if sigma is None else None, sigma=sigma),),
        prior=np.diag(_USUAL[:terms] ** -2),
        steps=12,
    )
    e, scale = found.rows[0].e, found.sigmas[0]
    square = (e**2).sum(axis=1) / scale**2
    loss = float(huber_cost(square, 3).sum() + ((found.at.numbers / _USUAL[:terms]) ** 2).sum())
    rigid = [as_transform(X) for X in found.at.poses]
    value = loss if sigma is not None else float(np.log(scale) * 3 * n + loss)
    return _Split(rigid[0], rigid[-1], value, scale, spread(Remainder(e)))
