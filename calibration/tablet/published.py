"""The tablet paper's two-stage calibration: chains, fitness functions, and the hand position for a pixel."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from scipy.optimize import least_squares, minimize

from weldcal.calibration.tablet.touches import TabletTouches, check_touches
from weldcal.models.arrays import Array

Model = Literal["htm", "dh"]

HTM_NAMES = ("x_c", "y_c", "alpha_c", "beta_c", "gamma_c", "x_t", "y_t", "alpha_t", "beta_t", "gamma_t", "x_p", "y_p")
DH_NAMES = (
    "theta1_c",
    "a1_c",
    "alpha_c",
    "beta_c",
    "gamma_c",
    "theta1_t",
    "a1_t",
    "alpha_t",
    "beta_t",
    "gamma_t",
    "x_p",
    "y_p",
)
# Search ranges of Tables 5 and 6, mm and degrees, in the order of the names above.
HTM_RANGE = np.array(
    [[-20, 20], [20, 50], *[[-30, 30]] * 3, [100, 200], [0, 100], *[[-30, 30]] * 3, [-20, 20], [-40, -10]], float
)
DH_RANGE = np.array(
    [
        [-30, 30],
        [20, 100],
        *[[-30, 30]] * 3,
        [0, 90],
        [80, 200],
        [-45, 45],
        [-30, 30],
        [-30, 30],
        [-20, 20],
        [-40, -10],
    ],
    float,
)

_FLIP = np.array([-1.0, 1.0])  # Ry(180) of Eq. 1, x and y

AFFINE_NAMES = ("X_1", "Y_1", "Sx_1", "Sy_1", "theta_1", "X_2", "Y_2", "Sx_2", "Sy_2", "theta_2")
AFFINE_NONE = np.array([0.0, 0.0, 1.0, 1.0, 0.0] * 2)
# The paper gives no search range for stage 2; its figures lie well inside this one. mm, 1, degrees.
AFFINE_RANGE = np.array([[-5, 5], [-5, 5], [0.7, 1.3], [0.7, 1.3], [-10, 10]] * 2, float)
CENTRE = 4  # the landmark that A_n turns about: "the fourth black dot", counted from 0

Residuals = Callable[[Array], Array]
"""Parameter sets (k, p) to differences (k, 2 n, 2), mm."""

_SMOOTH_MM = (1e-1, 1e-2, 1e-4)  # a distance d counts as sqrt(d^2 + s^2): the last one changes a mean by 1e-8 at most
_STEP = 1e-5  # of the central differences, mm or degrees


@dataclass(frozen=True)
class Landmarks:
    """The landmarks of k parameter sets in the base, mm, each (k, n, 2).

    ``seen`` by the camera (Eq. 5), ``shown`` by the tablet (Eq. 10), ``pen`` tip minus hand (Eq. 7), ``correction`` the
    touching error turned into the base (the right-hand term of Eq. 20).
    """

    seen: Array
    shown: Array
    pen: Array
    correction: Array


def search_range(model: Model) -> Array:
    """Search range (12, 2) of a model's parameters: Tables 5 and 6, mm and degrees."""
    return HTM_RANGE if model == "htm" else DH_RANGE


def place_landmarks(
    touches: TabletTouches, parameters: Array, model: Model, dh_offset_in_error: bool = True
) -> Landmarks:
    """Landmarks in the base for parameter sets (k, 12) in the paper's own units, mm and degrees.

    HTM: Eqs. 1-11. DH: Eqs. 12-16, with the camera's and the tablet's translation (a, 0) as in modified DH.
    ``dh_offset_in_error``: Eq. 20 of the DH chain as the published figures have it, with the tablet's translation added
    to a difference of points (homogeneous 1 in place of 0). False restores the 0. It changes nothing for HTM.
    """
    v = np.atleast_2d(parameters).T[:, :, None]
    zero = np.zeros_like(v[0])
    depth = 1e3 * touches.depth_m
    p_c = np.stack([touches.rays[:, 0] * depth, touches.rays[:, 1] * depth, depth])
    tablet, delta = 1e3 * touches.landmark_m, 1e3 * touches.pitch_m * touches.delta_px
    if model == "htm":
        x_c, y_c, a_c, b_c, g_c, x_t, y_t, a_t, b_t, g_t, x_p, y_p = v
        R_c = _rotation(a_c + 180.0, b_c + 180.0, g_c)
        R_t = _rotation(a_t + 180.0, b_t, g_t)
        t_c, t_t = (x_c, y_c), (x_t, y_t)
        mirror, extra = 1.0, (zero, zero)
    else:
        th_c, a1_c, a_c, b_c, g_c, th_t, a1_t, a_t, b_t, g_t, x_p, y_p = v
        R_c = _rotation(a_c, b_c, g_c + 180.0 + th_c)
        # diag(1, -1, -1) Rz(th1) in front: the turns about z add up, then y changes its sign
        R_t = _rotation(a_t, b_t, g_t + th_t)
        t_c, t_t = (a1_c, zero), (a1_t, zero)
        mirror, extra = -1.0, (a1_t if dh_offset_in_error else zero, zero)
    c = [R_c[r][0] * p_c[0] + R_c[r][1] * p_c[1] + R_c[r][2] * p_c[2] + t_c[r] for r in (0, 1)]
    seen = np.stack(c, axis=-1) * _FLIP + 1e3 * touches.hand_capture_m[:2]

    def turned(points: Array, shift: tuple[Array, Array]) -> Array:
        x = R_t[0][0] * points[:, 0] + R_t[0][1] * points[:, 1] + shift[0]
        y = mirror * (R_t[1][0] * points[:, 0] + R_t[1][1] * points[:, 1]) + shift[1]
        return np.stack([x, y], axis=-1)

    cos, sin = np.cos(touches.theta_rad), np.sin(touches.theta_rad)
    pen = np.stack([-x_p * cos + y_p * sin, x_p * sin + y_p * cos], axis=-1)
    return Landmarks(seen, turned(tablet, t_t), pen, turned(delta, extra))


