"""Build the simulated world: arm, tool, table, workpiece, and what a job adds, in one MultibodyPlant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    GeometryId,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import JointActuatorIndex, ModelInstanceIndex, PdControllerGains, UniformGravityFieldElement
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer

from weldcal.calibration.planning.clearance import Surroundings
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.flanges import flange_mesh
from weldcal.models.robots import BaseCircle
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.bodies.tool import (
    STEEL,
    TABLE,
    TIP_FRICTION,
    add_flange,
    add_surroundings,
    add_tool,
    mesh_shape,
    show,
)
from weldcal.systems.drivers.simulated.picture_scene import PictureScene, add_picture_scene
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture, add_fixture
from weldcal.systems.drivers.simulated.second_arm import PlacedArm, add_second_arm
from weldcal.systems.messages import Message

TABLE_M = (1.5, 1.2)  # length and width of the table, at least
SCANNER_RENDERER = "scanner"
JOINT_STIFFNESS = (2e5, 2e5, 1e5, 2e4, 2e4, 1e4)  # N m / rad, of a UR10e's joint servos
JOINT_DAMPING = (4e3, 4e3, 2e3, 3e2, 3e2, 1.5e2)  # N m s / rad
SERVO_EFFORT = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)  # N m, of that arm: another arm's servos are stiff in proportion


def servo_gains(arm: ArmModel) -> tuple[list[float], list[float]]:
    """Stiffness (6) N m / rad and damping (6) N m s / rad of joint servos, in proportion to the joints' torques."""
    share = arm.effort_limit / np.array(SERVO_EFFORT)
    return list(share * JOINT_STIFFNESS), list(share * JOINT_DAMPING)


@dataclass(frozen=True, kw_only=True)
class SimulatedWorld(Message):
    """Handles into the plant for drivers and `cheat.*` ports."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    arm: ModelInstanceIndex
    tool: ModelInstanceIndex | None
    scanner_view: PictureScene
    second: ModelInstanceIndex | None = None  # the second arm of a co-manipulation
    touch_pair: frozenset[GeometryId] | None = None  # whose contact counts as a touch


class Fittings(Protocol):
    """Further bodies of a scenario, on the flange and on the table."""

    def add(self, plant: MultibodyPlant, arm: ModelInstanceIndex) -> ModelInstanceIndex:
        """Add them before the plant is finalised.

        Returns the model instance whose springs have their rest position at zero.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldSetup:
    """Bodies for `build_world`, and `parts` that drivers look up by type (see StationBuild).

    `second` is another arm; `foot` is the ring of the base mounting, with a mesh finer than a scan resolves.
    `contacts_read`: a device reads the plant's contact results, which are then those of its last step.
    """

    fittings: Sequence[Fittings] = ()
    second: PlacedArm | None = None
    foot: BaseCircle | None = None
    profiler: ProfilerFixture | None = None
    time_step_s: float = 0.002  # of the plant: as fine as what is touched asks for
    parts: Sequence[object] = ()
    contacts_read: bool = False


def compensate_gravity(builder: DiagramBuilder, plant: MultibodyPlant, models: list[ModelInstanceIndex]) -> None:
    """Add the controller's feed-forward torques against gravity, so that the servos have no static error.

    Gravity stays on: without any force on an arm at rest, the contact solver has no scale for its convergence test.
    """
    feed_forward = builder.AddNamedSystem(
        "gravity_compensation", InverseDynamics(plant, InverseDynamics.InverseDynamicsMode.kGravityCompensation)
    )
    builder.Connect(plant.get_state_output_port(), feed_forward.get_input_port_estimated_state())
    split = builder.AddSystem(Demultiplexer([plant.num_actuated_dofs(m) for m in models]))
    builder.Connect(feed_forward.get_output_port_generalized_force(), split.get_input_port())
    for k, model in enumerate(models):
        builder.Connect(split.get_output_port(k), plant.get_actuation_input_port(model))


