"""Writes what the doctor finds: each cause with its evidence and the next step, and the report of `weldcal doctor`."""

from collections.abc import Callable
from dataclasses import asdict, dataclass

from weldcal.calibration.doctor.case import DoctorCase
from weldcal.calibration.doctor.diagnose import WORN, Cause, Diagnosis, diagnose
from weldcal.models.errors import WeldcalError

CALIBRATION = "calibration.yaml"
CHECKED = (
    "scanner moved", "TCP set at the controller", "wrong quaternion order", "poses inverted",
    "wrong rotation convention",
    "scans and poses shifted by one", "robot in another installation", "wrong flange size", "unit mix",
    "poses too alike",
    "scanner out of focus or range", "warm-up drift", "slack flange or loose mount", "wrong kinematics file",
    "outlier scans or partial views", "hidden tag", "soft tip worn", "torch bent or moved",
    "scanner axes mirrored",
    "scans and poses in different orders", "scanner scale error", "too few scans", "position columns exchanged",
)  # fmt: skip


NOT_ALIKE = ("TCP set at the controller",)
"""Causes that poses with one orientation cannot show."""


@dataclass(frozen=True)
class NamedCause:
    """A cause as it is printed: its name, confidence 0 to 1, evidence and next step, each a sentence."""

    name: str
    confidence: float
    evidence: str
    next: str


_CENTRES_SAY = 1.5
"""How much better the centres fit with a cause before they are its evidence; else the normals are."""


@dataclass(frozen=True)
class DoctorReport:
    """The named causes, the likeliest first; what was examined, number of scans, and the spread left (mm or None)."""

    source: str
    causes: tuple[NamedCause, ...]
    n: int
    spread_mm: float | None
    alike_deg: float | None = None

    @property
    def checked(self) -> list[str]:
        """What was looked for and would show."""
        return [name for name in CHECKED if self.alike_deg is None or name not in (*NOT_ALIKE, "poses too alike")]

    def summary(self) -> dict[str, object]:
        """Return the JSON object of `doctor`."""
        return {
            "state": "done",
            "source": self.source,
            "scans": self.n,
            "causes": [asdict(c) for c in self.causes],
            "spread_mm": self.spread_mm,
            "checked": self.checked,
            "alike_deg": self.alike_deg,
        }

    def text(self) -> str:
        """Return the printed answer."""
        if not self.causes:
            return (
                f"doctor: no cause found in {self.n} scans ({self.source}).\n  checked: {', '.join(self.checked)}\n"
                + self._not_shown
                + "  Where new scans still disagree, run 'weldcal verify' with the result and their folder."
            )
        lines = [
            f"doctor: {len(self.causes)} cause{'s' if len(self.causes) > 1 else ''} in {self.n} scans ({self.source})"
        ]
        for k, c in enumerate(self.causes, start=1):
            lines += [
                f"\n  {k}. {c.name} (confidence {100 * c.confidence:.0f} %)",
                f"     evidence  {c.evidence}",
                f"     next      {c.next}",
            ]
        return "\n".join(lines + ([f"\n{self._not_shown.rstrip()}"] if self._not_shown else []))

    @property
    def _not_shown(self) -> str:
        """Return the line on causes that these poses cannot show; empty where they can."""
        if self.alike_deg is None:
            return ""
        return (
            f"  cannot be seen: {', '.join(NOT_ALIKE)}. The poses differ by only {self.alike_deg:.1f} degrees in"
            " orientation: turn and tilt the flange by 20 degrees or more between poses, and scan again.\n"
        )


def worded(source: str, diagnosis: Diagnosis, *, most: int = 3) -> DoctorReport:
    """Return the report of a diagnosis: at most three causes."""
    spread = 1e3 * diagnosis.spread_m
    return DoctorReport(
        source,
        tuple(NamedCause(c.name, round(c.confidence, 3), *_WORDS[c.name](c)) for c in diagnosis.causes[:most]),
        diagnosis.n,
        spread if spread == spread else None,
        diagnosis.alike_deg if diagnosis.alike_deg == diagnosis.alike_deg else None,
    )