def _rotation(alpha: Array, beta: Array, gamma: Array) -> list[list[Array]]:
    """First two rows of Rz(gamma) Ry(beta) Rx(alpha), degrees, entry by entry (k, 1)."""
    ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
    cb, sb = np.cos(np.radians(beta)), np.sin(np.radians(beta))
    cg, sg = np.cos(np.radians(gamma)), np.sin(np.radians(gamma))
    return [
        [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa],
        [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa],
    ]


class Sign(IntEnum):
    """Sign of the touching error in Eq. 20: as printed in the paper, omitted, or as the paper's data require."""

    PRINTED = -1
    NONE = 0
    CORRECTED = 1


@dataclass(frozen=True)
class Fitness:
    """F = f1 + f2, mm: f1 camera against tablet (Eq. 18, 22), f2 hand against where it stood (Eq. 19, 23)."""

    F: float
    f1: float
    f2: float


def stage1_residuals(
    touches: TabletTouches, parameters: Array, model: Model, sign: Sign, dh_offset_in_error: bool = True
) -> Array:
    """Differences (k, 2 n, 2) mm of Eqs. 18 and 19 for parameter sets (k, 12): n of f1, then n of f2."""
    p = place_landmarks(touches, parameters, model, dh_offset_in_error)
    target = 1e3 * touches.hand_m + sign * p.correction
    return np.concatenate([p.seen - p.shown, p.seen - p.pen - target], axis=1)


def stage2_residuals(touches: TabletTouches, affine: Array, stage1: Landmarks, sign: Sign) -> Array:
    """Differences (k, 2 n, 2) mm of Eqs. 22 and 23 for affine pairs (k, 10) on top of one stage 1.

    A_1 acts on the camera's landmarks, A_2 on what A_1 gives minus the pen (only that reading of Eq. 23 reproduces the
    published figures).
    """
    a = np.atleast_2d(affine)
    first = apply_affine(a[:, :5], stage1.seen)
    hand = apply_affine(a[:, 5:], first - stage1.pen)
    target = 1e3 * touches.hand_m + sign * stage1.correction
    return np.concatenate([first - stage1.shown, hand - target], axis=1)


def apply_affine(a: Array, points: Array, about: Array | None = None) -> Array:
    """Apply Eq. 24 to points (k, n, 2) mm, about a point (k, 2) or landmark 4.

    ``a`` (k, 5) is X, Y, Sx, Sy (1), theta (deg).
    """
    X, Y, Sx, Sy, theta = np.asarray(a).T[:, :, None]
    centre = points[:, CENTRE : CENTRE + 1] if about is None else np.asarray(about)[:, None, :]
    d = points - centre
    x, y = Sx * d[..., 0], Sy * d[..., 1]
    c, s = np.cos(np.radians(theta)), np.sin(np.radians(theta))
    return np.asarray(centre + np.stack([c * x - s * y + X, s * x + c * y + Y], axis=-1))


def fitness(residuals: Array) -> Fitness:
    """Return the paper's figures from the differences (2 n, 2) mm of one parameter set."""
    d = np.linalg.norm(residuals.reshape(-1, 2), axis=-1)
    n = len(d) // 2
    f1, f2 = float(d[:n].mean()), float(d[n:].mean())
    return Fitness(f1 + f2, f1, f2)


@dataclass(frozen=True)
class DistanceMinimum:
    """Where the sum of the two mean distances is smallest.

    ``parameters`` (p,), ``residuals`` (2 n, 2) mm, how often the residuals of one parameter set were computed.
    """

    parameters: Array
    residuals: Array
    evaluations: int


