"""Calibrate a camera from pictures of a board, with covariance, and test whether it has changed."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.camera_file import CameraFile, read_camera
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import IDENTITY, inverse
from weldcal.calibration.hand_eye.pictures.boards import Board
from weldcal.calibration.hand_eye.pictures.bundle import Bundle, Corners, adjust
from weldcal.calibration.hand_eye.pictures.search import (
    FEWEST,
    GROSS,
    Picture,
    common_size,
    estimate_camera,
    find_in,
    picture_files,
    reprojection,
    sized,
    solutions,
)
from weldcal.models.arrays import Array

NUMBERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
_HELD_OUT = 4  # a choice: every fourth picture judges the camera of the others
_LEVEL = 0.01  # a choice: chance that a camera is called changed which is not
_LEAST_TILT_DEG = 8.0  # Zhang 2000, 5: a board that is never turned leaves focal length and distance one number
_START_PX = 0.3  # of a corner, to begin with


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraChange:
    """A camera of now beside that of a file.

    Attributes:
        file: name of the file.
        square, limit: chi-squared of the difference, and what 1 of 100 unchanged cameras exceed.
        numbers: how many numbers were compared.
        most: the number that differs most in its sigmas, by how much, and in how many of them.
    """

    file: str
    square: float
    limit: float
    numbers: int
    most: tuple[str, float, float]

    @property
    def changed(self) -> bool:
        """Whether the difference is no chance."""
        return self.square > self.limit

    @property
    def sentence(self) -> str:
        """What was found, for the reader."""
        figure = f"chi-squared {self.square:.1f} of {self.numbers} numbers, limit {self.limit:.1f}"
        if not self.changed:
            return f"The camera is as {self.file} states it: {figure}."
        name, by, sigmas = self.most
        unit = " px" if name in NUMBERS[:4] else ""
        return (
            f"The camera is not as {self.file} states it: {figure}; mostly {name}, {by:+.3g}{unit}"
            f" ({sigmas:.1f} sigma)."
            " Lens, focus or resolution changed: use weldcal camera to calibrate it again."
        )


def changed_since(file: CameraFile, name: str, now: Bundle, free: NDArray[np.int64]) -> CameraChange:
    """Compare the camera of an adjustment, which did not use the file, with the file.

    Args:
        free: the numbers that the adjustment estimated.
    """
    at = CameraFile(K=now.K, distortion=now.distortion, size=None).numbers
    m = max(len(at), len(file.numbers))
    d = (np.pad(at, (0, m - len(at))) - np.pad(file.numbers, (0, m - len(file.numbers))))[free]
    C = now.camera_covariance.copy()
    if file.covariance is not None:
        C += np.pad(file.covariance, (0, m - len(file.covariance)))[np.ix_(free, free)]
    sigmas = d / np.sqrt(np.diag(C))
    k = int(np.argmax(np.abs(sigmas)))
    limit = float(chi2_quantile(1.0 - _LEVEL, len(free)))
    most = NUMBERS[free[k]], float(d[k]), float(abs(sigmas[k]))
    return CameraChange(file=name, square=float(d @ np.linalg.solve(C, d)), limit=limit, numbers=len(free), most=most)


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraEstimate:
    """A calibrated camera.

    Attributes:
        camera: it, with its covariance.
        board: in the pictures.
        pictures: all of them, with why some are not used.
        bundle: the adjustment.
        free: the numbers that were estimated.
        rms_px: rms reprojection error of the pictures used.
        held_out_px: rms distance of the corners of each fourth picture from where its best pose puts them, with the
            camera and the board of the others.
        held_out: number of those pictures.
        change: since the camera of a file; None without one.
    """

    camera: CameraFile
    board: Board
    pictures: tuple[Picture, ...]
    bundle: Bundle
    free: NDArray[np.int64]
    rms_px: float
    held_out_px: float
    held_out: int
    change: CameraChange | None

    @property
    def used(self) -> int:
        """Number of pictures that were used."""
        return sum(not p.why for p in self.pictures)

    @property
    def sigma(self) -> Array:
        """Standard deviations of the camera's numbers, zero where they are fixed."""
        assert self.camera.covariance is not None
        return np.asarray(np.sqrt(np.diag(self.camera.covariance)))


def calibrate_camera(folder: Path, board: Board, old: Path | None = None) -> CameraEstimate:
    """Estimate the camera that took the pictures of a folder, with the shape of the board.

    Zhang, A flexible new technique for camera calibration, 2000; the board's points as in ``adjust``.

    Args:
        old: an earlier file of the same camera, to compare with.

    Raises:
        DatasetError: there are too few pictures, they show no board, or do not determine a camera.
    """
    if not folder.is_dir():
        raise DatasetError(f"'{folder.name}' is no folder: give the folder of the pictures of the board.")
    if board.kind == "tag":
        raise DatasetError("Four corners do not show a lens: use a board of several tags, ChArUco or a chessboard.")
    stated = None if old is None else (old.name, read_camera(old))
    files = picture_files(folder)
    board, pictures = find_in(files, board, folder.name)
    return camera_of(pictures, board, stated)


