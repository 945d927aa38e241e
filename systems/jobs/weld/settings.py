"""Computes the weld job's settings from scenario and station: feature, poses, stop criterion, servo."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.calibrate import PLAIN
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import (
    PlannedPose,
    PlannerConfig,
    plan_calibration_poses,
    start_posture,
)
from weldcal.calibration.planning.clearance import Obstacle, Surroundings
from weldcal.calibration.refinement.kinematics_fit import KINDS, informative_poses
from weldcal.models.arms.compiled_kinematics import tick_jacobian
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.flanges import FlangeStandard
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import Part, WeldPart, is_felt, numbered, seam_count
from weldcal.models.workpieces.seat import Press, Seated, contact_angle
from weldcal.systems.jobs.weld.iterative_calibrator import TIME_S, CalibratorConfig
from weldcal.systems.jobs.weld.sequencer import SCAN_TIMEOUT_S, JobPlan
from weldcal.systems.motion.clear_moves import BareArm, clear_move, clear_poses, station_bodies
from weldcal.systems.motion.spine import ACCELERATION_SHARE, JERK_LIMIT, MOVE_TIMEOUT_S, SPEED_SHARE
from weldcal.systems.scenario.schema import AnglesOrder, Scenario, WeldingConfig
from weldcal.systems.station import Station
from weldcal.welding.passes.stitch import StitchConfig
from weldcal.welding.passes.tacks import Tack
from weldcal.welding.passes.travel import SeamTravel, seam_travel
from weldcal.welding.seam.curve import SeamCurve, ringed
from weldcal.welding.seam.feasibility import SeamWindows
from weldcal.welding.servo.settings import (
    TORCH_ABOVE_ROOT_M,
    DeflectionControl,
    GapConfig,
    MotionLimits,
    ServoConfig,
    ToolGeometry,
    TorchAngles,
    TorchControl,
    TouchOnConfig,
)
from weldcal.welding.servo.tool_axes import tool_path
from weldcal.welding.servo.weave import WEAVE_SHARE, Bound, WeaveConfig, check_weave

_POOL = (3, 2)
"""Times the poses: how many to choose from, as many as the cell allows."""
SPARE_POSES = 2  # to replace refused scans
# a torch nearer to the tip turns the tool faster for the same error: the pitch is ramped, so that no joint lags behind
# the others
NEAR_M, NEAR_PITCH_RAD_S2 = 0.060, 1.0
_UNPRESSED_M = 1e-9  # of a tip that is not used
ZERO_FRAMES = 10  # frames of the tag with the tip free: 1/3 s before the descent
SCAN_CLEAR_M = 0.02  # from a part that is not found yet
NOZZLE_CLEAR_M = 0.001  # a choice: as the tool's body keeps from the part
WEAVE_EVERY = 25  # places of a seam at which a weave is checked: 25 mm, a choice


def feature_on_flange(scenario: Scenario, station: Station | BareArm) -> RigidTransform:
    """X_FR of the feature that the scanner observes."""
    if scenario.calibration.feature == "flange" or station.tool is None:
        return RigidTransform()
    return station.tool.X_FR


def feature_standard(scenario: Scenario) -> FlangeStandard:
    """Dimensions of that feature."""
    return scenario.feature_standard()


def servo_config(scenario: Scenario, station: Station, seam: int = 0) -> ServoConfig:
    """The servo's settings from scenario and tool, for a seam by its number.

    Raises:
        WeaveError: tool or arm cannot do the weave at one of the seams, as they are drawn.
    """
    config, order = _straight_on(scenario, station, seam), scenario.welding.weave
    if order is None or station.tool is None or station.cad is None:
        return config
    weave = order.weave()
    seams = (_arm_bounds(scenario, station, weave, k) for k in range(seam_count(station.cad)))
    check_weave(weave, [*config.weave_bounds(weave), *chain.from_iterable(seams)])
    return replace(config, weave=weave)


def _arm_bounds(scenario: Scenario, station: Station, weave: WeaveConfig, seam: int) -> list[Bound]:
    """Speed, acceleration and jerk that a weave asks of each joint along a drawn seam, at its guessed pose.

    A place that the arm does not reach gives none: the planner refuses the seam.
    """
    tool, cad, spec, arm = station.tool, station.cad, scenario.workpiece, station.arm
    assert tool is not None
    assert cad is not None
    assert spec is not None
    part, X_BP = numbered(cad, seam), spec.pose_guess.pose()
    R_BP, config = X_BP.rotation().matrix(), _straight_on(scenario, station, seam)
    ups = np.broadcast_to(part.up_P, part.seam_P.shape) @ R_BP.T
    line, ups, turn_m = ringed(part.seam_P @ R_BP.T + X_BP.translation(), ups)
    try:
        path = tool_path(SeamCurve.from_points(line, up=ups, length=turn_m), config)
    except WeldcalError:
        return []
    peaks, X_TF, q = np.zeros((3, 6)), tool.X_FT.inverse(), np.deg2rad(scenario.home_deg)
    c, s = np.cos(weave.plane_rad), np.sin(weave.plane_rad)
    for X_BT in path.X_BT[::WEAVE_EVERY]:
        found = nearest_solution(arm, X_BT @ X_TF, q)
        if found is None:
            continue
        x, y, z = X_BT.rotation().matrix().T
        twists = np.zeros((6, 3))
        twists[:3, 0], twists[:3, 1], twists[3:, 2] = c * z + s * y, c * z - s * y, x
        J = tick_jacobian(arm, found, np.array(tool.X_FT.translation()))
        gain = np.abs(np.linalg.lstsq(J, twists, rcond=1e-3)[0])
        side = np.maximum(gain[:, 0], gain[:, 1]) / config.tool.torch_offset_m
        peaks = np.maximum(peaks, np.outer(weave.side_peaks, side) + np.outer(weave.ahead_peaks, gain[:, 2]))
    allowed = (SPEED_SHARE * arm.velocity_limit, ACCELERATION_SHARE * arm.acceleration_limit, np.full(6, JERK_LIMIT))
    return [
        Bound(k + 1, float(needed), WEAVE_SHARE * float(most))
        for k in range(3)
        for needed, most in zip(peaks[k], allowed[k], strict=True)
    ]


def angles_order(scenario: Scenario, cad: WeldPart, seam: int) -> AnglesOrder | None:
    """What is ordered of the wire's angles on a seam by its number."""
    spec, part = scenario.workpiece, numbered(cad, seam)
    of_seam = (
        spec.seams[part.seam.listed].angles if spec is not None and isinstance(part, Part) and spec.seams else None
    )
    return scenario.welding.angles if of_seam is None else of_seam


