"""The study in short: one weld of each kind holds its target, and the command writes what it promises."""

from __future__ import annotations

import csv
import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.figures.harness import Run
from tests.figures.weld.rows import ROWS, MetricTarget, UnknownRow, get_rows, hold_against, run_turn
from tests.figures.weld.study import study
from tests.worlds.weld.budgets import BUDGETS, HARD, NOMINAL, PERFECT, WeldUnknowns, draw_world, planned_seam, roughness
from tests.worlds.weld.case import RunMetrics, WeldCase, run_case, study_config
from tests.worlds.weld.groove import DRAWN, DROP_M, SEAT_M, Groove, TipPlace
from tests.worlds.weld.plant import Stamps, StudyRun, simulate
from tests.worlds.weld.seams import NAMES, UnknownSeam, get_seam
from weldcal.welding.record.process import path_error
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.state import DeflectionSample

MM = 1e-3
TARGETS = {row.key: row for row in ROWS}


def holds(key: str, case: WeldCase, seed: int = 0) -> RunMetrics:
    """One weld against the targets of its row."""
    _, figures = run_case(case, seed)
    assert figures.completed, figures.reason
    for target in TARGETS[key].targets:
        assert getattr(figures, target.figure) <= target.limit, target.figure
    return figures


@pytest.mark.parametrize("seam", ["s_r60", "l_r20_concave"])
def test_a_gentle_seam_holds_the_nominal_targets(seam: str) -> None:
    holds("nominal", WeldCase(seam), 1)


def test_the_imperfect_world_holds_its_targets() -> None:
    holds("imperfect", WeldCase("s_r60", "imperfect"), 1)


@pytest.fixture(scope="module")
def known() -> StudyRun:
    """The weld of a straight seam in a groove that is as the servo knows it."""
    return simulate(get_seam("straight"), NOMINAL, study_config(WeldCase("straight")), 0, time_limit_s=25.0)


@pytest.mark.parametrize(
    ("budget", "side_mm", "height_mm"),
    [
        # r/sin of 23.25 deg against r/sin of 22.5 deg, r 2.5 mm
        ("wedge_open", 0.0, 2.5 / math.sin(math.radians(23.25)) - 2.5 / math.sin(math.radians(22.5))),
        ("wedge_side", 2.5 / math.sin(math.radians(22.5)) * math.sin(math.radians(0.75)), 0.0),
        ("wear", 0.0, -0.1 / math.sin(math.radians(22.5))),
        ("seat", 0.0, 0.1),
    ],
)
def test_what_the_servo_does_not_know_of_its_groove_shows_in_full(
    budget: str, side_mm: float, height_mm: float, known: StudyRun
) -> None:
    """A servo that were told of it would correct it."""
    run = simulate(
        get_seam("straight"), BUDGETS[budget], study_config(WeldCase("straight", budget)), 0, time_limit_s=25.0
    )
    off = []
    for weld in (run, known):
        error = path_error(weld.points("torch")[weld.column("torch_on") > 0.5], weld.torch_line)
        inside = error.s > 0.02
        off.append(1e3 * np.array((error.lateral[inside].mean(), error.height[inside].mean())))
    # Two welds with the same noise: a mean over 80 mm is the same to a few micrometres.
    np.testing.assert_allclose(off[0] - off[1], (side_mm, height_mm), atol=0.03)


def test_a_picture_gets_the_pose_of_its_stamp() -> None:
    stamps = Stamps(WeldUnknowns(image_bias_s=-0.010, pose_bias_s=0.008), 0)
    told = []
    for k in range(40):
        c, s = math.cos(0.5 * 0.008 * k), math.sin(0.5 * 0.008 * k)
        R, p = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))), np.array((0.008 * 0.008 * k, 0.0, 0.0))
        told.append(stamps.pose(0.008 * k, R, p))
    np.testing.assert_allclose(told, 0.008 * np.arange(40) + 0.008)
    taken = DeflectionSample(0.2, RigidTransform(), np.zeros(3), True)
    seen = stamps.picture(taken)
    assert seen.capture_time == pytest.approx(0.190)
    # 18 ms before the exposure, at 8 mm/s and 0.5 rad/s.
    assert seen.X_BT_at_capture.translation()[0] == pytest.approx(0.008 * 0.182, abs=1e-9)
    turn = RollPitchYaw(seen.X_BT_at_capture.rotation()).yaw_angle()
    assert turn == pytest.approx(0.5 * 0.182, abs=1e-6)
    exact = Stamps(WeldUnknowns(), 0)
    assert exact.pose(0.3, np.eye(3), np.zeros(3)) == 0.3
    assert exact.picture(taken) is taken


