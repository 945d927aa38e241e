"""Paces the Diagram by the wall clock.

Waits while it is ahead, slows the path while it is late, counts how late each tick was.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

KEPT = 8192  # corners of the course: 16 s of a rate that changes with every tick, and hours of one that does not


class LostTime:
    """The course of the time lost over a clock, both s, as a line through corners.

    Flat while the Diagram keeps its pace.

    A device with a clock of its own goes on while the Diagram stands. What the Diagram knows by its own time, such as
    where the arm was, is paired with the device's time less the time lost by then.
    """

    def __init__(self) -> None:
        self._corners: deque[tuple[float, float]] = deque(maxlen=KEPT)

    @property
    def newest(self) -> float:
        """The time lost so far, s."""
        return self._corners[-1][1] if self._corners else 0.0

    def reach(self, clock_s: float, lost_s: float = 0.0) -> None:
        """The clock has come to `clock_s`, and since the last call the Diagram has lost `lost_s` more, evenly."""
        corners, total = self._corners, self.newest + lost_s
        if len(corners) > 1 and corners[-2][1] == corners[-1][1] == total:
            corners.pop()
        corners.append((clock_s, total))

    def at(self, clock_s: float) -> float:
        """Return the time lost by a time of the clock, s.

        Before the first corner that is kept as at it, after the newest as at that.
        """
        later: tuple[float, float] | None = None
        for t, lost in reversed(self._corners):
            if t <= clock_s:
                return lost if later is None else lost + (later[1] - lost) * (clock_s - t) / (later[0] - t)
            later = t, lost
        return 0.0 if later is None else later[1]


LATE_S = 0.020  # of robot time: a longer delay is not made up for
LIMITS_MS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # upper limits of the histogram's bins; the last bin has none
ON_TIME_MS = 4.0  # one period of the commands, and a limit of the histogram's bins
# The path's rate falls from 1 at SLOW_FROM_S late by 1 per SLOW_SPAN_S, no faster than FALL_PER_S, and rises by
# RISE_PER_S. A computer that manages half of the rate then settles 4 ms late, within one period of the commands.
SLOW_FROM_S, SLOW_SPAN_S = 0.0015, 0.005
FALL_PER_S, RISE_PER_S = 25.0, 2.0  # moves are at most 1 rad/s: a fall adds 25 rad/s^2 to them, and the link allows 40
SLOWEST = 0.1  # a choice: above zero, so that a late computer still ends its job, in at most ten times as long
# The servo needs pictures and detections: where this computer makes them late the path is slowed too.
PICTURE_LATE_S, PICTURE_SPAN_S = 0.025, 0.100
# A robot that waits for its cell gives it time for a picture, too: each tick at most so long for one this old, and no
# longer in all.
PICTURE_DUE_S, PICTURE_STEP_S, PICTURE_PATIENCE_S = 0.150, 0.050, 2.0
# A robot that waits for this computer's next velocity does not move its time: go on after this time of the wall clock.
ROBOT_STANDS_S, ROBOT_LOOK_S = 0.100, 0.0005
STOPPED = 0.02  # the rate at which a held path stands: at 1 rad/s the arm stops within a step of the slew limit


@dataclass
class Lateness:
    """A histogram of how late velocities left the Diagram while the arm moved, in robot time.

    `delays`: from when to when (s of the host) those were waited for that were not on time.
    """

    counts: list[int] = field(default_factory=lambda: [0] * (len(LIMITS_MS) + 1))
    worst_ms: float = 0.0
    delays: list[tuple[float, float]] = field(default_factory=list)

    def add(self, late_ms: float, left_s: float | None = None) -> None:
        """Count one velocity; `left_s` is the host's time (s) at which it left."""
        if left_s is not None and late_ms >= ON_TIME_MS:
            self.delays.append((left_s - 1e-3 * late_ms, left_s))
        self.counts[sum(late_ms >= limit for limit in LIMITS_MS)] += 1
        self.worst_ms = max(self.worst_ms, late_ms)

    @property
    def on_time_percent(self) -> float:
        """Share of the velocities that were less than ON_TIME_MS late."""
        total = sum(self.counts)
        return 100.0 * sum(self.counts[: LIMITS_MS.index(ON_TIME_MS) + 1]) / total if total else 100.0

    def over(self, limit_ms: float) -> int:
        """How many were this late (one of LIMITS_MS) or later."""
        return sum(self.counts[LIMITS_MS.index(limit_ms) + 1 :])

    def summary(self) -> dict[str, object]:
        """The JSON object: limits and counts of the bins (one more than limits), the share on time, and the worst."""
        return {
            "limits_ms": list(LIMITS_MS),
            "velocities": list(self.counts),
            "under_4_ms_percent": self.on_time_percent,
            "worst_ms": self.worst_ms,
        }


