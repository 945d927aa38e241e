"""Find where a part stands for the arm to weld it, and from where a scanner on the flange scans it."""

import dataclasses as dc
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import ScannerPreset, cast
from weldcal.models.workpieces.part import Part, WeldPart, numbered, seam_count
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning, plan_drawn_seam, plan_seam
from weldcal.systems.jobs.weld.settings import clear_scan_move, servo_config
from weldcal.systems.messages import PlannedSeam, Scan, ScanView
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import PoseConfig, Scenario
from weldcal.systems.station import Station, make_station
from weldcal.tools.commands.cell.screen import used_s
from weldcal.welding.seam.clearance import NoClearance, check_beside

MARGIN_M = 0.025  # least overlap of two scans, and what the outer ones show beyond the part's ends
TILTS_DEG = (25.0, 12.0, 0.0, -12.0, -25.0)  # of the view about the part's length, towards the seam's side first
DISTANCES = 8  # from the scanner's best distance to its largest, for a part that is wide
TABLE_M = 0.5  # beyond the part, of the scan that is tried
OFF_M, OFF_RAD = (0.005, 0.0036, 0.0), math.radians(1.5)  # of the part in it from its guess
CARRIED = "carried_scanner"
TURNS_DEG = (90.0, -90.0, 0.0, 180.0)
TRIED_M = (0.7, 0.7)  # half the size of the table in the scan that is tried
TABLE_PITCH_M = 0.004  # between its points: a choice, fine beside a finger
SCAN_S, SCAN_S_EACH = 8.0, 5e-4  # of processor time to find a part in a scan, and more for each of its triangles
PLACE_M = (0.65, 0.0)  # of the part's middle, where the demo's plate lies


def add_scan_poses(scenario: Scenario, path: Path) -> str:
    """Write scan poses of a scanner on the flange into a scenario, or say why a scan does not show the part.

    Args:
        scenario: the scenario; its part lies where the arm can weld it.
        path: its file.
    """
    loaded = load_scenario(str(path))
    assert loaded.workpiece is not None
    assert scenario.workpiece is not None
    loaded.workpiece.pose_guess = scenario.workpiece.pose_guess
    if loaded.carried_scanner() is None or loaded.workpiece.located_by != "scan":
        return ""
    try:
        station = make_station(loaded, 0)
    except WeldcalError as error:
        return str(error)
    try:
        poses = scan_poses(loaded, station)
    except WeldcalError as error:
        return str(error)
    finally:
        station.close()
    scenario.planning.scan_poses_deg = [[round(float(v), 2) for v in np.rad2deg(q)] for q in poses]
    return ""


def _too_long(part_B: TriMesh, scanner: ScannerPreset, X_BC: RigidTransform, up: Array, ends: bool = False) -> str:
    """Say that a part is longer than what a scanner beside the arm shows; "" where it is not.

    ends: "" also where an end of the part is in view.
    """
    axes, (size, *_), middle = _lying(part_B, up)
    away = float(np.linalg.norm(middle - X_BC.translation()))
    shown = max(scanner.footprint_m(away))
    aside = abs(float(axes[:, 0] @ (middle - X_BC @ np.array([0.0, 0.0, away]))))
    if size <= shown or (ends and 0.5 * size - aside < 0.5 * shown):
        return ""
    words = f"The part is {size:.2g} m long, and the scanner beside the arm shows {shown:.2g} m of it"
    return f"{words}. Let the arm carry the scanner along the part: weldcal new FOLDER --part FILE --from {CARRIED}."


def _part(scenario: Scenario, station: Station) -> tuple[WeldPart, RigidTransform]:
    assert station.cad is not None
    assert scenario.workpiece is not None
    return station.cad, scenario.workpiece.pose_guess.pose()


def _scanner(scenario: Scenario) -> tuple[ScannerPreset, RigidTransform]:
    config, X_FC = scenario.scanner_config(), scenario.carried_scanner()
    assert config is not None
    assert X_FC is not None
    return config.scanner(), X_FC.pose()


def _lying(mesh_B: TriMesh, up: Array) -> tuple[Array, Array, Array]:
    """Compute the part's upright box: axes (3,3) in columns, longest level one first, up last; size and middle (3,)."""
    R = RotationMatrix.MakeFromOneVector(up, 2).matrix()
    q = mesh_B.vertices @ R
    _, sides, turn = cv2.minAreaRect(q[:, :2].astype(np.float32))
    angle = math.radians(turn + (90.0 if sides[1] > sides[0] else 0.0))
    axes = R @ RotationMatrix.MakeZRotation(angle).matrix()
    low, high = (mesh_B.vertices @ axes).min(axis=0), (mesh_B.vertices @ axes).max(axis=0)
    return axes, high - low, axes @ (0.5 * (low + high))


