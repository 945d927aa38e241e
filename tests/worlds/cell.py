"""What is wrong in a simulated cell, for all its worlds: the arm's joints and axes, the scanner, and the fit of a ring."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import exp_rotation, flange_poses, inverse, pose
from weldcal.models.arms.kinematics import ArmModel, Chain
from weldcal.models.arrays import Array

HOME = np.radians([20.0, -80.0, 105.0, -115.0, -90.0, 30.0])
SPREAD_RAD = np.array([0.5, 0.4, 0.5, 0.8, 0.8, 1.5])
Bend = tuple[float, Array, float]
"""A scanner's errors in scale, gradient (2,) and radial distortion."""
Arm = TypeVar("Arm", ArmModel, Chain)


def factory_errors(rng: np.random.Generator) -> Array:
    """Draw errors (6, 6) of joints [rotation; translation] as `flange_poses` takes them.

    Joint offsets of 0.02 to 0.05 degrees, axes off by 0.1 to 0.3 mm and 0.02 degrees.
    """
    sign = rng.choice([-1.0, 1.0], (6, 6))
    turn = np.radians(np.column_stack([0.02 * rng.normal(size=(6, 2)), rng.uniform(0.02, 0.05, 6) * sign[:, 2]]))
    return np.hstack([turn, rng.uniform(1e-4, 3e-4, (6, 3)) / np.sqrt(3.0) * sign[:, 3:]])


def wrong_arm(arm: Arm, errors: Array) -> Arm:
    """Return the arm with errors (6, 6) of its joints, as it was built."""
    return replace(arm, stack=arm.stack @ pose(exp_rotation(errors[:, :3]), errors[:, 3:]))


def bend(rng: np.random.Generator) -> Bend:
    """Draw a scale error of 0.1 %, a gradient of 0.05 % per 100 mm and a radial distortion."""
    return 1e-3 * rng.normal(), 5e-3 * rng.normal(size=2), 3e-3 * rng.normal()


def distorted(p: Array, bent: Bend) -> Array:
    """Where a scanner with these errors puts points (..., 3) m of its frame."""
    scale, gradient, radial = bent
    x = p[..., :2] / p[..., 2:]
    off = scale + p[..., :2] @ gradient + radial * (x * x).sum(axis=-1)
    return np.asarray(p * (1.0 + off[..., None]))


def scanned(
    seen: Callable[[Array], Array],
    X_CR: RigidTransform,
    radius_m: float,
    rng: np.random.Generator,
    centre_m: float,
    normal_rad: float,
) -> tuple[Array, Array, float]:
    """Centre (3,) m, normal (3,) and size over the drawn one of a ring, as a scanner sees the ends of two diameters.

    Args:
        seen: where the scanner puts a point (3,) m. X_CR, radius_m: of the ring. centre_m, normal_rad: noise, per axis.
    """
    p, R = X_CR.translation(), X_CR.rotation().matrix()
    a, b = (seen(p + radius_m * R[:, k]) - seen(p - radius_m * R[:, k]) for k in (0, 1))
    n = np.cross(a, b)
    n = exp_rotation(normal_rad * rng.normal(size=3)) @ (n / np.linalg.norm(n))
    ratio = float(np.linalg.norm(a) + np.linalg.norm(b)) / (4.0 * radius_m)
    return seen(p) + centre_m * rng.normal(size=3), n, ratio


def visible(
    arm: Chain,
    X_BC: Array,
    rng: np.random.Generator,
    n: int,
    *,
    home: Array = HOME,
    spread: Array = SPREAD_RAD,
    field: tuple[float, float, float] = (0.35, 0.4, 0.95),
    tilt_deg: float = 40.0,
) -> Array:
    """Joint angles (n, 6) about ``home`` at which the flange faces the scanner within its tilt.

    It lies in its field: how far aside over the distance, and from and to which distance m.
    """
    out: list[Array] = []
    aside, near, far = field
    while len(out) < n:
        q = home + spread * rng.uniform(-1.0, 1.0, (4000, arm.n))
        X = inverse(X_BC) @ flange_poses(arm, q, np.zeros((arm.n, 6)))
        p, z = X[:, :3, 3], X[:, :3, 2]
        good = (p[:, 2] > near) & (p[:, 2] < far) & (np.abs(p[:, :2]) < aside * p[:, 2:]).all(axis=1)
        good &= -(z * p).sum(axis=1) > np.cos(np.radians(tilt_deg)) * np.linalg.norm(p, axis=1)
        out += list(q[good])
    return np.array(out[:n])
