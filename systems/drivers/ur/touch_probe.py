"""Touch probe at a digital input of a UR controller.

`!UrTouchProbe` reads every RTDE sample, so that a touch has the joints of its sample.
"""

import dataclasses as dc
from collections import deque
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.sensors.preflight import Sensed
from weldcal.systems.drivers.sensors.stamps import CellTime, cell_time
from weldcal.systems.drivers.sensors.watch import watch
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.drivers.ur.faults import Fault, reported_as, sentence
from weldcal.systems.drivers.ur.readiness.preflight import Check
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe
from weldcal.systems.drivers.ur.wire.rtde_stream import RtdeStream
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import TorchTouch

INPUTS = "actual_digital_input_bits"
READ = ("timestamp", INPUTS, "actual_q", "actual_qd")
N_INPUTS = 18  # 0 to 7 standard, 8 to 15 configurable, 16 and 17 of the tool connector
FIRST_LIMIT_S = 2.0  # as in ur/robot.py
FIRST_LOOKS, LOOK_S = 5, 0.01
SILENT_S = 0.2  # of the cell's time, without a new sample
PERIOD_S = 0.004  # the period of the robot's commands; touches are timed by RTDE samples, and not by this
# Of the controller's time. A touch is on for HELD_S, and its bounce leaves it off for less than BOUNCE_S; a contact
# that opens has opened when it is off for RELEASED_S. A sound probe changes a few times when it closes and when it
# opens.
HELD_S, BOUNCE_S, RELEASED_S = 0.004, 0.006, 0.020
CHATTER_S, CHATTER_CHANGES = 0.5, 12


@dc.dataclass
class UrTouchProbe(DriverConfig):
    """`!UrTouchProbe`: a touch probe, or the circuit of torch and sphere, at a digital input of a UR controller."""

    FOR: ClassVar[tuple[str, ...]] = ("touch_probe",)

    host: str = ""  # the controller's address, as robot.host
    input: int = 0  # digital input: 0 to 7 standard, 8 to 15 configurable, 16 and 17 of the tool connector
    # true: the input is on while nothing is touched, and a broken cable holds the job at once
    normally_closed: bool = False
    # from the contact to the sample that shows it: a touch has the joints of so long before. What is left out puts each
    # touch too deep by the descent's speed times it: 0.006 mm for each ms at 6 mm/s
    latency_s: float = 0.0

    def check(self) -> None:
        """Raise InputError for keys that cannot be used."""
        if not self.host:
            raise InputError("Write touch_probe.host: the address of the controller that the probe is wired to.")
        if not 0 <= self.input < N_INPUTS:
            raise InputError(f"touch_probe.input must be a digital input from 0 to 17, not {self.input}.")
        if not 0.0 <= self.latency_s <= 0.1:
            raise InputError(f"touch_probe.latency_s must be from 0 to 0.1, not {self.latency_s:g}.")

    def closed(self, bits: int) -> bool:
        """Return whether the input's level, one of the controller's `bits`, is that of a touch."""
        return bool(bits >> self.input & 1) != self.normally_closed


@dc.dataclass(kw_only=True)
class Touches:
    """Counts the touches in an input's samples: bounce belongs to its touch, and a spike of one sample is none.

    `number` of the newest touch; `time` (s, of the controller) and `q` (6,) rad of its first sample; `down`: it is
    held.
    """

    number: int = 0
    time: float = -np.inf
    q: Array = dc.field(default_factory=lambda: np.zeros(6))
    down: bool = False
    _first: tuple[float, Array] | None = None
    _since: float = 0.0  # time of the newest change
    _last: float = -np.inf  # time of the newest sample that was on
    _on: bool = False
    _changes: deque[float] = dc.field(default_factory=deque)

    def add(self, time: float, on: bool, q: Array) -> None:
        """Add a sample: the controller's time (s), whether the contact is closed, and the joints (6,) rad."""
        if on != self._on:
            if on and not self.down and (self._first is None or time - self._last > BOUNCE_S):
                self._first = (time, q)
            self._on, self._since = on, time
            self._changes.append(time)
        while self._changes and self._changes[0] < time - CHATTER_S:
            self._changes.popleft()
        if on:
            self._last = time
            if not self.down and self._first is not None and time - self._since >= HELD_S - 1e-6:
                self.number, self.down = self.number + 1, True
                self.time, self.q = self._first
        elif time - self._last > RELEASED_S:
            self.down, self._first = False, None

    @property
    def chatters(self) -> bool:
        """Whether the input changes more often than a sound probe's."""
        return len(self._changes) > CHATTER_CHANGES


