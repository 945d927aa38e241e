"""Exports a hand-eye result to YAML, JSON, URDF, ROS 2, URScript and Drake directives."""

import json
import re
from dataclasses import dataclass
from hashlib import sha256
from itertools import combinations
from pathlib import Path

import numpy as np
import yaml
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import export_ros2, export_ur_pose, export_urdf, matrix4, software_version
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.hand_eye.mountings import Mounting, Unknown
from weldcal.calibration.hand_eye.several import SensorsTogether
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.models.files import write_atomic

RESULT_FILE = "hand_eye.yaml"


@dataclass(frozen=True)
class Provenance:
    """Where a result came from: the file's name and its SHA-256, and those of files that were solved with it."""

    source: str
    sha256: str
    together: tuple[str, ...] = ()


def digest(path: Path) -> str:
    """SHA-256 of a file, or of the files of a folder in the order of their names."""
    if path.is_file():
        return sha256(path.read_bytes()).hexdigest()
    whole = sha256()
    for one in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(one.relative_to(path).as_posix().encode())
        whole.update(one.read_bytes())
    return whole.hexdigest()


def export_drake_directive(X: RigidTransform, parent: str, child: str) -> str:
    """Return a Drake model directive that adds the child frame to the parent."""
    roll, pitch, yaw = np.degrees(X.rotation().ToRollPitchYaw().vector())
    x, y, z = X.translation()
    return (
        f"directives:\n- add_frame:\n    name: {child}\n    X_PF:\n      base_frame: {parent}\n"
        f"      translation: [{x:.9f}, {y:.9f}, {z:.9f}]\n"
        f"      rotation: !Rpy {{ deg: [{roll:.9f}, {pitch:.9f}, {yaw:.9f}] }}\n"
    )


def document(result: HandEyeResult, mounting: Mounting, provenance: Provenance) -> dict[str, object]:
    """Return all of a result in plain types: what hand_eye.yaml holds."""
    held, correction = result.held_out, getattr(result, "correction", None)
    return {
        "schema": 1,
        "software": software_version(),
        "configuration": mounting.name,
        "equation": mounting.equation,
        "poses": {u.symbol: _pose(result, k, u) for k, u in mounting.unknowns.items() if k in result.poses},
        "covariance_order": "rotation (rad) then translation (m), on the parent's side about the child's origin",
        **({} if correction is None else {"scanner_correction": correction.document()}),
        "held_out": {"deg": _number(held.rms_deg), "mm": _number(1e3 * held.rms_translation)},
        "noise": {
            "deg": _number(float(np.degrees(result.sigma_rotation_rad))),
            "mm": _number(1e3 * result.sigma_translation),
        },
        "degrees_of_freedom": float(result.degrees_of_freedom),
        "condition": _number(result.condition),
        "method": result.method,
        "start": result.start,
        "unobservable": list(result.unobservable),
        "warnings": list(result.warnings),
        "samples": [
            {
                "used": bool(used),
                "residual_deg": _number(float(np.degrees(w))),
                "residual_mm": _number(1e3 * float(d)),
                "held_out_deg": _number(float(np.degrees(hw))),
                "held_out_mm": _number(1e3 * float(hd)),
            }
            for used, w, d, hw, hd in zip(
                result.inliers,
                result.rotation_rad,
                result.translation,
                held.rotation_rad,
                held.translation,
                strict=True,
            )
        ],
        "data": {"file": provenance.source, "sha256": provenance.sha256}
        | ({"together_sha256": list(provenance.together)} if provenance.together else {}),
    }


def export_hand_eye(
    result: HandEyeResult, mounting: Mounting, folder: Path, provenance: Provenance
) -> tuple[Path, ...]:
    """Write hand_eye.yaml, hand_eye.json, and for every pose URDF, ROS 2, UR and Drake files; returns the paths."""
    whole = document(result, mounting, provenance)
    files = {RESULT_FILE: _yaml(whole), "hand_eye.json": json.dumps(whole, indent=2) + "\n"}
    for letter, X in result.poses.items():
        u = mounting.unknowns[letter]
        files[f"{u.symbol}.urdf.xacro"] = export_urdf(X, u.parent, u.child)
        files[f"{u.symbol}.static_transform.sh"] = export_ros2(X, u.parent, u.child)
        files[f"{u.symbol}.ur_pose.script"] = export_ur_pose(X)
        files[f"{u.symbol}.drake.yaml"] = export_drake_directive(X, u.parent, u.child)
    for name, text in files.items():
        write_atomic(folder / name, text)
    return tuple(folder / name for name in files)


def export_together(found: SensorsTogether, folder: Path) -> None:
    """Write together.yaml: the pose of every sensor in every earlier one, and their ROS 2 commands."""
    rows = []
    for i, j in combinations(range(len(found.names)), 2):
        a, b, (X, S) = found.names[i], found.names[j], found.between(i, j)
        rows.append({"parent": a, "child": b, "matrix": X.tolist(), "covariance": S.tolist()})
        text = export_ros2(as_transform(X), optical_frame(a), optical_frame(b))
        write_atomic(folder / f"{a}_to_{b}.static_transform.sh", text)
    whole = {
        "schema": 1,
        "software": software_version(),
        "sensors": list(found.names),
        "poses_measured": found.poses.tolist(),
        "poses_shared": found.shared,
        "between": rows,
        "covariance_order": "rotation (rad) then translation (m), on the parent's side about the child's origin",
        "robot_noise": {"deg": float(np.degrees(found.common[0])), "mm": 1e3 * found.common[1]},
        "sensor_noise": {
            name: {"deg": float(np.degrees(w)), "mm": float(1e3 * d)}
            for name, (w, d) in zip(found.names, found.noise, strict=True)
        },
        "left_out_mm": {"apart": _number(1e3 * found.apart_m), "together": _number(1e3 * found.together_m)},
    }
    write_atomic(folder / "together.yaml", _yaml(whole))


def optical_frame(name: str) -> str:
    """The tf name of one of several sensors."""
    return re.sub(r"\W+", "_", name) + "_optical_frame"


def _yaml(whole: dict[str, object]) -> str:
    """The text of pydrake's yaml_dump, by libyaml where it is there: thousands of samples take a third of the time."""
    return str(yaml.dump(whole, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), default_flow_style=None))


def _pose(result: HandEyeResult, letter: str, unknown: Unknown) -> dict[str, object]:
    X = result.poses[letter]
    return {
        "meaning": unknown.sentence,
        "parent": unknown.parent,
        "child": unknown.child,
        "matrix": matrix4(X),
        "xyz": [float(v) for v in X.translation()],
        "wxyz": [float(v) for v in X.rotation().ToQuaternion().wxyz()],
        "covariance": [[float(v) for v in row] for row in result.covariance[letter]],
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
