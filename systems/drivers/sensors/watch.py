"""DeviceWatch: a device's fault becomes the robot's: the arm stops, the process goes off, and the fault stays until the
run ends."""

import dataclasses as dc
from collections.abc import Callable
from typing import Any, Protocol

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.systems.drivers.sensors.cell_time import CellTime
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import UrStatus

PERIOD_S = 0.008
STOOD_S = 0.1  # a longer time between two looks: the Diagram computed, with the arm at rest


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
    watching = build.builder.AddSystem(DeviceWatch(device))
    watching.set_name(f"{name}_watch")
    build.builder.Connect(build.outputs["arm.status"], watching.GetInputPort("robot_status"))
    build.outputs["arm.status"] = watching.GetOutputPort("status")
