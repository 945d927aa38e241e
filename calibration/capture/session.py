"""A folder of scans or pictures that grows by hand: what is captured, where the arm was, and how it moves on."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.data.checks import read_header
from weldcal.calibration.data.clouds import cloud_id, ending_of
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.geometry.se3 import log_rotation
from weldcal.calibration.hand_eye.pictures.search import Picture
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import write_atomic

POSES_FILE = "robot.csv"
FOLDERS = ("clouds", "pictures", "profiles")
"""Of the kinds of captures, one in a session."""
TYPED = 5
"""Captures with typed poses from which on they show together how the numbers are to be read."""
RESULT, CHECKS = "calibration", "checks"
"""Folders beside that of the captures: the result in use, and the captures that judge it."""
LEAST = 3
"""Captures from which on a calibration is tried."""
_SAME_M, _SAME_RAD = 2e-3, np.radians(1.0)  # a choice: below any move on purpose, above what an arm repeats to
_MOVED_M, _MOVED_RAD = 3e-4, np.radians(0.05)  # a choice: three times what an arm at rest repeats to
_AXES = ("X", "Y", "Z")


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
        if len(self.numbers) not in known:
            raise InputError(
                "A pose has 6 numbers (position and three angles) or 7 (with a quaternion); these are"
                f" {len(self.numbers)}."
            )
        return known[len(self.numbers)]

    def moved(self, other: ArmPose) -> tuple[float, float]:
        """How far another pose lies from it, m and rad; of typed numbers 0 or infinite."""
        if self.X_BF is None or other.X_BF is None:
            away = 0.0 if self.numbers == other.numbers else np.inf
            return away, away
        D = self.X_BF.inverse() @ other.X_BF
        return float(np.linalg.norm(D.translation())), float(
            np.linalg.norm(log_rotation(D.rotation().matrix()[None])[0])
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownProfile:
    """A profile [x, z] (n, 2) m, and the points (k, 2) m of the target in it."""

    points: Array
    feature: Array = field(default_factory=lambda: np.zeros((0, 2)))


Shown = FlangeFit | Picture | ShownProfile
"""What a file shows."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """One scan or picture with its pose, what was found in it, and why it is left out ("": it counts)."""

    id: str
    file: Path
    pose: ArmPose
    found: Shown | None = None
    refused: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Advice:
    """The next pose, in words, and what it gains (m).

    ``X_BF``: of the flange (None: the mounting leaves it open); ``q`` (6,) rad: where only these joints do.
    """

    X_BF: RigidTransform | None
    words: str
    q: Array | None = None
    sigma_before_m: float
    sigma_after_m: float

    @property
    def gain(self) -> float | None:
        """The share by which it lowers the uncertainty; None where this is open before."""
        return 1.0 - self.sigma_after_m / self.sigma_before_m if 0.0 < self.sigma_before_m < np.inf else None

    @property
    def ur(self) -> str | None:
        """The pose, or the joints, as URScript has them."""
        if self.q is not None:
            return "[" + ", ".join(f"{v:.5f}" for v in self.q) + "]"
        return None if self.X_BF is None else ur_pose(self.X_BF)


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureVerdict:
    """What the captures say together.

    ``X`` the scanner's or camera's pose (None: not yet), its error at the work point with 95 %, what is still open or
    wrong in sentences, the captures that disagree with the others (id, reason), and the next pose. ``placed``: X_BC of
    each scan (its id), and how far it lies from where the others put it (m).
    """

    symbol: str
    said: tuple[str, ...]
    X: RigidTransform | None = None
    error_95_m: float | None = None
    odd: tuple[tuple[str, str], ...] = ()
    advice: Advice | None = None
    placed: tuple[tuple[str, RigidTransform, float], ...] = ()


class CaptureTask(Protocol):
    """What is captured: it looks at one file, and calibrates from the folder."""

    symbol: str
    folder: str
    least: int
    hint: str
    """How to vary the poses while there is no advice."""

    def prepare(self, folder: Path) -> None:
        """Write what the folder needs besides captures. Raises InputError where it is that of another mounting."""

    def look(self, id: str, path: Path, pose: ArmPose) -> tuple[Shown | None, str]:
        """Return what a file shows, taken at a pose, and why it cannot be used ("": it can)."""

    def repeats(self, one: Capture, other: Capture) -> str:
        """Return why both show one place though the arm has moved; "" where they do not."""

    def contradicts(self, one: Capture, other: Capture) -> str:
        """Say how the move from one capture to the other contradicts that of the arm; "" where it does not."""

    def forget(self, id: str, shunned: ArmPose | None = None) -> None:
        """Drop what was found in a capture; ``shunned``: a pose that is not to be proposed again."""

    def fresh(self) -> CaptureTask:
        """Return the same task, with nothing found yet."""

    def first_pose(self, last: ArmPose | None) -> Advice | None:
        """Return where to begin, and what comes next before there is a result; None where any pose will do."""

    def solve(self, folder: Path, last: ArmPose) -> CaptureVerdict:
        """Calibrate. Raises WeldcalError as the command of this folder does."""

    def command(self, folder: Path) -> str:
        """Return the command that calibrates from the folder."""

    def save(self, folder: Path) -> None:
        """Calibrate, and write the result into the folder's RESULT. Raises WeldcalError as the command does."""

    def judge(self, folder: Path, checks: Sequence[Capture]) -> list[tuple[str, float]]:
        """Return id and error (m) of captures in CHECKS by the result that was saved. Raises WeldcalError."""


