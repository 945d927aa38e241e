"""The arm keeps away from the cell's surroundings, and they may hide the flange."""

import pickle

import numpy as np
import pytest
from pydrake.math import RigidTransform

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannerConfig, plan_calibration_poses
from weldcal.calibration.planning.clearance import Obstacle, Surroundings, arm_bodies
from weldcal.models.arms.kinematics import link_frames, load_arm
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import get_scanner
from weldcal.systems.scenario.loading import load_scenario

ARM = load_arm("ur10e")
BODIES = arm_bodies(ARM)
Q = np.deg2rad([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def box(p_B: np.ndarray, half_m: float, margin_m: float = 0.0) -> Obstacle:
    mesh = extrude(half_m * SQUARE, -half_m, half_m).transformed(RigidTransform(p_B))
    return Obstacle("post", mesh, margin_m)


def flange(q: np.ndarray) -> np.ndarray:
    return np.array(link_frames(ARM, q)[6].translation())


def test_an_obstacle_in_the_wrist_is_touched_and_one_beside_it_is_not() -> None:
    frames = link_frames(ARM, Q)
    assert Surroundings((box(flange(Q), 0.02),)).touched(BODIES, frames) == "post"
    assert Surroundings((box(flange(Q) + np.array([0.0, 0.5, 0.0]), 0.02),)).touched(BODIES, frames) == ""


def test_a_body_deep_inside_a_closed_obstacle_touches_it() -> None:
    assert Surroundings((box(flange(Q), 3.0),)).touched(BODIES, link_frames(ARM, Q)) == "post"


def test_the_margin_counts() -> None:
    frames = link_frames(ARM, Q)
    radius = max(b.radius for b in BODIES)
    beside = flange(Q) + np.array([0.0, radius + 0.10, 0.0])
    assert Surroundings((box(beside, 0.01),)).touched(BODIES, frames) == ""
    assert Surroundings((box(beside, 0.01, margin_m=0.2),)).touched(BODIES, frames) == "post"


def test_the_gap_to_a_box_is_that_of_its_nearest_face() -> None:
    post = box(np.array([1.0, 0.0, 0.5]), 0.1)
    found = post.distance(np.array([[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [1.2, 0.2, 0.5]]))
    assert found == pytest.approx([0.9, -0.1, np.hypot(0.1, 0.1)], abs=1e-6)


def test_an_open_sheet_is_an_obstacle_too() -> None:
    sheet = TriMesh(np.column_stack([0.5 * SQUARE, np.zeros(4)]), np.array([[0, 1, 2], [0, 2, 3]]))
    placed = Obstacle("sheet", sheet.transformed(RigidTransform(flange(Q))))
    assert placed.distance(flange(Q)[None] + [[0.0, 0.0, 0.1]]) == pytest.approx([0.1], abs=1e-6)
    assert Surroundings((placed,)).touched(BODIES, link_frames(ARM, Q)) == "sheet"


def test_something_between_two_free_configurations_is_found_on_the_way() -> None:
    end = Q + np.deg2rad([90.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    middle = Surroundings((box(flange(0.5 * (Q + end)), 0.02),))
    assert middle.touched(BODIES, link_frames(ARM, Q)) == middle.touched(BODIES, link_frames(ARM, end)) == ""
    assert middle.touched_on_path(ARM, BODIES, Q, end) == "post"
    assert Surroundings().touched_on_path(ARM, BODIES, Q, end) == ""


def test_a_line_of_sight_is_blocked_by_what_stands_in_it() -> None:
    wall = Surroundings((box(np.array([0.5, 0.0, 0.5]), 0.1),))
    eye = np.array([0.0, 0.0, 0.5])
    assert wall.blocks(eye, np.array([[1.0, 0.0, 0.5]])) == "post"
    assert wall.blocks(eye, np.array([[0.3, 0.0, 0.5], [1.0, 0.5, 0.5]])) == ""


def test_surroundings_can_be_sent_to_another_process() -> None:
    here = Surroundings((box(flange(Q), 0.02),))
    here.touched(BODIES, link_frames(ARM, Q))
    assert pickle.loads(pickle.dumps(here)).touched(BODIES, link_frames(ARM, Q)) == "post"


def test_calibration_poses_avoid_an_obstacle_and_there_are_none_behind_a_wall() -> None:
    scenario = load_scenario("s_groove")
    X_BC = scenario.calibration.mounting_guess.pose()
    q_start = np.deg2rad(scenario.home_deg)

    def planned(surroundings: Surroundings) -> list[np.ndarray]:
        config = PlannerConfig(surroundings=surroundings, candidates=12, max_trials=400)
        return [
            p.q
            for p in plan_calibration_poses(
                ARM, RigidTransform(), X_BC, get_scanner("phoxi_m"), 4, q_start=q_start, config=config
            )
        ]

    free = planned(Surroundings())
    assert len(free) == 4
    post = Surroundings((box(flange(free[0]), 0.05),))
    assert all(post.touched(BODIES, link_frames(ARM, q)) == "" for q in planned(post))
    wall = Surroundings((box(np.array(X_BC.translation()) - [0.0, 0.0, 0.2], 0.1),))
    with pytest.raises(UnreachableScanner, match="No pose of the flange can be scanned"):
        planned(wall)
