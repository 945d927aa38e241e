"""weldcal check-cell: looks at every device of a scenario and says what to do. Nothing moves."""

import dataclasses as dc
import inspect
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from weldcal.calibration.errors import FlangeNotFound, UnreachableScanner
from weldcal.calibration.flange.fit import FlangeGuess, fit_flange
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.systems.drivers.config import DEVICES, DriverConfig, FingerCameraConfig, NoDevice
from weldcal.systems.drivers.sensors.preflight import Sensed
from weldcal.systems.drivers.sensors.wired_camera import WiredFingerCamera
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.drivers.ur.faults import RobotUnreachable
from weldcal.systems.drivers.ur.readiness.preflight import Check, Preflight, preflight
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.drivers.ur.wire.rtde_client import RtdeProbe
from weldcal.systems.jobs.weld.settings import feature_standard, plan_poses
from weldcal.systems.pacing import measure_host
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import nominal_arm
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.options import LOOK, Call, Outcome, command
from weldcal.tools.commands.controllers import emit_table, state_of
from weldcal.welding.finger.deformation import TagModel, detect_tag

LOOKED_AT = tuple(name for name in DEVICES if name not in ("robot", "robot_2"))
LEAST_FREE_GB = 2.0  # the scans, the log and the recording of a job take less
BLURRED_PX = 4.0  # of the tag's edges from black to white
LONGEST_LOOK_S = 3.0  # of a simulated sensor
_FIRST = Path()


@command("check-cell", common=LOOK, short_help="Check every device of a scenario. Nothing moves.")
def check_cell(
    call: Call,
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="Name of a scenario, or path of its YAML file.")],
) -> Outcome:
    """Look at robot, scanner, finger camera, torch output and computer: each is ok, or what to do. Nothing moves."""
    report = look_at_cell(load_scenario(scenario), scenario, progress=call.progress)
    rows = tuple(
        check if device == check.name else replace(check, name=f"{device.replace('_', ' ')}: {check.name}")
        for device, check in report.rows
    )
    table = Preflight(host=report.name, checks=rows)
    return Outcome(report.summary(), text=partial(emit_table, table), problem=report.first_problem)


