"""Small stations and cells for the tests of this room, each built once, and a way to drive a station by hand."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from tests.worlds.scaled_arms import perfect
from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.tool import WeldingTool
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station

KNOWN_CAMERA = "X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}"
WELD_ONLY = f"job: {{calibrate: false, {KNOWN_CAMERA}}}"  # no pose planning: such a cell is built in a moment
SMALL_IDEAL_SCANNER = (
    "scanner: !RenderedScanner {preset: ideal, width: 412, height: 308, exposure_s: 0.1,"
    " mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}"
)
EXACT_PLATE = (
    "workpiece: {shape: straight, length_mm: 200.0, pose_guess: {xyz_m: [0.65, 0.0, 0.02], rpy_deg: [0.0, 0.0, 90.0]},"
    " placement_error: {translation_mm: 0.0, rotation_deg: 0.0}, groove_error: {translation_mm: 0.0, rotation_deg:"
    " 0.0}}"
)


@lru_cache(maxsize=1)
def the_arm() -> ArmModel:
    """The UR10e."""
    return load_arm("ur10e")


TOOL = WeldingTool()
Q_HOME = np.deg2rad([190.0, -120.0, 135.0, -105.0, -90.0, 90.0])


def scenario(*overrides: str) -> Scenario:
    """The shipped S groove with changes, in a perfect world."""
    return perfect(load_scenario("s_groove", "\n".join((WELD_ONLY, *overrides))))


@lru_cache(maxsize=1)
def plain_station() -> Station:
    """A straight groove exactly where it is drawn, under an ideal scanner exactly where it is said to be."""
    return make_station(scenario(SMALL_IDEAL_SCANNER, EXACT_PLATE), 0)


@lru_cache(maxsize=1)
def weld_only_cell() -> Cell:
    """The whole cell of the S groove with a known camera."""
    return build_cell(scenario(), 0)


class Drive:
    """A station in a simulation, driven by hand through its own input ports."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self.simulator = Simulator(station.diagram)
        self.context: Context = self.simulator.get_mutable_context()
        for name in ("arm.velocity_command", "scanner.trigger", "finger_camera.streaming"):
            if station.diagram.HasInputPort(name):
                self.set(name, np.zeros(station.diagram.GetInputPort(name).size()))

    def set(self, name: str, value: Any) -> None:
        """Change one input from now on."""
        self.station.diagram.GetInputPort(name).FixValue(self.context, value)

    def get(self, name: str) -> Any:
        """The present value of an output port."""
        return self.station.diagram.GetOutputPort(name).Eval(self.context)

    @property
    def plant(self) -> Context:
        """The plant's own context."""
        return self.station.world.plant.GetMyMutableContextFromRoot(self.context)

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return float(self.context.get_time())

    def run(self, duration_s: float) -> None:
        """Let time pass."""
        self.simulator.AdvanceTo(self.time + duration_s)

    def ticks(self, duration_s: float, period_s: float = 0.002) -> Iterator[float]:
        """Let time pass tick by tick, and stop half way between every two."""
        start = int(np.ceil(self.time / period_s - 1e-6))
        for k in range(round(duration_s / period_s)):
            self.simulator.AdvanceTo((start + k + 0.5) * period_s)
            yield self.time

    def place_arm(self, q: np.ndarray, deflection_T: np.ndarray | None = None) -> None:
        """Put the arm at rest at q, its servo's reference with it, and the soft tip off its rest by deflection_T (3,)
        m."""
        world = self.station.world
        world.plant.SetPositions(self.plant, world.arm, q)
        world.plant.SetVelocities(self.plant, world.arm, np.zeros(6))
        if world.tool is not None:
            world.plant.SetPositions(self.plant, world.tool, np.zeros(3) if deflection_T is None else deflection_T)
            world.plant.SetVelocities(self.plant, world.tool, np.zeros(3))
        servo = self.station.diagram.GetSubsystemByName("arm_servo")
        place_servo(servo.GetMyMutableContextFromRoot(self.context), q, self.time)


def place_servo(context: Context, q: np.ndarray, time: float = 0.0, fault: float = 0.0) -> None:
    """Set the state of a SpeedJointServo: its reference and what it measured at rest at q, at that time, and its
    fault."""
    for group, value in enumerate((np.concatenate([q, np.zeros(6)]), q, np.zeros(6), [time], [fault])):
        context.SetDiscreteState(group, value)