class CaptureSession:
    """A folder of captures that grows: each is whole on disk before the next begins, and a new start goes on with it.

    A capture is its hidden file, then its row in the table of poses, then the file's name: whenever this ends, the
    folder calibrates, and a row finds its file.
    """

    def __init__(self, folder: Path, task: CaptureTask) -> None:
        self.folder, self.task = folder, task
        self.captures: list[Capture] = []
        self._checks: CaptureSession | None = None
        other = next((name for name in FOLDERS if name != task.folder and any((folder / name).glob("*"))), None)
        if other is not None:
            raise InputError(f"'{folder}' is a session of {other}, not of {task.folder}: name another folder.")
        (folder / task.folder).mkdir(parents=True, exist_ok=True)
        task.prepare(folder)
        rows = self._rows()
        for hidden in (folder / task.folder).glob(".*"):
            if any(row["id"] == cloud_id(hidden.with_name(hidden.name[1:])) for row in rows):
                hidden.replace(hidden.with_name(hidden.name[1:]))
            else:
                hidden.unlink()
        files = {cloud_id(p): p for p in (folder / task.folder).iterdir()}
        for row in rows:
            id, pose = row["id"], _pose_of(row)
            if id in files:
                self.captures.append(Capture(id=id, file=files[id], pose=pose, found=task.look(id, files[id], pose)[0]))

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
        hidden = kept.with_name(f".{kept.name}")
        shutil.copyfile(source, hidden)
        found, why = self.task.look(id, hidden, pose)
        one = replace(one, found=found)
        if not why:
            why = next((said for other in self.captures if (said := self.task.repeats(other, one))), "")
        if not why:
            against = [said for other in self.captures if (said := self.task.contradicts(other, one))]
            why = against[-1] if 2 * len(against) > len(self.captures) else ""
        if why:
            hidden.unlink()
            self.task.forget(id, pose)
            return replace(one, refused=why)
        self._write([*self.captures, one])
        hidden.replace(kept)
        return one

    def take_back(self, id: str) -> None:
        """Remove a capture. Raises InputError where there is none of that number."""
        one = next((c for c in self.captures if c.id == id), None)
        if one is None:
            raise InputError(f"There is no capture {id}: there are {', '.join(c.id for c in self.captures) or 'none'}.")
        self._write([c for c in self.captures if c is not one])
        one.file.unlink(missing_ok=True)
        self.task.forget(id)

    def verdict(self) -> CaptureVerdict:
        """Return what the captures say together: the calibration of this folder, as its command gives it."""
        typed = bool(self.captures) and self.captures[0].pose.X_BF is None
        least = max(self.task.least, TYPED if typed else 0)
        if len(self.captures) < least:
            need = least - len(self.captures)
            return CaptureVerdict(
                symbol=self.task.symbol,
                said=(f"{need} more capture{'s' * (need > 1)} for a first estimate.",),
                advice=self.task.first_pose(self.captures[-1].pose if self.captures else None),
            )
        try:
            return self.task.solve(self.folder, self.captures[-1].pose)
        except WeldcalError as refusal:
            return CaptureVerdict(symbol=self.task.symbol, said=(str(refusal),))

    def check(self, source: Path, pose: ArmPose, after: ArmPose | None = None) -> tuple[Capture, float]:
        """Judge the result in use by a capture that it never saw; returns it, and its error (m; NaN where refused)."""
        self._checks = self._checks or CaptureSession(self.folder.parent / CHECKS, self.task.fresh())
        one = self._checks.take(source, pose, after)
        if one.refused:
            return one, np.nan
        return one, dict(self.task.judge(self.folder, self._checks.captures))[one.id]

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


def require_mounting(folder: Path, configuration: str) -> None:
    """Require that a session which is there is of this mounting. Raises InputError."""
    there = folder / "dataset.yaml"
    if there.is_file() and (other := read_header(there).configuration) != configuration:
        raise InputError(
            f"'{folder}' is a session of the mounting {other}, not {configuration}: name another folder with --out."
        )


def jog(now: ArmPose, goal: RigidTransform) -> str:
    """Return in words how to jog the flange to a pose: shifts along the base's axes, then turns about them."""
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


def jog_joints(now: Array, goal: Array) -> str:
    """Return in words how to jog the joints (n,) rad from where they are to a goal."""
    turns = np.degrees(goal - now)
    words = ", ".join(f"J{k + 1} by {t:+.0f} deg" for k, t in enumerate(turns) if abs(t) > 1.0)
    return f"Turn the joints: {words}." if words else "Stay."


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
