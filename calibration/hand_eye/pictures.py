"""Read pictures of a board with the robot's poses, and calibrate camera, hand-eye pose and target from them."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.camera_file import CameraFile, read_camera
from weldcal.calibration.data.poses.listing import Listing, listing_of
from weldcal.calibration.data.poses.lists import folder_lists, together, whose
from weldcal.calibration.data.poses.names import mounting_name, number_of
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.quantiles import chi2_quantile
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, nearest_rotation, pose
from weldcal.calibration.hand_eye.boards import EXAMPLES, Board, find_board, what_is_there, with_layout
from weldcal.calibration.hand_eye.bundle import Bundle, Corners, adjust
from weldcal.calibration.hand_eye.conventions import UNITS
from weldcal.calibration.hand_eye.files import PosePairs
from weldcal.calibration.hand_eye.importing import ImportedPairs, StatedForms, WrongScale, import_pairs
from weldcal.calibration.hand_eye.picture_files import camera_in, load_grey, picture_files
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.models.arrays import Array

_FEWEST = 4  # pictures with the board
_K3_LEVEL = 0.999  # at which a third radial coefficient is no chance
_GROSS = 4.0  # times the median error of a picture, beyond which it does not fit the camera
_THUMBNAIL_PX = 240
_CHANGED_PX = 1.3  # a second solution may have at most so many times the reprojection error of the first
_TRIED_SHIFTS = (0, 1, -1, 2, -2, 3, -3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """One picture.

    Attributes:
        name: of its file.
        points: of the board (m, 2) px; NaN where one was not found.
        size: width and height, px; zeros where it cannot be read.
        thumbnail: a small JPEG with the points drawn.
        why: why it is not used, one sentence; empty where it is.
        rms_px: rms reprojection error; NaN where it is not used.
    """

    name: str
    points: Array
    size: tuple[int, int]
    thumbnail: bytes
    why: str = ""
    rms_px: float = float("nan")

    @property
    def found(self) -> int:
        """Number of points that were found."""
        return int(np.isfinite(self.points[:, 0]).sum())


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureSet:
    """Pictures with the robot's poses, ready to solve.

    Attributes:
        pairs: robot and camera poses of the n usable pictures, with points and camera.
        pictures: all pictures.
        rows: the picture of each pair (n,).
        board: the board.
        camera: the file that states the camera, or empty where it is estimated.
        free: the camera's numbers that are estimated, see ``adjust``.
    """

    pairs: PosePairs
    pictures: tuple[Picture, ...]
    rows: NDArray[np.int64]
    board: Board
    camera: str
    free: NDArray[np.int64]


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureResult:
    """What the pictures add to a hand-eye result.

    Attributes:
        board: the board.
        pictures: all pictures, with their errors and why some are not used.
        bundle: the adjustment.
        camera: the file that states the camera, or empty where it was estimated.
        free: the numbers of the camera that were estimated.
        reprojection_px: rms over all points of the pictures used.
    """

    board: Board
    pictures: tuple[Picture, ...]
    bundle: Bundle
    camera: str
    free: NDArray[np.int64]
    reprojection_px: float

    @property
    def sentences(self) -> list[str]:
        """What was found, for the reader."""
        used = [p for p in self.pictures if not p.why]
        b = self.bundle
        lines = [
            f"{len(used)} of {len(self.pictures)} pictures used, {self.board}, reprojection {self.reprojection_px:.3f} px rms.",
            f"Robot poses as found: {np.degrees(b.sigma_rad):.4f} degrees and {1e3 * b.sigma_m:.3f} mm per axis (1 sigma, at the flange).",
        ]
        lines += [f"{p.name} is not used. {p.why}" for p in self.pictures if p.why]
        K, s = b.K, b.camera_sigma
        if len(s) >= 4:
            words = ("fx", "fy", "cx", "cy")
            values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            lines.append(
                "Camera estimated: "
                + ", ".join(f"{w} {v:.2f} +- {e:.2f}" for w, v, e in zip(words, values, s, strict=False))
                + " px."
            )
        elif self.camera:
            lines.append(f"Camera from {self.camera}.")
        return lines


def read_pictures(
    folder: Path,
    board: Board,
    *,
    mounting: str | None,
    unit: str | None = None,
    stated: StatedForms | None = None,
    camera: Path | None = None,
) -> PictureSet:
    """The pictures of a folder with the robot's poses.

    Args:
        folder: it holds the pictures and the robot's poses in any form of docs/datasets.md; ``--camera-poses`` of ``stated`` names the
            pictures, where there are several kinds.
        board: the board in them.
        mounting: eye_in_hand or eye_on_base.
        unit: of the robot's positions.
        stated: what the user states of the robot's poses.
        camera: a file that states the camera; without it one of the folder is taken, or the camera is estimated.

    Raises:
        DatasetError: pictures, poses or camera cannot be used; InconsistentPoses: they contradict each other.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"'{folder.name}' is no folder: --board needs the folder of the pictures and of the robot's poses."
        )
    stated = stated or StatedForms()
    mode = "" if mounting is None else mounting_name(mounting)
    if mode not in ("eye_in_hand", "eye_on_base"):
        raise DatasetError(
            f"'{folder.name}' does not say where the camera is; add --mounting eye_in_hand (on the flange) or eye_on_base (fixed)."
        )
    if unit is not None and unit not in UNITS:
        raise DatasetError(f"There is no unit '{unit}'; use {', '.join(UNITS)}.")
    files = picture_files(folder, stated.camera_poses)
    stated_camera = (camera, read_camera(camera)) if camera is not None else camera_in(folder)
    skip = frozenset() if stated_camera is None else frozenset({stated_camera[0]})
    robot = _robot(folder, stated, skip, unit)
    board, pictures = find_in(files, board, folder.name)
    size = _common_size(pictures)
    pictures = [_sized(p, size) for p in pictures]
    file = None if stated_camera is None else stated_camera[1]
    K, dist, free, pictures = _camera(pictures, board, size, file, camera is not None and camera.name)
    return _paired(
        files=files, pictures=pictures, board=board, robot=robot, mode=mode, stated=stated, source=folder.name, K=K, dist=dist, free=free,
        camera="" if stated_camera is None or len(free) else stated_camera[0].name,
    )  # fmt: skip