class ProbeInput:
    """The connection that reads the input, in the Diagram's thread; what is wrong with it, as DeviceWatch asks.

    Raises:
        RobotUnreachable, RobotRefused: the controller does not answer, or does not report its inputs.
    """

    def __init__(self, config: UrTouchProbe, time: CellTime) -> None:
        self._config, self.time = config, time
        self._stream = RtdeStream(config.host, READ, ())
        try:
            self._stream.first(FIRST_LIMIT_S)
        except BaseException:
            self._stream.close()
            raise
        self.touches = Touches()
        self.newest = -np.inf  # the controller's time of the newest sample
        self._heard = time.now()
        for _ in range(FIRST_LOOKS):  # so that a probe that is closed now is known before anything moves
            self._stream.wait(LOOK_S)
            self.poll()

    def poll(self) -> None:
        """Take all samples that have arrived. Never waits."""
        for _, timestamp, bits, *joints in self._stream.packages():
            if timestamp <= self.newest:  # while an emulator waits it repeats its newest sample
                continue
            self.newest, self._heard = timestamp, self.time.now()
            q, qd = np.array(joints[:6]), np.array(joints[6:])
            self.touches.add(timestamp, self._config.closed(int(bits)), q - self._config.latency_s * qd)

    def fault(self, now: float) -> str | None:
        """See Watched."""
        n, host = self._config.input, self._config.host
        if self.touches.chatters:
            return (
                f"TOUCH PROBE: digital input {n} changed more than {CHATTER_CHANGES} times in {CHATTER_S:g} s; look for"
                " a loose plug, a broken shield or a worn contact of the probe, and start again."
            )
        if self._stream.not_finite:
            return sentence(Fault.STATE_NOT_FINITE, reported_as(self._stream.not_finite))
        if not self._stream.connected:
            return (
                f"TOUCH PROBE: the controller {host} closed the connection that reads the probe's input; start again."
            )
        if now - self._heard > SILENT_S:
            return (
                f"TOUCH PROBE: no new state of the probe's input from {host} for {1e3 * (now - self._heard):.0f} ms;"
                " check the network cable and start again."
            )
        return None

    def excuse(self, seconds: float) -> None:
        """See Watched."""
        self._heard += seconds

    def close(self) -> None:
        """See Watched."""
        self._stream.close()


class UrTouchProbeInput(LeafSystem):
    """Shows the touches of a probe at the controller's input.

    .. pydrake_system::

        name: UrTouchProbeInput
        output_ports:
        - touch

    `touch` is a TorchTouch with the joints of its sample; its time is that of the update less the sample's age.
    """

    def __init__(self, probe: ProbeInput, period_s: float = PERIOD_S) -> None:
        super().__init__()
        self._probe = probe
        self._shown = TorchTouch(probe.touches.number, 0.0, probe.touches.down, probe.touches.q)
        # number of the newest touch, whether it is held
        state = self.DeclareDiscreteState([float(probe.touches.number), float(probe.touches.down)])
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort("touch", lambda: AbstractValue.Make(TorchTouch()), self._output, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        self._probe.poll()
        found = self._probe.touches
        if found.number > self._shown.sequence:
            time = context.get_time() - (self._probe.newest - found.time)
            self._shown = TorchTouch(found.number, time, found.down, found.q)
        elif found.down != self._shown.down:
            self._shown = dc.replace(self._shown, down=found.down)
        discrete.set_value([float(found.number), float(found.down)])

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self._shown)


def preflight(config: UrTouchProbe) -> Sensed:
    """Read the input once, with nothing touched. Raises InputError for keys that cannot be used, RobotUnreachable."""
    config.check()
    with RtdeProbe(config.host) as probe:
        bits = probe.read((INPUTS,)).get(INPUTS)
    if bits is None:
        action = "The controller does not report its digital inputs: use PolyScope 5.12 or newer."
        return Sensed((Check("input", False, "not readable", action),))
    on = bool(int(np.asarray(bits).item()) >> config.input & 1)
    found = f"digital input {config.input} is {'on' if on else 'off'}, as while nothing is touched"
    if on == config.normally_closed:
        return Sensed((Check("input", True, found),))
    action = (
        f"Digital input {config.input} is {'on' if on else 'off'}, as in a touch: free the probe, look at its cable,"
        " and compare touch_probe.input and normally_closed with the wiring."
    )
    return Sensed((Check("input", False, f"digital input {config.input} is {'on' if on else 'off'}", action),))


def ApplyDriverConfig(config: UrTouchProbe, build: StationBuild) -> None:
    """Connect to the controller, and add the probe's port; its faults become the robot's."""
    config.check()
    probe = ProbeInput(config, cell_time(build))
    watch(build, probe, "touch_probe")
    build.add("touch_probe", UrTouchProbeInput(probe), "torch.touch")