def scan_poses(scenario: Scenario, station: Station) -> list[Array]:
    """Joints (6,) rad of the poses from which a scanner on the flange shows the whole part.

    Raises:
        InputError: there are none, with the reason of the poses that came nearest.
    """
    cad, X_BP = _part(scenario, station)
    axes, size, middle = _lying(cad.mesh.transformed(X_BP), station.arm.up)
    side = 1.0 if float((X_BP.rotation() @ cad.up_P.mean(axis=0)) @ axes[:, 1]) >= 0.0 else -1.0
    places, distance = _spread(_scanner(scenario)[0], size)
    reason = f"the arm reaches no {len(places)} scan poses at {distance:.2g} m above the part without touching anything"
    for X_BC in _views(axes, middle, side, places, distance):
        poses = _reached(scenario, station, X_BC)
        if poses:
            reason = _refused(scenario, station, poses)
            if not reason:
                return poses
    raise InputError(
        f"The scanner on the flange cannot show the part, {size[0]:.2g} m long, in {len(places)} scans: {reason}"
    )


def _spread(scanner: ScannerPreset, size: Array) -> tuple[Array, float]:
    """Compute the middles of the scans along the part (m, equal overlaps, also at the ends) and the distance.

    Raises:
        InputError: the part is wider than a scan at any distance.
    """
    wide, across = float(np.hypot(size[1], size[2])) + 2.0 * MARGIN_M, 0.0
    for distance in np.linspace(scanner.optimum_m, 0.95 * scanner.far_m - 0.5 * size[2], DISTANCES):
        along, across = scanner.footprint_m(distance - 0.5 * size[2])  # the field at the part's top
        if across >= wide:
            count = max(1, math.ceil((size[0] + MARGIN_M) / (along - MARGIN_M)))
            overlap = (count * along - size[0]) / (count + 1)
            return (np.arange(count) - 0.5 * (count - 1)) * (along - overlap), float(distance)
    raise InputError(
        f"The part is {wide - 2.0 * MARGIN_M:.2g} m wide, and the scanner shows at most {across:.2g} m: take a scanner"
        " with a larger field."
    )


def _views(axes: Array, middle: Array, side: float, places: Array, distance: float) -> Iterator[list[RigidTransform]]:
    """Return poses X_BC of the scans, for each tilt and both orientations of the scanner."""
    along, across, up = axes.T
    for tilt in np.radians(TILTS_DEG):
        back = math.cos(tilt) * up + side * math.sin(tilt) * across
        for x in (along, -along):
            R = RotationMatrix(np.column_stack([x, np.cross(-back, x), -back]))
            yield [RigidTransform(R, middle + place * along + distance * back) for place in places]


def _reached(scenario: Scenario, station: Station, views: list[RigidTransform]) -> list[Array]:
    """Joints (6,) rad of each view, with clear moves between them and home; empty where one is not reached."""
    arm, home, X_CF = station.arm, np.deg2rad(scenario.home_deg), _scanner(scenario)[1].inverse()
    stops: list[Array] = [home]
    for X_BC in views:
        q = inverse_kinematics(arm, X_BC @ X_CF)
        q = q + 2.0 * np.pi * np.round((stops[-1] - q) / (2.0 * np.pi))
        q = q[((q > arm.position_lower) & (q < arm.position_upper)).all(axis=1)]
        near = sorted(q, key=lambda one: float(np.abs(one - stops[-1]).max()))
        clear = (one for one in near if all(clear_scan_move(scenario, station, a, one) for a in (stops[-1], home)))
        if (found := next(clear, None)) is None:
            return []
        stops.append(found)
    return stops[1:]


