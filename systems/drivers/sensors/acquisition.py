"""Take a device's frames in a worker thread that opens it, reconnects, and knows at any time what is wrong."""

import threading
import time
import weakref
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.systems.drivers.sensors.stamps import CellTime, DeviceClock, HostTime, Stamp, UnixClock

Datum = TypeVar("Datum")
POLL_S = 0.02  # longest time that a source is waited for before requests are looked at
RETRY_S = (0.1, 1.0)  # first and longest pause before a lost device is opened again
CLOSE_S = 5.0  # a choice: a source that hangs in a read delays the end by this; half of it cuts off slow disconnects
ATTEMPTS = 5  # to connect, or to read a frame, when a device is started


class DeviceFault(WeldcalError):
    """A device does not deliver what the cell needs; the sentence names it and says what to do."""


class DeviceLost(DeviceFault):
    """The connection to a device has ended, or it cannot be opened."""


class Garbage(WeldcalError):
    """A frame that arrived and cannot be used; the device may send a good one next."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Delivery(Generic[Datum]):
    """A frame as a source takes it from its device.

    `arrived` s (host, monotonic). `device_time` s of the device's clock, `unix_time` s of the capture by this
    computer's clock; None where the frame has no such stamp. `number` of the frame as the device counts, None: it does
    not. `request`: the number of the request that it answers, 0: none. `lost`: frames that the source knows to be lost
    before it.
    """

    datum: Datum
    arrived: float
    device_time: float | None = None
    unix_time: float | None = None
    number: int | None = None
    request: int = 0
    lost: int = 0
    note: str = ""


class Source(Protocol[Datum]):
    """A device, used from the worker thread only."""

    name: str

    def open(self) -> None:
        """Connect. Raises DeviceLost."""

    def next(self, timeout_s: float) -> "Delivery[Datum] | None":
        """Return the next frame; None where none came in time.

        Raises DeviceLost, or Garbage for a frame that cannot be used.
        """

    def ask(self, request: int) -> None:
        """Trigger the device. Raises DeviceLost. A device that runs freely does nothing."""

    def close(self) -> None:
        """Disconnect; a second call has no effect."""

    def end(self) -> None:
        """Disconnect and let everything go; the source is not used any more. A second call has no effect."""
        self.close()


@dataclass(frozen=True, eq=False, kw_only=True)
class AcquiredFrame(Generic[Datum]):
    """A frame with its own number (from 1, gaps where frames were lost) and its stamp.

    `arrived` s (host, monotonic).
    """

    number: int
    datum: Datum
    arrived: float
    stamp: Stamp
    device_time: float | None = None
    request: int = 0
    note: str = ""


@dataclass(frozen=True)
class Rules:
    """When a device is at fault, s; None: that rule does not apply.

    Attributes:
        silent_s: without a usable frame.
        frozen_s: with identical frames.
        late_s: that a frame comes late.
        answer_s: from a request to its frame.
        lost_s: without a connection.
    """

    silent_s: float | None = None
    frozen_s: float | None = None
    late_s: float = 0.5
    answer_s: float | None = None
    lost_s: float = 0.5


@dataclass(frozen=True)
class Counts:
    """Frames that came, were lost, were never looked at or could not be read, and the connections after the first."""

    received: int = 0
    lost: int = 0  # the device's own count has a gap
    dropped: int = 0  # a newer one came before it was looked at
    garbled: int = 0
    reconnects: int = 0


@dataclass(kw_only=True)
class _Seen:
    """What the worker notes; each attribute is replaced as a whole, so that a reader needs no lock."""

    counts: Counts = field(default_factory=Counts)
    connected: bool = False
    opened_at: float = 0.0
    lost_since: float = 0.0
    trouble: str = ""  # the newest, as a sentence
    good_at: float = 0.0
    same_since: float | None = None
    late_s: float = 0.0
    asked: int = 0
    refused: int = 0  # attempts to connect in a row that failed
    latency: tuple[float, ...] = ()  # of the newest frames, from capture to arrival


class Acquisition(Generic[Datum]):
    """Takes a source's frames in a thread of its own.

    The newest `kept` of them can be read at any time without waiting.

    `prepare` is applied to each frame in that thread. Whether the device is silent or late is judged by `time`.
    """

    def __init__(
        self,
        source: Source[Datum],
        rules: Rules,
        *,
        kept: int = 2,
        latency_s: float = 0.0,
        prepare: Callable[[Datum], Datum] | None = None,
    ) -> None:
        self.source, self.rules = source, rules
        self._kept, self._latency_s, self._prepare = kept, latency_s, prepare
        self.clock = DeviceClock(latency_s, rules.late_s)
        self._unix = UnixClock()
        self._frames: tuple[AcquiredFrame[Datum], ...] = ()
        self._seen = _Seen()
        self._read = self._wanted = self._number = 0
        self._wanted_at = 0.0
        self._excused, self._excused_at = 0.0, float("-inf")
        self._print: int | None = None
        self._device_number: int | None = None
        self.time: CellTime = HostTime()  # before `start`: another one
        self._stop = threading.Event()
        self._news = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def name(self) -> str:
        """The device's name at the beginning of a sentence."""
        return self.source.name

    @property
    def counts(self) -> Counts:
        """What has come so far."""
        return self._seen.counts

    @property
    def latency_s(self) -> tuple[float, ...]:
        """Seconds from capture to arrival of the newest frames that have a stamp."""
        return self._seen.latency

    def start(self, wait_s: float, *, first_frame: bool) -> None:
        """Start the thread and wait until the device is connected, or its first frame is there.

        Raises:
            DeviceFault: it is not within `wait_s`; the thread has ended.
        """
        self._seen = _Seen(lost_since=self.time.now(), good_at=self.time.now())
        # the thread must not keep its own object alive: a station that nobody closed ends its threads when it is
        # forgotten
        self._thread = threading.Thread(target=_work, args=(weakref.ref(self), self._stop), daemon=True)
        self._thread.start()

        def here() -> bool:
            return bool(self._frames) or (self._seen.connected and not first_frame)

        def given_up() -> bool:
            return self._seen.refused >= ATTEMPTS or self._seen.counts.garbled >= ATTEMPTS

        with self._news:
            self._news.wait_for(lambda: here() or given_up(), wait_s)
        if here():
            return
        trouble = self._seen.trouble or f"it sent nothing within {wait_s:.0f} s"
        self.close()
        raise DeviceFault(f"{self.name} does not answer: {trouble.rstrip('.')}.")

    def request(self, number: int) -> None:
        """Ask the device for a frame, once for each number; its frame carries this number. Never waits."""
        if number > self._wanted:
            self._wanted_at = self.time.now()
            self._wanted = number

    def frames(self) -> tuple[AcquiredFrame[Datum], ...]:
        """The newest frames, oldest first. Never waits."""
        found = self._frames
        if found:
            self._read = max(self._read, found[-1].number)
        return found

    def answer(self, number: int) -> AcquiredFrame[Datum] | None:
        """Return the frame that answers a request; None where there is none yet. Never waits."""
        self.frames()
        return self._find(number)

    def _find(self, number: int) -> AcquiredFrame[Datum] | None:
        return next((f for f in reversed(self._frames) if f.request == number), None)

    def wait_for_answer(self, number: int) -> AcquiredFrame[Datum] | None:
        """Return the frame that answers a request, waited for until the device is at fault.

        Only where the Diagram may wait.
        """
        while (found := self.answer(number)) is None and self.fault(self.time.now()) is None:
            with self._news:
                self._news.wait(0.05)
        return found

    def excuse(self, seconds: float) -> None:
        """Do not count this time, in which nobody could read, as the device's silence, nor its frames as late."""
        self._excused += seconds
        self._excused_at, self._seen.late_s = time.monotonic(), 0.0

    def fault(self, now: float) -> str | None:
        """What is wrong with the device at `now` (s, of `time`), as a sentence; None where nothing is. Never waits."""
        seen, rules, excused = self._seen, self.rules, self._excused
        trouble = f": {seen.trouble.rstrip('.')}" if seen.trouble else ""
        silent = rules.silent_s is not None and now - seen.good_at - excused > rules.silent_s
        if not seen.connected and (silent or now - seen.lost_since - excused > rules.lost_s):
            return f"{self.name} is not connected{trouble}."
        if silent:
            return f"{self.name} sent nothing usable for {rules.silent_s:g} s{trouble}."
        if (
            rules.frozen_s is not None
            and seen.same_since is not None
            and seen.good_at - seen.same_since > rules.frozen_s
        ):
            return f"{self.name} is frozen: its frames were identical for {rules.frozen_s:g} s. Restart it."
        if seen.late_s > rules.late_s:
            return f"{self.name} is late: a frame came {seen.late_s:.1f} s after its time. Look at its connection."
        waited = now - self._wanted_at
        if rules.answer_s is not None and self._find(self._wanted) is None and self._wanted and waited > rules.answer_s:
            return f"{self.name} did not deliver scan {self._wanted} within {rules.answer_s:g} s{trouble}."
        return None

    def summary(self) -> dict[str, object]:
        """Return the JSON object of this device's acquisition."""
        c, latency = self.counts, np.array(self._seen.latency)
        found: dict[str, object] = {
            "received": c.received,
            "lost": c.lost,
            "dropped": c.dropped,
            "garbled": c.garbled,
            "reconnects": c.reconnects,
        }
        if latency.size:
            found["latency_ms"] = {"median": 1e3 * float(np.median(latency)), "worst": 1e3 * float(latency.max())}
        if self._frames:
            found["capture_time_from"] = self._frames[-1].stamp.clock
            if self._frames[-1].stamp.clock == "device":
                found["clock_error_ms"] = 1e3 * self.clock.error_s
        return found

    def close(self) -> None:
        """End the thread and disconnect; a second call has no effect."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(CLOSE_S)

    def step(self) -> float:
        """One pass of the worker: connect where there is no connection, trigger what is asked for, take a frame.

        Returns the seconds to pause before the next pass.
        """
        seen = self._seen
        self.time.look()
        try:
            if not seen.connected:
                self.source.open()
                seen.connected, seen.refused, seen.opened_at = True, 0, self.time.now()
                self.clock = DeviceClock(self._latency_s, self.rules.late_s)
                self._device_number = None
                seen.asked = min(seen.asked, max(self._wanted - 1, 0))  # an unanswered request is repeated
                self._tell()
            if seen.asked < self._wanted:
                seen.asked = self._wanted
                if self._find(seen.asked) is None:
                    self.source.ask(seen.asked)
            delivery = self.source.next(POLL_S)
            if delivery is not None:
                if self._prepare is not None:
                    delivery = replace(delivery, datum=self._prepare(delivery.datum))
                self._take(delivery)
        except Garbage as error:
            seen.trouble = str(error)
            seen.counts = replace(seen.counts, garbled=seen.counts.garbled + 1)
            self._tell()
        except DeviceFault as error:
            self._lose(str(error))
            return (
                RETRY_S[0]
                if not seen.counts.received
                else min(RETRY_S[0] * 2 ** min(seen.counts.reconnects, 4), RETRY_S[1])
            )
        except Exception as error:  # a device's own library may raise anything, and the thread must not end unseen
            self._lose(f"{type(error).__name__}: {error}")
            return RETRY_S[1]
        return 0.0

    def _lose(self, reason: str) -> None:
        seen, now = self._seen, self.time.now()
        seen.trouble = reason
        with suppress(Exception):  # whatever state its library is in
            self.source.close()
        if seen.connected:
            # a connection that ends at once, again and again, is none
            if seen.good_at > seen.opened_at or now - seen.opened_at > self.rules.lost_s:
                seen.lost_since = now
            seen.counts = replace(seen.counts, reconnects=seen.counts.reconnects + 1)
        else:
            seen.refused += 1
        seen.connected = False
        self._tell()

    def _take(self, delivery: Delivery[Datum]) -> None:
        seen, d = self._seen, delivery
        stamp = self._stamp(d)
        gap = d.lost
        if d.number is not None and self._device_number is not None and d.number > self._device_number:
            gap = max(gap, d.number - self._device_number - 1)
        self._device_number = d.number
        self._number += 1 + gap
        frame = AcquiredFrame(
            number=self._number,
            datum=d.datum,
            arrived=d.arrived,
            stamp=stamp,
            device_time=d.device_time,
            request=d.request,
            note=d.note,
        )
        pushed = self._frames[: max(len(self._frames) - self._kept + 1, 0)]
        dropped = sum(f.number > self._read for f in pushed)
        c = seen.counts
        if self.rules.frozen_s is not None:
            found = _print_of(d.datum)
            seen.same_since = (seen.same_since or seen.good_at) if found == self._print else None
            self._print = found
        seen.late_s = 0.0 if stamp.captured < self._excused_at else stamp.late_s
        if stamp.clock != "arrival":
            seen.latency = (*seen.latency[-99:], d.arrived - stamp.captured)
        seen.trouble = ""
        seen.good_at, self._excused = self.time.at(d.arrived), 0.0
        self._frames = (*self._frames[len(pushed) :], frame)
        seen.counts = replace(c, received=c.received + 1, lost=c.lost + gap, dropped=c.dropped + dropped)
        self._tell()

    def _stamp(self, d: Delivery[Datum]) -> Stamp:
        if d.unix_time is not None:
            captured = self._unix.to_monotonic(d.unix_time, d.arrived)
            late = self.time.at(d.arrived) - self.time.at(captured) - self._latency_s
            return Stamp(min(captured, d.arrived), "host", max(late, 0.0))
        if d.device_time is not None:
            return self.clock.stamp(d.device_time, d.arrived)
        return Stamp(d.arrived - self._latency_s, "arrival")

    def _tell(self) -> None:
        with self._news:
            self._news.notify_all()


def _print_of(datum: object) -> int:
    """Return a number that two frames share only if they are identical."""
    return zlib.crc32(np.ascontiguousarray(datum).data)


def _work(owner: "weakref.ref[Acquisition[Datum]]", stop: threading.Event) -> None:
    """The thread: passes until it is stopped, or nobody holds its acquisition any more."""
    source: Source[Datum] | None = None
    while not stop.is_set():
        acquisition = owner()
        if acquisition is None:
            break
        source = acquisition.source
        pause = acquisition.step()
        del acquisition
        stop.wait(pause)
    if source is not None:
        with suppress(Exception):
            source.end()
