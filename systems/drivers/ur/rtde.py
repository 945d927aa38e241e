"""Driver of a UR robot: reads the link in an update event and sends in a publish event."""

import contextlib
import dataclasses as dc
import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, EventStatus

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.errors import InputError
from weldcal.systems.addresses import controller_address, is_loopback
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import ARM_PORTS, PreparedRobot, StationBuild
from weldcal.systems.drivers.ur.faults import RobotRefused
from weldcal.systems.drivers.ur.link import StartFailed, UrLink, status_of
from weldcal.systems.drivers.ur.readiness.load import ExpectedLoad
from weldcal.systems.drivers.ur.readiness.preflight import preflight, require_ready
from weldcal.systems.drivers.ur.set_points import SETTLES_S, AnalogSetPoint, levels_of
from weldcal.systems.drivers.ur.supervisor import Limits
from weldcal.systems.drivers.ur.wire.line import stop_program
from weldcal.systems.drivers.ur.wire.transport import AUTO, NATIVE, UR_RTDE, Situation, choose, installed, taken
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.wall_clock import WallClock
from weldcal.welding.record.schedule import WeldSchedule

FULL_PACE = 1.0  # a controller's time is real time; only an emulated one has another pace
STILL_RAD_S = 1e-9  # rounding of a zero command: in a frame of 2 ms a joint turns 2e-12 rad
# one period of the commands: a later velocity is replaced by the next one before the robot uses it
CATCHES_UP_S = 0.004
OF_WORKER = (
    *("rate_hz", "payload_kg", "process_output", "arc_input", "arc_fault_input"),
    *("gas_output", "gas_before_s", "gas_after_s"),
)
"""Keys of the scenario that the worker takes as they are."""
N_OUTPUTS = 8


@dc.dataclass(kw_only=True)
class UrRtde(DriverConfig):
    """`!UrRtde`: a Universal Robots e-Series arm, or its emulator, at a network address."""

    FOR: ClassVar[tuple[str, ...]] = ("robot",)

    host: str = ""
    transport: str = AUTO  # ur_rtde, native (weldcal's own client), or auto: ur_rtde where it can be used
    rate_hz: float = 250.0  # of the worker's loop
    pace: float = 1.0  # seconds of the controller per second of this computer; other than 1 only for the emulator
    lockstep: bool = False  # only for the emulator: its time waits for this computer
    # only for an emulator in lockstep: the cell's time waits for it too, as for a world of its own
    follow: bool = False
    velocity_share: float = 0.6  # of the arm's limits; a faster command is refused
    upper_registers: bool | None = None  # from 24 on (fieldbuses use those from 0 on); null: true
    payload_kg: float = 1.4  # of the welding tool
    payload_cog_m: list[float] = dc.field(default_factory=lambda: [0.03, 0.0, 0.05])
    process_output: int | None = None  # standard digital output (0 to 7) that switches the torch; null: none is wired
    # standard digital inputs (0 to 7) of the power source; null: not wired. Without an established arc the weld does
    # not move, and a fault ends it
    arc_input: int | None = None
    arc_fault_input: int | None = None
    # standard digital output of the gas valve; null: the power source does it. Gas flows gas_before_s before the torch
    # is on, for which the weld stands only where arc_input is wired, and gas_after_s after it
    gas_output: int | None = None
    gas_before_s: float = 0.5
    gas_after_s: float = 1.0
    # the power source's wire feed at an analog output of the controller; null: not wired. A set point needs
    # process_output and arc_input, and is given after the gas and before the torch
    wire_feed: AnalogSetPoint | None = None
    arc_voltage: AnalogSetPoint | None = None  # the same for its voltage

    def limits(self, arm: ArmModel) -> Limits:
        """The limits against which the worker checks commands."""
        limits = Limits(
            position_lower=arm.position_lower,
            position_upper=arm.position_upper,
            speed=self.velocity_share * arm.velocity_limit,
            acceleration=arm.acceleration_limit,
        ).slowed(self.pace)
        if not self.lockstep:
            return limits
        return limits.following() if self.follow else limits.in_lockstep()

    @property
    def reports_arc(self) -> bool:
        """See DriverConfig."""
        return self.arc_input is not None

    def torch_delay_s(self) -> float:
        """The time of gas before the torch, where a valve is wired, and of the set points, where there are some."""
        points_s = 0.0 if self.wire_feed is None and self.arc_voltage is None else SETTLES_S
        return points_s + (0.0 if self.gas_output is None else self.gas_before_s)

    @property
    def takes(self) -> tuple[str, ...]:
        """See DriverConfig."""
        wired = {"wire_feed_m_min": self.wire_feed, "voltage_V": self.arc_voltage}
        return tuple(name for name, point in wired.items() if point is not None)

    def check_schedule(self, schedule: WeldSchedule) -> None:
        """See DriverConfig."""
        for key, name in (("wire_feed", "wire_feed_m_min"), ("arc_voltage", "voltage_V")):
            point = getattr(self, key)
            for value in schedule.extremes(name) if point is not None else ():
                dc.replace(point, value=value).level(key)

    @property
    def set_points(self) -> bool:
        """Whether the power source's set points are wired to analog outputs."""
        return self.wire_feed is not None or self.arc_voltage is not None

    def load(self, owner: str = "the scenario") -> ExpectedLoad:
        """The payload with which the pre-flight compares the controller's."""
        return ExpectedLoad(self.payload_kg, tuple(self.payload_cog_m), owner)