def find_in(files: Sequence[Path], board: Board, source: str) -> tuple[Board, list[Picture]]:
    """The board in every picture, on two threads.

    Raises:
        DatasetError: it is in fewer than four; the sentence says what was found in its place.
    """
    some = (
        [g for g in (load_grey(files[k]) for k in _spread(len(files), 6)) if g is not None] if board.layouts > 1 else []
    )
    board = with_layout(some, board)

    def one(path: Path) -> Picture:
        grey = load_grey(path)
        none = np.full((len(board.points), 2), np.nan)
        if grey is None:
            return Picture(
                name=path.name, points=none, size=(0, 0), thumbnail=b"", why="It cannot be read as a picture."
            )
        points = find_board(grey, board)
        least = 4 if board.kind == "tag" else min(8, len(board.points))
        why = ""
        if int(np.isfinite(points[:, 0]).sum()) < least:
            points, why = none, "The board was not found: show it whole, sharp, evenly lit, with a white margin."
        return Picture(
            name=path.name, points=points, size=grey.shape[::-1], thumbnail=_thumbnail(grey, points), why=why
        )

    before = cv2.getNumThreads()
    with ThreadPoolExecutor(max_workers=2) as pool:
        pictures = list(pool.map(one, files))
    cv2.setNumThreads(before)
    n = sum(not p.why for p in pictures)
    if n < _FEWEST:
        some = [g for g in (load_grey(files[k]) for k in _spread(len(files), 6)) if g is not None]
        there = what_is_there(some, board)
        raise DatasetError(
            f"The board {board} was found in {n} of {len(files)} pictures of '{source}', and {_FEWEST} are needed"
            + (
                f": {there}. Correct --board."
                if there
                else f". Check --board, such as {EXAMPLES[board.kind]}, and the pictures."
            )
        )
    return board, pictures


