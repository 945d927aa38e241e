"""Computes the weld job's settings from scenario and station: feature, poses, stop criterion, servo."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.calibrate import PLAIN
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannedPose, PlannerConfig, plan_calibration_poses
from weldcal.calibration.refinement.kinematics_fit import KINDS
from weldcal.calibration.refinement.poses import informative_poses
from weldcal.models.arms.chain import chain_of
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard
from weldcal.models.workpieces.part import is_felt, numbered
from weldcal.models.workpieces.seat import Press, Seated
from weldcal.systems.jobs.weld.iterative_calibrator import TIME_S, CalibratorConfig
from weldcal.systems.jobs.weld.sequencer import SCAN_TIMEOUT_S, JobPlan
from weldcal.systems.motion.clear_moves import clear_poses, station_bodies
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.welding.servo.settings import (
    DeflectionControl,
    GapConfig,
    ServoConfig,
    ToolGeometry,
    TorchControl,
    TouchConfig,
)

_POOL = (3, 2)
"""Times the poses: how many to choose from, as many as the cell allows."""
SPARE_POSES = 3  # one for Algorithm 1's verification cloud, two to replace refused scans
_UNPRESSED_M = 1e-9  # of a tip that is not used
ZERO_FRAMES = 10  # frames of the tag with the tip free: 1/3 s before the descent
TORCH_ABOVE_ROOT_M = 0.002  # height of the wire point above the root of the groove


def feature_on_flange(scenario: Scenario, station: Station) -> RigidTransform:
    """X_FR of the feature that the scanner observes."""
    if scenario.calibration.feature == "flange" or station.tool is None:
        return RigidTransform()
    return station.tool.X_FR


def feature_standard(scenario: Scenario) -> FlangeStandard:
    """Dimensions of that feature."""
    return scenario.feature_standard()


def servo_config(scenario: Scenario, station: Station, seam: int = 0) -> ServoConfig:
    """The servo's settings from scenario and tool, for a seam by its number."""
    tool, welding = station.tool, scenario.welding
    if tool is None or station.cad is None:
        return ServoConfig()
    press = Press(tool.press_axial_m, tool.press_lateral_m)
    cad = numbered(station.cad, seam)
    seat = cad.seated(tool, press)
    entry = cad.entry(tool, seat)
    felt = is_felt(cad, tool)
    if not felt:
        press = Press(_UNPRESSED_M, _UNPRESSED_M)
    geometry = ToolGeometry(
        torch_offset_m=tool.chord_m,
        torch_height_m=tool.torch_height_m,
        tip_drop_m=entry.drop_m,
        torch_clearance_m=TORCH_ABOVE_ROOT_M - seat.above_m,
        side_offset_m=-seat.aside_m,
    )
    return ServoConfig(
        tool=geometry,
        touch=TouchConfig(zero_frames=ZERO_FRAMES, offset_m=entry.aside_m),
        gap=GapConfig(end_window_m=cad.end_window_m),
        weld_speed_m_s=welding.speed_mm_s * 1e-3,
        deflection=DeflectionControl(delta_d_m=press.lateral_m, axial_d_m=press.axial_m),
        law=welding.law,
        felt=felt,
        torch=TorchControl(ignition_limit_s=TorchControl().ignition_limit_s + scenario.robot.torch_delay_s()),
    )


def seated_tip(station: Station, seam: int = 0) -> Seated:
    """Where the loaded tip rests in the drawn joint of a seam; a station with a tool and a workpiece."""
    tool, cad = station.tool, station.cad
    assert tool is not None
    assert cad is not None
    return numbered(cad, seam).seated(tool, Press(tool.press_axial_m, tool.press_lateral_m))


