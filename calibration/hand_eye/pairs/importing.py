"""Import pairs of robot and camera poses: find both lists, pair their rows, and let the data choose the reading."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.listing import Listing
from weldcal.calibration.data.poses.lists import named_inverse, together, two_lists
from weldcal.calibration.data.poses.readings import PoseReading, change_of, pick
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.robust import Rows
from weldcal.calibration.geometry.se3 import scaled
from weldcal.calibration.hand_eye.pairs.conventions import UNITS, ReadingAgreement, ReadingDecision, decide, order_of
from weldcal.models.arrays import Array

BY_MOTION = "by their motions"
"""How rows were paired whose order the angles of the motions show."""
_MOST_COMPARED = 60  # poses that decide the reading: more do not make it surer
_FEWEST = 4  # with fewer pairs the data decide nothing
_SHIFTS = (1, -1, 2, -2, 3, -3)
_DISTINCT = 1e-7  # of a rotation matrix, and of the extent of positions
_MILLIMETRES_FROM, _METRES_TO = 80.0, 10.0  # median distances of a robot's poses from its base, in mm and m
NEAREST_M = 0.02  # a choice: no arm works 20 mm from its own axis
FARTHEST_M = 20.0  # a choice: beyond any arm on a rail, below millimetres that are called metres
"""Median distance of a robot's poses from its base beyond which the unit is wrong."""
SCALE_SIGMA = 4.0  # a choice: 6 in 100,000 normal draws lie beyond
"""A ratio of lengths is known where this many of its standard deviations are below LEAST_SCALE."""
_OTHER_UNIT = 0.1  # of the logarithm: how near a factor must be to that of another unit than the robot's
_OTHER_SIZE = 2.0  # a choice: no board is measured wrong by a factor of 7
_SQUARES_M = (0.005, 0.2)  # a choice: sizes of a board's squares, which some programs count
_OWN_RAD = 0.005  # a choice: 0.3 deg, more than the errors of an arm turn its flange
LEAST_SCALE = 0.2  # a choice: 20 %, beyond a board's wrong scale, within a factor of unit
"""Of the logarithm of a factor on lengths: a factor that is nearer to a unit is a matter of the result, which names
it."""


@dataclass(frozen=True, kw_only=True)
class StatedForms:
    """What the user states of the two lists: form and name of each, the unit and who states it, the robot."""

    robot: PoseForm = field(default_factory=PoseForm)
    camera: PoseForm = field(default_factory=PoseForm)
    robot_poses: str | None = None
    camera_poses: str | None = None
    unit: str | None = None
    unit_by: str = "--unit"
    decide: bool = True  # whether the data choose the reading: not where the file holds motions
    arm: str | None = None  # the robot whose joint angles stand for its poses
    camera_known: bool = False  # whether the camera's poses were computed here, so that their reading is no question


class WrongScale(InconsistentPoses):
    """The camera's positions fit the robot's motion with one factor that is no ratio of units."""

    def __init__(self, factor: float, sentence: str) -> None:
        super().__init__(sentence)
        self.factor = factor


@dataclass(frozen=True, eq=False, kw_only=True)
class ImportedPairs:
    """Pairs of poses, (n, 4, 4) each, in metres, and how they were understood.

    Attributes:
        robot, camera: X_BF and X_CM.
        reading: for each list its file, form, unit, reading and the rows left out.
        notes: sentences for the reader.
        ids: names of the rows that are left, (n) or empty.
        rows: rows (from 0) of the robot's and of the camera's list that were paired.
        counts: rows of both lists.
        metres: of the robot's unit of length.
        joints: joint angles rad of all rows of the robot's list, or None.
    """

    robot: Array
    camera: Array
    reading: Mapping[str, Mapping[str, object]]
    notes: tuple[str, ...]
    ids: tuple[str, ...]
    rows: tuple[Rows, Rows]
    counts: tuple[int, int]
    metres: float
    joints: Array | None = None