def _spread(n: int, most: int) -> list[int]:
    return sorted({int(k) for k in np.linspace(0, n - 1, min(n, most)).round()})


def _thumbnail(grey: NDArray[np.uint8], points: Array) -> bytes:
    scale = min(1.0, _THUMBNAIL_PX / max(grey.shape))
    small = cv2.cvtColor(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for u, v in points[np.isfinite(points[:, 0])]:
        cv2.circle(small, (round(scale * u), round(scale * v)), 2, (0, 120, 255), -1, cv2.LINE_AA)
    ok, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return data.tobytes() if ok else b""


def _common_size(pictures: Sequence[Picture]) -> tuple[int, int]:
    sizes = [p.size for p in pictures if not p.why]
    return max(set(sizes), key=sizes.count)


def _sized(picture: Picture, size: tuple[int, int]) -> Picture:
    if picture.why or picture.size == size:
        return picture
    return replace(
        picture, why=f"It has {picture.size[0]} x {picture.size[1]} pixels, and the others have {size[0]} x {size[1]}."
    )


def _camera(
    pictures: list[Picture], board: Board, size: tuple[int, int], file: CameraFile | None, named: str | bool
) -> tuple[Array, Array, NDArray[np.int64], list[Picture]]:
    """Camera matrix, distortion, which of their numbers are free, and the pictures, those that do not fit left out."""
    if file is not None:
        if file.size is not None and file.size != size:
            raise DatasetError(
                f"The camera file {named or ''} is for pictures of {file.size[0]} x {file.size[1]} pixels, and these have {size[0]} x {size[1]}: "
                "give the file of this resolution, or leave it out to estimate the camera."
            )
        return file.K, file.distortion, np.zeros(0, dtype=np.int64), pictures
    start = np.array(
        [[1.2 * max(size), 0.0, 0.5 * size[0] - 0.5], [0.0, 1.2 * max(size), 0.5 * size[1] - 0.5], [0.0, 0.0, 1.0]]
    )
    fixed = cv2.CALIB_FIX_K3
    few = board.kind == "tag"  # four corners a picture do not show the lens
    if few:
        fixed |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags = fixed | (cv2.CALIB_USE_INTRINSIC_GUESS if few else 0)
    for _ in range(4):
        kept = [k for k, p in enumerate(pictures) if not p.why]
        if len(kept) < _FEWEST:
            raise DatasetError("Fewer than four pictures fit one camera: give the camera with --intrinsics FILE.")
        obj = [board.points[np.isfinite(pictures[k].points[:, 0])].astype(np.float32) for k in kept]
        img = [pictures[k].points[np.isfinite(pictures[k].points[:, 0])].astype(np.float32) for k in kept]
        try:
            found = cv2.calibrateCameraExtended(obj, img, size, start.copy(), np.zeros(5), flags=flags)
        except cv2.error as problem:
            raise DatasetError("The pictures do not show one camera: give it with --intrinsics FILE.") from problem
        error = np.ravel(found[7])
        bad = error > _GROSS * float(np.median(error)) + 0.3
        if not bad.any():
            break
        for k, e in zip(np.array(kept)[bad], error[bad], strict=True):
            pictures[k] = replace(pictures[k], why=f"Its points do not fit the camera of the others ({e:.1f} px).")
    K, dist = np.asarray(found[1], dtype=float), np.ravel(np.asarray(found[2], dtype=float))[:5]
    free = np.array([0, 1, 2, 3, 4, 5] if few else [0, 1, 2, 3, 4, 5, 6, 7])
    if not few:
        more = cv2.calibrateCamera(obj, img, size, K.copy(), dist.copy(), flags=cv2.CALIB_USE_INTRINSIC_GUESS)
        numbers = 2.0 * sum(len(o) for o in obj)
        if numbers * 2.0 * np.log(max(found[0], 1e-9) / max(more[0], 1e-9)) > float(chi2_quantile(_K3_LEVEL, 1)):
            K, dist = np.asarray(more[1], dtype=float), np.ravel(np.asarray(more[2], dtype=float))[:5]
            free = np.append(free, 8)
    if not (0.2 * max(size) < K[0, 0] < 50.0 * max(size)) or not np.isfinite(dist).all():
        raise DatasetError(
            f"The pictures do not determine the camera (focal length {K[0, 0]:.0f} px of {size[0]} pixels): tilt the board by 20 to 40 degrees in "
            "some pictures, or give the camera with --intrinsics FILE."
        )
    return K, dist, free.astype(np.int64), pictures


def solutions(points: Array, board: Board, K: Array, dist: Array) -> list[tuple[float, Array]]:
    """Poses (4, 4) of the board in the camera that fit a picture, with their rms reprojection errors px, best first."""
    seen = np.isfinite(points[:, 0])
    obj, img = board.points[seen], points[seen]
    found = []
    kind = cv2.SOLVEPNP_IPPE
    count, turns, shifts, _ = cv2.solvePnPGeneric(obj, img, K, dist, flags=kind)
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        w, t = cv2.solvePnPRefineLM(obj, img, K, dist, turn.copy(), shift.copy())
        uv, _ = cv2.projectPoints(obj, w, t, K, dist)
        error = float(np.sqrt(((np.asarray(uv)[:, 0] - img) ** 2).sum(axis=1).mean()))
        found.append((error, pose(exp_rotation(np.ravel(w)), np.ravel(t))))
    return sorted(found, key=lambda one: one[0])


def _robot(folder: Path, stated: StatedForms, skip: frozenset[Path], unit: str | None) -> Listing:
    """The list of the robot's poses among those of a folder. Raises DatasetError where there is none, or several."""
    lists = folder_lists(folder, 1, skip)
    known = ", ".join(repr(one.name) for one in lists[:8])
    if stated.robot_poses is not None:
        lists = [one for one in lists if stated.robot_poses in one.name]
        if len(lists) != 1:
            raise DatasetError(
                f"--robot-poses {stated.robot_poses} names {len(lists)} of the lists of '{folder.name}': {known or 'none'}."
            )
    if not lists:
        raise DatasetError(
            f"'{folder.name}' holds pictures and no robot poses: add robot.csv with the header id,x,y,z,qx,qy,qz,qw, one row per picture, or "
            "one file per picture."
        )
    if len(lists) > 1:
        mine = [one for one in lists if whose(one.name) == "robot"]
        others = [one for one in lists if whose(one.name) != "camera"]
        lists = mine if len(mine) == 1 else others if len(others) == 1 else lists
    if len(lists) > 1:
        raise DatasetError(
            f"The names of the lists of '{folder.name}' do not tell the robot's poses: {known}. Name them with --robot-poses."
        )
    return replace(lists[0], unit=lists[0].unit or unit or "")


def _paired(
    *,
    files: list[Path],
    pictures: list[Picture],
    board: Board,
    robot: Listing,
    mode: str,
    stated: StatedForms,
    source: str,
    K: Array,
    dist: Array,
    free: NDArray[np.int64],
    camera: str,
) -> PictureSet:
    """Pairs of the robot's and the boards' poses; flips of symmetric boards follow from the robot's rotations."""
    C = np.tile(np.eye(4), (len(pictures), 1, 1))
    for k, picture in enumerate(pictures):
        if not picture.why:
            found = solutions(picture.points, board, K, dist)
            if found:
                C[k] = found[0][1]
            else:
                pictures[k] = replace(picture, why="Its points give no pose of the board.")
    name = f"{files[0].name} ... {files[-1].name}"
    labels = np.zeros(len(pictures), dtype=np.int64)
    stated = replace(stated, robot_poses=robot.name, camera_poses=name, unit=None, camera_known=True)
    problem: InconsistentPoses | DatasetError | None = None
    for numbered in _numbered(robot, pictures):
        choices: list[NDArray[np.int64]] = [labels]
        if len(board.symmetries) > 1:
            choices = _flips(numbered, _listing(name, pictures, C), pictures, board)
        for choice in choices:
            listing = _listing(name, pictures, _flipped(C, choice, board))
            try:
                found_pairs = import_pairs([numbered, listing], source, mode, stated)
            except WrongScale as why:
                size = 1e3 * board.size * why.factor
                problem = InconsistentPoses(
                    f"The board in the pictures of '{source}' fits the robot's motion with its lengths multiplied by {why.factor:.4g}: a size of "
                    f"{size:.4g} mm in place of {1e3 * board.size:g} mm. Measure the board and correct --board, or correct --unit of the robot."
                )
                break
            except (InconsistentPoses, DatasetError) as why:
                problem = problem or why
                continue
            return _set(found_pairs, pictures, choice, board, mode, source, K, dist, free, camera)
    assert problem is not None
    raise problem


def _set(
    found: ImportedPairs, pictures: list[Picture], labels: NDArray[np.int64], board: Board, mode: str, source: str, K: Array, dist: Array,
    free: NDArray[np.int64], camera: str,
) -> PictureSet:  # fmt: skip
    rows = np.asarray(found.rows[1], dtype=np.int64)
    turned = [replace(p, points=p.points[board.symmetries[int(f)]]) for p, f in zip(pictures, labels, strict=True)]
    paired = set(rows.tolist())
    turned = [
        p if p.why or k in paired else replace(p, why="No robot pose belongs to it.") for k, p in enumerate(turned)
    ]
    pairs = PosePairs(
        source=source,
        robot=found.robot,
        camera=found.camera,
        mode=mode,
        img=np.stack([turned[k].points for k in rows]),
        obj=board.points,
        K=K,
        dist=dist,
        reading=found.reading,
        notes=found.notes,
        ids=tuple(turned[k].name for k in rows),
    )
    return PictureSet(pairs=pairs, pictures=tuple(turned), rows=rows, board=board, camera=camera, free=free)


def _listing(name: str, pictures: Sequence[Picture], C: Array) -> Listing:
    out = tuple((k, p.why) for k, p in enumerate(pictures) if p.why)
    found = listing_of(
        name, C[:, :3, 3], C[:, :3, :3], rotation="matrix", ids=tuple(Path(p.name).stem for p in pictures), unit="m", form="pictures of a board"
    )  # fmt: skip
    return replace(found, left_out=out)


def _numbered(robot: Listing, pictures: Sequence[Picture]) -> list[Listing]:
    """The robot's poses with the numbers of the pictures, where rows have no names and there are more rows than pictures: counted from 0 or 1."""
    numbers = [number_of(Path(p.name).stem) for p in pictures]
    if robot.ids or len(robot) == len(pictures) or None in numbers:
        return [robot]
    found = [
        replace(robot, ids=tuple(str(first + k) for k in range(len(robot))))
        for first in (1, 0)
        if first <= min(n for n in numbers if n is not None)
        and max(n for n in numbers if n is not None) < first + len(robot)
    ]
    return found or [robot]


def _flipped(C: Array, labels: NDArray[np.int64], board: Board) -> Array:
    """The boards' poses with another order of their points."""
    turns = [_turn(board, order) for order in board.symmetries]
    return np.stack([X @ turns[int(k)] for X, k in zip(C, labels, strict=True)])


def _turn(board: Board, order: NDArray[np.int64]) -> Array:
    """S (4, 4) with S p = p[order]: a board whose points are taken in this order has the pose C S instead of C."""
    p, q = board.points, board.points[order]
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    # in-plane points: add the normal, so that the rotation is the proper one
    R = nearest_rotation(b.T @ a + np.linalg.norm(a) ** 2 * np.outer([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]))
    return pose(R, q.mean(axis=0) - R @ p.mean(axis=0))


def _flips(robot: Listing, camera: Listing, pictures: Sequence[Picture], board: Board) -> list[NDArray[np.int64]]:
    """Orders of the points of each picture that agree best with the angles of the robot's relative rotations, most likely first."""
    rows_r, rows_c, _ = together(robot, camera)
    good = robot.good[rows_r] & camera.good[rows_c]
    rows_r, rows_c = rows_r[good], rows_c[good]
    turns = np.stack([_turn(board, order)[:3, :3] for order in board.symmetries])
    C = camera.readings[0].X[rows_c, :3, :3]
    n = len(C)
    tried: dict[bytes, tuple[float, NDArray[np.int64]]] = {}
    for shift in _TRIED_SHIFTS:
        m = n - abs(shift)
        if m < _FEWEST:
            continue
        a, b = slice(max(shift, 0), max(shift, 0) + m), slice(max(-shift, 0), max(-shift, 0) + m)
        turned = np.einsum("nij,sjk->nsik", C[b], turns)
        theirs = _angles(np.einsum("asji,btjk->abstik", turned, turned, optimize=True))
        for reading in robot.readings:
            R = reading.X[rows_r[a], :3, :3]
            ours = _angles(np.einsum("aji,bjk->abik", R, R, optimize=True))
            cost = np.minimum(np.abs(theirs - ours[:, :, None, None]), 0.5)
            labels, value = _least(cost)
            whole = np.zeros(len(pictures), dtype=np.int64)
            whole[rows_c[b]] = labels
            value /= m * (m - 1)
            value += 1e-6 * abs(shift)
            key = whole.tobytes()
            if key not in tried or value < tried[key][0]:
                tried[key] = value, whole
    best = sorted(tried.values(), key=lambda one: one[0])
    return [labels for _, labels in best[:8]] or [np.zeros(len(pictures), dtype=np.int64)]


def _angles(R: Array) -> Array:
    trace = np.einsum("...ii->...", R)
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def _least(cost: Array) -> tuple[NDArray[np.int64], float]:
    """Labels (n,) of least total cost[a, b, label a, label b]: coordinate descent from the labels that each picture alone suggests."""
    n = len(cost)
    best: tuple[NDArray[np.int64], float] | None = None
    each = np.arange(n)
    for anchor in _spread(n, 8):
        labels = cost[anchor, :, 0, :].argmin(axis=1)
        labels[anchor] = 0
        for _ in range(10):
            before = labels.copy()
            for k in range(n):
                total = cost[k, each, :, labels]
                total[k] = 0.0
                labels[k] = int(total.sum(axis=0).argmin())
            if (labels == before).all():
                break
        value = float(cost[each[:, None], each[None], labels[:, None], labels[None]].sum())
        if best is None or value < best[1] - 1e-9:
            first = labels.copy()
            best = first, value
    assert best is not None
    return best


def solve_pictures(
    data: PictureSet, solve: Callable[[PosePairs], HandEyeResult]
) -> tuple[HandEyeResult, PosePairs, PictureResult]:
    """Hand-eye pose, target and camera from pictures: the poses' solution as the start, then the adjustment of the corners.

    Returns:
        The result, with X, Y and covariance of the adjustment; the pairs under the camera that was found; what the pictures add.

    Raises:
        as ``solve``; DatasetError: too few pictures agree.
    """
    pairs = data.pairs
    result = solve(pairs)
    pairs, changed = _nearest(pairs, result, data.board)
    if changed:
        result = solve(pairs)
    keep = result.inliers.copy()
    for _ in range(3):
        bundle = _adjusted(pairs, result, keep, data)
        bad = bundle.rms_px > _GROSS * float(np.median(bundle.rms_px)) + 0.3
        if not bad.any() or int((~bad).sum()) < _FEWEST:
            break
        keep[np.flatnonzero(keep)[bad]] = False
    if len(data.free):
        pairs = _reprojected(replace(pairs, K=bundle.K, dist=bundle.distortion), data.board)
        result = solve(pairs)
    pictures = list(data.pictures)
    errors = np.full(len(keep), np.nan)
    errors[keep] = bundle.rms_px
    for k, row in enumerate(data.rows):
        if keep[k]:
            pictures[row] = replace(pictures[row], rms_px=float(errors[k]))
        else:
            deg, mm = np.degrees(result.rotation_rad[k]), 1e3 * result.translation[k]
            why = f"Board and robot pose disagree with the other pictures by {deg:.2f} degrees and {mm:.1f} mm."
            pictures[row] = replace(pictures[row], why=why)
    weight = np.isfinite(pairs.img[keep][..., 0]).sum(axis=1) if pairs.img is not None else np.ones(int(keep.sum()))
    total = float(np.sqrt((weight * bundle.rms_px**2).sum() / weight.sum()))
    found = PictureResult(
        board=data.board,
        pictures=tuple(pictures),
        bundle=bundle,
        camera=data.camera,
        free=data.free,
        reprojection_px=total,
    )
    if not result.unobservable:
        result = replace(
            result,
            poses={"X": _transform(bundle.X), "Y": _transform(bundle.Y)},
            covariance={"X": bundle.covariance[:6, :6], "Y": bundle.covariance[6:, 6:]},
            joint_covariance=bundle.covariance,
            degrees_of_freedom=bundle.degrees_of_freedom,
        )
    return replace(result, inliers=keep), pairs, found


def _transform(X: Array) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), X[:3, 3])


