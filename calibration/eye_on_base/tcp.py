"""Finds a TCP that was set while the poses were recorded: a constant offset of the circle in the flange's frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.adjustment import Kind, Observed, Unknowns, adjust, by_median, plain, scanned, soft_l1
from weldcal.calibration.eye_on_base.solve import SolveConfig, robust_start
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import f_tail
from weldcal.calibration.geometry.se3 import as_transform, fit_with_offset
from weldcal.models.arrays import Array

FALSE_ALARM = 1e-3  # of calibrations without a TCP in which one is named, by the F-test alone
_SHORTEST_M = 2e-3  # twice what arms are off: a joint's zero error looks like a TCP of a millimetre
_ARM_M = 5e-4  # a choice: a maker's calibration usually leaves 0.4 mm; half would name joint errors as a TCP
"""What arms err systematically per coordinate.

However such errors are spread over the poses, they move the offset by no more than the norm of its row of the
pseudo-inverse times theirs: a weak geometry makes much of little.
"""
_UNKNOWN_M = 5e-3  # one sigma of an axis from which on it is not known
_SURE_SIGMAS = 4.0  # a choice: 6 in 100,000 normal draws lie beyond; at 2 one in 22 does
_LEAST_FREE = 5  # spare numbers of the test
_SCANNER_ORDERS = ((12, 2), (7, 1), (0, 0))
"""From how many poses on the scanner's own error is left open to which power of x, y and z: a scale error looks like a
TCP along z where every pose faces the scanner. Depth is among them: triangulation errs with its square, time of flight
in waves over it."""
_GATE = 6.5  # sigmas of a pose that takes no part, as in the calibration
_USUAL_SPREAD_M = 1e-4  # as in scanner_fit.py
_SINGULAR = 1e-6  # a choice between rounding (1e-15) and real motions, of columns of unit length


@dataclass(frozen=True)
class TcpOffset:
    """A TCP that the poses seem to carry.

    ``offset_m`` (3,) of the flange's circle in the frame that the poses name, along x, y, z. ``sigma_m`` (3,), infinite
    where these poses do not show it. ``pretended_m`` (3,) the largest offset that systematic errors of the arm,
    or of the size of the residuals, could produce. ``with_m`` and ``without_m`` rms of the centres with and without it.
    ``probability`` that chance alone does as much.
    """

    offset_m: Array
    sigma_m: Array
    pretended_m: Array
    with_m: float
    without_m: float
    probability: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which of x, y, z the poses show (3,)."""
        return np.asarray(self.sigma_m < _UNKNOWN_M)

    @property
    def length_m(self) -> float:
        """Of the axes that are known."""
        return float(np.linalg.norm(self.offset_m[self.known]))

    def surely_beyond(self, length_m: float) -> bool:
        """Return whether it is longer than that by four sigmas, and by what systematic errors may pretend."""
        widest = np.maximum(_SURE_SIGMAS * self.sigma_m, self.pretended_m)[self.known]
        return self.length_m - float(np.linalg.norm(widest)) > length_m

    @property
    def evident(self) -> bool:
        """Whether it is no chance, and longer than what arms are off may pretend."""
        beyond = np.abs(self.offset_m) > np.maximum(self.pretended_m, _SHORTEST_M)
        return self.probability < FALSE_ALARM and bool((beyond & self.known).any())

    def sentence(self, X_FR: RigidTransform | None) -> str:
        """What to do, where poses were read with the feature at ``X_FR``; None where there are pairs and no poses."""
        tcp = ", ".join(f"{-1e3 * v:.1f}" if k else "?" for v, k in zip(self.offset_m, self.known, strict=True))
        cure = "or correct the positions in pairs.csv"
        if X_FR is not None:
            # the flange lies at -t in the frame of a TCP t: X_FR moves with it
            t = -X_FR.rotation().matrix() @ np.where(self.known, self.offset_m, 0.0)
            numbers = ", ".join(f"{v + 0.0:.4f}" for v in np.round(t, 4))
            cure = f"or write poses: {{tcp: [{numbers}, 0.0, 0.0, 0.0]}} (m, rad) in dataset.yaml"
        hidden = [a for a, k in zip("xyz", self.known, strict=True) if not k]
        open_axes = (
            f" Its {' and '.join(hidden)} cannot be seen in these poses: take it from the controller." if hidden else ""
        )
        return (
            f"The poses look as if a TCP of ({tcp}) mm were set at the robot: with it, centres fit to"
            f" {1e3 * self.with_m:.2f} mm instead of {1e3 * self.without_m:.2f}. Set the TCP to zero and record again,"
            f" {cure}.{open_axes}"
        )


