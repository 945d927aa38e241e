"""Says what of a measured tool has moved against its file and whether a seam's tolerance holds; writes the new file."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import frames_along
from weldcal.calibration.tool.measure import Move, ToolMeasurement
from weldcal.models.arrays import Array
from weldcal.models.documents import read_document

HOLDS, UNSURE, EXCEEDED, UNKNOWN = "holds", "may not hold", "does not hold", "is not known"
_ON_AXIS_M, _ON_AXIS_COS = 2e-3, 0.9998  # a choice: a body is the torch's own where its middle line is the wire's
_ALIKE_M = 5e-4  # a choice: shifts of ring and nozzle that differ by less are one shift
_DIGITS = 4  # of millimetres, and of directions two more


@dataclass(frozen=True)
class ToolVerdict:
    """Whether the seam's tolerance holds, the reason in one sentence, and the cause: empty where nothing has moved."""

    tolerance: str
    reason: str
    cause: str


def judge_tool(found: ToolMeasurement, tolerance_m: float) -> ToolVerdict:
    """Compare the wire point's shift and its 95 % error with the tolerance of a seam, m."""
    shift = found.move("wire") or found.move("nozzle")
    assert shift is not None
    most, least = shift.distance_m + shift.margin_m, shift.distance_m - shift.margin_m
    tolerance = HOLDS if most <= tolerance_m else EXCEEDED if least > tolerance_m else UNSURE
    limit = f"the seam tolerance of {1e3 * tolerance_m:g} mm"
    about = (
        f"{1e3 * shift.distance_m:.2f} mm from its place in the tool file, +- {1e3 * shift.margin_m:.2f} mm at 95 %."
    )
    if shift.part == "wire":
        return ToolVerdict(tolerance, f"The wire point is {about} {limit.capitalize()} {tolerance}.", _cause(found))
    place = "The nozzle has moved" if shift.moved else "The nozzle is in place"
    if tolerance == EXCEEDED:
        judged = f"The wire was not touched; were it straight, {limit} {tolerance}."
    else:
        tolerance, judged = UNKNOWN, f"The wire was not touched: whether {limit} holds is not known."
    return ToolVerdict(tolerance, f"{place}: its axis is {about} {judged}", _cause(found))


def _cause(found: ToolMeasurement) -> str:
    moved = [m for m in found.moves if m.moved]
    nozzle, wire, ring, tip = (next((m for m in moved if m.part == p), None) for p in ("nozzle", "wire", "ring", "tip"))
    if nozzle is not None and ring is not None and _alike(nozzle, ring):
        return "Ring and torch moved alike: the tool has slipped on the flange. Tighten it and measure again."
    if nozzle is not None:
        return (
            f"The torch is bent: its axis is turned by {np.degrees(nozzle.turn_rad):.2f} deg and shifted by"
            f" {1e3 * nozzle.distance_m:.2f} mm. Straighten it, or use the new tool file."
        )
    if wire is not None:
        along = float(wire.shift @ found.axis)
        across = float(np.linalg.norm(wire.shift - along * found.axis))
        if abs(along) > across:
            return f"Only the stick-out differs, by {1e3 * along:+.2f} mm: cut the wire, or use the new tool file."
        return "The nozzle is in its place and the wire is not: change the contact tip, or use the new tool file."
    if tip is not None:
        return "Only the tip's ball has moved: calibrate the finger again, or use the new tool file."
    return "The ring has moved: calibrate the scanner again." if ring is not None else ""


def _alike(one: Move, other: Move) -> bool:
    across = one.shift - other.shift
    return float(np.linalg.norm(across)) < _ALIKE_M + one.margin_m + other.margin_m


def wire_sigma(found: ToolMeasurement) -> float:
    """Error of the wire point, or across the nozzle where no wire was touched, not exceeded with 95 %, m."""
    return radius_95(found.axis_covariance[:2, :2] if found.wire is None else found.wire.covariance)


