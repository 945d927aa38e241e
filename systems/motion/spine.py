"""Builds the spine shared by all jobs.

Pose recorder, mover, arbiter and limiter for each arm, operator hold, process switch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, OutputPort, System

from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.drivers.simulated.second_arm import FIRST
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import JobCommand, UrStatus
from weldcal.systems.motion.buffers import PoseRecorder
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.operator import FASTEST, Operator
from weldcal.systems.viewer.kept import keep
from weldcal.systems.wiring import Wiring
from weldcal.welding.servo.guards import SlewLimits, slew_limit

HOLD_BUTTON = "Hold the job"
PACE_SLIDER = "Pace (1 = real time, 0 = as fast as it goes)"
PERIOD_S = 0.008  # two periods of the commands; an operator notices no delay below 0.1 s


class OperatorPanel(LeafSystem):
    """Reads the operator's wishes and the controls of the viewer at 125 Hz.

    .. pydrake_system::

        name: OperatorPanel
        output_ports:
        - hold
        - end
        - pace

    `hold` (1) is 1.0 while an operator holds the run. `end` (1) is 1.0 once an operator has ended it, for good. `pace`
    (1) is the requested real-time rate, 0 to 3; other values are ignored. A click of the viewer's button holds the run.
    Any page of this computer's browsers can reach the viewer, so that nothing there may let it go on.
    """

    def __init__(self, operator: Operator, meshcat: Meshcat | None = None, period_s: float = PERIOD_S) -> None:
        super().__init__()
        self._operator, self._meshcat = operator, None if meshcat is None else keep(meshcat)
        pace = operator.pace or 0.0
        if meshcat is not None:
            meshcat.AddButton(HOLD_BUTTON, "Escape")
            meshcat.AddSlider(PACE_SLIDER, 0.0, FASTEST, 0.1, pace)
        self._hold, self._end = self.DeclareDiscreteState(1), self.DeclareDiscreteState(1)
        self._pace = self.DeclareDiscreteState([pace])
        self._seen = self.DeclareDiscreteState([0.0, pace])  # clicks, and the pace that was asked for
        self.DeclareStateOutputPort("hold", self._hold)
        self.DeclareStateOutputPort("end", self._end)
        self.DeclareStateOutputPort("pace", self._pace)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._read)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        clicks, before = discrete.value(self._seen)
        pace = float(discrete.value(self._pace)[0])
        operator = self._operator
        asked = before if operator.pace is None else operator.pace
        if self._meshcat is not None:
            if asked != before:
                self._meshcat.SetSliderValue(PACE_SLIDER, asked)
            slider = self._meshcat.GetSliderValue(PACE_SLIDER)
            pace = slider if 0.0 <= slider <= FASTEST else pace
            if (now := float(self._meshcat.GetButtonClicks(HOLD_BUTTON))) > clicks:
                operator.hold("the 3D view")
            clicks = now
        elif asked != before:
            pace = asked
        discrete.set_value(self._hold, [float(operator.holds)])
        discrete.set_value(self._pace, [pace])
        discrete.set_value(self._seen, [clicks, asked])
        if operator.ends:  # for good
            discrete.set_value(self._end, [1.0])


class ProcessSwitch(LeafSystem):
    """Passes on the servo's torch request while robot, guard and operator allow it.

    .. pydrake_system::

        name: ProcessSwitch
        input_ports:
        - torch_wanted
        - job
        - robot_status
        - margin
        - hold
        output_ports:
        - process_on
        - arm_stopped

    `torch_wanted` (1) of the servo; `margin` (2) of the SingularityGuard, whose second number is 1 while it stops the
    arm; `hold` (1) of the operator. `process_on` (1) follows all inputs without delay. The arm's command passes through
    the arbiter and the slew limiter, so the torch is off no later than the first tick in which the arm is commanded to
    stop. A burning torch that the robot's status or the guard turned off stays off for the rest of that weld. After a
    operator's hold the servo asks for it anew, when it is let go and has gone back. `arm_stopped` (1): the guard turned
    it off; the JobSequencer then holds the job.
    """

    def __init__(self, period_s: float = 0.002) -> None:
        super().__init__()
        self._wanted = self.DeclareVectorInputPort("torch_wanted", 1)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._margin = self.DeclareVectorInputPort("margin", 2)
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._off = self.DeclareDiscreteState(1)  # turned off for this weld
        self._stopped_by_guard = self.DeclareDiscreteState(1)
        ticket = {self.all_input_ports_ticket(), self.discrete_state_ticket(self._off)}
        self.DeclareVectorOutputPort("process_on", 1, self._process, ticket)
        self.DeclareStateOutputPort("arm_stopped", self._stopped_by_guard)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._latch)

    def _stopped(self, context: Context) -> bool:
        return bool(self._margin.Eval(context)[1] > 0.5)

    def _free(self, context: Context) -> bool:
        """Return whether robot and guard both allow the process."""
        return bool(self._status.Eval(context).ready and not self._stopped(context))

    def _latch(self, context: Context, discrete: DiscreteValues) -> None:
        if self._job.Eval(context).mode != "weld":
            discrete.set_value(self._off, [0.0])
            discrete.set_value(self._stopped_by_guard, [0.0])
        elif self._wanted.Eval(context)[0] > 0.5 and not self._free(context):
            discrete.set_value(self._off, [1.0])
            if self._stopped(context):
                discrete.set_value(self._stopped_by_guard, [1.0])

    def _process(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        off = context.get_discrete_state(self._off).value()[0] > 0.5
        consent = job.process_on and not job.held and self._wanted.Eval(context)[0] > 0.5
        held = self._hold.Eval(context)[0] > 0.5
        output.SetAtIndex(0, float(consent and not off and not held and self._free(context)))


class SlewLimiter(LeafSystem):
    """Follows the commanded joint velocity as fast as its limits allow.

    .. pydrake_system::

        name: SlewLimiter
        input_ports:
        - velocity_wanted
        output_ports:
        - velocity_command

    Both (6) rad/s. A commanded velocity that is not finite makes it slow down to rest.
    """

    def __init__(self, limits: SlewLimits, period_s: float = 0.002) -> None:
        super().__init__()
        self._limits, self._period_s = SlewLimits(*limits.rows(6)), period_s
        # the first call loads machine code, which no tick has time for
        slew_limit(np.zeros(6), np.zeros(6), np.zeros(6), self._limits, period_s)
        self._wanted = self.DeclareVectorInputPort("velocity_wanted", 6)
        self._velocity = self.DeclareDiscreteState(np.zeros(6))
        self._acceleration = self.DeclareDiscreteState(np.zeros(6))
        self.DeclareStateOutputPort("velocity_command", self._velocity)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        v, a = discrete.value(self._velocity), discrete.value(self._acceleration)
        v, a = slew_limit(self._wanted.Eval(context), v, a, self._limits, self._period_s)
        discrete.set_value(self._velocity, v)
        discrete.set_value(self._acceleration, a)


class CommandArbiter(LeafSystem):
    """Outputs the velocity of the source that the job's mode selects, and zero while the job or the robot holds.

    .. pydrake_system::

        name: CommandArbiter
        input_ports:
        - job
        - robot_status
        - mover_velocity
        - servo_velocity
        output_ports:
        - velocity_wanted
    """

    def __init__(self) -> None:
        super().__init__()
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self._mover = self.DeclareVectorInputPort("mover_velocity", 6)
        self._servo = self.DeclareVectorInputPort("servo_velocity", 6)
        self.DeclareVectorOutputPort("velocity_wanted", 6, self._choose, {self.all_input_ports_ticket()})

    def _choose(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        if not self._status.Eval(context).ready or job.mode not in ("move", "weld"):
            output.SetFromVector(np.zeros(6))
        else:
            output.SetFromVector((self._mover if job.mode == "move" else self._servo).Eval(context))


MOVE_SPEED, MOVE_ACCELERATION = 1.0, 2.5  # rad/s and rad/s^2 of the fastest joint, at speed_factor 1
MOVE_TIMEOUT_S = 20.0  # at speed_factor 1
HOLD, END = "operator.hold", "operator.end"  # in a recording
JERK_LIMIT = 150.0  # rad/s^3: 100 ms to the acceleration limit of the large joints
SPEED_SHARE, ACCELERATION_SHARE = 0.6, 0.5  # of the arm's own limits


@dataclass(frozen=True, eq=False, kw_only=True)
class JobPorts:
    """The output ports of a job that the spine, the log and the run loop read.

    `commands`: a JobCommand for each arm. `velocity` (6) rad/s drives the first arm while its command's mode is `weld`.
    `torch_wanted` (1) and `margin` (2) go to the ProcessSwitch. `logged`: vector ports by their name in the log.
    `results`: ports whose values a recording keeps, by name. `shown`: ports with messages that the dashboard shows, by
    name.
    """

    commands: tuple[OutputPort, ...]
    state: OutputPort
    velocity: OutputPort | None = None
    torch_wanted: OutputPort | None = None
    margin: OutputPort | None = None
    logged: dict[str, OutputPort] = field(default_factory=dict)
    results: dict[str, OutputPort] = field(default_factory=dict)
    shown: dict[str, OutputPort] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class SpineArm:
    """One arm of the spine: the ports that a job reads, and the systems that drive the arm."""

    prefix: str
    position: OutputPort
    status: OutputPort
    history: OutputPort
    mover: FlangeMover
    arbiter: CommandArbiter
    error: System | None

    @property
    def settled_goal(self) -> OutputPort:
        """Id (1) of the newest goal at which the arm has come to rest."""
        return self.mover.GetOutputPort("settled_goal")


@dataclass(frozen=True, eq=False)
class Spine:
    """The shared systems: `hold` (1) is 1.0 while an operator holds the run, `end` (1) once an operator has ended it.

    `switch` outputs `process_on` and `arm_stopped`.
    """

    wiring: Wiring
    arms: tuple[SpineArm, ...]
    hold: OutputPort
    end: OutputPort
    switch: ProcessSwitch

    @property
    def arm(self) -> SpineArm:
        """The first arm."""
        return self.arms[0]

    def serve(self, procedure: LeafSystem, **sources: OutputPort) -> None:
        """Connect the ports of a job's procedure: those that the spine knows by their names, and `sources`."""
        first = self.arm
        known = {
            **dict.fromkeys(("position_measured", "position"), first.position),
            "settled_goal": first.settled_goal,
            "robot_status": first.status,
            "history": first.history,
            "hold": self.end,
        }
        known = {name: port for name, port in known.items() if procedure.HasInputPort(name)}
        self.wiring.connect(procedure, **known, **sources)

    def connect(self, job: JobPorts) -> None:
        """Connect the ports of the job."""
        w, first = self.wiring, self.arm
        for arm, command in zip(self.arms, job.commands, strict=True):
            w.connect(arm.mover, job=command)
            velocity = job.velocity if arm is first else None
            w.connect(
                arm.arbiter,
                job=command,
                servo_velocity=w.zeros(f"no_servo_velocity_{arm.prefix}", 6) if velocity is None else velocity,
            )
            if arm.error is not None:
                w.connect(arm.error, job=command)
        w.connect(
            self.switch,
            torch_wanted=job.torch_wanted or w.zeros("no_torch", 1),
            job=job.commands[0],
            robot_status=first.status,
            margin=job.margin or w.zeros("no_margin", 2),
            hold=self.hold,
        )
        process = self.switch.GetOutputPort("process_on")
        w.builder.ExportOutput(process, "process_on")
        for port in (f"{FIRST}.process_on", "power_source.process_on"):
            if w.station.diagram.HasInputPort(port):
                w.feed(port, process)