def test_a_world_is_drawn_within_its_ranges_and_is_that_of_its_seed() -> None:
    ranges = BUDGETS["imperfect"].unknown
    worlds = [draw_world(ranges, seed) for seed in range(200)]
    for field in fields(WeldUnknowns):
        low, high = getattr(ranges, field.name)
        drawn = np.array([getattr(w, field.name) for w in worlds])
        assert drawn.min() >= low
        assert drawn.max() <= high
        # 200 even draws come to within a tenth of both ends.
        assert drawn.max() - drawn.min() >= 0.8 * (high - low)
    assert draw_world(ranges, 7) == worlds[7]
    assert draw_world(NOMINAL.unknown, 7).wedge == DRAWN
    assert draw_world(NOMINAL.unknown, 7).lag_s(0.020, 0.025) == 0.020
    assert draw_world(BUDGETS["lag_double"].unknown, 7).lag_s(0.020, 0.025) == 0.050


def test_the_stamps_jitter_has_its_sigma_and_the_clock_never_runs_back() -> None:
    stamps = Stamps(WeldUnknowns(pose_jitter_s=0.002, image_jitter_s=0.002), 3)
    told = np.array([stamps.pose(0.008 * k, np.eye(3), np.zeros(3)) for k in range(2000)])
    assert np.all(np.diff(told) > 0.0)
    # 2000 stamps know their sigma to 2 %; the few that would run back are held.
    assert np.std(told - 0.008 * np.arange(2000)) == pytest.approx(0.002, rel=0.08)


def test_the_hard_budget_holds_its_targets() -> None:
    holds("hard", WeldCase("s_r60", "hard"))


def test_round_a_sharp_concave_corner_the_torch_goes_by_what_was_felt() -> None:
    # With this seed it was 0.34 mm off when the plan, which is 2 mm late, stood in for points close together.
    assert holds("r1_concave", WeldCase("l_r1_concave"), 100).max_mm <= 0.2


def test_a_sharp_concave_corner_is_welded_in_the_hard_budget() -> None:
    holds("hard_corners", WeldCase("l_r1_concave", "hard"), 2)


def test_a_gap_of_ten_millimetres_hardly_shows() -> None:
    holds("gap_10", WeldCase("s_r60", gaps=((0.145, 0.155),)))


def test_a_fast_weld_holds_its_target() -> None:
    holds("speed_24", WeldCase("l_r20_convex", speed_m_s=0.024))


def test_on_a_cylinder_work_and_travel_angle_are_as_foretold() -> None:
    figures = holds_space(WeldCase("s_r60_on_r150", "kinematic"))
    # asin(d/2R) of the line that rest point and torch run on, R 150 mm raised by the seat, less 3 mm, on the part of it
    # that is crossed square to the axis.
    assert figures.travel_deg == pytest.approx(
        math.degrees(math.asin(0.060 / (2.0 * (0.150 + SEAT_M - 3.0 * MM)))), abs=0.15
    )


def holds_space(case: WeldCase) -> RunMetrics:
    _, figures = run_case(case, 0)
    assert figures.completed
    assert figures.mean_mm <= 0.03
    assert figures.work_deg <= 3.0
    return figures


def test_a_turn_no_torch_can_follow_is_refused_and_welded_in_pieces() -> None:
    turn = run_turn("u_r20", 0.060, 0)
    assert not turn.possible
    assert turn.refused
    assert turn.named
    assert turn.pieces_done == len(turn.splits_mm) + 1 == 2
    # The split is in the middle of the half circle: 120 mm and a quarter of 2 pi 20 mm along.
    assert turn.splits_mm[0] == pytest.approx(120.0 + 0.5 * math.pi * 20.0, abs=3.0)


def test_figures_that_a_run_lacks_count_as_missed() -> None:
    case = WeldCase("straight")
    good, broken = (
        RunMetrics(completed=True, phase="DONE", reason="", reached_mm=300.0, max_mm=0.1),
        RunMetrics(completed=False, phase="FAULT", reason="why", reached_mm=20.0),
    )
    target = MetricTarget("max_mm", 0.15)
    assert hold_against(target, {case: {0: good}}).met
    both = hold_against(target, {case: {0: good, 1: broken}})
    assert not both.met
    assert both.worst_run.endswith("seed 1")
    assert hold_against(MetricTarget("max_mm", 0.15, "mean"), {case: {0: good, 1: good}}).mean == pytest.approx(0.1)


