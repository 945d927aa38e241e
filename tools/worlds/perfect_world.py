"""Takes the scanner's and the arm's own errors out of a scenario, for studies and tests that are not about them."""

from __future__ import annotations

from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.scenario.schema import Scenario


def perfect(scenario: Scenario) -> Scenario:
    """The scenario with an exact simulated arm, a scanner that has noise only, and a calibration that takes both so."""
    scanner = scenario.scanner_config()
    if isinstance(scenario.robot, SimulatedUr):
        scenario.robot.repeatability_mm = scenario.robot.kinematic_error_mm = 0.0
    if isinstance(scanner, RenderedScanner):
        scanner.scale_error = scanner.warp_mm = 0.0
        scanner.gradient_error_per_m = [0.0, 0.0]
    scenario.calibration.correct_scanner = False
    scenario.calibration.required_error_mm = 0.10
    scenario.calibration.maximum_scans = min(scenario.calibration.maximum_scans, 10)
    return scenario
