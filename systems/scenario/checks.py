"""Checks a scenario before anything is built; each error is one sentence that says what to change."""

import dataclasses as dc
import math
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

import numpy as np

from weldcal.calibration.calibrate import LIVE_KINDS, PLAIN
from weldcal.calibration.refinement.kinematics_choice import LEAST as LEAST_OF_ARM
from weldcal.calibration.refinement.local_field import LEAST as LEAST_OF_FIELD
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.errors import InputError
from weldcal.models.robots import get_robot
from weldcal.models.workpieces.reading import LARGEST_SIZE_M
from weldcal.systems.drivers.config import NoDevice, check_range
from weldcal.systems.jobs.job import job_of
from weldcal.systems.jobs.mounting.config import MountingJob, check_mounting
from weldcal.systems.scenario.parts import check_workpiece
from weldcal.systems.scenario.schema import PoseConfig, Scenario, ToolFile
from weldcal.welding.locate.part.fit_up import SHOWN_BY
from weldcal.welding.record.schedule import VALUES

POSITIVE = {
    *("required_error_mm", "theta_max_deg", "guess_radius_mm", "verification_limit_mm", "clearance_m", "clearance_mm"),
    *(
        "speed_mm_s",
        "deflection_mm",
        "axial_deflection_mm",
        "seam_length_mm",
        "tolerance_mm",
        "X_BC_sigma_mm",
        "length_mm",
        "hole_from_mm",
        "bend_radius_mm",
        "on_mm",
        "height_mm",
        "off_mm",
    ),
    *("maximum_time_s", "control_period_s", "following_error_rad"),
    *("pace", "velocity_share", "spread_deg", "travel_deg"),
    *("rate_hz", "focal_px", "field_of_view_deg", "width", "height", "recording_fps", "cloud_points"),
}
NOT_NEGATIVE = {
    *("exposure_s", "latency_s", "noise_grey", "hidden_from_s", "knock_s", "verification_scans", "payload_kg"),
    *("repeatability_mm", "from_mm", "kinematic_error_mm", "warp_mm"),
    *("interpass_s", "translation_mm", "rotation_deg", "mounting_translation_mm", "mounting_rotation_deg"),
    *("placement_translation_mm", "placement_rotation_deg", "margin_m"),
}
LENGTHS = {
    "xyz_m": 3,
    "rpy_deg": 3,
    "work_point_m": 3,
    "start_m": 3,
    "home_deg": 6,
    "payload_cog_m": 3,
    "box_m": 3,
    "gradient_error_per_m": 2,
    "knock_mm": 3,
    "knock_deg": 3,
}


LARGEST = {
    "width": 4096, "height": 4096, "samples": 8192, "recording_fps": 60, "cloud_points": 1_000_000,
    "maximum_scans": 200,
    "minimum_scans": 200, "verification_scans": 200, "scans": 500, "held_out": 500, "touches": 500, "passes": 50,
    "columns": 100,
    "rows": 100, "length_mm": 3000, "seam_length_mm": 3000, "maximum_time_s": 86_400, "rate_hz": 1000,
    "focal_px": 100_000,
    "hole_from_mm": 3000, "theta_max_deg": 89, "speed_mm_s": 500, "control_period_s": 1, "exposure_s": 60,
    "latency_s": 10,
}  # fmt: skip
"""Largest value of a key, in any part of a scenario."""
LARGEST_OF_UNIT = {
    "_mm": 100_000,
    "_m": 100,
    "_deg": 36_000,
    "_rad": 1000,
    "_s": 1_000_000,
    "_px": 100_000,
    "_mm_s": 10_000,
    "_kg": 10_000,
    "_per_m": 1e9,
    "_Hz": 10_000,
    "_hz": 10_000,
}
"""Largest size of any other key that names its unit; the longest unit counts."""
LARGEST_AT_ALL = 1e9  # a choice: beyond any quantity of a cell in any unit, and its cube is still finite
"""Largest size of any number."""


