"""Reads and writes a tablet calibration: tablet.yaml, tablet.json, and exports of the camera's pose on the flange."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import (
    export_ros2,
    export_ur_pose,
    export_urdf,
    pose_document,
    pose_of_document,
    software_version,
)
from weldcal.models.documents import DocumentSection, as_number, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, require_whole, write_atomic

RESULT_FILE = "tablet.yaml"
_CONFIGURATION = "eye_in_hand_tablet"
PARENT, CHILD = "tool0", "camera_optical_frame"


@dataclass(frozen=True, kw_only=True)
class TabletResult:
    """Contents of tablet.yaml.

    ``model``: closed_form, pnp, pnp_free_scale (planar, an upright pen) or of full poses: wrist, pen, pen_and_picture
    (of the last two the camera was calibrated before); ``parameters`` by name, m and rad, and their ``covariance`` in
    that order. ``leave_one_out_mm`` is empty where nothing could be held out. Only of full poses: ``X_FC`` and its
    covariance (6, 6) ([rotation; translation] on the flange side about the camera's origin), ``p_FP_m`` and its
    covariance (3, 3).
    """

    model: str
    parameters: dict[str, float]
    covariance: list[list[float]]
    residual_mm: list[float]
    leave_one_out_mm: list[float | None]
    X_FC: RigidTransform | None = None
    X_FC_covariance: list[list[float]] | None = None
    p_FP_m: list[float] | None = None
    p_FP_covariance: list[list[float]] | None = None
    two_stages: dict[str, Any] | None = None
    other_models: dict[str, float] = field(default_factory=dict)
    unobservable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    data_sha256: dict[str, str] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the result in YAML's and JSON's own types."""
        return {
            "schema": 1,
            "software": software_version(),
            "configuration": _CONFIGURATION,
            "model": self.model,
            "parameters": dict(self.parameters),
            "covariance": self.covariance,
            "X_FC": None if self.X_FC is None else pose_document(self.X_FC),
            "X_FC_covariance": self.X_FC_covariance,
            "p_FP_m": self.p_FP_m,
            "p_FP_covariance": self.p_FP_covariance,
            "residual_mm": self.residual_mm,
            "leave_one_out_mm": self.leave_one_out_mm,
            "two_stages": self.two_stages,
            "leave_one_out_of_other_models_mm": dict(self.other_models),
            "unobservable": list(self.unobservable),
            "warnings": list(self.warnings),
            "data_sha256": dict(self.data_sha256),
        }


def save_tablet_result(result: TabletResult, folder: Path) -> tuple[Path, ...]:
    """Write tablet.yaml, tablet.json and, where the camera's place is known, URDF, ROS 2 and URScript forms of it."""
    document = result.document()
    files = {RESULT_FILE: yaml_dump(document), "tablet.json": json.dumps(document, indent=1, allow_nan=False) + "\n"}
    if result.X_FC is not None:
        files |= {
            "camera.urdf.xacro": export_urdf(result.X_FC, PARENT, CHILD),
            "static_transform.sh": export_ros2(result.X_FC, PARENT, CHILD),
            "ur_pose.script": export_ur_pose(result.X_FC),
        }
    for name, text in files.items():
        write_atomic(folder / name, text)
    return tuple(folder / name for name in files)


def load_tablet_result(path: Path) -> TabletResult:
    """Read a tablet.yaml, or the folder that holds it; raises InputError where it is none."""
    path = path / RESULT_FILE if path.is_dir() else path
    require_whole(path)
    if not path.exists():
        raise InputError(f"There is no tablet calibration at '{path}'; give a folder of 'weldcal tablet calibrate'.")
    document = read_document(path)
    if not isinstance(document, dict) or (document.get("schema"), document.get("configuration")) != (1, _CONFIGURATION):
        raise InputError(f"'{path.name}' is not a tablet calibration of schema 1; run 'weldcal tablet calibrate'.")
    d = DocumentSection.of(path.name, document)
    X_FC = None
    if d.has("X_FC"):
        refusal = f"The rotation of X_FC in '{path.name}' is not orthonormal; the file was changed by hand."
        X_FC = pose_of_document(d.section("X_FC"), refusal)
    n = len(d.items("covariance"))
    left_out = d.items("leave_one_out_mm")
    if not all(v is None or abs(as_number(v)) <= LARGEST_NUMBER for v in left_out):
        raise d.wrong("leave_one_out_mm", "a list of numbers, or of nothing")
    return TabletResult(
        model=d.text("model"),
        parameters=_whole(d, "parameters"),
        covariance=d.array("covariance", n, n).tolist(),
        residual_mm=d.array("residual_mm", -1).tolist(),
        leave_one_out_mm=[None if v is None else as_number(v) for v in left_out],
        X_FC=X_FC,
        X_FC_covariance=d.array("X_FC_covariance", 6, 6).tolist() if d.has("X_FC_covariance") else None,
        p_FP_m=d.array("p_FP_m", 3).tolist() if d.has("p_FP_m") else None,
        p_FP_covariance=d.array("p_FP_covariance", 3, 3).tolist() if d.has("p_FP_covariance") else None,
        two_stages=dict(d.section("two_stages").values) if d.has("two_stages") else None,
        other_models=_whole(d, "leave_one_out_of_other_models_mm"),
        unobservable=d.texts("unobservable"),
        warnings=d.texts("warnings"),
        data_sha256={str(name): d.section("data_sha256").text(name) for name in d.section("data_sha256").values},
    )


def _whole(d: DocumentSection, key: str) -> dict[str, float]:
    """Numbers by name under a key, none of which is missing."""
    found = d.section(key)
    return {str(name): found.number(name) for name in found.values}
