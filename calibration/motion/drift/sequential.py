"""Test a calibration sequentially: has the scanner moved, when, by how much and in which direction."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.robust import chi2_threshold
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.motion.drift.hypotheses import RAMP, RAMP_S, STEP, DriftFilter, FilterConfig
from weldcal.calibration.motion.drift.residuals import (
    CLOCK,
    MOVE,
    SCALE,
    SIZE,
    FrameNoise,
    NoiseMemory,
    Rows,
    about,
    measured_noise,
    moved_about,
)
from weldcal.models.arrays import Array

MOVED, CREEP, WARM_UP = "moved", "creep", "warm-up"
ROBOT_OR_SCANNER = "the scanner or the robot's base moved"
OR_WARM_UP = "the scanner or the robot's base moves, or the scanner warms up"
_CLOCK_S = 2e-3  # a choice: one period of a robot's stream at 500 Hz
_MOST_SPREAD_M = 5e-4  # a choice: three times the usual spread of solve.py; more would hide a move of a millimetre
_RIGID = np.arange(SCALE)  # move and clock: a clock that jumps is no move
_SCALED = np.array([SCALE, CLOCK])
_REFUSED = 15.0  # twice the log likelihood at which five unknowns fewer are refused at 1 %
_LIKELY = 25.0  # a statistic from which on frames are also judged by the best hypothesis
_CLEARLY = 10.0  # twice the log likelihood by which a creep must beat a step
_PARSIMONY = 0.01  # a simpler change is named unless the data refuse it at this level


@dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """Settings of the test. ``false_alarms_per_hour`` bounds the alarms in a cell in which nothing happens.

    ``floor_m`` and ``floor_rad`` are sigmas per axis, at the pivot, of what no model here explains and no number of
    frames averages away. ``stated_m`` and ``stated_rad`` the same of a calibration's own covariance, which counts for a
    change that is as old as the first frame. It is tested for ``stated_s``. Changes older than ``longest_s`` are not
    tested. An alarm waits ``confirm_s`` before it says how far the scanner moved, and up to ``slow_s`` where a warm-up
    explains a slow change as well. The noise is that of the last ``noise_frames``, and no less than the mean of the
    last ``noise_memory``. Where ``novel_frames`` of the last 80 or so are at poses that the field's features do not
    reach, the field is learnt anew.
    """

    false_alarms_per_hour: float = 1e-3
    floor_m: float = 1.2e-5
    floor_rad: float = 2.5e-5
    stated_m: float = 8e-5
    stated_rad: float = 2e-4
    stated_s: float = 60.0
    longest_s: float = 1800.0
    least_frames: int = 8
    creep_frames: int = 100
    confirm_s: float = 4.0
    slow_s: float = 60.0
    noise_frames: int = 400
    noise_memory: int = 12000
    novel_frames: int = 40
    filter: FilterConfig = field(default_factory=FilterConfig)


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftEvent:
    """A change that the drift test found.

    ``kind`` is moved, creep or warm-up; times are of the change and of when it was found (robot clock, s). The move is
    that of the scanner about its own origin in the base: translation (3,) m, rotation vector (3,) rad, their covariance
    (6, 6) [rotation; translation]. The pose after it, the test statistic and its threshold follow. ``model`` says what
    of the move is significant: translation, rotation or both, and ``cause`` what residuals of the flange show of the
    cause. ``since_start`` holds where the change is as old as the first frame. Of a warm-up, ``scale`` is the change of
    the scanner's scale; the move is zero.
    """

    kind: str
    time_s: float
    time_sigma_s: float
    found_s: float
    translation_m: Array
    rotation_rad: Array
    covariance: Array
    X_BC_after: RigidTransform
    model: str
    statistic: float
    threshold: float
    cause: str = ""
    since_start: bool = False
    scale: float = 0.0


class DriftTest:
    """Feeds residuals of frames, in the order of their times, to the filter, raises alarms and turns them into events.

    ``X_BC`` and its ``covariance`` (6, 6) [rotation; translation] about the camera's origin are the calibration's;
    ``pivot`` (3,) m in B is a point in the middle of the work. Rows are residuals against that calibration about that
    pivot. The noise is measured from the frames themselves unless it is given. Theory: docs/drift.md.
    """

    def __init__(
        self,
        X_BC: RigidTransform,
        covariance: Array,
        pivot: Array,
        config: DriftConfig | None = None,
        noise: FrameNoise | None = None,
        frame_rate_hz: float = 20.0,
    ) -> None:
        self.config = config or DriftConfig()
        self._X_BC, self._pivot = X_BC, np.asarray(pivot, dtype=float)
        self._lever = self._pivot - np.asarray(X_BC.translation())
        self.filter = DriftFilter(about(covariance, self._lever), self.config.filter)
        self._given, self.noise = noise, noise
        self._memory = NoiseMemory(self.config.noise_memory)
        self._recent: list[Rows] = []
        self._waiting: list[Rows] = []
        self._alarm_s: float | None = None
        self.statistic = 0.0
        self._settles_s = np.inf
        self._last_s = 0.0
        self.events: list[DriftEvent] = []
        tests = 3600.0 * frame_rate_hz * len(self.filter.kind)
        level = min(self.config.false_alarms_per_hour / tests / 4.0, 0.3)
        # of a move with six unknowns, and of a pure translation or rotation
        self.threshold, self.threshold_alone = chi2_threshold(level, 6), chi2_threshold(level, 3)
        turned = np.vstack(
            [np.eye(3), -skew(self._lever)]
        )  # about the scanner's origin: it moves the pivot by rotation x lever
        self._simple = (np.vstack([np.zeros((3, 3)), np.eye(3)]), turned)
        # a turn about the line of sight shifts the feature least of all: alone, it has one unknown
        about_view = turned @ (self._lever / max(float(np.linalg.norm(self._lever)), 1e-9))[:, None]
        self._alone = tuple(
            (E, self.threshold / chi2_threshold(level, E.shape[1])) for E in (*self._simple, about_view)
        )

    @property
    def alarmed(self) -> bool:
        """Return whether an alarm is active whose size is still being measured."""
        return self._alarm_s is not None

    def current(self) -> tuple[RigidTransform, Array]:
        """Return the scanner's pose as it is now, and its covariance (6, 6) [rotation.

        Translation] about the camera's origin: the calibration, corrected by what all frames since the last change say.
        This is the recalibration.
        """
        X = moved_about(self._X_BC, self.filter.error[MOVE], self._pivot)
        return X, about(self.filter.covariance[MOVE, MOVE], -self._lever)

    @property
    def clock_s(self) -> float:
        """Estimated time (s) by which the frames' times are too early."""
        return float(self.filter.error[CLOCK])

    def update(self, rows: Rows) -> list[DriftEvent]:
        """Take the residuals of new frames; returns the events that they settle."""
        self._keep(rows)
        if self.noise is None:
            self._waiting.append(rows)
            return []
        if self._waiting:
            rows, self._waiting = _joined([*self._waiting, rows]), []
        out: list[DriftEvent] = []
        for i in range(len(rows)):
            t = float(rows.times[i])
            self._last_s = t
            f = self.filter
            f.update(rows, i, self.noise, spawn=self._alarm_s is None)
            age = np.where(f.used, t - f.start_time, 0.0)
            f.forget(age > np.where(f.start == 0, self.config.stated_s, self.config.longest_s))
            if self._alarm_s is None and f.novel > self.config.novel_frames:
                f.renew_field()
            self._test(t)
            if self._alarm_s is not None and t >= self._settles_s:
                out += self._settle(t)
        return out

    def finish(self) -> list[DriftEvent]:
        """Complete an active alarm after the last frame.

        Frames too few for their noise to be measured are tested with the stated one.
        """
        out: list[DriftEvent] = []
        if self.noise is None and self._waiting:
            self.noise = FrameNoise()
            rows, self._waiting = _joined(self._waiting), []
            out += self.update(rows)
        if self._alarm_s is not None:
            out += self._settle(self._last_s, last=True)
        return out

    def _keep(self, rows: Rows) -> None:
        """Measure the noise anew from the newest frames."""
        if self._given is not None:
            return
        self._recent.append(rows)
        count = sum(len(r) for r in self._recent)
        if count < 40 or (self.noise is not None and len(self._recent) < 40 and count < self.config.noise_frames):
            return
        joined = _joined(self._recent)
        joined = joined.part(slice(max(0, len(joined) - self.config.noise_frames), None))
        self._recent = [joined]
        window = measured_noise(joined, clock_s=self.clock_s)
        if window is not None:
            self.noise = self._memory.noise(window, len(rows))

    def _changes(self, unknowns: NDArray[np.intp]) -> tuple[Array, Array, Array, Array]:
        """Of every hypothesis (k,).

        Estimates (k, m) of these unknowns, covariances (k, m, m), gains in twice the log likelihood, and how much
        larger than expected the innovations stay under it (variance, at least 1).
        """
        f = self.filter
        pick = np.ix_(np.arange(len(f.kind)), unknowns, unknowns)
        prior = np.diag(1.0 / np.square(np.array(self.config.filter.change)[unknowns]))
        C = np.asarray(np.linalg.inv(f.information[pick] + prior), dtype=float)
        d = f.vector[:, unknowns]
        theta = np.einsum("kij,kj->ki", C, d)
        gain = np.einsum("ki,ki->k", d, theta)
        left = (f.squares - gain) / np.maximum(5 * f.frames - len(unknowns), 1)
        return theta, C, gain, np.maximum(left, 1.0)

    def _statistics(self, now: float) -> tuple[Array, Array, Array, Array]:
        """Return the test statistic (k,) of a move of every hypothesis, in terms of one with six unknowns.

        Also returns its estimate (k, 7), covariance (k, 7, 7) and variance factor.
        """
        f, c = self.filter, self.config
        theta, C, _, left = self._changes(_RIGID)
        C = C * left[:, None, None]
        floor = np.repeat([c.floor_rad**2, c.floor_m**2], 3)
        first = np.repeat([c.stated_rad**2, c.stated_m**2], 3)
        floors = np.where((f.start == 0)[:, None], first, floor)
        ramps = f.kind == RAMP
        # a creep's unknowns are what it makes in RAMP_S, and the floor is what it must have made by now
        floors[ramps] *= (RAMP_S / np.maximum(now - f.start_time[ramps], 1.0))[:, None] ** 2
        S = C[:, :6, :6] + floors[:, :, None] * np.eye(6)
        a = theta[:, :6]
        W = np.linalg.inv(S)
        Wa = np.einsum("kij,kj->ki", W, a)
        T = np.einsum("ki,ki->k", a, Wa)
        for E, share in self._alone:  # a pure translation or rotation has fewer unknowns, and so a lower threshold
            z = Wa @ E
            N = E.T @ W @ E
            fewer = np.einsum("ka,ka->k", z, np.linalg.solve(N, z[:, :, None])[:, :, 0])
            T = np.maximum(T, fewer * share)
        least = np.where(f.kind == RAMP, c.creep_frames, c.least_frames)
        return np.where(f.used & (f.frames >= least), T, 0.0), theta, C, left

    def _test(self, t: float) -> None:
        T, theta, _, _ = self._statistics(t)
        k = int(np.argmax(T))
        self.statistic = float(T[k])
        change = np.zeros(SIZE)
        change[_RIGID] = theta[k]
        self.filter.favourite = (k, change) if self.statistic > _LIKELY else None
        if self._alarm_s is None and self.statistic > self.threshold:
            self._alarm_s, self._settles_s = t, t + self.config.confirm_s

    def _settle(self, t: float, *, last: bool = False) -> list[DriftEvent]:
        """Return the event of the best hypothesis; the filter goes on from the pose after it.

        An alarm that has faded is withdrawn.
        """
        found = self._alarm_s
        assert found is not None
        self._alarm_s, self._settles_s = None, np.inf
        f = self.filter
        T, theta, C, left = self._statistics(t)
        k = int(np.argmax(T))
        if T[k] < self.threshold:
            return []
        scaled, C_scaled, gain_scaled, _ = self._changes(_SCALED)
        _, _, gain, _ = self._changes(_RIGID)
        k = self._likeliest(T, gain / left[k])
        kind = MOVED if f.kind[k] == STEP else CREEP
        ramps = np.flatnonzero((f.kind == RAMP) & f.used & (f.frames >= self.config.creep_frames))
        cause = ROBOT_OR_SCANNER
        if len(ramps):
            r = int(ramps[np.argmax(gain_scaled[ramps])])
            better = float(gain_scaled[r] - gain[k]) / left[k]
            warming = bool(self.events) and self.events[-1].kind == WARM_UP
            if better > (-_REFUSED if warming else _CLEARLY):  # what has begun as a warm-up goes on as one
                return [self._warm_up(r, scaled[r], C_scaled[r], found, float(T[k]))]
            if better > -_REFUSED:
                if t < found + self.config.slow_s and not last:  # what comes slowly may be looked at for a while
                    self._alarm_s, self._settles_s = found, t + self.config.confirm_s
                    return []
                cause = OR_WARM_UP
        share = 1.0 if kind == MOVED else (t - float(f.start_time[k])) / RAMP_S
        model, move, cov = self._simplest(theta[k, :6] * share, C[k, :6, :6] * share**2)
        time, sigma = self._when(k, gain, left)
        change, change_cov = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        change[_RIGID] = theta[k]
        change_cov[np.ix_(_RIGID, _RIGID)] = C[k]
        first = bool(f.start[k] == 0)
        f.absorb(k, change, change_cov)
        at_camera = move.copy()
        at_camera[3:] -= np.cross(move[:3], self._lever)
        event = DriftEvent(
            kind=kind,
            time_s=time,
            time_sigma_s=sigma,
            found_s=found,
            translation_m=at_camera[3:],
            rotation_rad=at_camera[:3],
            covariance=about(cov, -self._lever),
            X_BC_after=self.current()[0],
            model=model,
            statistic=float(T[k]),
            threshold=self.threshold,
            cause=cause,
            since_start=first,
        )
        self.events.append(event)
        return [event]

    def _likeliest(self, T: Array, gain: Array) -> int:
        """The likeliest of the significant hypotheses: a creep only where it explains clearly more than any step."""
        f = self.filter
        gain = np.where(self.threshold < T, gain, -np.inf)
        step = int(np.argmax(np.where(f.kind == STEP, gain, -np.inf)))
        ramp = int(np.argmax(np.where(f.kind == RAMP, gain, -np.inf)))
        return ramp if gain[ramp] > gain[step] + _CLEARLY else step

    def _warm_up(self, k: int, theta: Array, C: Array, found: float, statistic: float) -> DriftEvent:
        f = self.filter
        change, cov = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        change[_SCALED] = theta
        cov[np.ix_(_SCALED, _SCALED)] = C
        time = float(f.start_time[k])
        before = float(f.error[SCALE])
        f.absorb(k, change, cov)
        event = DriftEvent(
            kind=WARM_UP,
            time_s=time,
            time_sigma_s=0.0,
            found_s=found,
            translation_m=np.zeros(3),
            rotation_rad=np.zeros(3),
            covariance=np.zeros((6, 6)),
            X_BC_after=self.current()[0],
            model="scale",
            statistic=statistic,
            threshold=self.threshold,
            cause=WARM_UP,
            since_start=False,
            scale=float(f.error[SCALE]) - before,
        )
        self.events.append(event)
        return event

    def _simplest(self, move: Array, cov: Array) -> tuple[str, Array, Array]:
        """Return the move about the pivot and its covariance in the simplest form that the data do not refuse.

        That is a pure translation, or a pure rotation about the scanner's origin.
        """
        c = self.config
        S = cov + np.diag(np.repeat([c.floor_rad**2, c.floor_m**2], 3))
        W = np.linalg.inv(S)
        limit = chi2_threshold(_PARSIMONY, 3)
        best: tuple[float, str, Array, Array] | None = None
        for name, E in zip(("translation", "rotation"), self._simple, strict=True):
            N = np.linalg.inv(E.T @ W @ E)
            fit = E @ (N @ (E.T @ W @ move))
            misfit = float((move - fit) @ W @ (move - fit))
            if misfit < limit and (best is None or misfit < best[0]):
                best = misfit, name, fit, E @ N @ E.T
        return ("both", move, S) if best is None else best[1:]

    def _when(self, k: int, gain: Array, left: Array) -> tuple[float, float]:
        """Time (s) of the change and its sigma.

        Mean over the hypotheses of the same kind, weighted by their likelihood.
        """
        f = self.filter
        least = self.config.least_frames if f.kind[k] == STEP else self.config.creep_frames
        same = np.flatnonzero((f.kind == f.kind[k]) & f.used & (f.frames >= least))
        weight = np.exp(0.5 * (gain[same] - gain[k]) / left[k])
        times = f.start_time[same]
        mean = float((weight * times).sum() / weight.sum())
        spacing = np.diff(np.sort(times)).min(initial=np.inf)
        spread = float((weight * (times - mean) ** 2).sum() / weight.sum())
        return mean, float(np.sqrt(spread + (spacing if np.isfinite(spacing) else 0.0) ** 2 / 12.0))


def _joined(parts: list[Rows]) -> Rows:
    return Rows(*(np.concatenate([getattr(p, name) for p in parts]) for name in Rows.__dataclass_fields__))


def drift_config(
    sigma_position_m: float, clock_sigma_s: float | None, config: DriftConfig | None = None
) -> DriftConfig:
    """Return the test's settings for a calibration.

    Its spread of scanner and arm is that of the field, where it states a larger one.
    """
    config = config or DriftConfig()
    spread = float(np.clip(sigma_position_m, config.filter.field.sigma_m, _MOST_SPREAD_M))
    clock = max(_CLOCK_S, 3.0 * (clock_sigma_s if clock_sigma_s is not None else 10.0 * _CLOCK_S))
    known: FilterConfig = replace(config.filter, clock_s=clock, field=replace(config.filter.field, sigma_m=spread))
    return replace(config, filter=known)
