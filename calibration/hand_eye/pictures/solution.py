"""Solve camera, hand-eye pose and target from the pictures of a board."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import angle_of, as_transform, inverse
from weldcal.calibration.hand_eye.corners import poses_from_corners
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pictures.boards import Board
from weldcal.calibration.hand_eye.pictures.bundle import Bundle, Corners, adjust
from weldcal.calibration.hand_eye.pictures.camera import CameraChange, changed_since
from weldcal.calibration.hand_eye.pictures.search import FEWEST, FREE, GROSS, Picture, solutions
from weldcal.calibration.hand_eye.pictures.sets import PictureSet
from weldcal.calibration.hand_eye.solve import HandEyeResult

_CHANGED_PX = 1.3  # a second solution may have at most so many times the reprojection error of the first


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
        change: of the camera since its file; None without one.
    """

    board: Board
    pictures: tuple[Picture, ...]
    bundle: Bundle
    camera: str
    free: NDArray[np.int64]
    reprojection_px: float
    change: CameraChange | None = None

    @property
    def sentences(self) -> list[str]:
        """What was found, for the reader."""
        used = [p for p in self.pictures if not p.why]
        b = self.bundle
        lines = [
            (
                f"{len(used)} of {len(self.pictures)} pictures used, {self.board}, reprojection"
                f" {self.reprojection_px:.3f} px rms."
            ),
            (
                f"Robot poses as found: {np.degrees(b.sigma_rad):.4f} degrees and {1e3 * b.sigma_m:.3f} mm per axis (1"
                " sigma, at the flange)."
            ),
        ]
        lines += [f"{p.name} is not used. {p.why}" for p in self.pictures if p.why]
        lines.append(_of_board(b))
        K, s = b.K, b.camera_sigma
        if self.camera:
            lines.append(f"Camera from {self.camera}{', within its covariance' if len(s) else ''}.")
        if len(s) >= 4:
            words = ("fx", "fy", "cx", "cy")
            values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            lines.append(
                "Camera estimated: "
                + ", ".join(f"{w} {v:.2f} +- {e:.2f}" for w, v, e in zip(words, values, s, strict=False))
                + " px."
            )
        if self.change is not None:
            lines.append(self.change.sentence)
        return lines


def _of_board(b: Bundle) -> str:
    """What was found of the board's shape, for the reader."""
    (along, across, skew, *sag), sigma = b.terms, b.terms_sigma
    return (
        f"Board as found: print {100 * along:+.2f} % along and {100 * across:+.2f} % across (+- {100 * sigma[0]:.2f}),"
        f" skew {100 * skew:+.2f} %, sag {1e3 * sag[0]:+.2f}, {1e3 * sag[1]:+.2f}, {1e3 * sag[2]:+.2f} mm along,"
        f" twisted and across (+- {1e3 * sigma[3:].max():.2f})."
    )


def solve_pictures(
    data: PictureSet, solve: Callable[[PosePairs], HandEyeResult]
) -> tuple[HandEyeResult, PosePairs, PictureResult]:
    """Hand-eye pose, target and camera from pictures.

    The poses' solution as the start, then the adjustment of the corners.

    Returns:
        The result, with X, Y and covariance of the adjustment; the pairs under the camera that was found; what the
        pictures add.

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
        bad = bundle.rms_px > GROSS * float(np.median(bundle.rms_px)) + 0.3
        if not bad.any() or int((~bad).sum()) < FEWEST:
            break
        keep[np.flatnonzero(keep)[bad]] = False
    change = None if data.stated is None else _change(pairs, result, keep, data)
    # the poses under the camera and with the board as found, which the errors of left-out poses are of
    pairs = replace(pairs, K=bundle.K, dist=bundle.distortion, obj=data.board.points + bundle.shape)
    pairs = replace(pairs, camera=poses_from_corners(pairs, np.zeros(2), least=4))
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
        change=change,
    )
    if not result.unobservable:
        result = replace(
            result,
            poses={"X": as_transform(bundle.X), "Y": as_transform(bundle.Y)},
            covariance={"X": bundle.covariance[:6, :6], "Y": bundle.covariance[6:, 6:]},
            joint_covariance=bundle.covariance,
            degrees_of_freedom=bundle.degrees_of_freedom,
        )
    return replace(result, inliers=keep), pairs, found


def _change(pairs: PosePairs, result: HandEyeResult, keep: NDArray[np.bool_], data: PictureSet) -> CameraChange:
    """Return how the camera that the pictures show by themselves differs from that of the file."""
    file = data.stated
    assert file is not None
    data = replace(data, free=data.free if len(data.free) else FREE)
    return changed_since(file, data.camera, _adjusted(pairs, result, keep, data, own=True), data.free)


def _adjusted(
    pairs: PosePairs, result: HandEyeResult, keep: NDArray[np.bool_], data: PictureSet, *, own: bool = False
) -> Bundle:
    """Adjust the corners of the pictures used; ``own``: without what a file states of the camera."""
    assert pairs.img is not None
    assert pairs.K is not None
    assert pairs.dist is not None
    known = None
    if data.stated is not None and data.stated.covariance is not None and not own:
        known = np.asarray(np.linalg.inv(data.stated.covariance[np.ix_(data.free, data.free)]), dtype=float)
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
        known=known,
    )


def _nearest(pairs: PosePairs, result: HandEyeResult, board: Board) -> tuple[PosePairs, bool]:
    """Return the pairs with, for each picture, the solution that lies nearest to what the result predicts.

    A plane and a symmetric board have several.
    """
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
        off = [float(angle_of(one[1][:3, :3].T @ predicted[i, :3, :3])) for one in close]
        best = close[int(np.argmin(off))]
        now = float(angle_of(camera[i, :3, :3].T @ predicted[i, :3, :3]))
        if min(off) < 0.5 * now and now > 0.05:
            camera[i], img[i], changed = best[1], picture[best[2]], True
    return replace(pairs, camera=camera, img=img), changed