def _refused(scenario: Scenario, station: Station, poses: list[Array]) -> str:
    """Why the job does not find the part in scans from these poses, displaced by OFF; "" where it does."""
    (cad, guess), (scanner, X_FC) = _part(scenario, station), _scanner(scenario)
    off = RotationMatrix.MakeZRotation(OFF_RAD)
    middle = guess @ (0.5 * cad.mesh.bounds.sum(axis=0))
    X_BP = RigidTransform(off, middle + np.array(OFF_M) - off @ middle) @ guess
    z = scenario.table_height_m()
    part_B = cad.mesh.transformed(X_BP)
    (x, y), (x_to, y_to) = part_B.bounds[:, :2] + np.array([[-TABLE_M], [TABLE_M]])
    scene = [part_B, extrude(np.array([[x, y], [x_to, y], [x_to, y_to], [x, y_to]]), z - 0.02, z)]
    views = []
    for k, q in enumerate(poses):
        X_BC = forward_kinematics(station.arm, q) @ X_FC
        cloud, X_CB = cast(scene, X_BC, scanner, k), X_BC.inverse()
        points_C = (cloud @ X_CB.rotation().matrix().T + X_CB.translation()).astype(np.float32)
        views.append(ScanView(Scan(sequence=k + 1, points_C=points_C), X_BC))
    for number in range(seam_count(cad)):
        planning = seam_planning(scenario, station, servo_config(scenario, station, number))
        planning = dc.replace(planning, workpiece=numbered(cad, number), advises=False)
        last = views[-1]
        if reason := plan_seam(planning, last.scan, last.X_BC, ScannerCorrection(), tuple(views[:-1])).reason:
            return reason
    return ""


class OutOfTimeError(Exception):
    """The time for planning is over."""


def _check_time(until_s: float, needs_s: float = 0.0) -> None:
    if used_s() + needs_s > until_s:
        raise OutOfTimeError


def weldable_places(
    scenario: Scenario, apart: bool = False, advises: bool = False, until_s: float = math.inf
) -> tuple[list[tuple[PoseConfig, list[int]]], dict[int, str]]:
    """Find poses of a scenario's part on the table in which the arm can weld its seams.

    There it must also be found in a scan.

    Args:
        scenario: the cell, with a part that has these seams.
        apart: whether seams may be left out, and welded in different poses.
        advises: the reasons say what would help.
        until_s: by `used_s`, when it has to be done.

    Returns:
        Each pose with the numbers of its seams, the longest first, and why the others are welded in none.

    Raises:
        OutOfTimeError: it is not done until then.
    """
    assert scenario.workpiece is not None
    count = len(scenario.workpiece.seams)
    try:
        station = make_station(scenario, 0)
    except WeldcalError as error:
        return [], dict.fromkeys(range(count), str(error))
    tried, found = list[tuple[PoseConfig, dict[int, tuple[float, str]]]](), list[tuple[PoseConfig, list[int]]]()
    try:
        part = station.cad
        if not isinstance(part, Part) or station.tool is None:
            only = "Only a part from a file and a welding tool can be planned. Choose another scenario with --from."
            return [], dict.fromkeys(range(count), only)
        seams = [numbered(part, k) for k in range(seam_count(part))]
        line = np.concatenate([seam.seam_P for seam in seams])
        middles = [0.5 * part.mesh.bounds.sum(axis=0), 0.5 * (line.min(axis=0) + line.max(axis=0))]
        middles = middles[: 1 + bool(np.ptp(middles, axis=0).max() > 0.005)]  # nearer they are one place
        for guess in (standing(part.mesh, turn, middle, scenario) for middle in middles for turn in TURNS_DEG):
            _check_time(until_s)
            tried.append((guess, _refusals(scenario, station, seams, guess, apart)))
            if not tried[-1][1]:
                break

        def welded(refused: dict[int, tuple[float, str]]) -> float:
            return float(sum(seams[k].arc_length_m[-1] for k in left if k not in refused))

        left, why = set(range(len(seams))), dict[int, str]()
        nearest = max(
            tried, key=lambda at: len(seams) - len(at[1]) + max((near for near, _ in at[1].values()), default=0.0)
        )
        while tried and left:
            best = max(tried, key=lambda at: welded(at[1]))
            some = sorted(left - best[1].keys())
            tried.remove(best)
            if not some or (len(some) < len(seams) and not apart):
                break  # no pose welds more
            _check_time(until_s, SCAN_S + SCAN_S_EACH * len(part.mesh.triangles))
            if unseen := _unseen(scenario, station, seams[some[0]], best[0]):
                why |= dict.fromkeys(some, unseen)
            else:
                found.append((best[0], some if apart else list(range(count))))
                left -= set(some)
        if advises and left:
            nearest = nearest[0], _refusals(scenario, station, seams, nearest[0], apart, advises=True)
        why = {k: reason for k, (_, reason) in nearest[1].items()} | why
    finally:
        station.close()
    return found, {
        k: why.get(k, next(iter(why.values()), "")) for k in (left if apart else range(count) if left else ())
    }