class UrRtdeArm(LeafSystem):
    """The station's arm over a link to the controller.

    .. pydrake_system::

        name: UrRtdeArm
        input_ports:
        - velocity_command
        - process_on
        - set_values
        output_ports:
        - desired_state
        - position_measured
        - velocity_measured
        - X_BF
        - sample_time
        - status
        - arc_established

    Units as in the simulated arm. `sample_time` is the time of the robot's sample on the Diagram's clock: the time of
    the update less the sample's age, computed from robot time mapped to host time; of a robot that the Diagram follows,
    its own time. `desired_state` (12) rad, rad/s is the predicted state of the arm at the next tick, which the
    simulated arm follows. Outputs depend on the state only: no feedthrough. On a computer that is late the clock's
    `rate` is below 1: velocities are sent, and read, in proportion to it. `arc_established` (1): 1 while the power
    source reports an arc, or where its input is not wired. `process_on` (1) switches the torch's digital output, where
    one is wired; unconnected means off. `set_values` (4; unconnected: the scenario's) are those of the power source; a
    number that is NaN is the scenario's.
    """

    def __init__(
        self,
        arm: ArmModel,
        link: UrLink,
        clock: WallClock,
        period_s: float = 0.002,
        send_s: float = 0.004,
        points: Mapping[int, AnalogSetPoint] | None = None,
    ) -> None:
        """`points`: set points at analog outputs, by the index of their value in `set_values`."""
        super().__init__()
        self._points = points or {}
        self._arm, self._link, self._clock, self._period_s = arm, link, clock, period_s
        found = link.state()
        self._command = self.DeclareVectorInputPort("velocity_command", 6)
        self._process = self.DeclareVectorInputPort("process_on", 1)
        self._set = self.DeclareVectorInputPort("set_values", 4)
        # Numbers only, because an update of abstract state would make Drake copy and compute everything anew, 500 times
        # a second. One group for each port, which Drake then fills without Python.
        self._desired = self.DeclareDiscreteState(np.concatenate([found.q, np.zeros(6)]))
        self._position = self.DeclareDiscreteState(found.q)
        self._velocity = self.DeclareDiscreteState(6)
        self._sampled = self.DeclareDiscreteState(1)
        self._arc = self.DeclareDiscreteState(1)
        self._codes = self.DeclareDiscreteState(found.codes)  # of the status
        position, codes = ({self.discrete_state_ticket(group)} for group in (self._position, self._codes))
        self.DeclareStateOutputPort("desired_state", self._desired)
        self.DeclareStateOutputPort("position_measured", self._position)
        self.DeclareStateOutputPort("velocity_measured", self._velocity)
        self.DeclareAbstractOutputPort("X_BF", lambda: AbstractValue.Make(RigidTransform()), self._pose, position)
        self.DeclareStateOutputPort("sample_time", self._sampled)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(found.status), self._status, codes)
        self.DeclareStateOutputPort("arc_established", self._arc)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._read)
        self.DeclarePeriodicPublishEvent(send_s, 0.0, self._send)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        found = self._link.state()
        rate = self._clock.rate
        before = float(discrete.value(self._sampled)[0])
        if self._clock.follows:
            sampled = max(self._clock.diagram_time(found.robot_time, context.get_time()), before)
        else:
            sampled = max(context.get_time() - self._clock.pace * rate * found.age_s, before)
        qd = found.qd / rate
        ahead = min(context.get_time() + self._period_s - sampled, 0.05)
        desired = np.clip(found.q + ahead * qd, self._arm.position_lower, self._arm.position_upper)
        arc = float(found.arc != 0)
        discrete.set_value(self._desired, np.concatenate([desired, qd]))
        discrete.set_value(self._position, found.q)
        discrete.set_value(self._velocity, qd)
        discrete.set_value(self._sampled, [sampled])
        discrete.set_value(self._arc, [arc])
        discrete.set_value(self._codes, found.codes)

    def _send(self, context: Context) -> EventStatus:
        wanted = np.array(self._command.Eval(context))  # computed here: only now is known how late it is
        late_s = self._clock.overdue_s(context.get_time())
        if self._clock.follows and late_s > CATCHES_UP_S:
            return EventStatus.DidNothing()  # the robot that is followed waits until the Diagram has caught up with it
        # at rest exactly zero is sent: only then may the cell compute without a time limit
        process = self._process.HasValue(context) and bool(self._process.Eval(context)[0] > 0.5)
        # so that what is no number reaches the worker, which refuses it
        moving = not np.abs(wanted).max() < STILL_RAD_S
        self._clock.velocity_leaves(late_s, moving)
        self._link.command(self._clock.rate * wanted if moving else np.zeros(6), process, *self._shares(context))
        return EventStatus.Succeeded()

    def _shares(self, context: Context) -> tuple[np.ndarray, ...]:
        """Return the shares (2,) of the analog outputs; empty where nothing sets them."""
        if not self._points or not self._set.HasValue(context):
            return ()
        values, shares = self._set.Eval(context), np.full(2, np.nan)
        for index, point in self._points.items():
            shares[point.output] = point.share(float(values[index]))
        return (shares,)

    def _pose(self, context: Context, output: Any) -> None:
        output.set_value(tick_flange_pose(self._arm, context.get_discrete_state(self._position).value()))

    def _status(self, context: Context, output: Any) -> None:
        output.set_value(status_of(tuple(context.get_discrete_state(self._codes).value())))


