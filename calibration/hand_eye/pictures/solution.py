"""Solve camera, hand-eye pose and target from the pictures of a board by bundle adjustment."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import angle_of, as_transform, exp_rotation, inverse, moved, skew
from weldcal.calibration.hand_eye.corners import poses_from_corners
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pictures.boards import Board
from weldcal.calibration.hand_eye.pictures.search import FEWEST, GROSS, Picture, solutions
from weldcal.calibration.hand_eye.pictures.sets import PictureSet
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.models.arrays import Array

_TOLERANCE = 1e-5  # of the cost: below it a step changes nothing
_STEPS, _ROUNDS = 12, 40
_HUBER = 2.5  # sigma, of one corner's residual
_HUBER_SHARE = 0.9755  # of the square of a normal residual that its weights leave on average
_LEAST_RAD, _LEAST_M, _LEAST_PX = 1e-7, 1e-8, 1e-3
_WIDE = 10.0  # rad and m: standard deviation of the pose before the data; open directions keep it
_SETTLED = 1e-3  # of the logarithm of a standard deviation

_CHANGED_PX = 1.3  # a second solution may have at most so many times the reprojection error of the first


@dataclass(frozen=True, eq=False, kw_only=True)
class Corners:
    """Points of a board in n pictures, with the robot's poses.

    Attributes:
        robot: X_BF (n, 4, 4), m.
        img: points (n, m, 2) px; NaN where one was not found.
        obj: points (m, 3) of the board, m.
        eye_in_hand: whether the camera is on the flange; else it is on the base, and the board on the flange.
    """

    robot: Array
    img: Array
    obj: Array
    eye_in_hand: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Bundle:
    """A converged adjustment.

    Attributes:
        X, Y: hand-eye pose and target of F X G = Y, (4, 4) each.
        K, distortion: the camera.
        covariance: of X and Y (12, 12), each as (exp(a) R, p + b).
        camera_sigma: standard deviations of the camera's free numbers: fx, fy, cx, cy, then distortion; empty where it
            was given.
        sigma_px: of one coordinate of a corner.
        sigma_rad, sigma_m: of the robot's pose, per axis, at the flange.
        rms_px: rms reprojection error (n,) of each picture, with the robot's pose as corrected.
        off: the robot's error (n, 6) of each picture, rotation vector and displacement of the flange.
        degrees_of_freedom: that the covariance rests on.
    """

    X: Array
    Y: Array
    K: Array
    distortion: Array
    covariance: Array
    camera_sigma: Array
    sigma_px: float
    sigma_rad: float
    sigma_m: float
    rms_px: Array
    off: Array
    degrees_of_freedom: float


@dataclass(frozen=True, eq=False)
class _State:
    X: Array
    Y: Array
    K: Array
    dist: Array
    off: Array  # (n, 6)


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: A (g, g), B (n, g, 6), C (n, 6, 6), a (g,), c (n, 6)."""

    A: Array
    B: Array
    C: Array
    a: Array
    c: Array


