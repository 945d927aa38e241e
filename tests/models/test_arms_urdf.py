"""The arm in Drake is the arm of the numbers: same flange, masses, limits, and a body that its capsules enclose."""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_load_file
from pydrake.geometry import Role, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import DiagramBuilder

from weldcal.models.arms import kinematics as module
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, jacobian, known_arms, link_frames, load_arm
from weldcal.models.arms.urdf import (
    FLANGE_DISC_M,
    WRIST_3_LENGTH_M,
    WRIST_3_RADIUS_M,
    arm_urdf,
    link_capsules,
    wrist_3_size,
)
from weldcal.models.robots import get_robot

Array = NDArray[np.float64]


def calibrated_arm(seed: int = 7) -> ArmModel:
    """The nominal arm with each link moved by about a millimetre and turned by about a milliradian."""
    arm = load_arm()
    rng = np.random.default_rng(seed)
    stack = np.array(
        [
            X @ RigidTransform(RollPitchYaw(rng.normal(0, 1e-3, 3)), rng.normal(0, 1e-3, 3)).GetAsMatrix4()
            for X in arm.stack
        ]
    )
    return replace(arm, stack=stack)


def make_plant(arm: ArmModel) -> tuple[MultibodyPlant, SceneGraph]:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.002)
    Parser(plant).AddModelsFromString(arm_urdf(arm), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant, scene_graph


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    return make_plant(load_arm())[0]


@pytest.mark.parametrize("arm", [load_arm(), calibrated_arm()], ids=["nominal", "calibrated"])
def test_the_plant_moves_as_the_numbers_do(arm: ArmModel) -> None:
    plant, _ = make_plant(arm)
    context = plant.CreateDefaultContext()
    frame, world = plant.GetFrameByName("flange"), plant.world_frame()
    p_FP = np.array([0.03, 0.01, 0.2])
    for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 6)):
        plant.SetPositions(context, q)
        assert frame.CalcPoseInWorld(context).IsNearlyEqualTo(forward_kinematics(arm, q), 1e-9)
        J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, frame, p_FP, world, world)
        np.testing.assert_allclose(J, jacobian(arm, q, p_FP), rtol=0, atol=1e-9)
        for name, X in zip(arm.link_names, link_frames(arm, q), strict=True):
            assert plant.GetFrameByName(name).CalcPoseInWorld(context).IsNearlyEqualTo(X, 1e-9)


def test_the_text_parses_without_a_word_of_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger="drake"):
        make_plant(load_arm())
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING] == []


def test_six_joints_are_driven_within_their_limits(plant: MultibodyPlant) -> None:
    arm = load_arm()
    assert plant.num_positions() == plant.num_actuated_dofs() == 6
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert [a.joint().name() for a in actuators] == list(arm.joint_names)
    np.testing.assert_array_equal([a.effort_limit() for a in actuators], arm.effort_limit)
    np.testing.assert_array_equal(plant.GetPositionUpperLimits(), arm.position_upper)
    np.testing.assert_array_equal(plant.GetPositionLowerLimits(), arm.position_lower)
    np.testing.assert_array_equal(plant.GetVelocityUpperLimits(), arm.velocity_limit)
    np.testing.assert_array_equal(plant.GetAccelerationUpperLimits(), arm.acceleration_limit)
    np.testing.assert_array_equal(plant.GetAccelerationLowerLimits(), -arm.acceleration_limit)


def test_the_plant_weighs_what_the_file_says(plant: MultibodyPlant) -> None:
    file = Path(module.__file__).parent / "ur10e/physical_parameters.yaml"
    numbers = yaml_load_file(str(file))["inertia_parameters"]
    context = plant.CreateDefaultContext()
    arm = load_arm()
    for i, link in enumerate(module.LINKS):
        body = plant.GetBodyByName(f"{link}_link")
        assert body.default_mass() == numbers[f"{link}_mass"] == arm.masses[i]
        M = body.CalcSpatialInertiaInBodyFrame(context)
        np.testing.assert_allclose(
            M.get_com(), [numbers["center_of_mass"][f"{link}_cog"][k] for k in "xyz"], atol=1e-15
        )
        tensor = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        np.testing.assert_allclose(tensor, arm.inertias[i], rtol=0, atol=1e-12)
    assert plant.GetBodyByName("flange").default_mass() == 0.0


def test_a_held_arm_loads_its_shoulder_as_its_masses_say(plant: MultibodyPlant) -> None:
    # Stretched level, the shoulder lift carries sum m g x, x being each centre's distance from the lift axis.
    arm = load_arm()
    context = plant.CreateDefaultContext()
    q = np.zeros(6)
    plant.SetPositions(context, q)
    frames = link_frames(arm, q)[1:]
    centers = np.array([X @ c for X, c in zip(frames, arm.centers_of_mass, strict=True)])
    moment = 9.81 * np.sum(arm.masses[1:] * -centers[1:, 0])
    lift = abs(plant.CalcGravityGeneralizedForces(context)[1])
    assert lift == pytest.approx(moment, rel=1e-9)
    assert 0.3 * arm.effort_limit[1] < lift < 0.6 * arm.effort_limit[1]


