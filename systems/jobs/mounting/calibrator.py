"""MountingCalibrator: estimates the unknown poses of any mounting from scans of a circle, and proposes the next
pose."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.planning.mounting_estimate import (
    Circle,
    MountingResult,
    SeenCircle,
    expected_after,
    expected_error,
    fewest,
    off_prediction,
    see_circle,
    solve_mounting,
)
from weldcal.calibration.planning.mounting_poses import MountingPose
from weldcal.calibration.planning.mounting_scene import FLANGE, MountingScene
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.background import Answer, Background
from weldcal.systems.background_system import BackgroundSystem
from weldcal.systems.jobs.mounting.procedure import HeldOutScan, MountingState, MountingStatus, NextBest
from weldcal.systems.messages import Scan
from weldcal.systems.motion.pose_recorder import PoseHistory


@dc.dataclass(frozen=True)
class MountingFitConfig:
    """The circle, and the stop criterion (m)."""

    circle: Circle
    minimum_scans: int
    required_error_m: float


class MountingCalibrator(BackgroundSystem):
    """Fits the circle in each scan near its predicted position, and solves the mounting's equation with all
    observations.

    .. pydrake_system::

        name: MountingCalibrator
        input_ports:
        - scan
        - state
        - history
        - history_2
        output_ports:
        - status

    `history_2` is read only where the scene has a second arm.
    """

    def __init__(
        self,
        scene: MountingScene,
        config: MountingFitConfig,
        plan: Sequence[MountingPose],
        background: Background | None = None,
        period_s: float = 0.02,
    ) -> None:
        super().__init__("status", MountingStatus(), background, period_s)
        self.background.prepare(warm_up)
        self._scene, self._config, self._plan = scene, config, tuple(plan)
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._state = self.DeclareAbstractInputPort("state", AbstractValue.Make(MountingState()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._history_2 = self.DeclareAbstractInputPort("history_2", AbstractValue.Make(PoseHistory()))

    def ask(self, context: Context, newest: MountingStatus) -> Answer[MountingStatus] | None:
        """Ask for the status with a new scan."""
        scan: Scan = self._scan.Eval(context)
        job: MountingState = self._state.Eval(context)
        if scan.sequence <= newest.sequence or scan.sequence != job.trigger:
            return None
        q = self._history.Eval(context).joints_at(scan.capture_time)
        q_2 = self._history_2.Eval(context).joints_at(scan.capture_time) if self._scene.two else None
        return self.background.ask(digest, newest, scan, job, (q, q_2), self._scene, self._config, self._plan)


def digest(
    status: MountingStatus,
    scan: Scan,
    job: MountingState,
    joints: tuple[Array | None, Array | None],
    scene: MountingScene,
    config: MountingFitConfig,
    plan: Sequence[MountingPose],
) -> MountingStatus:
    """Compute the status after one more scan; an unusable scan is listed as refused with its label and the reason."""
    status = dc.replace(status, sequence=scan.sequence)
    q, q_2 = joints
    if q is None or (scene.two and q_2 is None):
        reason = "the arm's pose at the time of the scan is not known"
        return dc.replace(status, refused=(*status.refused, (job.label, reason)), message=reason)
    belief = scene if status.result is None else scene.believing(status.result.poses)
    try:
        seen = see_circle(scan.points_C.astype(float), belief, job.label, q, q_2, config.circle)
    except FlangeNotFound as error:
        return dc.replace(status, refused=(*status.refused, (job.label, str(error))), message=str(error))
    if job.purpose == "verify":
        off = off_prediction(belief, seen, None if status.result is None else status.result.correction)
        return dc.replace(status, held_out=(*status.held_out, HeldOutScan(job.label, *off)))
    status = dc.replace(status, seen=(*status.seen, seen), message="")
    if len(status.seen) < fewest(scene):
        return status
    try:
        result = solve_mounting(scene, status.seen)
    except WeldcalError as error:
        return dc.replace(status, message=str(error))
    sigma, within = expected_error(scene, result)
    return dc.replace(
        status,
        result=result,
        sigma_work_m=sigma,
        error_95_m=within,
        history=(*status.history, (len(status.seen), within)),
        next_best=next_best(scene.believing(result.poses), result, status.seen, plan),
        done=len(status.seen) >= config.minimum_scans and within <= config.required_error_m,
    )


def next_best(
    belief: MountingScene, result: MountingResult, seen: Sequence[SeenCircle], plan: Sequence[MountingPose]
) -> NextBest | None:
    """The unvisited planned pose (all are reachable, visible and clear) that reduces the expected error at the work
    point most; None where all were visited."""
    left = [p for p in plan if all(float(np.abs(p.q - s.pose.q).max()) > 1e-2 for s in seen)]
    if not left:
        return None
    after = expected_after(belief, result, seen, left)
    best = left[int(np.argmin(after))]
    return NextBest(
        best.q, best.q_2, belief.frames(best.q)[FLANGE], expected_error(belief, result)[0], float(after.min())
    )