def camera_of(pictures: list[Picture], board: Board, old: tuple[str, CameraFile] | None = None) -> CameraEstimate:
    """Estimate the camera from pictures in which the board was searched; see ``calibrate_camera``."""
    size = common_size(pictures)
    pictures = [sized(p, size) for p in pictures]
    if old is not None and old[1].size not in (None, size):
        raise DatasetError(f"'{old[0]}' is for pictures of another size than {size[0]} x {size[1]} pixels.")
    K, dist, free, pictures = estimate_camera(pictures, board, size, None, False)
    poses = _poses(pictures, board, K, dist)
    tilts = np.sort(np.degrees(np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0.0, 1.0))))
    if tilts[-3:].min() < _LEAST_TILT_DEG:
        raise DatasetError(
            f"The board is turned by at most {tilts[-1]:.0f} degrees: tilt it by 20 to 40 degrees to all sides."
            " Otherwise its distance and the focal length cannot be separated."
        )
    for _ in range(3):
        bundle = _adjusted(pictures, board, poses, K, dist, free)
        bad = bundle.rms_px > GROSS * float(np.median(bundle.rms_px)) + 0.3
        if not bad.any() or int((~bad).sum()) < FEWEST:
            break
        used = [k for k, p in enumerate(pictures) if not p.why]
        for k, e in zip(np.array(used)[bad], bundle.rms_px[bad], strict=True):
            pictures[k] = replace(pictures[k], why=f"Its points do not fit the camera of the others ({e:.1f} px).")
        poses = poses[~bad]
    used = [k for k, p in enumerate(pictures) if not p.why]
    counts = np.array([pictures[k].found for k in used])
    for k, e in zip(used, bundle.rms_px, strict=True):
        pictures[k] = replace(pictures[k], rms_px=float(e))
    covariance = np.zeros((4 + len(bundle.distortion),) * 2)
    covariance[np.ix_(free, free)] = bundle.camera_covariance
    change = None
    if old is not None:
        same = old[1].free if len(old[1].free) else free  # k3 free in one and zero in the other is no change
        now = bundle if np.array_equal(same, free) else _adjusted(pictures, board, poses, K, dist, same)
        change = changed_since(old[1], old[0], now, same)
    held_out, held_out_px = _held_out([pictures[k] for k in used], board, poses, K, dist, free)
    return CameraEstimate(
        camera=CameraFile(K=bundle.K, distortion=bundle.distortion, size=size, covariance=covariance),
        board=board,
        pictures=tuple(pictures),
        bundle=bundle,
        free=free,
        rms_px=float(np.sqrt((counts * bundle.rms_px**2).sum() / counts.sum())),
        held_out_px=held_out_px,
        held_out=held_out,
        change=change,
    )


def _poses(pictures: list[Picture], board: Board, K: Array, dist: Array) -> Array:
    """Poses (n, 4, 4) of the board in the pictures that are used, best first; those without one are marked."""
    found = []
    for k, picture in enumerate(pictures):
        if picture.why:
            continue
        if some := solutions(picture.points, board, K, dist):
            found.append(some[0][1])
        else:
            pictures[k] = replace(picture, why="Its points give no pose of the board.")
    if len(found) < FEWEST:
        raise DatasetError(f"{len(found)} pictures show the board, and {FEWEST} are needed: take more, tilted.")
    return np.stack(found)


def _adjusted(
    pictures: list[Picture], board: Board, poses: Array, K: Array, dist: Array, free: NDArray[np.int64]
) -> Bundle:
    img = np.stack([p.points for p in pictures if not p.why])
    corners = Corners(robot=inverse(poses), img=img, obj=board.points, eye_in_hand=True)
    return adjust(
        corners, IDENTITY, IDENTITY, K, dist, free=free, sigma_px=_START_PX, sigma_rad=0.0, sigma_m=0.0, arm=False
    )


def _held_out(
    pictures: list[Picture], board: Board, poses: Array, K: Array, dist: Array, free: NDArray[np.int64]
) -> tuple[int, float]:
    """Number of pictures that were left out, and their rms error px; NaN where too few remain."""
    out = np.arange(len(pictures)) % _HELD_OUT == _HELD_OUT - 1
    if int((~out).sum()) < FEWEST:
        return 0, float("nan")
    found = _adjusted([p for p, left in zip(pictures, out, strict=True) if not left], board, poses[~out], K, dist, free)
    squares = [
        reprojection(p.points, board.points + found.shape, C, found.K, found.distortion)
        for p, C, left in zip(pictures, poses, out, strict=True)
        if left
    ]
    return int(out.sum()), float(np.sqrt(np.concatenate(squares).mean()))
