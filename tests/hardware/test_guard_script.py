"""The guard script in the emulated controller, frame by frame and without a wire: what it obeys, refuses and stops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.robot import guard_script
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.modes import RuntimeState, SafetyMode
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.versions import parse_version

OBEYING, STALE, SILENT, TOO_FAST, MIXED = 1, 2, 3, 4, 5
SPEED_J, MOVE_J, MOVE_L, SPEED_STOP, PAYLOAD, TCP, TCP_BACK, STOP = 9, 1, 3, 15, 17, 29, 40, 255


class Guarded:
    """A controller that runs the guard, and its registers as a client writes them."""

    def __init__(self, *, upper: bool = True, stale: int = 0, version: str = "5.21") -> None:
        self.controller = Controller(load_arm(), np.array(HOME), parse_version(version))
        self.base, self.word = (24, 36) if upper else (0, 12)
        self.name = f"input_int_register_{self.base}"
        self.controller.inputs.integers[self.base] = stale
        self.controller.submit(guard_script(upper))
        self.number = 0.0
        self.frames(5)

    def frames(self, count: int, *, fed: bool = True) -> None:
        for _ in range(count):
            if fed:
                self.controller.written((self.name,))
            self.controller.step()

    def write(self, command: int, values: Sequence[float] = ()) -> None:
        self.controller.inputs.integers[self.base] = command
        for i, value in enumerate(values):
            self.controller.inputs.doubles[self.base + i] = value

    def speed(self, qd: Sequence[float], frames: int, *, numbered: bool = True) -> None:
        for _ in range(frames):
            self.number += numbered
            self.write(SPEED_J, [*qd, 40.0, self.number])
            self.frames(1)

    def once(self, command: int, values: Sequence[float] = (), frames: int = 6) -> None:
        """A command with its handshake: wait for 2, clear, wait for 1."""
        self.write(command, values)
        self.frames(frames)
        assert self.answer == 2
        self.write(0)
        self.frames(2)
        assert self.answer == 1

    @property
    def answer(self) -> int:
        return self.controller.outputs.integers[self.base]

    @property
    def says(self) -> int:
        return self.controller.outputs.integers[self.word]

    @property
    def qd(self) -> np.ndarray:
        return self.controller.arm.qd


@pytest.mark.parametrize("upper", [True, False])
@pytest.mark.parametrize("version", ["5.12", "5.21", "10.12"])
def test_the_guard_is_ready_and_moves_nothing_by_itself(upper: bool, version: str) -> None:
    guarded = Guarded(upper=upper, version=version)
    assert (guarded.answer, guarded.says) == (1, OBEYING)
    assert sorted(guarded.controller.watchdogs) == [guarded.name]
    guarded.frames(200)
    assert not guarded.qd.any()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 20)
    assert guarded.qd[0] == pytest.approx(0.1)


def test_a_command_that_an_earlier_program_left_is_refused() -> None:
    guarded = Guarded(stale=SPEED_J)
    guarded.frames(50)
    assert guarded.says == STALE
    assert guarded.controller.runtime_state == RuntimeState.STOPPED
    assert not guarded.qd.any()


def test_forty_milliseconds_without_a_new_number_and_the_arm_brakes_for_good() -> None:
    guarded = Guarded()
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 50)
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 19, numbered=False)
    assert guarded.says == OBEYING
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 3, numbered=False)
    assert guarded.says == SILENT
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 30)  # numbers again: too late
    assert not guarded.qd.any()
    assert guarded.says == SILENT
    guarded.once(SPEED_STOP, [5.0])  # the one thing that clears it
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 10)
    assert guarded.qd[1] == pytest.approx(0.1)


def test_the_deadman_does_not_care_which_command_keeps_the_watchdog_fed() -> None:
    guarded = Guarded()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 50)
    guarded.write(0)
    guarded.frames(40)
    assert guarded.says == SILENT
    assert not guarded.qd.any()


def test_an_arm_that_stands_still_needs_no_deadman() -> None:
    guarded = Guarded()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 20)
    guarded.speed([0.0] * 6, 30)
    guarded.speed([0.0] * 6, 45, numbered=False)  # 90 ms without a word, less than the watchdog takes
    assert guarded.says == OBEYING
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 10)
    assert guarded.qd[1] == pytest.approx(0.1)


def test_a_silent_client_is_stopped_by_the_guards_own_watchdog() -> None:
    guarded = Guarded()
    guarded.frames(49, fed=False)
    assert guarded.controller.runtime_state == RuntimeState.PLAYING
    guarded.frames(5, fed=False)
    assert guarded.controller.runtime_state == RuntimeState.STOPPED


def test_a_speed_beyond_the_arms_is_refused_and_latched() -> None:
    guarded = Guarded()
    guarded.speed([0, 0, 0, 0, 0, -3.2], 5)
    assert guarded.says == TOO_FAST
    assert not guarded.qd.any()
    assert guarded.controller.safety_mode == SafetyMode.NORMAL


def test_a_joint_move_goes_its_long_way_and_speeds_do_not_mix_into_it() -> None:
    guarded = Guarded()
    goal = np.array(HOME) + np.array([0.2, 0, 0, 0, 0, 0])
    guarded.once(MOVE_J, [*goal, 1.0, 3.0])
    assert guarded.controller.outputs.integers[guarded.base + 2] & 0x8000
    guarded.frames(600)
    assert guarded.controller.arm.q == pytest.approx(goal)
    assert not guarded.controller.outputs.integers[guarded.base + 2] & 0x8000
    guarded.once(MOVE_J, [*HOME, 1.0, 3.0])
    guarded.speed([0, 0, 0, 0, 0, 0.1], 60)
    assert guarded.says == MIXED
    assert not guarded.qd.any()


def test_a_move_under_way_is_stopped_by_speed_stop() -> None:
    guarded = Guarded()
    guarded.once(MOVE_J, [*(np.array(HOME) + 0.5), 1.0, 3.0])
    guarded.frames(60)
    assert np.abs(guarded.qd).max() > 0.1
    guarded.once(SPEED_STOP, [5.0], frames=120)
    assert not guarded.qd.any()
    assert guarded.says == OBEYING


def test_a_line_move_ends_at_its_pose() -> None:
    guarded = Guarded()
    pose = guarded.controller.arm.tool_pose()
    pose[2] -= 0.02
    guarded.once(MOVE_L, [*pose, 0.1, 1.0])
    guarded.frames(300)
    assert guarded.controller.arm.tool_pose() == pytest.approx(pose, abs=1e-6)


def test_the_tcp_is_zero_after_the_start_and_can_be_set_and_read_back() -> None:
    controller = Controller(load_arm(), np.array(HOME), parse_version("5.21"))
    controller.set_tcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    controller.submit(guard_script(True))
    for _ in range(5):
        controller.step()
    assert controller.tcp_offset == [0.0] * 6
    guarded = Guarded()
    guarded.once(TCP, [0.01, 0.02, 0.03, 0.0, 0.0, 0.0])
    guarded.once(TCP_BACK)
    for first in (24, 37):  # where ur_rtde looks, and where our own reader does
        read_back = guarded.controller.outputs.doubles[first : first + 6]
        assert read_back == pytest.approx([0.01, 0.02, 0.03, 0.0, 0.0, 0.0])
    guarded.once(PAYLOAD, [1.4, 0.03, 0.0, 0.05])
    assert guarded.controller.payload.mass == pytest.approx(1.4)


def test_the_program_ends_when_it_is_told_to_and_the_arm_is_braked_first() -> None:
    guarded = Guarded()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 50)
    guarded.write(STOP)
    guarded.frames(60)
    assert guarded.controller.runtime_state == RuntimeState.STOPPED
    assert not guarded.qd.any()
    assert guarded.answer == 0
    assert "weldcal guard: ended" in "\n".join(guarded.controller.log)