def _refusals(
    scenario: Scenario, station: Station, seams: list[WeldPart], guess: PoseConfig, every: bool, advises: bool = False
) -> dict[int, tuple[float, str]]:
    """Say why the arm cannot weld seams with the part in a pose, by number, and how near it comes, 0 to 1.

    ``every``: else the seams after the first of them are refused with it.
    """
    found = dict[int, tuple[float, str]]()
    for number, part in enumerate(seams):
        try:
            config = servo_config(scenario, station, number)
            planning = dc.replace(
                seam_planning(scenario, station, config), workpiece=part, X_BP_guess=guess.pose(), advises=advises
            )
            plan = plan_drawn_seam(planning, 0)
        except WeldcalError as error:  # no joint for this tool
            found[number] = 0.0, str(error)
        else:
            if plan.reason is not None:
                found[number] = 0.0, plan.reason
            elif reason := _at_the_table(planning, part, plan):
                found[number] = 0.5, reason  # nearer to a weld than where the arm has no way
        if found and not every:
            return found | dict.fromkeys(range(number, len(seams)), found[number])
    return found


def _at_the_table(planning: SeamPlanning, part: WeldPart, plan: PlannedSeam) -> str:
    """Why the tool would touch the table along a planned seam; "" where it would not."""
    assert plan.seam is not None
    p_B = np.asarray(plan.seam.position(np.linspace(0.0, plan.seam.length, 50)))[:, :2]
    x, y = (np.arange(low, high, TABLE_PITCH_M) for low, high in zip(p_B.min(0) - 0.2, p_B.max(0) + 0.2, strict=True))
    table = np.stack(np.meshgrid(x, y, [planning.table_z_m]), axis=-1).reshape(-1, 3)
    try:
        check_beside(table, part.mesh, planning.X_BP_guess, plan.seam, planning.tool, plan.lean_rad, planning.table_z_m)
    except NoClearance as error:
        return str(error)
    return ""


def _unseen(scenario: Scenario, station: Station, part: WeldPart, guess: PoseConfig) -> str:
    """Why the job does not find a part in a scan of it, turned and displaced as the scenario says; "" where it does."""
    scanner, placed = scenario.scanner, scenario.workpiece
    if not isinstance(scanner, RenderedScanner) or scanner.mounted_on != "base":
        return ""
    if placed is None or placed.located_by != "scan":
        return ""
    X_BC = PoseConfig(list(scanner.xyz_m), list(scanner.rpy_deg)).pose()
    off = RotationMatrix.MakeZRotation(np.deg2rad(placed.placement_error.rotation_deg))
    middle = guess.pose() @ (0.5 * part.mesh.bounds.sum(axis=0))
    shift = 1e-3 * placed.placement_error.translation_mm * np.array([0.8, 0.6, 0.0])
    X_BP = RigidTransform(off, middle + shift - off @ middle) @ guess.pose()
    seen = part.mesh.transformed(X_BP), scanner.scanner(), X_BC, station.arm.up
    if longer := _too_long(*seen, ends=True):
        return longer
    low, high = PLACE_M - np.array(TRIED_M), PLACE_M + np.array(TRIED_M)
    z = scenario.calibration.table_z_m
    table = extrude(np.array([low, (high[0], low[1]), high, (low[0], high[1])]), z - 0.02, z)
    cloud_B = cast([part.mesh.transformed(X_BP), table], X_BC, scanner.scanner(), 0)
    X_CB = X_BC.inverse()
    points_C = (cloud_B @ X_CB.rotation().matrix().T + X_CB.translation()).astype(np.float32)
    config = servo_config(scenario, station, 0)
    planning = dc.replace(
        seam_planning(scenario, station, config), workpiece=part, X_BP_guess=guess.pose(), advises=False
    )
    reason = plan_seam(planning, Scan(sequence=1, points_C=points_C), X_BC, ScannerCorrection()).reason
    return "" if reason is None else _too_long(*seen) or reason


def standing(mesh: TriMesh, turn_deg: float, middle_P: NDArray[np.float64], scenario: Scenario) -> PoseConfig:
    """Return the pose of a part on the table as it is drawn, turned about z, with a point of it at PLACE_M."""
    R = RotationMatrix.MakeZRotation(np.deg2rad(turn_deg)).matrix()
    x, y = np.array(PLACE_M) - (R @ middle_P)[:2]
    z = scenario.calibration.table_z_m - float(mesh.bounds[0, 2])
    return PoseConfig([round(float(v), 4) for v in (x, y, z)], [0.0, 0.0, turn_deg])
