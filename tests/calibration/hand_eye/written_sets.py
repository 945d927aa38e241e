"""Two lists of poses of one cell, written in random conventions."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.readings import PoseNumbers
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arrays import Array

KINDS = ("corners only", "camera", "robot", "both", "target poses", "heavy tails", "poor camera", "far target")
"""What is wrong besides the corners' own noise; "target poses" and "heavy tails": no corners, but poses with noise of
their own (normal, or Student's t of three degrees of freedom); "far target": a larger board 2 to 6 m away."""
_ARMS = ("ur10e", "ur5e")
_WIDTH, _HEIGHT = 1280.0, 960.0
_LEAST = 6  # corners in an image that is kept

ROTATION_DEG, POSITION_MM = 0.5, 2.0
"""Largest noise of the camera's poses, rms."""
_MIRROR = np.diag([1.0, -1.0, 1.0])
_MOVING = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
_AXES = (*_MOVING, *(axes.lower() for axes in _MOVING))
_NAMED = ("xzy", "yxz", "yzx", "zxy")  # angles about x, y, z in these columns, turned in this order
_SPREADS = (0.26, 0.7, 3.1)  # rad


@dataclass(frozen=True, kw_only=True)
class WrittenSet:
    """Two lists of poses of one cell, as written and without noise, and what is true of them.

    Attributes:
        robot, camera: the lists with noise.
        exact: the camera's list without noise.
        forms: the forms that read both.
        X: the camera in the hand (4, 4), m.
        scale: robot units per metre.
        unit_ratio: robot units per camera unit.
        rotation: noise of the camera's rotations, rms, rad.
        position: noise of its positions, rms, in the robot's unit.
    """

    robot: PoseNumbers
    camera: PoseNumbers
    exact: PoseNumbers
    forms: tuple[str, str]
    X: Array
    scale: float
    unit_ratio: float
    rotation: float
    position: float


def written_set(rng: np.random.Generator, n: int | None = None) -> WrittenSet:
    """Poses of an eye in hand (6 to 40 or ``n``), in a random notation, unit and order each.

    One list may be changed as a whole.
    """
    n = int(rng.integers(6, 41)) if n is None else n
    noise = np.radians(ROTATION_DEG) * rng.uniform(), 1e-3 * POSITION_MM * rng.uniform()
    turned = Rotation.from_rotvec(rng.normal(size=(n, 3)) * float(rng.choice(_SPREADS)) / 2.0) * Rotation.random(
        rng=rng
    )
    A = pose(turned.as_matrix(), rng.uniform([0.2, -0.3, 0.1], [0.8, 0.3, 0.7], (n, 3)))
    X = pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 0.07)
    Y = pose(Rotation.random(rng=rng).as_matrix(), np.array([0.6, 0.0, 0.0]))
    exact = inverse(X) @ inverse(A) @ Y
    B = exact.copy()
    B[:, :3, :3] @= Rotation.from_rotvec(rng.normal(size=(n, 3)) * noise[0] / np.sqrt(3.0)).as_matrix()
    B[:, :3, 3] += rng.normal(size=(n, 3)) * noise[1] / np.sqrt(3.0)
    units = float(rng.choice([1.0, 1e3])), float(rng.choice([1.0, 1e3, 1e2]))
    changed = bool(rng.random() < 0.5)
    (robot,), form = _written([A], rng, units[0], changed)
    (camera, clean), other = _written([B, exact], rng, units[1], not changed)
    return WrittenSet(
        robot=robot,
        camera=camera,
        exact=clean,
        forms=(form, other),
        X=X,
        scale=units[0],
        unit_ratio=units[0] / units[1],
        rotation=noise[0],
        position=noise[1] * units[0],
    )


def _written(
    lists: list[Array], rng: np.random.Generator, unit: float, may_change: bool
) -> tuple[list[PoseNumbers], str]:
    """Return the lists in one random convention, and the form that reads them."""
    change = str(rng.choice(["", "", "transposed", "left_handed"])) if may_change else ""
    kind = str(rng.choice(["vector", "vector", "vector", "quaternion", "matrix"]))
    order, angles, which = (
        str(rng.choice(["xyzw", "wxyz"])),
        str(rng.choice(["deg", "rad"])),
        int(rng.integers(-6, len(_AXES) + len(_NAMED))),
    )
    form = {"matrix": "matrix", "quaternion": f"quaternion_{order}"}.get(kind) or f"{_notation(which)},{angles}"
    found = []
    for X in lists:
        R, p = X[:, :3, :3], unit * X[:, :3, 3]
        if change == "transposed":
            R = np.swapaxes(R, 1, 2)
        if change == "left_handed":
            R, p = _MIRROR @ R @ _MIRROR, p @ _MIRROR
        turn = Rotation.from_matrix(R)
        if kind == "matrix":
            r = R
        elif kind == "quaternion":
            r = turn.as_quat(scalar_first=order == "wxyz") * np.where(rng.random((len(X), 1)) < 0.5, -1.0, 1.0)
        else:
            r = _angles(turn, which) * (1.0 if angles == "rad" else 180.0 / np.pi)
        found.append(PoseNumbers(source="list", p=p, r=r))
    return found, f"{form},{change}".rstrip(",")


def _notation(which: int) -> str:
    if which < 0:
        return "rotation_vector"
    return f"euler_{_AXES[which]}" if which < len(_AXES) else f"fixed_axes_{_NAMED[which - len(_AXES)]}"


def _angles(turn: Rotation, which: int) -> Array:
    if which < 0:
        return np.asarray(turn.as_rotvec())
    named = which >= len(_AXES)
    axes = _NAMED[which - len(_AXES)] if named else _AXES[which]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # gimbal lock: one angle is chosen, and the rotation is right
        found = np.asarray(turn.as_euler(axes))  # type: ignore[call-overload]
    return found[:, [axes.index(a) for a in "xyz"]] if named else found
