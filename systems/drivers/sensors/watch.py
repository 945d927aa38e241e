"""Systems beside a device's acquisition: OnTrigger asks for one datum, DeviceWatch makes its fault the robot's."""

import dataclasses as dc
import time
from collections.abc import Callable
from typing import Any, Protocol

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.drivers.sensors.acquisition import Acquisition
from weldcal.systems.drivers.sensors.stamps import CellTime, DiagramTime, cell_time
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import UrStatus

PERIOD_S = 0.008  # two periods of the commands: a tenth of the shortest time after which a device is silent
START_S = 10.0  # a choice: several attempts to connect, as in preflight.py; a device that opens in 5 s has one retry
STOOD_S = 0.1  # a longer time between two looks: the Diagram computed, with the arm at rest


class OnTrigger(LeafSystem):
    """Asks the device for one datum per trigger.

    .. pydrake_system::

        name: OnTrigger
        input_ports:
        - trigger
        output_ports:
        - scan

    The output port has the name `port`, such as scan or profile; `message` is made of a number, the capture time
    and the datum. The Diagram does not wait for the answer, unless it
    may (`waits`). The capture time is that of the datum's stamp, and at the earliest that of its trigger: from then on
    the arm is at rest.
    """

    def __init__(
        self, acquisition: Acquisition[Any], port: str, message: type[Any], period_s: float, waits: bool = False
    ) -> None:
        super().__init__()
        self.acquisition, self._message, self._waits = acquisition, message, waits
        self._times, self._shown = DiagramTime(), message()
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        state = self.DeclareDiscreteState([0.0, 0.0, 0.0])  # number asked for, its time, number shown
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort(port, lambda: AbstractValue.Make(message()), self._output, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        now = context.get_time()
        self._times.add(time.monotonic(), now)
        asked, asked_at, shown = context.get_discrete_state_vector().value()
        wanted = int(self._trigger.Eval(context)[0])
        if wanted > asked:
            asked, asked_at = float(wanted), now
            self.acquisition.request(wanted)
        if asked > shown:
            number = int(asked)
            found = self.acquisition.wait_for_answer(number) if self._waits else self.acquisition.answer(number)
            if found is not None:
                captured = max(self._times.at(found.stamp.captured), asked_at)
                self._shown = self._message(number, captured, found.datum)
                shown = asked
        discrete.set_value([asked, asked_at, shown])

    def _output(self, context: Context, output: Any) -> None:
        shown = context.get_discrete_state_vector()[2] > 0.5
        output.set_value(self._shown if shown else self._message())


class SelfTestingDevice(Protocol):
    """A device that knows what is wrong with it, by a clock of its own."""

    time: CellTime

    def fault(self, now: float) -> str | None:
        """What is wrong at `now` (s, of `time`), as a sentence; None where nothing is. Never waits."""

    def excuse(self, seconds: float) -> None:
        """Do not count this time, in which nobody could read, as the device's silence, nor its frames as late."""

    def close(self) -> None:
        """Disconnect; a second call has no effect."""


class DeviceWatch(LeafSystem):
    """Passes the robot's status on until its device is at fault; from then on the status has that fault.

    .. pydrake_system::

        name: DeviceWatch
        input_ports:
        - robot_status
        output_ports:
        - status

    Everything that stops for a robot's fault stops for a device's: the process first, then the arm, and the job holds
    by that sentence. A device that works again changes nothing before the next run.
    """

    def __init__(self, device: SelfTestingDevice, clock: Callable[[], float] | None = None) -> None:
        super().__init__()
        self._device, self._clock = device, clock or device.time.now
        self._looked = self._clock()
        self.sentence = ""
        self._status = self.DeclareAbstractInputPort("robot_status", AbstractValue.Make(UrStatus()))
        self.DeclareDiscreteState([0.0])
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(UrStatus()), self._output)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._look)

    def _look(self, context: Context, discrete: DiscreteValues) -> None:
        now = self._clock()
        if now - self._looked > STOOD_S:
            self._device.excuse(now - self._looked)
        self._looked = now
        if context.get_discrete_state_vector()[0] > 0.5:
            return
        if (found := self._device.fault(now)) is not None:
            self.sentence = found
            discrete.set_value([1.0])

    def _output(self, context: Context, output: Any) -> None:
        status: UrStatus = self._status.Eval(context)
        if context.get_discrete_state_vector()[0] > 0.5 and status.fault is None:
            status = dc.replace(status, fault=self.sentence)
        output.set_value(status)


def watch(build: StationBuild, device: SelfTestingDevice, name: str) -> None:
    """Let the station close a device, and let the robot's status show the device's faults."""
    build.closables.append(device)
    status = build.outputs["arm.status"]
    watching = build.add(f"{name}_watch", DeviceWatch(device), "arm.status")
    build.builder.Connect(status, watching.GetInputPort("robot_status"))


def begin(build: StationBuild, acquisition: Acquisition[Any], name: str, *, first_frame: bool) -> None:
    """Start a device's acquisition in a station, and watch it. Raises DeviceFault where it does not answer."""
    acquisition.time = cell_time(build)
    acquisition.start(START_S, first_frame=first_frame)
    watch(build, acquisition, name)
