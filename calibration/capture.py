"""Take scans or pictures by hand, one after the other: each is judged at once, and all lie in a folder that calibrates."""

from __future__ import annotations

import csv
import io
import shlex
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_dump
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.calibration.data.checks import AUTO, to_metres
from weldcal.calibration.data.clouds import CloudError, cloud_id, ending_of, read_cloud
from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.eye_on_base.estimate import point_error_covariance
from weldcal.calibration.eye_on_base.few_poses import calibrate_from_few
from weldcal.calibration.eye_on_base.observations import FlangeScan, fit_flanges, flange_scan
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import radius_95
from weldcal.calibration.geometry.se3 import exp_rotation, log_rotation, skew
from weldcal.calibration.hand_eye.pictures.boards import find_board, parse_board, what_is_there, with_layout
from weldcal.calibration.hand_eye.pictures.search import Picture, load_grey
from weldcal.calibration.planning.calibration_poses import predicted_sigma
from weldcal.calibration.recorded_flange import calibrate_flange, save_flange
from weldcal.calibration.recorded_hand_eye import HandEyeOptions, calibrate_recorded
from weldcal.calibration.verified_scans import verify_scans
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import write_atomic
from weldcal.models.robots import stated_flange

TASKS = ("flange", "board")
POSES_FILE = "robot.csv"
RESULT, CHECKS = "calibration", "checks"
"""Folders of a session: the result in use, and the captures that judge it."""
LEAST = 3
"""Captures from which on a calibration is tried."""
_SAME_M, _SAME_RAD = 2e-3, np.radians(1.0)  # a choice: below any move on purpose, above what an arm repeats to
_MOVED_M, _MOVED_RAD = 3e-4, np.radians(0.05)  # a choice: three times what an arm at rest repeats to
_APART_M, _APART = 0.01, 0.05  # a choice: centres in two frames differ by less, also with a wrong scale or a small TCP
_EDGE_SEEN = 0.6  # a choice: share of the flange's edge; less leaves its centre open across the missing part
_SHARP_PX = 6.0  # a choice: from dark to bright across a square's side; sharp pictures have 2 to 3
_SMALL_PX = 8.0  # a choice: between neighbours of a board; a corner is found to a twentieth of it at best
_AXES = ("X", "Y", "Z")
_TRIED = 200  # a choice: the best of 400 is 2 % better
_WIDER, _ASIDE = 1.15, 0.1  # a choice: how far beyond the places so far the next one may lie; at least so far aside
_TILT_RAD = np.radians(30.0)  # paper, section 2.1.4: the largest angle of the face to the line of sight
HOME_Q = np.radians([0.0, -80.0, 110.0, -120.0, -90.0, 0.0])
"""Joint angles of a Universal Robots arm near which the next pose is sought where none are known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmPose:
    """Where the arm is: the flange in its base, with joint angles (n,) rad where they are known.

    ``numbers``: as a person typed them, in whatever form; the captures together show how they are to be read.
    """

    X_BF: RigidTransform | None = None
    q: Array | None = None
    numbers: tuple[float, ...] = ()

    def row(self) -> list[float]:
        """The numbers of its row in the table of poses."""
        if self.X_BF is None:
            return [*self.numbers]
        wxyz = self.X_BF.rotation().ToQuaternion().wxyz()
        return [*self.X_BF.translation().tolist(), *wxyz.tolist(), *([] if self.q is None else self.q.tolist())]

    def header(self) -> list[str]:
        """The names of these numbers. Raises InputError for numbers that are no pose."""
        if self.X_BF is not None:
            joints = [] if self.q is None else [f"q{k + 1}" for k in range(len(self.q))]
            return ["x", "y", "z", "qw", "qx", "qy", "qz", *joints]
        known = {6: ["x", "y", "z", "rx", "ry", "rz"], 7: ["x", "y", "z", "q1", "q2", "q3", "q4"]}
        if len(self.numbers) == 16 or len(self.numbers) == 12:
            return [f"r{k}" for k in range(len(self.numbers))]
        if len(self.numbers) not in known:
            raise InputError(
                f"A pose has 6 numbers (position and three angles), 7 (with a quaternion), 12 or 16 (a matrix); these"
                f" are {len(self.numbers)}."
            )
        return known[len(self.numbers)]

    def moved(self, other: ArmPose) -> tuple[float, float]:
        """How far another pose lies from it, m and rad; of numbers only whether they are the same (0, else infinite)."""
        if self.X_BF is None or other.X_BF is None:
            away = 0.0 if self.numbers == other.numbers else np.inf
            return away, away
        D = self.X_BF.inverse() @ other.X_BF
        return float(np.linalg.norm(D.translation())), float(
            np.linalg.norm(log_rotation(D.rotation().matrix()[None])[0])
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """One scan or picture with its pose. ``found``: what was found in it, to be drawn; ``refused``: why it is not kept."""

    id: str
    file: Path
    pose: ArmPose
    found: FlangeFit | Picture | None = None
    refused: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Advice:
    """The next pose: the flange X_BF (None: the mounting leaves it open), in words, and what it gains (m)."""

    X_BF: RigidTransform | None
    words: str
    sigma_before_m: float
    sigma_after_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Verdict:
    """What the captures say together.

    ``X`` the scanner's or camera's pose (None: not yet), its error at the work point with 95 %, what is still open or
    wrong in sentences, the captures that disagree with the others (id, reason), and the next pose.
    """

    symbol: str
    said: tuple[str, ...]
    X: RigidTransform | None = None
    error_95_m: float | None = None
    odd: tuple[tuple[str, str], ...] = ()
    advice: Advice | None = None


class Task(Protocol):
    """What is captured: it looks at one file, and calibrates from the folder."""

    symbol: str
    folder: str

    def prepare(self, folder: Path) -> None:
        """Write what the folder needs besides captures."""

    def look(self, id: str, path: Path) -> tuple[FlangeFit | Picture | None, str]:
        """Return what a file shows, and why it cannot be used ("": it can)."""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """Say how the move from one capture to the other contradicts that of the arm; "" where it does not."""

    def forget(self, id: str) -> None:
        """Drop what was found in a capture."""

    def fresh(self) -> Task:
        """Return the same task, which has seen nothing."""

    def solve(self, folder: Path, last: ArmPose) -> Verdict:
        """Calibrate. Raises WeldcalError as the command of this folder does."""

    def command(self, folder: Path) -> str:
        """Return the command that calibrates from the folder."""

    def save(self, folder: Path) -> None:
        """Calibrate, and write the result into the folder's RESULT. Raises WeldcalError as the command does."""

    def judge(self, folder: Path, checks: Path) -> list[tuple[str, float]]:
        """Return the errors m of the captures in ``checks`` by the result that was saved. Raises WeldcalError."""


