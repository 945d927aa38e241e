"""What a plan states across a seam: as large as errors of arms, scanners and calibrations; refused where too large."""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.jobs.test_tip_to_torch import ARM, PRIOR, Q_HOME, STRAIGHT, TOOL
from tests.welding.locate.lying import FLOOR, TABLE, looking, put, scan
from tests.welding.locate.lying import pose as lying_pose
from tests.welding.locate.test_fit_up import drawn, parts
from tests.worlds.parts.step_parts import assembly, box, write_step
from tests.worlds.wrong_models import station
from weldcal.calibration.calibrate import Steps, calibrate
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.geometry.se3 import exp_rotation, pose
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, with_link_transforms
from weldcal.models.arrays import Array
from weldcal.models.workpieces.part import HOVER_M, Part
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.seat import JointNotWeldable, Press
from weldcal.models.workpieces.shape import PartShape
from weldcal.systems.jobs.weld import seam_planning
from weldcal.systems.jobs.weld.seam_planning import (
    SeamPlanning,
    UncertainSeam,
    added_variance,
    plan_root_anyhow,
    plan_seam,
    unfelt_sigma,
)
from weldcal.systems.jobs.weld.tip_to_torch import torch_sigma
from weldcal.systems.messages import PlannedSeam, Scan
from weldcal.tools.report.weld import fit_up_csv, fit_up_document
from weldcal.welding.locate.planning import RootPlan, tip_seam
from weldcal.welding.record.process import path_error
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.tool_axes import tool_path


def square_butt(folder: Path, gap_mm: float) -> Part:
    """Two plates of 8 mm, side by side at y = 0, with a gap between them, from their STEP file."""
    step, csv = folder / "square_butt.step", folder / "line.csv"
    plates = assembly(box((0, 0.5 * gap_mm, -8), (220, 60, 8)), box((0, -90 - 0.5 * gap_mm, -8), (220, 90, 8)))
    write_step(plates, step)
    csv.write_text("0,0,0\n220,0,0\n")
    shape = read_shape(step, "mm")
    return Part(shape, seam_of(shape, SeamSource(csv), "butt"))


@pytest.mark.parametrize(("gap_mm", "felt"), [(0.0, False), (1.0, False), (3.0, True)])
def test_plates_too_close_for_a_ball_are_not_felt(tmp_path: Path, gap_mm: float, felt: bool) -> None:
    part = square_butt(tmp_path, gap_mm)
    assert np.abs(part.seam_P[:, 1:]).max() < 1e-6
    assert part.length_m == pytest.approx(0.220, abs=0.0015)
    assert part.felt_by(TOOL) is felt
    if not felt:
        assert part.seated(TOOL, Press(0.003, 0.002)) == pytest.approx((0.0, TOOL.tip_radius_m + HOVER_M))
    with pytest.raises(JointNotWeldable, match="feel: false") if not felt else pytest.MonkeyPatch.context():
        Part(part.shape, replace(part.seam, feel=True)).press(TOOL, None, None)


def test_a_tip_that_is_not_used_hangs_clear_of_both_walls(tmp_path: Path) -> None:
    """A web on a plate, which could be felt and shall not be."""
    step, csv = tmp_path / "t.step", tmp_path / "line.csv"
    write_step(assembly(box((0, -60, -8), (220, 120, 8)), box((0, 0, 0), (220, 8, 50))), step)
    csv.write_text("0,0,0,0,-1,1\n220,0,0,0,-1,1\n")
    shape = read_shape(step, "mm")
    part = Part(shape, replace(seam_of(shape, SeamSource(csv), "fillet"), feel=False))
    centre = part.seam_P[100] + part.seated(TOOL, Press(0.003, 0.002)).above_m * part.up_P[100]
    assert -centre[1] == pytest.approx(TOOL.tip_radius_m + HOVER_M, abs=1e-6)  # from the web
    assert centre[2] == pytest.approx(TOOL.tip_radius_m + HOVER_M, abs=1e-6)  # from the plate


