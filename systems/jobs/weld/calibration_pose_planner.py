"""CalibrationPosePlanner: outputs the next of the checked calibration poses."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, State

from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, Message


@dc.dataclass(frozen=True, eq=False)
class NextPose(Message):
    """The pose to visit after the calibration status with this sequence number; q (6,) rad, None when none is left."""

    after_sequence: int = -1
    index: int = 0
    label: str = ""
    q: NDArray[np.float64] | None = None


class CalibrationPosePlanner(LeafSystem):
    """Steps through the planned poses, the most informative first, one for each scan that the calibrator has processed.

    .. pydrake_system::

        name: CalibrationPosePlanner
        input_ports:
        - calibration_status
        output_ports:
        - next_pose

    The plan is made before any motion (and raises where the scanner cannot be reached). pose_planning orders it greedily by
    the information that each pose adds, so that each prefix is the greedy set of that size.
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
        index = status.sequence  # one pose per scan
        q = self._plan[index].q if index < len(self._plan) else None
        new = NextPose(status.sequence, index, f"pose{index + 1:02d}", q)
        state.get_mutable_abstract_state(self._state).set_value(new)
