"""The world's physics: one plant step for each frame of the controller, and the record and score of the torch."""

import dataclasses as dc
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from weldcal.calibration.planning.clearance import TOOL, LinkCapsule, lowest_point, self_distance
from weldcal.models.arms.kinematics import ArmModel, jacobian, link_frames
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import seam_count
from weldcal.systems.drivers.config import DriverConfig, NoDevice
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import PreparedRobot, StationBuild
from weldcal.systems.jobs.job import job_of
from weldcal.systems.motion.clear_moves import station_bodies
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.tools.emulators.cell.wires import Arc
from weldcal.tools.report.weld import true_seam
from weldcal.welding.record.process import PathError, path_error
from weldcal.welding.seam.curve import SeamCurve

SETTLES = 0.05  # share by which the joints move to the offset of a new stop in a step
STEP_S = 0.002
LOG_EVERY = 4  # frames: the servo's period
COLLISION_EVERY = 20
STILL = 1e-6  # m/s and rad/s: the plant rests where nothing of it is faster
STILL_FRAMES = 50  # for so many frames; then its state stays as it is until the controller's joints move
FEWEST = 30  # points with a burning arc
WELDED = 0.95  # share of the wanted length


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
        """Return the true joints (6,) rad of this step for the reported ones and their velocities (6,) rad/s."""
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


def true_station(scenario: Scenario, arm: ArmModel, seed: int) -> Station:
    """Return the simulated station of a scenario whose arm is where its controller has moved it.

    All else follows from `seed`.

    Raises:
        InputError: the scenario has no simulated scanner or profiler, or a tool and no workpiece or no finger camera.
    """
    scenario = dc.replace(scenario, robot=WorldArm())
    feels = scenario.welds
    if not (scenario.scanner.SIMULATED or scenario.profiler.SIMULATED) or (
        feels and (not scenario.finger_camera.SIMULATED or scenario.workpiece is None)
    ):
        raise InputError(
            "The world needs a scenario with a simulated scanner or profiler, and a simulated finger camera and a"
            " workpiece or tool: none, such as s_groove, motion or profiler_edge."
        )
    if not isinstance(scenario.robot_2, NoDevice):
        raise InputError("The world has one arm: remove robot_2 from its scenario.")
    q_home = np.deg2rad(scenario.home_deg)
    return make_station(scenario, seed, PreparedRobot(arm, q_home), job_of(scenario).set_up_world)


def to_the_wire(body: LinkCapsule, tool: WeldingTool | None) -> LinkCapsule:
    """Return a body of the clearance checks; the torch's ends where the wire does, and its round end not beyond it."""
    if tool is None or body.link != TOOL or np.linalg.norm(body.p_end - tool.X_FT @ tool.p_TW) > body.radius:
        return body
    way = body.p_end - body.p_start
    return dc.replace(body, p_end=body.p_end - body.radius * way / np.linalg.norm(way))


def still(station: Station, q: Array) -> tuple[Simulator, Context]:
    """A simulator of the station with the joint servos' reference at `q` (6,) rad and every other input at zero."""
    simulator = Simulator(station.diagram)
    context = simulator.get_mutable_context()
    for k in range(station.diagram.num_input_ports()):
        port = station.diagram.get_input_port(k)
        port.FixValue(context, np.concatenate([q, np.zeros(6)]) if port.get_name() == "arm.desired_state" else 0.0)
    return simulator, context


