"""Builds the spine shared by all jobs: pose recorder, mover, arbiter and limiter for each arm, operator hold, process switch."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from pydrake.systems.framework import LeafSystem, OutputPort

from weldcal.models.arms.kinematics import ArmModel
from weldcal.systems.drivers.simulated.second_arm import FIRST
from weldcal.systems.motion.command_arbiter import CommandArbiter
from weldcal.systems.motion.flange_mover import FlangeMover
from weldcal.systems.motion.operator_panel import OperatorPanel
from weldcal.systems.motion.pose_recorder import PoseRecorder
from weldcal.systems.motion.process_switch import ProcessSwitch
from weldcal.systems.motion.slew_limiter import SlewLimiter
from weldcal.systems.wiring import Wiring
from weldcal.welding.servo.guards import SlewLimits

MOVE_SPEED, MOVE_ACCELERATION = 1.0, 2.5  # rad/s and rad/s^2 of the fastest joint, at speed_factor 1
MOVE_TIMEOUT_S = 20.0  # at speed_factor 1
HOLD, END = "operator.hold", "operator.end"  # in a recording
JERK_LIMIT = 150.0  # rad/s^3: 100 ms to the acceleration limit of the large joints
SPEED_SHARE, ACCELERATION_SHARE = 0.6, 0.5  # of the arm's own limits


@dataclass(frozen=True, eq=False, kw_only=True)
class JobPorts:
    """The output ports of a job that the spine, the log and the run loop read.

    `commands`: a JobCommand for each arm. `velocity` (6) rad/s drives the first arm while its command's mode is `weld`.
    `torch_wanted` (1) and `margin` (2) go to the ProcessSwitch. `logged`: vector ports by their name in the log. `results`:
    ports whose values a recording keeps, by name. `shown`: ports with messages that the dashboard shows, by name.
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
    error: LeafSystem | None

    @property
    def settled_goal(self) -> OutputPort:
        """Id (1) of the newest goal at which the arm has come to rest."""
        return self.mover.GetOutputPort("settled_goal")


@dataclass(frozen=True, eq=False)
class Spine:
    """The shared systems: `hold` (1) is 1.0 while a person holds the run, `end` (1) once a person has ended it; `switch` outputs
    `process_on` and `arm_stopped`."""

    wiring: Wiring
    arms: tuple[SpineArm, ...]
    hold: OutputPort
    end: OutputPort
    switch: ProcessSwitch

    @property
    def arm(self) -> SpineArm:
        """The first arm."""
        return self.arms[0]

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
        if w.station.diagram.HasInputPort(f"{FIRST}.process_on"):
            w.feed(f"{FIRST}.process_on", process)


def add_spine(
    wiring: Wiring,
    arms: Sequence[tuple[str, ArmModel]],
    speed: float = MOVE_SPEED,
    acceleration: float = MOVE_ACCELERATION,
    error: LeafSystem | None = None,
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
    hold, end = _person(w)
    return Spine(w, tuple(made), hold, end, w.add("process_switch", ProcessSwitch()))


def _person(w: Wiring) -> tuple[OutputPort, OutputPort]:
    """What a person asks for, or asked for in a recording that is played back: to hold, to end."""
    if all(w.station.diagram.HasOutputPort(name) for name in (HOLD, END)):
        return w.out(HOLD), w.out(END)
    if w.person is None:
        return w.zeros("nobody_holds", 1), w.zeros("nobody_ends", 1)
    panel = w.add("operator_panel", OperatorPanel(w.person, w.meshcat))
    w.read[HOLD], w.read[END] = panel.GetOutputPort("hold"), panel.GetOutputPort("end")
    return w.read[HOLD], w.read[END]
