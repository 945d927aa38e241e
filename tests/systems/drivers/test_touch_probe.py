"""The touch probe without a controller: the world's contact and wire, and what the driver makes of the input's
samples."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from weldcal.models.arms.kinematics import forward_kinematics, jacobian, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.profiler_world import TIP_RADIUS_M, ProfilerTruth
from weldcal.systems.drivers.ur import touch_probe
from weldcal.systems.drivers.ur.touch_probe import (
    CHATTER_S,
    SILENT_S,
    ProbeInput,
    Touches,
    UrTouchProbe,
    UrTouchProbeInput,
)
from weldcal.systems.messages import TorchTouch
from weldcal.tools.emulators.cell.wires import TouchProbe

STEP_S = 0.002
SPEED_M_S = 0.006
RADIUS_M = 0.020
Q = np.deg2rad([190.0, -110.0, 125.0, -105.0, -90.0, 90.0])
TIP = np.array([0.001, -0.002, 0.126])
ARM = load_arm("ur10e")


def sphere_below(gap_m: float) -> ProfilerTruth:
    """A sphere whose top is so far below the tip at Q."""
    center = forward_kinematics(ARM, Q).multiply(TIP) - [0.0, 0.0, gap_m + RADIUS_M + TIP_RADIUS_M]
    return ProfilerTruth(RigidTransform(), TIP, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.asarray(center), RADIUS_M)


def moved(q: Array, dz_m: float) -> Array:
    """The joints with the tip moved along z, to first order and once more."""
    for _ in range(2):
        goal = forward_kinematics(ARM, Q).multiply(TIP) + np.array([0.0, 0.0, dz_m])
        off = np.concatenate([np.zeros(3), goal - forward_kinematics(ARM, q).multiply(TIP)])
        q = q + np.linalg.solve(jacobian(ARM, q, TIP), off)
    return q


def test_a_touch_has_the_joints_of_the_first_sample_inside_the_sphere() -> None:
    world, touches = TouchProbe(arm=ARM, truth=sphere_below(0.0005), normally_closed=False), Touches()
    depths = 0.0005 - 0.001 * np.abs(np.linspace(-1.0, 1.0, 2 * round(0.001 / (SPEED_M_S * STEP_S)) + 1))
    q, seen = Q, []
    for k, depth in enumerate(np.concatenate([depths, depths])):  # down by 1 mm and up again, twice
        q = moved(q, -depth - 0.0005)
        seen.append(q)
        touches.add(k * STEP_S, world.step(q), q)
        assert touches.number <= world.touches
    assert (world.touches, touches.number, touches.down) == (2, 2, False)
    first = len(depths) + int(np.argmax(depths > 1e-9))
    assert touches.time == first * STEP_S
    np.testing.assert_array_equal(touches.q, seen[first])
    assert world.deepest_m == pytest.approx(0.0005, abs=1e-6)


@pytest.mark.parametrize(
    ("levels", "number", "first"),
    [
        ("000010000000000000", 0, None),  # a spike of one sample
        ("000011000000000000", 0, None),  # of two
        ("000001010111111111", 1, 5),  # bounce: the touch began with its first sample
        ("000010000001111111", 1, 11),  # a spike before a touch is not its beginning
        ("000111111100001111", 1, 3),  # bounce when it opens
        ("0111100000000000000111", 2, 19),  # off for long enough: another touch
    ],
)
def test_bounce_belongs_to_its_touch_and_a_spike_is_none(levels: str, number: int, first: int | None) -> None:
    touches = Touches()
    for k, level in enumerate(levels):
        touches.add(k * STEP_S, level == "1", np.full(6, float(k)))
    assert touches.number == number
    assert first is None or touches.q[0] == first
    assert not touches.chatters


def test_a_contact_that_opens_and_closes_all_the_time_chatters() -> None:
    world, touches = TouchProbe(arm=ARM, truth=sphere_below(0.01), normally_closed=False), Touches()
    world.set_how("chatters")
    told = next(k for k in range(100) if touches.add(k * STEP_S, world.step(Q), Q) or touches.chatters)
    assert told * STEP_S < 0.06  # 0.4 mm of a descent
    touches.add(told * STEP_S + CHATTER_S + 0.1, False, Q)
    assert not touches.chatters


def test_a_broken_cable_is_a_touch_of_a_normally_closed_probe_only() -> None:
    for normally_closed in (False, True):
        world = TouchProbe(arm=ARM, truth=sphere_below(0.01), normally_closed=normally_closed)
        config = UrTouchProbe("127.0.0.1", 3, normally_closed)
        assert not config.closed(int(world.step(Q)) << 3)
        world.set_how("cut")
        assert config.closed(int(world.step(Q)) << 3) == normally_closed
        world.set_how("stuck")
        assert config.closed(int(world.step(Q)) << 3)
    with pytest.raises(InputError, match="cut, stuck, chatters"):
        world.set_how("melts")


class Stream:
    """The controller's packages that a test puts in."""

    def __init__(self, *_: object) -> None:
        self.arrived: list[tuple[float, ...]] = []
        self.connected, self.closed, self.not_finite = True, False, ""

    def put(self, time: float, bits: int, q: Array, qd: Array) -> None:
        self.arrived.append((1.0, time, float(bits), *q, *qd))

    def packages(self) -> list[tuple[float, ...]]:
        found, self.arrived = self.arrived, []
        return found

    def first(self, limit_s: float) -> None: ...

    def wait(self, seconds: float) -> None: ...

    def close(self) -> None:
        self.closed = True


