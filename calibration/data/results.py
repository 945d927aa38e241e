"""Reads and writes calibration.yaml, and exports X_BC to URDF, ROS 2, URScript and JSON."""

import json
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import (
    TERMS,
    ScannerClock,
    ScannerCorrection,
    clock_from_document,
    correction_from_document,
)
from weldcal.calibration.geometry.se3 import as_transform, rotation_vector
from weldcal.models.arrays import Array
from weldcal.models.documents import DocumentSection, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole, write_atomic

ON_BASE = "eye_on_base"
RESULT_FILE, KINEMATICS_FILE = "calibration.yaml", "kinematics.yaml"


@dataclass(frozen=True, kw_only=True)
class PoseRecord:
    """One pose: whether it was used, its residual and held-out error (mm), tilts (deg); reason where it was refused."""

    id: str
    used: bool
    reason: str = ""
    residual_mm: float | None = None
    held_out_mm: float | None = None
    tilt_deg: float | None = None
    held_out_tilt_deg: float | None = None


def statistics(values: Iterable[float] | Array, *names: str) -> dict[str, float]:
    """Compute median, mean, rms, p95, min, max by name (median, mean, p95, max without); NaN for no finite value."""
    v = np.array([x for x in np.asarray(list(values), dtype=float) if np.isfinite(x)])
    of: dict[str, Callable[[Array], Any]] = {
        "median": np.median,
        "mean": np.mean,
        "rms": lambda x: np.sqrt(np.mean(x**2)),
        "p95": lambda x: np.percentile(x, 95),
        "min": np.min,
        "max": np.max,
    }
    chosen = names or ("median", "mean", "p95", "max")
    return {name: float(of[name](v)) if len(v) else float("nan") for name in chosen}


def known(value: float) -> float | None:
    """Return the number for a JSON object; None where it is not finite."""
    return float(value) if math.isfinite(value) else None


def tilt_summary(tilts_rad: Array) -> dict[str, float | None]:
    """Median and 95th percentile of tilts (n,) in degrees; None where there are none."""
    s = statistics(np.degrees(tilts_rad))
    return {k: known(s[k]) for k in ("median", "p95")}


def pose_records(
    ids: Sequence[str], used: NDArray[np.bool_], values: Mapping[str, Array], refused: Iterable[tuple[str, str]]
) -> tuple[PoseRecord, ...]:
    """The records of poses with their ``values`` (n,) by the record's field, then of those that were refused before."""
    reasons = dict(refused)
    records = []
    for k, id in enumerate(ids):
        numbers = {name: known(v[k]) for name, v in values.items()}
        records.append(PoseRecord(id=id, used=bool(used[k]), reason=reasons.pop(id, ""), **numbers))
    return (*records, *(PoseRecord(id=i, used=False, reason=t) for i, t in reasons.items()))