_NAMED_ALREADY = ("scanner moved", "TCP set at the controller", "unexplained", "too few scans")
"""Causes that the solver names itself, or that are none."""


def name_cause(problem: WeldcalError, case: DoctorCase) -> None:
    """Add the likely cause, its evidence and its correction to a refusal, unless the refusal names it."""
    causes = worded("", diagnose(case), most=1).causes
    if not causes or causes[0].name in _NAMED_ALREADY:
        return
    cause = causes[0]
    problem.args = (
        (
            f"{problem} The likely cause is: {cause.name} ({100.0 * cause.confidence:.0f} %). {cause.evidence}"
            f" {cause.next}"
        ),
        *problem.args[1:],
    )


def _names(c: Cause, most: int = 5) -> str:
    more = len(c.where) - most
    return ", ".join(c.where[:most]) + (f" and {more} more" if more > 0 else "")


def _fits(c: Cause) -> str:
    n = c.numbers
    if "without_deg" in n and n["without_mm"] < _CENTRES_SAY * n["with_mm"] and n["without_deg"] > n["with_deg"]:
        return (
            f"with it the faces look along the poses' z axes to {n['with_deg']:.2f} degrees, without it to"
            f" {n['without_deg']:.1f} (median); the centres fit to {n['with_mm']:.2f} mm either way"
        )
    return (
        f"with it the centres fit to {c.numbers['with_mm']:.2f} mm, without it to {c.numbers['without_mm']:.2f} mm"
        " (median)"
    )


def _moved(c: Cause) -> tuple[str, str]:
    return (
        (
            f"From '{c.where[1]}' on the scans agree on another camera pose than up to '{c.where[0]}':"
            f" {c.numbers['shift_mm']:.2f} mm and {c.numbers['turn_deg']:.3f} degrees apart; {_fits(c)}."
        ),
        f"Fasten the scanner. Calibrate only the later part with 'weldcal calibrate --poses {c.where[1]}:'.",
    )


def _tcp(c: Cause) -> tuple[str, str]:
    t = ", ".join(f"{c.numbers[f'tcp_{a}_mm']:.1f}" for a in "xyz")
    metres = ", ".join(f"{1e-3 * c.numbers[f'tcp_{a}_mm']:.4f}" for a in "xyz")
    return (
        f"The poses stand off the flange by a constant ({t}) mm in their own frame; {_fits(c)}.",
        (
            f"Set the TCP to zero at the controller and record again, or write poses: {{tcp: [{metres}, 0.0, 0.0,"
            " 0.0]} (m, rad) in dataset.yaml; if the TCP is turned too, with the rotation that the controller shows."
        ),
    )


def _misread(c: Cause) -> tuple[str, str]:
    order = "quaternion_wxyz" if c.words.startswith("the quaternions' order is (w") else "quaternion_xyzw"
    cure = {
        "wrong quaternion order": f"Swap the columns, or set 'poses: {{rotation: {order}}}' in dataset.yaml.",
        "poses inverted": "Set 'poses: {frame: base_in_flange}' in dataset.yaml, or invert the poses.",
        "wrong rotation convention": "Set 'poses: {rotation: ...}' in dataset.yaml to what the robot writes.",
        "position columns exchanged": "Name the columns in the header of the poses in the order of their numbers.",
        "scanner axes mirrored": "Export the clouds in a right-handed frame: x right, y down, z out of the scanner.",
        "scans and poses in different orders": (
            "Pair each scan with its own pose, by the same name; write numbers as 01, 02."
        ),
        "scans and poses shifted by one": "Pair each scan with its own pose, by the same name.",
    }[c.name]
    return f"It fits if {c.words}: {_fits(c)}.", cure


def _installation(c: Cause) -> tuple[str, str]:
    return (
        (
            f"The scans agree with each other, but put the scanner {c.numbers['off_mm']:.0f} mm from where it was"
            f" measured (stated to {c.numbers['stated_mm']:.0f} mm): the base is shifted by {c.numbers['shift_mm']:.0f}"
            f" mm and turned by {c.numbers['turn_deg']:.0f} degrees."
        ),
        (
            "Load the installation (base frame and mounting) that the cell uses, and record again; or measure"
            " scanner_guess anew."
        ),
    )


