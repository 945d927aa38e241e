"""The schedule in a weld: it follows a gap that the scan shows, the servo's speed with it, and its stages in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.jobs.test_unfelt import planning
from tests.welding.locate.lying import FLOOR, TABLE, looking, pose, put, scan
from tests.welding.locate.test_fit_up import drawn, parts
from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.arc_schedule import ArcSchedule
from weldcal.systems.jobs.weld.seam_planning import planned_gap
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport, at_gap
from weldcal.systems.messages import PlannedSeam
from weldcal.systems.scenario.loading import load_scenario
from weldcal.welding.locate.part.joint import measure_fit_up
from weldcal.welding.locate.planes import into
from weldcal.welding.locate.planning import _about_seam
from weldcal.welding.numerics import changed
from weldcal.welding.record.schedule import Crater, GapAlong, GapRow, HotStart, WeldSchedule
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.arc import Stand
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import WeldingState

# a row each 0.5 mm: gap mm, wire feed m/min, speed mm/s
ROWS = [(0.5 * k, w, v) for k, (w, v) in enumerate(
    [(8.0, 8.0), (8.2, 7.6), (8.7, 7.0), (8.8, 6.7), (9.4, 6.0), (9.6, 5.6), (10.4, 5.0)]
)]  # fmt: skip
TABLE_BY_GAP = WeldSchedule(by_gap=[GapRow(gap_mm=g, wire_feed_m_min=w, speed_mm_s=v) for g, w, v in ROWS])
LENGTH_M = 0.190  # of the drawn seam


def rising_gap(s_m: float) -> float:
    """The true gap m of the turned plate: 0.1 mm at the seam's start to 2.95 mm at its end."""
    return 1e-4 + 2.85e-3 * s_m / LENGTH_M


def cast(joint: str, seed: int) -> GapAlong:
    """A lap whose upper sheet is tilted along the seam, or plates that open along it, scanned by a ray caster of its
    own."""
    turn, middle = math.atan(2.85e-3 / LENGTH_M), rising_gap(0.5 * LENGTH_M)
    first, second = parts(joint, 0.0, 0.0, 0.0)
    X = pose((0.0, 0.0, middle), (0.0, -turn, 0.0)) if joint == "lap" else pose((0.0, middle, 0.0), (0.0, 0.0, turn))
    solids = [first, *put([second], X)]
    X = pose((0.6, 0.0, 0.008), (0.0, 0.0, 0.4))
    eye = X[:3, :3] @ np.array([0.05, 0.4 if joint == "lap" else 0.1, 0.75]) + X[:3, 3]
    cloud = scan([*put(solids, X), TABLE, FLOOR], looking(eye, X[:3, 3]), np.random.default_rng(seed))
    points = cloud.reshape(-1, 3)
    points, X_BP = points[np.isfinite(points).all(axis=1)], RigidTransform(X)
    model, seam = drawn(joint)
    near, normals = _about_seam(into(X_BP, points), into(X_BP, eye[None])[0], seam)
    found = measure_fit_up(near, normals, 0.75 / 850.0, model, seam)
    line = SeamCurve.from_points(seam.points_P)
    gap = planned_gap(planning(schedule=TABLE_BY_GAP), found, line, line)
    assert gap is not None
    return gap


@pytest.fixture(scope="module")
def measured() -> GapAlong:
    """Of a lap."""
    return cast("lap", 46)


@pytest.mark.parametrize(("joint", "seed"), [("lap", 46), ("butt", 47)])
def test_the_schedule_follows_a_gap_of_0_to_3_mm_within_a_table_step(joint: str, seed: int) -> None:
    gap = cast(joint, seed)
    for s in np.linspace(0.0, LENGTH_M, 96):
        assert gap.at(s) == pytest.approx(rising_gap(s), abs=0.25e-3)
        feed = TABLE_BY_GAP.values(gap.at(s), 10.0).wire_feed_m_min
        speed = 1e3 * TABLE_BY_GAP.speed_m_s(gap.at(s), 0.0)
        k = int(1e3 * rising_gap(s) / 0.5)  # the true gap is between the rows k and k + 1
        around = ROWS[max(k - 1, 0) : k + 3]
        assert min(r[1] for r in around) <= feed <= max(r[1] for r in around), s
        assert min(r[2] for r in around) <= speed <= max(r[2] for r in around), s


