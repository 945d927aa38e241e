"""Judge any file with a camera's pose on pairs of robot and camera poses, or on pictures of a board."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from weldcal.calibration.data.clouds import NO_NOTES
from weldcal.calibration.data.poses.bag import has_clouds
from weldcal.calibration.data.poses.source import FOLDERS
from weldcal.calibration.data.stated_pose import StatedPose, read_stated_pose
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.hand_eye.exports import digest
from weldcal.calibration.hand_eye.mountings import Mounting, get_mounting
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.hand_eye.pairs.judging import Judgement, judge_pose
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.sets import read_pictures
from weldcal.calibration.hand_eye.pictures.solution import solve_pictures
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.calibration.recorded_hand_eye import pairs_or_streams, problem_of_pairs

_MOUNTINGS = ("eye_in_hand", "eye_on_base")


def holds_scans(path: Path) -> bool:
    """Find whether a path holds scans of a flange, not pairs of poses: clouds, pairs.csv of centres, a recording."""
    if path.is_file():
        return has_clouds(path)
    if not path.is_dir():
        return True  # its reader says that it does not exist
    if (path / "pairs.csv").is_file() or has_clouds(path):
        return True
    if (path / "pairs.npz").is_file():
        return False
    places = [path, *(path / name for name in FOLDERS if name != "images" and (path / name).is_dir())]
    return any(
        one.suffix.lower() in NO_NOTES and one.suffix.lower() not in (".npz", ".npy")
        for p in places
        for one in p.iterdir()
    ) or any(
        p != path and any(one.suffix.lower() in (".npz", ".npy", ".xyz", ".txt", ".csv") for one in p.iterdir())
        for p in places
    )


@dataclass(frozen=True, kw_only=True)
class PairsOptions:
    """How a stated pose and the pairs are to be read.

    Attributes:
        mounting: eye_in_hand or eye_on_base; else as the pairs or the result state it, or as the result fits.
        unit, stated: how the pairs are written, as with `hand-eye`.
        pose: key of the pose, where the result's file holds several.
        board, intrinsics: the board in the pictures of the folder of pairs, and the file of their camera.
    """

    mounting: str | None = None
    unit: str | None = None
    stated: StatedForms = field(default_factory=StatedForms)
    pose: str | None = None
    board: str | None = None
    intrinsics: Path | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class VerifiedPairs:
    """A stated pose judged on pairs.

    Attributes:
        judgement: the figures.
        mounting: that of the pairs.
        result: name of the file with the pose.
        read_as: how the pose was read, a phrase.
        ids: names of the pairs (n).
        same_data: whether the result was computed from these pairs.
        reading, notes: how the pairs were understood.
        mounting_stated: the mounting that the result names, or None.
    """

    judgement: Judgement
    mounting: Mounting
    result: str
    read_as: str
    ids: tuple[str, ...]
    same_data: bool = False
    reading: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    mounting_stated: str | None = None


def verify_pairs(result: Path, pairs: Path, asked: PairsOptions | None = None) -> VerifiedPairs:
    """Judge the pose in a file on pairs.

    Args:
        result: any file with a pose: docs/hand_eye.md lists the forms.
        pairs: a file or folder that `weldcal hand-eye` reads.

    Raises:
        InputError: a file cannot be read; InconsistentPoses: the pairs contradict each other.
    """
    asked = asked or PairsOptions()
    given = read_stated_pose(result, asked.pose)
    read, reading, found = _judged(given, pairs, asked)
    one = given.readings[reading]
    words = f"{given.form}, {one.words}" if len(given.readings) > 1 else given.form
    words += f" in {given.unit}"
    if reading:
        words += " (of all readings the one that fits best)"
    return VerifiedPairs(
        judgement=found,
        mounting=get_mounting(read.mode),
        result=given.name,
        read_as=words,
        ids=read.ids or tuple(str(k + 1) for k in range(len(read.robot))),
        same_data=digest(pairs) in given.data,
        reading=read.reading,
        notes=read.notes,
        mounting_stated=given.mounting,
    )


def _read(path: Path, mode: str | None, asked: PairsOptions) -> tuple[PosePairs, HandEyeResult | None]:
    """Return the pairs in a mounting; of pictures with their own solution."""
    if asked.board is None:
        return pairs_or_streams(path, mounting=mode, unit=asked.unit, stated=asked.stated)[0], None
    what, config = parse_board(asked.board), HandEyeConfig(seed=asked.seed)
    shots = read_pictures(path, what, mounting=mode, unit=asked.unit, stated=asked.stated, camera=asked.intrinsics)
    # an estimated camera moves all pictures alike: only the adjustment of the corners knows by how much
    new, found, _ = solve_pictures(shots, lambda found: solve_problem(problem_of_pairs(found), config=config))
    return found, new


def _judged(given: StatedPose, path: Path, asked: PairsOptions) -> tuple[PosePairs, int, Judgement]:
    """Judge the pose on the pairs, in the stated mounting or else in the one in which it fits."""

    mounting = asked.mounting

    def judged(mode: str | None) -> tuple[PosePairs, int, Judgement]:
        pairs, new = _read(path, mode, asked)
        if pairs.mode not in _MOUNTINGS:
            raise DatasetError(
                f"'{path.name}' is {pairs.mode}; verify judges the mountings {' and '.join(_MOUNTINGS)}."
            )
        reading, found = judge_pose(
            problem_of_pairs(pairs),
            [one.X for one in given.readings],
            given.covariance,
            HandEyeConfig(seed=asked.seed),
            new,
        )
        return pairs, reading, found

    try:
        return judged(mounting)
    except (DatasetError, InconsistentPoses) as problem:
        unnamed = mounting is None and "--mounting" in str(problem)
        if unnamed and given.mounting is not None:
            return judged(given.mounting)
        if not unnamed and not isinstance(problem, InconsistentPoses):
            raise
        fits = {}
        for mode in _MOUNTINGS:
            if mode == mounting:
                continue
            try:
                answer = judged(mode)
            except (DatasetError, InconsistentPoses):
                continue
            if answer[2].near:
                fits[mode] = answer
        if len(fits) != 1:
            raise
        mode, answer = fits.popitem()
        if unnamed:
            return answer
        off = answer[2].off_mm if answer[2].other is None else answer[2].other[1]
        raise InconsistentPoses(
            f"The pairs contradict each other as given. RESULT fits them as {mode}, within {off:.3g} mm: give"
            f" --mounting {mode}."
        ) from problem
