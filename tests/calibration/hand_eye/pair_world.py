"""Robot and camera poses as calibration tools, robots and loggers store them: files and folders with one known X."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

N = 13
_RNG = np.random.default_rng(40)


def _poses(turn: Rotation, p: np.ndarray) -> np.ndarray:
    X = np.tile(np.eye(4), (len(p), 1, 1))
    X[:, :3, :3], X[:, :3, 3] = turn.as_matrix(), p
    return X


_SPREAD = Rotation.from_rotvec(_RNG.normal(size=(N, 3)) * 0.5)
A = _poses(
    _SPREAD * Rotation.from_euler("xyz", [175.0, 5.0, 40.0], degrees=True),
    _RNG.uniform([0.3, -0.3, 0.2], [0.7, 0.3, 0.6], (N, 3)),
)
(X,) = _poses(Rotation.from_euler("xyz", [[8.0, -4.0, 93.0]], degrees=True), np.array([[0.05, -0.03, 0.08]]))
(Y,) = _poses(Rotation.from_euler("xyz", [[2.0, 1.0, 20.0]], degrees=True), np.array([[0.55, 0.1, -0.02]]))
_NOISE = _poses(Rotation.from_rotvec(_RNG.normal(size=(N, 3)) * 2e-4), _RNG.normal(size=(N, 3)) * 1e-4)
B = np.linalg.inv(X) @ np.linalg.inv(A) @ Y @ _NOISE
"""The target in a camera on the hand: A X B = Y."""
(X_BASE,) = _poses(Rotation.from_euler("xyz", [[178.0, 3.0, -60.0]], degrees=True), np.array([[0.6, 0.2, 1.1]]))
B_BASE = np.linalg.inv(X_BASE) @ A @ np.linalg.inv(Y) @ _NOISE
"""The same of a camera beside the robot: A^-1 X B = Y^-1."""


class Turn:
    """The numbers of a list of poses in every notation."""

    def __init__(self, X: np.ndarray) -> None:
        turn = Rotation.from_matrix(X[:, :3, :3])
        self.X, self.p, self.mm, self.R = X, X[:, :3, 3], 1e3 * X[:, :3, 3], X[:, :3, :3]
        self.q, self.wxyz, self.v = turn.as_quat(), turn.as_quat(scalar_first=True), turn.as_rotvec()
        self.xyz, self.ZYX, self.ZYZ, self.XYZ = (turn.as_euler(a, degrees=True) for a in ("xyz", "ZYX", "ZYZ", "XYZ"))
        self.rpy = turn.as_euler("xyz")


ROBOT, CAMERA, CAMERA_BASE = Turn(A), Turn(B), Turn(B_BASE)


def row(*parts: Any, mark: str = ",", digits: int = 7) -> str:
    return mark.join(
        v if isinstance(v, str) else f"{v:.{digits}f}"
        for part in parts
        for v in np.ravel(np.asarray(part, dtype=object))
    )


def text(path: Path, lines: Sequence[str], before: str = "", after: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(before + "\n".join(lines) + "\n" + after)
    return path


def every(make: Callable[[int], Any]) -> list[Any]:
    return [make(k) for k in range(N)]


def dump(path: Path, tree: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree))
    return path


def beside(name: str, lines: Sequence[str], before: str = "", after: str = "") -> Callable[[Path], Path]:
    """A robot's file beside a plain table of the camera."""

    def make(folder: Path) -> Path:
        text(folder / name, lines, before, after)
        text(folder / "camera.csv", every(lambda k: row(CAMERA.p[k], CAMERA.q[k])), "x,y,z,qx,qy,qz,qw\n")
        return folder

    return make


def xyz(p: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", map(float, p), strict=True))


def xyzw(q: np.ndarray) -> dict[str, float]:
    return dict(zip("xyzw", map(float, q), strict=True))


def ros(turn: Turn, k: int) -> dict[str, Any]:
    return {"translation": xyz(turn.p[k]), "rotation": xyzw(turn.q[k])}


def ros_pose(turn: Turn, k: int) -> dict[str, Any]:
    return {"position": xyz(turn.p[k]), "orientation": xyzw(turn.q[k])}


def block(tree: Any, indent: int = 0) -> str:
    """A tree as block YAML, as ROS prints messages."""
    out = []
    for key, value in tree.items():
        if isinstance(value, dict):
            out += [f"{' ' * indent}{key}:", block(value, indent + 2)]
        elif isinstance(value, list) and isinstance(value[0], dict):
            out += [f"{' ' * indent}{key}:"]
            out += [" " * (indent + 2) + "- " + block(v, indent + 4).lstrip() for v in value]
        else:
            out.append(f"{' ' * indent}{key}: {json.dumps(value)}")
    return "\n".join(out)


def opencv(name: str, M: np.ndarray) -> str:
    rows, cols = np.atleast_2d(M).shape
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {row(M, mark=', ')} ]"


ROBOT_MM, CAMERA_MM = A.copy(), B.copy()
ROBOT_MM[:, :3, 3] *= 1e3
CAMERA_MM[:, :3, 3] *= 1e3
Source = tuple[Callable[[Path], Path], str]
HAND, BASE = "eye_in_hand", "eye_on_base"