def seam_tool(scenario: Scenario, station: Station, seam: int) -> WeldingTool:
    """The tool with the stick-out that is ordered for a seam.

    Raises:
        InputError: the nozzle would touch the joint, or the tool's own stick-out is not known.
    """
    tool, cad = station.tool, station.cad
    assert tool is not None
    order = None if cad is None else angles_order(scenario, cad, seam)
    if cad is None or order is None or order.stick_out_mm is None:
        return tool
    wanted, section = 1e-3 * order.stick_out_mm, numbered(cad, seam).section
    beside = min(tool.nozzle_radius_m, max(section.left_m, section.right_m) * np.sin(section.half_angle_rad))
    least = beside / np.tan(section.half_angle_rad) + NOZZLE_CLEAR_M - TORCH_ABOVE_ROOT_M
    if wanted < min(least, tool.stick_out_m or least):
        raise InputError(
            f"With angles.stick_out_mm: {order.stick_out_mm:g} the nozzle would touch the joint: order"
            f" {1e3 * least:.1f} or more."
        )
    return tool.with_stick_out(wanted)


def _torch_angles(scenario: Scenario, tool: WeldingTool, cad: WeldPart, seam: int) -> TorchAngles | None:
    """The ordered angles of the wire on a seam, with the joint's answer to the tip."""
    order, part = angles_order(scenario, cad, seam), numbered(cad, seam)
    if order is None:
        return None
    return TorchAngles(
        work_rad=order.ends_rad("work_angle_deg") or (0.0, 0.0),
        travel_rad=order.ends_rad("travel_angle_deg"),
        rotation_rad=order.ends_rad("wire_rotation_deg"),
        half_angle_rad=contact_angle(part.section, tool.tip_radius_m),
        stiffness_ratio=tool.axial_stiffness_N_per_m / tool.lateral_stiffness_N_per_m,
        seat=partial(part.seated, tool) if is_felt(part, tool) else None,
        stick_out_m=math.nan if tool.stick_out_m is None else tool.stick_out_m,
    )


