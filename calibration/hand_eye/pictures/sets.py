"""Read pictures of a board with the robot's poses.

Pair them, and turn symmetric boards as the robot's rotations say.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.camera_file import CameraFile, read_camera
from weldcal.calibration.data.poses.listing import Listing, listing_of, listing_of_array
from weldcal.calibration.data.poses.lists import folder_lists, together, without_copies
from weldcal.calibration.data.poses.names import mounting_name, number_of, whose
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.se3 import angle_of, nearest_rotation, pose
from weldcal.calibration.hand_eye.pairs.conventions import UNITS
from weldcal.calibration.hand_eye.pairs.files import NO_MOUNTING, PosePairs
from weldcal.calibration.hand_eye.pairs.importing import ImportedPairs, StatedForms, WrongScale, import_pairs
from weldcal.calibration.hand_eye.pictures.boards import Board
from weldcal.calibration.hand_eye.pictures.search import (
    FEWEST,
    Picture,
    camera_in,
    common_size,
    estimate_camera,
    find_in,
    picture_files,
    sized,
    solutions,
    spread,
)
from weldcal.models.array_files import read_npz
from weldcal.models.arrays import Array

_FLAT = 1e-3  # of its width: a flat board's points are stated in one plane
_TRIED_SHIFTS = (0, 1, -1, 2, -2, 3, -3)


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
        stated: what that file states; None without one.
    """

    pairs: PosePairs
    pictures: tuple[Picture, ...]
    rows: NDArray[np.int64]
    board: Board
    camera: str
    free: NDArray[np.int64]
    stated: CameraFile | None = None