class _Adjustment:
    """The residuals of all corners and their derivatives."""

    def __init__(self, corners: Corners, free: NDArray[np.int64], start: _State) -> None:
        self.seen = np.isfinite(corners.img[..., 0])
        self.n = len(corners.robot)
        self.picture, point = np.nonzero(self.seen)
        self.uv = corners.img[self.seen]
        self.p = corners.obj[point]
        self.bounds = np.searchsorted(self.picture, np.arange(self.n + 1))
        self.in_hand = corners.eye_in_hand
        self.M = inverse(corners.robot) if corners.eye_in_hand else corners.robot
        self.free = free
        self.start = start

    def project(self, s: _State, *, slopes: bool) -> tuple[Array, Array, Array]:
        """Residuals (N, 2) px, derivatives (N, 2, g) of camera, X and Y, and (N, 2, 6) of each picture's own error."""
        k = self.picture
        E, RX = exp_rotation(s.off[:, :3]), s.X[:3, :3]
        y = self.p @ s.Y[:3, :3].T
        at = y + s.Y[:3, 3]
        if self.in_hand:
            flange = (self.M[k, :3, :3] @ at[:, :, None])[:, :, 0] + self.M[k, :3, 3]
            turned = (E[k] @ flange[:, :, None])[:, :, 0]
            carrier = turned + s.off[k, 3:]
            to_noise, chain = np.broadcast_to(np.eye(3), (len(k), 3, 3)), E[k] @ self.M[k, :3, :3]
        else:
            turned = (E[k] @ at[:, :, None])[:, :, 0]
            carrier = (self.M[k, :3, :3] @ (turned + s.off[k, 3:])[:, :, None])[:, :, 0] + self.M[k, :3, 3]
            to_noise, chain = self.M[k, :3, :3], self.M[k, :3, :3] @ E[k]
        v = carrier - s.X[:3, 3]
        q = v @ RX
        zero = np.zeros(3)
        uv, jac = cv2.projectPoints(q[:, None], zero, zero, s.K, s.dist)
        r = np.asarray(uv, dtype=float)[:, 0] - self.uv
        r = np.where((q[:, 2] > 0.0)[:, None], r, 1e4)
        if not slopes:
            return r, r, r
        jac = np.asarray(jac, dtype=float).reshape(len(k), 2, -1)
        D = jac[:, :, 3:6] @ RX.T
        parts = [jac[:, :, 6:][:, :, self.free], D @ skew(v), -D, -(D @ chain) @ skew(y), D @ chain]
        own = D @ to_noise
        return r, np.concatenate(parts, axis=2), np.concatenate([-own @ skew(turned), own], axis=2)

    def normal(self, s: _State, px: float, prior: Array) -> _Normal:
        """Normal equations at a state; ``prior`` (6,): precisions of each picture's error."""
        r, G, own = self.project(s, slopes=True)
        w = np.minimum(1.0, _HUBER * px / np.maximum(np.linalg.norm(r, axis=1), 1e-12)) / px**2
        GW, OW = G * w[:, None, None], own * w[:, None, None]
        A = np.einsum("nki,nkj->ij", GW, G, optimize=True)
        a = np.einsum("nki,nk->i", GW, r)
        g = G.shape[2]
        B, C, c = np.zeros((self.n, g, 6)), np.zeros((self.n, 6, 6)), np.zeros((self.n, 6))
        for i in range(self.n):
            rows = slice(self.bounds[i], self.bounds[i + 1])
            o = OW[rows].reshape(-1, 6)
            B[i] = G[rows].reshape(-1, g).T @ o
            C[i] = o.T @ own[rows].reshape(-1, 6)
            c[i] = o.T @ r[rows].ravel()
        C += np.diag(prior)
        c += s.off * prior
        free = len(self.free)
        A[free:, free:] += np.eye(12) / _WIDE**2
        return _Normal(A, B, C, a, c)

    def cost(self, s: _State, px: float, prior: Array) -> float:
        r, _, _ = self.project(s, slopes=False)
        e = np.linalg.norm(r, axis=1) / px
        bounded = np.where(e <= _HUBER, e**2, 2.0 * _HUBER * e - _HUBER**2)
        return float(bounded.sum() + (s.off**2 * prior).sum())

    def step(self, s: _State, dg: Array, de: Array) -> _State:
        free = len(self.free)
        camera = np.concatenate([[s.K[0, 0], s.K[1, 1], s.K[0, 2], s.K[1, 2]], s.dist])
        camera[self.free] += dg[:free]
        K = np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])
        X, Y = moved(s.X, dg[free : free + 6]), moved(s.Y, dg[free + 6 :])
        return _State(X, Y, K, camera[4:], s.off + de)