class FlangeTask:
    """Scans of the flange by a scanner beside the robot; the folder is that of `weldcal calibrate`."""

    symbol, folder = "X_BC", "clouds"

    def __init__(self, robot: str, flange: str) -> None:
        self._standard = stated_flange(flange, robot)
        self._robot, self._known = robot, dict[str, FlangeScan]()
        self._X_BC: RigidTransform | None = None

    def prepare(self, folder: Path) -> None:
        """See Task."""
        document = {"schema": 1, "configuration": "eye_on_base", "flange": self._standard.designation}
        document |= {"units": {"clouds": "auto", "poses": "auto"}, "poses": {"file": POSES_FILE}}
        write_atomic(folder / "dataset.yaml", yaml_dump(document | ({"robot": self._robot} if self._robot else {})))

    def look(self, id: str, path: Path) -> tuple[FlangeFit | Picture | None, str]:
        """See Task."""
        try:
            points = to_metres(read_cloud(path).astype(float), AUTO, path.name)
        except CloudError as refusal:
            return None, refusal.reason
        found = self._known[id] = flange_scan(points, self._standard)
        if not isinstance(found, tuple):
            return None, found.reason
        fit = found[0]
        if fit.coverage < _EDGE_SEEN:
            return fit, (
                f"Only {100 * fit.coverage:.0f} % of the flange's edge is in the scan: bring it whole into the scanner's"
                " view, with nothing before it."
            )
        return fit, ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See Task."""
        a, b = one.pose.X_BF, other.pose.X_BF
        if a is None or b is None or not isinstance(one.found, FlangeFit) or not isinstance(other.found, FlangeFit):
            return ""
        robot = float(np.linalg.norm(a.translation() - b.translation()))
        seen = float(np.linalg.norm(one.found.center_C - other.found.center_C))
        if abs(robot - seen) < _APART_M + _APART * max(robot, seen):
            return ""
        return (
            f"Since {one.id} the flange moved by {1e3 * robot:.0f} mm at the robot and by {1e3 * seen:.0f} mm in the"
            " scans: the pose or the scan is an older one, the pose is not in its unit, or it is not the flange's (a TCP"
            " is set at the robot)."
        )

    def forget(self, id: str) -> None:
        """See Task."""
        self._known.pop(id, None)

    def fresh(self) -> Task:
        """See Task."""
        return FlangeTask(self._robot, self._standard.designation)

    def solve(self, folder: Path, last: ArmPose) -> Verdict:
        """See Task."""
        try:
            found = calibrate_flange(folder, known=self._known)
        except WeldcalError as refusal:
            data = load_dataset(folder, robot=self._robot)
            seen = fit_flanges(data, self._standard, known=self._known)
            with suppress(WeldcalError):  # of few, poses in one plane or at one place are enough for what comes next
                X_BC = self._X_BC or calibrate_from_few(seen.observations[-LEAST:], seen.patterns, None).X_BC
                advice = self._next(seen.observations, seen.data or data, X_BC, last)
                return Verdict(symbol=self.symbol, said=(str(refusal),), advice=advice)
            raise
        estimate, used = found.estimate, found.inliers
        self._X_BC = estimate.X_BC
        work = np.mean([o.p_BR for o in used], axis=0)
        error = radius_95(point_error_covariance(estimate, work))
        odd = tuple((id, reason) for id, reason in found.refused if id in found.outliers)
        said = (*found.result.unobservable, *found.result.warnings, *found.advice)
        advice = None if found.seen.data is None else self._next(used, found.seen.data, estimate.X_BC, last)
        return Verdict(symbol=self.symbol, said=said, X=estimate.X_BC, error_95_m=error, odd=odd, advice=advice)

    def _next(self, seen: Sequence[Observation], data: Dataset, X_BC: RigidTransform, last: ArmPose) -> Advice | None:
        """Return the pose that lowers the error at the work point most, of those before the scanner within reach."""
        rng, taken = np.random.default_rng(len(seen)), [o.X_BR for o in seen]
        arm = load_arm(self._robot) if self._robot in known_arms() else None
        p = np.array([o.p_CR for o in seen])
        z = np.array([p[:, 2].min() / _WIDER, p[:, 2].max() * _WIDER])
        side = np.maximum(_ASIDE, _WIDER * np.abs(p[:, :2] / p[:, 2:]).max(axis=0))
        tried: list[tuple[float, RigidTransform]] = []
        for _ in range(_TRIED):
            place = rng.uniform(*z) * np.array([*rng.uniform(-side, side), 1.0])
            X_CR = RigidTransform(_facing(place, rng), place)
            tried.append((predicted_sigma([*taken, X_BC @ X_CR], X_BC), X_BC @ X_CR @ data.X_FR.inverse()))
        q = HOME_Q if last.q is None else last.q
        for sigma, X_BF in sorted(tried, key=lambda one: one[0]):
            if arm is None or nearest_solution(arm, X_BF, q) is not None:
                before = predicted_sigma(taken, X_BC)
                return Advice(X_BF=X_BF, words=jog(last, X_BF), sigma_before_m=before, sigma_after_m=sigma)
        return None

    def command(self, folder: Path) -> str:
        """See Task."""
        return f"weldcal calibrate {shlex.quote(str(folder))}"

    def save(self, folder: Path) -> None:
        """See Task."""
        (folder / RESULT).mkdir(exist_ok=True)
        save_flange(calibrate_flange(folder, known=self._known), folder / RESULT)

    def judge(self, folder: Path, checks: Path) -> list[tuple[str, float]]:
        """See Task."""
        return [(p.id, 1e-3 * p.error_mm) for p in verify_scans(folder / RESULT, checks).poses]


class BoardTask:
    """Pictures of a board by a camera on the flange or beside the robot; the folder is that of `weldcal hand-eye`."""

    folder = "pictures"

    def __init__(self, board: str, mounting: str, robot: str = "", intrinsics: Path | None = None) -> None:
        self._board, self._text, self._mounting = parse_board(board), board, mounting
        self._robot, self._intrinsics, self._known = robot or None, intrinsics, dict[str, Picture]()
        self.symbol = "X_BC" if mounting == "eye_on_base" else "X_FC"

    def prepare(self, folder: Path) -> None:
        """See Task."""
        if self._intrinsics is not None:
            shutil.copyfile(self._intrinsics, folder / self._intrinsics.name)

    def look(self, id: str, path: Path) -> tuple[FlangeFit | Picture | None, str]:
        """See Task."""
        grey = load_grey(path)
        if grey is None:
            return None, f"'{path.name}' cannot be read as a picture."
        if self._board.layouts > 1:
            self._board = with_layout([grey], self._board)
        points = find_board(grey, self._board)
        seen = np.isfinite(points[:, 0])
        if int(seen.sum()) < (4 if self._board.kind == "tag" else min(8, len(points))):
            there = what_is_there([grey], self._board)
            return None, (
                f"The board {self._text} is not in the picture{f': {there}' if there else ''}. Show it whole, sharp and"
                " evenly lit, with its white margin."
            )
        picture = Picture(name=path.name, points=points, size=grey.shape[::-1], thumbnail=b"")
        gap = _gap(points)
        if gap < _SMALL_PX:
            return picture, f"The board's points are {gap:.0f} px apart: bring the board nearer."
        width = _edge_px(grey, points[seen], gap)
        if width > max(_SHARP_PX, 0.25 * gap):
            return picture, (
                f"The picture is blurred: edges are {width:.0f} px wide. Let the arm rest, focus the camera, or expose for"
                " a shorter time."
            )
        return picture, ""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """See Task."""
        if not isinstance(one.found, Picture) or not isinstance(other.found, Picture):
            return ""
        moved_px = float(np.nanmedian(np.linalg.norm(one.found.points - other.found.points, axis=1)))
        away = one.pose.moved(other.pose)
        if moved_px < 1.0 and away[0] > 10.0 * _SAME_M:
            return (
                f"The board is where it was in {one.id}, to {moved_px:.1f} px, and the arm moved by {1e3 * away[0]:.0f}"
                " mm: the picture is an older one, or the board moves with the camera."
            )
        return ""

    def forget(self, id: str) -> None:
        """See Task."""
        for name in [name for name in self._known if Path(name).stem == id]:
            del self._known[name]

    def fresh(self) -> Task:
        """See Task."""
        return BoardTask(self._text, self._mounting, self._robot or "", self._intrinsics)

    def solve(self, folder: Path, last: ArmPose) -> Verdict:
        """See Task."""
        asked = HandEyeOptions(board=self._text, mounting=self._mounting, robot=self._robot, corners=None)
        found = calibrate_recorded(folder, asked, known=self._known)
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
        return Verdict(symbol=self.symbol, said=said, X=X, error_95_m=error, odd=odd, advice=advice)

    def command(self, folder: Path) -> str:
        """See Task."""
        words = f"weldcal hand-eye ax-yb {shlex.quote(str(folder))} --board {shlex.quote(self._text)}"
        return f"{words} --mounting {self._mounting}{f' --robot {self._robot}' if self._robot else ''}"

    def save(self, folder: Path) -> None:
        """See Task."""
        raise InputError(f"Write the result with: {self.command(folder)}")

    def judge(self, folder: Path, checks: Path) -> list[tuple[str, float]]:
        """See Task."""
        raise InputError("New pictures are judged by: weldcal verify.")


class Session:
    """A folder of captures that grows: each is whole on disk before the next begins, and a new start goes on with it.

    A capture is its file, and then its row in the table of poses; a file without a row is not a capture.
    """

    def __init__(self, folder: Path, task: Task) -> None:
        self.folder, self.task = folder, task
        self.captures: list[Capture] = []
        self._checks: Session | None = None
        (folder / task.folder).mkdir(parents=True, exist_ok=True)
        rows = self._rows()
        files = {cloud_id(p): p for p in (folder / task.folder).iterdir() if not p.name.startswith(".")}
        for row in rows:
            id, pose = row["id"], _pose_of(row)
            if id in files:
                self.captures.append(Capture(id=id, file=files[id], pose=pose, found=task.look(id, files[id])[0]))
        task.prepare(folder)

    def take(self, source: Path, pose: ArmPose, after: ArmPose | None = None) -> Capture:
        """Judge a file of the sensor with the arm's pose, and keep both; ``after``: the pose after the exposure.

        What is refused is not kept. Raises InputError for a pose that is none, or in another form than those before.
        """
        header = ["id", *pose.header()]
        if self.captures and header != (old := ["id", *self.captures[0].pose.header()]):
            raise InputError(
                f"The poses so far have the columns {','.join(old)}, and this one {','.join(header)}: give all in one"
                " form, or begin another folder."
            )
        id = f"{1 + max((int(one.id) for one in self.captures), default=0):03d}"
        kept = self.folder / self.task.folder / f"{id}{ending_of(source) or source.suffix}"
        one = Capture(id=id, file=kept, pose=pose)
        if why := self._repeats(one, source) or _not_at_rest(pose, after):
            return replace(one, refused=why)
        unfinished = kept.with_name(f".{kept.name}")
        shutil.copyfile(source, unfinished)
        try:
            found, why = self.task.look(id, unfinished)
        finally:
            unfinished.replace(kept)
        one = replace(one, found=found)
        if not why:
            against = [said for other in self.captures if (said := self.task.contradicts(other, one))]
            why = against[-1] if 2 * len(against) > len(self.captures) else ""
        if why:
            kept.unlink()
            self.task.forget(id)
            return replace(one, refused=why)
        self._write([*self.captures, one])
        return one

    def take_back(self, id: str) -> None:
        """Remove a capture. Raises InputError where there is none of that number."""
        one = next((c for c in self.captures if c.id == id), None)
        if one is None:
            raise InputError(f"There is no capture {id}: there are {', '.join(c.id for c in self.captures) or 'none'}.")
        self._write([c for c in self.captures if c is not one])
        one.file.unlink(missing_ok=True)
        self.task.forget(id)

    def verdict(self) -> Verdict:
        """Return what the captures say together: the calibration of this folder, as its command gives it."""
        if len(self.captures) < LEAST:
            need = LEAST - len(self.captures)
            return Verdict(
                symbol=self.task.symbol, said=(f"{need} more capture{'s' * (need > 1)} for a first estimate.",)
            )
        try:
            return self.task.solve(self.folder, self.captures[-1].pose)
        except WeldcalError as refusal:
            return Verdict(symbol=self.task.symbol, said=(str(refusal),))

    def check(self, source: Path, pose: ArmPose, after: ArmPose | None = None) -> tuple[Capture, float]:
        """Judge the result in use by a capture that it never saw; returns it, and its error (m; NaN where refused)."""
        self._checks = self._checks or Session(self.folder / CHECKS, self.task.fresh())
        one = self._checks.take(source, pose, after)
        if one.refused:
            return one, np.nan
        return one, dict(self.task.judge(self.folder, self._checks.folder))[one.id]

    def _repeats(self, one: Capture, source: Path) -> str:
        """Say which capture is repeated by a file or a pose; "" where none is."""
        content = source.read_bytes()
        for other in self.captures:
            if other.file.read_bytes() == content:
                return f"The sensor gave the same data as for {other.id}: it has not taken anew."
            away, turn = one.pose.moved(other.pose)
            if away < _SAME_M and turn < _SAME_RAD:
                return f"The arm is where it was in {other.id}: move it, and turn the flange, before the next capture."
        return ""

    def _rows(self) -> list[dict[str, str]]:
        path = self.folder / POSES_FILE
        return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))) if path.is_file() else []

    def _write(self, captures: list[Capture]) -> None:
        table = io.StringIO()
        writer = csv.writer(table, lineterminator="\n")
        for k, one in enumerate(captures):
            if k == 0:
                writer.writerow(["id", *one.pose.header()])
            writer.writerow([one.id, *map(repr, one.pose.row())])
        write_atomic(self.folder / POSES_FILE, table.getvalue())
        self.captures = captures


def jog(now: ArmPose, goal: RigidTransform) -> str:
    """Say how a person moves the flange from a pose to another: shifts along, then turns about the base's axes."""
    if now.X_BF is None:
        p, w = 1e3 * goal.translation(), log_rotation(goal.rotation().matrix()[None])[0]
        at, turn = ", ".join(f"{v:.0f}" for v in p), ", ".join(f"{v:.3f}" for v in w)
        return f"Move the flange to ({at}) mm, rotation vector ({turn}) rad."
    shift = 1e3 * (goal.translation() - now.X_BF.translation())
    turns = np.degrees(RollPitchYaw(goal.rotation() @ now.X_BF.rotation().inverse()).vector())
    moves = [
        f"{abs(v):.0f} mm along the base's {'+' if v > 0.0 else '-'}{a}"
        for v, a in zip(shift, _AXES, strict=True)
        if abs(v) > 2.0
    ]
    turned = [f"{v:+.0f} deg about the base's {a}" for v, a in zip(turns, _AXES, strict=True) if abs(v) > 1.0]
    said = [f"move {', '.join(moves)}"] if moves else []
    said += [f"turn the flange about its own centre by {', then '.join(turned)}"] if turned else []
    words = "; then ".join(said) or "stay"
    return f"{words[0].upper()}{words[1:]}."


