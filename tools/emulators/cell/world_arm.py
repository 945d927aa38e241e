"""WorldArm: the arm of the world process, which stands where its controller has moved it."""

import dataclasses as dc
from typing import ClassVar

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, jacobian
from weldcal.models.arrays import Array
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild

SETTLES = 0.05  # share by which the joints move to the offset of a new stop in a step


@dc.dataclass
class WorldArm(DriverConfig):
    """A driver without a controller: the joint servos' reference is a port of the station.

    Made by code, not by a scenario.
    """

    FOR: ClassVar[tuple[str, ...]] = ("robot",)
    SIMULATED: ClassVar[bool] = True


def ApplyDriverConfig(config: WorldArm, build: StationBuild) -> None:
    """Export the reference of the joint servos, (12) rad and rad/s."""
    world = build.require(SimulatedWorld)
    build.inputs["arm.desired_state"] = world.plant.get_desired_state_input_port(world.arm)


class Repeatability:
    """The small joint offsets, one for each stop, by which the true joints differ from the reported ones."""

    def __init__(self, arm: ArmModel, repeatability_mm: float, seed: int) -> None:
        self._arm, self._mm, self._seed = arm, repeatability_mm, seed
        self._stop, self._moved = -1, True
        self._wanted, self._offset = np.zeros(6), np.zeros(6)

    def true_joints(self, q: Array, qd: Array) -> Array:
        """The true joints (6,) rad of this step for the reported ones and their velocities (6,) rad/s."""
        if self._mm == 0.0:
            return q
        moves = bool(np.abs(qd).max() > 1e-9)
        if self._stop < 0 or (moves and not self._moved):
            self._stop += 1
            lever = float(np.linalg.norm(jacobian(self._arm, q)[3:]))
            sigma = 1e-3 * self._mm / lever
            self._wanted = sigma * np.random.default_rng([self._seed, 7, self._stop]).standard_normal(6)
            if self._stop == 0:
                self._offset = self._wanted
        self._moved = moves
        if moves:
            self._offset = self._offset + SETTLES * (self._wanted - self._offset)
        return np.asarray(q + self._offset)
