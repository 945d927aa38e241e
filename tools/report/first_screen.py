"""Make the first screen of reports and terminal: verdict, error, concerns, next step and poses.

It holds the rule of the verdict, every printed form of a pose, and the error of a scanned point at the work point.
"""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import export_ur_pose
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, point_error_covariance
from weldcal.calibration.geometry.robust import radius_95 as radius_95
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

SCANNER = {
    "X_BC": "pose of the scanner C in the robot's base B",
    "X_FC": "pose of the scanner C in the robot's flange F",
}
"""The scanner's pose in words, by its symbol."""


def pose_rows(pose: object, symbol: str = "X_BC", words: str = "") -> dict[str, str]:
    """Rows for the terminal, by name: a RigidTransform, or its matrix (4, 4) as nested lists; ``words``: its frames."""
    if isinstance(pose, RigidTransform):
        X = pose
    else:
        M = np.asarray(pose, dtype=float)
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(M[:3, :3]), M[:3, 3])
    q = X.rotation().ToQuaternion()
    rows = [" ".join(f"{v:+.6f}" for v in row) for row in X.GetAsMatrix4()]
    return {
        symbol: words or SCANNER.get(symbol, "pose of the scanner in the robot's flange"),
        "position": "  ".join(f"{1e3 * v:+.3f}" for v in X.translation()) + "  mm",
        "rotation vector": "  ".join(f"{v:+.6f}" for v in rotation_vector(X.rotation())) + "  rad",
        "roll pitch yaw": "  ".join(f"{v:+.4f}" for v in np.degrees(X.rotation().ToRollPitchYaw().vector())) + "  deg",
        "quaternion wxyz": "  ".join(f"{v:+.7f}" for v in (q.w(), q.x(), q.y(), q.z())),
        "UR pose": export_ur_pose(X).strip(),
        "4 x 4, m": "\n".join(rows),
    }


@dataclass(frozen=True)
class WorkPoint:
    """The expected error of a scanned point at ``p_B_mm`` in the base.

    With 95 % probability it is at most ``error_95_mm``, if the errors are as stated; ``unseen_poses`` with a
    held-out error back it, 95 % of which were within ``held_out_95_mm`` (None: too few).
    """

    p_B_mm: tuple[float, float, float]
    error_95_mm: float
    unseen_poses: int
    held_out_95_mm: float | None

    def document(self) -> dict[str, object]:
        """Return the JSON object."""
        return {
            "p_B_mm": list(self.p_B_mm),
            "error_95_mm": self.error_95_mm,
            "unseen_poses": self.unseen_poses,
            "held_out_95_mm": self.held_out_95_mm,
        }


def work_point_error(estimate: CalibrationEstimate, p_BQ: Array) -> WorkPoint:
    """Return the error at the point (3,) m in the base, from the estimate's covariance and its held-out errors."""
    radius = radius_95(point_error_covariance(estimate, p_BQ))
    held = estimate.held_out.position_m[estimate.inliers]
    held = 1e3 * held[np.isfinite(held)]
    x, y, z = (float(1e3 * v) for v in p_BQ)
    return WorkPoint((x, y, z), 1e3 * radius, len(held), float(np.percentile(held, 95)) if len(held) else None)


USE, CARE, DO_NOT = "use it", "use with care", "do not use"
ENOUGH_UNSEEN = 4
"""Unseen poses (scans, frames, landmarks) from which on they back a verdict; `verify` asks for as many new scans."""
MOST_CONCERNS = 3
NO_TOLERANCE = "No tolerance is stated: add --limit-mm with the allowed error."


