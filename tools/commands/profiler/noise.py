"""The noise of robot and profiler at an edge: as stated, or estimated from the residuals of the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.errors import InconsistentData
from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.models.errors import InputError, WeldcalError

STARTS = (1.0, 2.0, 4.0)  # times the usual sigmas, for noisier sensors
MOST = 6.0
SETTLED = 1.15  # residuals up to this many times the sigmas agree with them


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of sensor and robot, m; `stated`: given by the user or the file, so points beyond them are outliers."""

    robot_m: float = 0.03e-3
    x_m: float = 0.05e-3
    z_m: float = 0.06e-3
    stated: bool = True

    def __post_init__(self) -> None:
        if not (self.robot_m >= 0.0 and self.x_m > 0.0 and self.z_m > 0.0):
            raise InputError("The sigmas of x and z must be positive, and the robot's not negative.")

    def times(self, factor: float) -> Sigmas:
        """All of them multiplied by a factor."""
        return Sigmas(factor * self.robot_m, factor * self.x_m, factor * self.z_m, self.stated)


def edge_by_noise(poses: FlangePoses, points: Floats, sigmas: Sigmas) -> tuple[EdgeEstimate, Sigmas]:
    """The joint estimate, and the sigmas that it uses.

    Where none are stated, the usual ones are scaled up together until they agree with the residuals: otherwise good points
    of a noisier sensor would be rejected as outliers, which biases the estimate and makes its sigma too small. A larger scale
    is kept only if no inlier is lost.

    Raises:
        InconsistentData: the points lie on no edge, with the enlarged sigmas either; others as edge_joint.
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