@dataclass(frozen=True, kw_only=True)
class IcpRecord:
    """Algorithm 1's ICP figure at one verification pose.

    Six numbers at the flange centre, and the components it does not see.
    """

    id: str
    method: str
    rotation_deg: tuple[float, float, float]
    translation_mm: tuple[float, float, float]
    translation_norm_mm: float
    unseen: tuple[str, ...]
    true_error_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class CalibrationResult:
    """Contents of calibration.yaml.

    ``covariance`` (6, 6): [rotation; translation] on the base side about the camera origin. ``joint_covariance`` (6 +
    K, 6 + K) that of X_BC and the factors of the scanner correction, where there is one. ``clock`` of the scanner and
    ``clock_covariance`` (6 + K, 6 + K) of X_BC and its offset (s), drift and rolling time (s), as far as they were
    estimated, where the calibration was made in motion. With the ``configuration`` eye_in_hand ``X_BC`` holds X_FC, and
    ``target`` the centre (3,) m and normal (3,) of what was seen, in the base. ``axis_turn_deg`` how far the hole
    pattern is turned about the flange's axis, and its spread over the scans. ``local_field``: document of what --refine
    local found, ``kinematics_file``: name of the file beside it with what --refine joints or links found,
    ``arm_errors`` the document of it (values, sigmas, covariance with X_BC and the correction). ``orientations``: mean
    (quaternion wxyz) of the flange's in the base, and how far they lie from it at most (deg). ``observed``: the poses
    used, for what a touch of the arm states.
    """

    X_BC: RigidTransform
    covariance: Array
    held_out_mm: dict[str, float]
    tilt_deg: dict[str, float | None]
    poses: tuple[PoseRecord, ...]
    icp: tuple[IcpRecord, ...] = ()
    unobservable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    robot: str = ""
    flange: str = ""
    scanner: str = ""
    sigma_position_mm: float = 0.0
    sigma_normal_deg: float = 0.0
    seed: int = 0
    data_hashes: dict[str, str] = field(default_factory=dict)
    scanner_correction: dict[str, Any] | None = None
    joint_covariance: Array | None = None
    axis_turn_deg: tuple[float, float] | None = None
    software: str = ""
    clock: ScannerClock | None = None
    clock_covariance: Array | None = None
    configuration: str = ON_BASE
    target: tuple[Array, Array] | None = None
    local_field: dict[str, Any] | None = None
    kinematics_file: str = ""
    arm_errors: dict[str, Any] | None = None
    orientations: dict[str, Any] | None = None
    observed: dict[str, Any] | None = None

    @property
    def symbol(self) -> str:
        """Name of the pose: X_BC, or X_FC of a scanner on the flange."""
        return "X_BC" if self.configuration == ON_BASE else "X_FC"

    def correct(self, points_C: ArrayLike) -> Array:
        """Correct measured points of the camera frame for the scanner's own errors, as the pose expects them.

        Args:
            points_C: (N, 3), or organised (H, W, 3), in metres; or a point cloud of Open3D.

        Returns:
            The corrected points, m, in the same shape; the same points where the result has no `scanner_correction`.
            NaN stays NaN.

        Raises:
            InputError: not three coordinates for each point.
        """
        correction = correction_from_document(self.scanner_correction)
        points = np.asarray(getattr(points_C, "points", points_C), dtype=float)
        if points.ndim < 1 or points.shape[-1] != 3:
            raise InputError(f"Points must be (N, 3) or (H, W, 3) in metres; these are {points.shape}.")
        return points if correction is None else correction.points(points)


def software_version() -> str:
    """Name and version of this software, for the record."""
    try:
        return f"weldcal {version('weldcal')}"
    except PackageNotFoundError:
        return "weldcal (not installed)"


def matrix4(X: RigidTransform) -> list[list[float]]:
    """4 x 4 homogeneous matrix as nested lists."""
    return [[float(v) for v in row] for row in X.GetAsMatrix4()]


def pose_document(X: RigidTransform) -> dict[str, Any]:
    """Return a pose as plain values: its matrix, position (m) and quaternion."""
    q = X.rotation().ToQuaternion().wxyz()
    return {"matrix": matrix4(X), "xyz": [float(v) for v in X.translation()], "wxyz": [float(v) for v in q]}


def pose_of_document(section: DocumentSection, refusal: str) -> RigidTransform:
    """The pose of a document's ``matrix``. Raises InputError where it is not rigid, or not that of xyz and wxyz."""
    M = section.array("matrix", 4, 4)
    if not np.allclose(M[:3, :3] @ M[:3, :3].T, np.eye(3), atol=1e-6) or np.linalg.det(M[:3, :3]) < 0.0:
        raise InputError(refusal)
    for key, own in list(pose_document(X := as_transform(M)).items())[1:]:
        if section.has(key) and not np.allclose(section.array(key, len(own)), own, atol=1e-5):  # five printed decimals
            raise InputError(f"'{section.file}': {section.place}.matrix and {section.place}.{key} differ: change both.")
    return X