def measured_file(found: ToolMeasurement) -> dict[str, Any]:
    """Return the tool file's document with the measured wire point and axis, and what else has moved.

    Bodies and capsules about the wire's line move with it. Files that the document names get absolute paths.
    """
    path = found.tool.file
    document: dict[str, Any] = copy.deepcopy(read_document(path))
    p_old, a_old, p_new, a_new = found.tool.p_FW, found.tool.torch_axis, found.p_FW, found.axis
    frame = frames_along(a_old[None])[0]
    turn = RotationMatrix(_shortest(a_old, a_new))
    X = RigidTransform(turn, p_new - turn @ p_old)
    document["torch"] = {
        **document["torch"],
        "xyz_mm": _mm(p_new),
        "axis": [round(float(v), _DIGITS + 2) for v in a_new],
    }
    if not np.isnan(found.stick_out_m):
        document["torch"]["stick_out_mm"] = round(1e3 * found.stick_out_m, _DIGITS)
    for shape in document.get("shapes") or []:
        if shape.get("mesh"):
            shape["mesh"] = str((path.parent / shape["mesh"]).resolve())
        place = RigidTransform(
            RollPitchYaw(np.radians(shape.get("rpy_deg", [0.0, 0.0, 0.0]))),
            1e-3 * np.array(shape.get("xyz_mm", [0.0, 0.0, 0.0])),
        )
        line = place.rotation().matrix()[:, 2]
        if "cylinder_mm" in shape and abs(float(line @ a_old)) > _ON_AXIS_COS:
            off = (place.translation() - p_old) @ frame[:, :2]
            if float(np.linalg.norm(off)) < _ON_AXIS_M:
                moved = X @ place
                shape["xyz_mm"] = _mm(moved.translation())
                rpy = np.degrees(RollPitchYaw(moved.rotation()).vector())
                shape["rpy_deg"] = [round(float(v), _DIGITS) + 0.0 for v in rpy]
    for capsule in document.get("keep_clear") or []:
        ends = [1e-3 * np.array(capsule[key]) for key in ("from_mm", "to_mm")]
        if all(float(np.linalg.norm((end - p_old) @ frame[:, :2])) < _ON_AXIS_M for end in ends):
            capsule["from_mm"], capsule["to_mm"] = (_mm(np.asarray(X @ end)) for end in ends)
    tip, ring = found.move("tip"), found.move("ring")
    if tip is not None and tip.moved and found.ball is not None:
        document["tip"] = {**document["tip"], "xyz_mm": _mm(found.ball.surface.centre)}
    if ring is not None and ring.moved and found.ring is not None:
        old = found.tool.tool.X_FR.rotation()
        back = RotationMatrix(_shortest(old.matrix()[:, 2], found.ring.normal)) @ old
        rpy = np.degrees(RollPitchYaw(back).vector())
        document["ring"] = {
            **document["ring"],
            "xyz_mm": _mm(found.ring.centre),
            "rpy_deg": [round(float(v), _DIGITS) + 0.0 for v in rpy],
        }
    finger = document["finger_camera"].get("calibration")
    if finger:
        document["finger_camera"]["calibration"] = str((path.parent / finger).resolve())
    return document


def tool_text(found: ToolMeasurement, document: dict[str, Any], source: str) -> str:
    """Return the new tool file, with what was measured in its first lines."""
    what = "nozzle's axis, the wire not touched," if found.wire is None else "wire point"
    head = (
        f"# '{found.tool.file.name}' with its torch as measured from {Path(source).name}:"
        f" {what} +- {1e3 * wire_sigma(found):.3f} mm at 95 %.\n"
    )
    return head + str(yaml_dump(document))


def _mm(p: Array) -> list[float]:
    return [round(1e3 * float(v), _DIGITS) + 0.0 for v in p]


def _shortest(a: Array, b: Array) -> Array:
    """Return the shortest rotation (3, 3) from one direction to another."""
    v, c = np.cross(a, b), float(a @ b)
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + c))
