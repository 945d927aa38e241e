"""The simulated world: arm, tool with its soft tip, table and workpiece in one MultibodyPlant, with what its cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Cylinder,
    GeometryInstance,
    IllustrationProperties,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    ProximityProperties,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuatorIndex,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.base_circles import BaseCircle
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces import Workpiece
from weldcal.systems.drivers.simulated.picture_scene import PictureScene, add_picture_scene
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture, TouchPair, add_fixture
from weldcal.systems.drivers.simulated.second_arm import PlacedArm, add_second_arm
from weldcal.systems.messages import Message
from weldcal.systems.textured_board import textured_board
from weldcal.welding.servo.deformation import TagModel, tag_cells

SCANNER_RENDERER = "scanner"
FINGER_RENDERER = "finger"
STEEL = (0.62, 0.64, 0.67, 1.0)
DARK = (0.16, 0.18, 0.21, 1.0)
COPPER = (0.80, 0.45, 0.20, 1.0)
SOFT = (0.18, 0.42, 0.62, 1.0)
TABLE = (0.36, 0.38, 0.40, 1.0)
CELL_PX = 32  # texels of a tag cell: more than those of the camera's picture of it
# A pixel of a camera gathers light over its area through a lens; a renderer looks at one point of each. What lens and pixel
# blur, in texels, is put into the print, or edges would lie a tenth of a pixel off wherever they run along the pixels.
BLUR_TEXELS = 1.2
TIP_FRICTION = 0.2  # soft tip on steel
# The contact model's ball is a polyhedron inside the ball it is asked for, with this share of its volume (at a resolution of half
# the radius). It is asked for one as much larger, or the tip would sink by what the corners were cut off.
CONTACT_MESH_VOLUME = 0.9114
JOINT_STIFFNESS = (2e5, 2e5, 1e5, 2e4, 2e4, 1e4)  # N m / rad, of the arm's joint servos
JOINT_DAMPING = (4e3, 4e3, 2e3, 3e2, 3e2, 1.5e2)  # N m s / rad


@dataclass(frozen=True)
class SimulatedWorld(Message):
    """Handles into the plant that drivers and `cheat.*` ports need."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    arm: ModelInstanceIndex
    tool: ModelInstanceIndex | None
    tip_joints: tuple[PrismaticJoint, ...]
    scanner_view: PictureScene
    finger_view: PictureScene | None
    second: ModelInstanceIndex | None = None  # the second arm of a co-manipulation
    touch_pair: TouchPair | None = None


class Fittings(Protocol):
    """What else a scenario puts into the world: bodies on the flange and on the table."""

    def add(self, plant: MultibodyPlant, arm: ModelInstanceIndex) -> ModelInstanceIndex:
        """Add them before the plant is finalised; returns the model instance whose springs are to rest at zero."""


def mesh_shape(mesh: TriMesh, name: str) -> Mesh:
    """A Drake Mesh of a TriMesh, kept in memory."""
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(contents=mesh.to_obj(), extension=".obj", filename_hint=name)))


def _show(
    plant: MultibodyPlant, body: RigidBody, X: RigidTransform, shape: Shape, name: str, rgba: tuple[float, ...]
) -> None:
    """Give a body something to see, in Meshcat and in the rendered images alike."""
    plant.RegisterVisualGeometry(body, X, shape, name, np.array(rgba))


def _add_flange(plant: MultibodyPlant, arm: ModelInstanceIndex, flange: str) -> None:
    """The ISO 9409-1 flange: its face in the flange frame's plane, its back inside the wrist."""
    body = plant.GetBodyByName("flange", arm)
    shape = mesh_shape(flange_mesh(get_flange(flange), thickness_m=0.012), "flange.obj")
    _show(plant, body, RigidTransform(), shape, "iso_flange", STEEL)