def _flange(c: Cause) -> tuple[str, str]:
    return (
        f"The scans show a flange {c.words}, and another one is stated.",
        f"State the flange that is on the robot: --flange {c.words}, or 'flange:' in dataset.yaml.",
    )


def _units(c: Cause) -> tuple[str, str]:
    factor = c.numbers.get("factor", 1e3)
    which = f"{len(c.where)} scans ({_names(c)})" if c.where else "The files"
    return (
        c.words or f"{which} hold lengths in another unit: a factor of {factor:.4g}.",
        "Write all lengths in one unit, and name it in dataset.yaml: 'units: {clouds: m, poses: mm}'.",
    )


def _alike(c: Cause) -> tuple[str, str]:
    return (
        (
            f"The flange centres spread by {c.numbers['spread_mm']:.0f} mm (and {c.numbers['second_mm']:.0f} mm across"
            f" that), and the orientations differ by at most {c.numbers['turn_deg']:.1f} degrees."
        ),
        "Take 8 to 12 poses over the working volume, tilted and turned by 20 degrees or more.",
    )


def _focus(c: Cause) -> tuple[str, str]:
    span = (
        f" The scanner's range is {c.numbers['near_mm']:.0f} to {c.numbers['far_mm']:.0f} mm."
        if "near_mm" in c.numbers
        else ""
    )
    return (
        (
            f"The noise of the faces is {c.numbers['factor']:.1f} times larger about {c.numbers['at_mm']:.0f} mm from"
            f" the scanner than distance explains ({_names(c)}).{span}"
        ),
        "Keep the flange within the scanner's range, focus it on the middle of the poses, and scan those poses again.",
    )


def _drift(c: Cause) -> tuple[str, str]:
    course = "and levels off, as of a scanner that warms up" if c.numbers["levels_off"] else "evenly"
    return (
        f"The camera creeps by {c.numbers['drift_mm']:.2f} mm over the recording, {course}; {_fits(c)}.",
        "Let scanner and robot run until they are warm (30 minutes or more), then record again without a pause.",
    )


def _slack(c: Cause) -> tuple[str, str]:
    what = "The flange or what it carries" if c.numbers["in_flange"] else "The scanner"
    return (
        (
            f"{what} stands in two places, {c.numbers['jump_mm']:.2f} mm apart, and jumps between them: {_names(c)}"
            f" against the others; {_fits(c)}."
        ),
        "Tighten the flange's screws and the scanner's mount, push at both by hand, and record again.",
    )


def _kinematics(c: Cause) -> tuple[str, str]:
    if c.where[0].startswith("as of a "):
        return (
            (
                f"The poses are those of another arm: computed {c.where[0]} from the same joints they move by"
                f" {c.numbers['largest_mm']:.0f} mm, and {_fits(c)}."
            ),
            (
                f"Name the arm that stands there ({c.where[0].rpartition(' ')[2]}) in dataset.yaml and at the program"
                " that wrote the poses."
            ),
        )
    return (
        (
            f"The residuals follow the joint angles: other joint zeros and link lengths (above all {c.where[0]}) move"
            f" the flange by up to {c.numbers['largest_mm']:.1f} mm; {_fits(c)}."
        ),
        "Compute the poses by this robot's own calibration file (its serial number), or read them from the controller.",
    )


def _outliers(c: Cause) -> tuple[str, str]:
    if "worst_mm" in c.numbers:
        said = (
            f"{_names(c)} disagree by up to {c.numbers['worst_mm']:.1f} mm; the others agree to"
            f" {c.numbers['others_mm']:.2f} mm."
        )
    else:
        said = (
            f"{100 * c.numbers['share']:.0f} % of the scans show too little of the flange's edge, or none"
            f" ({_names(c)})."
        )
    return (
        said,
        (
            "Look at these scans: remove them, or scan their poses again with the whole flange in view and nothing in"
            " front of it."
        ),
    )


