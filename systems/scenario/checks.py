"""Checks a scenario before anything is built; each error is one sentence that says what to change."""

import math

from weldcal.calibration.published.algorithm1 import named_cost
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.jobs.discovery import job_of, jobs
from weldcal.systems.scenario.numbers import check_numbers
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.scenario.workpiece import check_workpiece
from weldcal.welding.servo.laws import get_law

SLOWEST_FACTOR = 0.05
FARTHEST_WORKPIECE_M = 2.0  # the UR10e reaches 1.3 m; its torch and half a plate add less than the rest
DRAWN_ARMS = ("ur10e",)


def check_scenario(scenario: Scenario) -> None:
    """Check the parts of a scenario against each other.

    Raises:
        InputError: one sentence that says what to change.
    """
    if scenario.arm not in DRAWN_ARMS:
        raise InputError(
            f"The arm must be {' or '.join(DRAWN_ARMS)}, whose shape the clearance checks know, not '{scenario.arm}'."
        )
    if isinstance(scenario.robot, NoDevice):
        raise InputError("A cell needs a robot: write robot: !SimulatedUr {} in the scenario.")
    found = job_of(scenario)  # raises for the parts of two jobs
    check_numbers(scenario)
    for job in jobs():
        job.check(scenario)
    if not found.key and not scenario.job.calibrate and not scenario.job.weld:
        raise InputError("This scenario has nothing to do: set job.calibrate or job.weld to true.")
    if isinstance(scenario.scanner, NoDevice) and (scenario.job.calibrate or scenario.job.weld):
        raise InputError(
            "This job needs a scanner: write scanner: !RenderedScanner {} in the scenario or turn the job off."
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
    workpiece = scenario.workpiece
    if workpiece is not None:
        check_workpiece(workpiece)
    if workpiece is not None and math.hypot(*workpiece.pose_guess.xyz_m) > FARTHEST_WORKPIECE_M:
        raise InputError(
            f"workpiece.pose_guess.xyz_m is {math.hypot(*workpiece.pose_guess.xyz_m):.3g} m from the robot; no arm reaches beyond "
            f"{FARTHEST_WORKPIECE_M:g} m."
        )
    if scenario.workpiece is not None and scenario.workpiece.located_by not in ("scan", "drawing"):
        raise InputError(f"workpiece.located_by must be scan or drawing, not '{scenario.workpiece.located_by}'.")
    if scenario.job.weld and not scenario.job.calibrate and scenario.job.X_BC is None:
        raise InputError("A weld without calibrating first needs job.X_BC, the known pose of the scanner in the base.")
