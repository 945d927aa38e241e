"""The results of `weldcal profiler edge`, `sphere`, `compensate` and `seam`, with their first screens."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.first_screen import (
    Expected,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    expected_error,
    point_covariance,
)
from weldcal.tools.outcomes.poses import radius_95

WORDS = "pose of the scan plane S in the robot's flange F"
_LOST = {
    "without_feature": "{n} of {all} profiles show no edge and were not used.",
    "without_sphere": "{n} of {all} profiles show no sphere and were not used.",
    "without_groove": "{n} of {all} profiles show no groove.",
    "outlier_scans": "{n} of {all} points lie off the edge and were not used.",
    "wrong_scans": "{n} of {all} scans lie off the sphere and were not used.",
}
_GRAVE = {"wrong_sides": "The side of the sphere's centre is likely wrong in {n} of {all} scans: check their sign."}


def pose_of(record: ProfilerRecord) -> RigidTransform:
    """X_FS of a record."""
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation)


def middle_error_mm(record: ProfilerRecord, points_F: Array) -> float | None:
    """Error at 95 % (mm) of a profile point in the middle of the points (n, 3) m in F, of the calibration itself; None: it states none."""
    if record.covariance is None or not len(points_F):
        return None
    S = point_covariance(pose_of(record), record.covariance, np.asarray(points_F).mean(axis=0))
    return 1e3 * radius_95(S)


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerFile:
    """A calibration of a profiler from a file: ``found`` are values of its JSON object, ``points`` (n, 2) m those that were measured in
    the scan plane, ``held_out_mm`` (k,) the errors of scans that their calibration did not use."""

    record: ProfilerRecord
    found: Mapping[str, Any]
    points: Array
    held_out_mm: Array
    source: str
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen. The work point is the middle of the profile points; the error is the larger of two at 95 %."""
        own = middle_error_mm(self.record, self.record.points_F(self.points))
        held = self.held_out_mm[np.isfinite(self.held_out_mm)]
        p95 = float(np.percentile(held, 95)) if len(held) else float("nan")
        what = "error in the middle of the profiles, 95 %"
        expected, larger = expected_error(what, own, p95, len(held), "scans")
        tolerance = None
        if self.limit_mm is not None:
            tolerance = Tolerance(f"the {what},", larger, self.limit_mm, "--limit-mm")
        grave, notes = scan_notes(self.found)
        found = Findings(
            tolerance=tolerance,
            unseen=len(held),
            concerns=(*self.found.get("warnings", ()), *grave),
            notes=notes,
        )
        pose = ShownPose("X_FS", WORDS, pose_of(self.record))
        return FirstScreen(found, expected, self._next(), (pose,))

    def _next(self) -> Next:
        after = self.found.get("next_poses")
        if after:
            p, w = 1e3 * np.array(after["poses"][0][:3]), after["poses"][0][3:]
            return Next(
                f"To know it better, add a scan with the flange at ({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f}) mm, rotation vector "
                f"({w[0]:.3f}, {w[1]:.3f}, {w[2]:.3f}) rad."
            )
        return Next("Map a groove with it and touch some of its points; --plan 3 proposes poses to add.",
                    f"weldcal profiler seam SCANS --calibration {self.out}")  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerSeam:
    """A groove that was mapped into the base: ``found`` are values of the JSON object, ``root_mm`` (n, 3) the root in B."""

    record: ProfilerRecord
    found: Mapping[str, Any]
    root_mm: Array
    source: str
    calibration: Path
    out: Path
    limit_mm: float | None = None

    @property
    def first(self) -> FirstScreen:
        """The first screen. No pose is computed: X_FS is that of the calibration. No point of the groove is known otherwise."""
        own, n = self.found["error_95_mm"], self.found["found"]
        fit = f"{n} profiles fit their groove with {self.found['rms_mm']:.3f} mm rms (median)"
        what = "error of a mapped point, 95 %"
        if own is None:
            expected = Expected(what, "not known", f"the calibration states no uncertainty; {fit}")
        else:
            expected = Expected(
                what,
                f"{own:.3f} mm",
                f"of the profiler's calibration; {fit}; no point of the groove was measured otherwise",
            )
        tolerance = None
        if self.limit_mm is not None:
            tolerance = Tolerance(f"the {what},", float("nan") if own is None else own, self.limit_mm, "--limit-mm")
        grave, notes = scan_notes(self.found)
        found = Findings(tolerance=tolerance, concerns=(*self.found.get("warnings", ()), *grave), notes=notes)
        after = Next("Touch some points of the groove with a pointer of known length, and compare them with seam.csv.")
        pose = ShownPose("X_FS", f"{WORDS}, as calibrated in {self.calibration}", pose_of(self.record))
        return FirstScreen(
            found,
            expected,
            after,
            (pose,),
            {"seam": f"{n} of {self.found['scans']} profiles show it; seam.csv holds it in the base"},
        )


def scan_notes(found: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Sentences on scans that were not used: those that put the result in doubt, and the others."""

    def said(words: Mapping[str, str]) -> list[str]:
        return [text.format(n=len(found[key]), all=found["scans"]) for key, text in words.items() if found.get(key)]

    return said(_GRAVE), said(_LOST)
