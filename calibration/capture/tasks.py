"""What is captured by hand: scans of the flange, or pictures of a board; each looks at one and calibrates from all."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.calibration.capture.session import (
    CHECKS,
    LEAST,
    POSES_FILE,
    RESULT,
    Advice,
    ArmPose,
    Capture,
    CaptureTask,
    CaptureVerdict,
    Shown,
    jog,
    require_mounting,
)
from weldcal.calibration.data.camera_file import read_camera
from weldcal.calibration.data.checks import AUTO, to_metres
from weldcal.calibration.data.clouds import CloudError, read_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import ON_BASE, export_all, save_result
from weldcal.calibration.eye_on_base.estimate import point_error_covariance
from weldcal.calibration.eye_on_base.few_poses import calibrate_from_few
from weldcal.calibration.eye_on_base.observations import FlangeScan, fit_flanges, flange_scan
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.calibration.hand_eye.exports import Provenance, digest, export_hand_eye
from weldcal.calibration.hand_eye.pictures.boards import find_board, parse_board, what_is_there, with_layout
from weldcal.calibration.hand_eye.pictures.search import FEWEST, Picture, load_grey, solutions
from weldcal.calibration.planning.calibration_poses import PlannerConfig, predicted_sigma
from weldcal.calibration.recorded_flange import calibrate_flange
from weldcal.calibration.recorded_hand_eye import HandEyeOptions, RecordedHandEye, calibrate_recorded
from weldcal.calibration.verified_scans import verify_scans
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import write_atomic
from weldcal.models.robots import stated_flange

_APART_M, _APART = 0.01, 0.05  # a choice: centres in two frames differ by less, also with a wrong scale or a small TCP
_SHUN_M, _SHUN_RAD = 0.05, np.radians(15.0)  # a choice: about a pose whose scan was of no use
_CLEARLY_M = 0.02  # a choice: of the arm, which a camera at 3 m would show by several pixels
_EDGE_SEEN = 0.6  # a choice: share of the flange's edge; less leaves its centre open across the missing part
_SHARP_PX = 8.0  # a choice: from dark to bright across an edge; sharp pictures have 2 to 3, soft large ones 5
_SMALL_PX = 8.0  # a choice: between neighbours of a board; a corner is found to a twentieth of it at best
_DARK, _BRIGHT = 40, 230  # a choice: grey values; a board in them has no contrast left
_TRIED = 200  # a choice: the best of so many poses lies in the best 1 % of all (chance 0.87)
_FACE_M = 0.06  # a choice: half the width of a flange and what is about it, ISO 9409-1-80 has 0.05
_WIDER, _ASIDE = 1.15, 0.1  # a choice: how far beyond the places so far the next one may lie; at least so far aside
_TILT_RAD = np.radians(30.0)  # paper, section 2.1.4: the largest angle of the face to the line of sight
HOME_Q = np.radians([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
"""Joint angles of a Universal Robots arm near which the next pose is sought where none are known."""


class FlangeTask:
    """Scans of the flange by a scanner beside the robot; the folder is that of `weldcal calibrate`."""

    symbol, folder, least = "X_BC", "clouds", LEAST
    hint = "Move the flange by 50 to 150 mm and tilt it by 10 to 20 deg, each time in another direction."

    def __init__(self, robot: str, flange: str) -> None:
        self._standard = stated_flange(flange, robot)
        self._robot, self._known = robot, dict[str, FlangeScan]()
        self._X_BC: RigidTransform | None = None
        self._shunned: list[RigidTransform] = []
        self._view = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])  # tangents x/z and y/z that scans reach

    def prepare(self, folder: Path) -> None:
        """See CaptureTask."""
        require_mounting(folder, ON_BASE)
        document = {"schema": 1, "configuration": ON_BASE, "flange": self._standard.designation}
        document |= {"units": {"clouds": "auto", "poses": "auto"}, "poses": {"file": POSES_FILE}}
        write_atomic(folder / "dataset.yaml", yaml_dump(document | ({"robot": self._robot} if self._robot else {})))

    def look(self, id: str, path: Path, pose: ArmPose) -> tuple[Shown | None, str]:
        """See CaptureTask."""
        try:
            points = to_metres(read_cloud(path).astype(float), AUTO, path.name)
        except CloudError as refusal:
            return None, refusal.reason
        xyz = points.reshape(-1, 3)
        tangents = (xyz[:, :2] / xyz[:, 2:])[np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 0.0)]
        if len(tangents):
            low, high = tangents.min(axis=0), tangents.max(axis=0)
            self._view = np.array([np.minimum(self._view[0], low), np.maximum(self._view[1], high)])
        found = self._known[id] = flange_scan(points, self._standard)
        if not isinstance(found, tuple):
            return None, f"{found.reason} Let the flange face the scanner, whole and near the middle of its view."
        fit = found[0]
        if fit.coverage < _EDGE_SEEN:
            return fit, (
                f"Only {100 * fit.coverage:.0f} % of the flange's edge is in the scan: bring it whole into the"
                " scanner's view, with nothing before it."
            )
        return fit, ""

    def repeats(self, one: Capture, other: Capture) -> str:
        """See CaptureTask: an older scan contradicts the arm's moves."""
        return ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See CaptureTask."""
        a, b = one.pose.X_BF, other.pose.X_BF
        if a is None or b is None or not isinstance(one.found, FlangeFit) or not isinstance(other.found, FlangeFit):
            return ""
        robot = float(np.linalg.norm(a.translation() - b.translation()))
        shown = float(np.linalg.norm(one.found.center_C - other.found.center_C))
        if abs(robot - shown) < _APART_M + _APART * max(robot, shown):
            return ""
        return (
            f"Since {one.id} the flange moved by {1e3 * robot:.0f} mm at the robot and by {1e3 * shown:.0f} mm in the"
            " scans: the pose or the scan is an older one, the pose is not in its unit, or it is not the flange's (a"
            " TCP is set at the robot)."
        )

    def forget(self, id: str, shunned: ArmPose | None = None) -> None:
        """See CaptureTask."""
        self._known.pop(id, None)
        if shunned is not None and shunned.X_BF is not None:
            self._shunned.append(shunned.X_BF)

    def fresh(self) -> CaptureTask:
        """See CaptureTask."""
        return FlangeTask(self._robot, self._standard.designation)

    def first_pose(self, last: ArmPose | None) -> Advice | None:
        """See CaptureTask."""

    def solve(self, folder: Path, last: ArmPose) -> CaptureVerdict:
        """See CaptureTask."""
        try:
            found = calibrate_flange(folder, known=self._known)
        except WeldcalError as refusal:
            data = load_dataset(folder, robot=self._robot)
            seen = fit_flanges(data, self._standard, known=self._known)
            with suppress(WeldcalError):  # of few, poses in one plane or at one place are enough for what comes next
                X_BC = self._X_BC or calibrate_from_few(seen.observations[-LEAST:], seen.patterns, None).X_BC
                advice = next_scan(
                    seen.observations, X_BC, (seen.data or data).X_FR, self._robot, last, self._shunned, self._view
                )
                return CaptureVerdict(symbol=self.symbol, said=(str(refusal),), advice=advice)
            raise
        estimate, used = found.estimate, found.inliers
        self._X_BC = estimate.X_BC
        work = np.mean([o.p_BR for o in used], axis=0)
        held = estimate.held_out.position_m[estimate.inliers]
        held = held[np.isfinite(held)]  # as the first screen of calibrate: the larger of both
        error = max(
            radius_95(point_error_covariance(estimate, work)), *np.percentile(held, [95]) if len(held) else [0.0]
        )
        odd = tuple((id, reason) for id, reason in found.refused if id in found.outliers)
        said = (*found.result.unobservable, *found.result.warnings, *found.advice)
        read = found.seen.data
        if read is not None and last.X_BF is None:
            last = ArmPose(X_BF=list(read.poses.values())[-1])
        advice = (
            None
            if read is None
            else next_scan(used, estimate.X_BC, read.X_FR, self._robot, last, self._shunned, self._view)
        )
        off = position_errors(estimate.X_BC, found.observations)
        return CaptureVerdict(
            symbol=self.symbol,
            said=said,
            X=estimate.X_BC,
            error_95_m=error,
            odd=odd,
            advice=advice,
            placed=tuple((o.id, estimate.X_BC, float(e)) for o, e in zip(found.observations, off, strict=True)),
        )

    def command(self, folder: Path) -> str:
        """See CaptureTask."""
        return f"weldcal calibrate {shlex.quote(str(folder))}"

    def save(self, folder: Path) -> None:
        """See CaptureTask."""
        result = calibrate_flange(folder, known=self._known).result
        (folder.parent / RESULT).mkdir(exist_ok=True)
        export_all(result, folder.parent / RESULT)
        save_result(result, folder.parent / RESULT)

    def judge(self, folder: Path, checks: Sequence[Capture]) -> list[tuple[str, float]]:
        """See CaptureTask."""
        return [(p.id, 1e-3 * p.error_mm) for p in verify_scans(folder.parent / RESULT, folder.parent / CHECKS).poses]


class BoardTask:
    """Pictures of a board by a camera on the flange or beside the robot; the folder is that of `weldcal hand-eye`."""

    folder, least = "pictures", FEWEST
    hint = "Turn the flange by 20 to 40 deg about another axis each time, with the whole board in the picture."

    def __init__(self, board: str, mounting: str, robot: str = "", intrinsics: Path | None = None) -> None:
        self._board, self._text, self._mounting = parse_board(board), board, mounting
        self._robot, self._intrinsics, self._known = robot or None, intrinsics, dict[str, Picture]()
        if intrinsics is not None:
            read_camera(intrinsics)  # it can be read
        self._looked = dict[str, Picture]()
        self._used: RecordedHandEye | None = None
        self.symbol = "X_BC" if mounting == "eye_on_base" else "X_FC"

    def prepare(self, folder: Path) -> None:
        """See CaptureTask."""
        if self._intrinsics is not None:
            shutil.copyfile(self._intrinsics, folder / self._intrinsics.name)

    def look(self, id: str, path: Path, pose: ArmPose) -> tuple[Shown | None, str]:
        """See CaptureTask."""
        grey = load_grey(path)
        if grey is None:
            return None, f"'{path.name}' cannot be read as a picture."
        size = next((p.size for p in self._looked.values()), grey.shape[::-1])
        if size != grey.shape[::-1]:
            return None, (
                f"The picture has {grey.shape[1]} x {grey.shape[0]} pixels, those before {size[0]} x {size[1]}: set the"
                " camera as it was, or begin another folder."
            )
        if self._board.layouts > 1:
            self._board = with_layout([grey], self._board)
        points = find_board(grey, self._board)
        seen = np.isfinite(points[:, 0])
        if int(seen.sum()) < (4 if self._board.kind == "tag" else min(8, len(points))):
            there = _light(grey) or what_is_there([grey], self._board)
            return None, (
                f"The board {self._text} is not in the picture{f': {there}' if there else ''}. Show it whole, sharp and"
                " evenly lit, with its white margin."
            )
        picture = Picture(name=path.name, points=points, size=grey.shape[::-1], thumbnail=b"")
        self._looked[id] = picture
        gap = _gap(points)
        if gap < _SMALL_PX:
            return picture, f"The board's points are {gap:.0f} px apart: bring the board nearer."
        width = _edge_px(grey, points[seen], gap)
        if width > _SHARP_PX:
            return picture, (
                f"The picture is blurred: edges are {width:.0f} px wide. Let the arm rest, focus the camera, or expose"
                " for a shorter time."
            )
        return picture, ""

    def repeats(self, one: Capture, other: Capture) -> str:
        """See CaptureTask."""
        if not isinstance(one.found, Picture) or not isinstance(other.found, Picture):
            return ""
        moved_px = float(np.nanmedian(np.linalg.norm(one.found.points - other.found.points, axis=1)))
        away = one.pose.moved(other.pose)
        if moved_px < 1.0 and away[0] > _CLEARLY_M:
            return (
                f"The board is where it was in {one.id}, to {moved_px:.1f} px, and the arm moved by {1e3 * away[0]:.0f}"
                " mm: the picture is an older one, or the board moves with the camera."
            )
        return ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See CaptureTask: a board that slips shows as the odd one out."""
        return ""

    def forget(self, id: str, shunned: ArmPose | None = None) -> None:
        """See CaptureTask."""
        self._looked.pop(id, None)
        for name in [name for name in self._known if Path(name).stem == id]:
            del self._known[name]

    def fresh(self) -> CaptureTask:
        """See CaptureTask."""
        return BoardTask(self._text, self._mounting, self._robot or "", self._intrinsics)

    def first_pose(self, last: ArmPose | None) -> Advice | None:
        """See CaptureTask."""

    def solve(self, folder: Path, last: ArmPose) -> CaptureVerdict:
        """See CaptureTask."""
        found = self._calibrated(folder)
        result, step = found.result, found.next_pose
        X, error = result.X, None
        if step is not None:  # the work point is where the next pose shows the target
            J = np.hstack([-skew(X.rotation() @ step.X_CM.translation()), np.eye(3)])
            error = radius_95(J @ result.covariance["X"] @ J.T)
        left_out = [] if found.pictures is None else found.pictures.pictures
        odd = tuple((Path(p.name).stem, p.why) for p in left_out if p.why)
        advice = None
        if step is not None:
            words = found.advice if step.X_BF is None else jog(last, step.X_BF)
            advice = Advice(
                X_BF=step.X_BF, words=words, sigma_before_m=step.sigma_before, sigma_after_m=step.sigma_after
            )
        said = (*result.unobservable, *result.warnings)
        return CaptureVerdict(symbol=self.symbol, said=said, X=X, error_95_m=error, odd=odd, advice=advice)

    def command(self, folder: Path) -> str:
        """See CaptureTask."""
        words = f"weldcal hand-eye ax-yb {shlex.quote(str(folder))} --board {shlex.quote(self._text)}"
        return f"{words} --mounting {self._mounting}{f' --robot {self._robot}' if self._robot else ''}"

    def _calibrated(self, folder: Path) -> RecordedHandEye:
        asked = HandEyeOptions(board=self._text, mounting=self._mounting, robot=self._robot, corners=None)
        return calibrate_recorded(folder, asked, known=self._known)

    def save(self, folder: Path) -> None:
        """See CaptureTask."""
        self._used = self._calibrated(folder)
        (folder.parent / RESULT).mkdir(exist_ok=True)
        of = Provenance(folder.name, digest(folder / POSES_FILE))
        export_hand_eye(self._used.result, self._used.mounting, folder.parent / RESULT, of)

    def judge(self, folder: Path, checks: Sequence[Capture]) -> list[tuple[str, float]]:
        """See CaptureTask."""
        if self._used is None or self._used.pictures is None:
            raise InputError('Press "Use it" first: the camera of that result reads the new pictures.')
        bundle, X, Y = self._used.pictures.bundle, self._used.result.poses["X"], self._used.result.poses["Y"]
        found = []
        for one in checks:
            if one.pose.X_BF is None or not isinstance(one.found, Picture):
                raise InputError("Typed poses cannot judge a camera: verify it on a second session by weldcal verify.")
            C = RigidTransform(solutions(one.found.points, self._board, bundle.K, bundle.distortion)[0][1])
            on_base = self._mounting == "eye_on_base"  # X C = F Y with the camera on the base, F X C = Y in the hand
            seen, stated = (X @ C, one.pose.X_BF @ Y) if on_base else (one.pose.X_BF @ X @ C, Y)
            middle = self._board.points.mean(axis=0)
            found.append((one.id, float(np.linalg.norm(seen @ middle - stated @ middle))))
        return found


