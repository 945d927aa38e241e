"""What robot and profiler scatter by at an edge: as stated, as the file says, or as large as the points themselves show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.errors import InconsistentData
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.models.errors import InputError, WeldcalError

STARTS = (1.0, 2.0, 4.0)  # times the usual sigmas, for sensors that are that much worse
MOST = 6.0
SETTLED = 1.15  # residuals this many times the sigmas are what the sigmas say


@dataclass(frozen=True)
class Sigmas:
    """What is known of sensor and robot, m; `stated`: by a person or the file, so that points beyond them are wrong points."""

    robot_m: float = 0.03e-3
    x_m: float = 0.05e-3
    z_m: float = 0.06e-3
    stated: bool = True

    def __post_init__(self) -> None:
        if not (self.robot_m >= 0.0 and self.x_m > 0.0 and self.z_m > 0.0):
            raise InputError("The sigmas of x and z must be positive, and the robot's not negative.")

    def times(self, factor: float) -> Sigmas:
        """All of them, larger."""
        return Sigmas(factor * self.robot_m, factor * self.x_m, factor * self.z_m, self.stated)


def edge_by_noise(poses: FlangePoses, points: Floats, sigmas: Sigmas) -> tuple[EdgeEstimate, Sigmas]:
    """The joint estimate, and the sigmas that it rests on.

    Where none were stated the usual ones are enlarged together until the residuals are no larger than they say: good points of a
    noisier sensor must not pass for outliers, which would bias the estimate and flatter its sigma. More points must then agree, or
    as many.

    Raises:
        What edge_joint raises; InconsistentData only where the points lie on no edge by the enlarged ones either.
    """

    def fit(factor: float) -> EdgeEstimate:
        s = sigmas.times(factor)
        return edge_joint(
            poses.rotation, poses.translation, points, sigma_robot_m=s.robot_m, sigma_xz_m=np.array([s.x_m, s.z_m])
        )

    if sigmas.stated:
        return fit(1.0), sigmas
    refused: InconsistentData | None = None
    for factor in STARTS:
        try:
            e = fit(factor)
            break
        except InconsistentData as problem:
            refused = refused or problem
    else:
        assert refused is not None
        raise refused
    for _ in range(8):
        larger = factor * float(np.sqrt(e.reduced_chi2))
        if not SETTLED * factor < larger < MOST:
            break
        try:
            other = fit(larger)
        except WeldcalError:
            break
        if other.inliers.sum() < e.inliers.sum():
            break
        e, factor = other, larger
    return e, sigmas.times(factor)