def minimise_distances(residuals: Residuals, start: Array, search_range: Array) -> DistanceMinimum:
    """Minimise mean |e_1..n| + mean |e_n+1..2n| (Eqs. 17-19) within a range (p, 2) from a start (p,).

    A mean of distances has kinks where a point is met exactly; the smoothing shrinks until it is far below a digit of
    the published figures. Derivatives are central differences of all parameters in one call.
    """
    low, high = search_range[:, 0], search_range[:, 1]
    unit = 0.5 * (high - low)
    count = 0

    def value(x: Array) -> Array:
        nonlocal count
        count += 1
        return np.asarray(residuals(x[None])[0])

    def slope(x: Array) -> Array:
        """(p, 2 n, 2)."""
        nonlocal count
        count += 2 * len(x)
        steps = _STEP * np.eye(len(x))
        both = residuals(np.concatenate([x + steps, x - steps]))
        return np.asarray((both[: len(x)] - both[len(x) :]) / (2.0 * _STEP))

    def flat(x: Array) -> Array:
        return value(x).ravel()

    def flat_slope(x: Array) -> Array:
        return slope(x).reshape(len(x), -1).T

    squares = least_squares(flat, np.clip(start, low, high), flat_slope, bounds=(low, high), x_scale=unit, xtol=1e-10)
    x = np.asarray(squares.x)
    for smooth in _SMOOTH_MM:

        def objective(y: Array, s: float = smooth) -> tuple[float, Array]:
            r = value(y * unit)
            n = len(r) // 2
            d = np.sqrt((r**2).sum(axis=1) + s * s)
            gradient = (slope(y * unit) * (r / d[:, None])).sum(axis=(1, 2)) * unit / n
            return float(d.sum()) / n, gradient

        found = minimize(
            objective,
            x / unit,
            jac=True,
            method="SLSQP",
            bounds=list(zip(low / unit, high / unit, strict=True)),
            options={"maxiter": 300, "ftol": 1e-13},
        )
        x = np.clip(np.asarray(found.x) * unit, low, high)
    return DistanceMinimum(x, value(x), count)


@dataclass(frozen=True)
class StageResult:
    """One stage: its parameters (mm and degrees, named above), its fitness, its cost."""

    parameters: Array
    fitness: Fitness
    evaluations: int


def tablet_stage1(
    touches: TabletTouches, model: Model = "htm", sign: Sign = Sign.PRINTED, *, dh_offset_in_error: bool = True
) -> StageResult:
    """Stage 1 (Eqs. 17-20): the twelve parameters of a chain.

    Raises what check_touches raises. (alpha_t, beta_t) and their negatives are the same minimum: a plane seen in x and
    y only.
    """
    check_touches(touches)
    search = search_range(model)
    found = minimise_distances(
        lambda x: stage1_residuals(touches, x, model, sign, dh_offset_in_error), search.mean(axis=1), search
    )
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def tablet_stage2(
    touches: TabletTouches,
    stage1: Array,
    model: Model = "htm",
    sign: Sign = Sign.PRINTED,
    *,
    dh_offset_in_error: bool = True,
) -> StageResult:
    """Stage 2 (Eqs. 21-24): the ten parameters of the affine pair on top of ``stage1`` (12,)."""
    placed = place_landmarks(touches, stage1, model, dh_offset_in_error)

    def residuals(x: Array) -> Array:
        return stage2_residuals(touches, x, placed, sign)

    found = minimise_distances(residuals, AFFINE_NONE, AFFINE_RANGE)
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def hand_to_touch(
    fitted: TabletTouches,
    stage1: Array,
    affine: Array | None,
    uv_px: Array,
    depth_m: Array,
    theta_rad: Array,
    model: Model = "htm",
) -> Array:
    """Return hand positions (m, 2) m from which the pen touches the points at ``uv_px`` (m, 2).

    By Eq. 8, or by Eq. 25 with an affine pair (10,).

    ``fitted``: the touches that the parameters come from; A_n turns about their landmark 4.
    """
    m = len(uv_px)
    zeros = np.zeros((m, 2))
    query = replace(
        fitted, uv_px=uv_px, depth_m=depth_m, theta_rad=theta_rad, hand_m=zeros, delta_px=zeros, landmark_px=zeros
    )
    asked = place_landmarks(query, stage1, model)
    if affine is None:
        return np.asarray(1e-3 * (asked.seen - asked.pen)[0])
    own = place_landmarks(fitted, stage1, model)
    a = np.atleast_2d(affine)
    centre = min(CENTRE, len(fitted.uv_px) - 1)
    first = apply_affine(a[:, :5], own.seen, own.seen[:, centre])
    about = (first - own.pen)[:, centre]
    moved = apply_affine(a[:, :5], asked.seen, own.seen[:, centre]) - asked.pen
    return np.asarray(1e-3 * apply_affine(a[:, 5:], moved, about)[0])
