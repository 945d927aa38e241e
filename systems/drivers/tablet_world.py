"""The simulated world of the tablet cell: an arm with camera and sprung pen, and a tablet that lies not quite where it is thought."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    Cylinder,
    GeometryId,
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuatorIndex,
    PdControllerGains,
    PrismaticJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import arm_urdf
from weldcal.systems.drivers.picture_scene import add_picture_scene
from weldcal.systems.drivers.rendered_scanner import random_pose_error
from weldcal.systems.drivers.simulated_world import (
    DARK,
    JOINT_DAMPING,
    JOINT_STIFFNESS,
    STEEL,
    TABLE,
    SimulatedWorld,
    compensate_gravity,
)
from weldcal.systems.messages import Message
from weldcal.systems.tablet_scenario import TabletOnTable, TabletScenario, landmarks_m
from weldcal.systems.textured_board import textured_board

WRIST_RENDERER = "wrist"
_TEXELS_PER_MM = 8
_PEN_MASS_KG = 0.02
_PEN_DAMPING = 3.0  # N s / m
_HOLE = 0.62  # of a ring's radius, as the page draws it


@dataclass(frozen=True, eq=False)
class TabletTruth(Message):
    """What only the simulation knows: camera and pen tip (at rest) on the flange, tablet in the base."""

    X_FC: RigidTransform
    p_FP: NDArray[np.float64]
    X_BT: RigidTransform


def draw_truth(scenario: TabletScenario, rng: np.random.Generator) -> TabletTruth:
    """How the real rig differs from the drawing, from the seed; the tablet lies flat but for its error in place and turn."""
    camera, c = scenario.rig.camera.pose(), scenario.rig.camera_error
    off = random_pose_error(rng, 1e-3 * c.translation_mm, np.deg2rad(c.rotation_deg))
    X_FC = RigidTransform(camera.rotation() @ off.rotation(), camera.translation() + off.translation())
    direction = rng.normal(size=3)
    p_FP = np.array(scenario.rig.pen_tip_m) + 1e-3 * scenario.rig.pen_error_mm * direction / np.linalg.norm(direction)
    t = scenario.tablet.error
    moved = random_pose_error(rng, 1e-3 * t.translation_mm, np.deg2rad(t.rotation_deg))
    return TabletTruth(X_FC, p_FP, scenario.tablet.pose.pose() @ moved)


def page_picture(tablet: TabletOnTable) -> NDArray[np.uint8]:
    """The screen as the page draws it (h, w), its first landmark `margin_mm` from the upper left."""
    size = 1e3 * landmarks_m(tablet).max(axis=0) + 2.0 * tablet.margin_mm
    w, h = (round(v * _TEXELS_PER_MM) for v in size)
    screen = np.full((h, w), 235, dtype=np.uint8)
    fine = 4  # fractional bits of OpenCV's centres and radii
    for k, p in enumerate(1e3 * landmarks_m(tablet) + tablet.margin_mm):
        x, y = (round((v * _TEXELS_PER_MM - 0.5) * 2**fine) for v in p)
        radius = 0.5 * tablet.ring_mm * _TEXELS_PER_MM * 2**fine
        cv2.circle(screen, (x, y), round(radius), 15, -1, cv2.LINE_AA, fine)
        if k > 0:
            cv2.circle(screen, (x, y), round(_HOLE * radius), 235, -1, cv2.LINE_AA, fine)
    return screen


@dataclass(frozen=True, eq=False)
class TabletWorld:
    """The plant's handles, and the two geometries that touch."""

    world: SimulatedWorld
    glass: GeometryId
    nib: GeometryId