def build_world(
    builder: DiagramBuilder,
    arm: ArmModel,
    tool: WeldingTool | None,
    q_start: np.ndarray,
    *,
    flange: str,
    table: RigidTransform,
    workpiece: WeldPart | None,
    X_BP: RigidTransform | None,
    setup: WorldSetup,
    surroundings: Surroundings,
) -> SimulatedWorld:
    """Build the plant of the station, with the arm at `q_start`, held by implicit joint servos.

    Gravity pulls against the arm's `up`. `table` is the pose in B of the table's top, z up.
    A robot driver sets the servos' reference: the simulated controller, or a real arm that the simulated one follows.
    Frame: the world is the robot base B. `workpiece` is the true part (it may differ from its CAD), placed at X_BP.
    """
    profiler, second, foot = setup.profiler, setup.second, setup.foot
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=setup.time_step_s,
            contact_model="hydroelastic" if profiler is None else "point",
            # A plant with sampled ports steps in an unrestricted update: at each step Drake would copy the state of the
            # whole Diagram.
            use_sampled_output_ports=setup.contacts_read,
            # With `sap` the tip's rest position would depend on the sliding speed
            discrete_contact_approximation="lagged",
        ),
        builder,
    )
    plant.mutable_gravity_field().set_gravity_vector(-UniformGravityFieldElement.kDefaultStrength * arm.up)
    (instance,) = Parser(builder=builder, plant=plant).AddModelsFromString(arm_urdf(arm), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    add_flange(plant, instance, flange)
    tool_instance = None if tool is None else add_tool(plant, instance, tool, tool.tip_radius_m / 2)
    second_arm = None if second is None else add_second_arm(plant, second, *servo_gains(second.arm))
    if second_arm is not None:
        add_flange(plant, second_arm, flange)
    touch_pair = None if profiler is None else add_fixture(plant, instance, profiler, float(table.translation()[2]))
    world_body = plant.world_body()
    if foot is not None:
        ring = mesh_shape(flange_mesh(foot.standard, foot.standard.bore_depth_m), "foot.obj")
        show(plant, plant.GetBodyByName("base", instance), foot.X_BR, ring, "base_circle", STEEL)
    length, width = TABLE_M
    if workpiece is not None and X_BP is not None:  # a long part lies on a long table
        reach = np.abs(workpiece.mesh.transformed(table.inverse() @ X_BP).bounds[:, :2]).max(axis=0)
        length, width = (max(least, 2.0 * float(r) + 0.2) for least, r in zip(TABLE_M, reach, strict=True))
    show(plant, world_body, table @ RigidTransform([0.0, 0.0, -0.02]), Box(length, width, 0.04), "table", TABLE)
    add_surroundings(plant, surroundings)
    if workpiece is not None and X_BP is not None:
        show(plant, world_body, X_BP, mesh_shape(workpiece.mesh, "workpiece.obj"), "workpiece", STEEL)
        rigid = ProximityProperties()
        AddContactMaterial(friction=CoulombFriction(TIP_FRICTION, TIP_FRICTION), properties=rigid)
        AddRigidHydroelasticProperties(resolution_hint=0.002, properties=rigid)
        if profiler is None:
            plant.RegisterCollisionGeometry(
                world_body, X_BP, mesh_shape(workpiece.groove_mesh, "groove.obj"), "groove", rigid
            )
    fitted = [fitting.add(plant, instance) for fitting in setup.fittings]
    stiffness, damping = servo_gains(arm)
    for k in range(6):  # by index: the indices of one model instance are not known before Finalize
        servo = plant.get_joint_actuator(JointActuatorIndex(k))
        servo.set_controller_gains(PdControllerGains(p=stiffness[k], d=damping[k]))
    plant.Finalize()
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
    if len(actuators) != 6 or not all(a.has_controller() for a in actuators):
        raise RuntimeError("the arm does not have six joint servos")
    plant.SetDefaultPositions(instance, q_start)
    if second_arm is not None and second is not None:
        plant.SetDefaultPositions(second_arm, second.q_start)
    moved = [m for m in (instance, tool_instance, second_arm, *fitted) if m is not None]
    compensate_gravity(builder, plant, moved)
    if tool_instance is not None:
        memory = None if tool is None else tool.memory
        if memory is None:
            source = ConstantVectorSource(np.zeros(6))
        else:
            from weldcal.systems.bodies.relaxing_tip import RelaxingTip  # only here: few tips are described so far

            source = RelaxingTip(memory, setup.time_step_s)
        rest = builder.AddNamedSystem("tip_at_rest", source)
        if memory is not None:
            builder.Connect(plant.get_state_output_port(tool_instance), rest.get_input_port())
        builder.Connect(rest.get_output_port(), plant.get_desired_state_input_port(tool_instance))
    for k, model in enumerate(fitted):
        still = builder.AddNamedSystem(
            f"fittings_at_rest_{k}", ConstantVectorSource(np.zeros(2 * plant.num_actuated_dofs(model)))
        )
        builder.Connect(still.get_output_port(), plant.get_desired_state_input_port(model))
    scanner_view = add_picture_scene(builder, plant, scene_graph, SCANNER_RENDERER)
    return SimulatedWorld(
        plant=plant,
        scene_graph=scene_graph,
        arm=instance,
        tool=tool_instance,
        scanner_view=scanner_view,
        second=second_arm,
        touch_pair=touch_pair,
    )
