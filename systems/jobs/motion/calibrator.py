"""MotionCalibrator: estimates X_BC and the scanner's clock from what was collected in motion."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context

from weldcal.calibration.data.motion_dataset import RobotStream
from weldcal.calibration.motion.estimate import estimate_in_motion
from weldcal.calibration.motion.frames import observed_frames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.errors import WeldcalError
from weldcal.systems.background import Answer, Background
from weldcal.systems.background_system import BackgroundSystem
from weldcal.systems.jobs.motion.messages import MotionCalibration, MotionRecord, MotionState


class MotionCalibrator(BackgroundSystem):
    """Calibrates when the procedure asks for it, beside the control loop.

    .. pydrake_system::

        name: MotionCalibrator
        input_ports:
        - record
        - state
        output_ports:
        - calibration
    """

    def __init__(self, arm: ArmModel, background: Background | None = None, period_s: float = 0.02) -> None:
        super().__init__("calibration", MotionCalibration(), background, period_s)
        self._arm = arm
        self._record = self.DeclareAbstractInputPort("record", AbstractValue.Make(MotionRecord()))
        self._job = self.DeclareAbstractInputPort("state", AbstractValue.Make(MotionState()))

    def ask(self, context: Context, newest: MotionCalibration) -> Answer[MotionCalibration] | None:
        """Ask for the calibration once, when everything has been collected."""
        if newest.asked or self._job.Eval(context).phase != "calibrate":
            return None
        return self.background.ask(calibrate_record, self._record.Eval(context), self._arm)


def calibrate_record(record: MotionRecord, arm: ArmModel) -> MotionCalibration:
    """Calibrate from a record; without a result, the reason is given and no exception is raised.

    The robot's own kinematics are used, so that its factory calibration counts.
    """
    try:
        frames = observed_frames([f for f, _ in record.seen], {f.id: fit for f, fit in record.seen})
        return MotionCalibration(1, estimate_in_motion(frames, ContinuousMotion(posed_stream(record, arm))))
    except WeldcalError as error:
        return MotionCalibration(1, reason=str(error))


def posed_stream(record: MotionRecord, arm: ArmModel) -> RobotStream:
    """The robot's stream as flange poses by its own kinematics."""
    stream = record.stream(arm.name)
    assert stream.joints is not None
    poses = np.array([forward_kinematics(arm, q).GetAsMatrix4() for q in stream.joints])
    return RobotStream(stream.time, poses, None, arm.name)