def next_scan(
    seen: Sequence[Observation],
    X_BC: RigidTransform,
    X_FR: RigidTransform,
    robot: str,
    last: ArmPose,
    shunned: Sequence[RigidTransform] = (),
    view: Array | None = None,
) -> Advice | None:
    """Return the pose that lowers the error at the work point most, of those before the scanner within reach.

    Args:
        seen: the scans so far; the next one is about as far away, a little wider. The work point is their middle.
        X_BC: the scanner in the base, as they give it. X_FR: the feature on the flange.
        robot: an arm whose reach is looked at; any other name: it is not.
        last: where the arm is. shunned: poses X_BF at which a scan was of no use.
        view: least and largest x/z and y/z (2, 2) that the scanner sees; the flange is then whole in it.
    """
    rng, taken = np.random.default_rng(len(seen)), [o.X_BR for o in seen]
    arm = load_arm(robot) if robot in known_arms() else None
    p = np.array([o.p_CR for o in seen])
    x, y, z = np.mean([X.translation() for X in taken], axis=0).tolist()
    config = PlannerConfig(work_point_B=(x, y, z))
    depth = np.array([p[:, 2].min() / _WIDER, p[:, 2].max() * _WIDER])
    side = np.maximum(_ASIDE, _WIDER * np.abs(p[:, :2] / p[:, 2:]).max(axis=0))
    tried: list[tuple[float, RigidTransform]] = []
    for _ in range(_TRIED):
        place = rng.uniform(*depth) * np.array([*rng.uniform(-side, side), 1.0])
        edge = _FACE_M / place[2]
        if (
            view is not None
            and not ((place[:2] / place[2] - edge > view[0]) & (place[:2] / place[2] + edge < view[1])).all()
        ):
            continue
        X_BR = X_BC @ RigidTransform(_facing(place, rng), place)
        tried.append((predicted_sigma([*taken, X_BR], X_BC, config), X_BR @ X_FR.inverse()))
    if view is not None and not tried:  # a scanner that sees little but the flange
        return next_scan(seen, X_BC, X_FR, robot, last, shunned)
    q = HOME_Q if last.q is None else last.q
    for sigma, X_BF in sorted(tried, key=lambda one: one[0]):
        near = [ArmPose(X_BF=X_BF).moved(ArmPose(X_BF=X)) for X in shunned]
        if any(away < _SHUN_M and turn < _SHUN_RAD for away, turn in near):
            continue
        if arm is None or nearest_solution(arm, X_BF, q) is not None:
            before = predicted_sigma(taken, X_BC, config)
            return Advice(X_BF=X_BF, words=jog(last, X_BF), sigma_before_m=before, sigma_after_m=sigma)
    return None


