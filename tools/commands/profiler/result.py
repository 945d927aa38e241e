"""Hold what `edge`, `sphere` and `compensate` share: options, sigmas, and the files of a calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.results import matrix4
from weldcal.calibration.profiler.edge.joint import EdgeEstimate
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.calibration.profiler.result import ProfilerEstimate, believed_covariance
from weldcal.calibration.profiler.sensor import SensorCorrection, load_correction
from weldcal.calibration.profiler.sphere.joint import SphereEstimate
from weldcal.models.errors import InputError
from weldcal.tools import console
from weldcal.tools.cli.options import Call, Outcome, option
from weldcal.tools.commands.profiler.files import Measurements, PosesStated, read_profiler_file
from weldcal.tools.report.profiler_file import NUMBERS, ProfilerBead, ProfilerFile, ProfilerSeam, profiler_report
from weldcal.tools.report.render import write_atomic

CANDIDATES = 300
Estimate = TypeVar("Estimate", EdgeEstimate, SphereEstimate)
_MANY = 2000  # points of a report's picture

FileArgument = Annotated[
    Path, typer.Argument(metavar="FILE", help="Measurements, a profiler's export or a folder (docs/profiler.md).")
]
UnitOption = Annotated[str | None, option("--unit", "U", "m or mm, where the file does not state its unit.")]
PosesOption = Annotated[
    Path | None, option("--poses", "FILE", "The flange's pose of each profile, where the export has none.")
]
PlanOption = Annotated[int, option("--plan", "N", "Also propose N poses to add next.", min=0)]
RadiusOption = Annotated[float | None, option("--radius", "MM", "Radius of the sphere, in place of the file's.")]
TouchesOption = Annotated[Path | None, option("--touches", "FILE", "CSV of flange poses at touches of the sphere.")]
TipOption = Annotated[str, option("--tip", "X,Y,Z", "The torch's tip in the flange frame, mm.")]


def read_measurements(
    call: Call, file: Path, unit: str | None, poses: Path | None, posed: bool = True, alone: bool = True
) -> Measurements:
    """Read a file as --as states it, with the flange's poses if ``posed``; ``alone``: no other file is read with it."""
    stated = PosesStated(poses, call.reading.get("robot-form", ""), call.reading.get("pitch"))
    known = {"dataset": call.reading.get("set", ""), "trial": call.reading.get("trial")}
    return read_profiler_file(file, unit=unit, **known, stated=stated, posed=posed, alone=alone)


def stated_correction(call: Call, profiles: Sequence[Floats]) -> SensorCorrection | None:
    """Return the sensor correction that --as states, if it is of the sensor of these profiles; None without it."""
    if "sensor-correction" not in call.reading:
        return None
    correction = load_correction(call.reading["sensor-correction"])
    correction.require_same_sensor(profiles)
    return correction


def with_warnings(data: Measurements, found: Mapping[str, Any]) -> dict[str, Any]:
    """What was found, with the warnings about the file first."""
    whole = {**found, **({"warnings": [*data.warnings, *found.get("warnings", [])]} if data.warnings else {})}
    if data.reading:
        whole["reading"] = {who: dict(words) for who, words in data.reading.items()}
        whole["read_as"] = " ".join(understood(data))
    return whole


def understood(data: Measurements) -> list[str]:
    """How the profiles and the poses were understood, a sentence each."""
    lines = []
    for who, words in data.reading.items():
        out = len(left) if isinstance(left := words.get("left_out"), list) else 0
        rest = f", {out} rows left out" if out else ""
        form = f" as {words['form']}" if words.get("form") else ""
        lines.append(
            f"{'Profiles' if who == 'profiles' else 'Poses'} of '{words['file']}'{form} in {words['unit']}{rest}."
        )
    return [*lines, *data.notes]