def read_pictures(
    folder: Path,
    board: Board,
    *,
    mounting: str | None,
    unit: str | None = None,
    stated: StatedForms | None = None,
    camera: Path | None = None,
    known: dict[str, Picture] | None = None,
) -> PictureSet:
    """Return the pictures of a folder with the robot's poses.

    Args:
        folder: it holds the pictures and the robot's poses in any form of docs/datasets.md; ``--camera-poses`` of
            ``stated`` names the pictures, where there are several kinds.
        board: the board in them.
        mounting: eye_in_hand or eye_on_base.
        unit: of the robot's positions.
        stated: what the user states of the robot's poses.
        camera: a file that states the camera; without it one of the folder is taken, or the camera is estimated.
        known: see find_in.

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
            f"'{folder.name}' does not say where the camera is; add --mounting eye_in_hand (on the flange) or"
            " eye_on_base (fixed)."
        )
    if unit is not None and unit not in UNITS:
        raise DatasetError(f"There is no unit '{unit}'; use {', '.join(UNITS)}.")
    files = picture_files(folder, stated.camera_poses)
    stated_camera = (camera, read_camera(camera)) if camera is not None else camera_in(folder)
    skip = frozenset() if stated_camera is None else frozenset({stated_camera[0]})
    robot = _robot(folder, stated, skip, unit)
    board, pictures = find_in(files, board, folder.name, known)
    return picture_set(pictures, board, robot, mode, folder.name, stated=stated, camera=stated_camera, named=camera)


def read_corners(
    path: Path, *, mounting: str | None, unit: str | None, stated: StatedForms, camera: Path | None
) -> PictureSet | None:
    """Return the corners of another detector as pictures, from an npz file of A, img, obj and size; None of others.

    Args:
        path: the file, or a folder with pairs.npz. Without B the poses of the board follow from the corners; without K
            the camera is estimated.
        mounting, unit, stated, camera: as of ``read_pictures``.

    Raises:
        DatasetError: the arrays do not belong together.
    """
    path = path / "pairs.npz" if path.is_dir() else path
    raw = read_npz(path) if path.suffix.lower() == ".npz" and path.is_file() else {}
    if "B" in raw or not {"A", "img", "obj"} <= set(raw):
        return None
    name = path.name
    if "size" not in raw and "K" not in raw:
        raise DatasetError(f"'{name}' holds corners and no K: add 'size', the width and height of its pictures in px.")
    robot, img, obj = listing_of_array("A", raw["A"]), raw["img"].astype(float), raw["obj"].astype(float)
    if img.shape != (len(robot), len(obj), 2) or obj.ndim != 2 or obj.shape[1] != 3 or len(obj) < 4:
        raise DatasetError(
            f"'{name}' holds img {img.shape} and obj {obj.shape} for {len(robot)} poses: they must be"
            " (poses, points, 2) and (points, 3), with four points or more."
        )
    if not np.isfinite(obj).all() or float(np.ptp(obj[:, 2])) > _FLAT * float(np.ptp(obj[:, :2])):
        raise DatasetError(f"'{name}' holds points obj that do not lie in one plane z of the board: give a flat board.")
    mode = mounting_name(mounting or str(np.ravel(raw.get("mode", ""))[0]))
    if mode not in ("eye_in_hand", "eye_on_base"):
        raise DatasetError(NO_MOUNTING.format(name))
    size = np.ravel(raw["size"]).astype(int) if "size" in raw else np.ceil(2.0 * raw["K"][:2, 2]).astype(int) + 1
    file = None if camera is None else (camera, read_camera(camera))
    if file is None and "K" in raw:
        file = path, CameraFile(K=raw["K"], distortion=np.ravel(raw.get("dist", np.zeros(5))), size=None)
    pictures = [
        Picture(
            name=f"{k:04d}",
            points=np.where(np.isfinite(uv).all(axis=1)[:, None], uv, np.nan),
            size=(int(size[0]), int(size[1])),
            thumbnail=b"",
            why="" if int(np.isfinite(uv).all(axis=1).sum()) >= min(8, len(obj)) else "Fewer than 8 points were found.",
        )
        for k, uv in enumerate(img)
    ]
    if sum(not p.why for p in pictures) < FEWEST:
        raise DatasetError(f"'{name}' has {FEWEST - 1} pictures or fewer with 8 points, and {FEWEST} are needed.")
    gaps = np.linalg.norm(obj[:, None] - obj[None], axis=2) + np.diag(np.full(len(obj), np.inf))
    pitch, given = float(np.median(gaps.min(axis=1))), tuple(map(tuple, obj.tolist()))
    board = Board(kind="corners", columns=len(obj), size=pitch, given=given)
    robot = replace(robot, unit=unit or "", ids=tuple(p.name for p in pictures))
    return picture_set(pictures, board, robot, mode, name, stated=stated, camera=file, named=camera)


def picture_set(
    pictures: list[Picture],
    board: Board,
    robot: Listing,
    mode: str,
    source: str,
    *,
    stated: StatedForms | None = None,
    camera: tuple[Path, CameraFile] | None = None,
    named: Path | None = None,
) -> PictureSet:
    """Pictures in which the board was searched, with the robot's poses.

    Args:
        pictures: all of them, in their order.
        board: with its layout.
        robot: the robot's poses.
        mode: eye_in_hand or eye_on_base.
        source: name of the data.
        stated: what the user states of the robot's poses.
        camera: the file that states the camera, and what it states.
        named: the file, where the user named it.

    Raises:
        as ``read_pictures``.
    """
    size = common_size(pictures)
    pictures = [sized(p, size) for p in pictures]
    file = None if camera is None else camera[1]
    K, dist, free, pictures = estimate_camera(pictures, board, size, file, named is not None and named.name)
    C = np.tile(np.eye(4), (len(pictures), 1, 1))
    for k, picture in enumerate(pictures):
        if not picture.why:
            poses = solutions(picture.points, board, K, dist)
            if poses:
                C[k] = poses[0][1]
            else:
                pictures[k] = replace(picture, why="Its points give no pose of the board.")
    found, labels = _imported(pictures, C, board, robot, mode, source, stated or StatedForms())
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
    name = "" if camera is None else camera[0].name
    return PictureSet(pairs=pairs, pictures=tuple(turned), rows=rows, board=board, camera=name, free=free, stated=file)


def _robot(folder: Path, stated: StatedForms, skip: frozenset[Path], unit: str | None) -> Listing:
    """The list of the robot's poses among those of a folder. Raises DatasetError where there is none, or several."""
    lists = folder_lists(folder, 1, skip)
    known = ", ".join(repr(one.name) for one in lists[:8])
    if stated.robot_poses is not None:
        lists = [one for one in lists if stated.robot_poses in one.name]
        if len(lists) != 1:
            raise DatasetError(
                f"--robot-poses {stated.robot_poses} names {len(lists)} of the lists of '{folder.name}':"
                f" {known or 'none'}."
            )
    if not lists:
        raise DatasetError(
            f"'{folder.name}' holds pictures and no robot poses: add robot.csv with the header id,x,y,z,qx,qy,qz,qw,"
            " one row per picture, or one file per picture."
        )
    if len(lists) > 1:
        lists = [one for one in lists if len(one) > 1] or lists
        mine = without_copies([one for one in lists if whose(one.name) == "robot"])
        others = without_copies([one for one in lists if whose(one.name) != "camera"])
        lists = mine if len(mine) == 1 else others if len(others) == 1 else lists
    if len(lists) > 1:
        raise DatasetError(
            f"The names of the lists in '{folder.name}' do not show which one has the robot's poses: {known}. Name it"
            " with --robot-poses."
        )
    one = lists[0].of_arm(stated.arm)
    return replace(one, unit=one.unit or unit or "")


