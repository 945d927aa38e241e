"""The touch job finds flat places in a scan, lowers the tip until it gives way, and records where it touched."""

from __future__ import annotations

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.cells import EXACT_PLATE, Q_HOME, SMALL_IDEAL_SCANNER, TOOL, Drive, plain_station, scenario, the_arm
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.planning.clearance import Obstacle, Surroundings, arm_bodies
from weldcal.calibration.touch.judge import judge_touches
from weldcal.calibration.touch.touches import read_touches, touches_text
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, link_frames
from weldcal.models.errors import InputError
from weldcal.systems.jobs.touch.job import AddedTouches
from weldcal.systems.jobs.touch.planner import PlannedTouches, TouchConfig, TouchPlace, TouchPlanning, plan_touches
from weldcal.systems.jobs.touch.procedure import FRAMES, Felt, TouchInputs, TouchMotion, TouchProcedure, TouchState
from weldcal.systems.jobs.weld.arm_way import CLEAR_OF_PART_M
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import Scan, UrStatus
from weldcal.systems.scenario.checks import check_scenario
from weldcal.welding.servo.state import DeflectionSample

MOTION = TouchMotion(
    q_home=Q_HOME, descent_m_s=3e-3, press_m=1e-3, deepest_m=6e-3, move_timeout_s=20.0, maximum_time_s=500.0
)
FACE_Z = 0.02


@pytest.fixture(scope="module")
def planned() -> PlannedTouches:
    """Six places on the straight plate, as an ideal scanner of known pose sees it."""
    station, told = plain_station(), scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE)
    drive = Drive(station)
    drive.place_arm(Q_HOME)
    drive.set("scanner.trigger", [1.0])
    drive.run(0.15)
    scan: Scan = drive.get("scanner.scan")
    assert station.truth.X_BC is not None
    seam = seam_planning(told, station, servo_config(told, station))
    return plan_touches(TouchPlanning(seam, station.truth.X_BC, ScannerCorrection(), TouchConfig(points=6)), scan)


def test_the_places_are_on_the_flat_face_on_both_sides_and_the_tip_stands_above_them(planned: PlannedTouches) -> None:
    assert planned.reason is None
    assert len(planned.places) == 6
    p = np.array([place.p_B for place in planned.places])
    np.testing.assert_allclose(p[:, 2], FACE_Z, atol=1e-4)
    side = p[:, 0] - 0.65  # the straight seam runs along the base's y
    np.testing.assert_allclose(np.abs(side), 9e-3, atol=4e-3)
    assert (np.sign(side[::2]) != np.sign(side[1::2])).all()
    for place in planned.places:
        tip = (forward_kinematics(the_arm(), place.q_above) @ TOOL.X_FT).translation()
        np.testing.assert_allclose(
            tip - place.p_B, (TOOL.tip_radius_m + 1e-3 * TouchConfig().clearance_mm) * place.n_B, atol=1e-6
        )


def test_a_face_that_seems_tilted_by_three_degrees_does_not_refuse_a_place(planned: PlannedTouches) -> None:
    """The torch hangs as low as the tip, 60 mm from it: a few points of noise in the scanned face must not bring it to
    the part."""
    told = scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE)
    station = plain_station()
    seam = seam_planning(told, station, servo_config(told, station))
    assert station.truth.X_BP is not None
    part = Obstacle(
        "part", seam.workpiece.mesh.transformed(station.truth.X_BP), CLEAR_OF_PART_M + 0.06 * np.sin(np.radians(3.0))
    )
    bodies = arm_bodies(the_arm(), TOOL.capsules())
    assert all(Surroundings((part,)).touched(bodies, link_frames(the_arm(), p.q_above)) == "" for p in planned.places)


class Bench:
    """The procedure in a light world: moves end at once, and a rigid face lies at a height under the place."""

    def __init__(self, planned: PlannedTouches, face_m: float = 0.0) -> None:
        self.procedure = TouchProcedure(the_arm(), TOOL, MOTION)
        self.state, self.time, self.height, self.face_m = TouchState(), 0.0, 0.015, face_m
        self.plan, self.frame, self.blind, self.hold = dc.replace(planned, sequence=1), 0, False, False

    def run(self, seconds: float, until: str = "") -> TouchState:
        """Let time pass, tick by tick; at most until a phase begins."""
        for _ in range(int(seconds / 0.004)):
            self.time += 0.004
            if self.state.phase == "descend":
                self.height -= 0.004 * MOTION.descent_m_s
            if self.state.phase in ("lift", "to_above"):
                self.height = 0.015
            self.frame += int(not self.blind)
            deflection = np.array([0.0, 0.0, max(self.face_m - self.height, 0.0) + 1e-4])
            sample = DeflectionSample(self.time, RigidTransform(), deflection, True)
            felt = Deformation(self.frame, sample)
            now = TouchInputs(
                time=self.time,
                q=Q_HOME,
                settled_goal=self.state.goal_id,
                robot=UrStatus(),
                hold=self.hold,
                planned_touches=self.plan,
                deformation=felt,
                height=self.height,
            )
            self.state = self.procedure.next_state(self.state, now)
            if self.state.finished or (until and self.state.phase == until):
                break
        return self.state


