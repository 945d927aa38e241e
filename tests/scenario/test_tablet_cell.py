"""A visit to the tablet in the station, from the first look to the last touch: the pen meets the glass, and camera and
pen are found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.jobs.tablet.config import TabletTouch, WristPicture
from weldcal.systems.jobs.tablet.job import plan_tablet
from weldcal.systems.jobs.tablet.procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.messages import UrStatus
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import Station
from weldcal.tools.commands.tablet.demo import run_tablet_demo
from weldcal.tools.commands.weld import known_camera, run_scenario
from weldcal.tools.procedure import kind_of, run_procedure
from weldcal.tools.report.run import RunOptions

# six landmarks and quick descents: half of the shipped scenario's time
SHORT = "tablet: {rows: 2, across_mm: 60.0, down_mm: 60.0, turn_deg: 36.0, clearance_mm: 12.0, descent_mm_s: 25.0}"


@dataclass(frozen=True)
class Demo:
    """What one run left."""

    summary: dict[str, Any]
    folder: Path
    station: Station


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Demo:
    folder = tmp_path_factory.mktemp("tablet")
    shipped = (repository / "models" / "scenarios" / "tablet.yaml").read_text(encoding="utf-8")
    before, after = shipped[: shipped.index("tablet:\n")], shipped[shipped.index("calibration:") :]
    (folder / "short.yaml").write_text(f"{before}{SHORT}\n{after}")
    options = RunOptions(scenario=str(folder / "short.yaml"), out=folder / "out", seed=3, recording=False)
    result = run_procedure(options, lambda *_: None)
    return Demo(result.summary(), result.folder, result.run.cell.station)  # type: ignore[attr-defined]


def test_every_landmark_is_touched(demo: Demo) -> None:
    assert demo.summary["state"] == "done", demo.summary.get("reason")
    assert demo.summary["n_touches"] == 6


def test_camera_and_pen_are_found(demo: Demo) -> None:
    """Before: camera 4 mm and 2 deg, pen 3 mm off. One picture with 0.05 px leaves its tilt open to some 0.1 deg."""
    assert demo.summary["X_FC_error_mm"] < 1.2
    assert demo.summary["X_FC_error_deg"] < 0.25
    assert demo.summary["pen_error_mm"] < 0.3
    assert demo.summary["unobservable"] == ()


def test_points_that_nobody_touched_are_met(demo: Demo) -> None:
    # the tablet's own 0.3 px is 0.06 mm per axis, a pixel 0.5 mm on the tablet and its landmarks good to a tenth of it
    assert demo.summary["unseen_touch_mm"]["mean"] < 0.15
    assert demo.summary["leave_one_out_mm"] < 0.3


def test_depth_by_the_plane_beats_depth_by_the_pixel(demo: Demo) -> None:
    assert demo.summary["depth_by_plane_mm"] < 0.1 < 0.3 < demo.summary["depth_by_pixel_mm"]


def test_the_run_leaves_what_the_calibration_reads(demo: Demo) -> None:
    names = {path.name for path in demo.folder.iterdir()}
    files = {"touches.csv", "poses.csv", "camera.yaml", "picture.png", "tablet.yaml", "ur_pose.script", "report.html"}
    assert files <= names
    assert "pose of the camera C in the robot" in (demo.folder / "report.html").read_text(encoding="utf-8")


def test_it_is_the_one_station_with_a_pen_a_camera_and_a_tablet(demo: Demo) -> None:
    diagram = demo.station.diagram
    for name in ("wrist_camera.trigger", "arm.velocity_command"):
        assert diagram.HasInputPort(name)
    for name in ("wrist_camera.picture", "digitizer.touch", "arm.position_measured", "cheat.truth"):
        assert diagram.HasOutputPort(name)
    assert not diagram.HasInputPort("scanner.trigger")
    assert demo.station.truth.tablet is not None


@dataclass(eq=False)
class Alone:
    """The procedure by itself: its inputs are told, and every goal it sets is reached at once."""

    simulator: Simulator
    procedure: TabletProcedure
    plan: TabletPlan

    def tell(self, **inputs: object) -> None:
        for name, value in inputs.items():
            self.procedure.GetInputPort(name).FixValue(self.simulator.get_mutable_context(), value)

    @property
    def state(self) -> TabletState:
        shown: TabletState = self.procedure.GetOutputPort("state").Eval(self.simulator.get_context())
        return shown

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            if self.state.goal_id:
                self.tell(settled_goal=[self.state.goal_id], position_measured=np.array(self.state.q_goal))
            now = float(self.simulator.get_context().get_time())
            if self.state.q_goal is not None:
                here = np.tile(self.state.q_goal, (2, 1))
                self.tell(history=AbstractValue.Make(PoseHistory(np.array([-1.0, now + 1.0]), here)))
            if self.state.phase == "look":
                self.tell(picture=AbstractValue.Make(WristPicture(self.state.trigger, now)))
            self.simulator.AdvanceTo(now + 0.01)


@pytest.fixture
def alone() -> Alone:
    arm, scenario = load_arm("ur10e"), load_scenario("tablet")
    plan = plan_tablet(scenario, arm)
    procedure = TabletProcedure(arm, plan)
    made = Alone(Simulator(procedure), procedure, plan)
    made.tell(
        position_measured=plan.q_home,
        settled_goal=[0.0],
        robot_status=AbstractValue.Make(UrStatus()),
        picture=AbstractValue.Make(WristPicture()),
        touch=AbstractValue.Make(TabletTouch()),
        history=AbstractValue.Make(PoseHistory()),
        hold=[0.0],
    )
    return made


def test_a_tablet_that_feels_nothing_holds_the_procedure_and_the_arm_goes_home(alone: Alone) -> None:
    alone.run(0.5)
    assert alone.state.phase == "descend"
    alone.run(alone.plan.longest_descent_s)
    assert alone.state.phase == "held"
    assert "did not touch the tablet at landmark 1" in alone.state.reason
    np.testing.assert_array_equal(alone.state.q_goal, alone.plan.q_home)


def test_a_bounce_on_the_way_up_is_not_the_next_touch(alone: Alone) -> None:
    alone.run(0.5)
    alone.tell(touch=AbstractValue.Make(TabletTouch(1, 0.5, np.zeros(2), True)))
    alone.run(0.02)
    alone.tell(touch=AbstractValue.Make(TabletTouch(2, 0.52, np.ones(2), True)))
    alone.run(0.5)
    assert alone.state.phase == "descend"
    assert alone.state.landmark == 1
    assert len(alone.state.touches) == 1


def test_a_stopped_robot_holds_the_procedure_with_its_own_words(alone: Alone) -> None:
    alone.run(0.5)
    alone.tell(robot_status=AbstractValue.Make(UrStatus(safety_mode="PROTECTIVE_STOP", fault="It stopped.")))
    alone.run(0.05)
    assert (alone.state.phase, alone.state.reason) == ("held", "It stopped.")
    assert not alone.procedure.GetOutputPort("descent").Eval(alone.simulator.get_context()).any()


def test_a_person_holds_the_visit(alone: Alone) -> None:
    alone.run(0.5)
    alone.tell(hold=[1.0])
    alone.run(0.05)
    assert (alone.state.phase, alone.state.finished) == ("held", True)
    assert "The operator ended the job in phase 'descend'" in alone.state.reason


def test_a_touch_at_a_time_that_no_pose_is_known_for_is_not_used(alone: Alone) -> None:
    alone.run(0.5)
    alone.tell(touch=AbstractValue.Make(TabletTouch(1, 99.0, np.zeros(2), True)))
    alone.run(alone.plan.longest_descent_s + 0.5)
    assert alone.state.touches == ()
    assert (alone.state.phase, "check the clocks" in alone.state.reason) == ("held", True)


OUT_OF_REACH = "tablet: {xyz_m: [2.5, 0.0, 0.0]}"
UNDER_THE_TABLE = "calibration: {table_z_m: 0.2}"


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (OUT_OF_REACH, "cannot reach the tablet"),
        (UNDER_THE_TABLE, "The move from home to the look would touch the table"),
    ],
)
def test_a_visit_that_cannot_be_made_is_refused_before_anything_moves(overrides: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        build_cell(load_scenario("tablet", overrides))


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ("tool: none", "needs tool: pen"),
        ("wrist_camera: !NoDevice {}", "needs a wrist_camera"),
        ("digitizer: !NoDevice {}", "needs a digitizer"),
        ("tablet: null", "A pen touches a tablet"),
        ("tablet: {columns: 1}", "at least 2"),
        ("tablet: {columns: 40}", "more than 100 landmarks"),
        ("tablet: {across_mm: -1.0}", "tablet.across_mm must be a positive number"),
        ("tablet: {ring_mm: 50.0}", "rings overlap"),
        ("tablet: {tilt_deg: 80.0}", "from 0 to 45"),
        ("tablet: {pen: {radius_mm: 0.0}}", "must be positive"),
        ("tablet: {pen: {tip_m: [0.0, 0.0]}}", "must hold 3 numbers"),
        ("tablet: {pen: {tip_m: [0.0, 0.0, 0.0]}}", "0.03 m in front of the flange"),
        ("scanner: !RenderedScanner {}\njob: {calibrate: true}", "neither calibrates a scanner"),
        ("colour: red", "colour"),
    ],
)
def test_a_scenario_that_makes_no_sense_says_what_to_change(overrides: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("tablet", overrides)


def test_each_procedure_is_told_to_use_its_own_command() -> None:
    assert kind_of(load_scenario("tablet")) == "tablet"
    assert kind_of(load_scenario("s_groove")) == ""
    with pytest.raises(InputError, match="run it with weldcal demo"):
        run_scenario(load_scenario("tablet"), RunOptions(scenario="tablet", out=Path("never")))
    with pytest.raises(InputError, match="weldcal tablet demo"):
        known_camera("tablet")
    with pytest.raises(InputError, match="has no tablet"):
        run_tablet_demo(
            load_scenario("straight_groove"), RunOptions(scenario="straight_groove", out=Path("never")), lambda *_: None
        )