class WallClock:
    """Advances the Diagram's time at `pace` seconds per second of the wall clock, or slower.

    `rate` is the Diagram's seconds per second of the robot. It is 1 on a computer that keeps up. On a late one it
    falls, and the driver scales each velocity by it: the path stays the same, and the arm follows it more slowly, as
    with the speed slider. A single delay of more than LATE_S is never made up for, because a robot executes commands
    when they arrive: the Diagram goes on from where it is. Lateness is in robot time: `late_s` is the maximum while the
    arm was commanded to move, `thinking_s` the maximum while it was at rest, where computing time is not limited.
    `reanchored` counts the delays of more than LATE_S during motion, and `lost_s` is their sum. `held`: an operator
    wants the path to stand still.
    """

    def __init__(
        self, pace: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self.pace, self._clock, self._sleep = pace, clock, sleep
        self.follows = False  # see following
        self._due = 0.0  # wall clock at which the Diagram's time is _at
        self._at: float | None = None
        self.rate, self.slowest_rate = 1.0, 1.0
        self.slowed_s = 0.0
        self.late_s = 0.0
        self.thinking_s = 0.0
        self.reanchored = 0
        self.lost_s = 0.0
        self.lateness = Lateness()
        self.held = False
        self._course = LostTime()
        self.waiting_s = 0.0  # wall seconds for which the oldest picture or detection has been waited for

    @classmethod
    def following(cls, robot_time: Callable[[], float]) -> "WallClock":
        """Return a clock that waits for the robot's own time (s), for an emulated robot that waits for this computer.

        Neither gets ahead of the other, however slow both are. The path is not slowed: a robot that waits loses
        nothing.
        """

        def wait(seconds: float) -> None:
            newest = robot_time()
            due, moved_at = newest + seconds, time.monotonic()
            while newest < due and time.monotonic() - moved_at < ROBOT_STANDS_S:
                time.sleep(ROBOT_LOOK_S)
                before, newest = newest, robot_time()
                moved_at = time.monotonic() if newest != before else moved_at

        found = cls(1.0, robot_time, wait)
        found.follows = True
        return found

    def now(self) -> float:
        """Time of the clock that is waited for: the host's, or the robot's that is followed."""
        return self._clock()

    @property
    def stands(self) -> bool:
        """Whether a held path has come to rest."""
        return self.held and self.rate <= STOPPED

    def go_on(self) -> None:
        """Let a held path go on: the time that it stood is no lateness."""
        self.held = False
        self._stand_until(self._clock())

    def wait_for(self, diagram_time: float, moving: bool) -> None:
        """Wait until the wall clock reaches this time of the Diagram. `moving`: the arm is commanded to move."""
        now = self._clock()
        if self._at is None:
            self._due, self._at = now, diagram_time
            self._course.reach(now)
        step = diagram_time - self._at
        taken = step / (self.pace * self.rate)
        self._due += taken
        self._course.reach(self._due, taken - step / self.pace if self.rate != 1.0 else 0.0)
        self._at = diagram_time
        late = (now - self._due) * self.pace
        self._set_rate(step, late, moving)
        if late <= 0.0:
            self._sleep(self._due - now)
            return
        if moving:
            self.late_s = max(self.late_s, late)
        else:
            self.thinking_s = max(self.thinking_s, late)
        if late > LATE_S:
            self._stand_until(now)
            self.reanchored += int(moving)
            self.lost_s += late if moving else 0.0

    def diagram_time(self, clock_s: float, now: float) -> float:
        """Return the Diagram's time (s) at a time of the clock that it waits for; `now` before it has waited.

        `now`, too, for what lies more than LATE_S ahead: the Diagram has stood, and will go on from where it is.
        """
        if self._at is None:
            return now
        if clock_s < self._due:
            lost = self._course.newest - self._course.at(clock_s)
            return self._at - (self._due - clock_s - lost) * self.pace
        found = self._at + (clock_s - self._due) * self.pace * self.rate
        return found if found - now <= LATE_S else now

    def lost_by(self, clock_s: float) -> float:
        """Seconds by which the Diagram had fallen behind its clock at an earlier time of it, since it began."""
        return self._course.at(clock_s)

    def _stand_until(self, clock_s: float) -> None:
        """The Diagram has stood until this time of the clock, and goes on from where it is."""
        if self._at is not None:
            self._course.reach(clock_s, clock_s - self._due)
        self._due = clock_s

    def overdue_s(self, diagram_time: float) -> float:
        """How late (s of robot time) a velocity of this time of the Diagram would leave it now.

        0 before the clock has waited.
        """
        if self._at is None:
            return 0.0
        due = self._due + (diagram_time - self._at) / (self.pace * self.rate)
        return max((self._clock() - due) * self.pace, 0.0)

    def velocity_leaves(self, late_s: float, moving: bool) -> None:
        """Count how late a velocity left the Diagram; one at rest is not counted."""
        if moving and self._at is not None:
            self.lateness.add(1e3 * late_s, self._clock())

    def _set_rate(self, step: float, late: float, moving: bool) -> None:
        wanted = min(max(1.0 - (late - SLOW_FROM_S) / SLOW_SPAN_S, SLOWEST), 1.0)
        # a single long delay says nothing about the rate that the computer can keep
        if not moving or late > LATE_S or self.follows:
            wanted = 1.0
        wanted = min(wanted, max(1.0 - (self.waiting_s - PICTURE_LATE_S) / PICTURE_SPAN_S, SLOWEST))
        if self.held:
            wanted = STOPPED
        robot_step = step / self.rate
        self.slowed_s += robot_step - step
        self.rate = min(max(wanted, self.rate - FALL_PER_S * robot_step), self.rate + RISE_PER_S * robot_step)
        if not self.held:
            self.slowest_rate = min(self.slowest_rate, self.rate)

    def summary(self) -> dict[str, object]:
        """Return the JSON values of a paced run."""
        found: dict[str, object] = {
            "late_ms": 1e3 * self.late_s,
            "thinking_ms": 1e3 * self.thinking_s,
            "reanchored": self.reanchored,
            "tick_lateness": self.lateness.summary(),
            "slowed_to_percent": 100.0 * self.slowest_rate,
            "slowed_s": self.slowed_s,
        }
        if (behind := self.sentence()) is not None:
            found["fell_behind"] = behind
        return found

    def sentence(self) -> str | None:
        """Return a warning where the run did not keep up with its robot; None where it did."""
        if not self.reanchored:
            return None
        times = "once" if self.reanchored == 1 else f"{self.reanchored} times"
        return (
            f"The computer fell behind the robot {times} while the arm moved, by {1e3 * self.lost_s:.0f} ms in all. "
            "The arm slowed down during that time, and the times of the run are too short by the same amount. "
            "Close other programs."
        )


class PictureWait:
    """Gives a loaded computer time to take a late picture where the robot waits for its cell.

    A camera that has stopped gets little of it.

    Picture and Diagram are late by the same computer, and only the Diagram is waited for by the robot: without this the
    servo misses pictures that are on their way.
    """

    def __init__(self, sleep: Callable[[float], None] = time.sleep) -> None:
        self._sleep = sleep
        self._waited_s = 0.0

    def wait(self, age_s: float) -> None:
        """Wait a little, once in a tick, where the newest picture is older than PICTURE_DUE_S (s of the Diagram)."""
        if age_s <= PICTURE_DUE_S:
            self._waited_s = 0.0
        elif self._waited_s < PICTURE_PATIENCE_S:
            self._sleep(PICTURE_STEP_S)
            self._waited_s += PICTURE_STEP_S