def save_result(result: CalibrationResult, folder: Path) -> Path:
    """Write ``calibration.yaml`` in ``folder``; returns its path."""
    parent = "base" if result.configuration == ON_BASE else "flange"
    document = {
        "schema": 1,
        "software": result.software or software_version(),
        "robot": result.robot,
        "flange": result.flange,
        "scanner": result.scanner,
        "configuration": result.configuration,
        result.symbol: pose_document(result.X_BC),
        "covariance": _matrix(
            f"rotation (rad) then translation (m), on the {parent} side about the camera origin", result.covariance
        ),
        **({} if result.target is None else {"target": target_document(result.target)}),
        "scanner_correction": result.scanner_correction,
        "joint_covariance": _matrix(
            "as covariance, then the scanner correction's factors: scale, gradient_per_m, bend_per_m2, bend_per_m3",
            result.joint_covariance,
        ),
        "clock": None if result.clock is None else result.clock.document(),
        "clock_covariance": _matrix(
            "as covariance, then offset (s), drift (s/s) and rolling time (s), as far as the clock has them",
            result.clock_covariance,
        ),
        "axis_turn_deg": None if result.axis_turn_deg is None else list(result.axis_turn_deg),
        **{key: value for key in _WHERE_KNOWN if (value := getattr(result, key)) not in (None, "")},
        "held_out_mm": {k: v if np.isfinite(v) else None for k, v in result.held_out_mm.items()},
        "tilt_deg": result.tilt_deg,
        "sigma_position_mm": result.sigma_position_mm,
        "sigma_normal_deg": result.sigma_normal_deg,
        "icp": [_plain(asdict(r)) for r in result.icp],
        "unobservable": list(result.unobservable),
        "warnings": list(result.warnings),
        "poses": [_plain(asdict(r)) for r in result.poses],
        "seed": result.seed,
        "data_sha256": dict(result.data_hashes),
    }
    path = folder / RESULT_FILE
    write_atomic(path, yaml_dump(document))
    return path


_WHERE_KNOWN = ("local_field", "kinematics_file", "orientations", "observed", "arm_errors")


def _matrix(order: str, C: Array | None) -> dict[str, Any] | None:
    return None if C is None else {"order": order, "matrix": [[float(v) for v in row] for row in C]}


def target_document(target: tuple[Array, Array]) -> dict[str, list[float]]:
    """Return a fixed target's centre (m) and normal in the base as plain values."""
    return {"xyz": [float(v) for v in target[0]], "normal": [float(v) for v in target[1]]}


def _opened(path: Path) -> tuple[Path, Any]:
    """Return the path of a result's file and its contents."""
    path = Path(path)
    path = path / RESULT_FILE if path.is_dir() else path
    require_whole(path)
    if not path.exists():
        raise InputError(f"There is no calibration at '{path}'; give a folder written by 'weldcal calibrate'.")
    return path, read_document(path)


def load_correction(path: Path) -> ScannerCorrection | None:
    """Read the scanner correction of any calibration.yaml (or the folder that holds it); None where it has none.

    Raises InputError: the file is missing or no calibration, or its correction cannot be read.
    """
    path, document = _opened(path)
    if not isinstance(document, dict) or not {"X_BC", "X_FC", "scanner_correction"} & set(document):
        raise InputError(f"'{path}' is not a calibration result; give a folder written by 'weldcal calibrate'.")
    return correction_from_document(document.get("scanner_correction"), path.name)


