"""What stops the arm, and what does not: one sample and one command made by hand for each fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from weldcal.systems.drivers.ur.faults import SENTENCES, Fault, sentence
from weldcal.systems.drivers.ur.supervisor import (
    ACTIONS,
    BLIND_COMMANDS,
    COMMAND_S,
    NORMAL,
    OBEYING,
    PAUSED,
    PLAYING,
    PROTECTIVE,
    RECOVERY,
    REDUCED,
    ROBOT_EMERGENCY,
    RUNNING,
    SAFEGUARD,
    SYSTEM_EMERGENCY,
    Action,
    Decision,
    Limits,
    RobotSample,
    Supervisor,
    VelocityCommand,
)

PERIOD_S = 0.004
COMMAND_PERIOD_S = 0.008
STOPPED, STOPPING = 1, 0
LIMITS = Limits(
    position_lower=np.full(6, -6.0),
    position_upper=np.full(6, 6.0),
    speed=np.full(6, 1.2),
    acceleration=np.full(6, 15.0),
)
VELOCITY = np.array([0.1, 0.0, -0.05, 0.0, 0.0, 0.1])


class Rig:
    """A supervisor at 250 Hz, an arm that follows its commands, a cell that gives one every 8 ms; `lag_s` is the
    arm's."""

    def __init__(self, limits: Limits = LIMITS, velocity: np.ndarray = VELOCITY, *, process: bool = False) -> None:
        self.supervisor = Supervisor(limits)
        self.now, self.velocity, self.lag_s = 1000.0, velocity, 0.0
        self.pace = limits.pace
        self._led = np.zeros(6)
        self.robot = RobotSample(
            robot_time=100.0,
            fresh_at=self.now,
            q=np.zeros(6),
            qd=velocity,
            robot_mode=RUNNING,
            safety_mode=NORMAL,
            runtime_state=PLAYING,
            speed_scaling=1.0,
            guard=OBEYING,
            connected=True,
        )
        self.command = VelocityCommand(number=1, given_at=self.now, qd=velocity, process=process)

    def passes(self, seconds: float, *, state: bool = True, commands: bool = True) -> Decision:
        """So long with or without new states and commands; the last decision."""
        decision = Decision(Action.SEND)
        for _ in range(round(seconds / PERIOD_S)):
            decision = self.one(state=state, commands=commands)
        return decision

    def one(self, *, state: bool = True, commands: bool = True, **changes: object) -> Decision:
        """One pass; `changes` are of the sample."""
        self.now += PERIOD_S
        self._led = self._led + self.pace * PERIOD_S * self.velocity
        if state:
            share = 1.0 if self.lag_s == 0.0 else PERIOD_S / (PERIOD_S + self.lag_s)
            q = self.robot.q + share * (self._led - self.robot.q)
            time = self.robot.robot_time + self.pace * PERIOD_S
            self.robot = replace(self.robot, robot_time=time, fresh_at=self.now, q=q)
        if commands and self.now - self.command.given_at > COMMAND_PERIOD_S - 1e-6:
            self.command = replace(self.command, number=self.command.number + 1, given_at=self.now, qd=self.velocity)
        return self.supervisor.step(self.now, replace(self.robot, **changes), self.command)  # type: ignore[arg-type]

    def told(self, qd: np.ndarray) -> Decision:
        """One pass with a new command."""
        self.command = VelocityCommand(number=self.command.number + 1, given_at=self.now + PERIOD_S, qd=qd)
        return self.one(commands=False)


@pytest.fixture
def rig() -> Rig:
    """Moving since half a second, nothing wrong."""
    made = Rig()
    assert made.passes(0.5) == Decision(Action.SEND)
    return made