def planning(estimate: CalibrationEstimate | None = None, **more: Any) -> SeamPlanning:
    return SeamPlanning(
        arm=ARM,
        tool=TOOL,
        workpiece=None,  # type: ignore[arg-type]  # it has no share in this
        X_BP_guess=None,
        config=ServoConfig(),
        q_near=Q_HOME,
        clearance_m=0.025,
        seam_length_m=None,
        estimate=estimate,
        **more,
    )


def root_at(point: Array, along: Array, part_m: float) -> RootPlan:
    """A short root through a point, level, known to `part_m` in the scan."""
    line = point + np.linspace(-0.01, 0.01, 21)[:, None] * along
    up = np.tile([0.0, 0.0, 1.0], (21, 1))
    return RootPlan(
        root=line,
        up=up,
        half_angle_rad=0.5 * math.pi,
        X_BP=None,
        sigma_m=part_m,
        rms_m=0.0,
        confidence=1.0,
        summary="found",
        across_m=np.full(21, part_m),
    )


def squared(widened: float, worlds: int = 16) -> float:
    """Mean square of the error across a seam in units of its stated sigma (times `widened`), over calibrations of wrong
    arms and scanners.

    The truth is where the arm itself says that the flange is at new postures, and where the calibrated scanner puts it.
    """
    found = []
    for seed in range(worlds):
        world = station(seed, scans=12, new=4, planned=False)
        estimate = calibrate(world.observations, Steps()).estimate
        correction = estimate.correction or ScannerCorrection()
        for o in world.new:
            stated = np.asarray(o.X_BR.translation())
            along = np.array([1.0, 0.0, 0.0])
            given, root = planning(estimate), root_at(stated, along, 0.0)
            sigma, _ = unfelt_sigma(given, root, *added_variance(given, root, STRAIGHT, PlannedSeam(), estimate.X_BC))
            off = estimate.X_BC @ correction.points(o.p_CR[None])[0] - stated
            found.append((off[1] / (widened * sigma)) ** 2)
    return float(np.mean(found))


def test_a_live_calibration_states_as_much_as_it_errs() -> None:
    """From both sides: a sigma four times too wide gives less than 0.25, and one four times too narrow more than 4."""
    once = squared(1.0)
    assert 0.25 < once < 2.0
    assert squared(4.0) < 0.25
    assert squared(0.25) > 4.0


def test_a_known_pose_states_what_arms_as_made_err() -> None:
    """300 arms drawn with the prior's errors: their rms scatters by 4 %."""
    stated = torch_sigma(ARM, TOOL, STRAIGHT, Q_HOME)
    rng, config = np.random.default_rng(3), ServoConfig()
    path = tool_path(STRAIGHT, config)
    ends = [int(np.argmin(np.abs(path.s_torch - s))) for s in (0.0, STRAIGHT.length)]
    scale = np.array([PRIOR.turn_rad, PRIOR.turn_rad, PRIOR.offset_rad, *[PRIOR.length_m] * 3])
    rms = []
    for k in ends:
        q, off = nearest_solution(ARM, path.X_BT[k] @ TOOL.X_FT.inverse(), Q_HOME), []
        assert q is not None
        left, there = (
            STRAIGHT.frame(float(path.s_torch[k])).normal,
            (forward_kinematics(ARM, q) @ TOOL.X_FT) @ TOOL.p_TW,
        )
        for _ in range(300):
            errors = scale * rng.standard_normal((6, 6))
            stack = np.array([X @ pose(exp_rotation(e[:3]), e[3:]) for X, e in zip(ARM.stack, errors, strict=True)])
            true = with_link_transforms(ARM, stack, "", "drawn")
            off.append(((forward_kinematics(true, q) @ TOOL.X_FT) @ TOOL.p_TW - there) @ left)
        rms.append(float(np.sqrt(np.mean(np.square(off)))))
    assert stated == pytest.approx(max(rms), rel=0.12)