def _straight_on(scenario: Scenario, station: Station, seam: int) -> ServoConfig:
    """The servo's settings without a weave."""
    welding = scenario.welding
    if station.tool is None or station.cad is None:
        return ServoConfig()
    tool = seam_tool(scenario, station, seam)
    angles = _torch_angles(scenario, tool, station.cad, seam)
    press = Press(tool.press_axial_m, tool.press_lateral_m)
    cad = numbered(station.cad, seam)
    seat = cad.seated(tool, press)
    entry = cad.entry(tool, seat)
    felt = is_felt(cad, tool)
    if not felt:
        press = Press(_UNPRESSED_M, _UNPRESSED_M)
    tacks = tuple(
        Tack(a, b, lift)
        for k, a, b, height in welding.tacks_m()
        if k == seam and (lift := height + tool.tip_radius_m - seat.above_m) > 0.0
    )
    geometry = ToolGeometry(
        torch_offset_m=tool.chord_m,
        torch_height_m=tool.torch_height_m,
        tip_drop_m=entry.drop_m,
        torch_clearance_m=TORCH_ABOVE_ROOT_M - seat.above_m,
        side_offset_m=-seat.aside_m,
    )
    return ServoConfig(
        tool=geometry,
        touch=TouchOnConfig(
            zero_frames=ZERO_FRAMES,
            offset_m=entry.aside_m,
            # from the face beside a wide groove as far beyond its root as beside a usual one
            range_m=max(TouchOnConfig.range_m, TouchOnConfig.range_m + TouchOnConfig.offset_m - entry.aside_m),
        ),
        gap=GapConfig(end_window_m=cad.end_window_m),
        weld_speed_m_s=welding.speed_mm_s * 1e-3,
        deflection=DeflectionControl(delta_d_m=press.lateral_m, axial_d_m=press.axial_m),
        tacks=tacks,
        angles=angles,
        stitch=StitchConfig() if welding.stitch is None or pieces_of(welding).on_m else welding.stitch.stitch(),
        windows=SeamWindows.of(tool),
        felt=felt,
        torch=TorchControl(
            ignition_limit_s=TorchControl().ignition_limit_s
            + scenario.robot.torch_delay_s()
            + scenario.power_source.torch_delay_s(),
            from_rest=welding.arc.from_rest(scenario.reports_arc),
            start_s=welding.arc.start_s,
            crater_s=welding.arc.crater_s,
            work_angle_rad=0.0 if angles is None else 0.5 * sum(angles.work_rad),
        ),
        limits=MotionLimits(pitch_acceleration_rad_s2=NEAR_PITCH_RAD_S2) if tool.chord_m < NEAR_M else MotionLimits(),
    )


def seated_tip(station: Station, seam: int = 0) -> Seated:
    """Where the loaded tip rests in the drawn joint of a seam; a station with a tool and a workpiece."""
    tool, cad = station.tool, station.cad
    assert tool is not None
    assert cad is not None
    return numbered(cad, seam).seated(tool, Press(tool.press_axial_m, tool.press_lateral_m))