def surface(geometry: ET.Element, rng: np.random.Generator) -> Array:
    """Points on the rims and sides of a URDF cylinder, or on an ellipsoid, in the geometry frame."""
    angle = rng.uniform(0, 2 * np.pi, 100)
    cylinder = geometry.find("cylinder")
    if cylinder is not None:
        radius, length = float(cylinder.attrib["radius"]), float(cylinder.attrib["length"])
        z = np.where(np.arange(100) % 3 == 0, rng.uniform(-0.5, 0.5, 100), np.sign(rng.uniform(-1, 1, 100)) / 2)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), length * z])
    ellipsoid = geometry.find("{http://drake.mit.edu}ellipsoid")
    assert ellipsoid is not None
    n = rng.normal(size=(100, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True) * [float(ellipsoid.attrib[k]) for k in "abc"]


def drawn_points(arm: ArmModel) -> dict[int, Array]:
    """Sampled surface of each link's body in the link frame, from the URDF text itself."""
    rng = np.random.default_rng(0)
    points: dict[int, list[Array]] = {}
    for link in ET.fromstring(arm_urdf(arm)).iter("link"):
        for visual in link.iter("visual"):
            origin, geometry = visual.find("origin"), visual.find("geometry")
            assert origin is not None
            assert geometry is not None
            xyz, rpy = ([float(v) for v in origin.attrib[key].split()] for key in ("xyz", "rpy"))
            X = RigidTransform(RollPitchYaw(rpy), xyz)
            points.setdefault(arm.link_names.index(link.attrib["name"]), []).append((X @ surface(geometry, rng).T).T)
    return {index: np.vstack(parts) for index, parts in points.items()}


def beyond_capsules(arm: ArmModel, index: int, points: Array) -> Array:
    """Distance of points (n, 3) outside the capsules of one link (m), negative inside."""
    outside = []
    for capsule in link_capsules(arm):
        if capsule.link_index == index:
            axis = capsule.p_end - capsule.p_start
            t = np.clip((points - capsule.p_start) @ axis / max(axis @ axis, 1e-12), 0, 1)
            outside.append(np.linalg.norm(points - capsule.p_start - t[:, None] * axis, axis=1) - capsule.radius)
    return np.min(outside, axis=0)


@pytest.mark.parametrize("name", known_arms())
def test_capsules_enclose_the_body_without_much_air(name: str) -> None:
    arm = load_arm(name)
    for index, points in drawn_points(arm).items():
        outside = beyond_capsules(arm, index, points)
        assert outside.max() < 1e-3, arm.link_names[index]
        assert np.median(outside) > -0.025 / 0.076 * arm.housings.shoulder, arm.link_names[index]
    assert {c.link_index for c in link_capsules(arm)} == set(range(7))


def test_the_body_stops_where_the_flange_disc_begins() -> None:
    points = drawn_points(load_arm())[6]
    assert points[:, 2].max() == pytest.approx(-FLANGE_DISC_M, abs=1e-9)
    assert points[:, 2].min() == pytest.approx(-FLANGE_DISC_M - WRIST_3_LENGTH_M, abs=1e-9)
    assert np.hypot(points[:, 0], points[:, 1]).max() == pytest.approx(WRIST_3_RADIUS_M, abs=1e-9)


@pytest.mark.parametrize("name", known_arms())
def test_the_last_link_carries_its_flange(name: str) -> None:
    radius, length = wrist_3_size(load_arm(name))
    assert radius >= 0.5 * get_robot(name).standard.outer_m
    assert length > 0.012  # thickness of the drawn flange, which lies in it


@pytest.mark.parametrize("name", known_arms())
def test_neighbouring_links_touch_but_do_not_swallow_each_other(name: str) -> None:
    # Along each joint axis the housings of two neighbours meet at one seam: no gap wider than the seal, no overlap.
    arm = load_arm(name)
    frames = link_frames(arm, np.zeros(6))
    points = drawn_points(arm)
    reach = arm.housings.shoulder + 0.004  # of the largest housing
    for child in range(1, 7):
        X_BC = frames[child]
        mine = points[child]
        theirs = (X_BC.inverse() @ frames[child - 1] @ points[child - 1].T).T
        near = {name: p[np.hypot(p[:, 0], p[:, 1]) < reach] for name, p in {"mine": mine, "theirs": theirs}.items()}
        gap = min(
            abs(near["mine"][:, 2].min() - near["theirs"][:, 2].max()),
            abs(near["theirs"][:, 2].min() - near["mine"][:, 2].max()),
        )
        assert gap < 5e-3, arm.link_names[child]


def test_every_shape_is_seen_by_camera_and_viewer() -> None:
    _, scene_graph = make_plant(load_arm())
    inspector = scene_graph.model_inspector()
    seen = inspector.NumGeometriesWithRole(Role.kPerception)
    assert seen == inspector.NumGeometriesWithRole(Role.kIllustration) > 30
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 0
