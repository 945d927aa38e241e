"""Adjust camera, poses and the board's own shape to the corners of all pictures."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import exp_rotation, inverse, moved, skew
from weldcal.calibration.hand_eye.pictures.likeness import shared_errors
from weldcal.models.arrays import Array

_TOLERANCE = 1e-5  # of the cost: below it a step changes nothing
_STEPS, _ROUNDS = 12, 40
_HUBER = 2.5  # sigma, of one corner's residual
_HUBER_SHARE = 0.9755  # of the square of a normal residual that its weights leave on average
_LEAST_RAD, _LEAST_M, _LEAST_PX = 1e-7, 1e-8, 1e-3
_WIDE = 10.0  # rad and m: standard deviation of the pose before the data; open directions keep it
_RIDGE = 1e-13  # of information with a unit diagonal: rounding, so that open directions have a step
_SETTLED = 1e-2  # of the logarithm of a standard deviation, whose own error is several times that
_MOST = 400  # points of a board up to which each has corrections of its own: beyond it their mean is small
_ARM_M, _USUAL = 0.3, 2.0  # a joint's error moves the flange by it times a forearm; what that weighs, in numbers
_START = 0.1  # of SAG: size of the errors of single points to begin with

SCALE = 2e-3  # a choice: of the print in either direction, office printers 0.1 to 0.3 %
SKEW = 1e-3  # a choice: of the print, rad, half of SCALE: paper is fed straighter than evenly
SAG = 3e-3  # a choice: of the board's longer side, printed sheets on a carrier 0.1 to 0.5 %
_PRINT = 3e-5  # of the longer side: where the estimates of single points end; 0.01 mm of a sheet of paper


@dataclass(frozen=True, eq=False, kw_only=True)
class Corners:
    """Points of a board in n pictures, with the robot's poses.

    Attributes:
        robot: X_BF (n, 4, 4), m; without a robot the poses X_MC of the camera on the board.
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
        covariance: of X and Y (12, 12), each as (exp(a) R, p + b); empty without a robot.
        camera_covariance: of the camera's free numbers: fx, fy, cx, cy, then distortion, (f, f).
        sigma_px: of one coordinate of a corner.
        sigma_rad, sigma_m: of the robot's pose, per axis, at the flange.
        rms_px: rms reprojection error (n,) of each picture, with the robot's pose as corrected.
        off: the robot's error (n, 6) of each picture, rotation vector and displacement of the flange.
        degrees_of_freedom: that the covariance rests on.
        shape: corrections (m, 3) m of the board's points.
        alike: share of the variance of the robot's errors that poses near each other have in common.
        terms, terms_sigma: print scale along and across, skew, and sag along, twisted and across, with their standard
            deviations, (6,).
    """

    X: Array
    Y: Array
    K: Array
    distortion: Array
    covariance: Array
    camera_covariance: Array
    sigma_px: float
    sigma_rad: float
    sigma_m: float
    rms_px: Array
    off: Array
    degrees_of_freedom: float
    shape: Array
    alike: float
    terms: Array
    terms_sigma: Array

    @property
    def camera_sigma(self) -> Array:
        """Standard deviations (f,) of the camera's free numbers; empty where it was given."""
        return np.asarray(np.sqrt(np.diag(self.camera_covariance)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    X: Array
    Y: Array
    K: Array
    dist: Array
    off: Array  # (n, 6)
    terms: Array  # (6,)
    single: Array  # (m, 3), of single points


@dataclass(frozen=True, eq=False, kw_only=True)
class _Normal:
    """Normal equations: A (g, g), B (n, g, 6), C (n, 6, 6), a (g,), c (n, 6)."""

    A: Array
    B: Array
    C: Array
    a: Array
    c: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sizes:
    """Standard deviations: of a corner px, of the robot rad and m, of the board's points in and off its plane m."""

    px: float
    rad: float
    m: float
    print: float
    flat: float

    @property
    def off(self) -> Array:
        """Precisions (6,) of a picture's own error."""
        return np.repeat([self.rad**-2.0, self.m**-2.0], 3) if self.rad else np.zeros(6)

    @property
    def single(self) -> Array:
        """Precisions (3,) of the correction of a point."""
        return np.array([self.print, self.print, self.flat]) ** -2.0


def board_terms(obj: Array) -> tuple[Array, Array]:
    """Low-order errors of a board as made: displacements (m, 3, 6) per unit, and standard deviations (6,).

    The print's scale along and across and its skew; the sag m along, twisted and across of a surface of second order.
    Gruen and Beyer, System calibration through self-calibration, 2001: corrections of object points with their weights.
    """
    xy = obj[:, :2] - obj[:, :2].mean(axis=0)
    half = 0.5 * float(np.ptp(xy, axis=0).max())
    u, v = (xy / half).T
    out = np.zeros((len(obj), 3, 6))
    out[:, 0, 0], out[:, 1, 1] = xy[:, 0], xy[:, 1]
    out[:, 0, 2], out[:, 1, 2] = 0.5 * xy[:, 1], 0.5 * xy[:, 0]
    for k, square in enumerate((u * u, u * v, v * v), 3):
        out[:, 2, k] = square - square.mean()
    return out, np.array([SCALE, SCALE, SKEW, *[2.0 * half * SAG] * 3])


class _Adjustment:
    """The residuals of all corners and their derivatives."""

    def __init__(
        self, corners: Corners, free: NDArray[np.int64], known: Array | None, mean: Array, *, arm: bool
    ) -> None:
        self.seen = np.isfinite(corners.img[..., 0])
        self.n, self.m = len(corners.robot), len(corners.obj)
        self.picture, self.point = np.nonzero(self.seen)
        self.uv = corners.img[self.seen]
        self.obj = corners.obj
        self.bounds = np.searchsorted(self.picture, np.arange(self.n + 1))
        self.in_hand = corners.eye_in_hand
        self.M = inverse(corners.robot) if corners.eye_in_hand else corners.robot
        self.free, self.arm = free, 12 if arm else 0
        self.known, self.mean = np.zeros((len(free),) * 2) if known is None else known, mean
        self.low, self.usual = board_terms(corners.obj)
        self.points = self.m if self.m <= _MOST else 0
        self.dense = len(free) + self.arm + 6

    def shape(self, s: _State) -> Array:
        return np.asarray(self.low @ s.terms + s.single)

    def project(self, s: _State, *, slopes: bool) -> tuple[Array, Array, Array, Array]:
        """Residuals (N, 2) px and derivatives.

        By camera, X, Y and the board's terms (N, 2, g); each picture's own error (N, 2, 6); the point (N, 2, 3).
        """
        k = self.picture
        E, RX = exp_rotation(s.off[:, :3]), s.X[:3, :3]
        y = (self.obj + self.shape(s))[self.point] @ s.Y[:3, :3].T
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
            return r, r, r, r
        jac = np.asarray(jac, dtype=float).reshape(len(k), 2, -1)
        D = jac[:, :, 3:6] @ RX.T
        own, chained = D @ to_noise, D @ chain
        point = chained @ s.Y[:3, :3]
        parts = [jac[:, :, 6:][:, :, self.free]]
        if self.arm:
            parts += [D @ skew(v), -D, -chained @ skew(y), chained]
        parts.append(point @ self.low[self.point])
        return r, np.concatenate(parts, axis=2), np.concatenate([-own @ skew(turned), own], axis=2), point

    def normal(self, s: _State, sizes: _Sizes) -> _Normal:
        """Normal equations at a state."""
        r, G, own, P = self.project(s, slopes=True)
        w = np.minimum(1.0, _HUBER * sizes.px / np.maximum(np.linalg.norm(r, axis=1), 1e-12)) / sizes.px**2
        d, g = self.dense, self.dense + 3 * self.points
        GW = G * w[:, None, None]
        A, a, B = np.zeros((g, g)), np.zeros(g), np.zeros((self.n, g, 6))
        C, c = np.zeros((self.n, 6, 6)), np.zeros((self.n, 6))
        A[:d, :d] = np.einsum("nki,nkj->ij", GW, G, optimize=True)
        a[:d] = np.einsum("nki,nk->i", GW, r)
        OW = own * w[:, None, None]
        for i in range(self.n):
            rows = slice(self.bounds[i], self.bounds[i + 1])
            o = OW[rows].reshape(-1, 6)
            B[i, :d] = G[rows].reshape(-1, d).T @ o
            C[i] = o.T @ own[rows].reshape(-1, 6)
            c[i] = o.T @ r[rows].ravel()
        if self.points:
            self._points(A, a, B, w, r, (G, own, P))
            a[d:] += (s.single * sizes.single).ravel()
        C += np.diag(sizes.off)
        c += s.off * sizes.off
        f = len(self.free)
        A += self.prior(sizes)
        a[:f] += self.known @ (self.camera(s)[self.free] - self.mean)
        a[d - 6 : d] += s.terms / self.usual**2
        return _Normal(A=A, B=B, C=C, a=a, c=c)

    def prior(self, sizes: _Sizes) -> Array:
        """Information (g, g) of the common unknowns before the data."""
        f = len(self.free)
        points = np.tile(sizes.single, self.points)
        P = np.diag(np.r_[np.zeros(f), np.full(self.arm, _WIDE**-2.0), self.usual**-2.0, points])
        P[:f, :f] = self.known
        return P

    def _points(self, A: Array, a: Array, B: Array, w: Array, r: Array, slopes: tuple[Array, Array, Array]) -> None:
        """Add what the corrections of single points have in common with all other unknowns."""
        (G, own, P), d, m = slopes, self.dense, self.m
        PW = np.swapaxes(P * w[:, None, None], 1, 2)  # (N, 3, 2)
        with_common, block, pull = np.zeros((m, 3, d)), np.zeros((m, 3, 3)), np.zeros((m, 3))
        np.add.at(with_common, self.point, PW @ G)
        np.add.at(block, self.point, PW @ P)
        np.add.at(pull, self.point, (PW @ r[:, :, None])[:, :, 0])
        A[d:, :d] = with_common.reshape(-1, d)
        A[:d, d:] = A[d:, :d].T
        at = d + 3 * np.arange(m)[:, None] + np.arange(3)
        A[at[:, :, None], at[:, None, :]] += block
        a[d:] += pull.ravel()
        B[self.picture[:, None], at[self.point]] = PW @ own

    def shared(self, s: _State, sizes: _Sizes) -> float:
        """By how much errors that the corners of a picture share enlarge what they leave of camera and board.

        The squares of each picture's pull on them, without its own pose, over those of independent errors: vibration
        and blur move all corners. Liang and Zeger 1986, of one number in place of a matrix.
        """
        r, G, own, _ = self.project(s, slopes=True)
        w = np.minimum(1.0, _HUBER * sizes.px / np.maximum(np.linalg.norm(r, axis=1), 1e-12)) / sizes.px**2
        G = np.delete(G, np.s_[len(self.free) : len(self.free) + self.arm], axis=2)
        k = G.shape[2]
        pulls, gains = np.zeros((self.n, k)), np.zeros((self.n, k, k))
        for i in range(self.n):
            rows = slice(self.bounds[i], self.bounds[i + 1])
            root = np.repeat(np.sqrt(w[rows]), 2)
            Q = np.linalg.qr(own[rows].reshape(-1, 6) * root[:, None])[0]
            J = G[rows].reshape(-1, k) * root[:, None]
            J -= Q @ (Q.T @ J)
            pulls[i], gains[i] = J.T @ (root * r[rows].ravel()), J.T @ J
        unit = np.sqrt(np.maximum(np.diag(gains.sum(axis=0)), 1e-300))
        pulls, gains = pulls / unit, gains / np.outer(unit, unit)
        M = np.linalg.pinv(gains.sum(axis=0), rcond=1e-9, hermitian=True)
        share = M @ gains
        expected = np.einsum("nii->", share) - np.einsum("nij,nji->", share, share)
        return float(np.sqrt(max(np.einsum("ni,ij,nj->", pulls, M, pulls) / max(expected, 1e-9), 1.0)))

    def camera(self, s: _State) -> Array:
        return np.concatenate([[s.K[0, 0], s.K[1, 1], s.K[0, 2], s.K[1, 2]], s.dist])

    def cost(self, s: _State, sizes: _Sizes) -> float:
        r = self.project(s, slopes=False)[0]
        e = np.linalg.norm(r, axis=1) / sizes.px
        bounded = np.where(e <= _HUBER, e**2, 2.0 * _HUBER * e - _HUBER**2)
        off = self.camera(s)[self.free] - self.mean
        board = ((s.terms / self.usual) ** 2).sum() + (s.single**2 * sizes.single).sum()
        return float(bounded.sum() + (s.off**2 * sizes.off).sum() + board + off @ self.known @ off)

    def step(self, s: _State, dg: Array, de: Array) -> _State:
        f, d = len(self.free), self.dense
        camera = self.camera(s)
        camera[self.free] += dg[:f]
        K = np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])
        X, Y = (moved(s.X, dg[f : f + 6]), moved(s.Y, dg[f + 6 : f + 12])) if self.arm else (s.X, s.Y)
        single = s.single + dg[d:].reshape(-1, 3) if self.points else s.single
        terms = s.terms + dg[d - 6 : d]
        return _State(X=X, Y=Y, K=K, dist=camera[4:], off=s.off + de, terms=terms, single=single)


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
    arm: bool = True,
    known: Array | None = None,
) -> Bundle:
    """Minimise the reprojection errors over camera, X, Y, an error of each robot pose, and the board's shape.

    The sizes of the errors are estimated, too.

    Each robot pose has a normal error of its own at the flange, with one standard deviation for all rotations and one
    for all displacements. The board has the errors of ``board_terms``, and each of its points a normal error of its
    own, with one standard deviation in its plane and one off it. The variances follow from the restricted likelihood
    (MacKay 1992: squares over the numbers that the data determine).

    Args:
        X, Y, K, distortion: start.
        free: which of fx, fy, cx, cy, k1, k2, p1, p2, k3 ... are estimated.
        sigma_px, sigma_rad, sigma_m: start of the standard deviations.
        arm: whether there is a robot; without one each picture has a pose of its own, and X and Y are identities.
        known: information (f, f) of the camera's free numbers about their start.
    """
    n = len(corners.robot)
    dist = np.asarray(distortion, dtype=float)
    state = _State(X=X, Y=Y, K=K, dist=dist, off=np.zeros((n, 6)), terms=np.zeros(6), single=np.zeros_like(corners.obj))
    mean = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dist])[free]
    work = _Adjustment(corners, free, known, mean, arm=arm)
    f, d, least = len(free), work.dense, _PRINT * float(work.usual[-1]) / SAG
    z = _Sizes(
        px=max(sigma_px, _LEAST_PX),
        rad=max(sigma_rad, _LEAST_RAD) if arm else 0.0,
        m=max(sigma_m, _LEAST_M),
        print=_START * float(work.usual[-1]),
        flat=_START * float(work.usual[-1]),
    )
    for _ in range(_ROUNDS):
        state, normal = _descend(work, state, z)
        S, own = _covariances(normal)
        used = (
            3.0 * n - np.array([own[:, :3].sum() / z.rad**2, own[:, 3:].sum() / z.m**2]) if arm else np.full(2, 3.0 * n)
        )
        gamma = np.clip(used, 1e-6, 3.0 * n)
        one = np.diag(S)[d:].reshape(-1, 3) * z.single
        board = np.clip(len(one) * np.array([2.0, 1.0]) - [one[:, :2].sum(), one[:, 2].sum()], 1e-6, None)
        terms = 6.0 - float((np.diag(S)[d - 6 : d] / work.usual**2).sum())
        r = work.project(state, slopes=False)[0]
        w = np.minimum(1.0, _HUBER * z.px / np.maximum(np.linalg.norm(r, axis=1), 1e-12))
        taken = f + work.arm + terms + float(gamma.sum()) + float(board.sum())
        numbers = max(2.0 * len(r) - taken, 1.0)
        squares = [float((state.off[:, :3] ** 2).sum()), float((state.off[:, 3:] ** 2).sum())]
        new = _Sizes(
            px=max(float(np.sqrt((w * (r**2).sum(axis=1)).sum() / (_HUBER_SHARE * numbers))), _LEAST_PX),
            rad=_moved(z.rad, (squares[0] + _USUAL * (z.m / _ARM_M) ** 2) / (gamma[0] + _USUAL), _LEAST_RAD)
            if arm
            else 0.0,
            m=_moved(z.m, (squares[1] + _USUAL * (z.rad * _ARM_M) ** 2) / (gamma[1] + _USUAL), _LEAST_M)
            if arm
            else z.m,
            print=_moved(z.print, float((state.single[:, :2] ** 2).sum() / board[0]), least),
            flat=_moved(z.flat, float((state.single[:, 2] ** 2).sum() / board[1]), least),
        )
        change = max(abs(np.log(b / a)) for a, b in zip(vars(z).values(), vars(new).values(), strict=True) if a)
        z = new
        if change < _SETTLED:
            break
    alike, worth, more = 0.0, 1.0, np.zeros((d, d))
    of_corners = S[:d, :d] - S[:d] @ work.prior(z) @ S[:, :d]
    if arm:
        W = np.linalg.solve(normal.C, np.swapaxes(normal.B, 1, 2))
        corners_only = normal.C - np.diag(z.off) + 1e-9 * np.einsum("nii->ni", normal.C)[:, :, None] * np.eye(6)
        by_poses = np.linalg.solve(corners_only, np.swapaxes(normal.B, 1, 2))[:, :, f : f + 12]
        effect = np.einsum("gh,nih->ngi", S[:d], W) * z.off
        of_corners -= np.einsum("ngi,nhi->gh", effect / z.off, effect)
        alike, worth, more = shared_errors(corners.robot, state.off, np.repeat([z.rad, z.m], 3), by_poses, effect)
    S[:d, :d] += more + (work.shared(state, z) ** 2 - 1.0) * of_corners
    covariance = S[f : f + work.arm, f : f + work.arm]
    dof = numbers
    if arm:
        # how much of it comes from the robot: without errors of the robot the corners alone would leave that of A
        alone = np.linalg.inv(normal.A + 1e-300 * np.eye(len(normal.A)))[f : f + 6, f : f + 6]
        of_robot = float(np.clip(1.0 - np.trace(np.linalg.solve(covariance[:6, :6], alone)) / 6.0, 0.0, 1.0))
        robots = max(0.5 * worth * float(gamma.sum()), 3.0)
        dof = 1.0 / (of_robot**2 / robots + (1.0 - of_robot) ** 2 / max(numbers, 3.0))
    square = (work.project(state, slopes=False)[0] ** 2).sum(axis=1)
    rms = np.array([np.sqrt(square[a:b].mean()) for a, b in zip(work.bounds[:-1], work.bounds[1:], strict=True)])
    return Bundle(
        X=state.X,
        Y=state.Y,
        K=state.K,
        distortion=state.dist,
        covariance=covariance,
        camera_covariance=S[:f, :f],
        sigma_px=z.px,
        sigma_rad=z.rad,
        sigma_m=z.m if arm else 0.0,
        rms_px=rms,
        off=state.off,
        degrees_of_freedom=dof,
        shape=work.shape(state),
        alike=alike,
        terms=state.terms,
        terms_sigma=np.sqrt(np.diag(S)[d - 6 : d]),
    )


