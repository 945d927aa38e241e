"""Profiles of an edge or a sphere, captured by hand: each is judged, and all of them calibrate the profiler."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.capture.session import (
    POSES_FILE,
    RESULT,
    Advice,
    ArmPose,
    Capture,
    CaptureTask,
    CaptureVerdict,
    Shown,
    ShownProfile,
    jog,
)
from weldcal.calibration.capture.tasks import HOME_Q
from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.calibration.profiler.depth_sign import with_sign
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.commands.profiler.edge import FEATURES, calibrate_edge, edge_held_out, edge_shown, point_of_edge
from weldcal.tools.commands.profiler.files import PosesStated, read_profiler_file
from weldcal.tools.commands.profiler.result import Sigmas, finish
from weldcal.tools.commands.profiler.sphere import arc_of, calibrate_sphere, decided_sphere, finish_sphere

LEAST = 6  # ten unknowns, two numbers a profile, and one more to judge them
_NEAR = 0.02  # a choice: m and rad; a pose nearer than this adds little
_PROPOSED = 8  # a choice: of so many proposed poses one is in reach
_OTHER = {"left": "right", "right": "left"}
_FORMS = ", ".join([*(f"edge:{kind}" for kind in FEATURES), "sphere:RADIUS_MM"])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Calibrated:
    """A calibration, and the target's points (k, 2) m in each profile that shows it; ``sphere``: its data."""

    record: ProfilerRecord
    found: dict[str, Any]
    poses: FlangePoses
    points: tuple[Floats, ...]
    sphere: SphereData | None = None

    @property
    def points_B(self) -> Floats:
        """The target's points (n, 3) m in the base."""
        each = zip(self.poses.rotation, self.poses.translation, self.points, strict=True)
        return np.vstack([self.record.points_F(p) @ R.T + t for R, t, p in each])