# sample -> fault, one line each
OF_THE_SAMPLE = [
    ({"connected": False}, Fault.LINK_CLOSED),
    ({"robot_time": 50.0}, Fault.CLOCK_JUMPED),
    ({"robot_time": 150.0}, Fault.CLOCK_JUMPED),
    ({"q": np.full(6, 0.5)}, Fault.STATE_IMPLAUSIBLE),
    ({"q": np.full(6, np.nan)}, Fault.STATE_IMPLAUSIBLE),
    ({"not_finite": "speed_scaling"}, Fault.STATE_NOT_FINITE),
    ({"unheard_s": 0.201}, Fault.CONTROLLER_DEAF),
    ({"guard_silent_s": 0.081}, Fault.CONTROLLER_DEAF),
    ({"safety_mode": PROTECTIVE}, Fault.PROTECTIVE_STOP),
    ({"safety_mode": RECOVERY}, Fault.RECOVERY_MODE),
    ({"safety_mode": SAFEGUARD}, Fault.SAFEGUARD_STOP),
    ({"safety_mode": SYSTEM_EMERGENCY}, Fault.EMERGENCY_STOP),
    ({"safety_mode": ROBOT_EMERGENCY}, Fault.EMERGENCY_STOP),
    ({"safety_mode": 8}, Fault.SAFETY_VIOLATION),
    ({"safety_mode": 9}, Fault.SAFETY_VIOLATION),
    ({"safety_mode": 11}, Fault.SAFETY_VIOLATION),  # a mode that nobody has heard of
    ({"robot_mode": 3}, Fault.ROBOT_NOT_RUNNING),
    ({"robot_mode": 5}, Fault.ROBOT_NOT_RUNNING),
    ({"runtime_state": STOPPED}, Fault.PROGRAM_STOPPED),
    ({"runtime_state": STOPPING}, Fault.PROGRAM_STOPPED),
    ({"runtime_state": PAUSED}, Fault.PROGRAM_PAUSED),
    ({"guard": 3}, Fault.GUARD_LATCHED),
    ({"guard": 0}, Fault.GUARD_LATCHED),
    ({"robot_mode": 7 ^ 0xFF}, Fault.STATE_DAMAGED),  # a byte with all bits turned
    ({"robot_mode": -16777209}, Fault.STATE_DAMAGED),
    ({"safety_mode": 1 ^ 0xFF}, Fault.STATE_DAMAGED),
    ({"runtime_state": -3}, Fault.STATE_DAMAGED),
]


@pytest.mark.parametrize(("changes", "fault"), OF_THE_SAMPLE, ids=lambda value: str(value))
def test_a_sample_that_is_not_as_it_must_be_is_a_fault(rig: Rig, changes: dict[str, object], fault: Fault) -> None:
    decision = rig.one(**changes)  # type: ignore[arg-type]
    assert decision.fault is fault
    assert decision.action is ACTIONS[fault]


def test_another_tcp_shows_in_two_states_and_a_damaged_byte_in_one(rig: Rig) -> None:
    assert rig.one(pose_error_m=6e-5).fault is Fault.NONE
    assert rig.one(state=False, pose_error_m=6e-5).fault is Fault.NONE, "the same state again"
    assert rig.one().fault is Fault.NONE
    assert rig.one(pose_error_m=6e-5).fault is Fault.NONE
    assert rig.one(pose_error_m=6e-5) == Decision(Action.BRAKE, Fault.POSE_MISMATCH, pytest.approx(0.06))


def test_in_lockstep_a_controller_that_waited_has_not_jumped(rig: Rig) -> None:
    """Its time stood still for 0.7 s of the host's; a time that goes back is a fault even so."""
    patient = Supervisor(LIMITS.in_lockstep())
    for supervisor, fault in ((rig.supervisor, Fault.CLOCK_JUMPED), (patient, Fault.NONE)):
        resting = VelocityCommand(number=rig.command.number, given_at=rig.now, qd=np.zeros(6))
        supervisor.step(rig.now, rig.robot, resting)
        later = replace(rig.robot, robot_time=rig.robot.robot_time + 0.002, fresh_at=rig.now + 0.7)
        assert supervisor.step(rig.now + 0.7, later, replace(resting, given_at=rig.now + 0.7)).fault is fault
    earlier = replace(later, robot_time=rig.robot.robot_time - 1.0, fresh_at=rig.now + 0.71)
    assert patient.step(rig.now + 0.71, earlier, resting).fault is Fault.CLOCK_JUMPED


COMMANDS = [
    (np.full(6, np.nan), Fault.COMMAND_NOT_FINITE),
    (np.array([np.inf, 0, 0, 0, 0, 0]), Fault.COMMAND_NOT_FINITE),
    (np.array([0, 0, 0, 0, -1.3, 0]), Fault.COMMAND_TOO_FAST),
    # 15 rad/s^2 for the 8 ms between two commands and 20 ms on top
    (VELOCITY + np.array([0, 0.5, 0, 0, 0, 0]), Fault.COMMAND_JUMPED),
]