class Physics:
    """The plant of the world, advanced by the controller's frames.

    Without a tool nothing touches, and the arm is where it should be.
    """

    def __init__(self, scenario: Scenario, arm: ArmModel, seed: int, repeatability_mm: float) -> None:
        self.station = true_station(scenario, arm, seed)
        assert self.station.world is not None
        self.world: SimulatedWorld = self.station.world
        self._table_z_m = scenario.table_height_m()
        self._joints = Repeatability(arm, repeatability_mm, seed)
        self._arm = arm
        self._bodies = [to_the_wire(body, self.station.tool) for body in station_bodies(self.station)]
        self._simulator, self._context = still(self.station, self.station.q_start)
        self._simulator.Initialize()
        diagram, plant = self.station.diagram, self.world.plant
        self._desired = diagram.GetInputPort("arm.desired_state")
        self._plant_context = plant.GetMyContextFromRoot(self._context)
        self._poses = plant.get_body_poses_output_port()
        self._torch_port = diagram.GetOutputPort("cheat.torch") if self.station.tool is not None else None
        self._tag = None if self.station.tool is None else _tag_on(self.world, self.station.tool)
        self._true_q = np.array(self.station.q_start)
        self._reference = np.full(12, np.nan)
        self._still_frames = self._plant_frame = 0
        self._frame = 0
        self.time_s = 0.0
        self.arc_on_s = 0.0
        self.burns: list[list[Array]] = []  # of each burn of the arc, (3,) m of the torch in B at the servo's rate
        self._burns = False
        self.passes = scenario.welding.later_passes()
        self.collisions = 0
        self._touches = False

    @property
    def samples(self) -> bool:
        """Whether the newest frame is one of those whose torch is stored."""
        return self._frame % LOG_EVERY == 0

    def step(self, q: Array, qd: Array, arc: Arc) -> None:
        """Advance by one frame with the controller's joints (6,) rad, rad/s; `arc`: whether the arc burns."""
        self._frame += 1
        self.time_s = STEP_S * self._frame
        true_q = self._true_q = self._joints.true_joints(q, qd)
        if self._torch_port is not None:
            self._advance(np.concatenate([true_q, qd]))
        if arc.burns:
            self.arc_on_s += STEP_S
            if not self._burns:
                self.burns.append([])
            if self.samples and self._torch_port is not None:
                self.burns[-1].append(np.array(self._torch_port.Eval(self._context)))
        self._burns = arc.burns
        if self._frame % COLLISION_EVERY == 0:
            frames = link_frames(self._arm, true_q)
            touches = (
                lowest_point(self._bodies, frames, self.station.arm.up) < self._table_z_m
                or self_distance(self._bodies, frames) < 0.0
            )
            self.collisions += int(touches and not self._touches)
            self._touches = touches

    def _advance(self, reference: Array) -> None:
        """One step of the plant with the joint servos' reference (12,) rad, rad/s; none where plant and reference rest.

        The plant counts its own time: it knows nothing that depends on the world's.
        """
        if not np.array_equal(reference, self._reference):
            self._reference, self._still_frames = reference, 0
            self._desired.FixValue(self._context, reference)
        if self._still_frames >= STILL_FRAMES:
            return
        self._plant_frame += 1
        self._simulator.AdvanceTo(STEP_S * self._plant_frame)
        fastest = float(np.abs(self.world.plant.GetVelocities(self._plant_context)).max())
        self._still_frames = self._still_frames + 1 if fastest < STILL else 0

    @property
    def true_q(self) -> Array:
        """The arm's true joints (6,) rad in the newest frame."""
        return self._true_q

    def forget(self) -> None:
        """Begin the record of another job."""
        self.arc_on_s, self.collisions = 0.0, 0
        self.burns.clear()

    def positions(self) -> Array:
        """Return all positions of the plant, as the scanner's process poses its copy of it."""
        found = np.array(self.world.plant.GetPositions(self._plant_context))
        if self._torch_port is None:
            found[:6] = self._true_q
        return found

    def tag(self) -> Array:
        """Return the tag's pose in the flange frame, X_FM (4, 4), with the soft tip as it is bent now."""
        assert self._tag is not None
        plate, tip, X_TM = self._tag
        poses = self._poses.Eval(self._plant_context)
        found = poses[plate].InvertAndCompose(poses[tip]) @ X_TM
        return np.asarray(found.GetAsMatrix4())


def _tag_on(world: SimulatedWorld, tool: WeldingTool) -> tuple[int, int, RigidTransform]:
    """Indices of the bodies of the tool's plate and of its tip, and the tag's pose on the tip, X_TM."""
    assert world.tool is not None
    plate, tip = (int(world.plant.GetBodyByName(name, world.tool).index()) for name in ("tool_plate", "tip_z"))
    return plate, tip, tool.X_FT.InvertAndCompose(tool.X_FM_rest)


