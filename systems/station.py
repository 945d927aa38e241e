"""Builds the station: arms, sensors and tools with fixed ports.

The scenario's driver configs select real or simulated.
"""

import dataclasses as dc
import inspect
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from weldcal.calibration.planning.clearance import Surroundings
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arms.urdf import Capsule
from weldcal.models.errors import InputError
from weldcal.models.tool import LAST_LINK, WeldingTool
from weldcal.models.workpieces.part import Part, WeldPart, bend
from weldcal.models.workpieces.plate import make_workpiece, seeded_groove_error
from weldcal.models.workpieces.seat import Press
from weldcal.models.workpieces.tack import tacked
from weldcal.systems.background import Background, Inline, OwnProcess, require_guard
from weldcal.systems.drivers.config import DEVICES, DriverConfig, FingerCameraConfig, NoDevice
from weldcal.systems.drivers.simulated.profiler_world import ProfilerTruth
from weldcal.systems.drivers.simulated.rendered_scanner import TrueScanner, random_pose_error
from weldcal.systems.drivers.simulated.second_arm import FIRST, SECOND, PlacedArm
from weldcal.systems.drivers.simulated.world import SimulatedWorld, WorldSetup, build_world
from weldcal.systems.drivers.station_build import Closable, PreparedRobot, StationBuild
from weldcal.systems.jobs.tablet.config import TabletTruth
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message
from weldcal.systems.recording.answers import RepeatedBackground
from weldcal.systems.recording.player import Playback, add_player
from weldcal.systems.scenario.parts import corrected_arm, made, nominal_arm, part_of, surroundings_of
from weldcal.systems.scenario.schema import Scenario, WorkpieceConfig
from weldcal.systems.viewer.drawn_arm import add_drawn_arm


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Truth(Message):
    """Ground truth of a simulation, for reports and tests (`cheat.*`) only."""

    X_BC: RigidTransform | None
    X_BP: RigidTransform | None
    workpiece: WeldPart | None  # the true part
    tablet: TabletTruth | None = None  # camera and pen on the wrist and the tablet on the table
    X_LC: RigidTransform | None = None  # the scanner on what carries it, where that is not the base
    X_BD: RigidTransform | None = None  # the second arm's base
    profiler: ProfilerTruth | None = None
    scanner: TrueScanner | None = None  # the device with its own errors
    arm: ArmModel | None = None  # with its true kinematics


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """The station's Diagram and the handles that the cell needs. The caller that makes a station must close it."""

    diagram: Diagram
    robot: PreparedRobot
    tool: WeldingTool | None
    cad: WeldPart | None  # the nominal part
    truth: Truth
    world: SimulatedWorld | None  # None where no device is simulated
    second: ArmModel | None = None
    background: Background = dc.field(default_factory=Inline)
    devices: tuple[Closable, ...] = ()
    surroundings: Surroundings = dc.field(default_factory=Surroundings)

    @property
    def arm(self) -> ArmModel:
        """The arm model of the robot, with its own kinematics."""
        return self.robot.arm

    @property
    def q_start(self) -> np.ndarray:
        """The arm's configuration (6,) rad at the time the station was built."""
        return self.robot.q_start

    @property
    def pace(self) -> float | None:
        """Seconds of the Diagram per second of the wall clock; None: as fast as possible."""
        return self.robot.pace

    def has(self, output: str) -> bool:
        """Whether the station has an output port of this name."""
        return bool(self.diagram.HasOutputPort(output))

    def waiting_s(self, now: float) -> float:
        """Seconds for which the newest background computation has been waited for at `now` (s, monotonic)."""
        since = self.background.waiting_since
        return 0.0 if since is None else now - since

    def close(self) -> None:
        """Stop the arm, release the hardware and end the background; a second call has no effect."""
        self.robot.close()
        for device in self.devices:
            device.close()
        self.background.close()


def apply_driver_config(config: Any, build: StationBuild) -> Any:
    """Call the ApplyDriverConfig of the module that defines the config's class, as pydrake.manipulation does."""
    apply = getattr(inspect.getmodule(type(config)), "ApplyDriverConfig", None)
    return None if apply is None else apply(config, build)


def prepare_robot(config: Any, nominal: ArmModel, q_home: np.ndarray) -> PreparedRobot:
    """Call the PrepareRobot of the module that defines the config's class, which returns the arm and its configuration.

    A driver without one has the nominal arm at home.
    """
    prepare = getattr(inspect.getmodule(type(config)), "PrepareRobot", None)
    if prepare is None:
        return PreparedRobot(nominal, q_home)
    found: PreparedRobot = prepare(config, nominal)
    return found