def _adjusted(pairs: PosePairs, result: HandEyeResult, keep: NDArray[np.bool_], data: PictureSet) -> Bundle:
    assert pairs.img is not None
    assert pairs.K is not None
    assert pairs.dist is not None
    return adjust(
        Corners(
            robot=pairs.robot[keep], img=pairs.img[keep], obj=data.board.points, eye_in_hand=pairs.mode == "eye_in_hand"
        ),
        np.asarray(result.X.GetAsMatrix4()),
        np.asarray(result.Y.GetAsMatrix4()),
        pairs.K,
        pairs.dist,
        free=data.free,
        sigma_px=0.3,
        sigma_rad=result.sigma_rotation_rad,
        sigma_m=result.sigma_translation,
    )


def _nearest(pairs: PosePairs, result: HandEyeResult, board: Board) -> tuple[PosePairs, bool]:
    """The pairs with, for each picture, the solution that lies nearest to what the result predicts: a plane and a symmetric board have several."""
    assert pairs.img is not None
    assert pairs.K is not None
    assert pairs.dist is not None
    X, Y = np.asarray(result.X.GetAsMatrix4()), np.asarray(result.Y.GetAsMatrix4())
    predicted = inverse(pairs.F @ X) @ Y
    camera, img, changed = pairs.camera.copy(), pairs.img.copy(), False
    for i, picture in enumerate(pairs.img):
        tried = []
        for order in board.symmetries:
            found = solutions(picture[order], board, pairs.K, pairs.dist)
            tried += [(e, C, order) for e, C in found]
        least = min(e for e, _, _ in tried)
        close = [one for one in tried if one[0] <= _CHANGED_PX * least + 0.05]
        off = [float(_angles(one[1][:3, :3].T @ predicted[i, :3, :3])) for one in close]
        best = close[int(np.argmin(off))]
        now = float(_angles(camera[i, :3, :3].T @ predicted[i, :3, :3]))
        if min(off) < 0.5 * now and now > 0.05:
            camera[i], img[i], changed = best[1], picture[best[2]], True
    return replace(pairs, camera=camera, img=img), changed


def _reprojected(pairs: PosePairs, board: Board) -> PosePairs:
    """The pairs with the boards' poses under their camera, each the solution nearest to the present one."""
    assert pairs.img is not None
    assert pairs.K is not None
    assert pairs.dist is not None
    camera = pairs.camera.copy()
    for i, picture in enumerate(pairs.img):
        seen = np.isfinite(picture[:, 0])
        w, t = cv2.solvePnPRefineLM(
            board.points[seen],
            picture[seen],
            pairs.K,
            pairs.dist,
            cv2.Rodrigues(camera[i, :3, :3])[0],
            camera[i, :3, 3:].copy(),
        )
        camera[i] = pose(exp_rotation(np.ravel(w)), np.ravel(t))
    return replace(pairs, camera=camera)