class Time:
    """A clock that a test sets."""

    s = 0.0

    def now(self) -> float:
        return self.s

    def at(self, host_s: float) -> float:
        return self.s

    def look(self) -> None: ...


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> Stream:
    made = Stream()
    monkeypatch.setattr(touch_probe, "RtdeStream", lambda *_: made)
    return made


def test_the_port_shows_a_touch_with_its_joints_less_the_latency(stream: Stream) -> None:
    probe = ProbeInput(UrTouchProbe("127.0.0.1", 16, latency_s=0.003), Time())
    simulator = Simulator(UrTouchProbeInput(probe))
    port = simulator.get_system().GetOutputPort("touch")
    qd = np.full(6, 0.1)
    simulator.AdvanceTo(1.0)
    for k in range(8):
        for _ in range(2):  # an emulator that waits repeats its newest sample
            stream.put(100.0 + k * STEP_S, (k >= 3) << 16, Q + k * STEP_S * qd, qd)
    simulator.AdvanceTo(1.002)  # the samples are read at 1 s
    touch: TorchTouch = port.Eval(simulator.get_context())
    assert (touch.sequence, touch.down) == (1, True)
    assert touch.q is not None
    np.testing.assert_allclose(touch.q, Q + (3 * STEP_S - 0.003) * qd, atol=1e-12)
    assert touch.time == pytest.approx(1.0 - 4 * STEP_S)
    stream.put(100.1, 0, Q, qd)
    simulator.AdvanceTo(1.0081)
    assert not port.Eval(simulator.get_context()).down


def test_a_probe_that_is_closed_at_the_start_is_known_from_the_first_tick(stream: Stream) -> None:
    for k in range(4):
        stream.put(k * STEP_S, 1, Q, np.zeros(6))
    system = UrTouchProbeInput(ProbeInput(UrTouchProbe("127.0.0.1", 0), Time()))
    assert system.GetOutputPort("touch").Eval(system.CreateDefaultContext()).down


def test_silence_and_a_closed_connection_are_faults(stream: Stream) -> None:
    time = Time()
    probe = ProbeInput(UrTouchProbe("127.0.0.1", 0), time)
    assert probe.fault(0.9 * SILENT_S) is None
    assert "no new state of the probe's input" in str(probe.fault(1.1 * SILENT_S))
    probe.excuse(0.2 * SILENT_S)  # in which nobody could read
    assert probe.fault(1.1 * SILENT_S) is None
    time.s = 2.0
    stream.put(1.0, 0, Q, np.zeros(6))
    probe.poll()
    assert probe.fault(2.0) is None
    stream.connected = False
    assert "closed the connection" in str(probe.fault(2.0))
    probe.close()
    assert stream.closed


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        (UrTouchProbe(), "touch_probe.host"),
        (UrTouchProbe("127.0.0.1", 18), "from 0 to 17"),
        (UrTouchProbe("127.0.0.1", 0, latency_s=0.2), "latency_s"),
    ],
)
def test_keys_that_no_controller_has_are_refused(config: UrTouchProbe, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        touch_probe.preflight(config)
