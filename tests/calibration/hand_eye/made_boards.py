"""Corners of boards as they are made, by cameras that shake, on arms whose links are off: none of the model's own forms.

The board lies on a cylinder, a saddle or a wave; its print is stretched, sheared, and each corner is off by itself. The
readout of a picture is slower than the camera shakes. The arm has six joints, and its links and zeros are other than
stated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.rendering import SIZE, World, project, se3

GRID = np.array([[j, i, 0.0] for i in range(6) for j in range(9)])
# a, d (m) and alpha of six joints: shoulder, elbow and a wrist of three axes, about the size of an arm for 10 kg
LINKS = np.array(
    [[0, 0.18, np.pi / 2], [-0.61, 0, 0], [-0.57, 0, 0], [0, 0.17, np.pi / 2], [0, 0.12, -np.pi / 2], [0, 0.12, 0]]
)
READY = np.array([0.3, -1.7, 1.9, -1.8, -1.5, 0.2])


@dataclass(frozen=True)
class Made:
    """Sizes of everything that is not ideal; zero is ideal."""

    form: str = "cylinder"
    sag: float = 3e-3  # of the longer side, 1 sigma
    scale: float = 2e-3
    skew: float = 1e-3
    point_m: float = 3e-5
    px: float = 0.08
    shake_px: float = 0.05
    arm: str = "links"
    deg: float = 0.03  # of a joint's zero, or of each pose
    mm: float = 0.3  # of a link's length, or of each pose
    n: int = 20
    square_m: float = 0.02


@dataclass
class Seen(World):
    """A world with the corners (n, m, 2) px, and the points (m, 3) as they are stated and as they are."""

    img: np.ndarray = field(default_factory=lambda: np.zeros(0))
    obj: np.ndarray = field(default_factory=lambda: np.zeros(0))
    true: np.ndarray = field(default_factory=lambda: np.zeros(0))


def forward(q: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of the flange."""
    X = np.eye(4)
    for t, (a, d, alpha) in zip(q, links, strict=True):
        c, s, ca, sa = np.cos(t), np.sin(t), np.cos(alpha), np.sin(alpha)
        X = X @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return X


def joints(F: np.ndarray) -> np.ndarray | None:
    """Angles that reach a pose, by Newton's method; None where none near `READY` do."""
    q = READY.copy()
    for _ in range(12):
        X = forward(q, LINKS)
        e = np.r_[F[:3, 3] - X[:3, 3], Rotation.from_matrix(F[:3, :3] @ X[:3, :3].T).as_rotvec()]
        if np.abs(e).max() < 1e-10:
            return q
        J, at = np.zeros((6, 6)), np.eye(4)
        for k in range(6):
            J[:3, k], J[3:, k] = np.cross(at[:3, 2], X[:3, 3] - at[:3, 3]), at[:3, 2]
            at = at @ forward(q[k : k + 1], LINKS[k : k + 1])
        q = q + np.clip(np.linalg.lstsq(J, e, rcond=1e-6)[0], -0.3, 0.3)
    return None


