"""Predicts where a straight edge meets the scan plane, with derivatives and covariance.

Frames: B robot base, F flange, S scan plane (a profile point [x, z] is p_S = (x, 0, z)). Derivation in
docs/profiler.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.geometry.se3 import frames_along
from weldcal.calibration.profiler.motion import FlangePoses, Floats, turned


@dataclass(frozen=True, eq=False)
class EdgeState:
    """The unknowns: R_FS (3, 3), p_FS (3,) m, a point of the edge (3,) m and its unit direction (3,), both in B."""

    rotation: Floats
    translation: Floats
    point: Floats
    direction: Floats

    def moved(self, step: Floats) -> EdgeState:
        """Changed by (10,) [rotation in S; p_FS; two of the point, two of the direction across the edge]."""
        across = frames_along(self.direction)[:, :2]
        direction = self.direction + across @ step[8:10]
        return EdgeState(
            turned(self.rotation, step[:3]),
            self.translation + step[3:6],
            self.point + across @ step[6:8],
            direction / np.linalg.norm(direction),
        )


def predicted(state: EdgeState, poses: FlangePoses) -> tuple[Floats, Floats, Floats]:
    """Profile points at which the edge crosses the scan plane, and how they depend on the unknowns and on the robot.

    Returns:
        points (n, 2) m; Jacobian (n, 2, 10) by `EdgeState.moved`; Jacobian (n, 2, 3) by the flange's position in B.
    """
    M = poses.rotation @ state.rotation
    o = poses.rotation @ state.translation + poses.translation
    e, n = state.direction, M[:, :, 1]
    ne = n @ e
    ne = np.where(np.abs(ne) < 1e-6, np.copysign(1e-6, ne), ne)
    s = np.einsum("ni,ni->n", n, o - state.point) / ne
    X = state.point + s[:, None] * e - o
    axes = M[:, :, [0, 2]]
    p = np.einsum("nia,ni->na", axes, X)
    # A projects along the edge onto the scan plane
    A = np.eye(3) - e[None, :, None] * n[:, None, :] / ne[:, None, None]
    by_point = np.einsum("nia,nij->naj", axes, A)
    across = frames_along(e)[:, :2]
    slope = np.einsum("nia,i->na", axes, e) / ne[:, None]
    J = np.zeros((len(poses), 2, 10))
    # turning S in itself: the point turns within the plane (about y), and the plane leaves the point (about x and z)
    J[:, 0, 1], J[:, 1, 1] = -p[:, 1], p[:, 0]
    J[:, :, 0] -= slope * p[:, 1:2]
    J[:, :, 2] += slope * p[:, 0:1]
    J[:, :, 3:6] = -by_point @ poses.rotation
    J[:, :, 6:8] = by_point @ across
    J[:, :, 8:10] = s[:, None, None] * J[:, :, 6:8]
    return p, J, -by_point


def measurement_covariance(by_robot: Floats, sigma_robot_m: float, sigma_xz_m: Floats) -> Floats:
    """Covariance (n, 2, 2) m^2 of measured less predicted points: the profile's sigmas and the robot's, per axis."""
    robot = sigma_robot_m**2 * by_robot @ np.swapaxes(by_robot, 1, 2)
    return np.asarray(robot + np.diag(np.asarray(sigma_xz_m, float) ** 2))


def whitened(covariance: Floats, residual: Floats, J: Floats) -> tuple[Floats, Floats]:
    """Residuals (n, 2) and Jacobian (n, 2, m) in units of their own sigma."""
    L = np.linalg.cholesky(covariance)
    both = np.linalg.solve(L, np.concatenate([residual[:, :, None], J], axis=2))
    return both[:, :, 0], both[:, :, 1:]


def left_covariance(rotation: Floats, covariance: Floats) -> Floats:
    """From a rotation vector in S (right) to one in F (left) in the first three of [rotation; translation]."""
    T = np.eye(6)
    T[:3, :3] = rotation
    return np.asarray(T @ covariance[:6, :6] @ T.T)


def left_information(rotation: Floats, information: Floats) -> Floats:
    """Return the same for an information matrix (6, 6)."""
    T = np.eye(6)
    T[:3, :3] = rotation
    return np.asarray(T @ information @ T.T)  # T is orthogonal