def find_tcp(observations: Sequence[Observation], start: RigidTransform | None = None) -> TcpOffset | None:
    """Return the TCP that observations (n >= 5) seem to carry; None where they show none, or cannot.

    With the scanner's own errors left open, centres are fitted with and without a constant offset b in the frame of the
    poses, R_BC p_C + p_BC = p_BR + R_BR b. The F-test of both holds FALSE_ALARM for normal errors; besides, the offset
    must be longer than systematic errors may pretend. ``start`` of the camera's pose where one is known.
    """
    n = len(observations)
    order = next(k for least, k in _SCANNER_ORDERS if n >= least)
    terms = (1, 4, 10)[order]
    if n < 5 or 3 * n - 9 - terms < _LEAST_FREE:
        return None
    data = _Data.of(observations, order)
    rigid = robust_start(data.b, data.c, SolveConfig(hypotheses=300))
    starts = [one for one in (start, _linear_start(data), rigid) if one is not None]
    fitted = [_fit(data, one, offset=True) for one in starts]
    best = min(fitted, key=lambda one: float(np.median(one.norms)))
    scale = float(np.median(best.norms)) / 1.5382  # of the chi distribution with three free
    keep = best.norms < _GATE * max(scale, 1e-6) * np.sqrt(3.0 * n / max(3 * n - 9 - terms, 1))
    if 3 * int(keep.sum()) - 9 - terms < _LEAST_FREE or 2 * int(keep.sum()) <= n:
        return None
    data = data.pick(keep)
    full, bare = _fit(data, best.X_BC, offset=True, robust=False), _fit(data, best.X_BC, offset=False, robust=False)
    gained, free = full.rank - bare.rank, 3 * int(keep.sum()) - full.rank
    if gained < 1 or free < _LEAST_FREE:
        return None
    variance = max(full.square / free, 1e-12)
    value = (bare.square - full.square) / gained / variance
    probability = float(f_tail(value, gained, free))
    found = TcpOffset(
        full.offset,
        np.sqrt(variance) * full.offset_factor,
        max(_ARM_M, float(np.sqrt(variance))) * full.offset_factor * np.sqrt(3.0 * keep.sum()),
        float(np.sqrt(full.square / keep.sum())),
        float(np.sqrt(bare.square / keep.sum())),
        probability,
    )
    return found if found.evident else None


@dataclass(frozen=True)
class _Data:
    """The data of a fit, one row a pose.

    Centres c (n, 3) in the camera, b (n, 3) in the base, rotations R (n, 3, 3) of the poses, terms (n, K), weights
    (n,).
    """

    c: Array
    b: Array
    R: Array
    terms: Array
    weight: Array

    @staticmethod
    def of(observations: Sequence[Observation], order: int) -> "_Data":
        c = np.array([o.p_CR for o in observations])
        # about their middle, in their spread: powers of metres would be nearly alike
        at = (c - c.mean(axis=0)) / np.maximum(c.std(axis=0), 1e-3)
        powers = [e for e in product(range(order + 1), repeat=3) if sum(e) <= order]
        noise = [0.0 if o.center_covariance is None else np.trace(o.center_covariance) / 3.0 for o in observations]
        return _Data(
            c,
            np.array([o.p_BR for o in observations]),
            np.array([o.X_BR.rotation().matrix() for o in observations]),
            np.stack([np.prod(at ** np.array(e), axis=1) for e in powers], axis=1),
            1.0 / np.sqrt(1.0 + np.array(noise) / _USUAL_SPREAD_M**2),
        )

    def pick(self, keep: NDArray[np.bool_]) -> "_Data":
        return _Data(*(getattr(self, f)[keep] for f in ("c", "b", "R", "terms", "weight")))


@dataclass(frozen=True)
class _Fit:
    X_BC: RigidTransform
    offset: Array
    offset_factor: Array  # (3,) one sigma per sigma of a coordinate; infinite where the poses do not show it
    norms: Array  # (n,) weighted distances
    rank: int

    @property
    def square(self) -> float:
        return float(self.norms @ self.norms)


def _fit(data: _Data, start: RigidTransform, *, offset: bool, robust: bool = True) -> _Fit:
    """Gauss-Newton over pose, scanner terms and, where asked, the offset; reweighted (soft L1) where ``robust``."""
    n, K = data.terms.shape
    size = 6 + K + (3 if offset else 0)

    def linearised(at: Unknowns) -> tuple[Observed]:
        J, b = np.zeros((n, 3, size)), np.zeros(3)
        q, J[:, :, :6], J[:, :, 6 : 6 + K] = scanned(at.poses[0], data.c, data.terms, at.numbers[:K])
        if offset:
            J[:, :, 6 + K :], b = -data.R, at.numbers[K:]
        return (Observed((q - data.b - data.R @ b) * data.weight[:, None], J * data.weight[:, None, None]),)

    kind = Kind(rank=3, loss=soft_l1 if robust else plain, spread=by_median if robust else None)
    found = adjust(Unknowns((np.asarray(start.GetAsMatrix4()),), np.zeros(size - 6)), linearised, (kind,))
    e, J = found.rows[0].e, found.rows[0].J.reshape(-1, size)
    unit = np.maximum(np.linalg.norm(J, axis=0), 1e-12)  # no division by zero
    _, s, Vt = np.linalg.svd(J / unit, full_matrices=False)
    shown = s > _SINGULAR * s[0]
    factor = np.full(3, np.inf)
    if offset:
        hidden = (Vt[~shown, 6 + K :] ** 2).sum(axis=0) > _SINGULAR
        spread = np.sqrt(((Vt[shown, 6 + K :] / s[shown, None]) ** 2).sum(axis=0)) / unit[6 + K :]
        factor = np.where(hidden, np.inf, spread)
    X_BC, b = found.at.poses[0], found.at.numbers[K:] if offset else np.zeros(3)
    return _Fit(as_transform(X_BC), b, factor, np.linalg.norm(e, axis=1), int(shown.sum()))


def _linear_start(data: _Data) -> RigidTransform | None:
    """Return the camera's pose with the rotation's nine numbers free, so that an offset of any size is linear.

    None below six poses.
    """
    if len(data.c) < 6:
        return None
    R, p, _ = fit_with_offset(data.b, data.c, data.R)
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)