@dataclass(frozen=True, eq=False)
class CellReport:
    """The rows of the table, each with its device, and the name of the scenario."""

    name: str
    rows: tuple[tuple[str, Check], ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is to be changed."""
        return all(check.ok for _, check in self.rows)

    @property
    def first_problem(self) -> str:
        """What to do first; empty where nothing is to be changed."""
        return next((check.operator_action for _, check in self.rows if check.checked and not check.ok), "")

    def summary(self) -> Mapping[str, object]:
        """Return the JSON object of the command."""
        return {
            "state": "ready" if self.ok else "refused",
            "reason": self.first_problem,
            "devices": [
                {
                    "device": device,
                    "check": check.name,
                    "state": state_of(check),
                    "found": check.found,
                    "remedy": check.operator_action,
                }
                for device, check in self.rows
            ],
        }


def look_at_cell(
    scenario: Scenario, name: str, seed: int = 0, progress: Callable[[str, float], None] | None = None
) -> CellReport:
    """Look at the robot, then at each sensor, at the torch's output and at this computer.

    A simulated device is looked at in a simulation that moves nothing. A sensor that cannot be used is a row, not an
    exception.
    """
    tell = progress or (lambda stage, fraction: None)
    tell("robot", 0.0)
    q = _stands_at(scenario, seed)
    rows, X_BF = _robot(scenario, q)
    for k, device in enumerate(LOOKED_AT):
        config: DriverConfig = getattr(scenario, device)
        if isinstance(config, NoDevice):
            continue
        tell(device.replace("_", " "), (k + 1) / (len(LOOKED_AT) + 2))
        sensed = _sensed(scenario, device, config, seed, q)
        rows += [(device, check) for check in sensed.checks]
        if device == "scanner" and sensed.datum is not None:
            rows.append((device, _flange(scenario, sensed.datum, X_BF)))
        if device == "finger_camera" and sensed.datum is not None and isinstance(config, FingerCameraConfig):
            rows.append((device, _tag(scenario, config, sensed.datum)))
    tell("computer", 0.95)
    return CellReport(name, (*rows, *_torch(scenario), *_computer()))


def _stands_at(scenario: Scenario, seed: int) -> Array:
    """Return joints (6,) rad of a simulated arm: at the best calibration pose of a simulated scanner, else at home."""
    home: Array = np.deg2rad(scenario.home_deg)
    simulated = scenario.robot.SIMULATED and scenario.scanner.SIMULATED
    if not simulated or not scenario.job.calibrate or scenario.calibration.configuration != "eye_on_base":
        return home
    station = make_station(_alone(scenario, "scanner"), seed)
    try:
        return plan_poses(scenario, station, seed)[0].q
    except UnreachableScanner:
        return home
    finally:
        station.close()


def _alone(scenario: Scenario, device: str) -> Scenario:
    """Return the scenario with this sensor and a simulated arm only."""
    left_out: dict[str, Any] = {name: NoDevice() for name in LOOKED_AT if name != device}
    robot = scenario.robot if scenario.robot.SIMULATED else SimulatedUr()
    return dc.replace(scenario, robot=robot, **left_out)


def _robot(scenario: Scenario, q: Array) -> tuple[list[tuple[str, Check]], RigidTransform | None]:
    """Return the robot's checks, and the pose of its flange where it could be read."""
    config = scenario.robot
    arm = nominal_arm(scenario)
    if isinstance(config, UrRtde):
        report = preflight(
            config.host,
            upper_registers=config.upper_registers,
            nominal=arm,
            load=config.load(),
            set_points=config.set_points,
        )
        X_BF = None if report.arm is None or report.arm_q is None else forward_kinematics(report.arm, report.arm_q)
        return [("robot", check) for check in report.checks], X_BF
    if config.SIMULATED:
        at = "at home" if np.allclose(q, np.deg2rad(scenario.home_deg)) else "at a calibration pose"
        return [("robot", Check("robot", True, f"simulated, {at}"))], forward_kinematics(arm, q)
    return [("robot", _unknown("robot", config))], None


def _unknown(name: str, config: DriverConfig) -> Check:
    return Check(name, False, f"the driver {type(config).__name__} has no preflight", checked=False)


def _sensed(scenario: Scenario, device: str, config: DriverConfig, seed: int, q: Array) -> Sensed:
    """What a sensor shows: by its driver's preflight, or, where it is simulated, in a simulation that moves nothing."""
    look = getattr(inspect.getmodule(type(config)), "preflight", None)
    if look is None and config.SIMULATED:
        look = partial(_simulated, scenario, device, seed, q)
    if look is None:
        return Sensed((_unknown(device.replace("_", " "), config),))
    if isinstance(scenario.robot, UrRtde) and isinstance(config, WiredFingerCamera):
        # an emulated cell's camera runs at the emulator's pace, which is 1 for a robot
        config = dc.replace(config, rate_hz=config.rate_hz * scenario.robot.pace)
    try:
        found: Sensed = look(config)
    except WeldcalError as error:
        return Sensed((Check(device.replace("_", " "), False, "cannot be used", str(error)),))
    return found


def _simulated(scenario: Scenario, device: str, seed: int, q: Array, config: DriverConfig) -> Sensed:
    """One scan or picture of a simulated sensor, with every other sensor left out."""
    ask, port = {"scanner": ("trigger", "scan"), "finger_camera": ("streaming", "image")}.get(device, ("", ""))
    if not ask:  # a part of a job's furnishing
        return Sensed((Check(device.replace("_", " "), True, "simulated"),))
    arm = nominal_arm(scenario)
    station = make_station(_alone(scenario, device), seed, PreparedRobot(arm, q))
    try:
        if not station.diagram.HasOutputPort(f"{device}.{port}"):
            return Sensed((Check(device.replace("_", " "), True, "simulated"),))
        simulator = Simulator(station.diagram)
        context = simulator.get_mutable_context()
        for k in range(station.diagram.num_input_ports()):
            station.diagram.get_input_port(k).FixValue(context, np.zeros(station.diagram.get_input_port(k).size()))
        station.diagram.GetInputPort(f"{device}.{ask}").FixValue(context, [1.0])
        output = station.diagram.GetOutputPort(f"{device}.{port}")
        while (found := output.Eval(context)).sequence == 0 and context.get_time() < LONGEST_LOOK_S:
            simulator.AdvanceTo(context.get_time() + 0.05)
        datum: Any = found.points_C if device == "scanner" else found.pixels
        return Sensed((Check(port, bool(found.sequence), "simulated"),), datum if found.sequence else None)
    finally:
        station.close()


def _flange(scenario: Scenario, points_C: Array, X_BF: RigidTransform | None) -> Check:
    """Check that the calibration's feature is in a scan, near where arm and nominal scanner put it."""
    standard, on_tool = feature_standard(scenario), scenario.calibration.feature == "tool_ring"
    loaded = scenario.loaded_tool()
    guess = None
    if X_BF is not None and scenario.calibration.configuration == "eye_on_base":
        X_BR = X_BF @ (loaded.tool.X_FR if on_tool and loaded is not None else RigidTransform())
        X_CR = scenario.calibration.mounting_guess.pose().InvertAndCompose(X_BR)
        radius = 1e-3 * scenario.calibration.guess_radius_mm + 0.5 * standard.outer_m
        guess = FlangeGuess(X_CR.translation(), radius, X_CR.rotation().matrix()[:, 2])
    feature = "the tool's ring" if on_tool else "the flange"
    try:
        fit = fit_flange(np.asarray(points_C, dtype=float), standard, guess=guess)
    except FlangeNotFound as error:
        action = (
            f"{error} Jog the arm until {feature} faces the scanner in its range, or correct"
            " calibration.mounting_guess."
        )
        return Check("flange", False, f"{feature} is not in the scan", action)
    middle = fit.center_C
    found = f"{feature} is {np.linalg.norm(middle):.3f} m away"
    if guess is not None:
        found += f", {1e3 * np.linalg.norm(middle - guess.center_C):.0f} mm from where mounting_guess puts it"
    return Check("flange", True, found)


def _tag(scenario: Scenario, config: FingerCameraConfig, picture: Array) -> Check:
    """Return whether the tag is in a picture, and how sharp its edges are."""
    loaded = scenario.loaded_tool()
    tool = (load_tool(WELDING) if loaded is None else loaded).tool
    tag = TagModel(tool.tag_dictionary, tool.tag_id, tool.tag_size_m)
    pixels = np.asarray(picture, dtype=np.uint8)
    seen = detect_tag(pixels, config.camera().camera_matrix, tag)
    if not seen.valid or seen.corners is None or seen.X_KM is None:
        action = (
            f"The finger camera does not see tag {tag.id} of {tag.dictionary}: {seen.reason.rstrip('.')}. Clean lens"
            " and tag, look at exposure and focus, and print the tag with weldcal print-board."
        )
        return Check("tag", False, "not seen", action)
    blur = edge_width_px(pixels, seen.corners)
    far = float(np.linalg.norm(seen.X_KM.translation()))
    found = f"seen at {1e3 * far:.1f} mm, its edges {blur:.1f} px wide, corners within {seen.reprojection_px:.2f} px"
    action = f"The tag's edges are {blur:.1f} px wide: focus the finger camera, or shorten its exposure."
    return Check("tag", blur <= BLURRED_PX, found, "" if blur <= BLURRED_PX else action)


def edge_width_px(picture: NDArray[np.uint8], corners: Array) -> float:
    """Width (px) of a picture's edges around `corners` (4, 2): their contrast over their steepest slope."""
    low, high = np.floor(corners.min(axis=0)).astype(int) - 4, np.ceil(corners.max(axis=0)).astype(int) + 5
    window = picture[max(low[1], 0) : high[1], max(low[0], 0) : high[0]].astype(np.float32)
    slopes = np.hypot(cv2.Sobel(window, cv2.CV_32F, 1, 0), cv2.Sobel(window, cv2.CV_32F, 0, 1)) / 8.0
    dark, bright = np.percentile(window, (5.0, 95.0))
    return float((bright - dark) / max(float(np.percentile(slopes, 95.0)), 1e-6))


def _torch(scenario: Scenario) -> list[tuple[str, Check]]:
    """Return whether the torch's output is off."""
    config = scenario.robot
    if not isinstance(config, UrRtde) or config.process_output is None:
        return []
    try:
        with RtdeProbe(config.host) as probe:
            bits = probe.read(("actual_digital_output_bits",)).get("actual_digital_output_bits")
    except RobotUnreachable:
        return [("torch", Check("output", False, "needs robot", checked=False))]
    if bits is None:
        action = "The controller does not report its digital outputs: use PolyScope 5.12 or newer."
        return [("torch", Check("output", False, "not readable", action))]
    on = bool(int(np.asarray(bits).item()) >> config.process_output & 1)
    action = (
        f"Digital output {config.process_output} is on: turn it off at the pendant, and look at what is wired to it."
    )
    found = f"digital output {config.process_output} is {'on' if on else 'off'}"
    return [("torch", Check("output", not on, found, action if on else ""))]


def _computer() -> list[tuple[str, Check]]:
    timing = measure_host()
    free = shutil.disk_usage(_FIRST.absolute()).free / 1e9
    action = f"Only {free:.1f} GB are free here: make room, or write results elsewhere with --out."
    return [
        ("computer", Check("timing", timing.ok, timing.words, "" if timing.ok else timing.advice)),
        (
            "computer",
            Check("disk", free >= LEAST_FREE_GB, f"{free:.0f} GB free", "" if free >= LEAST_FREE_GB else action),
        ),
    ]