@dataclass(frozen=True)
class Tolerance:
    """What the verdict is measured against: `figure` may be `limit` at most, in `unit`.

    `what` names the figure, `source` the option or scenario key that states the limit.
    """

    what: str
    figure: float
    limit: float
    source: str
    unit: str = "mm"

    @property
    def met(self) -> bool:
        """Whether the figure is within the limit; a figure that is not known is not."""
        return bool(self.figure <= self.limit)

    @property
    def sentence(self) -> str:
        """The comparison as one sentence."""
        if not np.isfinite(self.figure):
            return f"{self.what} is not known, so it cannot be held against {self._text(self.limit)} ({self.source})."
        where = "within" if self.met else "above"
        return (
            f"{self.what} is {self._text(self.figure)}, {where} the tolerance of {self._text(self.limit)}"
            f" ({self.source})."
        )

    def _text(self, value: float) -> str:
        return f"{value:.3f} {self.unit}".strip()


def limit_tolerance(what: str, figure: float, limit_mm: float | None) -> Tolerance | None:
    """Return the figure named ``what`` (mm) against the limit that --limit-mm states; None where it states none."""
    return None if limit_mm is None else Tolerance(f"the {what},", figure, limit_mm, "--limit-mm")


@dataclass(frozen=True)
class ExpectedError:
    """The error to expect: `what` is measured, the figure with its unit, and what backs it, in words."""

    what: str
    figure: str
    backing: str


@dataclass(frozen=True)
class Next:
    """The next step: a sentence, and the command or motion that does it (empty: none).

    A command runs as it is printed, so that it has no placeholder. ``uses``: the step relies on the result, so that it
    is not shown beside "do not use".
    """

    text: str
    command: str = ""
    uses: bool = False


AGAINST = Next("Remove what the verdict names, or add data that vary more. Then run the command again.")
"""The next step in the place of one that relies on a result which is not to be used."""


def verify_next(folder: Path | str, lead: str = "Take four or more new scans") -> Next:
    """Return the step to judge the result in a folder with scans that are still to be taken."""
    return Next(f"{lead}. Run '{typed('verify', folder)}' and name their folder.", uses=True)


def typed(command: str, path: Path | str, *more: str) -> str:
    """Return a command of weldcal with a path, as a shell takes it."""
    return " ".join(["weldcal", command, shlex.quote(str(path)), *more])


