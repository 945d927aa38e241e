"""A base that hangs, or stands elsewhere: gravity, table, clearance and the plan of the part follow it."""

from __future__ import annotations

import dataclasses as dc
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.planning.clearance import arm_bodies, lowest_point
from weldcal.models.arms.kinematics import link_frames, load_arm, mounted
from weldcal.models.errors import InputError
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station, table_in_base
from weldcal.welding.locate.planning import PlanningMethod, RootPlan, plan_root_anyhow

CEILING = "base: {xyz_m: [0.1, 0.0, 1.2], rpy_deg: [180.0, 0.0, 0.0]}\n"


def test_gravity_and_table_follow_the_base() -> None:
    scenario = load_scenario("calibrate_only", CEILING + "arm: ur5e")
    with closing(make_station(scenario, 0)) as station:
        assert station.world is not None
        gravity = station.world.plant.gravity_field().gravity_vector()
        assert gravity == pytest.approx([0.0, 0.0, 9.81])  # towards +z of a base that hangs
        assert station.arm.name == "ur5e"
    assert scenario.table_height_m() == pytest.approx(-1.2)
    X_BTable = table_in_base(scenario)
    assert X_BTable.translation() == pytest.approx([0.35, 0.0, 1.2])
    assert X_BTable.rotation().matrix()[:, 2] == pytest.approx([0.0, 0.0, -1.0])


def test_the_lowest_point_is_measured_against_gravity() -> None:
    arm = load_arm()
    hanging = mounted(arm, RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 0.0]))
    assert hanging.up.tolist() == [0.0, 0.0, -1.0]
    bodies, q = arm_bodies(arm), np.array([0.2, -1.2, 1.4, -1.8, -1.6, 0.1])
    frames = link_frames(arm, q)
    points = [frames[b.frame] @ e for b in bodies if b.link > 1 for e in (b.p_start, b.p_end)]
    highest = max(float(p[2]) for p in points)
    assert lowest_point(bodies, frames, hanging.up) == pytest.approx(-highest, abs=0.11)  # less a capsule's radius
    assert lowest_point(bodies, frames, hanging.up) < lowest_point(bodies, frames) - 0.3


def test_a_part_is_looked_for_in_a_frame_whose_z_is_up() -> None:
    rng = np.random.default_rng(0)
    seen: dict[str, Any] = {}
    up = RollPitchYaw(0.4, -2.5, 0.3).ToRotationMatrix().matrix()[2]
    X_BP = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.4, 0.1, 0.9])
    points = rng.normal(size=(50, 3))

    def plan(points_U: Any, part: Any, X_UP: RigidTransform, method: PlanningMethod, eye_U: Any) -> RootPlan:
        seen.update(points=points_U, X_UP=X_UP, start=method.start_m, eye=eye_U)
        return RootPlan(
            root=points_U[:5],
            up=np.tile([0.0, 0.0, 1.0], (5, 1)),
            half_angle_rad=0.4,
            X_BP=X_UP,
            sigma_m=1e-4,
            rms_m=1e-4,
            confidence=1.0,
            summary="",
        )

    method = PlanningMethod(start_m=[0.1, 0.2, 0.3])
    part, eye = make_workpiece("straight"), np.array([0.5, 0.5, 0.5])
    found = plan_root_anyhow(points, part, X_BP, method, eye, up, plan)
    assert seen["points"][:, 2] == pytest.approx(points @ up)  # heights against gravity
    assert seen["eye"][2] == pytest.approx(eye @ up)
    assert seen["start"][2] == pytest.approx(np.array(method.start_m) @ up)
    assert found.root == pytest.approx(points[:5])
    assert found.up == pytest.approx(np.tile(up, (5, 1)))
    assert found.X_BP is not None
    assert found.X_BP.IsNearlyEqualTo(X_BP, 1e-12)


def test_other_jobs_refuse_a_base_that_is_not_the_worlds_origin() -> None:
    with pytest.raises(InputError, match="A tablet job runs with the robot's base upright at the world's origin only"):
        load_scenario("tablet", CEILING)
    assert dc.asdict(load_scenario("tablet").base) == {"xyz_m": [0.0] * 3, "rpy_deg": [0.0] * 3}