@pytest.mark.parametrize(("qd", "fault"), COMMANDS, ids=lambda value: getattr(value, "name", None))
def test_a_command_that_no_cell_gives_is_refused_and_the_arm_brakes(rig: Rig, qd: np.ndarray, fault: Fault) -> None:
    decision = rig.told(qd)
    assert (decision.action, decision.fault) == (Action.BRAKE, fault)


@pytest.mark.parametrize(("process", "limit_s"), [(True, 0.04), (False, 0.08)])
def test_a_state_that_stays_the_same_is_stale_earlier_under_a_burning_torch(process: bool, limit_s: float) -> None:
    rig = Rig(process=process)
    rig.one()
    assert rig.passes(limit_s - 0.004, state=False) == Decision(Action.SEND)
    decision = rig.passes(0.012, state=False)
    assert (decision.action, decision.fault) == (Action.LEAVE, Fault.LINK_STALE)
    assert 1e3 * limit_s < decision.detail < 1e3 * limit_s + 5.0


def test_states_without_a_gap_that_come_ever_later_after_their_commands_are_stale(rig: Rig) -> None:
    for _ in range(24):  # once late, by a computer that stood still
        assert rig.one(unheard_s=0.12) == Decision(Action.SEND)
    assert rig.one(unheard_s=0.01) == Decision(Action.SEND)
    decisions = [rig.one(unheard_s=0.12) for _ in range(30)]
    assert decisions[24] == Decision(Action.SEND)
    assert decisions[-1] == Decision(Action.LEAVE, Fault.LINK_STALE, 120.0)
    assert "120 ms old" in sentence(decisions[-1].fault, decisions[-1].detail)


def test_states_70_ms_after_their_commands_are_slow_and_no_fault(rig: Rig) -> None:
    assert all(rig.one(unheard_s=0.07) == Decision(Action.SEND) for _ in range(100))


@pytest.mark.parametrize(("process", "limit_s"), [(True, 0.05), (False, 0.5)])
def test_a_command_that_grows_old_brakes_a_burning_torch_at_once_and_an_arm_that_was_slowed_to_rest_later(
    process: bool, limit_s: float
) -> None:
    rig = Rig(process=process)
    assert rig.passes(limit_s - 0.006, commands=False) == Decision(Action.SEND)
    decision = rig.passes(0.016, commands=False)
    assert (decision.action, decision.fault) == (Action.BRAKE, Fault.COMMAND_LATE)


def test_a_cell_that_commands_rest_may_think_as_long_as_it_likes() -> None:
    rig = Rig(velocity=np.zeros(6))
    assert rig.passes(0.1) == Decision(Action.SEND)
    assert rig.passes(30.0, commands=False) == Decision(Action.SEND)


def test_a_torch_that_went_off_because_the_cell_was_silent_at_rest_stays_off() -> None:
    rig = Rig(velocity=np.zeros(6), process=True)
    assert rig.passes(0.04, commands=False) == Decision(Action.SEND)
    assert rig.passes(0.02, commands=False).fault is Fault.COMMAND_LATE
    assert rig.passes(1.0).action is Action.BRAKE


def test_after_a_long_thought_the_arm_may_be_ramped_up_and_not_jerked() -> None:
    # 15 rad/s^2 for one pass and 20 ms on top
    for first, fault in ((0.3, Fault.NONE), (0.4, Fault.COMMAND_JUMPED)):
        rig = Rig(velocity=np.zeros(6))
        rig.passes(5.0, commands=False)
        assert rig.told(np.full(6, first)).fault is fault


def test_a_slow_slider_for_a_few_passes_is_no_fault(rig: Rig) -> None:
    for _ in range(12):
        assert rig.one(speed_scaling=0.9) == Decision(Action.SEND)
    assert rig.one() == Decision(Action.SEND)
    for _ in range(12):
        assert rig.one(speed_scaling=0.9) == Decision(Action.SEND)


def test_a_slider_that_stays_slow_is_a_fault(rig: Rig) -> None:
    decisions = [rig.one(speed_scaling=0.5) for _ in range(15)]
    assert decisions[0] == Decision(Action.SEND)
    assert decisions[-1] == Decision(Action.BRAKE, Fault.SPEED_SLIDER, 50.0)


