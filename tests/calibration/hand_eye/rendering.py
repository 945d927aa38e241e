"""A renderer of boards: rays through a distorted lens onto a drawn plane, sampled, blurred and with noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

PX_PER_MM = 8.0  # of the drawings
SIZE = (640, 480)
K = np.array([[620.0, 0.0, 322.0], [0.0, 623.0, 236.0], [0.0, 0.0, 1.0]])
DIST = np.array([-0.12, 0.06, 0.0008, -0.0006])


def se3(w, t) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(np.asarray(w, dtype=float)).as_matrix()
    X[:3, 3] = t
    return X


@dataclass
class Drawing:
    """A drawn board: its picture, the drawing's pixel of the board's origin, and the points in mm that it shows."""

    image: np.ndarray
    origin: np.ndarray
    points: np.ndarray


def _canvas(width_mm: float, height_mm: float, margin_mm: float) -> np.ndarray:
    shape = (round((height_mm + 2 * margin_mm) * PX_PER_MM), round((width_mm + 2 * margin_mm) * PX_PER_MM))
    return np.full(shape, 245, np.uint8)


def _box(image: np.ndarray, x: float, y: float, w: float, h: float, value: int) -> None:
    a, b, c, d = (round(v * PX_PER_MM) for v in (x, y, x + w, y + h))
    image[b:d, a:c] = value


def draw_chessboard(columns: int, rows: int, square: float) -> Drawing:
    """``columns`` x ``rows`` inner corners, the upper left square black."""
    image = _canvas((columns + 1) * square, (rows + 1) * square, square)
    for i in range(rows + 1):
        for j in range(columns + 1):
            if (i + j) % 2 == 0:
                _box(image, (j + 1) * square, (i + 1) * square, square, square, 15)
    grid = np.array([[j * square, i * square] for i in range(rows) for j in range(columns)], dtype=float)
    return Drawing(image, np.array([2 * square, 2 * square]), grid)


def _marker(image: np.ndarray, dictionary: str, number: int, x: float, y: float, side: float, border: int = 1) -> None:
    bits = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    n = bits.markerSize + 2 * border
    cells = cv2.aruco.generateImageMarker(bits, number, n, borderBits=border)
    for i in range(n):
        for j in range(n):
            _box(image, x + j * side / n, y + i * side / n, side / n, side / n, 245 if cells[i, j] else 15)


def draw_charuco(columns: int, rows: int, square: float, marker: float, dictionary: str, old: bool = False) -> Drawing:
    """Squares with markers in the white ones, numbered row by row; ``old``: the upper left square is white where rows
    are even."""
    image = _canvas(columns * square, rows * square, square)
    number, inset = 0, 0.5 * (square - marker)
    white_first = 1 if old and rows % 2 == 0 else 0
    for i in range(rows):
        for j in range(columns):
            x, y = (j + 1) * square, (i + 1) * square
            if (i + j + white_first) % 2 == 0:
                _box(image, x, y, square, square, 15)
            else:
                _marker(image, dictionary, number, x + inset, y + inset, marker)
                number += 1
    grid = np.array([[(j + 1) * square, (i + 1) * square] for i in range(rows - 1) for j in range(columns - 1)])
    return Drawing(image, np.array([square, square]), grid)


def draw_circles(columns: int, rows: int, pitch: float, asymmetric: bool = False, inverse: bool = False) -> Drawing:
    """Discs of half the distance to the next one."""
    grid = np.array(
        [[(2 * j + i % 2 if asymmetric else j) * pitch, i * pitch] for i in range(rows) for j in range(columns)], float
    )
    radius, margin = (0.45 if asymmetric else 0.25) * pitch, 1.5 * pitch
    image = _canvas(*grid.max(axis=0), margin)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    for u, v in (grid + margin) * PX_PER_MM - 0.5:
        image[(x - u) ** 2 + (y - v) ** 2 < (radius * PX_PER_MM) ** 2] = 15
    return Drawing(255 - image if inverse else image, np.array([margin, margin]), grid)


def draw_tags(columns: int, rows: int, size: float, gap: float, dictionary: str, first: int = 0, upward: bool = False, border: int = 1) -> Drawing:  # fmt: skip
    """Tags in rows, the first number in the upper left, or in the lower left where they count ``upward``."""
    margin = 0.4 * size
    image = _canvas(columns * size + (columns - 1) * gap, rows * size + (rows - 1) * gap, margin)
    points = []
    for i in range(rows):
        for j in range(columns):
            x, y = j * (size + gap), i * (size + gap)
            row = rows - 1 - i if upward else i
            _marker(image, dictionary, first + row * columns + j, x + margin, y + margin, size, border)
            points += [[x, y], [x + size, y], [x + size, y + size], [x, y + size]]
    return Drawing(image, np.array([margin, margin]), np.array(points, dtype=float))


def distorted(x: np.ndarray, y: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brown's lens model, written from its equation."""
    r2 = x * x + y * y
    radial = 1.0 + d[0] * r2 + d[1] * r2 * r2
    return (
        x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x * x),
        y * radial + d[2] * (r2 + 2 * y * y) + 2 * d[3] * x * y,
    )