def plan_poses(scenario: Scenario, station: Station, seed: int, *, count: int | None = None) -> tuple[PlannedPose, ...]:
    """Plan all calibration and verification poses, or ``count``, best first, checked for reach, visibility and clearance.

    Raises:
        UnreachableScanner: no such set of poses exists for the scanner at its nominal pose.
    """
    c, tool = scenario.calibration, station.tool
    scanner = scenario.scanner_config()
    if scanner is None:
        raise InputError("A calibration needs a scanner: write scanner: !RenderedScanner {} in the scenario.")
    preset = scanner.scanner()
    config = PlannerConfig(
        seed=seed,
        theta_max_rad=np.deg2rad(c.theta_max_deg),
        table_z_m=scenario.table_height_m(),
        margin_m=c.clearance_m,
        feature_radius_m=0.5 * feature_standard(scenario).outer_m,
        work_point_B=tuple(work_point(scenario)),
        surroundings=station.surroundings,
    )
    if count is not None:
        # from half as many candidates again, which may lie closer together
        config = _denser(config, count)
    wanted = c.maximum_scans + c.verification_scans + SPARE_POSES if count is None else count

    def planned(config: PlannerConfig, n: int) -> list[PlannedPose]:
        return plan_calibration_poses(
            station.arm,
            feature_on_flange(scenario, station),
            c.mounting_guess.pose(),
            preset,
            n,
            q_start=np.deg2rad(scenario.home_deg),
            config=config,
            tool=() if tool is None else tool.capsules(),
        )

    refines = count is None and c.refine in KINDS
    poses = _telling_of_the_arm(scenario, station, planned, config, wanted) if refines else planned(config, wanted)
    return clear_poses(scenario, station, poses, station_bodies(station))


def _denser(config: PlannerConfig, count: int) -> PlannerConfig:
    return replace(config, candidates=max(config.candidates, 3 * count // 2), min_spacing_m=0.01, max_trials=60 * count)


def _telling_of_the_arm(
    scenario: Scenario,
    station: Station,
    planned: Callable[[PlannerConfig, int], list[PlannedPose]],
    config: PlannerConfig,
    wanted: int,
) -> list[PlannedPose]:
    """Of more poses than are wanted those that tell most of camera, scanner and arm together, the first ones most."""
    for times in _POOL:
        try:
            pool = planned(_denser(config, times * wanted), times * wanted)
        except UnreachableScanner:
            continue
        q = np.array([p.q for p in pool])
        guess, kind = scenario.calibration.mounting_guess.pose(), scenario.calibration.refine
        return [pool[i] for i in informative_poses(chain_of(station.arm), guess, q, wanted, kind)]
    return planned(config, wanted)


def work_point(scenario: Scenario) -> np.ndarray:
    """p_BWork (3,) m: the point at which the calibration's error is evaluated."""
    if scenario.workpiece is not None:
        return np.array(scenario.workpiece.pose_guess.pose().translation())
    return np.array(scenario.calibration.work_point_m)


def job_plan(scenario: Scenario) -> JobPlan:
    """The job's parameters; time limits are longer for slower moves and more seams."""
    c, job = scenario.calibration, scenario.job
    seams = max(1, len(scenario.workpiece.seams)) if scenario.workpiece is not None else 1
    if scenario.welding.pass_obstacles:
        seams *= 2  # pieces
    slower = 1.0 / job.speed_factor
    return JobPlan(
        calibrate=job.calibrate,
        weld=job.weld,
        q_home=np.deg2rad(scenario.home_deg),
        maximum_scans=c.maximum_scans,
        verification_scans=c.verification_scans,
        verification_limit_m=c.verification_limit_mm * 1e-3,
        required_error_m=c.required_error_mm * 1e-3,
        minimum_scans=c.minimum_scans,
        scan_timeout_s=SCAN_TIMEOUT_S if c.refine == PLAIN else TIME_S,
        move_timeout_s=MOVE_TIMEOUT_S * slower,
        maximum_time_s=job.maximum_time_s * slower * seams,
        seams=max(1, len(scenario.workpiece.seams)) if scenario.workpiece is not None else 1,
    )


def calibrator_config(scenario: Scenario) -> CalibratorConfig:
    """The stop criterion of the calibration."""
    c = scenario.calibration
    return CalibratorConfig(
        required_error_m=c.required_error_mm * 1e-3,
        minimum_scans=c.minimum_scans,
        maximum_scans=c.maximum_scans,
        p_BWork=work_point(scenario),
        cost=c.cost,
        work_radius_m=c.work_radius_mm * 1e-3,
        cost_axes=tuple(c.cost_axes),
        correct_scanner=c.correct_scanner,
        refine=c.refine,
    )