def largest(name: str) -> float:
    """The largest size that the value of a key of this name may have."""
    units = sorted((u for u in LARGEST_OF_UNIT if name.endswith(u)), key=len)
    return LARGEST.get(name, LARGEST_OF_UNIT[units[-1]] if units else LARGEST_AT_ALL)


def check_numbers(config: Any, place: str = "") -> None:
    """Check all numbers in a tree of configuration dataclasses.

    Raises:
        InputError: a number (or list of numbers) is invalid; the message names the first such key.
    """
    for field in dc.fields(config):
        value, key = getattr(config, field.name), f"{place}{field.name}"
        if dc.is_dataclass(value):
            check_numbers(value, f"{key}.")
            continue
        if isinstance(value, list) and value and all(dc.is_dataclass(item) for item in value):
            for k, item in enumerate(value):
                check_numbers(item, f"{key}[{k}].")
            continue
        _check_type(key, field.type, value)
        if isinstance(value, list) and len(value) != LENGTHS.get(field.name, len(value)):
            raise InputError(f"{key} must hold {LENGTHS[field.name]} numbers, not {len(value)}.")
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check(key, field.name, number)


def _check_type(key: str, kind: Any, value: Any) -> None:
    """Refuses a word where a number belongs.

    Drake's YAML reader converts plain types, and leaves an optional one as it was.
    """
    kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
    if value is None and NoneType not in kinds:
        raise InputError(f"{key} has no value; write one, or omit the key.")
    if isinstance(value, str) and str not in kinds and any(k in (int, float, bool) for k in kinds):
        raise InputError(f"{key} must be a number, not '{value}'.")
    listed = next((get_args(k) for k in kinds if get_origin(k) is list), None)
    if isinstance(value, list) and listed in ((float,), (int,)) and not all(isinstance(v, int | float) for v in value):
        raise InputError(f"{key} must hold numbers, not {value}.")
    if isinstance(value, float) and float not in kinds and int in kinds and not value.is_integer():
        raise InputError(f"{key} must be a whole number, not {value:g}.")


def _check(key: str, name: str, number: float) -> None:
    if abs(number) > LARGEST_AT_ALL and math.inf > abs(number):  # a whole number may be too long to be printed
        raise InputError(f"{key} is beyond {LARGEST_AT_ALL:g}.")
    if not math.isfinite(number):
        raise InputError(f"{key} must be finite, not {number}.")
    if abs(number) > largest(name):
        bound = f"at most {largest(name):g}" if number > 0.0 else f"at least {-largest(name):g}"
        raise InputError(f"{key} is {number:g}; it may be {bound}.")
    if name in POSITIVE and number <= 0.0:
        raise InputError(f"{key} must be a positive number, not {number:g}.")
    if name in NOT_NEGATIVE and number < 0.0:
        raise InputError(f"{key} must not be negative, and it is {number:g}.")


def check_home(home_deg: list[float], arm: str, key: str = "home_deg") -> None:
    """Check that an arm can be at home; `key` is the scenario's name of ``home_deg`` (6,).

    Raises:
        InputError: a joint is outside its limits; the message names the first one.
    """
    model = load_arm(arm)
    limits = np.degrees([model.position_lower, model.position_upper]).T
    for joint, (angle, (low, high)) in enumerate(zip(home_deg, limits, strict=True), start=1):
        if not low <= angle <= high:
            raise InputError(
                f"{key} puts joint {joint} of the {arm} at {angle:g} deg, and its limits are {low:g} to {high:g} deg:"
                " give an angle between them."
            )


SLOWEST_FACTOR = 0.05  # a choice: a job of 1 min takes 20 min at it; a smaller factor is more likely a typing error
MASS_TOLERANCE_KG = 0.05  # as the pre-flight compares a payload
BEYOND_REACH_M = 0.7  # torch and half a plate add less than this to an arm's reach