def test_over_the_tolerance_it_is_refused_with_both_numbers_and_what_helps() -> None:
    at, plan = root_at(np.array([0.65, 0.0, 0.02]), np.array([0.0, 1.0, 0.0]), 1e-4), PlannedSeam(q_start=Q_HOME)

    def stated(sigma_m: float, tolerance_m: float) -> tuple[float, str]:
        given = planning(X_BC_sigma_m=sigma_m, tolerance_m=tolerance_m)
        return unfelt_sigma(given, at, *added_variance(given, at, STRAIGHT, plan, RigidTransform()))

    with pytest.raises(UncertainSeam, match=r"0\.32 mm across .*tolerance_mm \(0\.2 mm\): calibrate in the same job"):
        stated(3e-4, 2e-4)
    with pytest.raises(UncertainSeam, match="scan the part from nearer"):
        stated(5e-5, 1e-4)
    sigma, words = stated(3e-4, 3.2e-4)
    assert sigma == pytest.approx(math.hypot(3e-4, 1e-4))
    assert "followed from the scan and the drawing; not felt" in words


def test_parts_that_stand_apart_are_refused_before_the_arc_with_what_was_found() -> None:
    """A sheet 1.2 mm above the other, scanned by a ray caster of its own."""
    limits = {"gap": (0.0, 0.0008)}
    X = lying_pose((0.6, 0.0, 0.008), (0.0, 0.0, 0.3))
    eye = X[:3, :3] @ np.array([0.05, 0.4, 0.75]) + X[:3, 3]
    solids = parts("lap", 0.0012, 0.0, 0.0)
    X_BC = looking(eye, X[:3, 3])
    cloud = (scan([*put(solids, X), TABLE, FLOOR], X_BC, np.random.default_rng(4)) - X_BC[:3, 3]) @ X_BC[:3, :3]
    model, seam = drawn("lap")
    part = Part(PartShape(name="lap", mesh=model.mesh, edges=(), unit_m=1.0), seam)
    given = replace(planning(), workpiece=part, X_BP_guess=RigidTransform(X), limits=limits)
    seen = Scan(sequence=1, points_C=cloud.astype(np.float32))
    plan = plan_seam(given, seen, RigidTransform(X_BC), ScannerCorrection())
    assert plan.seam is None
    assert re.search(r"at \d+ mm of the seam the gap is 1\.[1-3]\d mm .* its limit is 0\.8 mm", str(plan.reason)), (
        plan.reason
    )
    assert plan.records[0].fit_up is not None
    document = fit_up_document(plan.records[0].fit_up)
    assert document["gap_mm"]["mean"] == pytest.approx(1.2, abs=0.1)
    rows = list(csv.DictReader(io.StringIO(fit_up_csv(plan.records))))
    assert np.mean([float(row["gap_mm"]) for row in rows if row["gap_mm"]]) == pytest.approx(1.2, abs=0.1)
    assert {row["misalignment_mm"] for row in rows} == {""}


def drawn_arm(rng: np.random.Generator, q: Array) -> Array:
    """How far the torch is from where an arm with a maker's errors reports it (3,) m."""
    errors = np.array([PRIOR.turn_rad, PRIOR.turn_rad, PRIOR.offset_rad, *[PRIOR.length_m] * 3]) * rng.standard_normal(
        (6, 6)
    )
    stack = np.array([X @ pose(exp_rotation(e[:3]), e[3:]) for X, e in zip(ARM.stack, errors, strict=True)])
    true, reported = (
        forward_kinematics(a, q) @ TOOL.X_FT @ TOOL.p_TW for a in (with_link_transforms(ARM, stack, "", ""), ARM)
    )
    return np.asarray(true - reported)


