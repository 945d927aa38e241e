"""The tablet paper's two chains to the base: homogeneous transforms (HTM) and Denavit-Hartenberg (DH)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from weldcal.calibration.tablet.touches import TabletTouches
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
    to a difference of points (homogeneous 1 in place of 0); False restores the 0. It changes nothing for HTM.
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