def load_result(path: Path) -> CalibrationResult:
    """Read a calibration.yaml (or the folder that holds it).

    Raises InputError, with the file and the key, when it is missing, not a calibration, holds a value of the wrong
    kind, or its rotation is not orthonormal.
    """
    path, document = _opened(path)
    if isinstance(document, dict) and "X_FC" in document:
        raise InputError(
            f"'{path}' is the calibration of a scanner on the flange (X_FC). Give one of a scanner beside the robot."
        )
    if not isinstance(document, dict) or not {"schema", "X_BC", "covariance"} <= set(document):
        raise InputError(f"'{path.name}' is not a calibration result; run 'weldcal calibrate' again.")
    d = DocumentSection.of(path.name, document)
    if d.values["schema"] != 1:
        raise InputError(f"'{path.name}' is not a calibration result of schema 1; run 'weldcal calibrate' again.")
    refusal = f"The rotation in '{path.name}' is not orthonormal; the file was changed by hand."
    X_BC = pose_of_document(d.section("X_BC"), refusal)
    covariance = _covariance(d, "covariance", 6)
    correction_from_document(d.values.get("scanner_correction"), path.name)  # it can be read
    joint = None
    if d.has("joint_covariance"):
        size = len(d.section("joint_covariance").items("matrix"))
        if size not in (6, *(6 + terms for terms in TERMS.values())):
            raise d.section("joint_covariance").wrong("matrix", "as large as X_BC and a scanner correction")
        joint = _covariance(d, "joint_covariance", size)
    turn = d.array("axis_turn_deg", 2) if d.has("axis_turn_deg") else None
    return CalibrationResult(
        X_BC=X_BC,
        covariance=covariance,
        held_out_mm={k: float("nan") if v is None else v for k, v in d.numbers("held_out_mm").items()},
        tilt_deg=d.numbers("tilt_deg"),
        poses=d.records("poses", PoseRecord),
        icp=d.records("icp", IcpRecord),
        unobservable=d.texts("unobservable"),
        warnings=d.texts("warnings"),
        robot=d.text("robot"),
        flange=d.text("flange"),
        scanner=d.text("scanner"),
        sigma_position_mm=d.number("sigma_position_mm", 0.0, low=0.0),
        sigma_normal_deg=d.number("sigma_normal_deg", 0.0, low=0.0),
        seed=d.whole("seed"),
        data_hashes={str(name): d.section("data_sha256").text(name) for name in d.section("data_sha256").values},
        scanner_correction=d.values.get("scanner_correction"),
        joint_covariance=joint,
        axis_turn_deg=None if turn is None else (float(turn[0]), float(turn[1])),
        software=d.text("software"),
        local_field=d.values.get("local_field"),
        kinematics_file=d.text("kinematics_file"),
        arm_errors=d.values.get("arm_errors"),
        orientations=d.values.get("orientations"),
        observed=d.values.get("observed"),
        clock=clock_from_document(d.values.get("clock"), path.name),
        clock_covariance=(
            _covariance(d, "clock_covariance", len(d.section("clock_covariance").items("matrix")))
            if d.has("clock_covariance")
            else None
        ),
    )


def _covariance(d: DocumentSection, key: str, size: int) -> Array:
    """Return the matrix (size, size) of a covariance. Raises InputError where it is none."""
    C = d.section(key).array("matrix", size, size)
    scale = np.sqrt(np.abs(np.diag(C)))
    scale[scale == 0.0] = 1.0
    unit = C / np.outer(scale, scale)  # radians and metres: each direction in its own size
    if not np.allclose(unit, unit.T, atol=1e-6) or float(np.linalg.eigvalsh(0.5 * (unit + unit.T)).min()) < -1e-6:
        raise InputError(
            f"'{d.file}': {key}.matrix is no covariance (not symmetric, or not positive); the file was changed by hand."
        )
    return C


def export_urdf(
    X_BC: RigidTransform, parent: str = "base", child: str = "scanner_optical_frame", note: str | None = None
) -> str:
    """Return a xacro file for `xacro:include` into a robot that has the parent link.

    The child link on a fixed joint, one root element.
    """
    roll, pitch, yaw = X_BC.rotation().ToRollPitchYaw().vector()
    x, y, z = X_BC.translation()
    # two hyphens may not stand in an XML comment
    said = "" if note is None else f"  <!-- {note.replace('--', '')} -->\n"
    return (
        f'<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="{child}">\n'
        f"  <!-- Include this file in the description of the robot, which defines the link {parent}. -->\n{said}"
        f'  <link name="{child}"/>\n  <joint name="{parent}_to_{child}" type="fixed">\n'
        f'    <parent link="{parent}"/>\n    <child link="{child}"/>\n'
        f'    <origin xyz="{x:.9f} {y:.9f} {z:.9f}" rpy="{roll:.9f} {pitch:.9f} {yaw:.9f}"/>\n  </joint>\n</robot>\n'
    )


