"""Scans by a scanner that the arm carries: each is searched where the arm's pose expects the circle."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from pydrake.common.yaml import yaml_dump

from weldcal.calibration.capture.session import (
    POSES_FILE,
    RESULT,
    Advice,
    ArmPose,
    Capture,
    CaptureTask,
    CaptureVerdict,
    Shown,
    jog,
    jog_joints,
    require_mounting,
)
from weldcal.calibration.data.checks import AUTO, to_metres
from weldcal.calibration.data.clouds import CloudError, read_cloud
from weldcal.calibration.data.header import DatasetHeader, PoseForm, Units
from weldcal.calibration.errors import FlangeNotFound, TooFewPoses, UnreachableScanner
from weldcal.calibration.hand_eye.exports import Provenance, digest, export_hand_eye
from weldcal.calibration.planning.mounting_estimate import Circle, ObservedCircle, fewest, off_prediction, see_circle
from weldcal.calibration.planning.mounting_poses import MountingPlan, MountingPose, plan_mounting_poses
from weldcal.calibration.planning.mounting_scene import FLANGE, MountingScene
from weldcal.calibration.recorded_carried import SAME, CarriedCalibration, Joints, calibrate_carried
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic

_WIDE_M = 0.25  # a choice: radius of the search for a circle that is not where the pose expects it
_APART_M, _APART_GUESS_M = 0.015, 0.05  # a choice: by how much two scans may disagree, with a result and with a guess
_SETTLED_AFTER, _SETTLED = 4, 0.95  # a choice: errors of the last captures, of which the newest is hardly less
_SHUN_RAD, _SAME_RAD = 0.15, 0.03  # a choice: about joints at which a scan was of no use, and about those taken


class CarriedTask:
    """Scans of the flange or of the ring of the base by a scanner on the arm; the folder is that of calibrate."""

    folder = "clouds"
    hint = "Let the scanner see the whole circle from another direction each time, 10 to 30 deg apart."

    def __init__(self, header: DatasetHeader, scene: MountingScene, circle: Circle, plan: MountingPlan) -> None:
        if scene.two:
            raise InputError("Capture has the pose of one arm. Calibrate two by: weldcal calibrate --scenario NAME")
        self._header, self.scene, self._circle, self._plan = header, scene, circle, plan
        self.symbol, self.least = scene.mounting.unknowns["X"].symbol, fewest(scene)
        self._found: CarriedCalibration | None = None
        self._seen, self._known = dict[str, ObservedCircle](), dict[tuple[str, ...], CarriedCalibration]()
        self._shunned: list[Array] = []
        self._poses: tuple[MountingPose, ...] | None = None

    def prepare(self, folder: Path) -> None:
        """See CaptureTask."""
        require_mounting(folder, self._header.configuration)
        header = replace(self._header, schema=1, units=Units(AUTO, AUTO), poses=PoseForm(file=POSES_FILE))
        lines = {k: v for k, v in asdict(header).items() if v not in (None, "", 0.0)}
        write_atomic(folder / "dataset.yaml", yaml_dump(lines))

    def look(self, id: str, path: Path, pose: ArmPose) -> tuple[Shown | None, str]:
        """See CaptureTask."""
        joints = self._joints(pose)
        try:
            points = to_metres(read_cloud(path).astype(float), AUTO, path.name)
        except CloudError as refusal:
            return None, refusal.reason
        try:
            one = see_circle(points, self._belief, id, *joints, self._circle)
        except FlangeNotFound as error:
            with suppress(FlangeNotFound):
                wide = see_circle(points, self._belief, id, *joints, replace(self._circle, guess_radius_m=_WIDE_M))
                off, turn = off_prediction(self._belief, wide, None)
                return wide.fit, (
                    f"The circle lies {1e3 * off:.0f} mm and {np.degrees(turn):.0f} deg from where this pose expects"
                    " it: the pose or the scan is an older one, a TCP is set at the robot, or the mounting_guess is"
                    " wrong."
                )
            else_ = " If it is there, the pose is an older one, or not the flange's." if self._seen else ""
            return None, f"{error} Bring it whole into the scanner's view.{else_}"
        self._seen[id] = one
        return one.fit, ""

    def repeats(self, one: Capture, other: Capture) -> str:
        """See CaptureTask: a turn about the circle's axis shows it as before."""
        return ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See CaptureTask."""
        a, b = self._seen.get(one.id), self._seen.get(other.id)
        if a is None or b is None:
            return ""
        apart = float(np.linalg.norm(self._off(a) - self._off(b)))
        if apart < (_APART_GUESS_M if self._found is None else _APART_M):
            return ""
        return (
            f"This scan and {one.id} put the circle {1e3 * apart:.0f} mm apart, by the poses of the arm: the pose or"
            " the scan is an older one, a TCP is set at the robot, or something was moved."
        )

    def forget(self, id: str, shunned: ArmPose | None = None) -> None:
        """See CaptureTask."""
        self._seen.pop(id, None)
        self._known = {ids: found for ids, found in self._known.items() if id not in ids}
        if shunned is not None:
            self._shunned.append(self._joints(shunned)[0])

    def fresh(self) -> CaptureTask:
        """See CaptureTask."""
        task = CarriedTask(self._header, self.scene, self._circle, self._plan)
        task._found = self._found
        return task

    def solve(self, folder: Path, last: ArmPose) -> CaptureVerdict:
        """See CaptureTask."""
        try:
            found = calibrate_carried(folder, known=self._known).found
        except TooFewPoses as refusal:
            return CaptureVerdict(symbol=self.symbol, said=(str(refusal),), advice=self.first_pose(last))
        result = found.result
        if result is None:
            return CaptureVerdict(symbol=self.symbol, said=(found.message,), advice=self.first_pose(last))
        self._found = found
        held = result.held_out.translation[result.inliers & np.isfinite(result.held_out.translation)]
        error = max(found.error_95_m, *np.percentile(held, [95]) if len(held) else [0.0])
        odd = [
            (s.label, "It disagrees with the others.")
            for s, used in zip(found.seen, result.inliers, strict=True)
            if not used
        ]
        placed = [
            (s.label, self.scene.frames(s.pose.q)[self.scene.link] @ result.X, float(e))
            for s, e in zip(found.seen, result.translation, strict=True)
        ]
        return CaptureVerdict(
            symbol=self.symbol,
            said=(*result.unobservable, *result.warnings, *self._floor(found)),
            X=result.X,
            error_95_m=error,
            odd=(*odd, *found.refused),
            advice=self._next(found, last),
            placed=tuple(placed),
        )

    def _floor(self, found: CarriedCalibration) -> list[str]:
        """A sentence where more captures hardly lower the error."""
        errors = [error for _, error in found.history[-_SETTLED_AFTER:]]
        if len(errors) < _SETTLED_AFTER or errors[-1] < _SETTLED * errors[0]:
            return []
        arm = self.scene.arm_error_m
        return [
            f"The last {_SETTLED_AFTER - 1} captures hardly lowered the error. Most of it is then the arm's: its flange"
            f" is taken to be off by {1e3 * arm:.1f} mm (rms; arm_error_mm in dataset.yaml)."
        ]

    def command(self, folder: Path) -> str:
        """See CaptureTask."""
        return f"weldcal calibrate {shlex.quote(str(folder))}"

    def save(self, folder: Path) -> None:
        """See CaptureTask."""
        made = calibrate_carried(folder)
        if made.found.result is None:
            raise InputError(made.found.message)
        self._found = made.found
        (folder.parent / RESULT).mkdir(exist_ok=True)
        of = Provenance(folder.name, digest(folder / POSES_FILE))
        export_hand_eye(made.found.result, self.scene.mounting, folder.parent / RESULT, of)

    def judge(self, folder: Path, checks: Sequence[Capture]) -> list[tuple[str, float]]:
        """See CaptureTask."""
        if self._found is None or self._found.result is None:
            raise InputError('Press "Use it" first: that result is judged.')
        found, correction = [], self._found.result.correction
        for one in checks:
            points = to_metres(read_cloud(one.file).astype(float), AUTO, one.file.name)
            seen = see_circle(points, self._belief, one.id, *self._joints(one.pose), self._circle)
            found.append((one.id, off_prediction(self._belief, seen, correction)[0]))
        return found

    def first_pose(self, last: ArmPose | None) -> Advice | None:
        """See CaptureTask."""
        last = last or ArmPose(q=self.scene.q_home)
        return self._advice([p for p in self._pool(last) if self._new(p)][:1], last, np.inf, np.inf)

    def _next(self, found: CarriedCalibration, last: ArmPose) -> Advice | None:
        best = found.proposing(self.scene, [p for p in self._pool(last) if self._new(p)]).next_best
        if best is None:
            return None
        pose = MountingPose(best.q, None, self.scene.seen(best.q))
        return self._advice([pose], last, best.before_m, best.after_m)

    def _advice(self, poses: Sequence[MountingPose], last: ArmPose, before: float, after: float) -> Advice | None:
        if not poses:
            return None
        q = poses[0].q
        X_BF, on_link = self.scene.frames(q)[FLANGE], self.scene.link != FLANGE
        words = jog_joints(self._joints(last)[0], q) if on_link else jog(last, X_BF)
        return Advice(X_BF=X_BF, words=words, q=q, sigma_before_m=before, sigma_after_m=after)

    def _pool(self, last: ArmPose) -> tuple[MountingPose, ...]:
        """Poses that show the circle, by what they add; none where the arm reaches none."""
        if self._poses is None:
            scene = replace(self.scene, q_home=self._joints(last)[0])
            self._poses = ()
            with suppress(UnreachableScanner):
                self._poses = plan_mounting_poses(scene, 1, 0, self._plan)
        return self._poses

    def _new(self, pose: MountingPose) -> bool:
        taken = [(s.pose.q, _SAME_RAD) for s in self._seen.values()]
        return all(
            float(np.abs(pose.q - q).max()) > near for q, near in [*taken, *((q, _SHUN_RAD) for q in self._shunned)]
        )

    @property
    def _belief(self) -> MountingScene:
        known = None if self._found is None else self._found.result
        return self.scene if known is None else self.scene.believing(known.poses)

    def _off(self, one: ObservedCircle) -> Array:
        """Where the circle lies (3,) m from where its pose expects it, in the frame of the circle."""
        X_CR = self._belief.seen(one.pose.q, one.pose.q_2)
        return np.asarray(X_CR.inverse() @ one.observation.p_CM)

    def _joints(self, pose: ArmPose) -> Joints:
        """Return the arm's joints at a pose, as `calibrate` takes them. Raises InputError where they are unknown."""
        arm, q, on_link = self.scene.arm, pose.q, self.scene.link != FLANGE
        if q is not None and pose.X_BF is not None:
            q = q if self.scene.frames(q)[FLANGE].IsNearlyEqualTo(pose.X_BF, SAME) else None
            if q is None and on_link:
                raise InputError(
                    f"The joint angles do not lead the {arm.name} to the stated pose: a TCP is set at the robot, or the"
                    " robot is another one."
                )
        if q is None and pose.X_BF is not None and not on_link:
            q = nearest_solution(arm, pose.X_BF, self.scene.q_home if pose.q is None else pose.q)
        if q is None:
            raise InputError(
                "A scanner that the arm carries needs the arm's joint angles: read them with --poses."
                if on_link
                else f"The {arm.name} does not reach this pose, or it is typed: read poses with --poses."
            )
        return q, None
