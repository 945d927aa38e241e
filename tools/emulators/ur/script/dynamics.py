"""URScript functions of the arm's mechanics (PolyScope 5.23, 10.9): Jacobian, mass matrix."""

from typing import Any

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian, link_frames
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.poses import matrix
from weldcal.tools.emulators.ur.script.answers import SLOW, six
from weldcal.tools.emulators.ur.script.arithmetic import Effort
from weldcal.tools.emulators.ur.script.terminals import TerminalFunctions

STEP_RAD = 1e-6  # of the central differences


class Dynamics(TerminalFunctions):
    """Matrices are lists of rows; Jacobians are in the order [v; w]."""

    def get_jacobian(self, pos: Any = None, tcp: Any = None) -> list[list[float]]:
        return list(self._jacobian(self._joints(pos), tcp).tolist())

    def get_jacobian_time_derivative(self, pos: Any = None, vel: Any = None, tcp: Any = None) -> list[list[float]]:
        q, step = self._joints(pos), STEP_RAD * self._speeds(vel)
        change = self._jacobian(q + step, tcp) - self._jacobian(q - step, tcp)
        return list((change / (2.0 * STEP_RAD)).tolist())

    def get_mass_matrix(self, pos: Any = None, include_rotors_inertia: bool = True) -> list[list[float]]:
        return list(mass_matrix(self._controller.arm.model, self._joints(pos)).tolist())

    def get_coriolis_and_centrifugal_torques(self, pos: Any = None, vel: Any = None) -> list[float]:
        model, q, qd = self._controller.arm.model, self._joints(pos), self._speeds(vel)
        # Lagrange: c = dM/dt qd - 1/2 d(qd' M qd)/dq, with dM/dq_i by central differences
        slopes = [
            (mass_matrix(model, q + e) - mass_matrix(model, q - e)) / (2.0 * STEP_RAD) for e in STEP_RAD * np.eye(6)
        ]
        rate = sum((slope * speed for slope, speed in zip(slopes, qd, strict=True)), np.zeros((6, 6)))
        return list((rate @ qd - 0.5 * np.array([qd @ slope @ qd for slope in slopes])).tolist())

    def get_target_joint_accelerations(self) -> list[float]:
        return list(self._controller.arm.qdd_target.tolist())

    def _joints(self, pos: Any) -> Array:
        Effort.spend(SLOW)
        return self._controller.arm.q if pos is None else six(pos, "Joint positions")

    def _speeds(self, vel: Any) -> Array:
        return self._controller.arm.qd if vel is None else six(vel, "Joint speeds")

    def _jacobian(self, q: Array, tcp: Any) -> Array:
        arm = self._controller.arm
        p_FT = arm.p_FT if tcp is None else matrix(six(tcp, "A TCP").tolist())[:3, 3]
        J = kinematics_and_jacobian(arm.model, q, p_FT)[2]
        return np.concatenate([J[3:], J[:3]])


def mass_matrix(model: ArmModel, q: Array) -> Array:
    """M (6, 6) kg m^2 of the links without payload and rotors (Siciliano et al., Robotics, 2009, Eq. 7.32)."""
    frames = link_frames(model, q)[1:]
    M = np.zeros((6, 6))
    for i, X in enumerate(frames):
        R = X.rotation().matrix()
        p = X @ model.centers_of_mass[i]
        z = np.array([frame.rotation().matrix()[:, 2] for frame in frames[: i + 1]])
        o = np.array([frame.translation() for frame in frames[: i + 1]])
        angular, linear = np.zeros((3, 6)), np.zeros((3, 6))
        angular[:, : i + 1], linear[:, : i + 1] = z.T, np.cross(z, p - o).T
        M += model.masses[i] * linear.T @ linear + angular.T @ (R @ model.inertias[i] @ R.T) @ angular
    return M
