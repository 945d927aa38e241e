"""Calibrate a camera from a file: pairs of poses, two streams, pictures of a board, or motions."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.bag import at_rest
from weldcal.calibration.data.poses.listing import Listing, listing_of_array
from weldcal.calibration.data.poses.lists import folder_lists, two_lists
from weldcal.calibration.data.poses.names import mounting_name
from weldcal.calibration.errors import DatasetError, InconsistentPoses, UndeterminedPoses
from weldcal.calibration.geometry.se3 import IDENTITY, as_transform, inverse
from weldcal.calibration.hand_eye.corners import poses_from_corners, refine_with_corners
from weldcal.calibration.hand_eye.determinacy import check_poses
from weldcal.calibration.hand_eye.joints import poses_of_arm, refine_joints
from weldcal.calibration.hand_eye.mistakes import explain_outliers, likely_mistake, with_scale
from weldcal.calibration.hand_eye.mountings import Mounting, get_mounting
from weldcal.calibration.hand_eye.opencv_methods import METHODS, most_compared, opencv_held_out
from weldcal.calibration.hand_eye.pairs.files import NO_MOUNTING, PosePairs, read_pairs, recorded_lists
from weldcal.calibration.hand_eye.pairs.importing import FARTHEST_M, StatedForms, import_pairs
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.search import Picture
from weldcal.calibration.hand_eye.pictures.sets import PictureSet, read_corners, read_pictures
from weldcal.calibration.hand_eye.pictures.solution import PictureResult, solve_pictures
from weldcal.calibration.hand_eye.problem import Problem, full_problem
from weldcal.calibration.hand_eye.several import SensorPairs, SensorsTogether, solve_together
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_ax_xb, solve_problem
from weldcal.calibration.motion import pose_streams
from weldcal.calibration.motion.pose_streams import ClockOffset
from weldcal.calibration.planning.next_pose import NextPose, VisibleVolume, next_pose, view_of
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import Chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.scanners import get_scanner

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class HandEyeOptions:
    """What is asked of a file, and what is known of it beforehand.

    ``corners``: use those of the file (None: where it holds some). ``robot``, ``camera``: names of the arm and the
    scanner, for the next pose. ``refine``: "joints" or "links", errors of that robot to look for (one of corners and
    robot errors is applied: the robot's errors are sought in the poses that the corners left). ``kinematics``: file of
    that robot's own kinematics, whose poses at the joint angles replace the stated ones. ``board``: the board in the
    pictures of the folder, see ``parse_board``; ``intrinsics``: the file that states their camera.
    """

    equation: Literal["ax-xb", "ax-yb", "axb-ycz"] = "ax-yb"
    mounting: str | None = None
    unit: str | None = None
    motions: bool = False
    corners: bool | None = False
    robot: str | None = None
    camera: str | None = None
    refine: str | None = None
    kinematics: Path | None = None
    seed: int = 0
    stated: StatedForms = field(default_factory=StatedForms)
    board: str | None = None
    intrinsics: Path | None = None

    def checked(self) -> "HandEyeOptions":
        """Return the options with a camera's file told from a scanner's name.

        Raises:
            InputError: one option excludes another, or needs another.
        """
        asked = self
        if self.board is not None and self.camera is not None and Path(self.camera).is_file():
            asked = replace(self, intrinsics=Path(self.camera), camera=None)
        otherwise = self.motions or self.corners is False or self.refine is not None or self.equation == "axb-ycz"
        if self.board is not None and otherwise:
            without = "--as motions, --no-corners and --refine"
            raise InputError(f"Pictures (--board) are solved by their corners: omit {without}.")
        needs = {"A kinematics file (--kinematics) needs": self.kinematics, "Robot errors (--refine) need": self.refine}
        for option, value in needs.items():
            if value is not None and self.robot is None:
                raise InputError(f"{option} the robot's name. Add --robot, for example ur10e.")
        return replace(asked, stated=replace(asked.stated, arm=asked.robot))


@dataclass(frozen=True)
class MethodRow:
    """One line of the comparison: a method and its held-out errors; NaN where it gave no answer on some fold."""

    method: str
    deg: float
    mm: float


@dataclass(frozen=True, kw_only=True)
class RecordedHandEye:
    """A calibration from a file: the result, the comparison and the next pose (``advice``).

    ``corners``: sentences on corners and robot errors; ``streams``: the synchronisation where two streams were
    given; ``pairs``: as they were solved.
    """

    result: HandEyeResult
    mounting: Mounting
    comparison: tuple[MethodRow, ...]
    next_pose: NextPose | None
    corners: str = ""
    advice: str = ""
    streams: ClockOffset | None = None
    reading: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    read_notes: tuple[str, ...] = ()
    pictures: PictureResult | None = None
    pairs: PosePairs | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedTogether:
    """Several sensors from a file each: their calibrations with the poses and covariances of the joint solution."""

    each: tuple[RecordedHandEye, ...]
    together: SensorsTogether


@dataclass
class _Solution:
    """What is known so far of a file. ``adopted``: corners or robot errors are applied."""

    pairs: PosePairs
    problem: Problem
    result: HandEyeResult
    pictures: PictureResult | None = None
    adopted: bool = False


def calibrate_recorded(
    file: Path, asked: HandEyeOptions, say: Say = lambda _: None, known: dict[str, Picture] | None = None
) -> RecordedHandEye:
    """Calibrate from a file; ``say`` gets the pose-diversity report before anything is solved; ``known``: see find_in.

    Raises:
        InputError, WeldcalError: the file or the options cannot be used. Where the poses contradict each other, the
            sentence names the mistake (unit, inverse, mounting) whose correction makes them agree, if there is one.
    """
    asked = asked.checked()
    arm = None if asked.robot is None else load_chain(asked.robot, asked.kinematics)
    scanner = None if asked.camera is None else get_scanner(asked.camera)
    pairs, streams, shots = _read(file, asked, known)
    for sentence in [*([] if streams is None else [streams.sentence]), *understood(pairs)]:
        say(sentence)
    mounting = get_mounting(pairs.mode)
    if asked.kinematics is not None and arm is not None:
        pairs = poses_of_arm(pairs, arm)
    if (asked.equation == "axb-ycz") != (mounting.name == "co_manipulation"):
        right = "axb-ycz" if mounting.name == "co_manipulation" else "ax-yb"
        solve_it = f"weldcal hand-eye {right} {shlex.quote(str(file))}"
        raise InputError(f"'{file.name}' is {mounting.name}. Solve it with '{solve_it}'.")
    config = HandEyeConfig(seed=asked.seed)
    found = _solve_motions(pairs, asked.equation, config) if asked.motions else _solve_poses(pairs, shots, config, say)
    said = [] if found.pictures is None else found.pictures.sentences
    if found.pictures is None:
        _apply_corners(found, asked, mounting, config, said)
    if asked.refine is not None and arm is not None:
        errors = refine_joints(found.pairs, found.result, arm, asked.refine, config=config)
        said.append(errors.sentence)
        found.result, found.adopted = errors.result, found.adopted or errors.accepted
    if asked.equation == "ax-xb":
        found.result = _only_camera(found.result)
    advice, advised = None, ""
    if not asked.motions and asked.equation != "ax-xb":
        view = view_of(found.problem.G, found.pairs.K if found.pairs.has_corners else None, scanner)
        advice = next_pose(found.problem, found.result, mounting, (IDENTITY,) * 3, arm=arm, view=view)
        advised = advice.sentence() if advice is not None else _no_advice(view, arm)
    return RecordedHandEye(
        result=found.result,
        mounting=mounting,
        # with corners or robot errors applied the poses are others, so that a comparison would be of two data
        comparison=() if asked.motions or found.adopted else _compare(found.problem, found.result),
        next_pose=advice,
        corners=" ".join(said),
        advice=advised,
        reading=found.pairs.reading,
        read_notes=found.pairs.notes,
        streams=streams,
        pictures=found.pictures,
        pairs=found.pairs,
    )


def calibrate_several(files: Sequence[Path], asked: HandEyeOptions, say: Say = lambda _: None) -> RecordedTogether:
    """Calibrate several sensors of one mounting, that measured one target on one robot, from a file each.

    Raises:
        InputError, WeldcalError: as ``calibrate_recorded`` for each, and ``solve_together``.
    """
    if len({file.resolve() for file in files}) < len(files):
        raise InputError("A file is given twice: give the file of each sensor once.")
    if asked.robot is not None or asked.refine is not None:
        raise InputError("--robot and --refine go with one file: calibrate each sensor by itself first.")
    names = sensor_names(files)
    each = []
    for file, name in zip(files, names, strict=True):
        try:
            each.append(calibrate_recorded(file, asked, say))
        except WeldcalError as problem:
            raise InputError(
                f"{name}: {problem} Each of several files holds the pairs of one sensor; put two files of one"
                " sensor into one folder."
            ) from problem
    if len({found.mounting.name for found in each}) > 1:
        listed = ", ".join(f"'{name}' is {found.mounting.name}" for name, found in zip(names, each, strict=True))
        raise InputError(f"The files are of several mountings ({listed}): solve each mounting by itself.")
    cameras = [found.pairs.camera for found in each if found.pairs is not None]
    if any(np.array_equal(a, b) for a, b in combinations(cameras, 2)):
        raise InputError("Two files hold the same poses of the camera: give the file of each sensor once.")
    if open_ := [name for name, found in zip(names, each, strict=True) if found.result.unobservable]:
        raise InputError(f"The poses of '{open_[0]}' leave a direction open: add poses, or omit this file.")
    plain = asked.corners is False
    sensors = [
        SensorPairs(
            name=name,
            pairs=replace(found.pairs, img=None) if plain else found.pairs,
            result=found.result,
            bundle=None if found.pictures is None else found.pictures.bundle,
            free=None if found.pictures is None else found.pictures.free,
        )
        for name, found in zip(names, each, strict=True)
        if found.pairs is not None
    ]
    together = solve_together(sensors, HandEyeConfig(seed=asked.seed))
    n = 6 * len(each)
    joined = []
    for k, found in enumerate(each):
        rows = np.r_[6 * k : 6 * k + 6, n : n + 6]
        S = together.covariance[np.ix_(rows, rows)]
        others = ", ".join(name for name in names if name != names[k])
        result = replace(
            found.result,
            poses={"X": as_transform(together.X[k]), "Y": as_transform(together.Y)},
            covariance={"X": S[:6, :6], "Y": S[6:, 6:]},
            joint_covariance=S,
            method=f"together with {others}",
        )
        joined.append(replace(found, result=result, comparison=()))
    return RecordedTogether(each=tuple(joined), together=together)


def sensor_names(files: Sequence[Path]) -> list[str]:
    """A name for each file: the last part of its path that differs from the others'; with a number where none does."""
    paths = [file.resolve().with_suffix("") if file.is_file() else file.resolve() for file in files]
    for part in range(1, 3):
        names = [path.parts[-part] for path in paths if len(path.parts) > part]
        if len(set(names)) == len(paths):
            return names
    return [f"{path.name}_{k}" for k, path in enumerate(paths, 1)]


def _read(
    file: Path, asked: HandEyeOptions, known: dict[str, Picture] | None
) -> tuple[PosePairs, ClockOffset | None, PictureSet | None]:
    """Return the pairs of pictures, streams or a file of pairs or motions."""
    mounting, unit, stated = asked.mounting, asked.unit, asked.stated
    if asked.board is not None:
        board = parse_board(asked.board)
        shots = read_pictures(
            file, board, mounting=mounting, unit=unit, stated=stated, camera=asked.intrinsics, known=known
        )
        return shots.pairs, None, shots
    plain = asked.motions or asked.refine is not None or asked.equation == "axb-ycz"
    given = read_corners(file, mounting=mounting, unit=unit, stated=stated, camera=asked.intrinsics)
    if given is not None and not plain:
        return given.pairs, None, given
    if asked.intrinsics is not None:
        raise InputError("A camera file (--as intrinsics) goes with pictures: name the board in them with --board.")
    if asked.motions:
        return read_pairs(file, mounting=mounting, length=unit, stated=replace(stated, decide=False)), None, None
    return *pairs_or_streams(file, mounting=mounting, unit=unit, stated=stated, usual="eye_in_hand"), None


def pairs_or_streams(
    file: Path, *, mounting: str | None, unit: str | None, stated: StatedForms, usual: str = ""
) -> tuple[PosePairs, ClockOffset | None]:
    """Read pairs as read_pairs does, or pair two recordings in motion, with the offset of their clocks.

    Args:
        usual: the mounting of recordings in motion where none is given; empty: it must be given.

    Raises:
        InputError: as read_pairs.
    """
    lists = None
    if pose_streams.is_stream_file(file):
        if unit not in (None, "m"):
            raise InputError("Two streams of poses are in metres; omit --unit.")
    elif (lists := _trajectories(file, stated)) is None:
        return read_pairs(file, mounting=mounting, length=unit, stated=stated), None
    mode = mounting_name(mounting or usual)
    if not mode:
        raise DatasetError(NO_MOUNTING.format(file.name))
    streams = (
        pose_streams.synchronise(pose_streams.read_streams(file), mounting=mode, source=file.name)
        if lists is None
        else pose_streams.synchronise_lists(*lists, mounting=mode, source=file.name)
    )
    return streams.pairs, streams


def _solve_motions(pairs: PosePairs, equation: str, config: HandEyeConfig) -> _Solution:
    """Solve AX = XB with the motions A and B of a file."""
    if equation != "ax-xb":
        raise InputError("Motions (--as motions) belong to ax-xb.")
    result = solve_ax_xb(pairs.robot, pairs.camera, config)
    problem = full_problem(pairs.robot, inverse(pairs.camera), free=(True, False, False), tied=True)
    return _Solution(pairs, problem, with_scale(problem, result, config))


def _solve_poses(pairs: PosePairs, shots: PictureSet | None, config: HandEyeConfig, say: Say) -> _Solution:
    """Solve with the poses of a file, or with the corners of its pictures."""
    problem = problem_of_pairs(pairs)
    say(check_poses(problem).sentence())
    if shots is not None:
        return _solve_pictures(shots, config)
    return _Solution(pairs, problem, solve_pairs(pairs, config))


def _solve_pictures(shots: PictureSet, config: HandEyeConfig) -> _Solution:
    """Solve with the corners of pictures, and name those that are not used."""
    result, pairs, pictures = solve_pictures(shots, lambda pairs: solve_pairs(pairs, config))
    left = [f"{p.name} ({p.why[0].lower()}{p.why[1:].rstrip('.')})" for p in pictures.pictures if p.why]
    warnings = [w for w in result.warnings if "were excluded:" not in w]
    if left:
        warnings.insert(0, f"{len(left)} of {len(pictures.pictures)} pictures are not used: {'; '.join(left)}.")
    return _Solution(pairs, problem_of_pairs(pairs), replace(result, warnings=tuple(warnings)), pictures)


def _apply_corners(
    found: _Solution, asked: HandEyeOptions, mounting: Mounting, config: HandEyeConfig, said: list[str]
) -> None:
    """Refine by the corners that the file holds, with a sentence added to ``said``."""
    pairs, corners, optional = found.pairs, asked.corners, asked.corners is None
    if optional:
        corners = pairs.has_corners and not asked.motions and mounting.name in ("eye_in_hand", "eye_on_base")
    if not corners:
        return
    if asked.motions or mounting.name == "co_manipulation":
        raise InputError("Corners (--corners) go with the poses of one robot.")
    try:
        refined = refine_with_corners(pairs, config)
    except WeldcalError as problem:
        if not optional:
            raise
        said.append(f"Corners: not used. {problem}")
        return
    said.append(refined.sentence)
    if refined.accepted:
        found.adopted = True
        result = replace(refined.result, labels=mounting.labels, equation=mounting.equation)
        found.result = replace(result, warnings=found.result.warnings, scale=found.result.scale)
        found.pairs = replace(pairs, camera=poses_from_corners(pairs, refined.shift_px))
        found.problem = problem_of_pairs(found.pairs)


def _trajectories(path: Path, stated: StatedForms) -> tuple[Listing, Listing] | None:
    """Return the robot's and the camera's recording in motion of a path; None where it holds none."""
    lists = recorded = recorded_lists(path, stated)
    if lists is None and (not path.is_dir() or (path / "pairs.npz").exists()):
        return None
    try:
        lists = lists or two_lists(folder_lists(path), path.name, stated.robot_poses, stated.camera_poses)
    except InputError:
        return None  # the reader of pairs says what is wrong
    if (recorded is not None and at_rest(*recorded) is not None) or not pose_streams.are_trajectories(*lists):
        return None
    robot, camera = lists
    return robot.of_arm(stated.arm).stated(stated.robot, "--as robot-form"), camera.stated(
        stated.camera, "--as camera-form"
    )


def _no_advice(view: VisibleVolume, arm: Chain | None) -> str:
    reach = "" if arm is None else f" and within reach of {arm.name}"
    return (
        f"No further pose near those so far is visible{reach} (view: {view.source}). Move to a region with a better"
        " view."
    )


def understood(pairs: PosePairs) -> list[str]:
    """How a file was understood, a line for each list, and the notes."""
    lines = []
    for who, found in pairs.reading.items():
        out = len(found["left_out"])  # type: ignore[arg-type]
        left = f", {out} left out" if out else ""
        lines.append(
            f"{who:<7}{found['file']}: {found['rows']} poses{left}, {found['form']}, read as {found['reading']} in"
            f" {found['unit']}"
        )
    return [*lines, *pairs.notes]


def _only_camera(result: HandEyeResult) -> HandEyeResult:
    poses, of_X = {"X": result.poses["X"]}, result.covariance["X"]
    return replace(result, poses=poses, covariance={"X": of_X}, joint_covariance=of_X)


def problem_of_pairs(pairs: PosePairs) -> Problem:
    """Return the equation of a file's mounting."""
    return full_problem(pairs.F, pairs.G, pairs.H, free=(True, True, pairs.mode == "co_manipulation"))


def solve_pairs(pairs: PosePairs, config: HandEyeConfig | None = None) -> HandEyeResult:
    """Return the poses of a file's mounting, with a test for the usual mistakes in files.

    Raises:
        InconsistentPoses: the correction of one mistake makes the poses agree far better; others as solve_problem.
    """
    config, mounting = config or HandEyeConfig(), get_mounting(pairs.mode)
    problem = problem_of_pairs(pairs)
    try:
        result = solve_problem(problem, config=config, equation=mounting.equation, labels=mounting.labels)
    except (InconsistentPoses, UndeterminedPoses) as e:
        if (mistake := likely_mistake(pairs)) is None:
            raise
        raise InconsistentPoses(mistake) from e
    if (mistake := likely_mistake(pairs)) is not None:
        raise InconsistentPoses(mistake)
    explained = replace(result, warnings=(*result.warnings, *explain_outliers(pairs, result)))
    return with_scale(problem, explained, config)


def solve_arrays(
    robot: Array, camera: Array, mounting: str, robot_form: str | None = None, camera_form: str | None = None
) -> HandEyeResult:
    """Solve pairs of poses (n, 4, 4) in metres; the data choose how the matrices are read, as for a file.

    Raises:
        InputError: as read_pairs and solve_pairs.
    """
    far = float(np.median(np.linalg.norm(robot[:, :3, 3], axis=1)))
    if far > FARTHEST_M:
        raise InputError(
            f"The robot's positions have a median of {far:.4g} from the base: they must be metres. Divide millimetres"
            " by 1000."
        )
    stated = replace(stated_forms(None, None, robot_form, camera_form), unit="m")
    lists = [listing_of_array(name, X) for name, X in (("robot", robot), ("camera", camera))]
    found = import_pairs(lists, "the poses", mounting, stated)
    usual = len(found.robot) == len(robot) and all(one["reading"] == "matrix" for one in found.reading.values())
    if not usual:
        robot, camera = found.robot, found.camera
    result = solve_pairs(PosePairs(source="the poses", robot=robot, camera=camera, mode=mounting))
    return replace(result, warnings=(*found.notes, *result.warnings))


def stated_forms(
    robot_poses: str | None, camera_poses: str | None, robot_form: str | None, camera_form: str | None
) -> StatedForms:
    """What the options state of the two lists of poses."""
    forms = [PoseForm() if form is None else PoseForm(rotation=form) for form in (robot_form, camera_form)]
    return StatedForms(robot=forms[0], camera=forms[1], robot_poses=robot_poses, camera_poses=camera_poses)


def _compare(problem: Problem, ours: HandEyeResult) -> tuple[MethodRow, ...]:
    rows = [MethodRow("weldcal", ours.held_out.rms_deg, 1e3 * ours.held_out.rms_translation)]
    if problem.free == (True, True, False):
        most = most_compared(len(problem.F))
        for m in METHODS:
            held = opencv_held_out(m, problem.F, problem.G, most=most, observation=ours.observation)
            whole = bool(np.isfinite(held.translation).all())
            errors = (held.rms_deg, 1e3 * held.rms_translation) if whole else (float("nan"), float("nan"))
            rows.append(MethodRow(m, *errors))
    return tuple(rows)