def project(p: np.ndarray, C: np.ndarray, camera: np.ndarray = K, d: np.ndarray = DIST) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) m of the board under its pose C."""
    q = p @ C[:3, :3].T + C[:3, 3]
    x, y = distorted(q[:, 0] / q[:, 2], q[:, 1] / q[:, 2], d)
    return np.stack([camera[0, 0] * x + camera[0, 2], camera[1, 1] * y + camera[1, 2]], axis=1)


@lru_cache(maxsize=2)
def rays(sub: int) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted rays x, y at z = 1 of every sample of the picture, by fixed-point iteration."""
    width, height = SIZE
    step = (np.arange(sub) + 0.5) / sub - 0.5
    u, v = np.meshgrid((np.arange(width)[:, None] + step).ravel(), (np.arange(height)[:, None] + step).ravel())
    xd, yd = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    x, y = xd.copy(), yd.copy()
    for _ in range(8):
        a, b = distorted(x, y, DIST)
        x, y = x + xd - a, y + yd - b
    return x.astype(np.float32), y.astype(np.float32)


def render(drawing: Drawing, C: np.ndarray, rng: np.random.Generator, *, blur: float = 0.7, noise: float = 2.0, sub: int = 3) -> np.ndarray:  # fmt: skip
    """The picture of a drawing under its pose C (m)."""
    width, height = SIZE
    x, y = rays(sub)
    n = C[:3, 2]
    depth = (n @ C[:3, 3]) / (n[0] * x + n[1] * y + n[2])
    q = [depth * x - C[0, 3], depth * y - C[1, 3], depth - C[2, 3]]
    bx, by = (1e3 * sum(C[k, c] * q[k] for k in range(3)) for c in (0, 1))
    i = np.floor((by + drawing.origin[1]) * PX_PER_MM).astype(int)
    j = np.floor((bx + drawing.origin[0]) * PX_PER_MM).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < drawing.image.shape[0]) & (j < drawing.image.shape[1]) & (depth > 0)
    value = np.where(inside, drawing.image[np.where(inside, i, 0), np.where(inside, j, 0)], 110).astype(float)
    value = value.reshape(height, sub, width, sub).mean(axis=(1, 3))
    value = 20.0 + 0.8 * gaussian_filter(value, blur) + rng.normal(0.0, noise, (height, width))
    return np.clip(np.rint(value), 0, 255).astype(np.uint8)


@dataclass
class World:
    """Robot poses (n, 4, 4) as the robot states them, poses of the board in the camera, and the truth."""

    robot: np.ndarray
    camera: np.ndarray
    X: np.ndarray
    Y: np.ndarray


def world(drawing: Drawing, seed: int, n: int = 20, *, eye_in_hand: bool = True, deg: float = 0.02, mm: float = 0.1) -> World:  # fmt: skip
    """n views that show the whole board, and the robot's poses with normal errors."""
    rng = np.random.default_rng(seed)
    X = se3([0.1, -0.2, 1.5], [0.03, -0.05, 0.10])
    Y = se3([0.2, 0.1, 0.5], [0.5, 0.1, 0.05]) if eye_in_hand else se3([0.1, 2.9, 0.3], [0.01, 0.02, 0.05])
    p = np.c_[1e-3 * drawing.points, np.zeros(len(drawing.points))]
    whole = 1e-3 * np.array([[x, y, 0.0] for x in (0.0, 1.0) for y in (0.0, 1.0)]) * [*(np.array(drawing.image.shape[::-1]) / PX_PER_MM), 0.0]  # fmt: skip
    whole[:, :2] -= 1e-3 * drawing.origin
    extent = float(np.ptp(p[:, :2], axis=0).max())
    robot, camera = [], []
    while len(robot) < n:
        R = Rotation.from_rotvec(rng.normal(0.0, 0.33, 3) * [1.0, 1.0, 1.5]).as_matrix()
        z = max(extent, 0.04) * rng.uniform(1.5, 2.4)
        C = np.eye(4)
        C[:3, :3] = R
        C[:3, 3] = [*(rng.uniform(-0.14, 0.14, 2) * z), z] - R @ p.mean(axis=0)
        uv = project(whole, C)
        if (uv < 5).any() or (uv > np.array(SIZE) - 6).any():
            continue
        F = Y @ np.linalg.inv(X @ C)
        B = F if eye_in_hand else np.linalg.inv(F)
        robot.append(B @ se3(rng.normal(0, np.radians(deg), 3), rng.normal(0, 1e-3 * mm, 3)))
        camera.append(C)
    return World(np.array(robot), np.array(camera), X, Y)


def write_pictures(folder: Path, drawing: Drawing, found: World, seed: int, name: str = "{:02d}.png", **how) -> None:
    """One picture for each pose."""
    rng = np.random.default_rng(seed + 1000)
    for k, C in enumerate(found.camera):
        path = folder / name.format(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), render(drawing, C, rng, **how))


def write_robot(path: Path, robot: np.ndarray, mm: bool = False) -> None:
    """x, y, z and a rotation vector, one row for each pose."""
    w = Rotation.from_matrix(robot[:, :3, :3]).as_rotvec()
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.c_[robot[:, :3, 3] * (1e3 if mm else 1.0), w], fmt="%.8f", delimiter=",")