def constant(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """M and N (4, 4) of stated_i M = N actual_i in least squares: what of an arm's errors is as if its flange were elsewhere.

    No calibration can find it and none needs it: it is the same at every pose where the arm works.
    """
    S, T = np.array([s for s, _ in pairs]), np.array([t for _, t in pairs])

    def off(v: np.ndarray) -> np.ndarray:
        D = np.linalg.inv(S @ se3(v[:3], v[3:6])) @ se3(v[6:9], v[9:]) @ T
        return np.c_[Rotation.from_matrix(D[:, :3, :3]).as_rotvec(), D[:, :3, 3] / 0.3].ravel()

    v = least_squares(off, np.zeros(12)).x
    return se3(v[:3], v[3:6]), se3(v[6:9], v[9:])


def board(how: Made, rng: np.random.Generator) -> np.ndarray:
    """Points (54, 3) m of a board as it is made, about its middle."""
    p = how.square_m * (GRID - GRID.mean(axis=0))
    length = np.ptp(p[:, 0])
    a, b = 1.0 + rng.normal(0.0, how.scale, 2)
    g = rng.normal(0.0, how.skew)
    x, y = a * p[:, 0] + 0.5 * g * p[:, 1], b * p[:, 1] + 0.5 * g * p[:, 0]
    sag = rng.normal(0.0, how.sag) * length + 1e-12
    turn = rng.uniform(0.0, np.pi)
    u, v = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    if how.form == "cylinder":  # paper keeps its lengths: the arc is as long as the print
        R = length**2 / (8.0 * sag)
        u, z = R * np.sin(u / R), R * (1.0 - np.cos(u / R))
    elif how.form == "saddle":
        z = 4.0 * sag * (u**2 - v**2) / length**2
    else:
        z = 0.5 * sag * np.sin(2.0 * np.pi * u / length + rng.uniform(0.0, 2.0 * np.pi))
    q = np.stack([np.cos(turn) * u - np.sin(turn) * v, np.sin(turn) * u + np.cos(turn) * v, z], axis=1)
    return q + rng.normal(0.0, how.point_m, q.shape) * [1.0, 1.0, 0.5] + how.square_m * GRID.mean(axis=0)


def seen(seed: int, how: Made, *, eye_in_hand: bool = True) -> Seen:
    """Views that show the whole board, with the poses that the arm states."""
    rng = np.random.default_rng(seed)
    obj, true = how.square_m * GRID, board(how, rng)
    links = LINKS + 1e-3 * how.mm * rng.normal(size=LINKS.shape) * [1.0, 1.0, 0.0]
    links[:, 2] += rng.normal(0.0, np.radians(how.deg), 6)
    zero = rng.normal(0.0, np.radians(how.deg), 6) * [0, 1, 1, 1, 1, 0]  # those of the outer two turn X and Y
    start = forward(READY, LINKS)
    X = se3([0.1, -0.2, 1.5], [0.03, -0.05, 0.10])
    extent, middle = np.ptp(obj[:, 0]), obj.mean(axis=0)
    first = se3([0, 0, 0], [0, 0, 1.9 * extent] - middle)
    Y = start @ X @ first if eye_in_hand else None
    if Y is None:
        Y = np.linalg.inv(start) @ np.linalg.inv(np.linalg.inv(X @ first))
    robot, camera, img, pairs = [], [], [], []
    fresh = 40 if how.arm == "links" else 0
    while len(robot) < how.n or len(pairs) < fresh:
        R = Rotation.from_rotvec(rng.normal(0.0, 0.33, 3) * [1.0, 1.0, 1.5]).as_matrix()
        z = extent * rng.uniform(1.5, 2.4)
        C = np.eye(4)
        C[:3, :3] = R
        C[:3, 3] = [*(rng.uniform(-0.14, 0.14, 2) * z), z] - R @ middle
        uv = project(true, C)
        if (uv < 5).any() or (uv > np.array(SIZE) - 6).any():
            continue
        F = Y @ np.linalg.inv(X @ C)
        B = F if eye_in_hand else np.linalg.inv(F)
        stated = B @ se3(rng.normal(0, np.radians(how.deg), 3), rng.normal(0, 1e-3 * how.mm, 3))
        if fresh:
            q = joints(B)
            if q is None:
                continue
            stated = B @ np.linalg.inv(forward(q + zero, links)) @ forward(q, LINKS)
            pairs.append((stated, B))
        if len(robot) == how.n:
            continue
        shake = how.shake_px * np.sqrt(2.0) * rng.normal(size=2)
        wave = np.sin(2.0 * np.pi * uv[:, 1:] / rng.uniform(100.0, 400.0) + rng.uniform(0.0, 2.0 * np.pi))
        robot.append(stated)
        camera.append(C)
        img.append(uv + shake * wave + rng.normal(0.0, how.px, uv.shape))
    if fresh:
        M, N = constant(pairs)
        X, Y = (M @ X, N @ Y) if eye_in_hand else (N @ X, M @ Y)
    return Seen(np.array(robot), np.array(camera), X, Y, np.array(img), obj, true)