def test_each_place_is_touched_once_and_the_free_tip_s_reading_is_its_zero(planned: PlannedTouches) -> None:
    state = Bench(planned).run(120.0)
    assert state.phase == "done"
    assert [felt.place for felt in state.felt] == list(planned.places)
    for felt in state.felt:
        np.testing.assert_allclose(felt.deflection_T, [0.0, 0.0, MOTION.press_m], atol=5e-5)
        assert FRAMES > 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"face_m": -0.02}, "met nothing at place 1"),
        ({"blind": True}, "does not see the tip's tag"),
        ({"hold": True}, "The operator ended the job in phase 'zero'."),
    ],
)
def test_what_goes_wrong_holds_the_job_with_a_reason(
    planned: PlannedTouches, change: dict[str, float], said: str
) -> None:
    bench = Bench(planned)
    bench.run(10.0, until="zero")
    for name, value in change.items():
        setattr(bench, name, value)
    state = bench.run(60.0)
    assert state.phase == "held"
    assert said in state.reason
    assert not state.felt
    lost = Bench(planned)
    lost.run(20.0, until="descend")
    lost.blind = True
    assert "lost the tip's tag" in lost.run(5.0).reason


def test_the_touches_of_a_true_calibration_agree_with_the_scan_and_go_through_the_table(
    planned: PlannedTouches, tmp_path: Path
) -> None:
    """The tip pressed by a millimetre into a rigid face: its ball gives way by what its stiffness says."""
    station = plain_station()
    given_way = 1e-3
    radius = TOOL.tip_radius_m - TOOL.indentation(TOOL.axial_stiffness_N_per_m * given_way)
    felt = []
    for place in planned.places:
        felt.append((place, _joints_at(place, radius - given_way)))
    state = TouchState(felt=tuple(_felt(place, q, given_way) for place, q in felt))
    job = AddedTouches.__new__(AddedTouches)
    job.station = station
    job.state = lambda root: state  # type: ignore[method-assign]
    touches = job.touches(None)  # type: ignore[arg-type]
    (tmp_path / "touches.csv").write_text(touches_text(touches))
    read = read_touches(tmp_path / "touches.csv")
    assert station.truth.X_BC is not None
    result = CalibrationResult(
        X_BC=station.truth.X_BC,
        covariance=1e-10 * np.eye(6),
        held_out_mm={},
        tilt_deg={},
        poses=(),
        sigma_position_mm=0.02,
        robot="ur10e",
    )
    for each in (touches, read):
        assert np.abs(judge_touches(result, each).error_m).max() < 2e-5


def _joints_at(place: TouchPlace, height_m: float) -> np.ndarray:
    """Joints that put the tip at rest this high over a place."""
    above = forward_kinematics(the_arm(), place.q_above) @ TOOL.X_FT
    wanted = RigidTransform(above.rotation(), np.add(place.p_B, height_m * place.n_B)) @ TOOL.X_FT.inverse()
    q = nearest_solution(the_arm(), wanted, place.q_above)
    assert q is not None
    return np.asarray(q)


def _felt(place: TouchPlace, q: np.ndarray, given_way: float) -> Felt:
    return Felt(place, q, np.array([0.0, 0.0, given_way]))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"result": "nowhere"}, "touch.result must be a result of weldcal calibrate"),
        ({"points": 2}, "touch.points must be from 3 to 60"),
        ({"press_mm": 0.0}, "touch.press_mm must be a positive number"),
        ({"turn_deg": 80.0}, "touch.turn_deg must be from 0 to 45"),
    ],
)
def test_a_touch_that_cannot_be_is_one_sentence(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    told = scenario()
    told.job.calibrate = told.job.weld = False
    told.touch = dc.replace(TouchConfig(result=str(tmp_path)), **changes)  # type: ignore[attr-defined,arg-type]
    with pytest.raises(InputError, match=said):
        check_scenario(told)
