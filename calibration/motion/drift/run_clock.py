"""Learns a scanner's clock from streamed frames of the flange while the arm moves, for a live monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import DEVICE, ScannerClock, ScannerCorrection
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arms.kinematics import ArmModel, chain_poses
from weldcal.models.arrays import Array


class StreamedFit(Protocol):
    """A streamed frame: its arrival on the robot's clock, its time on the device's own (s), and its fit."""

    @property
    def arrival_time(self) -> float: ...
    @property
    def device_time(self) -> float | None: ...
    @property
    def fit(self) -> FlangeFit | None: ...


F = TypeVar("F", bound=StreamedFit)
SEARCHED_S = 0.3  # by which a frame may come later or earlier than usual
_APART_S = 0.5  # a frame that is this early is of a clock that was set anew; one this late may be late
_RELEARN_S = 3.0  # frames that stay so late for so long belong to a clock that was set back
_NEVER_S = 5.0  # no frame is so late
_STEP_S = 0.02  # of the fit's grid of shifts
_FEWEST, _MOST = 12, 60  # frames
_CERTAIN_S = 1e-3  # half of _CONFIRMED_S: two sigma of a learnt shift are what the test lets a known clock be wrong
_CONFIRMED_S = 2e-3  # as far as the drift test lets a known clock be wrong
_REST_M = 1e-4  # by which the feature moves in SEARCHED_S at rest
_HALF_S = 0.01  # about a capture: its velocity
_ROUNDS = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class RunClock:
    """A device time and the robot's time then (s), and the robot's rate over the device's.

    ``learnt``: frames in motion have shown it. Until then it is what the calibration's clock says (``known``), which is
    of another run and another start of the robot's clock, or what the earliest arrival says, wrong by what that frame
    came late. ``waiting`` are the frames that could not be used yet; ``late_since``: the arrival (s) of the first of
    those that come very late now.
    """

    device_s: float
    robot_s: float
    rate: float = 1.0
    known: bool = False
    learnt: bool = False
    waiting: tuple[Any, ...] = ()
    late_since: float | None = None

    def time(self, device_s: float) -> float:
        """Return a device time on the robot's clock, s."""
        return self.robot_s + self.rate * (device_s - self.device_s)


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """What a clock is learnt with.

    The calibration, the arm and where the feature is on its flange, and the arm's joints (n, k) rad at recent times.
    """

    X_BC: RigidTransform
    correction: ScannerCorrection
    arm: ArmModel
    X_FR: RigidTransform
    times: Array
    positions: Array

    def features(self, times: Array) -> Array:
        """Return the feature in the base by the robot (..., 3) m at times (...) s; NaN outside the history."""
        t, q = self.times, self.positions
        if t.size < 2:
            return np.full((*times.shape, 3), np.nan)
        flat = times.ravel()
        joints = np.column_stack([np.interp(flat, t, q[:, k]) for k in range(q.shape[1])])
        p = (chain_poses(self.arm, joints) @ self.X_FR.GetAsMatrix4())[:, :3, 3]
        p[(flat < t[0]) | (flat > t[-1])] = np.nan
        return np.asarray(p.reshape(*times.shape, 3))


def followed(
    clock: RunClock | None, estimate: StreamedFit, delay_s: float, known: ScannerClock | None
) -> RunClock | None:
    """The clock with a new frame's times. ``known`` is the calibration's clock. None where a frame has no device time.

    No frame comes before its time, so that a clock that is not learnt yet moves to the earliest. One that was set anew
    is learnt again: at once where a frame is too early for it, or later than any frame is, else where frames stay late.
    """
    device, arrival = estimate.device_time, estimate.arrival_time
    if device is None or not np.isfinite(arrival):
        return None
    expected = None if known is None else known.capture(arrival, device)
    by_device = known is not None and known.kind == DEVICE
    usual = arrival - delay_s if by_device or expected is None else expected
    rate = 1.0 if known is None else 1.0 + (known.drift or 0.0)
    late = 0.0 if clock is None else usual - clock.time(device)
    if clock is None or late >= _NEVER_S or late <= -(_APART_S if clock.learnt else _NEVER_S):
        if by_device and expected is not None and abs(expected - usual) < SEARCHED_S:
            return RunClock(device_s=device, robot_s=expected, rate=rate, known=True)
        return RunClock(device_s=device, robot_s=usual, rate=rate)
    if not clock.learnt and (abs(late) >= SEARCHED_S if clock.known else late < 0.0):
        return replace(clock, device_s=device, robot_s=usual, known=False, late_since=None)
    if late < _APART_S:
        return clock if clock.late_since is None else replace(clock, late_since=None)
    if clock.late_since is None:
        return replace(clock, late_since=arrival)
    return clock if arrival - clock.late_since < _RELEARN_S else RunClock(device_s=device, robot_s=usual, rate=rate)


