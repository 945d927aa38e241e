"""Set points of the power source: which level an analog output gets, what is refused, and that the torch waits for
them."""

from __future__ import annotations

import math
import re

import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde
from weldcal.systems.drivers.ur.set_points import SETTLES_S, AnalogSetPoint, Gas, SetPoints, apart, levels_of
from weldcal.welding.record.schedule import HotStart, WeldSchedule

FEED = AnalogSetPoint(output=0, unit="V", at_zero=1.0, at_full=22.0, value=8.0)
VOLTAGE = AnalogSetPoint(output=1, unit="mA", at_zero=10.0, at_full=40.0, value=25.0)
V_BIT, INPUT_BITS = 1 << 2, 0b11


def test_a_value_is_a_share_of_its_outputs_range() -> None:
    feed, voltage = levels_of(FEED, VOLTAGE)
    assert (feed.output, feed.volts, feed.share) == (0, True, pytest.approx(7.0 / 21.0))
    assert (voltage.output, voltage.volts, voltage.share) == (1, False, pytest.approx(0.5))
    assert feed.shown(10.0 * feed.share, V_BIT | INPUT_BITS) == pytest.approx(feed.share)
    assert voltage.shown(0.012, V_BIT) == pytest.approx(0.5)
    assert (feed.shown(0.0, V_BIT), voltage.shown(0.004, 0)) == (0.0, 0.0)
    assert math.isnan(feed.shown(0.0, INPUT_BITS)), "somebody set the output to mA"
    assert apart(0.0, math.nan)
    assert not apart(0.4, 0.41)
    assert levels_of(None, None) == ()


def test_a_schedule_moves_the_share_and_stays_in_the_range() -> None:
    feed, voltage = levels_of(FEED, VOLTAGE)
    shares = [FEED.share(11.5), VOLTAGE.share(math.nan)]
    assert feed.wanted(shares) == pytest.approx(0.5)
    assert voltage.wanted(shares) == voltage.share, "what the schedule does not set is the scenario's"
    assert [feed.wanted([share, 0.0]) for share in (-0.2, 1.3)] == [0.0, 1.0]
    robot = UrRtde(wire_feed=FEED, arc_voltage=VOLTAGE)
    assert robot.takes == ("wire_feed_m_min", "voltage_V")
    robot.check_schedule(WeldSchedule(wire_feed_m_min=8.0, voltage_V=25.0))
    with pytest.raises(InputError, match=r"robot\.wire_feed\.value must be between"):
        robot.check_schedule(WeldSchedule(wire_feed_m_min=8.0, hot_start=HotStart(wire_feed_m_min=23.0)))


@pytest.mark.parametrize(
    ("wires", "says"),
    [
        ({"wire_feed": AnalogSetPoint(2, "V", 0.0, 22.0, 8.0)}, r"wire_feed\.output .* 0 or 1, not 2"),
        ({"wire_feed": AnalogSetPoint(0, "A", 0.0, 22.0, 8.0)}, r"wire_feed\.unit must be V .* or mA .*not 'A'"),
        ({"wire_feed": AnalogSetPoint(0, "V", 0.0, 0.0, 8.0)}, r"wire_feed\.at_full .* 10 V, and it must differ"),
        ({"arc_voltage": AnalogSetPoint(0, "mA", 0.0, math.nan, 8.0)}, r"arc_voltage\.at_full .* 20 mA"),
        ({"wire_feed": AnalogSetPoint(0, "V", 1.0, 22.0, 23.0)}, r"value must be between at_zero \(1.*at_full \(22\), not 23"),
        ({"wire_feed": AnalogSetPoint(0, "V", 1.0, 22.0, 1.0)}, "which is off"),
        ({"wire_feed": FEED, "arc_voltage": AnalogSetPoint(0, "V", 0.0, 40.0, 20.0)}, "both at analog output 0"),
        ({"wire_feed": FEED, "arc_input": None}, "need process_output and arc_input"),
        ({"wire_feed": FEED, "process_output": None}, "need process_output and arc_input"),
    ],
)  # fmt: skip
def test_nonsense_is_refused_before_anything_is_asked_of_the_robot(wires: dict[str, object], says: str) -> None:
    given: dict[str, object] = {"host": "127.0.0.1", "process_output": 0, "arc_input": 0} | wires
    with pytest.raises(InputError) as refused:
        PrepareRobot(UrRtde(**given), load_arm())  # type: ignore[arg-type]
    assert re.search(says, str(refused.value)), refused.value


def test_gas_then_set_points_then_the_torch_and_all_off_at_once_but_the_gas() -> None:
    gas, points, found = Gas(0.1, 0.2), SetPoints(), []
    shown = False
    for k in range(100):
        now, wanted = 0.01 * k, 10 <= k < 60
        flows, free = gas.step(now, wanted)
        armed, torch = points.step(now, free, shown)
        found.append((flows, armed, torch))
        shown = armed  # of the next package
    begins = [next(k for k in range(100) if found[k][what]) for what in range(3)]
    assert begins == [10, 20, pytest.approx(21 + 100 * SETTLES_S, abs=1)]
    ends = [next(k for k in range(30, 100) if not found[k][what]) for what in range(3)]
    assert ends == [pytest.approx(80, abs=1), 60, 60]


def test_a_torch_does_not_come_on_while_the_set_points_are_not_there_and_does_not_flicker_with_them() -> None:
    points = SetPoints()
    assert not any(points.step(0.01 * k, True, k % 3 != 0)[1] for k in range(100)), "never right for long enough"
    assert [points.step(1.0 + 0.01 * k, True, True)[1] for k in range(10)][-1]
    assert points.step(1.2, True, False) == (True, True), "the supervisor ends a torch whose set point is wrong"
    assert points.step(1.3, False, True) == (False, False)
    assert points.step(1.4, True, True) == (True, False)