def _moved(sigma: float, square: float, least: float) -> float:
    """Return the next standard deviation: at most a factor of five from the last."""
    return max(float(np.clip(np.sqrt(max(square, 0.0)), sigma / 5.0, 5.0 * sigma)), least)


def _descend(work: _Adjustment, state: _State, sizes: _Sizes) -> tuple[_State, _Normal]:
    """Levenberg-Marquardt at fixed variances; also the normal equations at the end."""
    damping = 0.0
    cost = work.cost(state, sizes)
    normal = work.normal(state, sizes)
    for _ in range(_STEPS):
        better = False
        for _ in range(8):
            dg, de = _solved(normal, damping)
            new = work.step(state, dg, de)
            cost_new = work.cost(new, sizes)
            if cost_new <= cost * (1.0 + 1e-12):
                better = True
                break
            damping = max(10.0 * damping, 1e-4)
        if not better:
            break
        gain = cost - cost_new
        state, cost = new, cost_new
        normal = work.normal(state, sizes)
        damping = 0.0 if damping < 1e-3 else 0.1 * damping
        if gain < _TOLERANCE * max(cost, 1e-12):
            break
    return state, normal


def _solved(normal: _Normal, damping: float) -> tuple[Array, Array]:
    C = normal.C + damping * np.einsum("nii->ni", normal.C)[:, :, None] * np.eye(6)
    W = np.linalg.solve(C, np.swapaxes(normal.B, 1, 2))  # (n, 6, g)
    c = np.linalg.solve(C, normal.c[:, :, None])[:, :, 0]
    S = normal.A + damping * np.diag(np.diag(normal.A)) - np.tensordot(normal.B, W, ([0, 2], [0, 1]))
    b = normal.a - np.einsum("ngi,ni->g", normal.B, c)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.A), 1e-300))
    unit = S * scale[:, None] * scale + _RIDGE * np.eye(len(S))
    dg = -scale * np.linalg.solve(unit, b * scale)
    return dg, -c - (W @ dg[None, :, None])[:, :, 0]


def _covariances(normal: _Normal) -> tuple[Array, Array]:
    """Covariance (g, g) of the common unknowns, and the variances (n, 6) of each picture's own error."""
    W = np.linalg.solve(normal.C, np.swapaxes(normal.B, 1, 2))
    S = normal.A - np.tensordot(normal.B, W, ([0, 2], [0, 1]))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.A), 1e-300))
    Q = np.linalg.pinv(S * scale[:, None] * scale, rcond=1e-15, hermitian=True) * scale[:, None] * scale
    own = np.einsum("nii->ni", np.linalg.inv(normal.C)) + np.einsum("nig,gh,nih->ni", W, Q, W, optimize=True)
    return Q, own
