"""Predicts what a planned motion will tell of X_BC and of the scanner's clock."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.motion.clock import arrival_clock
from weldcal.calibration.motion.clock_fit import OFFSET, MotionProblem, linearised
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.motion.variances import Variances, frame_weights
from weldcal.models.errors import InputError

_FEWEST = 6
_LARGEST = 1e6  # sigmas beyond this are of directions that the motion does not show at all


@dataclass(frozen=True)
class PredictedSigma:
    """What a motion is expected to tell, one sigma: ``work_m`` of a point among the flange's places (3-D), ``turn_rad``
    of X_BC's rotation (3-D), ``offset_s`` of the clock, ``shared`` the largest correlation 0..1 of the offset with a
    shift of the scanner. Infinite where the motion does not show it."""

    work_m: float
    turn_rad: float
    offset_s: float
    shared: float


def expected_of_motion(
    motion: ContinuousMotion,
    X_BC: RigidTransform,
    *,
    frame_s: float = 0.05,
    centre_sigma_m: float = 1e-4,
    normal_sigma: float = 1e-3,
    jitter_s: float = 0.015,
    X_FR: RigidTransform | None = None,
) -> PredictedSigma:
    """Expected sigmas of a calibration from a planned motion, with a frame every ``frame_s``, as the joint fit would
    state them.

    ``jitter_s`` is that of the arrivals; for device times give their own, 0.0001 for instance. Raises InputError: less
    than six frames.
    """
    begin, end = motion.span
    t = np.arange(begin, end, frame_s)
    t = t[motion.known(t)]
    if len(t) < _FEWEST:
        raise InputError(f"The motion lasts for {len(t)} frames; {_FEWEST} or more are needed.")
    at = motion.feature(t, X_FR)
    R = X_BC.rotation().matrix()
    n = len(t)
    frames = ObservedFrames(
        ids=tuple(str(k) for k in range(n)),
        arrival=t,
        device=None,
        p_C=(at.p - X_BC.translation()) @ R,
        n_C=at.n @ R,
        covariance=np.zeros((n, 3, 3)),
        normal_sigma=np.zeros(n),
    )
    problem = MotionProblem(frames, arrival_clock(frames), motion, X_FR)
    pivot = at.p.mean(axis=0)
    linear = linearised(problem, X_BC, t, t, 0.0, 0.0, pivot)
    W = frame_weights(linear, Variances(0.0, centre_sigma_m**2, normal_sigma**2, jitter_s**2), np.zeros(n, dtype=bool))
    J = linear.J[:, :, : OFFSET + 1]
    unit = np.array([1e-3] * 3 + [1e-4] * 3 + [1e-3])
    values, vectors = np.linalg.eigh(np.einsum("nia,nij,njb->ab", J, W, J) * np.outer(unit, unit))
    root = vectors / np.sqrt(np.maximum(values, 1.0 / _LARGEST**2))
    C = unit[:, None] * (root @ root.T) * unit
    sigma = np.sqrt(np.diag(C))
    slack = [-skew(p - pivot) for p in at.p]
    spread = np.mean([np.trace(np.hstack([S, np.eye(3)]) @ C[:6, :6] @ np.hstack([S, np.eye(3)]).T) for S in slack])
    share = float(np.abs(C[3:6, 6] / (sigma[3:6] * sigma[6])).max())
    limits = 0.01 * _LARGEST * unit
    return PredictedSigma(
        work_m=float(np.sqrt(spread)) if (sigma[:6] < limits[:6]).all() else float("inf"),
        turn_rad=float(np.linalg.norm(sigma[:3])) if (sigma[:3] < limits[:3]).all() else float("inf"),
        offset_s=float(sigma[6]) if sigma[6] < limits[6] else float("inf"),
        shared=share,
    )