def build_tablet_world(
    builder: DiagramBuilder, arm: ArmModel, scenario: TabletScenario, truth: TabletTruth, time_step_s: float = 0.004
) -> TabletWorld:
    """Build arm, rig, table and tablet. Frame: the world is the base B. The pen gives way along z_F against its spring."""
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(time_step=time_step_s, contact_model="point", discrete_contact_approximation="lagged"),
        builder,
    )
    (instance,) = Parser(builder=builder, plant=plant).AddModelsFromString(arm_urdf(arm), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    flange = plant.GetBodyByName("flange", instance)
    rig = plant.AddModelInstance("rig")
    inertia = SpatialInertia(0.4, np.zeros(3), UnitInertia.SolidBox(0.14, 0.07, 0.03))
    plate = plant.AddRigidBody("rig_plate", rig, inertia)
    plant.WeldFrames(flange.body_frame(), plate.body_frame())

    def show(body: object, X: RigidTransform, shape: object, name: str, rgba: tuple[float, ...]) -> None:
        plant.RegisterVisualGeometry(body, X, shape, name, np.array(rgba))

    show(plate, RigidTransform([0.03, 0.0, 0.006]), Box(0.14, 0.07, 0.012), "plate", DARK)
    show(plate, truth.X_FC @ RigidTransform([0.0, 0.0, -0.016]), Box(0.09, 0.024, 0.02), "camera", STEEL)
    X_FP = RigidTransform(truth.p_FP)
    offset = plant.AddFrame(FixedOffsetFrame("pen_rest", plate.body_frame(), X_FP, rig))
    pen = plant.AddRigidBody("pen", rig, SpatialInertia(_PEN_MASS_KG, np.zeros(3), UnitInertia.SolidSphere(0.02)))
    joint = plant.AddJoint(PrismaticJoint("pen", offset, pen.body_frame(), [0.0, 0.0, 1.0], -0.012, 0.0005, 0.0))
    spring = plant.AddJointActuator("pen", joint)
    spring.set_controller_gains(PdControllerGains(p=scenario.rig.pen_stiffness_N_per_m, d=_PEN_DAMPING))
    radius, length = 1e-3 * scenario.rig.pen_radius_mm, float(truth.p_FP[2]) - 0.012
    show(pen, RigidTransform([0.0, 0.0, -0.5 * length - 0.004]), Cylinder(0.0045, length - 0.008), "pen_body", DARK)
    show(pen, RigidTransform([0.0, 0.0, -0.002]), Cylinder(radius, 0.004), "nib", STEEL)
    touching = ProximityProperties()
    AddContactMaterial(dissipation=1.0, friction=CoulombFriction(0.1, 0.1), properties=touching)
    nib = plant.RegisterCollisionGeometry(pen, RigidTransform(), Sphere(radius), "nib_contact", touching)

    ground = plant.world_body()
    tablet = scenario.tablet
    size = landmarks_m(tablet).max(axis=0) + 2e-3 * tablet.margin_mm
    middle = truth.X_BT @ RigidTransform(np.r_[0.5 * landmarks_m(tablet).max(axis=0), 0.0])
    show(ground, RigidTransform([0.45, 0.0, -0.02]), Box(1.5, 1.2, 0.04), "table", TABLE)
    show(
        ground, middle @ RigidTransform([0.0, 0.0, 0.0045]), Box(size[0] + 0.02, size[1] + 0.02, 0.008), "tablet", DARK
    )
    facing = RotationMatrix.MakeXRotation(np.pi)  # the board looks along its z, the tablet's z goes into it
    board = GeometryInstance(
        middle @ RigidTransform(facing),
        textured_board("page", float(size[0]), float(size[1]), page_picture(tablet)),
        "page",
    )
    board.set_perception_properties(PerceptionProperties())
    board.set_illustration_properties(IllustrationProperties())
    plant.RegisterVisualGeometry(ground, board)
    slab = Box(size[0] + 0.02, size[1] + 0.02, 0.008)
    glass = plant.RegisterCollisionGeometry(ground, middle @ RigidTransform([0.0, 0.0, 0.004]), slab, "glass", touching)
    for k in range(6):  # by index: the indices of one model instance are not known before Finalize
        servo = plant.get_joint_actuator(JointActuatorIndex(k))
        servo.set_controller_gains(PdControllerGains(p=JOINT_STIFFNESS[k], d=JOINT_DAMPING[k]))
    plant.Finalize()
    plant.SetDefaultPositions(instance, np.deg2rad(scenario.home_deg))
    compensate_gravity(builder, plant, [instance, rig])
    rest = builder.AddSystem(ConstantVectorSource(np.zeros(2)))
    rest.set_name("pen_at_rest")
    builder.Connect(rest.get_output_port(), plant.get_desired_state_input_port(rig))
    view = add_picture_scene(builder, plant, scene_graph, WRIST_RENDERER, mount="flange")
    return TabletWorld(SimulatedWorld(plant, scene_graph, instance, rig, (joint,), view, None), glass, nib)
