"""Variants of the demo's cell: scaled to another arm's reach, or without the scanner's and the arm's own errors."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.robots import get_robot
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.simulated.ur import SimulatedUr
from weldcal.systems.scenario.schema import Scenario

ARMS = ("ur3e", "ur5e", "ur10e", "ur16e", "ur20", "ur30")
REFERENCE = "ur10e"
HOME_DEG = (190.0, -120.0, 135.0, -105.0, -90.0, 90.0)
PART_X_M, SCANNER_Z_M, SEAM_MM = 0.65, 0.95, 300.0
KINEMATIC_ERROR_MM = 0.4  # rms at the flange, of an arm of that reach
SCANNER_RISE_M = 0.2  # how much higher the scanner is over a cell of twice the size
LEAST_SCALE = 0.5  # nearer than this the tool, which has its size, touches the arm's own base
LEAST_SEAM_MM = 200.0  # two arcs of the S and their ends
TEXT = """\
description: The demo on a {title}; part, scanner and home are scaled to its reach.
arm: {arm}
robot: !SimulatedUr {{repeatability_mm: {repeatability_mm:g}, kinematic_error_mm: {kinematic_error_mm:.2g}}}
scanner: !RenderedScanner
  preset: phoxi_m
  width: 824
  height: 616
  xyz_m: [{x:.3f}, 0.0, {z:.3f}]
  scale_error: -0.002
  gradient_error_per_m: [0.013, 0.0]
  warp_mm: 0.1
finger_camera: !RenderedFingerCamera {{}}
calibration:
  required_error_mm: 0.15
  maximum_scans: 12
  mounting_guess:
    xyz_m: [{x:.3f}, 0.0, {z:.3f}]
    rpy_deg: [180.0, 0.0, -90.0]
workpiece:
  shape: s
  length_mm: {length:.0f}
  pose_guess:
    xyz_m: [{x:.3f}, 0.0, 0.02]
    rpy_deg: [0.0, 0.0, 90.0]
  placement_error: {{translation_mm: 6.0, rotation_deg: 1.5}}
  groove_error: {{translation_mm: 2.0, rotation_deg: 0.5}}
welding:
  seam_length_mm: {seam:g}
home_deg: [{home}]
"""


def scale_of(arm: str) -> float:
    """Size of an arm's cell relative to the UR10e's."""
    return max(LEAST_SCALE, get_robot(arm).reach_m / get_robot(REFERENCE).reach_m)


def home_of(arm: str) -> Array:
    """Home (6,) rad: the flange as in the demo, at its scaled place, in the branch nearest to the demo's.

    Raises:
        InputError: the arm does not reach it.
    """
    reference, scale = np.deg2rad(HOME_DEG), scale_of(arm)
    X_BF = forward_kinematics(load_arm(REFERENCE), reference)
    x, y, z = X_BF.translation()
    tool_m = 0.2  # hangs below the flange, whatever the arm
    solutions = inverse_kinematics(
        load_arm(arm), RigidTransform(X_BF.rotation(), [scale * x, scale * y, tool_m + scale * (z - tool_m)])
    )
    if not len(solutions):
        raise InputError(f"A {arm} does not reach the scaled home of the demo.")
    turn = (solutions - reference + np.pi) % (2.0 * np.pi) - np.pi
    home: Array = reference + turn[int(np.argmin(np.square(turn).sum(axis=1)))]
    return home


def arm_scenario(arm: str, seam_mm: float) -> str:
    """Return the scenario's YAML text for that arm, with a weld of ``seam_mm``."""
    scale = scale_of(arm)
    return TEXT.format(
        title=get_robot(arm).title,
        arm=arm,
        kinematic_error_mm=KINEMATIC_ERROR_MM * get_robot(arm).reach_m / get_robot(REFERENCE).reach_m,
        x=scale * PART_X_M,
        z=SCANNER_Z_M + SCANNER_RISE_M * (scale - 1.0),
        # a choice where the maker's figure is not public: the UR20's 0.1 mm
        repeatability_mm=1e3 * (get_robot(arm).repeatability_m or 1e-4),
        length=max(LEAST_SEAM_MM, min(scale, 1.0) * SEAM_MM),
        seam=seam_mm,
        home=", ".join(f"{angle:.1f}" for angle in np.rad2deg(home_of(arm))),
    )


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
