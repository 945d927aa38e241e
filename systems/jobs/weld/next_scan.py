"""Selects the planned pose that a live eye-to-hand calibration should add next, with its predicted benefit."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.planning.calibration_poses import PlannedPose, PlannerConfig, predicted_sigma
from weldcal.systems.messages import CalibrationStatus, Message


@dataclass(frozen=True, eq=False)
class NextScan(Message):
    """A planned pose that was not visited, and the expected error (m) of a scanned point at the work point without and with it."""

    pose: PlannedPose
    error_now_m: float
    error_then_m: float

    def sentence(self) -> str:
        """The proposal as one sentence for the operator."""
        joints = ", ".join(f"{v:.0f}" for v in np.degrees(self.pose.q))
        p = 1e3 * self.pose.X_BF.translation()
        return (
            f"joints [{joints}] deg (flange at {p[0]:.0f}, {p[1]:.0f}, {p[2]:.0f} mm in the base): it would reduce the expected "
            f"error at the work point from {1e3 * self.error_now_m:.3f} to {1e3 * self.error_then_m:.3f} mm."
        )


def next_scan(status: CalibrationStatus, poses: tuple[PlannedPose, ...], p_BWork: np.ndarray) -> NextScan | None:
    """The unvisited planned pose (all are reachable, visible and clear) that reduces the expected error at the work point
    most; None before the first estimate, or where all were visited.

    The gain is computed by the planner; the present error is the estimate's.
    """
    left = poses[status.sequence :]
    if status.estimate is None or not left or not status.observations:
        return None
    config = PlannerConfig(work_point_B=(float(p_BWork[0]), float(p_BWork[1]), float(p_BWork[2])))
    X_BC: RigidTransform = status.estimate.X_BC
    seen = [o.X_BR for o in status.observations]
    before = predicted_sigma(seen, X_BC, config)
    after = [predicted_sigma([*seen, p.X_BR], X_BC, config) for p in left]
    best = int(np.argmin(after))
    share = after[best] / before if np.isfinite(before) else 1.0
    return NextScan(left[best], status.predicted_error_m, share * status.predicted_error_m)
