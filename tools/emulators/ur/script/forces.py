"""URScript functions of the arm's mechanics and of forces on the tool."""

from typing import Any

import numpy as np

from weldcal.models.arms.kinematics import ArmModel, kinematics_and_jacobian, link_frames
from weldcal.models.arrays import Array
from weldcal.tools.emulators.ur.controller.arm import Compliance, Task, force_task, free_task
from weldcal.tools.emulators.ur.controller.poses import matrix
from weldcal.tools.emulators.ur.script.answers import SLOW, TerminalFunctions, six
from weldcal.tools.emulators.ur.script.arithmetic import Effort
from weldcal.tools.emulators.ur.script.syntax import ScriptError

STEP_RAD = 1e-6  # of the central differences
# [M] how hard a touch is a contact
CONTACT_N = 5.0
BASE = [0.0] * 6


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


class Forces(Dynamics):
    """Force mode and freedrive hold until they are ended or the program ends."""

    def get_tcp_force(self) -> list[float]:
        return self._controller.tcp_force()

    def zero_ftsensor(self) -> None:
        sensor = self._controller.sensor
        sensor.offset = sensor.offset + np.array(self._controller.tcp_force())

    def ft_rtde_input_enable(
        self, enable: bool, sensor_mass: float = 0.0, sensor_measuring_offset: Any = None, sensor_cog: Any = None
    ) -> None:
        self._controller.sensor.external = bool(enable)

    enable_external_ft_sensor = ft_rtde_input_enable

    def force_mode(self, task_frame: Any, selection_vector: Any, wrench: Any, type: int, limits: Any) -> None:
        if type not in (1, 2, 3):
            raise ScriptError(f"force_mode knows the types 1, 2 and 3, not {type!r}.")
        frame, chosen = six(task_frame, "force_mode").tolist(), six(selection_vector, "force_mode")
        scaling = self._controller.force_gain_scaling
        task = force_task(frame, chosen, six(wrench, "force_mode"), int(type), six(limits, "force_mode"), scaling)
        self._comply(task)

    def end_force_mode(self) -> None:
        self._controller.arm.compliance = None

    def force_mode_set_damping(self, damping: float) -> None:
        if not 0.0 <= float(damping) <= 1.0:
            raise ScriptError(f"The damping of force mode is from 0 to 1, not {damping!r}.")

    def force_mode_set_gain_scaling(self, scaling: float) -> None:
        if not 0.0 <= float(scaling) <= 2.0:
            raise ScriptError(f"The gain scaling of force mode is from 0 to 2, not {scaling!r}.")
        self._controller.force_gain_scaling = float(scaling)

    def freedrive_mode(self, freeAxes: Any = (1, 1, 1, 1, 1, 1), feature: Any = None) -> None:
        if feature == "tool":
            feature = self._controller.arm.tool_pose()
        frame = BASE if feature is None or feature == "base" else six(feature, "freedrive_mode").tolist()
        self._comply(free_task(frame, six(list(freeAxes), "freedrive_mode")))

    end_freedrive_mode = end_teach_mode = end_force_mode
    teach_mode = freedrive_mode

    def get_freedrive_status(self) -> int:
        return 0

    def tool_contact(self, direction: Any = None) -> int:
        c = self._controller
        if c.tool_contact_steps > 0 or c.surroundings.stiffness == 0.0:
            return c.tool_contact_steps
        force = c.surroundings.wrench(np.array(c.arm.tool_pose()[:3]))[:3]
        ahead = np.zeros(3) if direction is None else six(direction, "tool_contact")[:3]
        speed = float(np.linalg.norm(ahead))
        # without a direction, any contact counts
        pressed = -float(force @ ahead) / speed if speed > 1e-9 else float(np.linalg.norm(force))
        return self._steps_in_contact() if pressed > CONTACT_N else 0

    def _steps_in_contact(self) -> int:
        """How many steps ago the tool touched the surface, by bisection of the positions that are remembered."""
        c = self._controller
        history, touching, clear = c.arm.history, 0, len(c.arm.history)
        while clear - touching > 1:
            middle = (clear + touching) // 2
            p = (c.arm.flange(history[-1 - middle]) @ c.arm.X_FT)[:3, 3]
            touching, clear = (middle, clear) if c.surroundings.depth(p) > 0.0 else (touching, middle)
        return max(1, min(clear, len(history) - 1))

    def _comply(self, task: Task) -> None:
        arm = self._controller.arm
        if arm.compliance is None:
            arm.compliance = Compliance(arm.model, arm.q_target, arm.qd_target, arm.p_FT, task)
        arm.compliance.task = task