def test_rows_and_seams_are_named_when_unknown() -> None:
    with pytest.raises(UnknownRow, match="nominal"):
        get_rows(("nonsense",))
    with pytest.raises(UnknownSeam, match="s_r60"):
        get_seam("nonsense")
    assert {case.seam for row in ROWS for case in row.cases} <= set(NAMES)


@pytest.mark.parametrize("name", ["straight", "s_r60", "l_r20_convex", "l_r1_concave", "arc_r60_end"])
def test_every_flat_seam_is_three_hundred_millimetres_long(name: str) -> None:
    seam = get_seam(name)
    assert SeamCurve.from_points(seam.points, seam.up).length == pytest.approx(0.3, abs=0.3 * MM)


def test_a_plan_is_off_by_what_its_budget_says() -> None:
    seam = get_seam("s_r60")
    true = SeamCurve.from_points(seam.points, seam.up)
    assert planned_seam(seam, PERFECT, np.random.default_rng(0)).length == pytest.approx(true.length, abs=1e-9)
    off = [path_error(planned_seam(seam, b, np.random.default_rng(k)).position(np.linspace(0.01, 0.29, 60)), true).max_m
           for b in (NOMINAL, HARD) for k in range(6)]  # fmt: skip
    # Shift, bend, half a degree over 150 mm, noise: at most their sum, and hardly ever under a fifth of it.
    assert max(off[:6]) <= 2.0 * MM + 0.5 * MM + 1.31 * MM + 1.0 * MM
    assert max(off[6:]) <= 3.0 * MM + 1.0 * MM + 1.31 * MM + 1.5 * MM
    assert min(off) >= 0.5 * MM


def test_the_walls_roughness_has_its_sigma_and_its_length() -> None:
    rough = roughness(20.0, HARD, np.random.default_rng(0))
    assert rough.std() == pytest.approx(0.1 * MM, rel=1e-6)
    lag = round(2.0 * MM / 0.25e-3)
    # exp(-(x/L)^2) at x = L; 10,000 lengths leave a hundredth.
    assert np.mean(rough[lag:] * rough[:-lag]) / rough.var() == pytest.approx(math.exp(-1.0), abs=0.05)


def test_the_tip_sits_in_the_groove_lags_by_friction_and_relaxes_beyond_the_end() -> None:
    line = SeamCurve.from_points(get_seam("straight").points).raised(SEAT_M)
    pressed = np.array([0.1, 1.0 * MM, SEAT_M - 3.0 * MM])
    tip = TipPlace(pressed, Groove(line, friction=0.2))
    for k in range(300):
        centre = tip.step(pressed + np.array([1e-4 * k, 0.0, 0.0]), 0.008)
    np.testing.assert_allclose(centre[1:], [0.0, SEAT_M], atol=1e-9)
    # It drags behind by mu F / (k sin b): F = 0.9 N of the axial spring, k = 600 N/m.
    assert 0.1 + 1e-4 * 299 - centre[0] == pytest.approx(0.2 * 0.9 / math.sin(math.radians(22.5)) / 600.0, rel=1e-3)
    beyond = np.array([0.32, 1.0 * MM, SEAT_M - 3.0 * MM])
    free = TipPlace(beyond, Groove(line))
    for _ in range(100):
        centre = free.step(beyond, 0.008)
    np.testing.assert_allclose(centre, beyond, atol=1e-6)
    assert DRAWN.floor(0.0) == (0.0, pytest.approx(1.0 / math.tan(math.radians(22.5))))
    assert DRAWN.floor(20.0 * MM) == (DROP_M, 0.0)


def test_the_figure_prints_its_row_and_draws_its_seam(tmp_path: Path) -> None:
    run = Run(out=tmp_path)
    # A sharp convex corner is put back from its two sides, within the target of its row.
    study(run, ("r1_convex",))
    assert "L R1 convex, nominal" in run.text[0]
    assert "MISSED" not in run.text[0]
    with (tmp_path / "runs.csv").open() as file:
        assert [row["case"] for row in csv.DictReader(file)] == ["l_r1_convex-d60-nominal"]
    pictures = {path.name: path.read_text() for path in tmp_path.glob("*.svg")}
    assert set(pictures) == {f"l_r1_convex-d60-nominal_{kind}.svg" for kind in ("paths", "along")}
    assert all("<svg" in picture for picture in pictures.values())