def _print_tag(plant: MultibodyPlant, body: RigidBody, X: RigidTransform, tag: TagModel) -> None:
    """The tag with a white margin of one cell, in the marker frame (x right, y up, z out of the print)."""
    cells = cv2.copyMakeBorder(255 * tag_cells(tag).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=255)
    sharp = np.maximum(np.kron(cells, np.ones((CELL_PX, CELL_PX), dtype=np.uint8)), 5)
    print_ = np.asarray(cv2.GaussianBlur(sharp, (0, 0), BLUR_TEXELS), dtype=np.uint8)
    size = tag.size_m * cells.shape[0] / (cells.shape[0] - 2)
    geometry = GeometryInstance(X, textured_board("tag", size, size, print_), "tag_print")
    geometry.set_perception_properties(PerceptionProperties())
    geometry.set_illustration_properties(IllustrationProperties())
    plant.RegisterVisualGeometry(body, geometry)


def _add_tool(
    plant: MultibodyPlant, arm: ModelInstanceIndex, tool: WeldingTool, contact_hint_m: float
) -> tuple[ModelInstanceIndex, tuple[PrismaticJoint, ...]]:
    """Plate, ring, camera, torch (welded to the flange) and the soft tip on three sprung prismatic joints."""
    instance = plant.AddModelInstance("tool")
    flange_frame = plant.GetFrameByName("flange", arm)
    inertia = SpatialInertia(
        tool.mass_kg,
        np.array([0.03, 0.0, 0.05]),
        UnitInertia.SolidBox(0.25, 0.08, 0.12).ShiftFromCenterOfMass(np.array([-0.03, 0.0, -0.05])),
    )
    plate = plant.AddRigidBody("tool_plate", instance, inertia)
    plant.WeldFrames(flange_frame, plate.body_frame())
    t, r = tool.plate_thickness_m, tool.ring_offset_m
    ring = flange_mesh(get_flange("tool-ring-63"), thickness_m=tool.ring_height_m)
    _show(plant, plate, RigidTransform([0.0, 0.0, t / 2]), Cylinder(0.0375, t), "mount", DARK)
    _show(plant, plate, RigidTransform([r / 2, 0.0, t / 2]), Box(r, 0.064, t), "bar", DARK)
    _show(plant, plate, RigidTransform([r, 0.0, t / 2]), Cylinder(0.0375, t), "ring_base", DARK)
    _show(plant, plate, tool.X_FR, mesh_shape(ring, "ring.obj"), "flange_like_ring", STEEL)
    camera_z = tool.X_FK.translation()[2]
    _show(
        plant,
        plate,
        RigidTransform([0.0, 0.0, t + (camera_z - 0.006 - t) / 2]),
        Box(0.026, 0.026, camera_z - 0.006 - t),
        "camera",
        DARK,
    )
    for side in (-1.0, 1.0):  # the frame that carries the soft metamaterial, outside the camera's view
        _show(
            plant,
            plate,
            RigidTransform([0.0, side * 0.034, (t + tool.tag_reach_m) / 2]),
            Box(0.012, 0.004, tool.tag_reach_m - t),
            f"post{side:+.0f}",
            DARK,
        )
    p_FW = tool.X_FT @ tool.p_TW
    length = p_FW[2] - 0.012 - t
    _show(
        plant,
        plate,
        RigidTransform([p_FW[0] / 2 - 0.01, 0.0, t / 2 + t]),
        Box(-p_FW[0] + 0.02, 0.03, t),
        "torch_arm",
        DARK,
    )
    _show(plant, plate, RigidTransform([p_FW[0], 0.0, t + length / 2]), Cylinder(0.009, length), "torch_body", COPPER)
    _show(plant, plate, RigidTransform([p_FW[0], 0.0, p_FW[2] - 0.006]), Cylinder(0.0006, 0.012), "torch_wire", STEEL)

    # Three prismatic joints in series carry the tip; the springs are implicit PD, stable at 2 ms with a mass of grams.
    parent = plant.AddFrame(_fixed_offset(plant, "tip_rest", plate, tool.X_FT))
    small = SpatialInertia(tool.tip_mass_kg / 3, np.zeros(3), UnitInertia.SolidSphere(0.01))
    joints: list[PrismaticJoint] = []
    body = plate
    for axis, name in enumerate("xyz"):
        body = plant.AddRigidBody(f"tip_{name}", instance, small)
        direction = np.eye(3)[axis]
        joint = plant.AddJoint(PrismaticJoint(f"tip_{name}", parent, body.body_frame(), direction, -0.012, 0.012, 0.0))
        actuator = plant.AddJointActuator(f"tip_{name}", joint)
        stiffness = tool.axial_stiffness_N_per_m if name == "z" else tool.lateral_stiffness_N_per_m
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=tool.damping_N_s_per_m))
        joints.append(joint)
        parent = body.body_frame()

    radius, reach = tool.tip_radius_m, tool.tip_reach_m - tool.tag_reach_m
    _show(plant, body, RigidTransform(), Sphere(radius), "tip", SOFT)
    _show(plant, body, RigidTransform([0.0, 0.0, reach / 2 - 0.003]), Cylinder(0.0022, reach - 0.006), "finger", SOFT)
    _show(plant, body, RigidTransform([0.0, 0.0, reach - 0.0015]), Cylinder(0.026, 0.002), "membrane", SOFT)
    tag = TagModel(dictionary=tool.tag_dictionary, id=tool.tag_id, size_m=tool.tag_size_m)
    X_TM = RigidTransform([0.0, 0.0, reach])
    _show(
        plant,
        body,
        X_TM @ RigidTransform([0.0, 0.0, -0.0003]),
        Box(0.016, 0.016, 0.0005),
        "tag_white",
        (1.0, 1.0, 1.0, 1.0),
    )
    _print_tag(plant, body, X_TM, tag)
    contact = ProximityProperties()
    AddContactMaterial(dissipation=1.0, friction=CoulombFriction(TIP_FRICTION, TIP_FRICTION), properties=contact)
    AddCompliantHydroelasticProperties(
        resolution_hint=contact_hint_m, hydroelastic_modulus=tool.tip_modulus_Pa, properties=contact
    )
    rounded = Sphere(radius * CONTACT_MESH_VOLUME ** (-1.0 / 3.0))
    plant.RegisterCollisionGeometry(body, RigidTransform(), rounded, "tip_contact", contact)
    return instance, tuple(joints)