def check_arm(scenario: Scenario) -> None:
    """Check that the scenario's arm can be simulated and driven, and that it carries its tool.

    Raises:
        InputError: another arm than Universal Robots', or a tool heavier than its payload.
    """
    if scenario.arm not in known_arms():
        raise InputError(
            f"A cell runs with an arm of Universal Robots: {', '.join(known_arms())}; '{scenario.arm}' is none of them."
            " Other arms, and a URDF, serve recorded data and plans: weldcal calibrate DATASET, and weldcal hand-eye or"
            " plan-poses with --robot my_arm.urdf."
        )
    payload, robot = get_robot(scenario.arm).payload_kg, scenario.robot
    told = getattr(robot, "payload_kg", None)
    if told is not None and told > payload:
        raise InputError(
            f"robot.payload_kg is {told:g} kg, and the payload of a {scenario.arm} is {payload:g} kg: take a stronger"
            " arm or a lighter tool."
        )
    loaded = scenario.loaded_tool()
    mass = 0.0 if loaded is None else loaded.tool.mass_kg
    if isinstance(scenario.tool, ToolFile) and told is not None and abs(told - mass) > MASS_TOLERANCE_KG:
        raise InputError(
            f"robot.payload_kg is {told:g} kg, and the tool of {scenario.tool.file} weighs {mass:g} kg: make them"
            " equal."
        )
    if mass > payload:
        raise InputError(
            f"The tool weighs {mass:g} kg, and the payload of a {scenario.arm} is {payload:g} kg: take a stronger arm"
            " or a lighter tool."
        )


def check_inputs(scenario: Scenario) -> None:
    """Check that no digital input of the controller is to show two things.

    Raises:
        InputError: it names the two.
    """
    probe, robot = scenario.touch_probe, scenario.robot
    keys = {f"robot.{name}": getattr(robot, name, None) for name in ("arc_input", "arc_fault_input")}
    if getattr(probe, "host", "") == getattr(robot, "host", None):
        keys["touch_probe.input"] = getattr(probe, "input", None)
    seen: dict[int, str] = {}
    for key, number in keys.items():
        if number is not None and number in seen:
            raise InputError(f"{seen[number]} and {key} are both digital input {number}: wire them to two inputs.")
        if number is not None:
            seen[number] = key


def check_refinement(scenario: Scenario) -> None:
    """Check that the live calibration can be refined as the scenario wants it.

    Raises:
        InputError: an unknown refinement, or too few scans for it.
    """
    c = scenario.calibration
    if c.refine not in LIVE_KINDS:
        raise InputError(
            f"calibration.refine must be {', '.join(LIVE_KINDS[:-1])} or {LIVE_KINDS[-1]}, not '{c.refine}'."
        )
    least = {PLAIN: 0, "local": LEAST_OF_FIELD}.get(c.refine, LEAST_OF_ARM)
    if c.minimum_scans < least:
        raise InputError(
            f"calibration.refine: {c.refine} needs {least} scans and more: raise calibration.minimum_scans"
            f" ({c.minimum_scans}) to {least}, and maximum_scans with it."
        )


def check_order(scenario: Scenario) -> None:
    """Check the order of the weld, and that what its limits are compared with will be known.

    Raises:
        InputError: an invalid value, or a limit of something that nothing measures or states.
    """
    welding = scenario.welding
    process, limits, schedule = dc.replace(welding.process), welding.order.limits, welding.schedule
    welding.order.check()
    stated = {process.current_A is not None} | {bool(schedule and schedule.current_A and schedule.voltage_V)}
    for name in ("heat_input_kJ_mm", "current_A", "voltage_V"):
        if getattr(limits, name) is not None and isinstance(scenario.power_source, NoDevice) and True not in stated:
            raise InputError(
                f"welding.order.limits.{name} needs the arc's current and voltage: write power_source, or"
                " current_A and voltage_V under welding.process as they are set by hand."
            )
    if limits.heat_input_kJ_mm is not None and process.k is None:
        raise InputError(
            "welding.order.limits.heat_input_kJ_mm needs the process: write welding.process.name, such as MAG, or"
            " welding.process.efficiency."
        )