def ur_pose(X_BF: RigidTransform) -> str:
    """Return a pose as URScript has it."""
    w = log_rotation(X_BF.rotation().matrix()[None])[0]
    return "p[" + ", ".join(f"{v:.5f}" for v in (*X_BF.translation(), *w)) + "]"


def _pose_of(row: dict[str, str]) -> ArmPose:
    numbers = [float(value) for name, value in row.items() if name != "id"]
    if "qw" not in row:
        return ArmPose(numbers=tuple(numbers))
    X = RigidTransform(Quaternion(np.array(numbers[3:7]) / np.linalg.norm(numbers[3:7])), numbers[:3])
    return ArmPose(X_BF=X, q=np.array(numbers[7:]) if len(numbers) > 7 else None)


def _not_at_rest(pose: ArmPose, after: ArmPose | None) -> str:
    away, turn = (0.0, 0.0) if after is None else pose.moved(after)
    if away < _MOVED_M and turn < _MOVED_RAD:
        return ""
    return (
        f"The arm moved by {1e3 * away:.1f} mm and {np.degrees(turn):.2f} deg while the sensor took: let it rest, and"
        " capture again."
    )


def _facing(p: Array, rng: np.random.Generator) -> RotationMatrix:
    """Draw an orientation of a face at p (3,) that looks back at the camera, within _TILT_RAD, turned at random."""
    sight = -p / np.linalg.norm(p)
    side = exp_rotation(rng.uniform(0.0, 2.0 * np.pi) * sight) @ np.cross(sight, [1.0, 0.0, 0.0])
    normal = exp_rotation(rng.uniform(0.0, _TILT_RAD) * side / np.linalg.norm(side)) @ sight
    X = RotationMatrix.MakeFromOneVector(normal, 2)
    return X @ RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))


def _gap(points: Array) -> float:
    """Median distance px from each point to its nearest neighbour."""
    p = points[np.isfinite(points[:, 0])]
    return float(np.median(np.asarray(cKDTree(p).query(p, 2)[0])[:, 1])) if len(p) > 1 else np.inf


def _edge_px(grey: NDArray[np.uint8], points: Array, gap: float) -> float:
    """Median width px of the edges at a board's points: contrast over the steepest slope in a window of each."""
    half = int(np.clip(0.4 * gap, 3, 12))
    found = []
    for u, v in points[:: max(1, len(points) // 40)]:
        x, y = round(u), round(v)
        part = grey[max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1].astype(float)
        if min(part.shape) > 4:
            dy, dx = np.gradient(part)
            found.append(float(np.ptp(part)) / max(float(np.hypot(dx, dy).max()), 1.0))
    return float(np.median(found)) if found else np.inf
