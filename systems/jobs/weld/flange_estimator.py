"""FlangeEstimator: fits the circle of the flange (or of the tool's flange-like ring) in each scan."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.face import IN_MOTION
from weldcal.calibration.flange.fit import FlangeFitConfig, FlangeGuess, face_cloud, fit_flange
from weldcal.calibration.flange.holes import find_holes
from weldcal.calibration.flange.warm_up import warm_up
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand, Scan, StreamedScan
from weldcal.systems.motion.buffers import PoseHistory

_CLOCKS_APART_S = 0.2  # a device's time that is further from the arrival's has jumped
_COARSE = 8  # rows and columns of a scan between those that are looked at
_NEAR_M = 0.03  # of a frame's flange from its prediction by the frame before
# The poses are planned with the whole feature visible; otherwise an object occludes it and the rim's ends are wrong.
LIVE_FIT = FlangeFitConfig(min_coverage=0.85)
STREAM_FIT = dc.replace(IN_MOTION, min_coverage=0.6)  # at the edge of the view the rim's ends are wrong


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

    It takes the scan that the job ordered, and every frame of a streaming scanner. The search sphere is centred at the
    feature's position predicted from the nominal X_BC, of a streamed frame from the newest one, and the arm's pose at
    the capture time: a dataset of the same scans is searched alike.
    A streamed frame's capture time is taken from its stamp and `delay_s`, the nominal time from capture to arrival; the
    prediction is corrected by what the frame before it showed. The fit runs beside the control loop.
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
        delay_s: float = 0.0,
    ) -> None:
        super().__init__("flange_estimate", FlangeEstimate(), background, period_s)
        self.background.prepare(warm_up)
        self._arm, self._X_FR, self._standard = arm, X_FR, standard
        self._X_BC_guess, self._guess_radius_m, self._delay_s = X_BC_guess, guess_radius_m, delay_s
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._status = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))

    def ask(self, context: Context, newest: FlangeEstimate) -> Answer[FlangeEstimate] | None:
        """Ask for the estimate of a new calibration scan."""
        scan: Scan = self._scan.Eval(context)
        if isinstance(scan, StreamedScan):
            return self._ask_streamed(context, scan, newest)
        job: JobCommand = self._job.Eval(context)
        if scan.sequence <= newest.sequence or scan.sequence != job.scan_sequence or job.scan_purpose == "workpiece":
            return None
        X_BF = self._history.Eval(context).pose_at(self._arm, scan.capture_time)
        return self.background.ask(
            estimate_flange, scan, job, X_BF, self._X_FR, self._standard, self._X_BC_guess, self._guess_radius_m
        )

    def _ask_streamed(
        self, context: Context, scan: StreamedScan, newest: FlangeEstimate
    ) -> Answer[FlangeEstimate] | None:
        """Ask for the estimate of a streamed frame."""
        if scan.sequence <= newest.sequence:
            return None
        capture = believed_capture(scan, newest, self._delay_s)
        X_BF = self._history.Eval(context).pose_at(self._arm, capture)
        base = FlangeEstimate(
            sequence=scan.sequence,
            capture_time=capture,
            purpose="stream",
            arrival_time=scan.arrival_time,
            device_time=scan.device_time,
        )
        if X_BF is None:
            done = dc.replace(base, reason="the arm's pose at the time of the frame is not known")
            return self.background.ask(_as_it_is, done)
        status: CalibrationStatus = self._status.Eval(context)
        X_CR = (status.X_BC or self._X_BC_guess).InvertAndCompose(X_BF @ self._X_FR)
        guess = streamed_guess(X_CR, newest, self._guess_radius_m, self._standard)
        base = dc.replace(base, center_expected_C=X_CR.translation())
        # only what may show the flange travels to the computing process: a whole frame takes longer to copy than to fit
        points = points_about(scan.points_C, guess.center_C, guess.radius_m)
        return self.background.ask(estimate_streamed, base, points, guess, self._standard)


def believed_capture(scan: StreamedScan, newest: FlangeEstimate, delay_s: float) -> float:
    """When a frame was captured, s.

    By the device's time since the frame before where both have one, else by its arrival.
    """
    by_arrival = scan.arrival_time - delay_s
    if scan.device_time is None or newest.device_time is None:
        return by_arrival
    by_device = newest.capture_time + scan.device_time - newest.device_time
    # frames are late and never early: the earliest arrival says most
    return min(by_device, by_arrival) if abs(by_device - by_arrival) < _CLOCKS_APART_S else by_arrival


def streamed_guess(
    X_CR: RigidTransform, before: FlangeEstimate, radius_m: float, standard: FlangeStandard
) -> FlangeGuess:
    """Where to look in a frame: at the robot's X_CR, shifted as the frame before was.

    In ``radius_m`` where that shows nothing.
    """
    expected = X_CR.translation()
    if before.fit is not None and before.center_expected_C is not None:
        expected = expected + before.fit.center_C - before.center_expected_C
        radius_m = min(radius_m, _NEAR_M)
    return FlangeGuess(expected, radius_m + 0.5 * standard.outer_m, X_CR.rotation().matrix()[:, 2])


def points_about(points_C: NDArray[np.float32], center_C: Array, radius_m: float) -> NDArray[np.float32]:
    """The rows and columns (h, w, 3) of a scan (H, W, 3) m with all points within ``radius_m`` of a place, and more.

    The whole scan where a coarse look finds none.
    """
    coarse = points_C[::_COARSE, ::_COARSE]
    with np.errstate(invalid="ignore"):
        near = np.square(coarse - np.asarray(center_C, dtype=np.float32)).sum(axis=2) < (1.2 * radius_m) ** 2
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if not len(rows):
        return points_C
    r, c = ((max(int(k[0]) - 1, 0) * _COARSE, (int(k[-1]) + 2) * _COARSE) for k in (rows, columns))
    return points_C[r[0] : r[1], c[0] : c[1]].copy()


def _as_it_is(estimate: FlangeEstimate) -> FlangeEstimate:
    return estimate


def estimate_streamed(
    base: FlangeEstimate, points_C: NDArray[np.float32], guess: FlangeGuess, standard: FlangeStandard
) -> FlangeEstimate:
    """Fit the feature in a streamed frame near the guess.

    Without a fit, the reason is given and no exception is raised.
    """
    try:
        return dc.replace(base, fit=fit_flange(points_C.astype(float), standard, guess=guess, config=STREAM_FIT))
    except FlangeNotFound as error:
        return dc.replace(base, reason=str(error))


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
    base = FlangeEstimate(
        sequence=scan.sequence, capture_time=scan.capture_time, purpose=job.scan_purpose, label=job.scan_label
    )
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
    pattern = find_holes(points, fit, standard)
    return dc.replace(base, fit=fit, pattern=pattern, points_C=face_cloud(points, fit, standard))