def _imported(
    pictures: Sequence[Picture], C: Array, board: Board, robot: Listing, mode: str, source: str, stated: StatedForms
) -> tuple[ImportedPairs, NDArray[np.int64]]:
    """Pairs of the robot's and the boards' poses C (n, 4, 4), and the order of points (n,) of each picture.

    Flips of symmetric boards follow from the robot's rotations.
    """
    name = f"{pictures[0].name} ... {pictures[-1].name}"
    stated = replace(stated, robot_poses=robot.name, camera_poses=name, unit=None, camera_known=True)
    problem: InconsistentPoses | DatasetError | None = None
    for numbered in _numbered(robot, pictures):
        choices = [np.zeros(len(pictures), dtype=np.int64)]
        if len(board.symmetries) > 1:
            choices = _flips(numbered, _listing(name, pictures, C), pictures, board)
        for choice in choices:
            listing = _listing(name, pictures, _flipped(C, choice, board))
            try:
                return import_pairs([numbered, listing], source, mode, stated), choice
            except WrongScale as why:
                size = 1e3 * board.size * why.factor
                problem = InconsistentPoses(
                    f"The board in the pictures of '{source}' fits the robot's motion with its lengths multiplied by"
                    f" {why.factor:.4g}: a size of {size:.4g} mm in place of {1e3 * board.size:g} mm. Measure the board"
                    " and correct --board, or correct --unit of the robot."
                )
                break
            except (InconsistentPoses, DatasetError) as why:
                problem = problem or why
    assert problem is not None
    raise problem


def _listing(name: str, pictures: Sequence[Picture], C: Array) -> Listing:
    out = tuple((k, p.why) for k, p in enumerate(pictures) if p.why)
    found = listing_of(
        name,
        C[:, :3, 3],
        C[:, :3, :3],
        rotation="matrix",
        ids=tuple(Path(p.name).stem for p in pictures),
        unit="m",
        form="pictures of a board",
    )
    return replace(found, left_out=out)


def _numbered(robot: Listing, pictures: Sequence[Picture]) -> list[Listing]:
    """Number the robot's poses as the pictures, where rows have no names and there are more rows than pictures.

    They are counted from 0 or 1.
    """
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
    """Return the boards' poses with another order of their points."""
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
    """Order the points of each picture by the robot's relative rotations, the most likely orders first.

    The angles of the relative rotations must agree.
    """
    rows_r, rows_c, _ = together(robot, camera)
    good = robot.good[rows_r] & camera.good[rows_c]
    rows_r, rows_c = rows_r[good], rows_c[good]
    turns = np.stack([_turn(board, order)[:3, :3] for order in board.symmetries])
    C = camera.readings[0].X[rows_c, :3, :3]
    n = len(C)
    tried: dict[bytes, tuple[float, NDArray[np.int64]]] = {}
    for shift in _TRIED_SHIFTS:
        m = n - abs(shift)
        if m < FEWEST:
            continue
        a, b = slice(max(shift, 0), max(shift, 0) + m), slice(max(-shift, 0), max(-shift, 0) + m)
        turned = np.einsum("nij,sjk->nsik", C[b], turns)
        theirs = angle_of(np.einsum("asji,btjk->abstik", turned, turned, optimize=True))
        for reading in robot.readings:
            R = reading.X[rows_r[a], :3, :3]
            ours = angle_of(np.einsum("aji,bjk->abik", R, R, optimize=True))
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


def _least(cost: Array) -> tuple[NDArray[np.int64], float]:
    """Labels (n,) of least total cost[a, b, label a, label b].

    Coordinate descent from the labels that each picture alone suggests.
    """
    n = len(cost)
    best: tuple[NDArray[np.int64], float] | None = None
    each = np.arange(n)
    for anchor in spread(n, 8):
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
