"""The simulated profiler: its rays meet the true geometry to a micron, it loses what a real one loses, and its time is
right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from tests.systems.cells import Q_HOME, the_arm
from weldcal.calibration.profiler.edge.features import extract_edge
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics, jacobian
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture
from weldcal.systems.drivers.simulated.rendered_profiler import RayFan, RenderedProfiler, drawn_pose, measured_profile
from weldcal.systems.jobs.job import job_of
from weldcal.systems.jobs.profiler.config import ProfilerJob
from weldcal.systems.jobs.profiler.job import RobotError, draw_fixture
from weldcal.systems.messages import JobCommand
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station

CLEAN = RenderedProfiler(noise_mm=0.0, jitter_mm=0.0, quantum_mm=0.0, share_missing=0.0, share_spikes=0.0, samples=4000)
X_BP = RigidTransform(RotationMatrix.MakeZRotation(0.3), [0.5, -0.3, 0.02])


@pytest.fixture(scope="module")
def fixture() -> ProfilerFixture:
    rng = np.random.default_rng(4)
    return draw_fixture(drawn_pose(CLEAN), 4e-3, 0.03, ProfilerJob(), rng, 0.0, make_workpiece("s"), X_BP)


def above(p: np.ndarray, height: float) -> np.ndarray:
    """A point so much higher."""
    return np.asarray(p + np.array([0.0, 0.0, height]))


def over(point: np.ndarray, turn: list[float], distance: float = 0.085) -> RigidTransform:
    """X_BS of a profiler that looks down at a point, turned by Euler angles z y x in degrees."""
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    R = down @ Rotation.from_euler("ZYX", turn, degrees=True).as_matrix()
    return RigidTransform(RotationMatrix(R), point - distance * R[:, 2])


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [25.0, 15.0, -20.0]])
def test_rays_meet_the_sphere_to_a_tenth_of_a_micron(fixture: ProfilerFixture, turn: list[float]) -> None:
    truth = fixture.truth
    X = over(above(truth.center, truth.radius_m), turn)
    p, _, _ = RayFan(CLEAN, fixture).cast(X)
    near = p[p[:, 1] < 0.095]
    at = X.multiply(np.column_stack([near[:, 0], 0.0 * near[:, 0], near[:, 1]]).T).T
    assert len(near) > 500
    assert np.abs(np.linalg.norm(at - truth.center, axis=1) - truth.radius_m).max() < 1e-7


def test_the_edge_is_where_the_estimators_model_says(fixture: ProfilerFixture) -> None:
    """To the pitch of the samples, 13 um here, of which the feature knows the middle."""
    truth = fixture.truth
    direction = truth.edge_direction
    yaw = float(np.degrees(np.arctan2(direction[1], direction[0])))
    off = []
    for turn in ([-yaw, 0.0, 0.0], [20.0 - yaw, 12.0, 15.0], [-25.0 - yaw, -10.0, -18.0]):
        X = over(truth.edge_point, turn)
        p = measured_profile(CLEAN, *RayFan(CLEAN, fixture).cast(X), np.random.default_rng(0))
        found, _ = extract_edge(np.minimum(p, [np.inf, 0.11]), "bar", "left")
        state = EdgeState(np.eye(3), np.zeros(3), truth.edge_point, direction)
        pose = FlangePoses(X.rotation().matrix()[None], X.translation()[None])
        off.append(found - predicted(state, pose)[0][0])
    assert np.abs(off).max() < 0.6 * CLEAN.pitch_m(0.09) + 1e-6


def test_the_groove_of_the_workpiece_is_seen_as_deep_as_it_is(fixture: ProfilerFixture) -> None:
    part = make_workpiece("s")
    k = len(part.seam_P) // 2
    root, tangent = X_BP.multiply(part.seam_P[k]), X_BP.rotation().multiply(part.tangents_P[k])
    x = np.cross(tangent, [0.0, 0.0, 1.0])
    R = np.column_stack([x, np.cross([0.0, 0.0, -1.0], x), [0.0, 0.0, -1.0]])
    p, _, _ = RayFan(CLEAN, fixture).cast(RigidTransform(RotationMatrix(R), above(root, 0.09)))
    deepest = p[np.nanargmax(p[:, 1])]
    assert deepest == pytest.approx([0.0, 0.09], abs=5e-5)  # half the slope's rise over a pitch
    assert np.nanmedian(p[:, 1]) == pytest.approx(0.09 - part.depth_m, abs=1e-6)


def test_steep_and_dark_surfaces_lose_returns_and_the_rest_is_rounded() -> None:
    config = RenderedProfiler(share_missing=0.0, share_spikes=0.0, samples=4000)
    clean = np.column_stack([np.linspace(-0.02, 0.02, 4000), np.full(4000, 0.08)])
    flat, bright = np.ones(4000), np.zeros(4000)

    def lost(cosine: np.ndarray, dark: np.ndarray) -> float:
        p = measured_profile(config, clean, cosine, dark, np.random.default_rng(1))
        return float(np.isnan(p[:, 0]).mean())

    assert lost(flat, bright) == 0.0
    assert lost(flat, 0.6 + bright) == pytest.approx(0.6, abs=4 * np.sqrt(0.24 / 4000))
    assert lost(np.cos(np.radians(78.0)) * flat, bright) == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / 4000))
    assert lost(np.cos(np.radians(87.0)) * flat, bright) == 1.0
    p = measured_profile(config, clean, flat, bright, np.random.default_rng(2))
    steps = 1e3 * p[:, 1] / config.quantum_mm
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    again = measured_profile(config, clean, flat, bright, np.random.default_rng(2))
    np.testing.assert_array_equal(p, again)


def test_what_is_out_of_range_returns_nothing(fixture: ProfilerFixture) -> None:
    top = above(fixture.truth.center, fixture.truth.radius_m)
    fan = RayFan(CLEAN, fixture)
    near = fan.cast(over(top, [0.0, 0.0, 0.0], 0.050))[0]
    assert np.isnan(near[len(near) // 2, 1])
    far = RayFan(replace(CLEAN, farthest_mm=110.0), fixture).cast(over(top, [0.0, 0.0, 0.0], 0.120))[0]
    assert np.isnan(far).any(axis=1).all()


def test_a_profile_taken_in_motion_meets_the_pose_of_its_own_time() -> None:
    scenario = load_scenario("profiler_sphere")
    scenario.profiler = replace(CLEAN, samples=480)
    station = make_station(scenario, 3, set_up_world=job_of(scenario).set_up_world)
    truth = station.truth.profiler
    assert truth is not None
    X_BS = over(above(truth.center, truth.radius_m), [100.0, 0.0, 0.0])
    q = nearest_solution(station.arm, X_BS @ truth.X_FS.inverse(), np.deg2rad(scenario.home_deg))
    assert q is not None
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    plant = station.world.plant
    # 40 mm/s downwards, begun a little above: a wrong step of 4 ms would be off by 160 um
    qd = np.linalg.solve(jacobian(station.arm, q), [0.0, 0.0, 0.0, 0.0, 0.0, -0.04])
    plant.SetPositions(plant.GetMyMutableContextFromRoot(root), station.world.arm, q - 0.3 * qd)
    servo = station.diagram.GetSubsystemByName("arm_servo")
    begun = servo.GetMyMutableContextFromRoot(root)
    begun.SetDiscreteState(0, np.append(q - 0.3 * qd, np.zeros(6)))  # the reference
    begun.SetDiscreteState(1, q - 0.3 * qd)  # what is measured
    command, trigger = (station.diagram.GetInputPort(n) for n in ("arm.velocity_command", "profiler.trigger"))
    command.FixValue(root, qd)
    trigger.FixValue(root, [0.0])
    simulator.AdvanceTo(0.284)
    out, known = station.diagram.GetOutputPort, {}
    for k in range(12):
        if k == 4:
            trigger.FixValue(root, [1.0])
        simulator.AdvanceTo(root.get_time() + 0.004)
        sampled = round(float(out("arm.sample_time").Eval(root)[0]), 6)
        known[sampled] = np.array(out("arm.position_measured").Eval(root))
    scan = out("profiler.profile").Eval(root)
    assert scan.sequence == 1
    X = forward_kinematics(station.arm, known[round(scan.capture_time, 6)]) @ truth.X_FS
    p = scan.points[scan.points[:, 1] < 0.1]
    at = X.multiply(np.column_stack([p[:, 0], 0.0 * p[:, 0], p[:, 1]]).T).T
    assert np.abs(np.median(np.linalg.norm(at - truth.center, axis=1)) - truth.radius_m) < 5e-6


def test_the_robots_error_is_one_of_the_flanges_place_and_another_one_at_each_goal() -> None:
    system = RobotError(the_arm(), 1e-4, 5)
    context = system.CreateDefaultContext()
    shifts = []
    for goal in range(60):
        system.GetInputPort("position_measured").FixValue(context, Q_HOME)
        system.GetInputPort("job").FixValue(context, AbstractValue.Make(JobCommand(goal_id=goal)))
        q = system.GetOutputPort("position").Eval(context)
        error = forward_kinematics(the_arm(), Q_HOME).inverse() @ forward_kinematics(the_arm(), q)
        assert error.rotation().ToAngleAxis().angle() < 1e-7
        shifts.append(error.translation())
    # 180 normal numbers: their rms is sigma within sqrt(1/360)
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(1e-4, rel=4 * np.sqrt(1 / 360))
