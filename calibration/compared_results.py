"""Compare two results of one mounting: the same within their stated regions, or different in which direction."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.data.stated_pose import StatedPose, read_stated_pose
from weldcal.calibration.geometry.robust import chi2_quantile, f_quantile
from weldcal.calibration.geometry.se3 import angle_of, difference, skew
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEVEL = 0.95  # the usual level of a region, as everywhere in the reports
USUAL_WORK_M = 0.7  # before the sensor, where no result states what its scans show: a usual scanner's best distance
_ALIKE = np.cos(np.radians(20.0))  # axes of sensor and parent nearer than this are one direction for a reader
_SENSORS = {
    "X_BC": ("scanner's", "base's", "optical axis"),
    "X_FC": ("scanner's", "flange's", "optical axis"),
    "X_FS": ("profiler's", "flange's", "profiler's z"),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedResults:
    """The second of two results less the first.

    Attributes:
        symbol: X_BC, X_FC or X_FS.
        square, limit: squared Mahalanobis distance of the six numbers, and the limit that right results stay within
            with probability LEVEL.
        origin_mm, origin_deg: difference of the poses: distance of the origins, and angle.
        work_mm, work_p: difference (3,) mm of the place of one measured point, and the point (3,) m in the parent.
        work_known: whether a result states what its scans show.
        corrected: whether the scanner corrections are applied at the work point.
        direction: the single shift or turn that explains most of the distance, in words; sigmas: its size in standard
            deviations; share: of the distance that it explains.
        shared: the results have data in common, or are one result: the test has no meaning.
        notes: what a reader must know.
    """

    symbol: str
    square: float
    limit: float
    origin_mm: float
    origin_deg: float
    work_mm: Array
    work_p: Array
    work_known: bool
    corrected: bool
    direction: str
    sigmas: float
    share: float
    shared: bool
    notes: tuple[str, ...] = ()

    @property
    def differ(self) -> bool:
        """Whether the distance is above the limit."""
        return self.square > self.limit


def compare_results(first: Path, second: Path) -> ComparedResults:
    """Compare two results of calibrate, hand-eye or profiler.

    Raises:
        InputError: a result cannot be read or states no covariance, or they are of different mountings.
    """
    return compare_stated(*(read_stated_pose(one) for one in (first, second)))


def compare_stated(first: StatedPose, second: StatedPose) -> ComparedResults:
    """Compare two stated poses; the two are independent. Raises InputError as compare_results."""
    both = (first, second)
    for one in both:
        if one.covariance is None or not float(np.diag(one.covariance).min()) > 0.0:
            raise InputError(
                f"'{one.name}' states no covariance, so a difference cannot be judged: give a result that weldcal"
                " computed with one."
            )
    if first.symbol != second.symbol or first.symbol not in _SENSORS:
        kinds = " and ".join(one.symbol or "no pose of a known mounting" for one in both)
        raise InputError(f"The results hold {kinds}: give two of one mounting, X_BC, X_FC or X_FS.")
    corrected = all(one.correction is None or one.joint is not None for one in both)
    c = [one.work_C for one in both if one.work_C is not None]
    work_C = np.mean(c, axis=0) if c else np.array([0.0, 0.0, USUAL_WORK_M])
    X, Y = (one.readings[0].X for one in both)
    q, S = zip(*(_at(one, work_C, corrected) for one in both), strict=True)
    plain = difference(X, Y)
    d = np.concatenate([plain[:3], q[1] - q[0]])
    total = S[0] + S[1]
    unit = 1.0 / np.sqrt(np.diag(total))
    W = np.linalg.pinv(total * unit[:, None] * unit, hermitian=True) * unit[:, None] * unit
    square = float(d @ W @ d)
    # Yao, Biometrika 52 (1965): each result counts as it contributes to this distance
    parts = [float(d @ W @ s @ W @ d) / max(square, 1e-300) for s in S]  # 1e-300: no division by zero
    few = sum(part**2 / one.freedom for part, one in zip(parts, both, strict=True))
    limit = 6.0 * f_quantile(LEVEL, 6.0, 1.0 / few) if few > 0.0 else chi2_quantile(LEVEL, 6.0)
    sigmas, direction = max(_gains(first.symbol, X, q[0] - X[:3, 3], W, d))
    notes = []
    if not corrected:
        notes.append("A scanner correction has no covariance: the poses are compared without the corrections.")
    if not all(one.data for one in both):
        notes.append("A result does not name its data: make sure that the two have none in common.")
    return ComparedResults(
        symbol=first.symbol,
        square=square,
        limit=limit,
        origin_mm=1e3 * float(np.linalg.norm(plain[3:])),
        origin_deg=float(np.degrees(angle_of(Y[:3, :3] @ X[:3, :3].T))),
        work_mm=1e3 * (q[1] - q[0]),
        work_p=q[0],
        work_known=bool(c),
        corrected=corrected and any(one.correction is not None for one in both),
        direction=direction,
        sigmas=sigmas,
        share=sigmas**2 / max(square, 1e-300),
        shared=bool(first.data & second.data) or bool(np.array_equal(X, Y)),
        notes=tuple(notes),
    )


def _at(one: StatedPose, work_C: Array, corrected: bool) -> tuple[Array, Array]:
    """Return the place (3,) of a measured point in the parent, and the covariance (6, 6) of rotation and place."""
    X, C, scanner = one.readings[0].X, one.covariance, one.correction if corrected else None
    assert C is not None
    c = work_C if scanner is None else scanner.points(work_C)
    lever = X[:3, :3] @ c
    J = np.eye(6)
    J[3:, :3] = -skew(lever)
    if scanner is not None and one.joint is not None:
        C, terms = one.joint, np.outer(X[:3, :3] @ work_C, scanner.terms(work_C))
        J = np.hstack([J, np.vstack([np.zeros_like(terms), terms])])
    return X[:3, 3] + lever, np.asarray(J @ C @ J.T)


def _gains(symbol: str, X: Array, lever: Array, W: Array, d: Array) -> Iterator[tuple[float, str]]:
    """Yield for each shift and turn how many sigmas it is, fitted alone to a difference d (6,), and its words.

    ``W``: information of rotation and place of the work point, which is at ``lever`` (3,) from the sensor's origin.
    """
    sensor, parent, optical = _SENSORS[symbol]
    R = X[:3, :3]
    axes = [(R[:, 0], f"{sensor} x"), (R[:, 1], f"{sensor} y"), (R[:, 2], optical)]
    rest = [(a, f"{parent} {name}") for a, name in zip(np.eye(3), "xyz", strict=True)]
    axes += [(a, name) for a, name in rest if float(np.abs(a @ R).max()) < _ALIKE]
    for a, name in axes:
        causes = (
            (np.concatenate([np.zeros(3), a]), "{:+.3f} mm along the {}", 1e3),
            (
                np.concatenate([a, np.cross(a, lever)]),
                "a turn of {:+.4f} deg about the {} through the sensor",
                np.degrees(1.0),
            ),
            (
                np.concatenate([a, np.zeros(3)]),
                "a turn of {:+.4f} deg about the {} through the work point",
                np.degrees(1.0),
            ),
        )
        for u, words, scale in causes:
            known, pulled = float(u @ W @ u), float(u @ W @ d)
            if known > 0.0:
                yield abs(pulled) / np.sqrt(known), words.format(scale * pulled / known, name)