def outcome_of(call: Call, found: Mapping[str, object], made: ProfilerFile | ProfilerSeam | ProfilerBead) -> Outcome:
    """What is printed of a result."""
    warnings = found.get("warnings")
    # the first screen has them, and the JSON object has no first screen
    for sentence in warnings if isinstance(warnings, list) and call.json else []:
        console.emit_warning(str(sentence))
    rows: dict[str, str] = {}
    for key in NUMBERS:
        numbers = found.get(key)
        if isinstance(numbers, list) and numbers:
            rows[key.replace("_", " ")] = ", ".join(map(str, numbers))
    after = found.get("next_poses")
    if isinstance(after, dict):
        for k, pose in enumerate(after["poses"]):
            place = ", ".join(f"{1e3 * v:.1f}" for v in pose[:3])
            turn = ", ".join(f"{v:.4f}" for v in pose[3:])
            left = after["rms_before_and_after_each_mm"]
            rows[f"add pose {k + 1}"] = f"{place} mm, {turn} rad: {left[k]:.3f} to {left[k + 1]:.3f} mm in the field"
    values = {k: v for k, v in found.items() if v != [] and k not in ("warnings", "reading")}
    return Outcome({"state": "done", **found, "written_to": str(made.out)}, values, rows, first=made.first)


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations of sensor and robot, m; `stated`: given, so that points beyond them are outliers."""

    robot_m: float = 0.03e-3
    x_m: float = 0.05e-3
    z_m: float = 0.06e-3
    stated: bool = True

    def __post_init__(self) -> None:
        if not (self.robot_m >= 0.0 and self.x_m > 0.0 and self.z_m > 0.0):
            raise InputError("The sigmas of x and z must be positive, and the robot's not negative.")

    def times(self, factor: float) -> "Sigmas":
        """Return all of them multiplied by a factor."""
        return Sigmas(factor * self.robot_m, factor * self.x_m, factor * self.z_m, self.stated)


def check_number(poses: FlangePoses, shape: tuple[int, ...], what: str, each: tuple[int, ...] = ()) -> None:
    """Check that an array of this shape has an entry (of the shape ``each``) for every pose. Raises InputError."""
    if shape != (len(poses), *each):
        found = str(shape[0]) if len(shape) == 1 else f"an array of shape {shape}"
        raise InputError(f"{len(poses)} poses need {len(poses)} {what}, not {found}.")


def widened(e: Estimate) -> Estimate:
    """Return the estimate with the covariance that its residuals support."""
    return replace(e, covariance=believed_covariance(e))


def figures_of(e: ProfilerEstimate) -> dict[str, Any]:
    """Sigmas, residual and condition of an estimate, for the JSON object."""
    turn, shift = np.trace(e.covariance[:3, :3]), np.trace(e.covariance[3:, 3:])
    figures: dict[str, Any] = {
        "sigma_rotation_deg": float(np.degrees(np.sqrt(turn))),
        "sigma_translation_mm": 1e3 * float(np.sqrt(shift)),
        "rms_mm": 1e3 * e.rms_m,
        "reduced_chi2": e.reduced_chi2,
        "condition": e.condition,
    }
    if isinstance(e, EdgeEstimate):
        figures["inliers"] = int(e.inliers.sum())
    return figures


def next_poses(candidates: FlangePoses, chosen: tuple[int, ...], rms_m: Floats) -> dict[str, Any]:
    """Return the proposed poses (m, rad) and the error in the field before and after each, for the JSON object."""
    turns = Rotation.from_matrix(candidates.rotation).as_rotvec()
    return {
        "poses": [[float(v) for v in (*candidates.translation[k], *turns[k])] for k in chosen],
        "rms_before_and_after_each_mm": [1e3 * float(v) for v in rms_m],
    }


def write_calibration(record: ProfilerRecord, folder: Path) -> dict[str, Any]:
    """Writes profiler.yaml and X_FS.json; returns the pose for the JSON object."""
    save_record(record, folder)
    return {
        "X_FS": matrix4(RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation))
    }


def finish(
    record: ProfilerRecord,
    found: dict[str, Any],
    points: Floats,
    held_mm: Floats,
    source: str,
    out: Path,
    limit_mm: float | None,
) -> tuple[ProfilerFile, dict[str, Any]]:
    """Write a calibration and its report; the result, and its JSON object without the folder."""
    points = points[np.isfinite(points).all(axis=1)]
    if "reading" in found:
        record = replace(record, figures={**record.figures, "robot_form": found["reading"]["robot"]["reading"]})
    made = ProfilerFile(
        record=record,
        found=found,
        points=points[:: max(1, len(points) // _MANY)],
        held_out_mm=held_mm,
        source=source,
        out=out,
        limit_mm=limit_mm,
    )
    written = write_calibration(record, out)
    write_atomic(out / "report.html", profiler_report(made))
    return made, {**found, **written}