def adjust(
    corners: Corners,
    X: Array,
    Y: Array,
    K: Array,
    distortion: Array,
    *,
    free: NDArray[np.int64],
    sigma_px: float,
    sigma_rad: float,
    sigma_m: float,
) -> Bundle:
    """Minimise the reprojection errors over camera, X, Y and an error of each robot pose.

    The sizes of the errors are estimated, too.

    Each robot pose has a normal error of its own at the flange, with one standard deviation for all rotations and one
    for all displacements. The variances follow from the restricted likelihood (MacKay 1992: squares over the numbers
    that the data determine).

    Args:
        X, Y, K, distortion: start.
        free: which of fx, fy, cx, cy, k1, k2, p1, p2, k3 ... are estimated.
        sigma_px, sigma_rad, sigma_m: start of the standard deviations.
    """
    n = len(corners.robot)
    state = _State(X, Y, K, np.asarray(distortion, dtype=float), np.zeros((n, 6)))
    work = _Adjustment(corners, free, state)
    px, rad, m = max(sigma_px, _LEAST_PX), max(sigma_rad, _LEAST_RAD), max(sigma_m, _LEAST_M)
    gamma = np.array([3.0 * n, 3.0 * n])
    for _ in range(_ROUNDS):
        prior = np.repeat([1.0 / rad**2, 1.0 / m**2], 3)
        state, normal = _descend(work, state, px, prior)
        S, own = _covariances(normal)
        used = 3.0 * n - np.array([own[:, :3].sum() / rad**2, own[:, 3:].sum() / m**2])
        gamma = np.clip(used, 1e-6, 3.0 * n)
        r, _, _ = work.project(state, slopes=False)
        w = np.minimum(1.0, _HUBER * px / np.maximum(np.linalg.norm(r, axis=1), 1e-12))
        numbers = max(2.0 * len(r) - len(S) - float(gamma.sum()), 1.0)
        before = np.log([px, rad, m])
        px = max(float(np.sqrt((w * (r**2).sum(axis=1)).sum() / (_HUBER_SHARE * numbers))), _LEAST_PX)
        rad = _moved(rad, float((state.off[:, :3] ** 2).sum() / gamma[0]), _LEAST_RAD)
        m = _moved(m, float((state.off[:, 3:] ** 2).sum() / gamma[1]), _LEAST_M)
        if float(np.abs(np.log([px, rad, m]) - before).max()) < _SETTLED:
            break
    covariance = S[-12:, -12:]
    # how much of it comes from the robot: without errors of the robot the corners alone would leave that of A
    alone = np.linalg.inv(normal.A + 1e-300 * np.eye(len(normal.A)))[-12:, -12:]
    share = float(np.clip(1.0 - np.trace(np.linalg.solve(covariance[:6, :6], alone[:6, :6])) / 6.0, 0.0, 1.0))
    robots = max(0.5 * float(gamma.sum()), 3.0)
    dof = 1.0 / (share**2 / robots + (1.0 - share) ** 2 / max(numbers, 3.0))
    r, _, _ = work.project(state, slopes=False)
    square = (r**2).sum(axis=1)
    rms = np.array([np.sqrt(square[a:b].mean()) for a, b in zip(work.bounds[:-1], work.bounds[1:], strict=True)])
    return Bundle(
        X=state.X,
        Y=state.Y,
        K=state.K,
        distortion=state.dist,
        covariance=covariance,
        camera_sigma=np.sqrt(np.diag(S)[: len(free)]),
        sigma_px=px,
        sigma_rad=rad,
        sigma_m=m,
        rms_px=rms,
        off=state.off,
        degrees_of_freedom=dof,
    )


def _moved(sigma: float, square: float, least: float) -> float:
    """Return the next standard deviation: at most a factor of five from the last."""
    return max(float(np.clip(np.sqrt(max(square, 0.0)), sigma / 5.0, 5.0 * sigma)), least)


def _descend(work: _Adjustment, state: _State, px: float, prior: Array) -> tuple[_State, _Normal]:
    """Levenberg-Marquardt at fixed variances; also the normal equations at the end."""
    damping = 0.0
    cost = work.cost(state, px, prior)
    normal = work.normal(state, px, prior)
    for _ in range(_STEPS):
        better = False
        for _ in range(8):
            dg, de = _solved(normal, damping)
            new = work.step(state, dg, de)
            cost_new = work.cost(new, px, prior)
            if cost_new <= cost * (1.0 + 1e-12):
                better = True
                break
            damping = max(10.0 * damping, 1e-4)
        if not better:
            break
        gain = cost - cost_new
        state, cost = new, cost_new
        normal = work.normal(state, px, prior)
        damping = 0.0 if damping < 1e-3 else 0.1 * damping
        if gain < _TOLERANCE * max(cost, 1e-12):
            break
    return state, normal


def _solved(normal: _Normal, damping: float) -> tuple[Array, Array]:
    C = normal.C + damping * np.einsum("nii->ni", normal.C)[:, :, None] * np.eye(6)
    W = np.linalg.solve(C, np.swapaxes(normal.B, 1, 2))  # (n, 6, g)
    c = np.linalg.solve(C, normal.c[:, :, None])[:, :, 0]
    S = normal.A + damping * np.diag(np.diag(normal.A)) - np.einsum("ngi,nih->gh", normal.B, W)
    b = normal.a - np.einsum("ngi,ni->g", normal.B, c)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.A), 1e-300))
    dg = -scale * np.linalg.lstsq(S * scale[:, None] * scale, b * scale, rcond=1e-14)[0]
    return dg, -c - (W @ dg[None, :, None])[:, :, 0]


def _covariances(normal: _Normal) -> tuple[Array, Array]:
    """Covariance (g, g) of the common unknowns, and the variances (n, 6) of each picture's own error."""
    W = np.linalg.solve(normal.C, np.swapaxes(normal.B, 1, 2))
    S = normal.A - np.einsum("ngi,nih->gh", normal.B, W)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.A), 1e-300))
    Q = np.linalg.pinv(S * scale[:, None] * scale, rcond=1e-15, hermitian=True) * scale[:, None] * scale
    own = np.einsum("nii->ni", np.linalg.inv(normal.C)) + np.einsum("nig,gh,nih->ni", W, Q, W, optimize=True)
    return Q, own


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
    if len(data.free):
        pairs = replace(pairs, K=bundle.K, dist=bundle.distortion)
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