def plan_poses(
    scenario: Scenario, station: Station | BareArm, seed: int, *, count: int | None = None
) -> tuple[PlannedPose, ...]:
    """Plan all calibration and verification poses, or ``count``, best first: reachable, visible and clear.

    A bare arm starts where it holds the feature to the scanner, for the scenario's home is another arm's.

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

    X_FR, X_BC = feature_on_flange(scenario, station), c.mounting_guess.pose()
    capsules = () if tool is None else tool.capsules()
    if isinstance(station, BareArm):
        home = start_posture(station.arm, X_FR, X_BC, preset, config, capsules)
        scenario = replace(scenario, home_deg=np.degrees(home).tolist())

    def planned(config: PlannerConfig, n: int) -> list[PlannedPose]:
        start = np.deg2rad(scenario.home_deg)
        return plan_calibration_poses(station.arm, X_FR, X_BC, preset, n, q_start=start, config=config, tool=capsules)

    refines = count is None and c.refine in KINDS
    poses = _telling_of_the_arm(scenario, station, planned, config, wanted) if refines else planned(config, wanted)
    return clear_poses(scenario, station, poses, station_bodies(station))


def _denser(config: PlannerConfig, count: int) -> PlannerConfig:
    return replace(config, candidates=max(config.candidates, 3 * count // 2), min_spacing_m=0.01, max_trials=60 * count)


def _telling_of_the_arm(
    scenario: Scenario,
    station: Station | BareArm,
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
        return [pool[i] for i in informative_poses(station.arm, guess, q, wanted, kind)]
    return planned(config, wanted)


def clear_scan_move(scenario: Scenario, station: Station, q_a: Array, q_b: Array) -> bool:
    """Whether a straight move (6,) rad between home and scan poses is clear, also of the part at its guess."""
    bodies, spec, cad = station_bodies(station), scenario.workpiece, station.cad
    if not clear_move(scenario, station, bodies, q_a, q_b) or spec is None or cad is None:
        return False
    part = Obstacle("part", cad.mesh.transformed(spec.pose_guess.pose()), SCAN_CLEAR_M)
    return not Surroundings((part,)).touched_on_path(station.arm, bodies, q_a, q_b)


def check_scan_moves(scenario: Scenario, station: Station) -> None:
    """Check the moves from home to each scan pose and back.

    Raises:
        InputError: a move is not clear.
    """
    home, poses = np.deg2rad(scenario.home_deg), [np.deg2rad(pose) for pose in scenario.planning.scan_poses_deg]
    stops = [home, *poses, home] if poses else []
    for k, (a, b) in enumerate(pairwise(stops)):
        if not clear_scan_move(scenario, station, a, b):
            where = (
                f"to planning.scan_poses_deg[{k}]"
                if k < len(poses)
                else "home from the last of planning.scan_poses_deg"
            )
            raise InputError(
                f"On its move {where} the arm would touch the table, the part, the surroundings or itself: choose"
                " another pose."
            )


def work_point(scenario: Scenario) -> np.ndarray:
    """p_BWork (3,) m: the point at which the calibration's error is evaluated."""
    if scenario.workpiece is not None:
        return np.array(scenario.workpiece.pose_guess.pose().translation())
    return np.array(scenario.calibration.work_point_m)


def job_plan(scenario: Scenario, cad: WeldPart | None = None) -> JobPlan:
    """The job's parameters; time limits are longer for slower moves and more seams."""
    c, job = scenario.calibration, scenario.job
    listed = 1 if scenario.workpiece is None else len(scenario.workpiece.seams)
    seams = max(1, listed if cad is None else seam_count(cad))
    pieces, stitches = 2 if scenario.welding.pass_obstacles else 1, pieces_of(scenario.welding)
    if stitches.on_m and cad is not None:
        lines = [np.diff(numbered(cad, k).seam_P, axis=0) for k in range(seams)]
        pieces = max(len(stitches.pieces(float(np.linalg.norm(line, axis=1).sum()))) for line in lines)
    interpass_s = tuple(order.interpass_s for order in scenario.welding.later_passes())
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
        maximum_time_s=(job.maximum_time_s * slower * pieces * (1 + len(interpass_s)) + sum(interpass_s)) * seams,
        seams=seams,
        direct=scenario.welding.between_seams == "direct",
        interpass_s=interpass_s,
        scan_poses=tuple(np.deg2rad(pose) for pose in scenario.planning.scan_poses_deg),
    )


def pieces_of(welding: WeldingConfig) -> StitchConfig:
    """The stitches that are planned as pieces of their own; on_m of 0: none."""
    stitch = StitchConfig() if welding.stitch is None else welding.stitch.stitch()
    if not stitch.middle_out:
        return StitchConfig()
    stitch.check(1e-3 * welding.speed_mm_s)
    return stitch


def travel_of(scenario: Scenario, station: Station) -> SeamTravel:
    """The order of the seams, by the places where they are drawn."""
    spec, cad, tool, welding = scenario.workpiece, station.cad, station.tool, scenario.welding
    if spec is None or cad is None or tool is None:
        return SeamTravel((0,), 0.0, 0.0)
    ends = np.array([numbered(cad, k).seam_P[[0, -1]] for k in range(seam_count(cad))])
    ends = ends @ spec.pose_guess.pose().rotation().matrix().T + spec.pose_guess.pose().translation()
    home = (forward_kinematics(station.arm, np.deg2rad(scenario.home_deg)) @ tool.X_FT).translation()
    return seam_travel(ends[:, 0], ends[:, 1], np.asarray(home), welding.seam_order == "least_travel")


def calibrator_config(scenario: Scenario) -> CalibratorConfig:
    """The stop criterion of the calibration."""
    c = scenario.calibration
    return CalibratorConfig(
        required_error_m=c.required_error_mm * 1e-3,
        minimum_scans=c.minimum_scans,
        maximum_scans=c.maximum_scans,
        p_BWork=work_point(scenario),
        correct_scanner=c.correct_scanner,
        refine=c.refine,
    )
