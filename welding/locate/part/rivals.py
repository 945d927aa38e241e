"""Finds the poses that look like the one found, names the directions that are free, and decides whether they matter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from weldcal.welding.locate.part.fit import moved
from weldcal.welding.locate.part.model import PartModel

Floats = npt.NDArray[np.float64]

SAME_SET_M = 0.0006  # below 1 mm, within which the tests' scenes call a pose right
TURNS_DEG = (180.0, 90.0, -90.0, 120.0, -120.0)


@dataclass(frozen=True, eq=False)
class FreeDirection:
    """A small motion (6,) in P that the scan does not fix, its size by one standard deviation, and its name."""

    xi: Floats
    name: str


def turned_poses(model: PartModel, X_BP: RigidTransform) -> list[RigidTransform]:
    """The pose turned about the part's own axes through its middle."""
    middle = model.gravity
    poses = []
    for a in own_axes(model):
        for degrees in TURNS_DEG:
            R = Rotation.from_rotvec(math.radians(degrees) * a).as_matrix()
            poses.append(X_BP @ RigidTransform(RotationMatrix(R), middle - R @ middle))
    return poses


def own_axes(model: PartModel) -> list[Floats]:
    """The axes (3,) of the part's frame, and its principal ones where they differ by more than 3 deg."""
    _, axes = np.linalg.eigh(np.cov(model.points.T))
    candidates = [*np.eye(3), *axes.T]
    chosen: list[Floats] = []
    for a in candidates:
        if not any(abs(a @ b) > math.cos(math.radians(3.0)) for b in chosen):
            chosen.append(a)
    return chosen


def same_set(points_P: Floats | None, X_PP: RigidTransform) -> bool:
    """Tell whether a motion in P leaves these points (N,3), as a set, where they are, to 0.6 mm.

    The spacing is allowed for.
    """
    if points_P is None or len(points_P) < 2:
        return False
    there = np.asarray(points_P) @ X_PP.rotation().matrix().T + X_PP.translation()
    tree = cKDTree(points_P)
    spacing = float(np.median(np.asarray(tree.query(points_P, k=2)[0])[:, 1]))
    forth = np.asarray(tree.query(there)[0]).max()
    back = np.asarray(cKDTree(there).query(points_P)[0]).max()
    return bool(max(forth, back) < SAME_SET_M + 0.55 * spacing)


def same_pose(A: RigidTransform, B: RigidTransform, model: PartModel) -> bool:
    """Whether two poses put every point of the part within a few millimetres of the same place."""
    corners = model.mesh.vertices
    ends = corners[np.unique([np.argmax(corners @ d) for d in np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3))])])]
    gap = A.multiply(ends.T) - B.multiply(ends.T)
    return bool(np.linalg.norm(gap, axis=0).max() < 0.004)


def describe_turn(X_PP: RigidTransform) -> str:
    """A finite motion in P in words."""
    turn = Rotation.from_matrix(X_PP.rotation().matrix()).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle < math.radians(4.0):
        p = 1e3 * X_PP.translation()
        return f"moving it by ({p[0]:.0f}, {p[1]:.0f}, {p[2]:.0f}) mm in its frame looks the same"
    return f"turning it about {axis_name(turn / angle, 'its')} by {math.degrees(angle):.0f} deg looks the same"


def axis_name(direction: Floats, whose: str) -> str:
    """The axis nearest to a direction, or the direction itself: "its z axis"."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > math.cos(math.radians(10.0)):
        return f"{whose} {'xyz'[k]} axis"
    d = direction if direction[k] > 0.0 else -direction
    return f"{whose} axis ({d[0]:.2f}, {d[1]:.2f}, {d[2]:.2f})"


def free_directions(model: PartModel, X_BP: RigidTransform, covariance: Floats, limit_m: float) -> list[FreeDirection]:
    """List the independent motions by whose sigma a point of the part moves more than `limit_m`, worst first."""
    c, length = model.points.mean(axis=0), 0.5 * model.radius
    cross = np.array([[0.0, -c[2], c[1]], [c[2], 0.0, -c[0]], [-c[1], c[0], 0.0]])
    # Motion of the middle and rotation times the part's size: both are lengths then.
    to = np.zeros((6, 6))
    to[:3, :3] = length * np.eye(3)
    to[3:, :3] = -cross
    to[3:, 3:] = np.eye(3)
    values, vectors = np.linalg.eigh(to @ covariance @ to.T)
    found = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda v: -v[0]):
        sigma = math.sqrt(max(0.0, float(value)))
        if sigma < limit_m:
            break
        xi = np.linalg.solve(to, sigma * vector)
        turn, shift = vector[:3], vector[3:]
        if np.linalg.norm(turn) > np.linalg.norm(shift):
            axis = turn / np.linalg.norm(turn)
            degrees = math.degrees(sigma * float(np.linalg.norm(turn)) / length)
            name = f"free to turn about {axis_name(axis, 'its')} ({degrees:.1f} deg or more)"
        else:
            along = X_BP.rotation().matrix() @ (shift / np.linalg.norm(shift))
            name = (
                f"free along {axis_name(along, 'the base' + chr(39) + 's')} ({1e3 * sigma:.1f} mm or more): no side of"
                " it is seen there"
            )
        found.append(FreeDirection(xi, name))
    return found


def harmless(direction: FreeDirection, matters_P: Floats | None) -> bool:
    """Whether moving by a free direction leaves the points that matter where they are as a set."""
    if matters_P is None:
        return False
    size = max(float(np.linalg.norm(direction.xi[:3])) / 0.08, float(np.linalg.norm(direction.xi[3:])) / 0.006, 1e-9)
    return all(same_set(matters_P, moved(RigidTransform(), sign * direction.xi / size)) for sign in (-1.0, 1.0))
