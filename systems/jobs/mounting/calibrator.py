"""MountingCalibrator: estimates the unknown poses of any mounting from scans of a circle, and proposes the next pose."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.base_circle import fit_base_circle
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.hand_eye.linearisation import inverse_information
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.calibration.hand_eye.stated_noise import information_of, with_stated_noise
from weldcal.calibration.planning.mounting_poses import MountingPose, information, prior, work_point
from weldcal.calibration.planning.mounting_scene import FLANGE, MountingScene
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.flanges import FlangeStandard
from weldcal.systems.background import Answer, Background
from weldcal.systems.background_system import BackgroundSystem
from weldcal.systems.jobs.mounting.procedure import HeldOut, MountingState, MountingStatus, NextBest, SeenCircle
from weldcal.systems.jobs.weld.flange_estimator import LIVE_FIT
from weldcal.systems.messages import Scan
from weldcal.systems.motion.pose_recorder import PoseHistory

FIT_SHARE = 1.25  # errors of the fits over their predicted sigma (which assumes independent noise in a scan), rms in simulated scans


@dc.dataclass(frozen=True)
class MountingFitConfig:
    """Settings of the circle fit and the stop criterion (m)."""

    standard: FlangeStandard
    guess_radius_m: float
    foot: bool  # the ring of the base mounting, whose far side is hidden by its column
    minimum_scans: int
    required_error_m: float


class MountingCalibrator(BackgroundSystem):
    """Fits the circle in each scan near its predicted position, and solves the mounting's equation with all observations.

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
        fit = find_circle(scan.points_C.astype(float), belief, q, q_2, config)
    except FlangeNotFound as error:
        return dc.replace(status, refused=(*status.refused, (job.label, str(error))), message=str(error))
    if job.purpose == "verify":
        return dc.replace(status, held_out=(*status.held_out, compare(job.label, fit, belief, q, q_2)))
    X_CR = belief.seen(q, q_2)
    observation = scene.observation(q, q_2, fit.center_C, fit.normal_C, own_covariance(fit, X_CR))
    seen = SeenCircle(job.label, MountingPose(q, q_2, X_CR), observation, fit.coverage)
    status = dc.replace(status, seen=(*status.seen, seen), message="")
    if len(status.seen) < fewest(scene):
        return status
    try:
        result = solve_mounting(scene, status.seen)
    except WeldcalError as error:
        return dc.replace(status, message=str(error))
    sigma = sigma_of_work(scene, result)
    return dc.replace(
        status,
        result=result,
        sigma_work_m=sigma,
        history=(*status.history, (len(status.seen), sigma)),
        next_best=next_best(scene.believing(result.poses), result, status.seen, plan),
        done=len(status.seen) >= config.minimum_scans and sigma <= config.required_error_m,
    )


def find_circle(
    points_C: Array, belief: MountingScene, q: Array, q_2: Array | None, config: MountingFitConfig
) -> FlangeFit:
    """Find the circle in a cloud (H, W, 3) near its predicted position. Raises FlangeNotFound with the reason."""
    X_CR = belief.seen(q, q_2)
    radius = config.guess_radius_m + 0.5 * config.standard.outer_m
    guess = FlangeGuess(X_CR.translation(), radius, X_CR.rotation().matrix()[:, 2])
    if config.foot:
        return fit_base_circle(points_C, config.standard, guess)
    return fit_flange(points_C, config.standard, guess=guess, config=LIVE_FIT)


def own_covariance(fit: FlangeFit, X_CR: RigidTransform) -> Array:
    """Covariance (6, 6) [rotation; translation] of a fitted circle in its own axes; for an arc it is not isotropic."""
    R = X_CR.rotation().matrix()
    out = np.zeros((6, 6))
    out[:3, :3] = fit.normal_sigma**2 * np.eye(3)
    out[3:, 3:] = R.T @ fit.center_covariance @ R
    return FIT_SHARE**2 * out


def fewest(scene: MountingScene) -> int:
    """Smallest number of observations to solve: six position equations more than unknowns, to estimate the noise."""
    return 2 + 2 * (len(scene.mounting.unknowns) - len(scene.known))


def solve_mounting(scene: MountingScene, seen: Sequence[SeenCircle], *, folds: int = 0) -> HandEyeResult:
    """Solve for the unknown poses with all observations; the starts are closed forms and the prior. Raises as solve_problem."""
    mounting, problem = scene.mounting, scene.problem([s.observation for s in seen])
    result = solve_problem(
        problem,
        scene.state,
        config=HandEyeConfig(folds=folds),
        equation=mounting.equation,
        starts=(scene.state,),
        labels=mounting.labels,
    )
    return with_stated_noise(problem, scene.state, result)


def sigma_of_work(scene: MountingScene, result: HandEyeResult) -> float:
    """Predicted error (3-D, rms, m) of a point at the scanner's best distance, in the frame that carries the scanner."""
    J = np.hstack([-skew(result.X.rotation().matrix() @ work_point(scene)), np.eye(3)])
    return float(np.sqrt(np.trace(J @ result.covariance["X"] @ J.T)))


def compare(label: str, fit: FlangeFit, belief: MountingScene, q: Array, q_2: Array | None) -> HeldOut:
    """Position error and tilt of a held-out circle against the calibration's prediction."""
    X_CR = belief.seen(q, q_2)
    cosine = float(np.clip(X_CR.rotation().matrix()[:, 2] @ fit.normal_C, -1.0, 1.0))
    return HeldOut(label, float(np.linalg.norm(X_CR.translation() - fit.center_C)), float(np.arccos(cosine)))


def next_best(
    belief: MountingScene, result: HandEyeResult, seen: Sequence[SeenCircle], plan: Sequence[MountingPose]
) -> NextBest | None:
    """The unvisited planned pose (all are reachable, visible and clear) that reduces the predicted error at the work point
    most; None where all were visited."""
    size = len(result.joint_covariance)
    own = np.median([np.diag(_covariance_of(s)) for s in seen], axis=0)
    left = [p for p in plan if all(float(np.abs(p.q - s.pose.q).max()) > 1e-2 for s in seen)]
    if not left:
        return None
    problem = belief.problem([s.observation for s in seen]).pick(result.inliers)
    taken = information_of(problem, belief.state)[0] + prior(belief)[:size, :size]
    more = information(belief, left, np.sqrt(own[3:]), float(np.sqrt(own[0])))[:, :size, :size]
    J = np.hstack([-skew(belief.X_LC.rotation().matrix() @ work_point(belief)), np.eye(3)])

    def at_work(total: Array) -> float:
        return float(np.sqrt(np.trace(J @ inverse_information(total)[:6, :6] @ J.T)))

    after = [at_work(taken + m) for m in more]
    best = left[int(np.argmin(after))]
    now = sigma_of_work(belief, result)
    return NextBest(best.q, best.q_2, belief.frames(best.q)[FLANGE], now, now * min(after) / at_work(taken))


def _covariance_of(seen: SeenCircle) -> Array:
    C = seen.observation.covariance
    return np.zeros((6, 6)) if C is None else C