def with_frame(clock: RunClock, estimate: F, seen: SeenMotion) -> tuple[RunClock, tuple[F, ...]]:
    """Return the clock after a frame with a fit, and the frames that can be used now.

    At rest each at once, because no time is wrong there; in motion those that waited, once they show the clock. One
    that has left the history is given up. By a clock that is learnt only a very late frame waits, for the next: then it
    was late, and the clock is right.
    """
    assert estimate.device_time is not None
    if clock.learnt and clock.late_since is not None:
        return replace(clock, waiting=(*clock.waiting, estimate)), ()
    if clock.learnt:
        return replace(clock, waiting=()) if clock.waiting else clock, (*clock.waiting, estimate)
    time = clock.time(estimate.device_time)
    around = seen.features(time + np.array([-SEARCHED_S, 0.0, min(SEARCHED_S, seen.times[-1] - time)]))
    if np.linalg.norm(around - around[1], axis=1).max() < _REST_M:
        return clock, (estimate,)
    begins = seen.times[0] + SEARCHED_S
    waiting = [f for f in clock.waiting if f.device_time is not None and clock.time(f.device_time) > begins]
    waiting = [*waiting, estimate][-_MOST:]
    shift = _shift(clock, waiting, seen) if len(waiting) >= _FEWEST else None
    if shift is None:
        return replace(clock, waiting=tuple(waiting)), ()
    if clock.known and abs(shift) < _CONFIRMED_S:
        shift = 0.0
    return replace(clock, robot_s=clock.robot_s + shift, learnt=True, waiting=()), tuple(waiting)


def _shift(clock: RunClock, frames: Sequence[StreamedFit], seen: SeenMotion) -> float | None:
    """By how much (s) the robot's time is later than the clock says; None where the frames do not show it.

    The least squares of e_k = X_BC p_C,k - p_BR(t_k + shift) - o, whose common part o takes out a scanner that was
    moved before: first over steps of _STEP_S, then by Gauss-Newton.
    """
    times = np.array([clock.time(f.device_time) for f in frames if f.device_time is not None])
    centers = np.array([f.fit.center_C for f in frames if f.fit is not None])
    q = np.array([seen.X_BC @ p for p in seen.correction.points(centers)])
    shifts = np.arange(-SEARCHED_S, SEARCHED_S + 0.5 * _STEP_S, _STEP_S)
    e = q - seen.features(times + shifts[:, None])
    e -= np.nanmean(e, axis=1, keepdims=True)
    inside = np.isfinite(e[:, :, 0]).all(axis=1)  # a later time may not have been recorded yet
    if not inside.any():
        return None
    spread = np.einsum("dkx,dkx->d", e[inside], e[inside])
    shift = float(shifts[inside][np.argmin(spread)])
    for _ in range(_ROUNDS):
        before, now, after = seen.features(times + shift + np.array([-_HALF_S, 0.0, _HALF_S])[:, None])
        v = (after - before) / (2.0 * _HALF_S)
        e, v = q - now, v - v.mean(axis=0)
        e -= e.mean(axis=0)
        told = float(np.einsum("kx,kx", v, v))
        if not np.isfinite(told) or told <= 0.0:
            return None
        step = float(np.einsum("kx,kx", v, e)) / told
        shift += step
        if abs(step) < 1e-6:
            break
    sigma = np.sqrt(float(np.einsum("kx,kx", e, e)) / (3 * len(frames) - 4) / told)
    return shift if sigma < _CERTAIN_S and abs(shift) <= SEARCHED_S else None