def import_pairs(lists: list[Listing], source: str, mounting: str, stated: StatedForms) -> ImportedPairs:
    """Return the pairs of two lists of poses, each read as the data and the user's statements say.

    Args:
        lists: those of the source.
        source: the file or folder, for messages.
        mounting: eye_in_hand or eye_on_base.
        stated: what the user states.

    Raises:
        DatasetError: a list is missing, the rows do not pair, a unit cannot be told.
        InconsistentPoses: several readings agree with the data and differ in the result, or one factor scales the
            camera's positions.
    """
    robot, camera = two_lists(lists, source, stated.robot_poses, stated.camera_poses)
    robot = robot.of_arm(stated.arm)
    _check_own(robot, camera)
    robot = robot.stated(_with_name(robot, stated.robot), "--as robot-form")
    camera = camera.stated(_with_name(camera, stated.camera), "--as camera-form")
    known = stated.decide and mounting in ("eye_in_hand", "eye_on_base")
    notes: list[str] = []
    paired = ""
    try:
        rows_r, rows_c, how = together(robot, camera)
    except DatasetError:
        ordered = _ordered(robot, camera, mounting) if known else None
        if ordered is None:
            raise
        rows_r, rows_c, how, paired = *ordered, "", BY_MOTION
        notes.append(order_words(robot, camera, *ordered))
    keep = robot.good[rows_r] & camera.good[rows_c]
    notes += _left_out(robot, rows_r, ~keep) + _left_out(camera, rows_c, ~keep)
    rows_r, rows_c = rows_r[keep], rows_c[keep]
    n = len(rows_r)
    if n == 0:
        raise DatasetError(f"'{source}' holds no pair of poses: each row lacks the robot's or the camera's pose.")
    a, b = [pick(one, rows) for one, rows in ((robot.readings, rows_r), (camera.readings, rows_c))]
    _check_motion(a[0], robot, "robot")
    _check_motion(b[0], camera, "camera")
    decision, shift = decided(a, b, mounting == "eye_in_hand", n) if known else (None, 0)
    ordered = None
    if known and how and (shift or not (decision and decision.best.agrees)):
        ordered = _ordered(robot, camera, mounting, sure=not shift)
    whole = max(shift, 0) - max(-shift, 0)  # rows of the robot's list before those of the camera's
    if ordered is not None and not (shift and (ordered[0] - ordered[1] == whole).all()):
        rows_r, rows_c, how, paired = *ordered, "", BY_MOTION
        notes.append(order_words(robot, camera, *ordered))
        n = len(rows_r)
        a, b = [pick(one, rows) for one, rows in ((robot.readings, rows_r), (camera.readings, rows_c))]
        decision, shift = decided(a, b, mounting == "eye_in_hand", n)
    if decision is None:
        A, B = a[0], b[0]
        if len(a) > 1 or len(b) > 1:
            notes.append(
                f"{n} pairs do not show how the poses are written; they were read as {A.words} and {B.words}. State it"
                " with --as robot-form=FORM and --as camera-form=FORM."
            )
        units = _units(A, B, robot, camera, None, stated, source)
    else:
        best = decision.best
        _require_one(decision, (a, b), (robot, camera), source, mounting, stated.camera_known)
        A, B = [_of_all_rows(_changed(listed, one), one) for listed, one in ((a, best.robot), (b, best.camera))]
        notes += _sentences(decision, robot, camera, shift)
        units = _units(A, B, robot, camera, best, stated, source)
    if shift:
        A, B = (
            replace(A, X=A.X[max(shift, 0) : n + min(shift, 0)]),
            replace(B, X=B.X[max(-shift, 0) : n + min(-shift, 0)]),
        )
        rows_r, rows_c = rows_r[max(shift, 0) : n + min(shift, 0)], rows_c[max(-shift, 0) : n + min(-shift, 0)]
    reading = {
        who: {
            "file": listing.name,
            "form": listing.form,
            "unit": unit,
            "reading": one.form,
            "rows": len(listing),
            "left_out": [f"row {row + 1}: {why}" for row, why in listing.left_out],
            "paired": paired or how,
        }
        for who, listing, one, unit in (("robot", robot, A, units[0][1]), ("camera", camera, B, units[1][1]))
    }
    if how == "by time" or (shift and how):
        notes.append(f"The rows were paired {how}.")
    metric = [scaled(one.X, factor) for one, (factor, _) in zip((A, B), units, strict=True)]
    ids = robot.ids or camera.ids
    rows = rows_r if robot.ids else rows_c
    return ImportedPairs(
        robot=metric[0],
        camera=metric[1],
        reading=reading,
        notes=tuple(notes),
        ids=tuple(ids[k] for k in rows) if ids else (),
        rows=(rows_r, rows_c),
        counts=(len(robot), len(camera)),
        metres=units[0][0],
        joints=robot.joints,
    )