def chosen_transport(config: UrRtde, version: tuple[int, ...], upper: bool) -> tuple[str, str]:
    """The transport for this controller, `native` or `ur_rtde`, and why in a sentence.

    Raises:
        InputError: there is no such transport, or ur_rtde is asked for and cannot be used.
        RobotUnreachable: the controller does not answer.
    """
    if config.transport not in (AUTO, NATIVE, UR_RTDE):
        raise InputError(f"robot.transport must be {AUTO}, {NATIVE} or {UR_RTDE}, not '{config.transport}'.")
    found = Situation(
        version=version,
        own_time=config.pace != FULL_PACE or config.lockstep,
        set_points=config.set_points,
        installed=installed(),
        cores=len(os.sched_getaffinity(0)),
    )
    name, why = choose(config.transport, found)
    if name == UR_RTDE:
        claimed = taken(config.host, upper, config.process_output is not None)
        name, why = choose(config.transport, dc.replace(found, taken=claimed))
    if config.transport == UR_RTDE != name:
        raise InputError(f"robot.transport cannot be {UR_RTDE} here. {why} Leave it at {AUTO}.")
    return name, why


def start_link(start: Callable[..., UrLink], config: UrRtde, transport: str, why: str) -> tuple[UrLink, str]:
    """The link over this transport, and why over this one.

    Where `auto` took ur_rtde and it does not start, native follows.

    Raises:
        RobotRefused: the link does not start.
    """
    try:
        return start(transport=transport), why
    except StartFailed:
        if config.transport != AUTO or transport != UR_RTDE:
            raise
    with contextlib.suppress(RobotRefused):
        stop_program(config.host)  # of the guard, which may run
    return start(transport=NATIVE), "Transport native: ur_rtde did not start."