def _facing(p: Array, rng: np.random.Generator) -> RotationMatrix:
    """Draw an orientation of a face at p (3,) that looks back at the camera, within _TILT_RAD, turned at random."""
    sight = -p / np.linalg.norm(p)
    side = exp_rotation(rng.uniform(0.0, 2.0 * np.pi) * sight) @ np.cross(sight, [1.0, 0.0, 0.0])
    normal = exp_rotation(rng.uniform(0.0, _TILT_RAD) * side / np.linalg.norm(side)) @ sight
    X = RotationMatrix.MakeFromOneVector(normal, 2)
    return X @ RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))


def _light(grey: NDArray[np.uint8]) -> str:
    """Return what is wrong with the light of a picture; "" where nothing is."""
    low, high = np.percentile(grey, [2.0, 98.0])
    if high < _DARK:
        return "it is dark; expose for longer"
    return "it is overexposed; expose for a shorter time" if low > _BRIGHT else ""


def _gap(points: Array) -> float:
    """Median distance px from each point to its nearest neighbour."""
    p = points[np.isfinite(points[:, 0])]
    return float(np.median(np.asarray(cKDTree(p).query(p, 2)[0])[:, 1])) if len(p) > 1 else np.inf


def _edge_px(grey: NDArray[np.uint8], points: Array, gap: float) -> float:
    """Median width px of the edges at a board's points: contrast over the steepest slope in a window of each."""
    half = int(np.clip(0.45 * gap, 3, 40))
    found = []
    for u, v in points[:: max(1, len(points) // 40)]:
        x, y = round(u), round(v)
        part = grey[max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1].astype(float)
        if min(part.shape) > 4:
            dy, dx = np.gradient(part)
            found.append(float(np.ptp(part)) / max(float(np.hypot(dx, dy).max()), 1.0))
    return float(np.median(found)) if found else np.inf