def _check_own(robot: Listing, camera: Listing) -> None:
    """Raise DatasetError where the poses beside a robot's joint angles are those of its flange or tool."""
    if robot.joints is None or len(robot) != len(camera) or robot.name.rpartition(", ")[2] != "joints":
        return
    R = robot.readings[0].X[:, :3, :3]
    limit = min(_OWN_RAD, 0.1 * float(np.ptp(R, axis=0).max()))  # an arm that hardly turns shows nothing of it
    for one in camera.readings:
        tool = np.swapaxes(R, 1, 2) @ one.X[:, :3, :3]
        if float(np.ptp(tool[camera.good], axis=0).max(initial=0.0)) < limit:
            raise DatasetError(
                f"The poses in '{camera.name}' are those of the joint angles beside them, and the camera's are"
                " missing: give these as a second list."
            )


def _with_name(listing: Listing, form: PoseForm) -> PoseForm:
    """Return the stated form, inverted where the list's name says so."""
    return replace(form, frame="base_in_flange") if named_inverse(listing) and form.frame == "flange_in_base" else form


def _of_all_rows(listed: list[PoseReading], chosen: PoseReading) -> PoseReading:
    """Return the chosen reading with all rows: of the same form, and of the same meaning where six numbers have two."""
    same = [one for one in listed if one.form == chosen.form]
    return min(same, key=lambda one: float(np.abs(one.X - chosen.X[0]).max(axis=(1, 2)).min()))


def _changed(listed: list[PoseReading], wanted: PoseReading) -> list[PoseReading]:
    """The readings, and the wanted one's change applied to them all."""
    by = change_of(wanted, listed)
    return listed if by is None else [*listed, *(one.changed(by) for one in listed)]


def _option(who: str, one: PoseReading, listing: Listing) -> str:
    """Return the option that states a reading; the name of a list may invert it beyond that."""
    return f"--as {who}-form={(one.changed('inverse') if named_inverse(listing) else one).form}"


def _ordered(robot: Listing, camera: Listing, mounting: str, *, sure: bool = True) -> tuple[Rows, Rows] | None:
    """Rows of both lists that belong together by the angles of their motions; None where no order agrees.

    Raises InconsistentPoses where some rows may have several partners, if ``sure``.
    """
    good = [np.flatnonzero(one.good) for one in (robot, camera)]
    lists = [pick(one.readings, rows) for one, rows in zip((robot, camera), good, strict=True)]
    found = order_of(*lists, eye_in_hand=mounting == "eye_in_hand")
    if found is None or 2 * len(found.unclear) > len(found.first) or (found.unclear and not sure):
        return None
    if found.unclear:
        raise InconsistentPoses(
            f"The rows of '{robot.name}' and '{camera.name}' are not in the same order. The poses show the order of all"
            f" but {_rows(robot, good[0][list(found.unclear)])} of '{robot.name}'. Number the rows of both lists alike,"
            " or remove these."
        )
    return good[0][found.first], good[1][found.second]