def drawn_scanner(rng: np.random.Generator, p_C: Array) -> Array:
    """Where a scanner as bought measures points (..., 3) m: 0.2 % off in scale, 1.5 % per metre in gradient."""
    scale, gx, gy = np.array([2e-3, 1.5e-2, 1.5e-2]) * rng.standard_normal(3)
    return np.asarray(p_C * (1.0 + scale + gx * p_C[..., :1] + gy * p_C[..., 1:2]))


def test_a_fresh_cell_states_what_its_scanner_and_arm_err() -> None:
    """Over 200 cells that nobody has calibrated; a sigma four times too wide or too narrow is out of the bounds."""
    rng, z = np.random.default_rng(61), []
    path = tool_path(STRAIGHT, ServoConfig())
    q = nearest_solution(ARM, path.X_BT[0] @ TOOL.X_FT.inverse(), Q_HOME)
    assert q is not None
    s = np.linspace(0.0, STRAIGHT.length, 9)
    root, left = STRAIGHT.position(s), np.array(STRAIGHT.normal(s))
    found = replace(root_at(root[4], np.array([0.0, 1.0, 0.0]), 1e-4), root=root, up=np.array(STRAIGHT.up(s)))
    for k in range(200):
        eye = np.array([0.65, 0.0, 0.95]) + 0.15 * rng.uniform(-1.0, 1.0, 3)
        X_BC = looking(eye, np.array([0.65, 0.0, 0.0]))
        measured = drawn_scanner(rng, (root - eye) @ X_BC[:3, :3]) @ X_BC[:3, :3].T + eye
        off = np.sum((measured - root + drawn_arm(rng, q)) * left, axis=1)
        if k % 10 == 0:
            plan = PlannedSeam(q_start=q)
            _, others = added_variance(planning(), found, STRAIGHT, plan, RigidTransform(X_BC))
        z.append(np.mean(off**2) / np.mean(others))
    assert 0.6 < math.sqrt(np.mean(z)) < 1.4


def test_a_fresh_cells_first_plan_lies_within_its_sigma(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fillet, scanned by a ray caster of its own with a scanner as bought; uncertain along itself, as a ring is."""

    def along_itself(*given: Any) -> RootPlan:
        return replace(plan_root_anyhow(*given), sigma_m=8e-3)

    monkeypatch.setattr(seam_planning, "plan_root_anyhow", along_itself)
    rng = np.random.default_rng(62)
    X = lying_pose((0.65, 0.0, 0.008), (0.0, 0.0, 0.5 * math.pi))
    X_BC = looking(np.array([0.65, 0.0, 0.95]), X[:3, 3])
    cloud = (scan([*put(parts("fillet", 0.0, 0.0, 0.0), X), TABLE, FLOOR], X_BC, rng) - X_BC[:3, 3]) @ X_BC[:3, :3]
    model, seam = drawn("fillet")
    part = Part(PartShape(name="fillet", mesh=model.mesh, edges=(), unit_m=1.0), seam)
    press = part.press(TOOL, None, None)
    tool = replace(TOOL, press_axial_m=press.axial_m, press_lateral_m=press.lateral_m)
    given = replace(planning(), workpiece=part, tool=tool, X_BP_guess=RigidTransform(X))
    seen = Scan(sequence=1, points_C=(cloud * (1.0 - 2e-3)).astype(np.float32))
    plan = plan_seam(given, seen, RigidTransform(X_BC), ScannerCorrection())
    assert plan.seam is not None, plan.reason
    line = tip_seam(part, RigidTransform(X), tool, None)
    off = path_error(plan.seam.position(np.linspace(0.0, plan.seam.length, 50)), line).lateral
    assert 0.25 * plan.sigma_m < float(np.sqrt(np.mean(off**2))) < 2.0 * plan.sigma_m
    assert f"with scanner and arm its sigma is {1e3 * plan.sigma_m:.2f} mm" in plan.summary