TABLE_MIDDLE_M = 0.45  # along the world's x


class CheatPoses(LeafSystem):
    """Outputs the true positions of tip and torch.

    .. pydrake_system::

        name: CheatPoses
        input_ports:
        - body_poses
        output_ports:
        - contact
        - torch

    `contact` (6): true tip centre in B (m) and its deflection from rest in T (m); `torch` (3): wire point in B, m.
    """

    def __init__(self, world: SimulatedWorld, tool: WeldingTool) -> None:
        super().__init__()
        plant = world.plant
        self._tool = tool
        self._flange = plant.GetBodyByName("flange", world.arm).index()
        self._tip = plant.GetBodyByName("tip_z", world.tool).index() if world.tool is not None else self._flange
        self._poses = self.DeclareAbstractInputPort("body_poses", plant.get_body_poses_output_port().Allocate())
        self.DeclareVectorOutputPort("contact", 6, self._contact)
        self.DeclareVectorOutputPort("torch", 3, self._torch)

    def _contact(self, context: Context, output: BasicVector) -> None:
        poses = self._poses.Eval(context)
        X_BT = poses[self._flange] @ self._tool.X_FT
        p_BTip = poses[self._tip].translation()
        output.SetFromVector(np.concatenate([p_BTip, X_BT.inverse() @ p_BTip]))

    def _torch(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._poses.Eval(context)[self._flange] @ self._tool.X_FT @ self._tool.p_TW)


