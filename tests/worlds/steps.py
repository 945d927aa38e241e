"""Light planes cast onto a step target in space, and a triangulation sensor whose camera and plane are not as believed.

A ray of the real plane of light meets boxes by their faces. A pinhole camera shows the point, and the believed camera
and plane give it back. Nothing here knows of affine errors, gradients or calibrations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.motion import FlangePoses, Floats

STANDOFF_M, ANGLE_RAD = 0.20, np.radians(35.0)  # of the field's middle below the sensor; of the camera to the light
FAR_M = 0.33  # of the camera from the field's middle
SAMPLES, HALF_FAN_RAD = 400, np.arctan(0.022 / STANDOFF_M)
LENGTH_M = 0.15  # of the target, along and across
FACE_M = 0.012  # of each face that has another above it
DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Triangulation:
    """The plane of light and the camera of a sensor in its housing, as they are less as they are believed.

    ``tilt`` (2,) rad of the plane about x and z, ``shift_m`` of it along y, and the share by which the image is larger.
    """

    tilt: Floats
    shift_m: float
    magnification: float

    @staticmethod
    def made(rng: np.random.Generator) -> Triangulation:
        """Return a sensor whose plane is tilted by up to 0.8 deg and whose image is up to 1 % larger or smaller."""
        return Triangulation(np.radians(rng.uniform(-0.8, 0.8, 2)), 1e-3 * rng.uniform(-1, 1), rng.uniform(-0.01, 0.01))

    @property
    def plane(self) -> Floats:
        """Axes (3, 3) of the real plane of light in the housing: its x and z lie in it, y is its normal."""
        return np.asarray(Rotation.from_euler("xz", self.tilt).as_matrix())

    @property
    def middle(self) -> Floats:
        """A point (3,) m of the real plane."""
        return np.array([0.0, self.shift_m, STANDOFF_M])

    def report(self, p: Floats) -> Floats:
        """Points (..., 2) m of the real plane, about its middle, as the sensor reports them."""
        inside = np.stack([p[..., 0], 0.0 * p[..., 0], p[..., 1]], axis=-1) @ self.plane.T + self.middle
        axis = np.array([0.0, np.sin(ANGLE_RAD), np.cos(ANGLE_RAD)])
        eye = np.array([0.0, 0.0, STANDOFF_M]) - FAR_M * axis
        right, up = np.array([1.0, 0.0, 0.0]), np.cross(axis, [1.0, 0.0, 0.0])
        ray = inside - eye
        image = np.stack([ray @ right, ray @ up], axis=-1) / (ray @ axis)[..., None] * (1.0 + self.magnification)
        ray = axis + image[..., :1] * right + image[..., 1:] * up
        back = eye - (eye[1] / ray[..., 1])[..., None] * ray  # the believed plane is y = 0
        return np.asarray(back[..., [0, 2]])

    def truth(self) -> tuple[Floats, Floats]:
        """Return x scale, z scale and shear (3,) that correct the reports best, and the plane's axes (3, 3)."""
        at = np.stack(np.meshgrid(np.linspace(-0.02, 0.02, 21), np.linspace(-0.015, 0.015, 21)), axis=-1).reshape(-1, 2)
        u = self.report(at)
        A = np.linalg.lstsq(u - u.mean(axis=0), at - at.mean(axis=0), rcond=None)[0].T
        return upright(A, self.plane)


def upright(A: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Split what corrects reports (2, 2) into a symmetric part (3,) and axes (3, 3) turned in their plane."""
    U, s, Vt = np.linalg.svd(A)
    S, Q = Vt.T @ np.diag(s) @ Vt, U @ Vt
    turn = np.array([[Q[0, 0], 0.0, Q[0, 1]], [0.0, 1.0, 0.0], [Q[1, 0], 0.0, Q[1, 1]]])
    return np.array([S[0, 0] - 1.0, S[1, 1] - 1.0, S[0, 1]]), axes @ turn


def cut(R_TS: Floats, p_TS: Floats, heights: Floats) -> Floats:
    """Profile (n, 2) m, in a plane of light, of faces at these heights (m) over z = 0, the next above each.

    The fan comes from STANDOFF_M above the plane's middle, at (R_TS, p_TS) in the target. NaN: nothing was met.
    """
    a = np.linspace(-HALF_FAN_RAD, HALF_FAN_RAD, SAMPLES)
    d_S = np.column_stack([np.sin(a), 0.0 * a, np.cos(a)])
    d, o = d_S @ R_TS.T, p_TS - STANDOFF_M * R_TS[:, 2]
    low = np.array([[-LENGTH_M, -LENGTH_M, -1.0]] + [[k * FACE_M, -LENGTH_M, -1.0] for k in range(len(heights) - 1)])
    high = np.array([[LENGTH_M, LENGTH_M, h] for h in heights])
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = ((side[:, None] - o) / d for side in (low, high))
    enters, leaves = np.minimum(one, two).max(axis=2), np.maximum(one, two).min(axis=2)
    t = np.where((enters <= leaves) & (enters > 0.0), enters, np.inf).min(axis=0)
    p = d_S[:, [0, 2]] * t[:, None] - [0.0, STANDOFF_M]
    return np.where(np.isfinite(t)[:, None], p, np.nan)


@dataclass(frozen=True, eq=False)
class StepScans:
    """Flange poses as the robot states them, the raw profiles (n, m, 2) m, and heights (k,) m of the faces."""

    poses: FlangePoses
    profiles: Floats
    heights_m: Floats


def step_scans(
    rng: np.random.Generator,
    report: Callable[[Floats], Floats],
    axes_F: Floats,
    *,
    count: int = 12,
    tilt_deg: float = 25.0,
    heights_mm: Sequence[float] = (10.0,),
    noise_m: float = 0.05e-3,
    robot_rad: float = np.radians(0.02),
) -> StepScans:
    """Scan a target that lies anywhere, from a robot, with the plane of light whose axes are ``axes_F`` (3, 3)."""
    heights = np.concatenate([[0.0], np.cumsum(heights_mm)]) * 1e-3
    R_BT = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [180.0, 15.0, 15.0], degrees=True).as_matrix()
    turn = rng.uniform(-1.0, 1.0, (count, 3)) * [15.0, tilt_deg, tilt_deg]
    R_TS = DOWN @ Rotation.from_euler("ZYX", turn, degrees=True).as_matrix()
    first = 0.5 * FACE_M * (len(heights) - 2)
    at = np.column_stack([first + rng.uniform(-4e-3, 4e-3, count), np.zeros(count), heights[-1] / 2 * np.ones(count)])
    at += R_TS[:, :, 2] * rng.uniform(-6e-3, 6e-3, (count, 1))  # at several heights
    profiles = np.array([report(cut(R, p, heights)) for R, p in zip(R_TS, at, strict=True)])
    profiles += noise_m * rng.standard_normal(profiles.shape)
    R_BF = R_BT @ R_TS @ axes_F.T
    stated = R_BF @ Rotation.from_rotvec(robot_rad * rng.standard_normal((count, 3))).as_matrix()
    place = np.array([0.6, 0.1, 0.3]) + at @ R_BT.T
    return StepScans(FlangePoses(stated, place), profiles, heights)