def test_a_slider_is_judged_while_the_arm_is_to_move() -> None:
    rig = Rig(velocity=np.zeros(6))
    assert all(rig.one(speed_scaling=0.5) == Decision(Action.SEND) for _ in range(50))  # ramps up when a program starts
    rig.velocity = VELOCITY
    assert [rig.one(speed_scaling=0.5) for _ in range(15)][-1].fault is Fault.SPEED_SLIDER


ON = {"process_on": True, "process_asked": True}


def test_an_output_that_goes_on_without_being_asked_for_is_a_fault_in_the_first_sample(rig: Rig) -> None:
    assert rig.one(process_on=False) == Decision(Action.SEND)
    rig.passes(0.1)
    decision = rig.one(process_on=True)
    assert decision == Decision(Action.BRAKE, Fault.PROCESS_OUTPUT, 1.0)
    assert "went on" in sentence(decision.fault, decision.detail)


def test_an_output_that_goes_off_unasked_is_a_fault_once_the_guard_would_have_said_so(rig: Rig) -> None:
    for _ in range(25):
        assert rig.one(**ON) == Decision(Action.SEND)  # type: ignore[arg-type]
    decisions = [rig.one(process_on=False, process_asked=True) for _ in range(15)]
    assert decisions[12] == Decision(Action.SEND)  # 48 ms
    assert decisions[-1] == Decision(Action.BRAKE, Fault.PROCESS_OUTPUT, 0.0)
    assert "is off" in sentence(decisions[-1].fault, decisions[-1].detail)


def test_an_output_that_stays_on_after_its_end_is_a_fault_once_it_should_have_followed(rig: Rig) -> None:
    for _ in range(25):
        assert rig.one(**ON) == Decision(Action.SEND)  # type: ignore[arg-type]
    decisions = [rig.one(process_on=True, process_asked=False) for _ in range(8)]
    assert decisions[4] == Decision(Action.SEND)  # 16 ms after the first sample without the wish
    assert decisions[-1] == Decision(Action.BRAKE, Fault.PROCESS_OUTPUT, 1.0)


def test_an_output_that_follows_its_command_some_frames_later_is_none(rig: Rig) -> None:
    for k in range(100):  # on and off, each for 0.1 s, shown 16 ms later
        assert rig.one(process_asked=k % 50 < 25, process_on=(k - 4) % 50 < 25 and k >= 4) == Decision(Action.SEND)