class SetUpWorld(Protocol):
    """The signature of Job.set_up_world, which adds a job's objects to the simulated world."""

    def __call__(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> WorldSetup:
        """Draw the job's objects with the run's random numbers."""


def make_station(
    scenario: Scenario,
    seed: int,
    robot: PreparedRobot | None = None,
    set_up_world: SetUpWorld | None = None,
    played: Playback | None = None,
) -> Station:
    """Build the station of a scenario; all random deviations of the simulated world follow from `seed`.

    `robot` is an already prepared robot; None: the driver in the scenario prepares it. `set_up_world` is the job's
    method. `played`: ports of a recording take the place of all devices. A station without simulated devices has no
    simulated world: the arm is displayed at its measured joints.

    Ports: in `arm.velocity_command` (6) rad/s, `scanner.trigger` (1), `finger_camera.streaming` (1); out
    `arm.position_measured`, `.velocity_measured`, `.X_BF`, `.sample_time`, `.status`, `scanner.scan`,
    `finger_camera.image`, `.capture_time`, `query_object`; simulated only: `cheat.X_BC`, `cheat.truth`,
    `cheat.contact`, `cheat.torch`. With a tablet: in `wrist_camera.trigger` (1), out `wrist_camera.picture`,
    `digitizer.touch`. With a profiler: in `profiler.trigger`, out `profiler.profile`; with a simulated one or a touch
    probe: `torch.touch`.

    Raises:
        InputError: the scenario has no robot; a script starts a robot's job outside its guard. A driver adds its own:
            RobotRefused where the robot does not allow the job.
    """
    if isinstance(scenario.robot, NoDevice):
        raise InputError("A cell needs a robot: write robot: !SimulatedUr {} in the scenario.")
    if played is None and not scenario.robot.SIMULATED:
        require_guard()
    if robot is None:
        robot = prepare_robot(scenario.robot, nominal_arm(scenario), np.deg2rad(scenario.home_deg))
    opened: list[Closable] = []
    try:
        return _make_station(scenario, seed, robot, set_up_world, opened, played)
    except BaseException:
        robot.close()
        for device in opened:
            device.close()
        raise


def _make_station(
    scenario: Scenario,
    seed: int,
    robot: PreparedRobot,
    set_up_world: SetUpWorld | None,
    opened: list[Closable],
    played: Playback | None,
) -> Station:
    rng = np.random.default_rng(seed)
    controller = robot.arm  # by which the controller computes, and the true arm deviates
    robot = dc.replace(robot, arm=corrected_arm(scenario, controller))
    cad, real, X_BP = _workpieces(scenario, rng)
    surroundings = surroundings_of(scenario)
    tool = _tool(scenario, cad)
    devices: dict[str, DriverConfig] = {} if played is not None else {name: getattr(scenario, name) for name in DEVICES}
    builder = DiagramBuilder()
    build = StationBuild(
        builder=builder, arm=robot.arm, tool=tool, q_start=robot.q_start, rng=rng, robot=robot, closables=opened
    )
    setup = WorldSetup()
    world, true_arm = None, controller
    if any(config.SIMULATED for config in devices.values()):
        setup = WorldSetup() if set_up_world is None else set_up_world(scenario, rng, real, X_BP)
        build.tool = _tool(scenario, cad, simulated=True)
        true_arm, second = scenario.robot.true_arm(controller, robot.q_start, rng), setup.second
        if second is not None:
            second = dc.replace(second, arm=scenario.robot_2.true_arm(second.arm, second.q_start, rng))
        world = build_world(
            builder,
            true_arm,
            build.tool,
            robot.q_start,
            flange=scenario.flange_name(),
            table=table_in_base(scenario),
            workpiece=real,
            X_BP=X_BP,
            setup=dc.replace(setup, second=second),
            surroundings=surroundings,
        )
        build.parts = (world, *setup.parts)
    X_LC = None
    if played is not None:
        add_player(played, build)
    for name, config in devices.items():
        if name == "robot_2" and setup.second is not None:
            _apply_second_robot(config, setup.second, build)
            continue
        placed = apply_driver_config(config, build)
        if name == "scanner" and world is not None:  # only a simulation knows the truth
            X_LC = placed
    scanner = scenario.scanner_config()
    on_base = scanner is None or scanner.mounted_on == "base"
    truth = Truth(
        X_BC=X_LC if on_base else None,
        X_BP=X_BP if world is not None else None,
        workpiece=real if world is not None else None,
        tablet=build.find(TabletTruth),
        X_LC=X_LC,
        X_BD=None if setup.second is None else setup.second.X_BD,
        profiler=build.find(ProfilerTruth),
        scanner=build.find(TrueScanner),
        arm=None if world is None else true_arm,
    )
    _export(build, world, truth, scenario, surroundings)
    diagram = builder.Build()
    diagram.set_name("station")
    # only a Diagram that keeps a robot's pace cannot wait for a computation
    background: Background = Inline() if robot.pace is None else OwnProcess(waits=robot.waits)
    if played is not None:
        background = RepeatedBackground(looks=played.looks)
    return Station(
        diagram=diagram,
        robot=robot,
        tool=tool,
        cad=cad,
        truth=truth,
        world=world,
        second=None if setup.second is None else setup.second.arm,
        background=background,
        devices=tuple(opened),
        surroundings=surroundings,
    )


def _apply_second_robot(config: DriverConfig, placed: PlacedArm, build: StationBuild) -> None:
    """Apply a single-arm driver to the second arm.

    It gets a world with this arm as its arm, and its ports are renamed.
    """
    world = build.require(SimulatedWorld)
    assert world.second is not None
    own = dc.replace(
        build,
        arm=placed.arm,
        tool=None,
        q_start=placed.q_start,
        parts=(dc.replace(world, arm=world.second),),
        inputs={},
        outputs={},
    )
    before = {id(s) for s in build.builder.GetSystems()}
    apply_driver_config(config, own)
    for system in build.builder.GetSystems():
        if id(system) not in before:
            system.set_name(_of_second(system.get_name()))
    build.inputs |= {_of_second(name): port for name, port in own.inputs.items()}
    build.outputs |= {_of_second(name): port for name, port in own.outputs.items()}


def _of_second(name: str) -> str:
    """Return the name of a port or system of the second arm, from the one that its driver gave it."""
    return f"{SECOND}{name.removeprefix(FIRST)}" if name.startswith(FIRST) else name


def _tool(scenario: Scenario, cad: WeldPart | None, *, simulated: bool = False) -> WeldingTool | None:
    """Return the welding tool, or the one that the simulated arm carries.

    It has the scenario's press deflections and the groove angle of the workpiece.
    """
    loaded, welding, camera = scenario.loaded_tool(simulated=simulated), scenario.welding, scenario.finger_camera
    if loaded is None:
        return None
    tool = loaded.tool
    given = [None if mm is None else 1e-3 * mm for mm in (welding.axial_deflection_mm, welding.deflection_mm)]
    press = Press(tool.press_axial_m, tool.press_lateral_m) if cad is None else cad.press(tool, given[0], given[1])
    measured = camera.tag_size_m() if isinstance(camera, FingerCameraConfig) else None
    clear, carried = tool.keep_clear, scenario.carried_scanner()
    if carried is not None:  # its housing moves with the tool
        start, end = (carried.pose() @ np.array([x, 0.0, -0.045]) for x in (-0.09, 0.09))
        clear = (*tool.capsules(), Capsule(LAST_LINK, start, end, 0.05))
    return dc.replace(
        tool,
        keep_clear=clear,
        press_axial_m=press.axial_m,
        press_lateral_m=press.lateral_m,
        tag_size_m=measured or tool.tag_size_m,
        groove_half_angle_rad=tool.groove_half_angle_rad if cad is None else cad.half_angle_rad,
    )


def _workpieces(
    scenario: Scenario, rng: np.random.Generator
) -> tuple[WeldPart | None, WeldPart | None, RigidTransform | None]:
    """Return the nominal part, the true part, and the true pose."""
    spec = scenario.workpiece
    if spec is None:
        return None, None, None
    if spec.file is None:
        cad, real = _plates(spec, rng)
    else:
        drawn = part_of(spec)
        cad, real = drawn, made(drawn, spec, rng)
    real = tacked(real, scenario.welding.tacks_m())
    placed = _lying_error(
        rng, spec.placement_error.translation_mm * 1e-3, np.deg2rad(spec.placement_error.rotation_deg)
    )
    # A part turns about its middle: the origin of its file may be far away.
    middle = RigidTransform(0.5 * cad.mesh.bounds.sum(axis=0)) if isinstance(cad, Part) else RigidTransform()
    return cad, real, spec.pose_guess.pose() @ middle @ placed @ middle.inverse()


def _plates(spec: WorkpieceConfig, rng: np.random.Generator) -> tuple[WeldPart, WeldPart]:
    """Return the nominal plate, and the true one."""
    length = spec.length_mm * 1e-3
    cad = make_workpiece(spec.shape, length_m=length)
    X_PG = seeded_groove_error(rng, spec.groove_error.translation_mm * 1e-3, np.deg2rad(spec.groove_error.rotation_deg))
    real = make_workpiece(spec.shape, length_m=length, X_PG=X_PG)
    if spec.hole_from_mm is not None:
        short = make_workpiece(spec.shape, length_m=length, X_PG=X_PG, end_cut_m=spec.hole_from_mm * 1e-3)
        real = dc.replace(real, groove_mesh=short.groove_mesh)
    if spec.bend_radius_mm is not None:
        cad, real = (bend(part, spec.bend_radius_mm * 1e-3) for part in (cad, real))
    return cad, real


def table_in_base(scenario: Scenario) -> RigidTransform:
    """Pose in the base of the table's frame: its top's middle, z up."""
    return scenario.base.pose().inverse() @ RigidTransform([TABLE_MIDDLE_M, 0.0, scenario.calibration.table_z_m])


def _lying_error(rng: np.random.Generator, translation_m: float, rotation_rad: float) -> RigidTransform:
    """Draw the pose error of a plate on its fixture: a translation and a rotation in its plane."""
    error = random_pose_error(rng, translation_m, rotation_rad)
    p = np.array(error.translation())
    length = np.hypot(p[0], p[1])
    p = np.array([p[0], p[1], 0.0]) * (translation_m / length if length > 0 else 0.0)
    sign = 1.0 if rng.random() < 0.5 else -1.0
    return RigidTransform(RollPitchYaw(0.0, 0.0, sign * rotation_rad), p)


def _export(
    build: StationBuild, world: SimulatedWorld | None, truth: Truth, scenario: Scenario, surroundings: Surroundings
) -> None:
    builder = build.builder
    for name, port in build.inputs.items():
        builder.ExportInput(port, name)
    for name, port in build.outputs.items():
        builder.ExportOutput(port, name)
    if world is None:
        drawn = add_drawn_arm(
            builder,
            build.arm,
            build.tool,
            scenario.flange_name(),
            table_in_base(scenario),
            build.outputs["arm.position_measured"],
            surroundings,
        )
        builder.ExportOutput(drawn.get_query_output_port(), "query_object")
        return
    source = builder.AddNamedSystem("truth", ConstantValueSource(AbstractValue.Make(truth)))
    builder.ExportOutput(source.get_output_port(), "cheat.truth")
    if truth.X_BC is not None:
        camera = builder.AddNamedSystem("true_X_BC", ConstantValueSource(AbstractValue.Make(truth.X_BC)))
        builder.ExportOutput(camera.get_output_port(), "cheat.X_BC")
    if build.tool is not None:
        cheat = builder.AddNamedSystem("cheat_poses", CheatPoses(world, build.tool))
        builder.Connect(world.plant.get_body_poses_output_port(), cheat.GetInputPort("body_poses"))
        builder.ExportOutput(cheat.GetOutputPort("contact"), "cheat.contact")
        builder.ExportOutput(cheat.GetOutputPort("torch"), "cheat.torch")
    builder.ExportOutput(world.scene_graph.get_query_output_port(), "query_object")
