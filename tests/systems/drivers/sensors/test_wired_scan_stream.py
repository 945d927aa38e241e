"""Frames of a scanner that runs freely: its own clock stays with the Diagram's while the computer is late."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from weldcal.systems.drivers.sensors.acquisition import AcquiredFrame, Acquisition
from weldcal.systems.drivers.sensors.stamps import HostTime, Stamp
from weldcal.systems.drivers.sensors.wired_scanner import WiredScanStream
from weldcal.systems.messages import ScanStream
from weldcal.systems.wall_clock import WallClock

DEVICE_0_S, DELAY_S = 7000.0, 0.15
CLOUD = np.zeros((1, 1, 3), np.float32)


class Host:
    """A computer whose clock is read and moved on by hand."""

    now = 50.0

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def frame(number: int, captured: float) -> AcquiredFrame[Any]:
    """A frame that the device has taken at this time of the host."""
    stamp = Stamp(captured, "host")
    return AcquiredFrame(
        number=number, datum=CLOUD, arrived=captured + DELAY_S, stamp=stamp, device_time=DEVICE_0_S + captured - 50.0
    )


def device_times(clock: WallClock | None, frames: list[AcquiredFrame[Any]]) -> list[float | None]:
    source = SimpleNamespace(frames=lambda: tuple(frames), time=HostTime())
    stream = WiredScanStream(cast("Acquisition[Any]", source), clock)
    simulator = Simulator(stream)
    context = simulator.get_mutable_context()
    stream.GetInputPort("streaming").FixValue(context, 1.0)
    simulator.AdvanceTo(0.05)
    found: ScanStream = stream.GetOutputPort("stream").Eval(context)
    return [f.device_time for f in found.frames]


def stalled_clock() -> WallClock:
    """Of a Diagram that ran for 1 s, stood for 0.4 s and ran for 1 s more."""
    host = Host()
    clock = WallClock(1.0, lambda: host.now, host.sleep)
    clock.wait_for(0.0, moving=False)
    clock.wait_for(1.0, moving=True)
    host.now += 0.4
    clock.wait_for(1.0, moving=True)
    clock.wait_for(2.0, moving=True)
    return clock


def test_the_device_time_is_less_what_the_diagram_had_lost_when_the_frame_was_taken() -> None:
    taken = [50.5, 50.9, 51.1, 51.3, 51.5, 52.3]
    found = device_times(stalled_clock(), [frame(k + 1, t) for k, t in enumerate(taken)])
    diagram = [0.5, 0.9, 1.0, 1.0, 1.1, 1.9]
    assert found == pytest.approx([DEVICE_0_S + t for t in diagram], rel=0.0, abs=1e-9)


def test_without_a_clock_it_is_the_devices_own() -> None:
    assert device_times(None, [frame(1, 50.5)]) == pytest.approx([DEVICE_0_S + 0.5], rel=0.0, abs=1e-9)