def _seams(physics: Physics) -> list[SeamCurve]:
    """The torch's true paths along the seams of the part."""
    truth = physics.station.truth
    assert truth.workpiece is not None
    found = [true_seam(truth, k) for k in range(seam_count(truth.workpiece))]
    return [seam for seam in found if seam is not None]


def _of_burns(physics: Physics) -> list[tuple[tuple[int, int], PathError]]:
    """Of each burn its seam and pass, from 0, and the torch's error: it is of the nearest seam, whose n-th is pass n.

    Where the world orders no passes every burn is of the root.
    """
    seams, found = _seams(physics), list[tuple[tuple[int, int], PathError]]()
    for points in physics.burns:
        if len(points) < FEWEST:
            continue
        p = np.array(points)
        off = [float(np.median(path_error(p[:: len(p) // FEWEST], seam).distance_m)) for seam in seams]
        k = int(np.argmin(off))
        number = min(sum(numbers[0] == k for numbers, _ in found), len(physics.passes))
        line, reverse = seams[k], False
        if number:
            order = physics.passes[number - 1]
            line, reverse = line.raised(order.vertical_m, order.lateral_m), order.reverse
        found.append(((k, number), path_error(p, line, backwards=reverse)))
    return found


def score(physics: Physics, wanted_m: float | None, *, arc_burns: bool, at_rest: bool) -> dict[str, object]:
    """The contents of the truth file. `wanted_m` is the arc length to weld; None: the whole seam.

    `state` is what the world can see: waiting (no arc yet), welding, done (the arc has gone off, the arm is at rest,
    the seam's length is welded and nothing collided), or stopped.
    """
    truth = physics.station.truth
    found: dict[str, object] = {}
    if truth.X_BC is not None:
        found["X_BC"] = truth.X_BC.GetAsMatrix4().tolist()
    if truth.profiler is not None:
        found["X_FS"] = truth.profiler.X_FS.GetAsMatrix4().tolist()
        found["p_FTip"], found["sphere_center"] = truth.profiler.p_FTip.tolist(), truth.profiler.center.tolist()
    if truth.workpiece is None:
        return found | {"collisions": physics.collisions, "time_s": physics.time_s}
    welded_m, errors = 0.0, _of_burns(physics)
    if errors:
        distance = 1e3 * np.concatenate([error.distance_m for _, error in errors])
        lateral = 1e3 * np.abs(np.concatenate([error.lateral for _, error in errors]))
        root = [(seam, error.s) for (seam, number), error in errors if number == 0]
        for seam in {seam for seam, _ in root}:
            welded_m += float(np.ptp(np.concatenate([s for other, s in root if other == seam])))
        found |= {
            "torch_mean_mm": float(distance.mean()),
            "torch_max_mm": float(distance.max()),
            "torch_lateral_mean_mm": float(lateral.mean()),
            "torch_lateral_max_mm": float(lateral.max()),
            "torch_every_s": LOG_EVERY * STEP_S,
            "torch_s_left_up_mm": [
                np.round(1e3 * np.column_stack([error.s, error.lateral, error.height]), 4).tolist()
                for _, error in errors
            ],
        }
        if len({numbers for numbers, _ in errors}) > 1:
            found["burns"] = [
                {"seam": seam + 1, "pass": number + 1, "torch_max_mm": 1e3 * float(error.distance_m.max())}
                for (seam, number), error in errors
            ]
    else:
        found |= {"torch_mean_mm": None, "torch_max_mm": None}
    seams = _seams(physics)
    wanted_m = sum(seam.length for seam in seams) if wanted_m is None else wanted_m * len(seams)
    whole = welded_m >= WELDED * wanted_m
    state = "waiting"
    if physics.arc_on_s:
        good = whole and physics.collisions == 0
        state = "welding" if arc_burns else ("done" if good and at_rest else "stopped")
    return found | {
        "arc_on_s": physics.arc_on_s,
        "welded_mm": 1e3 * welded_m,
        "collisions": physics.collisions,
        "state": state,
        "time_s": physics.time_s,
    }