def PrepareRobot(config: UrRtde, nominal: ArmModel) -> PreparedRobot:
    """Run the pre-flight checks, read the robot's kinematics, then start the link with its guard.

    The arm does not move.

    Raises:
        InputError: the scenario names no host, or a pace other than 1 or lockstep for a real robot.
        RobotRefused, RobotUnreachable: the message gives the operator action.
    """
    if not config.host:
        raise InputError("Write the robot's address in the scenario: robot: !UrRtde {host: 192.168.1.10}.")
    if config.pace != FULL_PACE and not is_loopback(controller_address(config.host)):
        raise InputError("Only the emulator can run at another pace: leave pace at 1 for a robot.")
    if config.lockstep and not is_loopback(controller_address(config.host)):
        raise InputError("Only the emulator waits for this computer: leave lockstep at false for a robot.")
    if config.follow and not config.lockstep:
        raise InputError(
            "robot.follow needs robot.lockstep: only an emulator that waits for this computer may be waited for."
        )
    if config.process_output is not None and not 0 <= config.process_output < N_OUTPUTS:
        raise InputError(
            f"robot.process_output must be a standard digital output from 0 to 7, not {config.process_output}."
        )
    for name in ("arc_input", "arc_fault_input"):
        if (n := getattr(config, name)) is not None and not 0 <= n < N_OUTPUTS:
            raise InputError(f"robot.{name} must be a standard digital input from 0 to 7, not {n}.")
    if config.gas_output is not None:
        if config.process_output is None or config.arc_input is None or not 0 <= config.gas_output < N_OUTPUTS:
            raise InputError(
                "robot.gas_output must be a standard digital output from 0 to 7, and it needs process_output and"
                " arc_input."
            )
        if config.gas_output == config.process_output:
            raise InputError("robot.gas_output and robot.process_output must be two outputs.")
        if not (0.0 <= config.gas_before_s <= 10.0 and 0.0 <= config.gas_after_s <= 10.0):
            raise InputError("robot.gas_before_s and robot.gas_after_s must be from 0 to 10.")
    levels = levels_of(config.wire_feed, config.arc_voltage)
    if levels and (config.process_output is None or config.arc_input is None):
        raise InputError("robot.wire_feed and robot.arc_voltage need process_output and arc_input.")
    report = preflight(
        config.host,
        upper_registers=config.upper_registers,
        nominal=nominal,
        load=config.load(),
        set_points=config.set_points,
    )
    require_ready(report)
    arm = report.arm
    if arm is None:
        raise RuntimeError("the pre-flight passed without the robot's kinematics")
    transport, why = chosen_transport(config, report.version or (), report.upper_registers)
    x, y, z = config.payload_cog_m
    start = partial(
        UrLink.start,
        config.host,
        arm,
        config.limits(arm),
        upper_registers=report.upper_registers,
        payload_cog_m=(x, y, z),
        levels=levels,
        version=report.version or (),
        **{name: getattr(config, name) for name in OF_WORKER},
    )
    link, why = start_link(start, config, transport, why)
    clock = WallClock.following(link.robot_time) if config.follow else WallClock(config.pace)
    return PreparedRobot(arm, link.state().q, link, clock, config.lockstep, why)


def ApplyDriverConfig(config: UrRtde, build: StationBuild) -> None:
    """Add the arm with its link; the simulated arm follows the real one, for the rendered sensors."""
    if build.robot is None or not isinstance(build.robot.handle, UrLink) or build.robot.clock is None:
        raise RuntimeError("the robot was not prepared")
    points = {k: point for k, point in ((1, config.wire_feed), (2, config.arc_voltage)) if point is not None}
    arm = UrRtdeArm(build.arm, build.robot.handle, build.robot.clock, points=points)
    process = () if config.process_output is None else ("arm.process_on",)
    arc = () if config.arc_input is None else ("arm.arc_established",)
    values = ("arm.set_values",) if points else ()
    build.add("arm_link", arm, *ARM_PORTS, *process, *arc, *values)
    if (world := build.find(SimulatedWorld)) is not None:
        build.builder.Connect(arm.GetOutputPort("desired_state"), world.plant.get_desired_state_input_port(world.arm))