def export_ros2(X_BC: RigidTransform, parent: str = "base", child: str = "scanner_optical_frame") -> str:
    """Return the command line of ROS 2's static transform publisher."""
    x, y, z = X_BC.translation()
    qw, qx, qy, qz = _wxyz(X_BC)
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {x:.9f} --y {y:.9f} --z {z:.9f} "
        f"--qx {qx:.9f} --qy {qy:.9f} --qz {qz:.9f} --qw {qw:.9f} --frame-id {parent} --child-frame-id {child}\n"
    )


def export_ur_pose(X_BC: RigidTransform) -> str:
    """Return a URScript pose: position m and rotation vector rad."""
    return "p[" + ", ".join(f"{v:.9f}" for v in (*X_BC.translation(), *rotation_vector(X_BC.rotation()))) + "]\n"


def correction_hint(symbol: str, file: Path | str = RESULT_FILE) -> str:
    """Where a user of the pose finds the scanner correction: the command and the Python call that apply it."""
    call = f", in Python weldcal.read_calibration({str(file)!r}).correct(points)" if symbol == "X_BC" else ""
    return (
        f"{symbol} applies to corrected scanner points: 'weldcal apply {shlex.quote(str(file))}' and the name of a scan"
        f" writes them{call}."
    )


def correction_note(result: CalibrationResult, file: Path | str | None = None) -> str | None:
    """Note for users of X_BC that it applies to corrected points; None where it needs none.

    Args:
        file: the calibration.yaml, for a reader who can use it; None: for another program, with the correction as a
            formula.
    """
    said = []
    correction = correction_from_document(result.scanner_correction)
    if correction is not None and file is not None:
        said.append(correction_hint(result.symbol, file))
    elif correction is not None:
        said.append(
            "X_BC applies to corrected scanner points: multiply every point (x, y, z), in metres, by "
            f"{correction.formula} before use, or calibrate with --no-scanner-correction."
        )
    if result.local_field is not None:
        said.append(
            "This format cannot hold the local field (--refine local) of calibration.yaml: without it errors are those"
            " of the plain calibration."
        )
    if result.kinematics_file:
        said.append(f"X_BC belongs to the arm with the kinematics of {result.kinematics_file}.")
    return " ".join(said) or None


def result_parent(result: CalibrationResult) -> str:
    """Return the frame, as ROS calls it, that the scanner is fixed in."""
    return "base" if result.configuration == ON_BASE else "tool0"


def export_json(result: CalibrationResult) -> str:
    """X_BC and covariance for other programs."""
    return json.dumps(
        {
            "parent": result_parent(result),
            "child": "scanner_optical_frame",
            result.symbol: matrix4(result.X_BC),
            "xyz": [float(v) for v in result.X_BC.translation()],
            "quaternion_wxyz": list(_wxyz(result.X_BC)),
            "covariance_rotation_translation": np.asarray(result.covariance).tolist(),
            "scanner_correction": result.scanner_correction,
            "note": correction_note(result),
        },
        indent=2,
    )


def export_all(result: CalibrationResult, folder: Path) -> tuple[Path, ...]:
    """Write every export into ``folder``; returns the paths."""
    note, parent = correction_note(result), result_parent(result)
    comment = "" if note is None else f"# {note}\n"
    files = {
        "scanner.urdf.xacro": export_urdf(result.X_BC, parent, note=note),
        "static_transform.sh": comment + export_ros2(result.X_BC, parent),
        "ur_pose.script": comment + export_ur_pose(result.X_BC),
        f"{result.symbol}.json": export_json(result),
    }
    for name, text in files.items():
        write_atomic(folder / name, text)
    return tuple(folder / name for name in files)


def _wxyz(X: RigidTransform) -> tuple[float, float, float, float]:
    q: Quaternion = X.rotation().ToQuaternion()
    return float(q.w()), float(q.x()), float(q.y()), float(q.z())


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    return {k: list(v) if isinstance(v, tuple) else v for k, v in record.items()}
