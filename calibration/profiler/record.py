"""Reads and writes profiler.yaml: pose, covariance, sensor and arm corrections, and the hashes of the data."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import pose_document, pose_of_document, software_version
from weldcal.calibration.profiler.arm_errors import OFFSET_JOINTS, SAG_JOINTS, DhArm
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.result import ProfilerEstimate
from weldcal.calibration.profiler.sphere.joint import SphereEstimate
from weldcal.calibration.profiler.sphere.model import corrected
from weldcal.models.documents import DocumentSection, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole, write_atomic

RECORD_FILE = "profiler.yaml"
JSON_FILE = "X_FS.json"


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerRecord:
    """Calibration that maps a profile point into the base frame, with its uncertainty.

    Attributes:
        rotation (3, 3), translation (3,) m: X_FS; covariance (6, 6) [rotation in F; translation] or None (paper's
            methods). affine (3,), origin (2,) m: the sensor's correction; tip (3,) m in F or None.
        arm: its table as it was found where joints were corrected, with offsets (4,) rad of joints 2 to 5 and sag (2,)
            rad/m.
        figures: what the command reports of the fit; data_sha256: of the file it came from.
    """

    method: str
    rotation: Floats
    translation: Floats
    covariance: Floats | None = None
    affine: Floats = field(default_factory=lambda: np.zeros(3))
    origin: Floats = field(default_factory=lambda: np.zeros(2))
    tip: Floats | None = None
    arm: DhArm | None = None
    offsets: Floats = field(default_factory=lambda: np.zeros(len(OFFSET_JOINTS)))
    sag: Floats = field(default_factory=lambda: np.zeros(len(SAG_JOINTS)))
    figures: dict[str, Any] = field(default_factory=dict)
    data_sha256: str = ""

    @staticmethod
    def of(
        method: str, e: ProfilerEstimate, figures: dict[str, Any], data_sha256: str, arm: DhArm | None = None
    ) -> ProfilerRecord:
        """Of an edge's or a sphere's estimate; arm, as it is drawn, only where its joints were corrected."""
        plain = ProfilerRecord(
            method=method,
            rotation=e.rotation,
            translation=e.translation,
            covariance=e.covariance,
            figures=figures,
            data_sha256=data_sha256,
        )
        if not isinstance(e, SphereEstimate):
            return plain
        table, errors = None if arm is None else arm.changed(e.arm_errors.table), e.arm_errors
        return replace(
            plain, affine=e.affine, origin=e.origin, tip=e.tip, arm=table, offsets=errors.offsets, sag=errors.sag
        )

    def points_F(self, points: Floats) -> Floats:
        """Profile points (n, 2) m in F (n, 3)."""
        return np.asarray(
            corrected(np.asarray(points, float), self.affine, self.origin) @ self.rotation.T + self.translation
        )

    def flange(self, poses: FlangePoses, q: Floats | None) -> FlangePoses:
        """Flange poses as the corrected arm has them; as given where the calibration corrects no joints.

        Raises:
            InputError: the calibration corrects joints, and there are none.
        """
        if self.arm is None:
            return poses
        if q is None:
            raise InputError(
                "This calibration corrects the arm's joints: give the joints q with the scans, or calibrate"
                " with --model affine."
            )
        return self.arm.poses(q, self.offsets, self.sag, self.arm.loads(q))


def save_record(record: ProfilerRecord, folder: Path) -> tuple[Path, Path]:
    """Write profiler.yaml and X_FS.json into a folder; their paths."""
    X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation)
    pose = pose_document(X)
    covariance = None
    if record.covariance is not None:
        covariance = {
            "order": "rotation vector (rad) in the flange frame, then translation (m)",
            "matrix": record.covariance.tolist(),
        }
    document = {
        "schema": 1,
        "software": software_version(),
        "method": record.method,
        "units": "m, rad",
        "X_FS": pose,
        "covariance": covariance,
        "sensor": {"x_scale_z_scale_shear": record.affine.tolist(), "origin": record.origin.tolist()},
        "tip_F": None if record.tip is None else record.tip.tolist(),
        "arm": (
            None
            if record.arm is None
            else {"dh": record.arm.rows.tolist(), "offsets": record.offsets.tolist(), "sag": record.sag.tolist()}
        ),
        "figures": record.figures,
        "data_sha256": record.data_sha256,
    }
    paths = folder / RECORD_FILE, folder / JSON_FILE
    write_atomic(paths[0], yaml_dump(document))
    exported = {"parent": "flange", "child": "profiler", "X_FS": pose, "covariance": covariance}
    write_atomic(paths[1], json.dumps(exported, indent=2) + "\n")
    return paths


def load_record(path: Path) -> ProfilerRecord:
    """Read a profiler.yaml, or the folder that holds it.

    Raises:
        InputError: it is not there, or no profiler's calibration.
    """
    path = path / RECORD_FILE if path.is_dir() else path
    require_whole(path)
    if not path.exists():
        raise InputError(
            f"There is no calibration at '{path}': give a folder written by 'weldcal profiler edge' or 'sphere'."
        )
    document = read_document(path)
    if not isinstance(document, dict) or document.get("schema") != 1 or "X_FS" not in document:
        raise InputError(f"'{path.name}' is no profiler's calibration: run 'weldcal profiler edge' or 'sphere' again.")
    d = DocumentSection.of(path.name, document)
    refusal = f"'{path.name}' was changed by hand: run 'weldcal profiler edge' or 'sphere' again."
    X_FS = pose_of_document(d.section("X_FS"), refusal)
    sensor, table = d.section("sensor"), d.section("arm")
    arm, offsets, sag = None, np.zeros(len(OFFSET_JOINTS)), np.zeros(len(SAG_JOINTS))
    if d.has("arm"):
        arm = DhArm.checked(table.array("dh", -1, 4))
        offsets, sag = table.array("offsets", len(offsets)), table.array("sag", len(sag))
    return ProfilerRecord(
        method=d.text("method"),
        rotation=X_FS.rotation().matrix(),
        translation=np.asarray(X_FS.translation()),
        covariance=d.section("covariance").array("matrix", 6, 6) if d.has("covariance") else None,
        affine=sensor.array("x_scale_z_scale_shear", 3),
        origin=sensor.array("origin", 2),
        tip=d.array("tip_F", 3) if d.has("tip_F") else None,
        arm=arm,
        offsets=offsets,
        sag=sag,
        figures=dict(d.section("figures").values),
        data_sha256=d.text("data_sha256"),
    )