def check_schedule(scenario: Scenario) -> None:
    """Check the welding schedule.

    Raises:
        InputError: an invalid value, or a table by gap for a seam whose gap is not measured.
    """
    schedule, spec = scenario.welding.schedule, scenario.workpiece
    if scenario.robot.reports_arc and scenario.power_source.reports_arc:
        raise InputError("robot.arc_input and power_source both report the arc: leave out robot.arc_input.")
    if schedule is None:
        return
    schedule.check(scenario.welding.arc.crater_s)
    taken = {*scenario.power_source.takes, *scenario.robot.takes}
    wanted = [name for name in VALUES if schedule.extremes(name)] + ["job"] * (schedule.job is not None)
    if missing := [name for name in wanted if name not in taken]:
        raise InputError(
            f"welding.schedule sets {missing[0]}, and nothing passes it on: write power_source with a register for it,"
            " or wire robot.wire_feed and robot.arc_voltage."
        )
    for driver in (scenario.power_source, scenario.robot):
        driver.check_schedule(schedule)
    measured = spec is not None and spec.file is not None and spec.located_by == "scan"
    if schedule.by_gap and not (measured and spec is not None and "gap" in SHOWN_BY.get(spec.joint or "", ())):
        raise InputError(
            "welding.schedule.by_gap needs a joint whose gap is measured in the scan: a butt, fillet or lap of a part"
            " from a file (workpiece.file, located_by: scan)."
        )


def check_tack_order(scenario: Scenario) -> None:
    """Check the tacks against the seams.

    Raises:
        InputError: a tack without a length or a seam, or tacks where the seam is interrupted.
    """
    welding, spec = scenario.welding, scenario.workpiece
    seams = 1 if spec is None else max(1, len(spec.seams))
    for k, tack in enumerate(welding.tacks):
        if not tack.from_mm < tack.to_mm:
            raise InputError(
                f"welding.tacks[{k}].to_mm is {tack.to_mm:g}, and from_mm {tack.from_mm:g}: it must be larger."
            )
        if not 1 <= tack.seam <= seams:
            raise InputError(f"welding.tacks[{k}].seam is {tack.seam}, and the part has seams 1 to {seams}.")
    if welding.tacks and welding.pass_obstacles:
        raise InputError("welding.tacks goes without welding.pass_obstacles; leave out one of them.")


def check_seam_order(scenario: Scenario) -> None:
    """Check the order of the seams and of their pieces; raises InputError."""
    welding = scenario.welding
    for name, known in (("seam_order", ("given", "least_travel")), ("between_seams", ("home", "direct"))):
        if getattr(welding, name) not in known:
            raise InputError(f"welding.{name} must be {' or '.join(known)}, not '{getattr(welding, name)}'.")
    middle_out = welding.stitch is not None and welding.stitch.stitch().middle_out
    if middle_out and (welding.tacks or welding.passes or welding.pass_obstacles):
        raise InputError("welding.stitch.order: middle_out goes without welding.tacks, passes and pass_obstacles.")
    if welding.seam_order == "least_travel" and welding.between_seams == "home":
        raise InputError(
            "welding.seam_order: least_travel saves nothing where the arm goes home after each seam: write"
            " welding.between_seams: direct."
        )


def check_angles_order(scenario: Scenario) -> None:
    """Check the ordered angles of the wire.

    Raises:
        InputError: a list that is not of two angles, a stick-out of no length, or another key that turns the tool.
    """
    welding, spec = scenario.welding, scenario.workpiece
    orders = [welding.angles] + ([] if spec is None else [seam.angles for seam in spec.seams])
    for order in orders:
        if order is None:
            continue
        for name in ("work_angle_deg", "travel_angle_deg", "wire_rotation_deg"):
            order.ends_rad(name)
        if order.stick_out_mm is not None:
            check_range("angles.stick_out_mm", order.stick_out_mm, 3.0, 40.0)  # a choice: of any arc with a wire
        if welding.lean_deg:
            raise InputError("Ordered angles go with welding.lean_deg: 0; leave out the other.")


