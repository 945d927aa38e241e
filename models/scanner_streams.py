"""Timing of a scanner that streams: frame rate, exposure, readout, transport delay and the device's own clock.

MotionCam-3D: 20 frames per second and about 140 ms between capture and arrival (the second flange paper, sections 2.3
and 3.3). Exposure, readout, jitter and the clock's drift are not published there; they are typical values of such
devices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.depth_noise import Depth
from weldcal.models.errors import InputError


def mixed_exposure(stack: Depth, edge_step_m: float, flying: float, rng: np.random.Generator) -> Depth:
    """Mix the instants ``stack`` (n, H, W) of an exposure to one depth map (H, W) m.

    They are infinite or 0 where nothing is.

    Depths further apart than ``edge_step_m`` are two surfaces; such a pixel reads one of them, by its share of the
    exposure, or with chance ``flying`` the mean. 0 marks "no reading".
    """
    stack = np.where(np.isfinite(stack) & (stack > 0.0), stack, np.float32(np.inf))
    low, high = stack.min(axis=0), stack.max(axis=0)
    seen = np.isfinite(low)
    with np.errstate(invalid="ignore"):
        edge = seen & (high - low > edge_step_m)
        mean = stack.mean(axis=0)
    out = np.where(seen & ~edge, mean, 0.0).astype(np.float32)
    at = np.flatnonzero(edge)
    if len(at):
        out.ravel()[at] = _edge_pixels(stack.reshape(len(stack), -1)[:, at], flying, rng)
    return out


def _edge_pixels(samples: Depth, flying: float, rng: np.random.Generator) -> Depth:
    """Depths (k,) of pixels whose instants (n, k) show two surfaces, or one and none."""
    n, k = samples.shape
    one = samples[rng.integers(n, size=k), np.arange(k)]
    seen = np.isfinite(samples)
    mean = np.where(seen, samples, 0.0).sum(axis=0) / seen.sum(axis=0)
    out = np.where(rng.random(k) < flying, mean, one)
    return np.asarray(np.where(np.isfinite(out), out, 0.0), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class ScannerStream:
    """Timing of streamed frames; seconds. A frame is captured in the middle of the exposure of its middle row.

    Attributes:
        fps: frames per second of the device's clock.
        exposure_s: time over which each row is exposed.
        readout_s: time between the exposures of the first and the last row; 0: a global shutter.
        period_jitter_s: standard deviation of a capture about its regular time.
        delay_s: mean time from capture to arrival.
        delay_jitter_s: its standard deviation: a smallest delay and a skewed tail (a gamma distribution of shape 2).
        device_epoch_s: reading of the device's clock at robot time 0.
        device_drift_ppm: rate of the device's clock over the robot's, less 1, in parts per million.
        device_jitter_s: standard deviation of a stamp about its capture.
        device_quantum_s: step of the device's stamps.
        loss: chance that a frame never arrives.
    """

    fps: float = 20.0
    exposure_s: float = 0.010
    readout_s: float = 0.0
    period_jitter_s: float = 5.0e-5
    delay_s: float = 0.140
    delay_jitter_s: float = 0.015
    device_epoch_s: float = 48211.7
    device_drift_ppm: float = 18.0
    device_jitter_s: float = 2.0e-5
    device_quantum_s: float = 1.0e-6
    loss: float = 0.0

    def __post_init__(self) -> None:
        sizes = (self.exposure_s, self.readout_s, self.period_jitter_s, self.delay_jitter_s, self.device_jitter_s)
        if not (np.isfinite([*sizes, self.fps, self.delay_s]).all() and min(sizes) >= 0.0 and self.fps > 0.0):
            raise InputError("A scanner's stream needs a positive frame rate, and times that are not negative.")
        if self.shortest_delay_s < 0.0:
            raise InputError("A delay's jitter can be at most its mean over the square root of 2: lower the jitter.")
        if self.exposure_s + self.readout_s > 1.0 / self.fps:
            raise InputError("Exposure and readout last longer than a frame: lower them, or the frame rate.")
        if not (0.0 <= self.loss < 1.0 and abs(self.device_drift_ppm) < 1e4 and self.device_quantum_s > 0.0):
            raise InputError("A stream's loss lies below 1, its drift below 10000 ppm, its quantum above 0.")

    @property
    def shortest_delay_s(self) -> float:
        """The delay that no frame undercuts, s."""
        return self.delay_s - math.sqrt(2.0) * self.delay_jitter_s

    @property
    def period_s(self) -> float:
        """Time between two frames on the robot's clock, s."""
        return 1.0 / self.fps / (1.0 + 1e-6 * self.device_drift_ppm)

    def captures(self, n: int, rng: np.random.Generator) -> Array:
        """Capture times (n,) s on the robot's clock, the first regular one at 0."""
        return np.asarray(np.arange(n) * self.period_s + self.period_jitter_s * rng.standard_normal(n))

    def delay(self, rng: np.random.Generator) -> float:
        """Return the transport delay of one frame, s."""
        return float(self.shortest_delay_s + rng.gamma(2.0, self.delay_jitter_s / np.sqrt(2.0)))

    def arrivals(self, captures: Array, rng: np.random.Generator) -> Array:
        """Arrival times (n,) s of frames captured at ``captures`` (n,) s; no frame overtakes another one."""
        return np.asarray(np.maximum.accumulate([t + self.delay(rng) for t in captures]))

    def device_time(self, capture_s: float, rng: np.random.Generator) -> float:
        """Return the device's stamp, s of its own clock, of a frame captured at ``capture_s`` of the robot's."""
        exact = self.device_epoch_s + capture_s * (1.0 + 1e-6 * self.device_drift_ppm)
        stamped = exact + self.device_jitter_s * float(rng.standard_normal())
        return float(np.round(stamped / self.device_quantum_s) * self.device_quantum_s)


STREAMS: dict[str, ScannerStream] = {
    "motioncam_3d_stream": ScannerStream(),
    "motioncam_3d_stream_half": ScannerStream(),
}
"""The timing of each scanner that streams, by the name of its preset."""


def get_stream(name: str) -> ScannerStream:
    """Return the timing of the named scanner preset; raises InputError naming those that stream."""
    stream = STREAMS.get(name.strip().lower().replace("-", "_"))
    if stream is None:
        raise InputError(f"Scanner '{name}' does not stream: use one of {', '.join(STREAMS)}.")
    return stream
