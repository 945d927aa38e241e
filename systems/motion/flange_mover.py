"""FlangeMover: moves the arm to a joint goal on a quintic synchronised path, as a stream of joint velocities."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, State

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, Message

FEEDBACK_PER_S = 8.0  # proportional correction towards the path
SETTLED_RAD = 2e-4  # a choice: 0.2 mm at 1 m of reach; scans use the measured pose, so that this is no error of theirs
SETTLED_RAD_S = 1e-3  # a choice: 1 mm/s at 1 m of reach; where measured velocities are noisier, REST_WINDOW_S decides
REST_WINDOW_S = 0.1  # over which the joints tell their mean speed, where the measured one is noisy


@dc.dataclass(frozen=True, eq=False)
class _Move(Message):
    """One move: from q_start at t_start to q_goal in duration s."""

    goal_id: int = 0
    t_start: float = 0.0
    duration: float = 0.0
    q_start: NDArray[np.float64] = dc.field(default_factory=lambda: np.zeros(6))
    q_goal: NDArray[np.float64] = dc.field(default_factory=lambda: np.zeros(6))


def move_duration(
    q_start: NDArray[np.float64], q_goal: NDArray[np.float64], speed: float, acceleration: float
) -> float:
    """Shortest duration (s) of a quintic rest-to-rest path within joint speed (rad/s) and acceleration (rad/s^2).

    The quintic 10 s^3 - 15 s^4 + 6 s^5 peaks at 15/8 of the mean speed and at 10/sqrt(3) of distance / duration^2.
    """
    distance = float(np.max(np.abs(q_goal - q_start)))
    return max(1.875 * distance / speed, float(np.sqrt(10.0 / np.sqrt(3.0) * distance / acceleration)), 0.05)


def quintic(
    q_start: NDArray[np.float64], q_goal: NDArray[np.float64], u: float, duration: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Position (6,) and velocity (6,) of the path at the fraction u in [0, 1] of its duration."""
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    ds = 30.0 * u * u * (1.0 - u) ** 2 / duration
    return q_start + s * (q_goal - q_start), ds * (q_goal - q_start)


class FlangeMover(LeafSystem):
    """Moves the arm while the job's mode is `move`.

    .. pydrake_system::

        name: FlangeMover
        input_ports:
        - job
        - position_measured
        - velocity_measured
        output_ports:
        - velocity
        - settled_goal

    `velocity` (6) rad/s. `settled_goal` (1) is the id of the newest goal at which the arm has come to rest: by its
    measured velocity, or, where that is noisier than SETTLED_RAD_S, by how little the joints have turned in
    REST_WINDOW_S. The path is straight in joint space: every goal of the cell is a checked configuration, and the
    channel is joint velocity.
    """

    def __init__(self, speed: float = 1.0, acceleration: float = 2.5, period_s: float = 0.008) -> None:
        super().__init__()
        self._speed, self._acceleration = speed, acceleration
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._position = self.DeclareVectorInputPort("position_measured", 6)
        self._velocity = self.DeclareVectorInputPort("velocity_measured", 6)
        self._move = self.DeclareAbstractState(AbstractValue.Make(_Move()))
        self._commanded = self.DeclareDiscreteState(np.zeros(6))
        self._settled = self.DeclareDiscreteState(1)
        # the time, s, at which the present window began, and the least and greatest joint angles in it, rad
        self._window = self.DeclareDiscreteState(13)
        self.DeclareStateOutputPort("velocity", self._commanded)
        self.DeclareStateOutputPort("settled_goal", self._settled)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        job: JobCommand = self._job.Eval(context)
        move: _Move = context.get_abstract_state(self._move).get_value()
        out, velocity = state.get_mutable_discrete_state(), np.zeros(6)
        if job.mode == "move" and job.q_goal is not None:
            now, q = context.get_time(), self._position.Eval(context)
            if job.goal_id != move.goal_id:
                duration = move_duration(q, job.q_goal, job.speed_share * self._speed, self._acceleration)
                move = _Move(job.goal_id, now, duration, np.array(q), np.array(job.q_goal))
                state.get_mutable_abstract_state(self._move).set_value(move)
            u = min((now - move.t_start) / move.duration, 1.0)
            q_path, v_path = quintic(move.q_start, move.q_goal, u, move.duration)
            velocity = v_path + FEEDBACK_PER_S * (q_path - q)
            at_rest = np.max(np.abs(self._velocity.Eval(context))) < SETTLED_RAD_S
            window = context.get_discrete_state(self._window).value()
            begun, least, greatest = window[0], np.minimum(window[1:7], q), np.maximum(window[7:], q)
            if u < 1.0 or begun < move.t_start:
                begun, least, greatest = now, q, q
            elif now - begun >= REST_WINDOW_S:
                at_rest = at_rest or float(np.max(greatest - least)) < SETTLED_RAD_S * (now - begun)
                begun, least, greatest = now, q, q
            out.set_value(self._window, [begun, *least, *greatest])
            if u >= 1.0 and at_rest and np.max(np.abs(q - move.q_goal)) < SETTLED_RAD:
                out.set_value(self._settled, [move.goal_id])
        out.set_value(self._commanded, velocity)