def compensate_gravity(builder: DiagramBuilder, plant: MultibodyPlant, models: list[ModelInstanceIndex]) -> None:
    """The controller's feed-forward: joint torques against gravity, so that the servos need not sag to find them.

    Gravity stays on: an arm at rest without any force leaves the contact solver no scale to converge by.
    """
    feed_forward = builder.AddSystem(InverseDynamics(plant, InverseDynamics.InverseDynamicsMode.kGravityCompensation))
    feed_forward.set_name("gravity_compensation")
    builder.Connect(plant.get_state_output_port(), feed_forward.get_input_port_estimated_state())
    split = builder.AddSystem(Demultiplexer([plant.num_actuated_dofs(m) for m in models]))
    builder.Connect(feed_forward.get_output_port_generalized_force(), split.get_input_port())
    for k, model in enumerate(models):
        builder.Connect(split.get_output_port(k), plant.get_actuation_input_port(model))


def _fixed_offset(plant: MultibodyPlant, name: str, body: RigidBody, X: RigidTransform) -> FixedOffsetFrame:
    return FixedOffsetFrame(name, body.body_frame(), X, body.model_instance())


def build_world(
    builder: DiagramBuilder,
    arm: ArmModel,
    tool: WeldingTool | None,
    q_start: np.ndarray,
    *,
    flange: str,
    table_z_m: float,
    workpiece: Workpiece | None,
    X_BP: RigidTransform | None,
    fittings: Sequence[Fittings] = (),
    profiler: ProfilerFixture | None = None,
    time_step_s: float = 0.002,
    second: PlacedArm | None = None,
    foot: BaseCircle | None = None,
) -> SimulatedWorld:
    """Build the plant with everything the station needs; the arm stands at `q_start` and hangs in its implicit joint servos.

    A robot's driver says where they pull it: the simulated controller, or a real arm whose shadow this one then is.
    Frame: the world is the robot base B. `workpiece` is the real part (it may differ from its CAD), placed at X_BP.
    `second` is another arm; `foot` the ring of the base mounting, drawn as round as a scan can tell.
    """
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=time_step_s,
            contact_model="hydroelastic" if profiler is None else "point",
            discrete_contact_approximation="lagged",  # with `sap` the tip's rest position depends on the sliding speed
        ),
        builder,
    )
    (instance,) = Parser(builder=builder, plant=plant).AddModelsFromString(arm_urdf(arm), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    _add_flange(plant, instance, flange)
    tool_instance, tip_joints = (None, ()) if tool is None else _add_tool(plant, instance, tool, tool.tip_radius_m / 2)
    second_arm = None if second is None else add_second_arm(plant, second, JOINT_STIFFNESS, JOINT_DAMPING)
    if second_arm is not None:
        _add_flange(plant, second_arm, flange)
    touch_pair = None if profiler is None else add_fixture(plant, instance, profiler, table_z_m)
    world_body = plant.world_body()
    if foot is not None:
        ring = mesh_shape(flange_mesh(foot.standard, foot.standard.bore_depth_m), "foot.obj")
        _show(plant, plant.GetBodyByName("base", instance), foot.X_BR, ring, "base_circle", STEEL)
    _show(plant, world_body, RigidTransform([0.45, 0.0, table_z_m - 0.02]), Box(1.5, 1.2, 0.04), "table", TABLE)
    if workpiece is not None and X_BP is not None:
        _show(plant, world_body, X_BP, mesh_shape(workpiece.mesh, "workpiece.obj"), "workpiece", STEEL)
        rigid = ProximityProperties()
        AddContactMaterial(friction=CoulombFriction(TIP_FRICTION, TIP_FRICTION), properties=rigid)
        AddRigidHydroelasticProperties(resolution_hint=0.002, properties=rigid)
        if profiler is None:
            plant.RegisterCollisionGeometry(
                world_body, X_BP, mesh_shape(workpiece.groove_mesh, "groove.obj"), "groove", rigid
            )
    fitted = [fitting.add(plant, instance) for fitting in fittings]
    for k in range(6):  # by index: the indices of one model instance are not known before Finalize
        servo = plant.get_joint_actuator(JointActuatorIndex(k))
        servo.set_controller_gains(PdControllerGains(p=JOINT_STIFFNESS[k], d=JOINT_DAMPING[k]))
    plant.Finalize()
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
    if len(actuators) != 6 or not all(a.has_controller() for a in actuators):
        raise RuntimeError("the six joint servos of the arm are not in place")
    plant.SetDefaultPositions(instance, q_start)
    if second_arm is not None and second is not None:
        plant.SetDefaultPositions(second_arm, second.q_start)
    moved = [m for m in (instance, tool_instance, second_arm, *fitted) if m is not None]
    compensate_gravity(builder, plant, moved)
    if tool_instance is not None:
        rest = builder.AddSystem(ConstantVectorSource(np.zeros(6)))
        rest.set_name("tip_at_rest")
        builder.Connect(rest.get_output_port(), plant.get_desired_state_input_port(tool_instance))
    for k, model in enumerate(fitted):
        still = builder.AddSystem(ConstantVectorSource(np.zeros(2 * plant.num_actuated_dofs(model))))
        still.set_name(f"fittings_at_rest_{k}")
        builder.Connect(still.get_output_port(), plant.get_desired_state_input_port(model))
    scanner_view = add_picture_scene(builder, plant, scene_graph, SCANNER_RENDERER)
    finger_view = None
    if tool_instance is not None:
        finger_view = add_picture_scene(
            builder,
            plant,
            scene_graph,
            FINGER_RENDERER,
            mount="tool_plate",
            only=("tag_print", "tag_white"),
            apart=DiagramBuilder(),  # drawn in a thread of its own
            background=SOFT[:3],  # the membrane fills the view behind the tag: shading it would cost as much as the tag
        )
    return SimulatedWorld(
        plant, scene_graph, instance, tool_instance, tip_joints, scanner_view, finger_view, second_arm, touch_pair
    )
