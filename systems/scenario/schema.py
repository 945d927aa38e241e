"""What a scenario YAML may say: typed configuration of one cell, unknown keys are errors."""

import dataclasses as dc
import re
from pathlib import Path

import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.published.algorithm1 import COST_AXES, named_cost
from weldcal.models.errors import InputError
from weldcal.systems.drivers.no_device import NoDevice
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera
from weldcal.systems.drivers.simulated.tablet import SimulatedTablet
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.jobs.mounting.config import MountingJob, check_mounting
from weldcal.systems.jobs.profiler.config import ProfilerJob, check_profiler_job
from weldcal.systems.jobs.tablet.config import TabletConfig, check_tablet
from weldcal.systems.scenario.numbers import check_numbers
from weldcal.welding.locate.planning import PlanningMethod
from weldcal.welding.record.process import WeldProcess
from weldcal.welding.servo.laws import get_law

SLOWEST_FACTOR = 0.05
DRAWN_ARMS = ("ur10e",)
SCENARIO_FOLDER = Path(__file__).resolve().parents[2] / "models" / "scenarios"


@dc.dataclass
class PoseConfig:
    """A pose as a person writes it: metres and degrees, roll-pitch-yaw about fixed axes."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    def pose(self) -> RigidTransform:
        """The pose as a RigidTransform."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)


@dc.dataclass
class ErrorConfig:
    """How far the simulated world may differ from what the cell was told (drawn from the run's seed)."""

    translation_mm: float = 0.0
    rotation_deg: float = 0.0


@dc.dataclass
class CalibrationConfig:
    """The calibration job: which feature, which poses, when to stop."""

    configuration: str = "eye_on_base"  # or eye_in_hand, eye_on_arm_target_on_flange, ..._on_base, co_manipulation
    feature: str = "tool_ring"  # tool_ring: the ring on the welding tool; flange: the bare flange
    mounting_guess: PoseConfig = dc.field(default_factory=PoseConfig)  # X_BC (X_FC, X_LC) as measured with a tape
    guess_radius_mm: float = 60.0  # how far the feature may be from where the guess puts it
    theta_max_deg: float = 25.0  # between the feature's normal and the line of sight
    required_error_mm: float = 0.10  # e_required, on the estimate's own error at the work point
    minimum_scans: int = 6
    maximum_scans: int = 10  # k_max, verification scans not counted
    verification_scans: int = 1
    verification_limit_mm: float = 0.5  # a larger error at the unseen pose holds the job
    cost: str = "translation"  # cost metric of Algorithm 1: translation, work_radius or translation_and_rotation
    work_radius_mm: float = 200.0  # section 4.2: how far from the flange centre a rotation counts
    cost_axes: list[str] = dc.field(default_factory=lambda: list(COST_AXES))  # of work_radius: those that matter
    table_z_m: float = 0.0
    clearance_m: float = 0.05
    work_point_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.05])  # where there is no workpiece


@dc.dataclass
class WorkpieceConfig:
    """The workpiece as its CAD says, and how far the real one is from that."""

    shape: str = "s"  # s, straight or l
    length_mm: float = 300.0
    pose_guess: PoseConfig = dc.field(default_factory=PoseConfig)  # X_BP as the fixture's drawing says
    bend_radius_mm: float | None = None  # bent over a cylinder of this radius, its axis across the plate
    located_by: str = "scan"  # scan: registered to its CAD; drawing: the fixture's drawing is believed
    placement_error: ErrorConfig = dc.field(default_factory=ErrorConfig)  # of the plate on the fixture
    groove_error: ErrorConfig = dc.field(default_factory=ErrorConfig)  # of the groove against the plate's datums
    hole_from_mm: float | None = (
        None  # from this arc length on the real groove has no walls, unseen by the scan: contact is lost
    )


@dc.dataclass
class ProcessConfig:
    """The arc as set at the power source, for the weld log; what is not given is not guessed."""

    name: str | None = None  # MAG, MIG, FCAW, MMA, SAW, TIG or plasma
    current_A: float | None = None
    voltage_V: float | None = None
    efficiency: float | None = None  # thermal efficiency k; without it the process's own of EN 1011-1
    wire_feed_m_min: float | None = None

    def process(self) -> WeldProcess:
        """The same, checked (WeldProcessError)."""
        return WeldProcess(self.name, self.current_A, self.voltage_V, self.efficiency, self.wire_feed_m_min)