def add_spine(
    wiring: Wiring,
    arms: Sequence[tuple[str, ArmModel]],
    speed: float = MOVE_SPEED,
    acceleration: float = MOVE_ACCELERATION,
    error: System | None = None,
) -> Spine:
    """Add the spine's systems and make the connections that do not depend on the job.

    Args:
        wiring: the cell under construction.
        arms: prefix of the station's ports and model of each arm, the first arm first.
        speed, acceleration: of moves, rad/s and rad/s^2 of the fastest joint at speed_factor 1.
        error: a system with the ports `position_measured`, `job` and `position`, between the first arm and its readers.
    """
    w, factor, made = wiring, wiring.scenario.job.speed_factor, []
    for k, (prefix, model) in enumerate(arms):
        suffix = "" if k == 0 else f"_{k + 1}"
        measured, own_error = w.out(f"{prefix}.position_measured"), error if k == 0 else None
        if own_error is not None:
            w.add("robot_error", own_error)
            w.connect(own_error, position_measured=measured)
            measured = own_error.GetOutputPort("position")
        recorder = w.add(f"pose_recorder{suffix}", PoseRecorder())
        w.connect(recorder, position_measured=measured, sample_time=w.out(f"{prefix}.sample_time"))
        mover = w.add(f"flange_mover{suffix}", FlangeMover(speed * factor, acceleration * factor))
        w.connect(mover, position_measured=measured, velocity_measured=w.out(f"{prefix}.velocity_measured"))
        status = w.out(f"{prefix}.status")
        arbiter = w.add(f"command_arbiter{suffix}", CommandArbiter())
        w.connect(arbiter, robot_status=status, mover_velocity=mover.GetOutputPort("velocity"))
        limits = SlewLimits(
            speed=SPEED_SHARE * model.velocity_limit,
            acceleration=ACCELERATION_SHARE * model.acceleration_limit,
            jerk=JERK_LIMIT,
        )
        limiter = w.add(f"slew_limiter{suffix}", SlewLimiter(limits))
        w.connect(limiter, velocity_wanted=arbiter.GetOutputPort("velocity_wanted"))
        w.feed(f"{prefix}.velocity_command", limiter.get_output_port())
        made.append(
            SpineArm(
                prefix=prefix,
                position=measured,
                status=status,
                history=recorder.GetOutputPort("history"),
                mover=mover,
                arbiter=arbiter,
                error=own_error,
            )
        )
    hold, end = _operator(w)
    return Spine(w, tuple(made), hold, end, w.add("process_switch", ProcessSwitch()))


def _operator(w: Wiring) -> tuple[OutputPort, OutputPort]:
    """What an operator asks for, or asked for in a recording that is played back: to hold, to end."""
    if all(w.station.diagram.HasOutputPort(name) for name in (HOLD, END)):
        return w.out(HOLD), w.out(END)
    if w.operator is None:
        return w.zeros("nobody_holds", 1), w.zeros("nobody_ends", 1)
    panel = w.add("operator_panel", OperatorPanel(w.operator, w.meshcat))
    w.read[HOLD], w.read[END] = panel.GetOutputPort("hold"), panel.GetOutputPort("end")
    return w.read[HOLD], w.read[END]
