"""The tablet cell from the first look to the last touch: the pen meets the glass, and camera and pen are found."""

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
from weldcal.systems.drivers.wrist_devices import TabletTouch, WristPicture
from weldcal.systems.messages import UrStatus
from weldcal.systems.tablet_cell import make_tablet_cell, plan_tablet
from weldcal.systems.tablet_procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.tablet_scenario import load_tablet_scenario
from weldcal.tools.tablet_demo import run_tablet_demo

# six landmarks and quick descents: half of the shipped scenario's time
SHORT = "{tablet: {rows: 2, across_mm: 60.0, down_mm: 60.0}, turn_deg: 36.0, clearance_mm: 12.0, descent_mm_s: 25.0}"


@dataclass(frozen=True)
class Demo:
    """What one run left."""

    summary: dict[str, Any]
    folder: Path


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    folder = tmp_path_factory.mktemp("tablet")
    (folder / "short.yaml").write_text(SHORT)
    summary = run_tablet_demo(folder / "short.yaml", folder / "out", 3, lambda *_: None)
    return Demo(summary, folder / "out")


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
    assert {"touches.csv", "poses.csv", "camera.yaml", "picture.png", "tablet.yaml", "ur_pose.script"} <= names


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
            if self.state.phase == "look":
                self.tell(picture=AbstractValue.Make(WristPicture(self.state.trigger)))
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + 0.01)


@pytest.fixture
def alone() -> Alone:
    arm, scenario = load_arm("ur10e"), load_tablet_scenario()
    plan = plan_tablet(scenario, arm)
    procedure = TabletProcedure(arm, plan)
    made = Alone(Simulator(procedure), procedure, plan)
    made.tell(
        position_measured=plan.q_home,
        settled_goal=[0.0],
        robot_status=AbstractValue.Make(UrStatus()),
        picture=AbstractValue.Make(WristPicture()),
        touch=AbstractValue.Make(TabletTouch()),
    )
    return made


def test_a_tablet_that_feels_nothing_holds_the_procedure_and_the_arm_goes_home(alone: Alone) -> None:
    alone.run(0.5)
    assert alone.state.phase == "descend"
    alone.run(alone.plan.longest_descent_s)
    assert alone.state.phase == "held"
    assert "met no tablet at landmark 1" in alone.state.reason
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


def test_a_tablet_out_of_reach_is_refused_before_anything_moves(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot reach the tablet"):
        make_tablet_cell(
            load_tablet_scenario(None, "tablet: {pose: {xyz_m: [2.5, 0.0, 0.0], rpy_deg: [180.0, 0.0, 0.0]}}")
        )
    with pytest.raises(InputError, match="no tablet scenario"):
        load_tablet_scenario(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_tablet_scenario(None, "colour: red")