@dataclass(frozen=True, eq=False)
class ShownPose:
    """A computed pose: its symbol (X_BC), frames in words, and the transform with its translation in m.

    ``sigma``: its uncertainty in words, of the position first. ``aside``: not on the brief screen.
    """

    symbol: str
    words: str
    X: RigidTransform
    sigma: str = ""
    aside: bool = False

    @property
    def forms(self) -> tuple[tuple[str, str, str], ...]:
        """Forms to copy: a name, a word for the button, and the text."""
        q = self.X.rotation().ToQuaternion()
        matrix = ",\n".join(
            ("[[" if k == 0 else " [") + ", ".join(f"{v: .9f}" for v in row + 0.0) + ("]]" if k == 3 else "]")
            for k, row in enumerate(self.X.GetAsMatrix4())
        )
        quaternion = ", ".join(f"{v:.9f}" for v in (*self.X.translation(), q.w(), q.x(), q.y(), q.z()))
        return (
            ("4 x 4 matrix, m", "matrix", matrix),
            ("UR pose: x, y, z in m, rotation vector in rad", "UR pose", export_ur_pose(self.X).strip()),
            ("x, y, z in m, quaternion w, x, y, z", "quaternion", quaternion),
        )

    @property
    def read(self) -> tuple[tuple[str, str], ...]:
        """Forms to read: position and angles."""
        rows = self.rows()
        return (("position", rows["position"]), ("roll pitch yaw", rows["roll pitch yaw"]))

    @property
    def line(self) -> str:
        """Position and rotation vector on one line."""
        p, r = 1e3 * self.X.translation(), rotation_vector(self.X.rotation())
        line = f"{p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f} mm; rotation vector {r[0]:.6f}, {r[1]:.6f}, {r[2]:.6f} rad"
        return f"{line}; one sigma {self.sigma.partition('; ')[0]}" if self.sigma else line

    def rows(self) -> dict[str, str]:
        """Return the rows for the terminal."""
        rows = pose_rows(self.X, self.symbol, self.words)
        return rows | ({"one sigma": self.sigma} if self.sigma else {})


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a command found, as the verdict's rule reads it.

    Attributes:
        against: what the command itself decided against its result: a held job, a moved scanner; any of them ends in
            "do not use".
        tolerance: None where nobody stated one.
        no_tolerance: the sentence that takes its place.
        unseen: number of poses that were unseen when their error was predicted; None for a result that has no such
            poses.
        concerns: what could be wrong; any of them leaves the verdict at "use with care".
        notes: what a reader should know; they do not change the verdict.
        settled: verdict and reason of a command that has a rule of its own (`verify`, `compare`).
        words: what the command calls this verdict; empty: as it is.
    """

    against: Sequence[str] = ()
    tolerance: Tolerance | None = None
    no_tolerance: str = NO_TOLERANCE
    unseen: int | None = None
    concerns: Sequence[str] = ()
    notes: Sequence[str] = ()
    settled: tuple[str, str] | None = None
    words: str = ""


def decide(found: Findings) -> tuple[str, str]:
    """Return the verdict, one of three, and the reason; the first rule that applies decides.

    1. A verdict that the command settled by a rule of its own stays as it is.
    2. "do not use": the command decided against the result (the job was held, no pose, the scanner has moved).
    3. "do not use": a tolerance is stated, and the figure is above it or not known.
    4. "use with care": no tolerance is stated; or fewer than ENOUGH_UNSEEN unseen poses back the figure; or something
      could be wrong.
    5. "use it".
    """
    if found.settled is not None:
        return found.settled
    if found.against:
        return DO_NOT, found.against[0]
    said = found.no_tolerance if found.tolerance is None else upper(found.tolerance.sentence)
    if found.tolerance is not None and not found.tolerance.met:
        return DO_NOT, said
    if found.unseen is not None and found.unseen < ENOUGH_UNSEEN:
        number = {0: "no unseen pose backs", 1: "only 1 unseen pose backs"}
        return CARE, f"{said} But {number.get(found.unseen, f'only {found.unseen} unseen poses back')} it."
    if found.concerns:
        n = len(found.concerns)
        joint = "And" if found.tolerance is None else "But"
        return CARE, f"{said} {joint} {'one thing' if n == 1 else f'{n} things'} could be wrong, below."
    return (CARE, said) if found.tolerance is None else (USE, said)


@dataclass(frozen=True, eq=False)
class FirstScreen:
    """The first screen.

    `lead` is said before the verdict's reason. `more` are rows by name: other results, and what takes the place of a
    pose or a figure that the command does not have. Its parts agree: beside "do not use" stands no step that relies on
    the result, and not that nothing was found; beside "use it" nothing that could be wrong.
    """

    found: Findings
    expected: ExpectedError
    step: Next
    poses: tuple[ShownPose, ...] = ()
    more: Mapping[str, str] = field(default_factory=dict)
    lead: str = ""

    @property
    def verdict(self) -> str:
        """One of three."""
        return decide(self.found)[0]

    @property
    def named(self) -> str:
        """The verdict in the command's own words."""
        return self.found.words or self.verdict

    @property
    def reason(self) -> str:
        """Why, in a sentence or two."""
        return f"{self.lead} {decide(self.found)[1]}".strip()

    @property
    def tone(self) -> str:
        """The report's colour."""
        return {USE: "good", CARE: "warn", DO_NOT: "bad"}[self.verdict]

    @property
    def refusal(self) -> str:
        """Return the sentence that ends a command with exit code 1; empty unless the result is not to be used."""
        return f"The verdict is: {self.named}. {self.reason}" if self.verdict == DO_NOT else ""

    @property
    def next(self) -> Next:
        """The step; another one where it relies on a result that is not to be used."""
        return AGAINST if self.step.uses and self.verdict == DO_NOT else self.step

    @property
    def concerns(self) -> tuple[str, ...]:
        """At most three things that could be wrong, the gravest first; the third says how many more there are."""
        return () if self.verdict == USE else _first_few([*self.found.against[1:], *self.found.concerns])

    @property
    def notes(self) -> tuple[str, ...]:
        """List at most three things that do not speak against the result; the third counts the others."""
        concerns = self.found.concerns if self.verdict == USE else ()  # of a verdict by another rule
        return _first_few(text for text in (*concerns, *self.found.notes) if text not in self.concerns)

    @property
    def nothing(self) -> str:
        """Return the text for no concern besides the verdict's reason."""
        if self.verdict == DO_NOT:
            return "Nothing else was found."
        return "Nothing that changes the verdict." if self.notes else "Nothing was found."

    def rows(self) -> dict[str, str]:
        """Return the rows for the terminal, by name; several things stand on lines of their own."""
        rows = {
            "verdict": f"{self.named}. {self.reason}",
            self.expected.what: f"{self.expected.figure} ({self.expected.backing})",
            "could be wrong": "\n".join(f"- {text}" for text in self.concerns) or self.nothing,
            **({"good to know": "\n".join(f"- {text}" for text in self.notes)} if self.notes else {}),
            "next": self.next.text + (f"\n{self.next.command}" if self.next.command else ""),
            **self.more,
        }
        for k, pose in enumerate(self.poses):
            rows |= {name + " " * k: text for name, text in pose.rows().items()}
        return rows

    @property
    def sizes(self) -> list[tuple[int, int, int, int]]:
        """Sizes of the brief screen from the longest on: other results, sentences of the step, concerns, notes."""
        c, n = len(self.concerns), len(self.notes)
        texts = [(k, m) for k in range(c, min(c, 1) - 1, -1) for m in range(n, -1, -1)]
        texts.sort(key=lambda size: (-min(size), -sum(size)))
        steps, more = range(len(sentences(self.next.text)), 0, -1), range(len(self.more), -1, -1)
        return [(others, number, *size) for others in more for number in steps for size in texts]

    def brief(self, others: int, steps: int, concerns: int, notes: int) -> dict[str, str]:
        """Return the rows for a terminal with few lines, in one of its ``sizes``."""

        def listed(texts: Sequence[str], number: int) -> str:
            shown = [f"- {first_sentence(text)}" for text in texts[:number]]
            left = len(texts) - number
            return "\n".join(shown + ([f"- {left} more in the report"] if shown and left > 0 else []))

        rows = {"why": self.reason, "result": f"{self.expected.what}: {self.expected.figure}"}
        rows |= {pose.symbol: pose.line for pose in self.poses if not pose.aside}
        rows |= {name: first_sentence(text) for name, text in list(self.more.items())[:others]}
        rows |= {"could be wrong": listed(self.concerns, concerns) or self.nothing}
        rows |= {"good to know": listed(self.notes, notes)}
        return rows | {"next": self.next.command or " ".join(sentences(self.next.text)[:steps])}

    def document(self) -> dict[str, object]:
        """Return the JSON object."""
        tolerance = self.found.tolerance
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "error": f"{self.expected.what}: {self.expected.figure}",
            "backing": self.expected.backing,
            "tolerance": None if tolerance is None else vars(tolerance),
            "unseen": self.found.unseen,
            "could_be_wrong": list(self.concerns),
            "good_to_know": list(self.notes),
            "next": self.next.text,
            "command": self.next.command or None,
        }


