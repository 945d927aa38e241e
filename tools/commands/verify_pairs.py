"""Judge any file with a camera's pose on pairs of robot and camera poses, or on pictures of a board."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from weldcal.calibration.data.clouds import NO_NOTES
from weldcal.calibration.data.poses.bag import find_bag
from weldcal.calibration.data.poses.source import FOLDERS
from weldcal.calibration.data.stated_pose import StatedPose, read_stated_pose
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.pairs.files import PosePairs, read_pairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms
from weldcal.calibration.hand_eye.pairs.judging import Judgement, judge_pose
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.sets import read_pictures
from weldcal.calibration.hand_eye.pictures.solution import solve_pictures
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.calibration.recorded_hand_eye import problem_of_pairs
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic
from weldcal.tools.commands.hand_eye import digest
from weldcal.tools.console import plain
from weldcal.tools.report.verify_pairs import PairsReport, verify_pairs_report

_MOUNTINGS = ("eye_in_hand", "eye_on_base")


def holds_scans(path: Path) -> bool:
    """Find whether a path holds scans of a flange, not pairs of poses: clouds, pairs.csv of centres, a recording."""
    if path.is_file():
        return find_bag(path) is not None
    if not path.is_dir():
        return True  # its reader says that it does not exist
    if (path / "pairs.csv").is_file() or find_bag(path) is not None:
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


def verify_on_pairs(
    result: Path,
    pairs: Path,
    out: Path | None,
    *,
    mounting: str | None = None,
    unit: str | None = None,
    stated: StatedForms | None = None,
    pose: str | None = None,
    limit_mm: float | None = None,
    board: str | None = None,
    intrinsics: Path | None = None,
    seed: int = 0,
    options: tuple[str, ...] = (),
) -> PairsReport:
    """Judge the pose in a file on pairs; write verification.json and report.html to ``out`` (None: nothing is written).

    Args:
        result: any file with a pose: docs/hand_eye.md lists the forms.
        pairs: a file or folder that `weldcal hand-eye` reads.
        mounting: eye_in_hand or eye_on_base; else as the pairs or the result state it, or as the result fits.
        unit, stated: how the pairs are written, as with `hand-eye`.
        pose: key of the pose, where the result's file holds several.
        limit_mm: error at the target that the job allows.
        options: further words with which a command reads the pairs, for the next step.
        board, intrinsics: the board in the pictures of the folder ``pairs``, and the file of their camera.

    Raises:
        InputError: a file cannot be read; InconsistentPoses: the pairs contradict each other.
    """
    if limit_mm is not None and not (np.isfinite(limit_mm) and limit_mm > 0.0):
        raise InputError(f"The limit must be a positive number of millimetres, not {limit_mm:g}.")
    given = read_stated_pose(Path(result), pose)
    config = HandEyeConfig(seed=seed)
    forms = stated or StatedForms()

    def read_in(mode: str | None) -> tuple[PosePairs, HandEyeResult | None]:
        if board is None:
            return read_pairs(Path(pairs), mounting=mode, length=unit, stated=forms), None
        what = parse_board(board)
        shots = read_pictures(Path(pairs), what, mounting=mode, unit=unit, stated=forms, camera=intrinsics)
        # an estimated camera moves all pictures alike: only the adjustment of the corners knows by how much
        new, found, _ = solve_pictures(shots, lambda found: solve_problem(problem_of_pairs(found), config=config))
        return found, new

    read, reading, found = _judged(given, Path(pairs), mounting, read_in, config)
    one = given.readings[reading]
    words = f"{given.form}, {one.words}" if len(given.readings) > 1 else given.form
    words += f" in {given.unit}"
    if reading:
        words += " (of all readings the one that fits best)"
    n = len(read.robot)
    report = PairsReport(
        judgement=found,
        mounting=get_mounting(read.mode),
        result=given.name,
        pairs=str(pairs),
        read_as=words,
        ids=read.ids or tuple(str(k + 1) for k in range(n)),
        same_data=digest(Path(pairs)) in given.data,
        limit_mm=limit_mm,
        reading=read.reading,
        notes=read.notes,
        mounting_stated=given.mounting,
        board=board or "",
        options=options,
    )
    if out is not None:
        write_atomic(out / "report.html", verify_pairs_report(report))
        # last, so that its presence means that everything else is there
        write_atomic(out / "verification.json", json.dumps(plain(report.summary()), indent=2, allow_nan=False) + "\n")
    return report


def _judged(
    given: StatedPose,
    path: Path,
    mounting: str | None,
    read_in: Callable[[str | None], tuple[PosePairs, HandEyeResult | None]],
    config: HandEyeConfig,
) -> tuple[PosePairs, int, Judgement]:
    """Judge the pose on the pairs, in the stated mounting or else in the one in which it fits."""

    def judged(mode: str | None) -> tuple[PosePairs, int, Judgement]:
        pairs, new = read_in(mode)
        if pairs.mode not in _MOUNTINGS:
            raise DatasetError(
                f"'{path.name}' is {pairs.mode}; verify judges the mountings {' and '.join(_MOUNTINGS)}."
            )
        reading, found = judge_pose(
            problem_of_pairs(pairs), [one.X for one in given.readings], given.covariance, config, new
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
