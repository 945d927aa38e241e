"""The guard script in the emulated controller, frame by frame and without a wire: what it obeys, refuses and stops."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.robot import guard_script, same_payload
from weldcal.systems.drivers.ur.set_points import Level
from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.controller.registers import RuntimeState, SafetyMode
from weldcal.tools.emulators.ur.main import HOME
from weldcal.tools.emulators.ur.versions import parse_version

OBEYING, STALE, TOO_FAST, SILENT = 1, 2, 4, 5
MOVE_J, MOVE_L, SPEED_J, SPEED_STOP, PAYLOAD, TCP, STOP = 1, 3, 9, 15, 17, 29, 255


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
    def lost_s(self) -> float:
        return self.controller.outputs.doubles[self.word + 1]

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


def code_of(text: str) -> str:
    """A script without its comments."""
    return "\n".join(line.partition("#")[0] for line in text.splitlines())


def called(text: str) -> set[str]:
    """Names that a script calls and does not define."""
    code = code_of(text)
    own = set(re.findall(r"\bdef\s+(\w+)", code))
    return set(re.findall(r"\b([A-Za-z_]\w*)\s*\(", code)) - own - {"and", "or", "not", "if", "elif", "while", "return"}


def test_the_guard_calls_only_what_its_documentation_lists() -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "guard_script.md").read_text(encoding="utf-8")
    section = text.partition("# What the guard script needs")[2].partition("\nThere are no threads")[0]
    rows = [row.split("|")[1] for row in section.splitlines() if row.startswith("| `")]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    digital, analog = ({name for name in listed if kind in name} for kind in ("digital", "analog"))
    levels = [Level(0, True, 0.4), Level(1, False, 0.5)]
    assert called(guard_script(True, 3, levels=levels)) == called(guard_script(False, 3, levels=levels)) == listed
    assert called(guard_script(True, 3)) == listed - analog
    assert called(guard_script(True)) == listed - digital - analog
    assert "global domain0 = 1" in guard_script(True, 3, levels=levels)
    assert "global domain1 = 0" in guard_script(True, 3, levels=levels)
    assert not {"thread", "run", "kill", "enter_critical"} & set(re.findall(r"\w+", code_of(guard_script(True, 3))))


def test_a_command_that_an_earlier_program_left_is_refused() -> None:
    guarded = Guarded(stale=SPEED_J)
    guarded.frames(50)
    assert guarded.says == STALE
    assert guarded.controller.runtime_state == RuntimeState.STOPPED
    assert not guarded.qd.any()


def test_numbers_that_come_late_slow_the_arm_and_the_next_one_gives_it_its_speed_back() -> None:
    guarded = Guarded()
    guarded.speed([0.0, 0.28, 0, 0, 0, 0], 50)
    found = []
    for _ in range(70):
        guarded.speed([0.0, 0.28, 0, 0, 0, 0], 1, numbered=False)
        found.append(guarded.qd[1])
    assert found[:6] == pytest.approx([0.28] * 6)  # 12 ms
    assert found[6:20] == pytest.approx([0.28 * k / 14 for k in range(13, -1, -1)])
    assert not any(found[19:])  # at rest from 40 ms on
    assert guarded.says == OBEYING
    assert guarded.lost_s == pytest.approx(0.002 * (13 * 0.5 + 51))
    guarded.speed([0.0, 0.28, 0, 0, 0, 0], 10)
    assert guarded.qd[1] == pytest.approx(0.28)
    assert guarded.says == OBEYING


def test_after_150_milliseconds_without_a_new_number_the_arm_brakes_for_good() -> None:
    guarded = Guarded()
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 50)
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 75, numbered=False)
    assert guarded.says == OBEYING
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 1, numbered=False)
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
    guarded.frames(21)
    assert not guarded.qd.any()
    guarded.frames(60)
    assert guarded.says == SILENT
    assert not guarded.qd.any()


def test_an_arm_that_stands_still_needs_no_deadman() -> None:
    guarded = Guarded()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 20)
    guarded.speed([0.0] * 6, 30)
    guarded.speed([0.0] * 6, 95, numbered=False)  # 190 ms without a word, less than the watchdog takes
    assert guarded.says == OBEYING
    guarded.speed([0.0, 0.1, 0, 0, 0, 0], 10)
    assert guarded.qd[1] == pytest.approx(0.1)


def test_a_silent_client_is_stopped_by_the_guards_own_watchdog() -> None:
    guarded = Guarded()
    guarded.frames(99, fed=False)
    assert guarded.controller.runtime_state == RuntimeState.PLAYING
    guarded.frames(5, fed=False)
    assert guarded.controller.runtime_state == RuntimeState.STOPPED


def test_a_speed_beyond_the_arms_is_refused_and_latched() -> None:
    guarded = Guarded()
    guarded.speed([0, 0, 0, 0, 0, -3.2], 5)
    assert guarded.says == TOO_FAST
    assert not guarded.qd.any()
    assert guarded.controller.safety_mode == SafetyMode.NORMAL


@pytest.mark.parametrize("command", [MOVE_J, MOVE_L, TCP])
def test_a_command_that_nothing_uses_is_answered_and_does_nothing(command: int) -> None:
    guarded = Guarded()
    before = guarded.controller.arm.q.copy()
    guarded.once(command, [*(np.array(HOME) + 0.2), 1.0, 3.0])
    guarded.frames(100)
    assert guarded.controller.arm.q.tolist() == before.tolist()
    assert guarded.controller.tcp_offset == [0.0] * 6
    assert guarded.says == OBEYING


def test_the_tcp_is_zero_after_the_start_and_the_payload_can_be_set() -> None:
    controller = Controller(load_arm(), np.array(HOME), parse_version("5.21"))
    controller.set_tcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    controller.submit(guard_script(True))
    for _ in range(5):
        controller.step()
    assert controller.tcp_offset == [0.0] * 6
    guarded = Guarded()
    guarded.once(PAYLOAD, [1.7, 0.03, 0.0, 0.05])
    assert guarded.controller.payload.mass == pytest.approx(1.7)


@pytest.mark.parametrize(
    ("mass", "cog", "same"),
    [
        (1.4, (0.03, 0.0, 0.05), True),
        (1.395, (0.0305, 0.0, 0.05), True),
        (1.2, (0.03, 0.0, 0.05), False),
        (1.4, (0.03, 0.0, 0.053), False),
    ],
)
def test_the_payload_that_is_read_back_must_be_the_one_that_was_set(
    mass: float, cog: tuple[float, ...], same: bool
) -> None:
    assert same_payload({"payload": mass, "payload_cog": cog}, 1.4, [0.03, 0.0, 0.05]) == same
    assert not same_payload({"payload": mass}, 1.4, [0.03, 0.0, 0.05])


FAST = [0.5, 0.3, 0.0, 0.0, 0.0, -0.4]


@pytest.mark.parametrize("unread", [0, 1, 2])
@pytest.mark.parametrize("stop", ["pause", "protective stop"])
def test_play_after_a_pause_moves_nothing_while_no_new_number_comes(unread: int, stop: str) -> None:
    guarded = Guarded()
    guarded.speed(FAST, 50)
    if stop == "pause":
        guarded.controller.pause_program()
    else:
        guarded.controller.protective_stop("injected")
    for _ in range(unread):  # the computer dies only now: these are read after the resume
        guarded.speed(FAST, 1)
    guarded.frames(3000, fed=False)
    assert guarded.controller.runtime_state == RuntimeState.PAUSED
    guarded.controller.unlock_protective_stop()
    before = guarded.controller.arm.q.copy()
    assert guarded.controller.resume_program()
    guarded.frames(200, fed=False)
    assert guarded.controller.arm.q.tolist() == before.tolist()
    assert guarded.controller.runtime_state == RuntimeState.STOPPED


def test_after_a_pause_the_arm_moves_again_with_the_next_number() -> None:
    guarded = Guarded()
    guarded.speed(FAST, 50)
    guarded.controller.pause_program()
    guarded.frames(100)
    guarded.controller.resume_program()
    guarded.frames(10)
    assert not guarded.qd.any()
    assert guarded.says == OBEYING
    guarded.speed(FAST, 20)
    assert guarded.qd == pytest.approx(FAST)


def test_a_pause_in_the_first_frames_of_a_motion_is_worth_less_than_half_a_milliradian() -> None:
    # the arm's own speed does not show the pause yet: only a number just read moves it, for two frames
    for frames in (1, 2, 3):
        guarded = Guarded()
        guarded.speed([0.0] * 6, 20)
        guarded.speed(FAST, frames)
        guarded.controller.pause_program()
        guarded.speed(FAST, 1)
        guarded.frames(300, fed=False)
        before = guarded.controller.arm.q.copy()
        guarded.controller.resume_program()
        guarded.frames(200, fed=False)
        assert np.abs(guarded.controller.arm.q - before).max() < 5e-4


def test_a_stream_that_turns_speeds_up_and_stops_is_never_taken_for_a_pause() -> None:
    guarded = Guarded()
    rng = np.random.default_rng(3)
    qd = np.zeros(6)
    for _ in range(2000):  # numbers every 4 ms, the arm's full acceleration in every direction, at rest now and then
        goal = rng.uniform(-1.0, 1.0, 6) * rng.choice([0.0, 0.05, 0.5])
        qd = qd + np.clip(goal - qd, -0.06, 0.06)
        guarded.speed(qd.tolist(), 1)
        guarded.speed(qd.tolist(), 1, numbered=False)
    assert guarded.lost_s <= 0.01  # of 8 s; a false alarm costs the wait for one number
    assert guarded.says == OBEYING


def test_the_program_ends_when_it_is_told_to_and_the_arm_is_braked_first() -> None:
    guarded = Guarded()
    guarded.speed([0.1, 0, 0, 0, 0, 0], 50)
    guarded.write(STOP)
    guarded.frames(60)
    assert guarded.controller.runtime_state == RuntimeState.STOPPED
    assert not guarded.qd.any()
    assert guarded.answer == 0
