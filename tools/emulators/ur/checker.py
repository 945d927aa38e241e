"""Invariant checker: records the motion of every frame and counts motions without a command."""

from typing import Any

import numpy as np

from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.motions import STEP_S

RECORD_FRAMES = 300_000  # ten minutes
REST_RAD_S = 1e-3
# A streamed motion whose client has been silent for longer than this moves unattended. Silence is counted in frames, as
# the watchdogs count it and as the arm moves: a controller whose frames come late lives slowly, and its arm moves as
# slowly.
SILENT_S = 0.25
TIME, SPEED, TOOL, SILENCE, STREAMED, OUTPUTS = range(6)


class Checker:
    """Points in time are on the host's monotonic clock, which processes on one machine share.

    Durations are the controller's own: its frames, 2 ms each, whatever the host made of them.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._record = np.zeros((RECORD_FRAMES, 6))
        self._count = 0
        self._heard: float = float("-inf")  # frame of the newest input package or script
        self._moving = False
        self._latched_at: float | None = None
        self._rested_since_fault = False
        self.faults: list[tuple[float, str]] = []
        self.moves_without_a_command = 0
        self.moves_after_a_fault = 0
        self.unattended_s = 0.0

    def heard(self, *_: object) -> None:
        """A client has sent an input package or a script."""
        self._heard = self._count

    def fault(self, name: str, now: float) -> None:
        """A fault was injected: from the first rest on, any motion before `reset` is a violation."""
        self.faults.append((now, name))
        if self._latched_at is None:
            self._latched_at, self._rested_since_fault = now, not self._moving

    def reset(self) -> None:
        """An operator has acknowledged: motion is allowed again."""
        self._latched_at = None

    def frame(self, now: float) -> None:
        """Looks at one control frame."""
        arm = self._controller.arm
        qd = arm.qd
        moving_any = qd.any()
        speed = float(np.abs(qd).max()) if moving_any else 0.0
        silence = (self._count - self._heard) * STEP_S
        motion = arm.motion
        streamed = motion is not None and motion.streamed
        tool = float(np.linalg.norm(arm.tool_speed()[:3])) if moving_any else 0.0
        self._record[self._count % RECORD_FRAMES] = (
            *(now, speed, tool, min(silence, 1e9), streamed),
            self._controller.terminals.digital_outputs,
        )
        self._count += 1
        moving = speed > REST_RAD_S
        if moving and not self._moving:
            self.moves_without_a_command += silence > SILENT_S
            self.moves_after_a_fault += self._latched_at is not None and self._rested_since_fault
        if moving and streamed and silence > SILENT_S:
            self.unattended_s += STEP_S
        self._moving = moving
        if not moving:
            self._rested_since_fault = True

    def _rows(self) -> Any:
        if self._count <= RECORD_FRAMES:
            return self._record[: self._count]
        return np.roll(self._record, -(self._count % RECORD_FRAMES), axis=0)

    def at_rest_after(self, fault_time: float, within: float, speed: float = REST_RAD_S) -> dict[str, Any]:
        """Return whether the arm was at rest `within` seconds after the fault and has not moved since.

        ``rest_after_s`` is None where it never came to rest, moved_again_s where it never moved again; travel_m is the
        tool's path from the fault to the first rest (m).
        """
        rows = self._rows()
        rows = rows[rows[:, TIME] >= fault_time]
        if rows.shape[0] == 0:
            return {"ok": False, "reason": "nothing was recorded after that time"}
        still = rows[:, SPEED] < speed
        if not still.any():
            return {
                "ok": False,
                "rest_after_s": None,
                "moved_again_s": None,
                "travel_m": float(rows[:, TOOL].sum() * STEP_S),
            }
        first = int(np.argmax(still))
        again = ~still[first:]
        moved = (first + int(np.argmax(again)) + 1) * STEP_S if again.any() else None
        rest = (first + 1) * STEP_S
        return {
            "ok": rest <= within and moved is None,
            "rest_after_s": rest,
            "moved_again_s": moved,
            "travel_m": float(rows[:first, TOOL].sum() * STEP_S),
            "peak_tool_speed_after_m_s": float(rows[first:, TOOL].max()),
            "recorded_s": rows.shape[0] * STEP_S,
        }

    def output_after(self, fault_time: float, output: int) -> dict[str, Any]:
        """When after a point in time a digital output went off and when the arm began to slow down (s; None: not yet).

        `frames_before_braking`: how many frames the output was off before the first in which the joints went slower
        than at that time by a hundredth; `on_again_s`: when it went on again.
        """
        rows = self._rows()
        # from the last frame before that time: what happens between frames is seen in the first one after it
        rows = rows[max(0, int(np.searchsorted(rows[:, TIME], fault_time)) - 1) :]
        on = (rows[:, OUTPUTS].astype(np.int64) >> output & 1).astype(bool)
        if rows.shape[0] == 0 or not on[0]:
            return {"ok": False, "reason": "the output was not on at that time"}
        off = int(np.argmax(~on)) if not on.all() else None
        slow = rows[:, SPEED] < 0.99 * rows[0, SPEED]
        slower = int(np.argmax(slow)) if slow.any() else None
        again = None if off is None or not on[off:].any() else off + int(np.argmax(on[off:]))

        def seconds(row: int | None) -> float | None:
            return None if row is None else row * STEP_S

        return {
            "ok": off is not None and again is None,
            "off_after_s": seconds(off),
            "slows_after_s": seconds(slower),
            "frames_before_braking": None if off is None or slower is None else slower - off,
            "on_again_s": seconds(again),
        }

    def output_on_after(self, fault_time: float, output: int) -> dict[str, Any]:
        """For how long a digital output was on after a point in time (s), and when for the last time.

        The last time is None where it was never on.
        """
        rows = self._rows()
        rows = rows[rows[:, TIME] >= fault_time]
        on = (rows[:, OUTPUTS].astype(np.int64) >> output & 1).astype(bool)
        last = float(np.flatnonzero(on)[-1] * STEP_S) if on.any() else None
        return {"ok": True, "on_s": float(on.sum() * STEP_S), "last_on_s": last}

    def summary(self) -> dict[str, Any]:
        """Counts since the start."""
        return {
            "ok": not (self.moves_without_a_command or self.moves_after_a_fault or self.unattended_s > 0.0),
            "moves_without_a_command": int(self.moves_without_a_command),
            "moves_after_a_fault": int(self.moves_after_a_fault),
            "unattended_s": round(self.unattended_s, 3),
            "faults": [{"time": time, "fault": name} for time, name in self.faults],
            "latched": self._latched_at is not None,
        }