def check_devices(scenario: Scenario, key: str) -> None:
    """Check that scanner, second robot, tool and profiler belong to the job with this key.

    Raises:
        InputError: one sentence that says what to change.
    """
    scanner = scenario.scanner_config()
    if key in ("mounting", "profiler_job", "tablet") and scanner is not None and scanner.stream_delay_s() is not None:
        raise InputError(
            "A scanner that streams, such as !StreamingScanner, belongs to a motion job or to the weld job: write"
            " motion: {} or another scanner."
        )
    check_mounting(
        scenario.calibration.configuration,
        scenario.part(MountingJob),
        "base" if scanner is None else scanner.mounted_on,
        second_robot=not isinstance(scenario.robot_2, NoDevice),
        weld=scenario.job.weld,
    )
    if key != "profiler_job" and not isinstance(scenario.profiler, NoDevice):
        raise InputError("A profiler needs a job: write profiler_job: {} in the scenario.")
    if key != "tablet" and scenario.tool == "pen":
        raise InputError("A pen touches a tablet: write tablet: {} in the scenario, or another tool.")


def check_scan_poses(scenario: Scenario) -> None:
    """Check the scan poses of the workpiece, and that the pose of a scanner on the flange is known.

    Raises:
        InputError: one sentence that says what to change.
    """
    job, poses, scanner = scenario.job, scenario.planning.scan_poses_deg, scenario.scanner_config()
    on_flange = scanner is not None and scanner.mounted_on == "flange"
    if poses and not on_flange:
        raise InputError(
            "planning.scan_poses_deg is for a scanner on the flange (scanner.mounted_on: flange). A scanner beside the"
            " arm has one view: remove the list, or let the arm carry the scanner."
        )
    if on_flange and job.weld and (job.calibrate or job.X_FC is None):
        nominal = scenario.calibration.mounting_guess
        raise InputError(
            "A weld with the scanner on the flange needs its pose there. Calibrate with the scenario eye_in_hand first."
            f" Then write, with its numbers: job: {{calibrate: false, X_FC: {{xyz_m: {nominal.xyz_m}, rpy_deg:"
            f" {nominal.rpy_deg}}}}}"
        )
    if len(poses) > 1 and (scenario.workpiece is None or scenario.workpiece.file is None):
        raise InputError(
            "planning.scan_poses_deg: several poses are for a part from a file; write one pose for a plate."
        )
    for k, pose in enumerate(poses):
        if len(pose) != 6:
            raise InputError(f"planning.scan_poses_deg[{k}] must hold 6 angles, not {len(pose)}.")
        check_home(pose, scenario.arm, f"planning.scan_poses_deg[{k}]")