def order_words(robot: Listing, camera: Listing, rows_r: Rows, rows_c: Rows) -> str:
    """Say in which order two lists belong together, and which rows have no partner."""
    said = ""
    moved = [(r, c) for r, c in zip(rows_r.tolist(), rows_c.tolist(), strict=True)]
    if len(moved) > 1 and (np.diff(rows_c) == -1).all():
        said = f"The rows of '{camera.name}' are in reverse order"
    elif (np.diff(rows_c) < 0).any():
        pairs = ", ".join(f"{_row(camera, c)} to {_row(robot, r)}" for r, c in moved[:12])
        more = f" and {len(moved) - 12} more" if len(moved) > 12 else ""
        said = f"The rows of '{camera.name}' belong to others of '{robot.name}': {pairs}{more}"
    else:
        said = f"The rows of '{camera.name}' are in the order of '{robot.name}', but some have no partner"
    said += ". The angles of the motions show it."
    for one, rows in ((robot, rows_r), (camera, rows_c)):
        alone = np.setdiff1d(np.flatnonzero(one.good), rows)
        if len(alone):
            said += f" No partner: {_rows(one, alone)} of '{one.name}'."
    return said


def _row(listing: Listing, row: int) -> str:
    return listing.ids[row] if listing.ids else str(row + 1)


def _rows(listing: Listing, rows: NDArray[np.integer[Any]]) -> str:
    return f"row{'s' if len(rows) > 1 else ''} {', '.join(_row(listing, int(k)) for k in rows)}"


def _left_out(listing: Listing, rows: Array, out: Array) -> list[str]:
    reasons = dict(listing.left_out)
    found = [(int(r), reasons[int(r)]) for r in rows[out] if int(r) in reasons]
    if not found:
        return []
    which = ", ".join(listing.ids[r] if listing.ids else str(r + 1) for r, _ in found[:8])
    return [f"'{listing.name}': row{'s' if len(found) > 1 else ''} {which} left out. {found[0][1]}"]


def _check_motion(reading: PoseReading, listing: Listing, who: str) -> None:
    X = reading.X
    if len(X) > 1 and float(np.abs(X - X[0]).max()) <= _DISTINCT * max(float(np.abs(X[:, :3, 3]).max()), 1.0):
        raise InconsistentPoses(
            f"The {who} has the same pose in all {len(X)} rows of '{listing.name}', but the other list changes. Check"
            f" that each sample stores the pose that the {who} has at that moment."
        )


def decided(
    a: list[PoseReading], b: list[PoseReading], eye_in_hand: bool, n: int
) -> tuple[ReadingDecision | None, int]:
    """Return the decision, and by how many rows the camera's list is shifted; None where the data decide nothing."""
    if n < _FEWEST:
        return None, 0
    some = np.unique(np.linspace(0, n - 1, min(n, _MOST_COMPARED)).round().astype(int))
    found = decide(pick(a, some), pick(b, some), eye_in_hand=eye_in_hand)
    if found.best.agrees:
        return found, 0
    best, by = found, 0
    for shift in _SHIFTS:
        if n - abs(shift) < max(_FEWEST, 6):
            continue
        rows = np.arange(n - abs(shift))[:_MOST_COMPARED]
        one = decide(pick(a, rows + max(shift, 0)), pick(b, rows + max(-shift, 0)), eye_in_hand=eye_in_hand)
        if one.best.agrees and one.best.cost < best.best.cost:
            best, by = one, shift
    return (best, by) if best.best.agrees or len(a) > 1 or len(b) > 1 else (None, 0)


