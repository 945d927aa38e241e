"""Adds a second arm to the simulated plant, with its base at its true pose."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.arms.urdf import arm_urdf
from weldcal.systems.jobs.mounting.config import SecondArm

FIRST, SECOND = "arm", "arm_2"
"""Prefixes of the ports of the first and of the second arm, whatever their models."""


@dc.dataclass(frozen=True, eq=False)
class PlacedArm:
    """An arm, the true pose X_BD of its base in the first arm's base, and its start configuration (6,) rad."""

    arm: ArmModel
    X_BD: RigidTransform
    q_start: NDArray[np.float64]


def place_second_arm(config: SecondArm, off: RigidTransform) -> PlacedArm:
    """Place the arm with the deviation ``off`` from its nominal pose.

    Its rotation is in the arm's own frame, its translation in the first arm's base.
    """
    drawn = config.pose()
    X_BD = RigidTransform(drawn.rotation() @ off.rotation(), drawn.translation() + off.translation())
    return PlacedArm(load_arm(config.arm), X_BD, np.deg2rad(config.home_deg))


def add_second_arm(
    plant: MultibodyPlant, placed: PlacedArm, stiffness: Sequence[float], damping: Sequence[float]
) -> ModelInstanceIndex:
    """Add the arm to a plant that is not finalised, with joint servos of its own size."""
    (instance,) = Parser(plant).AddModelsFromString(arm_urdf(placed.arm, SECOND), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance), placed.X_BD)
    for name, p, d in zip(placed.arm.joint_names, stiffness, damping, strict=True):
        plant.GetJointActuatorByName(name, instance).set_controller_gains(PdControllerGains(p=p, d=d))
    top, grey = RigidTransform([0.0, 0.0, -0.02]), np.array([0.36, 0.38, 0.40, 1.0])
    plant.RegisterVisualGeometry(plant.world_body(), placed.X_BD @ top, Box(0.5, 0.5, 0.04), "second_table", grey)
    return instance