class ProfileTask:
    """Profiles of a laser profiler on the flange; the folder is that of `weldcal profiler edge` or `sphere`."""

    symbol, folder, least = "X_FS", "profiles", LEAST
    hint = "Tilt the flange by 15 to 30 deg about another axis each time, with the target elsewhere in the laser line."

    def __init__(self, target: str, robot: str) -> None:
        self._target, self._robot = target, robot
        kind, _, detail = target.partition(":")
        self._feature, self._radius_m = (detail, 0.0) if kind == "edge" else ("", _metres(detail))
        if not (kind == "edge" and detail in FEATURES) and not (kind == "sphere" and self._radius_m > 0.0):
            raise InputError(f"--profiler must be {_FORMS}, not '{target}'.")
        self._tried = list[ArmPose]()
        self._side, self._used = "left", cast(_Calibrated | None, None)

    def prepare(self, folder: Path) -> None:
        """See CaptureTask."""

    def look(self, id: str, path: Path, pose: ArmPose) -> tuple[Shown | None, str]:
        """See CaptureTask."""
        self._tried.append(pose)
        try:
            profiles = read_profiler_file(path, posed=False).profiles or ()
        except WeldcalError as refusal:
            return None, str(refusal)
        if len(profiles) != 1:
            return None, f"'{path.name}' holds {len(profiles)} profiles: capture one at a time, the arm at rest."
        points = profiles[0]
        try:
            feature = self._shown(points)
        except WeldcalError as refusal:
            return ShownProfile(points=points), f"{refusal} Bring the {self._target.partition(':')[0]} into the line."
        return ShownProfile(points=points, feature=feature), ""

    def repeats(self, one: Capture, other: Capture) -> str:
        """See CaptureTask: a sphere may lie alike in two profiles."""
        return ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See CaptureTask: what does not fit shows as the odd one out."""
        return ""

    def forget(self, id: str, shunned: ArmPose | None = None) -> None:
        """See CaptureTask."""

    def fresh(self) -> CaptureTask:
        """See CaptureTask."""
        task = ProfileTask(self._target, self._robot)
        task._used = self._used
        return task

    def first_pose(self, last: ArmPose | None) -> Advice | None:
        """See CaptureTask."""

    def solve(self, folder: Path, last: ArmPose) -> CaptureVerdict:
        """See CaptureTask."""
        shown = self._calibrated(folder, plan=True)
        record, found = shown.record, shown.found
        ids = [p.stem for p in sorted((folder / self.folder).iterdir())]
        wrong = [*found.get("outlier_scans", ()), *found.get("wrong_scans", ())]
        lost = [*found.get("without_feature", ()), *found.get("without_sphere", ())]
        points, C = np.vstack(shown.points), record.covariance
        assert C is not None
        J = np.hstack([-skew(record.rotation @ np.insert(np.median(points, axis=0), 1, 0.0)), np.eye(3)])
        return CaptureVerdict(
            symbol=self.symbol,
            said=tuple(found.get("warnings", ())),
            X=RigidTransform(RotationMatrix.ProjectToRotationMatrix(record.rotation), record.translation),
            error_95_m=radius_95(J @ C @ J.T),
            odd=(
                *((ids[k], "It disagrees with the others.") for k in wrong),
                *((ids[k], "It does not show the target.") for k in lost),
            ),
            advice=self._next(found.get("next_poses"), last),
        )

    def command(self, folder: Path) -> str:
        """See CaptureTask."""
        kind, _, detail = self._target.partition(":")
        side = " --as side=right" if self._side == "right" else ""
        given = f"--feature {detail}{side}" if kind == "edge" else f"--radius {detail}"
        place, poses = (shlex.quote(str(folder / name)) for name in (self.folder, POSES_FILE))
        return f"weldcal profiler {kind} {place} --poses {poses} {given}"

    def save(self, folder: Path) -> None:
        """See CaptureTask."""
        self._used = shown = self._calibrated(folder)
        out, points = folder.parent / RESULT, np.vstack(shown.points)
        out.mkdir(exist_ok=True)
        if shown.sphere is None:
            held = edge_held_out(shown.poses, points, shown.found["sigmas_mm"])
            finish(shown.record, shown.found, points, held, folder.name, out, None)
        else:
            finish_sphere(shown.sphere, SphereSigmas(), shown.record, shown.found, folder.name, out, None)

    def judge(self, folder: Path, checks: Sequence[Capture]) -> list[tuple[str, float]]:
        """See CaptureTask."""
        if self._used is None:
            raise InputError('Press "Use it" first: that result is judged.')
        used, found = self._used, []
        for one in checks:
            if one.pose.X_BF is None or not isinstance(one.found, ShownProfile):
                raise InputError("Typed poses cannot judge a profiler: read them with --poses.")
            new_B = (one.pose.X_BF @ used.record.points_F(one.found.feature).T).T
            found.append((one.id, self._off(used.points_B, new_B)))
        return found

    def _off(self, seen_B: Floats, new_B: Floats) -> float:
        """How far new points (k, 3) m lie from the edge, or the sphere, that others (n, 3) m show."""
        middle = seen_B.mean(axis=0)
        if not self._radius_m:
            along = np.linalg.svd(seen_B - middle)[2][0]
            away = new_B - middle
            return float(np.linalg.norm(away - np.outer(away @ along, along), axis=1).mean())
        q = seen_B - middle  # |q|^2 = 2 c.q + (R^2 - |c|^2)
        c = np.linalg.lstsq(np.column_stack([2.0 * q, np.ones(len(q))]), (q**2).sum(axis=1))[0][:3]
        return abs(float(np.linalg.norm(new_B - middle - c, axis=1).mean()) - self._radius_m)

    def _shown(self, profile: Floats) -> Floats:
        """Points (k, 2) m of the target in a profile. Raises WeldcalError where it is not there."""
        if self._radius_m:
            return arc_of(profile, self._radius_m, 0)
        for z in ("away", "towards"):
            for side in (self._side, _OTHER[self._side]):
                found, _ = with_sign([profile], partial(point_of_edge, self._feature, side), z)
                if found:
                    return found[0][None]
        raise FeatureNotFound(f"The profile does not show the {self._feature}.")

    def _calibrated(self, folder: Path, plan: bool = False) -> _Calibrated:
        data = read_profiler_file(folder / self.folder, stated=PosesStated(poses=folder / POSES_FILE))
        proposed = _PROPOSED if plan else 0
        if self._radius_m:
            lost: list[int] = []
            data, sphere = decided_sphere(data, radius_m=self._radius_m, lost=lost)
            record, found = calibrate_sphere(sphere, data.digest, Sigmas(0.03e-3, 0.05e-3, 0.05e-3), plan=proposed)
            found |= {"without_sphere": lost}
            return _Calibrated(
                record=record, found=found, poses=sphere.poses, points=tuple(sphere.profiles), sphere=sphere
            )
        sigmas, why = Sigmas(stated=False), list[WeldcalError]()
        for side in (self._side, _OTHER[self._side]):
            try:
                shown = edge_shown(data, sigmas, self._feature, side, "")
                record, found = calibrate_edge(shown, sigmas, plan=proposed)
            except WeldcalError as refusal:
                why.append(refusal)
                continue
            self._side = side
            poses, points = shown.seen()
            return _Calibrated(record=record, found=found, poses=poses, points=tuple(points[:, None]))
        raise why[0]

    def _next(self, proposed: dict[str, Any] | None, last: ArmPose) -> Advice | None:
        """Return the first proposed pose that the arm reaches and has not been in."""
        arm = load_arm(self._robot) if self._robot in known_arms() else None
        if proposed is None:
            return None
        for k, pose in enumerate(proposed["poses"]):
            X_BF = RigidTransform(RotationMatrix(exp_rotation(np.array(pose[3:]))), pose[:3])
            if any(max(one.moved(ArmPose(X_BF=X_BF))) < _NEAR for one in self._tried):
                continue
            if arm is None or nearest_solution(arm, X_BF, HOME_Q if last.q is None else last.q) is not None:
                sigmas = [1e-3 * v for v in proposed["rms_before_and_after_each_mm"]]
                return Advice(X_BF=X_BF, words=jog(last, X_BF), sigma_before_m=sigmas[0], sigma_after_m=sigmas[k + 1])
        return None


def _metres(text: str) -> float:
    try:
        return 1e-3 * float(text)
    except ValueError:
        return 0.0