def _hidden(c: Cause) -> tuple[str, str]:
    log = (
        f"The weld log repeats one deflection for its last {c.numbers['blind_s']:.2f} s."
        if c.numbers["blind_s"] > 0.0
        else ""
    )
    return (
        " ".join(text for text in (c.words, log) if text),
        (
            "Clean the tag and the finger camera's window, keep spatter and cables off them, and check the light:"
            " weldcal check-cell."
        ),
    )


def _worn(c: Cause) -> tuple[str, str]:
    return (
        (
            f"At touch-on the tag moved {c.numbers['gain']:.2f} times as far as the tip; a good tip stays within"
            f" {WORN:.2f} of 1."
        ),
        "Look at the soft tip for wear and cracks, replace it, and calibrate it: weldcal finger calibrate.",
    )


def _bent(c: Cause) -> tuple[str, str]:
    return (
        c.words,
        "After a repair measure the tool again: 'weldcal tool check' with its file and --measure with the scans.",
    )


def _held(c: Cause) -> tuple[str, str]:
    return c.words, "Do what the sentence says. docs/robot_faults.md lists the faults of robot and devices."


def _scale(c: Cause) -> tuple[str, str]:
    if "no hole circle is there" in c.words:
        return c.words, "Check the scanner's own calibration: a ring without holes cannot confirm a scale."
    if c.words:
        return c.words, "Scan nearer, or with more pixels, so that three scans or more show the flange's holes."
    return (
        (
            f"The scans are {abs(c.numbers['percent']):.2f} % too {'small' if c.numbers['percent'] > 0 else 'large'};"
            f" with that scale the centres fit to {c.numbers['with_mm']:.2f} mm (median)."
        ),
        "Check the scanner's own calibration and the unit of its export; weldcal corrects small errors by itself.",
    )


def _few(c: Cause) -> tuple[str, str]:
    return (
        f"{c.numbers['n']:.0f} scans can be used, and the residuals say nothing with fewer than 5.",
        "Take 8 to 12 poses over the working volume, tilted and turned by 20 degrees or more.",
    )


def _unexplained(c: Cause) -> tuple[str, str]:
    if "normals_deg" in c.numbers:
        return (
            (
                f"The centres agree to {c.numbers['centres_mm']:.2f} mm, but the faces are turned by"
                f" {c.numbers['normals_deg']:.1f} degrees from the poses' z axes (median), and no known misreading of"
                " the rotations explains it."
            ),
            (
                "Compare one stated orientation with the controller's screen: its order, unit (degrees or radians) and"
                " frame."
            ),
        )
    return (
        (
            f"After the best of all models the centres still disagree by {c.numbers['with_mm']:.1f} mm and the normals"
            f" by {c.numbers['tilt_deg']:.1f} degrees (medians), most at {_names(c)} ({c.numbers['worst_mm']:.1f} mm)."
            " No known cause explains it."
        ),
        (
            "Check by hand that each scan belongs to its pose; then record three scans at one pose: they must agree to"
            " the scanner's noise."
        ),
    )


_WORDS: dict[str, Callable[[Cause], tuple[str, str]]] = {
    "scanner moved": _moved, "TCP set at the controller": _tcp, "wrong quaternion order": _misread,
    "poses inverted": _misread,
    "wrong rotation convention": _misread, "scans and poses shifted by one": _misread,
    "robot in another installation": _installation,
    "wrong flange size": _flange, "unit mix": _units, "poses too alike": _alike,
    "scanner out of focus or range": _focus,
    "warm-up drift": _drift, "slack flange or loose mount": _slack, "wrong kinematics file": _kinematics,
    "outlier scans or partial views": _outliers, "hidden tag": _hidden, "soft tip worn": _worn,
    "torch bent or moved": _bent, "the run was held": _held,
    "scanner axes mirrored": _misread, "scans and poses in different orders": _misread, "scanner scale error": _scale,
    "too few scans": _few, "unexplained": _unexplained, "position columns exchanged": _misread,
}  # fmt: skip
