"""Propose from where a scanner on the flange scans a part: overlapping views, each reached and tried by a scan."""

import dataclasses as dc
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import ScannerPreset, cast
from weldcal.models.workpieces.part import WeldPart, numbered, seam_count
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import plan_drawn_seam, plan_seam
from weldcal.systems.jobs.weld.settings import clear_scan_move, servo_config
from weldcal.systems.messages import Scan, ScanView
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station

MARGIN_M = 0.025  # least overlap of two scans, and what the outer ones show beyond the part's ends
TILTS_DEG = (25.0, 12.0, 0.0, -12.0, -25.0)  # of the view about the part's length, towards the seam's side first
DISTANCES = 8  # from the scanner's best distance to its largest, for a part that is wide
TABLE_M = 0.5  # beyond the part, of the scan that is tried
OFF_M, OFF_RAD = (0.005, 0.0036, 0.0), math.radians(1.5)  # of the part in it from its guess
CARRIED = "carried_scanner"


def add_scan_poses(scenario: Scenario, path: Path, reason: str) -> str:
    """Write scan poses of a scanner on the flange into a scenario, or say why a scan does not show the part.

    Args:
        scenario: the scenario; its part lies where the arm can weld it.
        path: its file.
        reason: why it cannot be welded; "" where it can.

    Returns:
        The reason; another one where the scanner is the cause.
    """
    loaded = load_scenario(str(path))
    assert loaded.workpiece is not None
    assert scenario.workpiece is not None
    loaded.workpiece.pose_guess = scenario.workpiece.pose_guess
    carried = loaded.carried_scanner() is not None and loaded.workpiece.located_by == "scan"
    if carried == bool(reason):
        return reason
    try:
        station = make_station(loaded, 0)
    except WeldcalError as error:
        return reason or str(error)
    try:
        if not carried:
            return _too_long(loaded, station) or reason
        poses = scan_poses(loaded, station)
    except WeldcalError as error:
        return str(error)
    finally:
        station.close()
    scenario.planning.scan_poses_deg = [[round(float(v), 2) for v in np.rad2deg(q)] for q in poses]
    return ""


def _too_long(scenario: Scenario, station: Station) -> str:
    """Say why one scan beside the arm does not show a part that the arm could weld; "" where size is not the cause."""
    cad, X_BP = _part(scenario, station)
    scanner, planning = scenario.scanner, seam_planning(scenario, station, servo_config(scenario, station))
    refused = plan_drawn_seam(dc.replace(planning, advises=False), 0).reason is not None
    if refused or not isinstance(scanner, RenderedScanner) or scanner.mounted_on != "base":
        return ""
    away = float(np.linalg.norm(X_BP @ (0.5 * cad.mesh.bounds.sum(axis=0)) - np.array(scanner.xyz_m)))
    shown = max(scanner.scanner().footprint_m(away))
    size = _lying(cad.mesh.transformed(X_BP), station.arm.up)[1][0]
    words = f"The part is {size:.2g} m long, and the scanner beside the arm shows {shown:.2g} m of it"
    advice = f"Let the arm carry the scanner along the part: weldcal new FOLDER --part FILE --from {CARRIED}."
    return "" if size <= shown else f"{words}. {advice}"


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
