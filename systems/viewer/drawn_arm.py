"""Adds a kinematic display of the arm, at its measured joints, to a station without a simulated world."""

import numpy as np
from pydrake.geometry import Box, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from weldcal.calibration.planning.clearance import Surroundings
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.tool import WeldingTool
from weldcal.systems.bodies.tool import TABLE, add_flange, add_surroundings, add_tool, show


def add_drawn_arm(
    builder: DiagramBuilder,
    arm: ArmModel,
    tool: WeldingTool | None,
    flange: str,
    table: RigidTransform,
    position_measured: OutputPort,
    surroundings: Surroundings,
) -> SceneGraph:
    """Add a scene with arm, tool (tip at rest), table, its top's frame at `table` in B, and surroundings.

    Frame: the world is the base B.

    `position_measured` (6) rad sets the arm's pose. The scene has no dynamics, no contact and no rendered sensors.
    """
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = MultibodyPlant(time_step=0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    (instance,) = Parser(plant).AddModelsFromString(arm_urdf(arm), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    add_flange(plant, instance, flange)
    if tool is not None:
        add_tool(plant, instance, tool, tool.tip_radius_m / 2)
    show(plant, plant.world_body(), table @ RigidTransform([0.0, 0.0, -0.02]), Box(1.5, 1.2, 0.04), "table", TABLE)
    add_surroundings(plant, surroundings)
    plant.Finalize()
    poses = builder.AddNamedSystem("drawn_poses", MultibodyPositionToGeometryPose(plant))
    rest = plant.num_positions() - len(arm.joint_names)
    if rest:
        joints = builder.AddSystem(Multiplexer([len(arm.joint_names), rest]))
        still = builder.AddSystem(ConstantVectorSource(np.zeros(rest)))
        builder.Connect(position_measured, joints.get_input_port(0))
        builder.Connect(still.get_output_port(), joints.get_input_port(1))
        position_measured = joints.get_output_port()
    builder.Connect(position_measured, poses.get_input_port())
    source = plant.get_source_id()
    builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
    return scene_graph