def check_scenario(scenario: Scenario) -> None:
    """Check the parts of a scenario against each other.

    Raises:
        InputError: one sentence that says what to change.
    """
    check_arm(scenario)
    if isinstance(scenario.robot, NoDevice):
        raise InputError("A cell needs a robot: write robot: !SimulatedUr {} in the scenario.")
    found = job_of(scenario)  # raises for the parts of two jobs
    check_numbers(scenario)
    check_home(scenario.home_deg, scenario.arm)
    check_inputs(scenario)
    if found.key and scenario.base != PoseConfig():
        raise InputError(
            f"A {found.key} job runs with the robot's base upright at the world's origin only: leave out base, or"
            " calibrate with the default job (job.weld: false)."
        )
    check_devices(scenario, found.key)
    check_scan_poses(scenario)
    found.check(scenario)
    if not found.key and not scenario.job.calibrate and not scenario.job.weld:
        raise InputError("This scenario has nothing to do: set job.calibrate or job.weld to true.")
    if isinstance(scenario.scanner, NoDevice) and (scenario.job.calibrate or scenario.job.weld):
        raise InputError(
            "This job needs a scanner: write scanner: !RenderedScanner {} in the scenario or turn the job off."
        )
    check_order(scenario)
    if scenario.welding.weave is not None:
        scenario.welding.weave.weave()
    scenario.welding.arc.check(scenario.reports_arc)
    check_schedule(scenario)
    if scenario.welding.later_passes() and scenario.welding.pass_obstacles:
        raise InputError("welding.passes goes without welding.pass_obstacles; leave out one of them.")
    check_tack_order(scenario)
    check_seam_order(scenario)
    check_angles_order(scenario)
    if scenario.welding.stitch is not None:
        scenario.welding.stitch.stitch().check(1e-3 * scenario.welding.speed_mm_s)
    dc.replace(scenario.planning)
    check_range("job.speed_factor", scenario.job.speed_factor, SLOWEST_FACTOR, 1.0)
    calibration = scenario.calibration
    if calibration.feature not in ("tool_ring", "flange"):
        raise InputError(f"calibration.feature must be tool_ring or flange, not '{calibration.feature}'.")
    if isinstance(scenario.tool, str) and scenario.tool not in ("welding", "pen", "none"):
        raise InputError(f"tool must be welding, pen, none or {{file: my_tool.yaml}}, not '{scenario.tool}'.")
    loaded = scenario.loaded_tool()
    ring = loaded is not None and loaded.tool.ring is not None
    if loaded is not None and not ring and calibration.feature == "tool_ring":
        raise InputError(f"The tool of {loaded.file.name} has no ring to measure: write calibration.feature: flange.")
    if (calibration.feature == "tool_ring") != ring:
        raise InputError("calibration.feature tool_ring goes with tool: welding, and flange with tool: none.")
    if not 4 <= calibration.minimum_scans <= calibration.maximum_scans:
        raise InputError("calibration.minimum_scans must be at least 4 and not above calibration.maximum_scans.")
    check_refinement(scenario)
    if scenario.job.weld and (
        scenario.workpiece is None or scenario.tool == "none" or isinstance(scenario.finger_camera, NoDevice)
    ):
        raise InputError("A weld needs a workpiece, tool: welding and a finger_camera in the scenario.")
    if not 0.0 <= scenario.welding.lean_deg <= 10.0:
        raise InputError(f"welding.lean_deg must be from 0 to 10, not {scenario.welding.lean_deg:g}.")
    if scenario.welding.posture not in ("home", "any"):
        raise InputError(f"welding.posture must be home or any, not '{scenario.welding.posture}'.")
    workpiece, farthest = scenario.workpiece, get_robot(scenario.arm).reach_m + BEYOND_REACH_M
    if workpiece is not None:
        check_workpiece(workpiece)
    # The frame of a part from a file may lie as far from it as the largest part is long.
    beyond = farthest if workpiece is None or workpiece.file is None else farthest + LARGEST_SIZE_M
    if workpiece is not None and math.hypot(*workpiece.pose_guess.xyz_m) > beyond:
        raise InputError(
            f"workpiece.pose_guess.xyz_m is {math.hypot(*workpiece.pose_guess.xyz_m):.3g} m from the robot; a"
            f" {scenario.arm} with its torch does not reach beyond {farthest:.3g} m."
        )
    if scenario.workpiece is not None and scenario.workpiece.located_by not in ("scan", "drawing"):
        raise InputError(f"workpiece.located_by must be scan or drawing, not '{scenario.workpiece.located_by}'.")
    if scenario.job.weld and not scenario.job.calibrate and (scenario.job.X_BC or scenario.carried_scanner()) is None:
        nominal = scenario.calibration.mounting_guess
        raise InputError(
            "A weld without calibrating first needs the known pose of the scanner in the base. Write, with the numbers"
            f" of your calibration: job: {{calibrate: false, X_BC: {{xyz_m: {nominal.xyz_m}, rpy_deg:"
            f" {nominal.rpy_deg}}}}}"
        )
