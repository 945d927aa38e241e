"""CalibrationPosePlanner: says which of the checked poses the flange should visit next."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem, State

from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.systems.messages import CalibrationStatus, Message


@dc.dataclass(frozen=True, eq=False)
class NextPose(Message):
    """The pose to visit after the calibration status with this sequence number; q (6,) rad, None when none is left."""

    after_sequence: int = -1
    index: int = 0
    label: str = ""
    q: NDArray[np.float64] | None = None


class CalibrationPosePlanner(LeafSystem):
    """Walks through the planned poses, the most telling first, one for each scan the calibrator has digested.

    .. pydrake_system::

        name: CalibrationPosePlanner
        input_ports:
        - calibration_status
        output_ports:
        - next_pose

    The plan is made (and refused, where the scanner cannot be reached) before anything moves: pose_planning orders it
    greedily by the information each pose adds, so its beginning is always the best set of that size.
    """

    def __init__(self, plan: tuple[PlannedPose, ...], period_s: float = 0.02) -> None:
        super().__init__()
        self._plan = plan
        self._status = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._state = self.DeclareAbstractState(
            AbstractValue.Make(NextPose(-1, 0, "pose01", plan[0].q if plan else None))
        )
        self.DeclareStateOutputPort("next_pose", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        status: CalibrationStatus = self._status.Eval(context)
        newest: NextPose = context.get_abstract_state(self._state).get_value()
        if status.sequence <= newest.after_sequence:
            return
        index = status.sequence  # one pose a scan
        q = self._plan[index].q if index < len(self._plan) else None
        new = NextPose(status.sequence, index, f"pose{index + 1:02d}", q)
        state.get_mutable_abstract_state(self._state).set_value(new)
