"""Pictures of printed boards: rays through a distorted lens onto a drawn plane, sampled, blurred and with noise."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.geometry.se3 import as_transform, difference, exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_solve
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.search import Picture, offsets
from weldcal.calibration.hand_eye.pictures.sets import picture_set, read_pictures
from weldcal.calibration.hand_eye.pictures.solution import solve_pictures
from weldcal.calibration.hand_eye.solve import HandEyeConfig
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.tools.commands.cell.board import described_sheet
from weldcal.tools.commands.hand_eye import solve_pairs

PX_PER_MM = 8.0  # of the drawings
SIZE = (640, 480)
K = np.array([[620.0, 0.0, 322.0], [0.0, 623.0, 236.0], [0.0, 0.0, 1.0]])
DIST = np.array([-0.12, 0.06, 0.0008, -0.0006])
BOARDS = (
    "chessboard:9x6:20",
    "charuco:8x6:20:15:5X5_100",
    "circles:7x5:20",
    "acircles:4x11:12",
    "tag:7:60:APRILTAG_36h11",
    "tags:4x3:30:10:4X4_50",
)
_N, _BAD = 20, (3, 9, 14)
_CORNER_PX, _ROBOT_DEG, _ROBOT_MM = 0.1, 0.03, 0.1
_SUB = 3  # rays of a pixel in each direction
_BLUR_PX, _NOISE = 0.7, 2.0
_MARGIN_MM = 8.0


@dataclass(frozen=True, eq=False)
class Drawing:
    """A drawn board.

    Attributes:
        image: its picture.
        origin: of the board's frame in it, mm.
        points: of the board, mm (m, 2).
    """

    image: NDArray[np.uint8]
    origin: Array
    points: Array


@dataclass(frozen=True, eq=False)
class BoardWorld:
    """Robot poses (n, 4, 4) as the robot states them, poses of the board in the camera, and the truth."""

    robot: Array
    camera: Array
    X: Array
    Y: Array


@lru_cache(maxsize=8)
def printed(text: str) -> Drawing:
    """Return the board that a string describes, as it is printed on A3."""
    sheet, board = described_sheet(parse_board(text), "A3"), parse_board(text)
    image: Any = np.full((round(sheet.height * PX_PER_MM), round(sheet.width * PX_PER_MM)), 245, np.uint8)
    corners: list[tuple[float, float]] = []
    for value, rectangles in ((15, sheet.black), (245, sheet.white)):
        for x, y, w, h in rectangles:
            left, right = (round(v * PX_PER_MM) for v in (x, x + w))
            top, bottom = (round((sheet.height - v) * PX_PER_MM) for v in (y + h, y))
            image[top:bottom, left:right] = value
            corners += [(left, top), (right, bottom)]
    for x, y, r in sheet.discs:
        u, v = x * PX_PER_MM, (sheet.height - y) * PX_PER_MM
        i, j = np.ogrid[: image.shape[0], : image.shape[1]]
        image[(j + 0.5 - u) ** 2 + (i + 0.5 - v) ** 2 < (r * PX_PER_MM) ** 2] = 15
        corners += [(u - r * PX_PER_MM, v - r * PX_PER_MM), (u + r * PX_PER_MM, v + r * PX_PER_MM)]
    margin = _MARGIN_MM * PX_PER_MM
    low = np.maximum(np.floor(np.min(corners, axis=0) - margin).astype(int), 0)
    high = np.ceil(np.max(corners, axis=0) + margin).astype(int)
    origin = np.array([sheet.origin[0], sheet.height - sheet.origin[1]]) - low / PX_PER_MM
    return Drawing(image[low[1] : high[1], low[0] : high[0]], origin, 1e3 * board.points[:, :2])


def project(points: Array, C: Array) -> Array:
    """Pixels (n, 2) of points (n, 2) mm of the board under its pose C."""
    p = np.column_stack([1e-3 * points, np.zeros(len(points))])
    return np.asarray(cv2.projectPoints(p, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3], K, DIST)[0], dtype=float)[:, 0]


@lru_cache(maxsize=1)
def _rays() -> tuple[Any, Any]:
    """Undistorted rays x, y at z = 1 of every sample of the picture."""
    u, v = np.meshgrid(*((np.arange(n * _SUB) + 0.5) / _SUB - 0.5 for n in SIZE))
    exact = (cv2.TERM_CRITERIA_COUNT, 10, 0.0)
    rays = cv2.undistortPointsIter(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, DIST, np.eye(3), np.eye(3), exact)
    x, y = np.asarray(rays, dtype=np.float32).reshape(*u.shape, 2).transpose(2, 0, 1)
    return x, y


def render(drawing: Drawing, C: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the picture of a drawing under its pose C (m)."""
    x, y = _rays()
    H = np.linalg.inv(C[:3, [0, 1, 3]]).astype(np.float32)  # rays to points of the plane
    p = [H[k, 0] * x + H[k, 1] * y + H[k, 2] for k in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along the plane
        j, i = ((1e3 * p[k] / p[2] + np.float32(drawing.origin[k])) * np.float32(PX_PER_MM) - 0.5 for k in (0, 1))
    found = cv2.remap(drawing.image, j, i, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
    value = cv2.resize(found.astype(np.float32), SIZE, interpolation=cv2.INTER_AREA)
    value = 20.0 + 0.8 * cv2.GaussianBlur(value, (0, 0), _BLUR_PX) + rng.normal(0.0, _NOISE, value.shape)
    return np.asarray(np.clip(np.rint(value), 0, 255), dtype=np.uint8)


def views(
    drawing: Drawing, rng: np.random.Generator, n: int, *, eye_in_hand: bool, deg: float, mm: float
) -> BoardWorld:
    """``n`` views of the whole board, and the robot's poses with normal errors of ``deg`` and ``mm`` per axis."""
    X = pose(exp_rotation(np.array([0.1, -0.2, 1.5])), np.array([0.03, -0.05, 0.10]))
    turn, shift = ([0.2, 0.1, 0.5], [0.5, 0.1, 0.05]) if eye_in_hand else ([0.1, 2.9, 0.3], [0.01, 0.02, 0.05])
    Y = pose(exp_rotation(np.array(turn)), np.array(shift))
    whole = np.array([[u, v] for u in (0, 1) for v in (0, 1)]) * drawing.image.shape[::-1] / PX_PER_MM - drawing.origin
    extent = 1e-3 * max(float(np.ptp(drawing.points, axis=0).max()), 40.0)
    middle = np.append(1e-3 * drawing.points.mean(axis=0), 0.0)
    robot: list[Array] = []
    camera: list[Array] = []
    while len(robot) < n:
        R = exp_rotation(rng.normal(0.0, 0.33, 3) * [1.0, 1.0, 1.5])
        z = extent * rng.uniform(1.5, 2.4)
        C = pose(R, np.array([*(rng.uniform(-0.14, 0.14, 2) * z), z]) - R @ middle)
        uv = project(whole, C)
        if (uv < 5).any() or (uv > np.array(SIZE) - 6).any():
            continue
        F = Y @ inverse(X @ C)
        noise = pose(exp_rotation(rng.normal(0.0, np.radians(deg), 3)), rng.normal(0.0, 1e-3 * mm, 3))
        robot.append((F if eye_in_hand else inverse(F)) @ noise)
        camera.append(C)
    return BoardWorld(np.array(robot), np.array(camera), X, Y)


def calibrated(kind: str, board: str, seed: int) -> Mapping[str, object]:
    """One calibration from rendered corners, from rendered pictures or from pictures of which three are bad."""
    rng = np.random.default_rng([seed, len(kind)])
    drawing, what, in_hand = printed(board), parse_board(board), bool(seed % 2)
    mode = "eye_in_hand" if in_hand else "eye_on_base"
    world = views(drawing, rng, _N, eye_in_hand=in_hand, deg=_ROBOT_DEG, mm=_ROBOT_MM)
    robot = world.robot
    try:
        if kind == "corners":
            noise = rng.normal(0.0, _CORNER_PX, (_N, *drawing.points.shape))
            points = [
                project(drawing.points, C) + offsets(what, C, K, DIST) + e
                for C, e in zip(world.camera, noise, strict=True)
            ]
            shots = [Picture(name=f"{k:02d}.png", points=p, size=SIZE, thumbnail=b"") for k, p in enumerate(points)]
            data = picture_set(shots, what, listing_of_array("robot", robot, unit="m"), mode, kind)
        else:
            images = [render(drawing, C, rng) for C in world.camera]
            if kind == "bad":
                images[_BAD[0]] = np.full_like(images[0], 90)
                images[_BAD[1]] = images[_BAD[1] - 1]
                robot[_BAD[2], :3, 3] += [0.02, -0.01, 0.03]
            with tempfile.TemporaryDirectory() as name:
                for k, image in enumerate(images):
                    cv2.imwrite(str(Path(name) / f"{k:02d}.png"), image)
                np.save(Path(name) / "robot.npy", robot)
                data = read_pictures(Path(name), what, mounting=mode, unit="m")
        result, pairs, found = solve_pictures(data, lambda pairs: solve_pairs(pairs, HandEyeConfig(folds=0)))
    except WeldcalError as problem:
        return {"refused": str(problem)}
    keep, truth = result.inliers, as_transform(world.X)
    theirs = {m: opencv_solve(m, pairs.F[keep], pairs.G[keep]) for m in METHODS}
    return {
        "square": result.normalised_error("X", truth),
        "inside": result.normalised_error("X", truth) < result.region(),
        "each": (
            difference(np.asarray(result.X.GetAsMatrix4()), world.X) ** 2 / np.diag(result.covariance["X"])
        ).tolist(),
        "error": _errors(np.asarray(result.X.GetAsMatrix4()), world.X),
        "opencv": {m: None if t is None else _errors(t[0], world.X) for m, t in theirs.items()},
        "used": sum(not p.why for p in found.pictures),
        "right": all(bool(p.why) == (kind == "bad" and k in _BAD) for k, p in enumerate(found.pictures)),
        "sigma_px": found.bundle.sigma_px,
        "dof": result.degrees_of_freedom,
    }


def _errors(X: Array, truth: Array) -> list[float]:
    """Errors of rotation and position, degrees and mm."""
    e = difference(X, truth)
    return [float(np.degrees(np.linalg.norm(e[:3]))), 1e3 * float(np.linalg.norm(e[3:]))]
