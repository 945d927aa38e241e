"""FlangeEstimator: fits the circle of the flange (or of the tool's flange-like ring) in each scan."""

import dataclasses as dc

from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import FlangeFitConfig, FlangeGuess, fit_flange
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.calibration.published.icp import face_cloud
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.flanges import FlangeStandard
from weldcal.systems.background import Answer, Background
from weldcal.systems.background_system import BackgroundSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand, Scan
from weldcal.systems.motion.pose_recorder import PoseHistory

# The poses are planned with the whole feature visible; otherwise an object occludes it and the rim's ends are wrong.
LIVE_FIT = FlangeFitConfig(min_coverage=0.85)


class FlangeEstimator(BackgroundSystem):
    """Fits the flange in each calibration scan, near its predicted position.

    .. pydrake_system::

        name: FlangeEstimator
        input_ports:
        - scan
        - job
        - history
        - calibration_status
        output_ports:
        - flange_estimate

    The search sphere is centred at the feature's position predicted from the newest X_BC (at first the nominal one) and the
    arm's pose at the capture time. The fit runs beside the control loop.
    """

    def __init__(
        self,
        arm: ArmModel,
        X_FR: RigidTransform,
        standard: FlangeStandard,
        X_BC_guess: RigidTransform,
        guess_radius_m: float,
        background: Background | None = None,
        period_s: float = 0.02,
    ) -> None:
        super().__init__("flange_estimate", FlangeEstimate(), background, period_s)
        self.background.prepare(warm_up)
        self._arm, self._X_FR, self._standard = arm, X_FR, standard
        self._X_BC_guess, self._guess_radius_m = X_BC_guess, guess_radius_m
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._status = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))

    def ask(self, context: Context, newest: FlangeEstimate) -> Answer[FlangeEstimate] | None:
        """Ask for the estimate of a new calibration scan."""
        scan: Scan = self._scan.Eval(context)
        job: JobCommand = self._job.Eval(context)
        if scan.sequence <= newest.sequence or scan.sequence != job.scan_sequence or job.scan_purpose == "workpiece":
            return None
        status: CalibrationStatus = self._status.Eval(context)
        X_BF = self._history.Eval(context).pose_at(self._arm, scan.capture_time)
        X_BC = status.X_BC or self._X_BC_guess
        return self.background.ask(
            estimate_flange, scan, job, X_BF, self._X_FR, self._standard, X_BC, self._guess_radius_m
        )


def estimate_flange(
    scan: Scan,
    job: JobCommand,
    X_BF: RigidTransform | None,
    X_FR: RigidTransform,
    standard: FlangeStandard,
    X_BC: RigidTransform,
    guess_radius_m: float,
) -> FlangeEstimate:
    """Fit the feature in one scan; for an unusable scan the result holds the reason, and no exception is raised."""
    base = FlangeEstimate(scan.sequence, scan.capture_time, job.scan_purpose, job.scan_label)
    if X_BF is None:
        return dc.replace(base, reason="the arm's pose at the time of the scan is not known")
    X_CR = X_BC.InvertAndCompose(X_BF @ X_FR)
    radius = guess_radius_m + 0.5 * standard.outer_m
    guess = FlangeGuess(center_C=X_CR.translation(), radius_m=radius, normal_C=X_CR.rotation().matrix()[:, 2])
    points = scan.points_C.astype(float)
    try:
        fit = fit_flange(points, standard, guess=guess, config=LIVE_FIT)
    except FlangeNotFound as error:
        return dc.replace(base, reason=str(error))
    return dc.replace(base, fit=fit, points_C=face_cloud(points, fit, standard))