def _require_one(
    decision: ReadingDecision,
    stated: tuple[list[PoseReading], list[PoseReading]],
    lists: tuple[Listing, Listing],
    source: str,
    mounting: str,
    camera_known: bool,
) -> None:
    """Raise InconsistentPoses where readings agree equally and differ, or take back a stated change."""
    best = decision.best
    other = "eye_on_base" if mounting == "eye_in_hand" else "eye_in_hand"
    if not best.agrees:
        if decision.rivals or best.changed:
            runner = decision.rivals[0] if decision.rivals else best
            raise InconsistentPoses(
                f"The poses of '{source}' contradict each other in every known convention. The best is"
                f" {_pair_words(best)}, {_residual(best)}; then {_pair_words(runner)}, {_residual(runner)}. Check that"
                " row k of both lists was recorded at the same moment. Or state the conventions with"
                " --as robot-form=FORM and --as camera-form=FORM."
            )
        return
    ones = (best.robot, best.camera)
    own = [change_of(one, listed) for one, listed in zip(ones, stated, strict=True)]
    by, k = own[0] or own[1], int(own[0] is None)  # the change beyond what is stated, and whose list it is
    options = [
        _option(who, one if mine or by is None else one.changed(by), listing)
        for who, one, mine, listing in zip(("robot", "camera"), ones, own, lists, strict=True)
    ]
    if by == "inverse":
        corrections = [f"the camera is mounted {other} (--mounting {other})"]
        for who, option in list(zip(("robot", "camera"), options, strict=True))[: 1 if camera_known else 2]:
            corrections.append(f"the {who} poses are {'' if option.endswith(by) else 'not '}inverted ({option})")
        what, whom = ("robot poses", "the pictures") if camera_known else ("poses", "each other")
        raise InconsistentPoses(
            f"With --mounting {mounting} the {what} of '{source}' contradict {whom}."
            f" {'Two' if camera_known else 'Three'} corrections fit equally well ({_residual(best)}):"
            f" {', '.join(corrections[:-1])}, or {corrections[-1]}. Give the option that is true."
        )
    if decision.rivals:
        rival = decision.rivals[0]
        raise InconsistentPoses(
            f"The poses of '{source}' agree in two conventions, with different results: {_pair_words(best)}"
            f" ({_residual(best)}), or {_pair_words(rival)} ({_residual(rival)}). State the right one:"
            f" {_options(best)}, or {_options(rival)}."
        )
    if by is not None and not ones[k].form.endswith(by):
        raise InconsistentPoses(
            f"The {('robot', 'camera')[k]} poses of '{source}' are stated as {by}, and agree only if they are not"
            f" ({_residual(best)}): state {options[k]}."
        )


def _options(one: ReadingAgreement) -> str:
    return f"--as robot-form={one.robot.form} --as camera-form={one.camera.form}"


def _pair_words(one: ReadingAgreement) -> str:
    return f"robot as {one.robot.words}, camera as {one.camera.words}"


def _residual(one: ReadingAgreement) -> str:
    share = 100.0 * one.position / max(one.extent, 1e-12)
    return f"residuals {np.degrees(one.rotation):.3g} degrees and {share:.2g} % of the motion"


def _sentences(decision: ReadingDecision, robot: Listing, camera: Listing, shift: int) -> list[str]:
    """What was chosen where there was a choice."""
    best, found = decision.best, []
    chosen = [
        f"{who} poses read as {one.words}"
        for who, one, listing in (("robot", best.robot, robot), ("camera", best.camera, camera))
        if len(listing.readings) > 1 or one.form != listing.readings[0].form
    ]
    if chosen:
        text = "; ".join(chosen)
        text = text[0].upper() + text[1:] + f": {_residual(best)}"
        if decision.same:
            text += "; another reading is the same for these poses"
        elif decision.next is not None:
            text += f"; the next best reading leaves {_residual(decision.next).removeprefix('residuals ')}"
        found.append(text + ".")
    if shift:
        later = "later" if shift > 0 else "earlier"
        found.append(
            f"The camera's rows belong to robot poses {abs(shift)} row{'s' if abs(shift) > 1 else ''} {later}: they"
            " were shifted."
        )
    return found