@dc.dataclass
class PlanningConfig:
    """How the seam is planned from the workpiece's scan."""

    method: str = "cad"  # cad: the drawing laid over the scan; cloud: the groove found in the scan, no drawing
    search: str = "guess"  # of the drawing: guess, near workpiece.pose_guess; anywhere, over the whole scan
    start_m: list[float] | None = None  # a cloud's seam starts at the end nearest to this; null: nearest to the robot

    def planning_method(self) -> PlanningMethod:
        """The same for the planner; raises InputError for words it does not know."""
        x_y_z = None if self.start_m is None else (self.start_m[0], self.start_m[1], self.start_m[2])
        return PlanningMethod(self.method, self.search, x_y_z)


@dc.dataclass
class WeldingConfig:
    """The welding job."""

    speed_mm_s: float = 8.0
    deflection_mm: float = 2.0  # delta_d of Eq. 16
    axial_deflection_mm: float = 3.0
    clearance_mm: float = 25.0  # height above the seam where the approach ends
    seam_length_mm: float | None = None  # weld only this much of the seam
    process: ProcessConfig = dc.field(default_factory=ProcessConfig)
    law: str = "guarded"  # steering law: guarded, or one of the paper's for comparison (welding/servo/laws.py)


@dc.dataclass
class JobConfig:
    """Which parts of the job run; a part that is off is not attempted."""

    calibrate: bool = True
    weld: bool = True
    X_BC: PoseConfig | None = None  # a known calibration, where `calibrate` is off
    speed_factor: float = 1.0  # of the arm's moves, 0.05 to 1; the weld keeps its own speed
    maximum_time_s: float = 240.0  # at speed_factor 1


@dc.dataclass
class VisualizationConfig:
    """What Meshcat records."""

    recording_fps: float = 10.0
    cloud_points: int = 20000


