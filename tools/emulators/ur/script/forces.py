"""URScript functions of forces on the tool: sensor, force mode, freedrive, contact."""

from typing import Any

import numpy as np

from weldcal.tools.emulators.ur.controller.compliance import Compliance, Task, force_task, free_task
from weldcal.tools.emulators.ur.script.answers import six
from weldcal.tools.emulators.ur.script.dynamics import Dynamics
from weldcal.tools.emulators.ur.script.syntax import ScriptError

# [M] how hard a touch is a contact
CONTACT_N = 5.0
BASE = [0.0] * 6


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
