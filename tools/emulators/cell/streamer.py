"""The world's end of its streaming scanner: when a frame is exposed and when it arrives, in the world's time."""

from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated.streaming.scanner import StreamingScanner
from weldcal.tools.emulators.cell.physics import STEP_S
from weldcal.tools.emulators.cell.stream_process import Exposure
from weldcal.tools.emulators.cell.waiter import Waiter

IDLE_S = 0.5  # between frames while no program runs on the controller: nobody looks closely


class Streamer:
    """Exposes frames at the scanner's rate and hands each on when its delay is over."""

    def __init__(self, config: StreamingScanner, seed: int, pipe: Connection, unix_now: Callable[[], float]) -> None:
        self._timing, self._waiter, self._unix_now = config.stream(), Waiter(pipe), unix_now
        self._samples = config.exposure_samples
        self._spacing = max(1, round(self._timing.exposure_s / self._samples / STEP_S))
        self._rng = np.random.default_rng([seed, 32])
        self._instants: list[Array] = []
        self._next_frame, self._number = 1, 0  # the world counts its frames from 1
        self._unix_s = 0.0
        self._underway: deque[tuple[float, Exposure]] = deque()
        self._knock_s = config.knock_s
        self.knocked_at_s: float | None = None

    def knock(self, now: float) -> None:
        """Knock the scanner's stand at `now`, s of the world.

        Raises InputError where the world's scenario has no such stand.
        """
        if self._knock_s is None:
            raise InputError(
                "Write scanner.knock_s and knock_mm in the world's scenario: then its stand can be knocked."
            )
        self.knocked_at_s = now if self.knocked_at_s is None else self.knocked_at_s

    def step(self, frame: int, positions: Callable[[], Array], busy: bool) -> None:
        """One frame of the world; `busy`: a program runs on the controller."""
        if frame >= self._next_frame + len(self._instants) * self._spacing:
            if len(self._instants) == self._samples // 2:
                self._unix_s = self._unix_now()
            self._instants.append(positions())
            if len(self._instants) == self._samples:
                self._expose(frame, busy)
        while self._underway and frame * STEP_S >= self._underway[0][0]:
            self._waiter.send(self._underway.popleft()[1])  # no frame is late by more than this computer

    def truth(self) -> dict[str, object]:
        """The scanner's clock, what it read (s) at time 0 of the world and how much faster it is, and when its stand
        was knocked."""
        t = self._timing
        clock = {"at_0_s": t.device_epoch_s, "rate": 1.0 + 1e-6 * t.device_drift_ppm}
        return {"scanner_clock": clock, "knocked_at_s": self.knocked_at_s}

    def _expose(self, frame: int, busy: bool) -> None:
        capture = (frame - 0.5 * (self._samples - 1) * self._spacing) * STEP_S
        self._number += 1
        if self._knock_s is not None and self.knocked_at_s is None and capture >= self._knock_s:
            self.knocked_at_s = self._knock_s
        device = self._timing.device_time(capture, self._rng)
        exposure = Exposure(self._number, tuple(self._instants), self._unix_s, device, self.knocked_at_s is not None)
        arrival = capture + self._timing.delay(self._rng)
        self._underway.append((max(arrival, self._underway[-1][0]) if self._underway else arrival, exposure))
        self._instants = []
        self._next_frame += max(round(max(self._timing.period_s, 0.0 if busy else IDLE_S) / STEP_S), 1)