def after_hold(
    ended: bool, advice: str = "Remove the cause that is named above, then run the job again.", command: str = ""
) -> Next:
    """What to do after a run that was held; `ended`: the operator ended it, so there is no fault to look for."""
    return Next("The operator ended this run. Run it again for a result.") if ended else Next(advice, command)


def point_covariance(X: RigidTransform, covariance: Array, p: Array) -> Array:
    """Map the covariance (6, 6) [rotation; translation] of ``X`` to (3, 3) m^2 of a point.

    ``p`` (3,) m is the point in the parent's axes.

    The rotation is on the parent's side about the child's origin, as in every result of weldcal.
    """
    d = np.asarray(p, dtype=float) - X.translation()
    skewed = np.array([[0.0, -d[2], d[1]], [d[2], 0.0, -d[0]], [-d[1], d[0], 0.0]])
    J = np.hstack([-skewed, np.eye(3)])
    return np.asarray(J @ covariance @ J.T)


def expected_error(
    what: str, own_mm: float | None, held_95_mm: float | None, n: int, of: str, place: str = ""
) -> tuple[ExpectedError, float]:
    """Return the error at 95 % in words and mm (NaN: unknown): the larger of the own and the unseen one.

    ``own_mm``: from the covariance (None: none is stated), ``place``: where; ``held_95_mm``: 95 % of ``n`` held-out
    errors of ``of`` (poses, scans; None: there are none).
    """
    own = None if own_mm is None or not np.isfinite(own_mm) else own_mm
    held = None if held_95_mm is None or not np.isfinite(held_95_mm) else held_95_mm
    itself = f"of the calibration itself{f', at {place}' if place else ''}"
    seen = (
        f"of 1 {of.removesuffix('s')}, unseen by its calibration"
        if n == 1
        else f"within which 95 % of {n} {of} were, each unseen by its calibration"
    )
    if own is None and held is None:
        return ExpectedError(
            what, "not known", f"the method states no uncertainty, and none of the {of} was left out"
        ), float("nan")
    if held is None:
        return ExpectedError(what, f"{own:.3f} mm", f"{itself}; no unseen {of.removesuffix('s')} backs it"), float(
            own or 0.0
        )
    if own is None:
        return ExpectedError(what, f"{held:.3f} mm", f"{seen}; the method states no uncertainty of its own"), held
    larger = max(own, held)
    return (
        ExpectedError(what, f"{larger:.3f} mm", f"the larger of two: {own:.3f} mm {itself}, and {held:.3f} mm {seen}"),
        larger,
    )