def test_an_arm_that_the_guard_slows_is_where_it_is_expected() -> None:
    for told, fault in ((True, Fault.NONE), (False, Fault.TRACKING)):
        rig = Rig(velocity=np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        rig.passes(0.3)
        decision, start_s, lost_s = Decision(Action.SEND), rig.now, 0.0
        while rig.now < start_s + 0.2:  # it stands still for the second tenth of a second
            if rig.now > start_s + 0.1:
                lost_s += PERIOD_S
                rig._led = rig._led - PERIOD_S * rig.velocity
            decision = rig.one(lost_s=lost_s if told else 0.0)
        assert decision.fault is fault


def test_reduced_mode_goes_on(rig: Rig) -> None:
    assert all(rig.one(safety_mode=REDUCED) == Decision(Action.SEND) for _ in range(50))


def test_the_first_fault_stays(rig: Rig) -> None:
    first = rig.one(safety_mode=PROTECTIVE)
    assert first.fault is Fault.PROTECTIVE_STOP
    assert rig.one(safety_mode=ROBOT_EMERGENCY) == first
    assert rig.passes(1.0) == first, "also when everything is well again"
    assert rig.told(np.zeros(6)) == first
    assert rig.supervisor.latched == first


@pytest.mark.parametrize("later", [{"connected": False}, {"robot_time": 50.0}], ids=["closed", "clock"])
def test_a_link_that_breaks_while_the_arm_brakes_is_left_under_the_first_fault(
    rig: Rig, later: dict[str, object]
) -> None:
    decision = rig.told(np.full(6, np.nan))
    assert decision.action is Action.BRAKE
    rig.command = replace(rig.command, qd=VELOCITY)
    assert rig.one(commands=False).action is Action.BRAKE
    assert rig.one(commands=False, **later) == replace(decision, action=Action.LEAVE)  # type: ignore[arg-type]
    assert rig.one() == replace(decision, action=Action.LEAVE)


def test_a_link_that_falls_silent_while_the_program_is_stopped_is_left(rig: Rig) -> None:
    assert rig.one(runtime_state=STOPPED).action is Action.STOP
    assert rig.passes(0.1, state=False) == Decision(Action.LEAVE, Fault.PROGRAM_STOPPED, float(STOPPED))


@pytest.mark.parametrize("end", [{"stop": True}, {"orphaned": True}], ids=["stop", "orphaned"])
def test_the_end_of_the_cell_brakes_the_arm_and_is_no_fault(rig: Rig, end: dict[str, bool]) -> None:
    rig.command = replace(rig.command, **end)  # type: ignore[arg-type]
    assert rig.passes(0.2, commands=False) == Decision(Action.BRAKE)


def test_a_fault_after_the_end_is_still_told(rig: Rig) -> None:
    rig.command = replace(rig.command, stop=True)
    assert rig.one() == Decision(Action.BRAKE)
    assert rig.one(connected=False).action is Action.LEAVE


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_brakes_before_its_limit(sign: float) -> None:
    near = 5.9  # at 1 rad/s: 0.1 to brake at 5 rad/s^2, 0.05 under way, 0.02 to spare
    rig = Rig(velocity=sign * np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    rig.robot = replace(rig.robot, q=sign * np.array([0.0, 0.0, 0.0, 0.0, 0.0, near]))
    rig._led = rig.robot.q.copy()
    decision = rig.one()
    assert decision == Decision(Action.BRAKE, Fault.JOINT_LIMIT, 6.0)


def test_a_joint_at_its_limit_may_leave_it() -> None:
    rig = Rig(velocity=np.array([0.0, -0.5, 0.0, 0.0, 0.0, 0.0]))
    rig.robot = replace(rig.robot, q=np.array([0.0, 5.99, 0.0, 0.0, 0.0, 0.0]))
    rig._led = rig.robot.q.copy()
    assert rig.passes(0.2) == Decision(Action.SEND)


def test_an_arm_that_is_held_is_seen(rig: Rig) -> None:
    held = rig.robot.q
    decisions = [rig.one(q=held) for _ in range(125)]
    assert decisions[-1].fault is Fault.TRACKING
    # 0.1 rad/s lead 0.014 rad off, which is allowed, in 0.14 s, and later where the reference forgets
    seen_s = PERIOD_S * sum(decision.fault is Fault.NONE for decision in decisions)
    assert 0.14 < seen_s < 0.3


def test_an_arm_that_follows_half_a_second_late_is_seen(rig: Rig) -> None:
    rig.lag_s = 0.5
    assert rig.passes(1.0).fault is Fault.TRACKING


@pytest.mark.parametrize("lag_s", [0.02, 0.04])
def test_an_arm_that_follows_as_late_as_a_network_is_not_accused(lag_s: float) -> None:
    rig = Rig()
    rig.lag_s = lag_s
    for k in range(500):
        # to and fro at 1 rad/s and 5 rad/s^2
        wave = np.sin(5.0 * PERIOD_S * k)
        rig.velocity = np.array([wave, 0.0, 0.5 * wave, 0.0, 0.0, -wave])
        assert rig.one() == Decision(Action.SEND)


def test_a_power_sources_fault_ends_the_weld_and_says_nothing_while_no_torch_is_asked_for() -> None:
    assert Rig(process=False).one(arc_fault=True) == Decision(Action.SEND)
    rig = Rig(process=True)
    assert rig.one() == Decision(Action.SEND)
    found = rig.one(arc_fault=True)
    assert (found.action, found.fault) == (Action.BRAKE, Fault.ARC_FAULT)
    assert rig.one().fault is Fault.ARC_FAULT, "latched"


def test_a_set_point_that_its_output_does_not_show_is_a_fault_and_a_late_output_is_none() -> None:
    rig = Rig(process=True)
    right, wrong = {"set_points": ((0.4, 0.405), (0.0, 0.0))}, {"set_points": ((0.4, 0.4), (0.0, 0.5))}
    assert rig.one(**right) == Decision(Action.SEND)
    assert all(rig.one(**wrong) == Decision(Action.SEND) for _ in range(13))
    assert rig.one(**right) == Decision(Action.SEND)
    found = [rig.one(**wrong) for _ in range(14)]
    assert {decision.action for decision in found[:-1]} == {Action.SEND}
    assert (found[-1].action, found[-1].fault, found[-1].detail) == (Action.BRAKE, Fault.SET_POINT, 50.0)
    changed = Rig()
    assert [changed.one(set_points=((0.0, np.nan),)) for _ in range(14)][-1].fault is Fault.SET_POINT, "another range"


def test_an_arc_that_nothing_asks_for_is_a_fault_once_the_last_one_has_had_time_to_end() -> None:
    def readings(arc: list[bool], torch: list[bool]) -> list[bool]:
        """Whether each pass of 4 ms is sent, for an input and a torch of these levels."""
        rig = Rig(process=True)
        found = []
        for lit, on in zip(arc, torch, strict=True):
            rig.command = replace(rig.command, process=on)
            decision = rig.one(arc=lit, process_on=on, process_asked=on)
            assert decision.fault in (Fault.NONE, Fault.ARC_INPUT)
            found.append(decision.action is Action.SEND)
        return found

    def passes(seconds: float) -> int:
        return round(seconds / PERIOD_S)

    off, burns = [False] * passes(0.2), [True] * passes(0.2)
    assert all(readings([False, True, True] * 50, [False] * 150)), "a glitch of 8 ms"
    assert readings([*off, *burns], [False] * 2 * len(off)).count(False) == len(burns) - 3, "10 ms later"
    ends = [True] * passes(0.9) + [False] * passes(0.5)
    assert all(readings([*off, *burns, *ends], [*off, *burns, *[False] * len(ends)])), (
        "an arc may end later than its torch"
    )
    sticks = [True] * passes(1.2)
    found = readings([*burns, *sticks], [*burns, *[False] * len(sticks)])
    assert found.index(False) == pytest.approx(len(burns) + passes(1.0), abs=2)
    comes_back = [False] * 5 + [True] * 10
    assert not all(readings([*burns, *comes_back], [*burns, *[False] * 15])), "it does not come back by itself"


def test_a_slow_controller_has_longer_deadlines_by_its_own_clock() -> None:
    rig = Rig(LIMITS.slowed(0.25))
    assert rig.passes(2.0) == Decision(Action.SEND)
    assert rig.passes(0.31, state=False, commands=False) == Decision(Action.SEND)
    assert rig.passes(0.02, state=False, commands=False).fault is Fault.LINK_STALE


def test_a_followed_controller_is_judged_by_the_commands_that_it_lets_pass_and_not_by_the_host() -> None:
    slow = Rig(LIMITS.following())
    assert slow.passes(20.0, state=False, commands=False) == Decision(Action.SEND), "neither goes on"
    rig = Rig(LIMITS.following())
    assert rig.passes(1.0) == Decision(Action.SEND)
    found = [rig.one(state=False) for _ in range(60)]
    named = [decision.fault for decision in found]
    assert named.index(Fault.LINK_STALE) == pytest.approx(2 * BLIND_COMMANDS, abs=2), "a command in every second pass"
    assert found[-1].detail == pytest.approx(1e3 * COMMAND_S * (BLIND_COMMANDS + 1))


def test_every_fault_has_a_sentence_and_those_of_the_worker_an_action() -> None:
    assert set(SENTENCES) == set(Fault) - {Fault.NONE}
    assert all(sentence(fault, 1.0).endswith(".") for fault in SENTENCES)
    seen = {fault for _, fault in OF_THE_SAMPLE} | {fault for _, fault in COMMANDS}
    seen |= {Fault.LINK_STALE, Fault.COMMAND_LATE, Fault.SPEED_SLIDER, Fault.JOINT_LIMIT, Fault.TRACKING}
    seen |= {Fault.PROCESS_OUTPUT, Fault.ARC_FAULT, Fault.ARC_INPUT, Fault.SET_POINT, Fault.POSE_MISMATCH}
    of_the_start = {fault for fault in Fault if fault >= Fault.GUARD_REFUSED}
    assert seen == set(Fault) - of_the_start - {Fault.NONE, Fault.WORKER_DIED}, "every fault is tested here"
    assert seen <= set(ACTIONS)


def test_an_arm_at_a_limit_may_leave_it_and_not_go_on() -> None:
    """Within the margin of its limits, as an operator may have left it."""
    for q, way in ((-5.99, 1.0), (5.99, -1.0)):
        for sign, fault in ((1.0, Fault.NONE), (-1.0, Fault.JOINT_LIMIT)):
            rig = Rig(velocity=sign * way * np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))
            rig.robot = replace(rig.robot, q=np.array([q, 0.0, 0.0, 0.0, 0.0, 0.0]))
            rig._led = rig.robot.q
            assert rig.passes(0.05).fault is fault
