"""The schedule of the power source: stages and ramps in time, the table by gap along the seam, and what is refused."""

import math

import numpy as np
import pytest

from weldcal.welding.record.schedule import Crater, GapRow, HotStart, ScheduleError, WeldSchedule, gap_along

STAGES = WeldSchedule(
    wire_feed_m_min=8.0,
    voltage_V=24.0,
    hot_start=HotStart(wire_feed_m_min=10.0, time_s=0.5, ramp_s=0.4),
    crater=Crater(wire_feed_m_min=5.0, voltage_V=20.0, ramp_s=0.2),
)
# a row each 0.5 mm, none on a straight line with its neighbours
ROWS = [(0.0, 8.0, 24.0, 8.0), (0.5, 8.2, 23.6, 7.6), (1.0, 8.7, 23.4, 7.0), (1.5, 8.8, 22.6, 6.7),
        (2.0, 9.4, 22.3, 6.0), (2.5, 9.6, 21.4, 5.6), (3.0, 10.4, 21.0, 5.0)]  # fmt: skip
TABLE = WeldSchedule(by_gap=[GapRow(gap_mm=g, wire_feed_m_min=w, voltage_V=u, speed_mm_s=v) for g, w, u, v in ROWS])


@pytest.mark.parametrize(
    ("arc_s", "crater_s", "wire", "voltage"),
    [
        (-1.0, -1.0, 10.0, 24.0),  # before the arc the source already has the hot start's values
        (0.0, -1.0, 10.0, 24.0),
        (0.49, -1.0, 10.0, 24.0),
        (0.6, -1.0, 9.5, 24.0),  # a quarter of the ramp
        (0.8, -1.0, 8.5, 24.0),
        (5.0, -1.0, 8.0, 24.0),
        (5.0, 0.0, 8.0, 24.0),
        (5.0, 0.1, 6.5, 22.0),
        (5.0, 3.0, 5.0, 20.0),
        (0.3, 0.1, 7.5, 22.0),  # a seam that ends in its hot start
    ],
)
def test_stages_and_ramps(arc_s: float, crater_s: float, wire: float, voltage: float) -> None:
    found = STAGES.values(math.nan, arc_s, crater_s)
    np.testing.assert_allclose(found[:2], (wire, voltage), atol=1e-9)
    assert math.isnan(found.current_A)  # of which nothing is ordered


def test_a_stage_without_a_ramp_is_a_step() -> None:
    step = WeldSchedule(current_A=100.0, hot_start=HotStart(current_A=140.0, time_s=0.5, ramp_s=0.0))
    assert [step.values(math.nan, t).current_A for t in (0.49, 0.51)] == [140.0, 100.0]


def test_the_gap_is_followed_within_a_table_step() -> None:
    """Gap 0 to 3 mm along 300 mm, measured each 10 mm with an error of 0.1 mm: compared row by row."""
    rng = np.random.default_rng(46)
    places = np.arange(0.005, 0.300, 0.010)
    true = lambda s: 3.0e-3 * (0.5 - 0.5 * np.cos(2.0 * np.pi * s / 0.4))  # noqa: E731 (rises and falls)
    measured = np.maximum(true(places) + rng.normal(0.0, 1e-4, len(places)), 0.0)
    measured[7] = math.nan  # where a clamp hides it
    along = gap_along(places, measured, np.full(len(places), 1e-4), TABLE)
    gaps = [row[0] for row in ROWS]
    for s in np.linspace(0.0, 0.3, 601):
        found = TABLE.values(along.at(s), 10.0)
        got = (found.wire_feed_m_min, found.voltage_V, 1e3 * TABLE.speed_m_s(along.at(s), 99.0))
        below = max(k for k, g in enumerate(gaps) if g <= 1e3 * true(s) + 1e-9)  # the rows around the true gap
        for column, value in enumerate(got, start=1):
            # a step of the table: not past the rows next to these two
            around = [ROWS[k][column] for k in range(max(below - 1, 0), min(below + 3, len(ROWS)))]
            assert min(around) <= value <= max(around), (s, column)
    assert TABLE.values(2.25e-3).wire_feed_m_min == pytest.approx(9.5)  # between two rows
    assert TABLE.values(9.0e-3).wire_feed_m_min == 10.4  # within the allowance past the last row: its values


def test_the_gap_shifts_run_and_not_the_hot_start() -> None:
    table = WeldSchedule(by_gap=TABLE.by_gap, hot_start=HotStart(wire_feed_m_min=12.0, time_s=0.2, ramp_s=0.2))
    assert table.values(1e-3, 0.1).wire_feed_m_min == 12.0
    assert table.values(1e-3, 0.3).wire_feed_m_min == pytest.approx(0.5 * (12.0 + 8.7))
    assert table.values(1e-3, 9.0).voltage_V == 23.4


def test_noise_of_a_coarse_scan_is_smoothed() -> None:
    """A butt in a scan of 1 mm: 0.4 mm of noise at each place, of which half is left; a slope stays."""
    rng, places = np.random.default_rng(4), np.arange(0.005, 0.300, 0.010)
    true = 1e-3 + 5e-3 * places
    left = []
    for _ in range(40):
        along = gap_along(places, true + rng.normal(0.0, 4e-4, len(places)), np.full(len(places), 4e-4), TABLE)
        left.append(along.gap_m - true)
    rms = np.sqrt(np.mean(np.square(left), axis=0))
    assert rms[3:-3].max() < 2.2e-4
    assert rms.max() < 3.5e-4  # at the ends there are places on one side only
    assert np.abs(np.mean(left, axis=0)).max() < 1.5e-4


@pytest.mark.parametrize(
    ("gap_mm", "words"), [([2.9, 3.5, 4.1], "At 30 mm of the seam the gap is 4.03 mm"), ([math.nan] * 3, "not show")]
)
def test_a_gap_without_a_row_is_refused(gap_mm: list[float], words: str) -> None:
    with pytest.raises(ScheduleError, match=words):
        gap_along(np.array([0.01, 0.02, 0.03]), 1e-3 * np.array(gap_mm), np.full(3, 1e-4), TABLE)


@pytest.mark.parametrize(
    ("schedule", "words"),
    [
        (WeldSchedule(wire_feed_m_min=-1.0), "wire_feed_m_min must be above 0"),
        (WeldSchedule(current_A=math.nan), "current_A must be above 0"),
        (WeldSchedule(job=70_000), "job must be from 0 to 65535"),
        (WeldSchedule(voltage_V=20.0, crater=Crater(voltage_V=18.0, ramp_s=0.5)), "raise welding.arc.crater_s"),
        (WeldSchedule(wire_feed_m_min=8.0, hot_start=HotStart(voltage_V=30.0)), "voltage_V is missing"),
        (WeldSchedule(by_gap=[GapRow(gap_mm=0.0, voltage_V=20.0)]), "two rows or more"),
        (WeldSchedule(by_gap=[GapRow(gap_mm=1.0, voltage_V=20.0), GapRow(gap_mm=0.5, voltage_V=21.0)]), "rising"),
        (WeldSchedule(by_gap=[GapRow(gap_mm=0.0, voltage_V=20.0), GapRow(gap_mm=0.5)]), "in all rows or in none"),
        (WeldSchedule(by_gap=[GapRow(gap_mm=0.0), GapRow(gap_mm=0.5)]), "a gap and no value"),
    ],
)
def test_schedules_that_are_refused(schedule: WeldSchedule, words: str) -> None:
    with pytest.raises(ScheduleError, match=words):
        schedule.check(crater_s=0.3)