@dc.dataclass
class Scenario:
    """One cell: arm, station drivers, calibration, workpiece, welding and job."""

    description: str = ""
    arm: str = "ur10e"
    kinematics: str | None = None  # a factory calibration in Universal Robots' kinematics.yaml schema
    flange: str = "iso9409-1-50-4-m6"  # of the arm
    tool: str = "welding"  # welding, pen or none
    robot: SimulatedUr | UrRtde | NoDevice = dc.field(default_factory=SimulatedUr)
    robot_2: SimulatedUr | NoDevice = dc.field(default_factory=NoDevice)
    scanner: RenderedScanner | NoDevice = dc.field(default_factory=RenderedScanner)
    finger_camera: RenderedFingerCamera | NoDevice = dc.field(default_factory=RenderedFingerCamera)
    wrist_camera: RenderedWristCamera | NoDevice = dc.field(default_factory=NoDevice)
    digitizer: SimulatedTablet | NoDevice = dc.field(default_factory=NoDevice)
    profiler: RenderedProfiler | NoDevice = dc.field(default_factory=NoDevice)
    profiler_job: ProfilerJob | None = None
    home_deg: list[float] = dc.field(default_factory=lambda: [0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
    calibration: CalibrationConfig = dc.field(default_factory=CalibrationConfig)
    mounting: MountingJob | None = None
    workpiece: WorkpieceConfig | None = None
    planning: PlanningConfig = dc.field(default_factory=PlanningConfig)
    welding: WeldingConfig = dc.field(default_factory=WeldingConfig)
    tablet: TabletConfig | None = None  # a visit to a tablet instead of the job
    job: JobConfig = dc.field(default_factory=JobConfig)
    visualization: VisualizationConfig = dc.field(default_factory=VisualizationConfig)


def scenario_names() -> list[str]:
    """Names of the scenarios that ship with weldcal."""
    return sorted(path.stem for path in SCENARIO_FOLDER.glob("*.yaml"))


def load_scenario(name: str, overrides: str = "") -> Scenario:
    """Load a scenario by name or path; `overrides` is a second YAML text merged on top.

    Raises:
        InputError: unknown name, unknown key, wrong type; the sentence says which.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else SCENARIO_FOLDER / f"{name}.yaml"
    if not path.is_file():
        raise InputError(
            f"There is no scenario '{name}': choose one of {', '.join(scenario_names())} or give a YAML file."
        )
    scenario = Scenario()
    for label, text in ((str(path.name), path.read_text(encoding="utf-8")), ("the overrides", overrides)):
        if not text.strip():
            continue
        try:
            scenario = yaml_load_typed(schema=Scenario, data=text, defaults=scenario)
        except Exception as error:  # Drake's loader raises several kinds, and not every text names the key
            what = " ".join(str(error).split())
            raise InputError(f"Scenario {label} cannot be read{_part_at_fault(text)}: {what}") from error
    check_scenario(scenario)
    return scenario


def _part_at_fault(text: str) -> str:
    """Which top-level part of a YAML text does not load by itself, as words for a sentence; empty where that is not clear."""
    parts = re.split(r"^(?=\w+ *:)", text, flags=re.MULTILINE)
    for part in filter(str.strip, parts):
        try:
            yaml_load_typed(schema=Scenario, data=part, defaults=Scenario())
        except Exception:  # the same loader as above: any failure names this part
            return f" at '{part.split(':')[0].strip()}'"
    return ""


def check_scenario(scenario: Scenario) -> None:
    """Refuse what no cell could do, before any work.

    Raises:
        InputError: one sentence that says what to change.
    """
    if scenario.arm not in DRAWN_ARMS:
        raise InputError(
            f"The cell is built round the {' or '.join(DRAWN_ARMS)}, whose shape its clearances are made for, not '{scenario.arm}'."
        )
    if isinstance(scenario.robot, NoDevice):
        raise InputError("A cell needs a robot: write robot: !SimulatedUr {} in the scenario.")
    asked = [name for name in ("tablet", "mounting", "profiler_job") if getattr(scenario, name) is not None]
    if len(asked) > 1:
        raise InputError(f"A scenario is one procedure: take {' or '.join(asked)} out of it, and make another of that.")
    check_tablet(scenario)
    if isinstance(scenario.scanner, NoDevice) and (scenario.job.calibrate or scenario.job.weld):
        raise InputError(
            "This job needs a scanner: write scanner: !RenderedScanner {} in the scenario or turn the job off."
        )
    check_numbers(scenario)
    check_mounting(
        scenario.calibration.configuration,
        scenario.mounting,
        "base" if isinstance(scenario.scanner, NoDevice) else scenario.scanner.mounted_on,
        simulated=isinstance(scenario.robot, SimulatedUr),
        second_robot=not isinstance(scenario.robot_2, NoDevice),
        weld=scenario.job.weld,
    )
    scenario.welding.process.process()
    scenario.planning.planning_method()
    if not SLOWEST_FACTOR <= scenario.job.speed_factor <= 1.0:
        raise InputError(
            f"job.speed_factor must be from {SLOWEST_FACTOR:g} to 1, and it is {scenario.job.speed_factor:g}."
        )
    calibration = scenario.calibration
    if calibration.feature not in ("tool_ring", "flange"):
        raise InputError(f"calibration.feature must be tool_ring or flange, not '{calibration.feature}'.")
    named_cost(calibration.cost, 1e-3 * calibration.work_radius_mm, calibration.cost_axes)
    if scenario.tool not in ("welding", "pen", "none"):
        raise InputError(f"tool must be welding, pen or none, not '{scenario.tool}'.")
    if (calibration.feature == "tool_ring") != (scenario.tool == "welding"):
        raise InputError("calibration.feature tool_ring goes with tool: welding, and flange with tool: none.")
    if not 4 <= calibration.minimum_scans <= calibration.maximum_scans:
        raise InputError("calibration.minimum_scans must be at least 4 and not above calibration.maximum_scans.")
    if scenario.job.weld and (
        scenario.workpiece is None or scenario.tool == "none" or isinstance(scenario.finger_camera, NoDevice)
    ):
        raise InputError("A weld needs a workpiece, tool: welding and a finger_camera in the scenario.")
    get_law(scenario.welding.law)
    if isinstance(scenario.profiler, RenderedProfiler):
        scenario.profiler.preset()
    check_profiler_job(
        scenario.profiler_job,
        has_profiler=not isinstance(scenario.profiler, NoDevice),
        has_groove=scenario.workpiece is not None,
        tool=scenario.tool,
    )
    if scenario.workpiece is not None and scenario.workpiece.located_by not in ("scan", "drawing"):
        raise InputError(f"workpiece.located_by must be scan or drawing, not '{scenario.workpiece.located_by}'.")
    if scenario.job.weld and not scenario.job.calibrate and scenario.job.X_BC is None:
        raise InputError("A weld without calibrating first needs job.X_BC, the known pose of the scanner in the base.")