def test_the_servo_gets_the_speed_of_its_place(measured: GapAlong) -> None:
    config = ServoConfig()
    assert at_gap(config, TABLE_BY_GAP, None, WeldingState()) is config
    assert at_gap(config, WeldSchedule(wire_feed_m_min=8.0), measured, WeldingState()) is config
    before = at_gap(config, TABLE_BY_GAP, measured, WeldingState())
    assert before.weld_speed_m_s == 8e-3, "the fastest one, by which the seam is found feasible"
    plan_fit = object()  # of a weld that has begun
    speeds = [
        at_gap(config, TABLE_BY_GAP, measured, changed(WeldingState(), plan_fit=plan_fit, s_torch=s)).weld_speed_m_s
        for s in (0.01, 0.1, 0.18)
    ]
    assert speeds[0] > speeds[1] > speeds[2]
    assert speeds[2] == pytest.approx(TABLE_BY_GAP.speed_m_s(measured.at(0.18), 0.0))


def test_a_piece_of_a_seam_starts_at_its_own_place(measured: GapAlong) -> None:
    """What is planned from 80 mm on has the gap of there at its start."""
    line = SeamCurve.from_points(np.column_stack([np.linspace(0.0, LENGTH_M, 96), np.zeros(96), np.zeros(96)]))
    piece = SeamCurve.from_points(line.position(np.linspace(0.08, LENGTH_M, 60)))
    fit_up = type("Found", (), {"s_m": measured.s_m, "values": {"gap": measured.gap_m},
                                "sigmas": {"gap": np.full(len(measured.s_m), 1e-4)}})  # fmt: skip
    found = planned_gap(planning(schedule=TABLE_BY_GAP), fit_up, line, piece)  # type: ignore[arg-type]
    assert found is not None
    assert found.at(0.0) == pytest.approx(measured.at(0.08), abs=3e-5)
    assert planned_gap(planning(), None, line, piece) is None


STAGES = WeldSchedule(
    job=7,
    wire_feed_m_min=8.0,
    hot_start=HotStart(wire_feed_m_min=10.0, time_s=0.2, ramp_s=0.2),
    crater=Crater(wire_feed_m_min=5.0, ramp_s=0.2),
)


def test_the_stages_begin_with_the_arc_and_with_the_stand_at_the_end() -> None:
    system = ArcSchedule(STAGES)
    context = system.CreateDefaultContext()
    port = {
        name: system.GetInputPort(name) for name in ("servo_report", "planned_seam", "process_on", "arc_established")
    }
    port["planned_seam"].FixValue(context, PlannedSeam())
    feeds = []
    for k in range(200):
        now = 0.008 * k
        context.SetTime(now)
        port["process_on"].FixValue(context, [float(0.1 < now < 1.5)])
        port["arc_established"].FixValue(context, [float(0.3 < now < 1.5)])  # 0.2 s after the torch
        stand = Stand.CRATER if now > 1.0 else Stand.NONE
        port["servo_report"].FixValue(context, ServoReport(state=changed(WeldingState(), stand=stand)))
        discrete = system.AllocateDiscreteVariables()
        discrete.SetFrom(context.get_discrete_state())
        system._update(context, discrete)
        context.SetDiscreteState(discrete)
        job, feed, *others = system.GetOutputPort("set_values").Eval(context)
        assert job == 7
        assert np.isnan(others).all()
        feeds.append((now, feed))
    at = {round(t, 3): f for t, f in feeds}
    assert at[0.048] == at[0.2] == at[0.4] == 10.0  # before the torch, before the arc, hot
    assert at[0.608] == pytest.approx(9.0, abs=0.45)  # half of the ramp, within a tick
    assert at[0.8] == at[1.0] == 8.0
    assert at[1.104] == pytest.approx(6.5, abs=0.35)
    assert at[1.4] == 5.0
    assert at[1.56] == 10.0  # over: ready for the next


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("welding: {schedule: {wire_feed_m_min: 8.0}}", "sets wire_feed_m_min, and nothing passes it on"),
        (
            "{power_source: !SimulatedPowerSource {}, welding: {schedule: {by_gap: [{gap_mm: 0, voltage_V: 20},"
            " {gap_mm: 1, voltage_V: 21}]}}}",
            "by_gap needs a joint whose gap is measured",
        ),
        (
            "{power_source: !SimulatedPowerSource {}, welding: {schedule: {voltage_V: 20, crater: {voltage_V: 18}}}}",
            "raise welding.arc.crater_s",
        ),
        (
            "{robot: !UrRtde {host: h, process_output: 0, arc_input: 1}, power_source: !SimulatedPowerSource {}}",
            "both report the arc",
        ),
    ],
)
def test_schedules_that_a_cell_cannot_follow_are_refused(keys: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_scenario("straight_groove", keys)