def _units(
    A: PoseReading,
    B: PoseReading,
    robot: Listing,
    camera: Listing,
    best: ReadingAgreement | None,
    stated: StatedForms,
    source: str,
) -> tuple[tuple[float, str], tuple[float, str]]:
    """Metres for the units of the robot's and of the camera's positions, with the units' names.

    Stated units win. Else the robot's follows from its reach, and the camera's from the ratio of the motions.
    """
    ours, _, theirs = (stated.unit or "").partition(",")
    units = ours, theirs or ours
    words = [robot.unit or units[0], camera.unit or units[1]]
    for listing, unit in zip((robot, camera), units, strict=True):
        if listing.unit and unit and listing.unit != unit:
            raise DatasetError(
                f"'{listing.name}' states lengths in {listing.unit}, and --unit states {unit}; correct one of them."
            )
    median = float(np.median(np.linalg.norm(A.X[:, :3, 3], axis=1)))
    if not words[0]:
        if median > _MILLIMETRES_FROM:
            words[0] = "mm"
        elif median <= _METRES_TO:
            words[0] = "m"
        elif len(pairs := _pairs_of_units(best, median)) == 1:
            words = [pairs[0][0], words[1] or pairs[0][1]]
        else:
            raise DatasetError(
                f"The median distance of the robot positions of '{source}' from the base is {median:.3g}. An arm's"
                " reach is neither that in metres nor in millimetres. State the unit with --unit m, mm, cm or inch, or"
                " the robot's and the camera's with --unit inch,mm."
            )
    unit_r = UNITS[words[0]]
    if median * unit_r > FARTHEST_M or (words[0] != "m" and median * unit_r < NEAREST_M):
        raise DatasetError(
            f"Read in {words[0]}, the robot positions of '{source}' have a median distance of {median * unit_r:.3g} m"
            f" from the base. No arm reaches that: correct {'the unit in the file' if robot.unit else stated.unit_by}."
        )
    ratio = None
    if best is not None and best.agrees and best.scale_sigma * SCALE_SIGMA < LEAST_SCALE:
        ratio = best.scale * unit_r  # metres per camera unit
    if not words[1]:
        words[1] = _camera_unit(ratio, words[0], B, source)
    elif ratio is not None and abs(np.log(ratio / UNITS[words[1]])) > LEAST_SCALE:
        _refuse_scale(ratio, words[1], source)
    return (unit_r, words[0]), (UNITS[words[1]], words[1])


def _pairs_of_units(best: ReadingAgreement | None, median: float) -> list[tuple[str, str]]:
    """Units of robot and camera that the ratio of the motions and the robot's reach allow."""
    if best is None or not best.agrees:
        return []
    return [
        (ours, theirs)
        for ours, theirs in product(UNITS, UNITS)
        if NEAREST_M < median * UNITS[ours] < FARTHEST_M
        and abs(np.log(best.scale * UNITS[ours] / UNITS[theirs])) < _OTHER_UNIT
    ]


def _camera_unit(ratio: float | None, robot: str, B: PoseReading, source: str) -> str:
    if ratio is None:
        far = float(np.median(np.linalg.norm(B.X[:, :3, 3], axis=1)))
        return "mm" if far > _MILLIMETRES_FROM else "m" if far <= _METRES_TO else robot
    near = min(UNITS, key=lambda u: abs(np.log(ratio / UNITS[u])))
    # a factor near that of another unit may be the size of a square: 28.5 mm are no inch
    if abs(np.log(ratio / UNITS[near])) > (LEAST_SCALE if near == robot else _OTHER_UNIT):
        _refuse_scale(ratio, "m", source)
    return near


def _refuse_scale(ratio: float, unit: str, source: str) -> None:
    factor = ratio / UNITS[unit]
    near = min(UNITS, key=lambda u: abs(np.log(ratio / UNITS[u])))
    if near != unit and abs(np.log(ratio / UNITS[near])) < _OTHER_UNIT:
        raise InconsistentPoses(
            f"The camera positions of '{source}' fit the robot's motion in {near}, but {unit} is stated. Correct the"
            f" unit, or multiply the positions by {UNITS[near] / UNITS[unit]:g}."
        )
    if abs(np.log(factor)) > _OTHER_SIZE and not _SQUARES_M[0] <= ratio <= _SQUARES_M[1]:
        raise InconsistentPoses(
            f"The camera positions of '{source}' fit the robot's motion only when multiplied by {factor:.4g}. One of"
            " the two lists has another unit, or an unknown scale. State the unit of both with --unit, or multiply the"
            " positions of one list."
        )
    squares = f", or the distances count squares of {ratio:.4g} m" if ratio < _SQUARES_M[1] else ""
    raise WrongScale(
        factor,
        f"The camera positions of '{source}' ({unit}) fit the robot's motion only when multiplied by {factor:.4g}."
        f" The size of the board's squares or of the marker is wrong by that factor{squares}, or the unit is another"
        f" one. Correct the size, or multiply the positions by {factor:.4g}.",
    )
