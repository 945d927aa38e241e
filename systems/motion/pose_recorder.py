"""PoseRecorder: stores recent joint positions, so that a sensor's datum is paired with the arm's pose at its capture
time."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, State

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message

LENGTH_S = 10.0  # an estimate of a scan is paired with its pose when it is ready, which a job waits 8 s for


@dataclass(frozen=True, eq=False)
class PoseHistory(Message):
    """Recent times (n,) s, ascending, and joint positions (n, 6) rad."""

    times: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    positions: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 6)))

    def joints_at(self, time: float) -> NDArray[np.float64] | None:
        """Joint positions (6,) rad interpolated to `time` s; None where `time` is more than one sample outside the
        history."""
        t = self.times
        if t.size < 2 or not t[0] <= time <= t[-1] + (t[-1] - t[-2]):
            return None
        k = int(np.clip(np.searchsorted(t, time), 1, t.size - 1))
        w = (time - t[k - 1]) / (t[k] - t[k - 1])
        return np.asarray((1.0 - w) * self.positions[k - 1] + w * self.positions[k])

    def pose_at(self, arm: ArmModel, time: float) -> RigidTransform | None:
        """Flange pose X_BF at `time` s; None as in joints_at."""
        q = self.joints_at(time)
        return None if q is None else tick_flange_pose(arm, q)


class PoseRecorder(LeafSystem):
    """Keeps a ring of joint positions with their sample times.

    .. pydrake_system::

        name: PoseRecorder
        input_ports:
        - position_measured
        - sample_time
        output_ports:
        - history
    """

    def __init__(self, period_s: float = 0.008, length_s: float = LENGTH_S) -> None:
        super().__init__()
        self._length = int(length_s / period_s)
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._state = self.DeclareAbstractState(AbstractValue.Make(PoseHistory()))
        self.DeclareStateOutputPort("history", self._state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._record)

    def _record(self, context: Context, state: State) -> None:
        old: PoseHistory = context.get_abstract_state(self._state).get_value()
        time = float(self._time.Eval(context)[0])
        if old.times.size and time <= old.times[-1]:
            return
        n = min(old.times.size, self._length)
        times, positions = np.empty(n + 1), np.empty((n + 1, 6))
        times[:n], positions[:n] = old.times[old.times.size - n :], old.positions[old.times.size - n :]
        times[n], positions[n] = time, self._position.Eval(context)
        state.get_mutable_abstract_state(self._state).set_value(PoseHistory(times, positions))