def work_point_expected(work: WorkPoint) -> tuple[ExpectedError, float]:
    """Return the error at the work point in words, and in mm."""
    x, y, z = work.p_B_mm
    place = f"({x:.0f}, {y:.0f}, {z:.0f}) mm in the base"
    what = "error at the work point, 95 %"
    return expected_error(what, work.error_95_mm, work.held_out_95_mm, work.unseen_poses, "poses", place)


def check_limit(limit_mm: float | None) -> None:
    """Check a stated tolerance. Raises InputError where it is no positive number."""
    if limit_mm is not None and not (np.isfinite(limit_mm) and limit_mm > 0.0):
        raise InputError(f"The limit must be a positive number of millimetres, not {limit_mm:g}.")


def refused_note(refused: Sequence[tuple[str, str]], n: int, what: str = "scans") -> tuple[str, ...]:
    """Return a sentence on what was not used, of ``n`` in all; none where all were used."""
    if not refused:
        return ()
    names = ", ".join(name for name, _ in refused[:4]) + (" ..." if len(refused) > 4 else "")
    was = "was not used ({}); the reason is" if len(refused) == 1 else "were not used ({}); the reasons are"
    return (f"{len(refused)} of {n} {what} {was.format(names)} listed in the report.",)


def _first_few(texts: Iterable[str]) -> tuple[str, ...]:
    every = list(dict.fromkeys(texts))
    if len(every) <= MOST_CONCERNS:
        return tuple(every)
    kept = every[: MOST_CONCERNS - 1]
    return (*kept, f"{len(every) - len(kept)} more are listed in the report.")


def sentences(text: str) -> list[str]:
    """Split a text into its sentences."""
    return re.split(r"(?<=[.!?])\s+(?=[A-Z])", text.strip())


def first_sentence(text: str) -> str:
    """Return the text up to the end of its first sentence."""
    return sentences(text)[0]


def upper(text: str) -> str:
    """Return the text with a capital first letter."""
    return text[:1].upper() + text[1:]
