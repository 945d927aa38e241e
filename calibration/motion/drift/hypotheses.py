"""Kalman filter of the calibration's error, with a bank of hypotheses that the scanner moved at an earlier frame."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from weldcal.calibration.motion.drift.residuals import CLOCK, MOVE, SCALE, SIZE, FrameNoise, Rows
from weldcal.models.arrays import Array


@dataclass(frozen=True)
class FieldConfig:
    """How a systematic error of scanner and arm varies.

    Its sigma per axis (m, rad) and its lengths (m, and rad of the normal).

    ``novelty`` is the share of the variance that the features may leave unexplained before one more is added, up to
    ``largest`` features.
    """

    sigma_m: float = 1.5e-4
    sigma_rad: float = 8e-4
    length_m: float = 0.15
    length_rad: float = 0.5
    novelty: float = 0.01
    largest: int = 120


class PoseField:
    """Features phi(x) with k(x, y) ~ phi(x) . phi(y) for a squared-exponential kernel, grown where poses are new.

    The features are those of the inducing poses so far: phi(x) = L^-1 k(Z, x) with L L' = k(Z, Z). A new inducing pose
    appends one feature and leaves the others as they are, so that coefficients learnt before keep their meaning, and
    the new one is independent of them a priori (Csato and Opper 2002, with the basis of a Cholesky factor).
    """

    def __init__(self, config: FieldConfig) -> None:
        self.config = config
        self._scale = np.repeat([1.0 / config.length_m, 1.0 / config.length_rad], 3)
        self._poses = np.empty((0, 6))
        self._factor = np.empty((0, 0))

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def full(self) -> bool:
        """Whether no feature can be added."""
        return len(self) >= self.config.largest

    def copy(self) -> "PoseField":
        """Return a field that grows by itself from here on; its arrays are never changed in place."""
        out = PoseField(self.config)
        out._poses, out._factor = self._poses, self._factor
        return out

    def features(self, p_C: Array, n_C: Array) -> tuple[Array, float]:
        """Return features (m,) at a centre (3,) m with normal (3,), and the unexplained share.

        They are grown by one where the pose is new.
        """
        x = np.concatenate([p_C, n_C]) * self._scale
        d = self._poses - x
        k = np.exp(-0.5 * np.einsum("ij,ij->i", d, d))
        phi = solve_triangular(self._factor, k, lower=True, check_finite=False) if len(k) else k
        left = max(1.0 - float(phi @ phi), 0.0)
        if left <= self.config.novelty or self.full:
            return np.asarray(phi), left
        m = len(self)
        root = np.sqrt(left)
        factor = np.zeros((m + 1, m + 1))
        factor[:m, :m], factor[m, :m], factor[m, m] = self._factor, phi, root
        self._poses, self._factor = np.vstack([self._poses, x]), factor
        return np.append(phi, root), 0.0


STEP, RAMP = 0, 1
RAMP_S = 60.0  # a choice of unit only: the prior scales with it (FilterConfig)
"""A creep's unknowns are what it reaches in so many seconds."""

_ROWS = 5
_STEPS, _RAMPS = 64, 12  # hypotheses kept of each kind
_EVERY = {STEP: 2, RAMP: 40}  # frames between new ones
_INFLUENCE = 25.0  # of chi-square with 5: a frame farther off counts as that far
_NOVEL_OVER = 80.0  # frames over which those at new poses are counted
_HOURS = 3600.0  # seconds of an hour: the wander is stated per root of an hour


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """What is known before.

    The sigmas of clock (s) and scale, and how far pose (m, rad per root hour), clock and scale wander in a cell in
    which nothing happens. ``change`` (SIZE,) is how large a change may be.
    """

    clock_s: float = 5e-3
    scale: float = 3e-4
    wander_m: float = 2e-5
    wander_rad: float = 5e-5
    wander_clock_s: float = 4e-3
    wander_scale: float = 2e-5
    change: tuple[float, ...] = (0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.05, 0.01)
    field: FieldConfig = field(default_factory=FieldConfig)


class DriftFilter:
    """State x: the calibration's error [rotation.

    Translation] about the pivot, clock (s), scale, coefficients of the field.

    Beside the estimate under "nothing happened" it carries, for each hypothesis "a change theta (SIZE,) from frame s
    on", the sensitivity F of the estimate to theta, and the information C and the vector d of theta in the innovations
    (Willsky and Jones 1976): innovation_k = (H_k - G_k F) theta + noise. A step adds H theta from s on, a creep H theta
    (t - t_s) / RAMP_S.
    """

    def __init__(self, covariance: Array, config: FilterConfig) -> None:
        self.config = config
        c = config.field
        largest = SIZE + _ROWS * c.largest
        self._x, self._P = np.zeros(largest), np.zeros((largest, largest))
        self._P[MOVE, MOVE] = covariance
        self._P[CLOCK, CLOCK], self._P[SCALE, SCALE] = config.clock_s**2, config.scale**2
        self._n = SIZE
        self._wander = np.repeat(
            np.array([config.wander_rad, config.wander_m, config.wander_clock_s, config.wander_scale]) ** 2 / _HOURS,
            [3, 3, 1, 1],
        )
        self._prior = np.repeat(np.array([c.sigma_m, c.sigma_rad]) ** 2, [3, 2])
        self._field = PoseField(c)
        self._time: float | None = None
        self.count = 0
        self.clear()

    def clear(self) -> None:
        """Forget all hypotheses."""
        k = _STEPS + _RAMPS
        self._F = np.zeros((len(self._x), k * SIZE))
        self.information, self.vector = np.zeros((k, SIZE, SIZE)), np.zeros((k, SIZE))
        self.squares, self.frames = np.zeros(k), np.zeros(k, dtype=int)
        self.start, self.start_time = np.full(k, -1), np.full(k, np.inf)
        self.kind = np.repeat([STEP, RAMP], [_STEPS, _RAMPS])
        self._since = self.count
        self.novel = 0.0
        self.favourite: tuple[int, Array] | None = None

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which hypotheses stand for a frame (k,)."""
        return np.asarray(self.start >= 0)

    @property
    def error(self) -> Array:
        """Estimated [rotation; translation; clock; scale] (SIZE,) under "nothing happened"."""
        return self._x[:SIZE].copy()

    @property
    def covariance(self) -> Array:
        """Covariance (SIZE, SIZE) of ``error``."""
        return self._P[:SIZE, :SIZE].copy()

    def copy(self) -> "DriftFilter":
        """Return a filter with the same estimate and field, without hypotheses."""
        out = DriftFilter(np.eye(6), self.config)
        out._x, out._P, out._n = self._x.copy(), self._P.copy(), self._n
        out._field, out._time, out.count = self._field.copy(), self._time, self.count
        out.clear()
        return out

    def spawn(self, time: float, kinds: tuple[int, ...] = (STEP, RAMP)) -> None:
        """Add the hypotheses that something happened before the next frame, at ``time`` s."""
        for kind in kinds:
            slots = np.flatnonzero(self.kind == kind)
            free = slots[self.start[slots] < 0]
            k = int(free[0]) if len(free) else self._least_missed(slots)
            self.start[k], self.start_time[k] = self.count, time
            self._F[:, k * SIZE : (k + 1) * SIZE] = 0.0
            self.information[k], self.vector[k], self.squares[k], self.frames[k] = 0.0, 0.0, 0.0, 0

    def forget(self, which: NDArray[np.bool_]) -> None:
        """Drop hypotheses (k,)."""
        for k in np.flatnonzero(which & self.used):
            self.start[k], self.start_time[k] = -1, np.inf
            self._F[:, k * SIZE : (k + 1) * SIZE] = 0.0
            self.information[k], self.vector[k], self.squares[k], self.frames[k] = 0.0, 0.0, 0.0, 0

    def update(self, rows: Rows, i: int, noise: FrameNoise, *, spawn: bool = True) -> None:
        """Take frame i of the rows. With ``spawn``, hypotheses are added as they are due.

        A frame at a pose that the features of a full field do not reach says nothing: scanner and arm err there as they
        do in every lap, and taken for noise that would become a move within some hundred frames.
        """
        t = float(rows.times[i])
        if self._time is not None:
            between = t - self._time
            if spawn:
                age = self.count - self._since
                due = tuple(kind for kind, every in _EVERY.items() if age % every == 0)
                if due:
                    self.spawn(t - 0.5 * between, due)
            self._P[range(SIZE), range(SIZE)] += self._wander * max(between, 0.0)
        elif spawn:
            self.spawn(t, (STEP,))
        self._time = t
        self.count += 1
        H = rows.derivatives[i]
        G, unexplained = self._rows(H, rows.centers[i], rows.normals[i])
        if unexplained > self.config.field.novelty:
            return
        n = self._n
        P = self._P[:n, :n]
        PG = P @ G.T
        V = G @ PG + noise.covariance(rows.covariances[i], H[:, CLOCK]) + np.diag(10.0 * unexplained * self._prior)
        innovation = np.asarray(rows.residuals[i] - G @ self._x[:n])
        L = np.asarray(np.linalg.cholesky(V), dtype=float)
        whitened = np.column_stack([innovation, PG.T, self._sensitivities(H, G, t)])
        whitened = np.asarray(solve_triangular(L, whitened, lower=True, check_finite=False))
        w, K, D = whitened[:, 0], whitened[:, 1 : 1 + n].T, whitened[:, 1 + n :]  # K: P G' L^-T
        excess = float(w @ w) / _INFLUENCE
        if excess > 1.0 and self.favourite is not None:
            # a frame is judged by the hypothesis that it fits better: else those that show a change best would count
            # least
            k, change = self.favourite
            e = w - D.reshape(_ROWS, -1, SIZE)[:, k] @ change
            excess = min(excess, float(e @ e) / _INFLUENCE)
        if excess > 1.0:
            less = 1.0 / np.sqrt(excess)
            w, K, D = w * less, K * less, D * less
        self._accumulate(D, K, w)
        self._x[:n] += K @ w
        P -= K @ K.T

    def renew_field(self) -> None:
        """Forget the field and the hypotheses, where the arm works at poses that its features do not reach.

        What is known of error, clock and scale stays.
        """
        self._x[SIZE:] = 0.0
        known = self._P[:SIZE, :SIZE].copy()
        self._P[:] = 0.0
        self._P[:SIZE, :SIZE] = known
        self._n = SIZE
        self._field = PoseField(self.config.field)
        self.clear()

    def _rows(self, H: Array, p_C: Array, n_C: Array) -> tuple[Array, float]:
        phi, unexplained = self._field.features(p_C, n_C)
        self.novel += float(unexplained > self.config.field.novelty) - self.novel / _NOVEL_OVER
        n = SIZE + _ROWS * len(phi)
        if n > self._n:
            new = np.arange(self._n, n)
            self._P[new, new] = np.tile(self._prior, len(new) // _ROWS)
            self._n = n
        G = np.zeros((_ROWS, n))
        G[:, :SIZE] = H
        for c in range(_ROWS):
            G[c, SIZE + c :: _ROWS] = phi
        return G, unexplained

    def _sensitivities(self, H: Array, G: Array, t: float) -> Array:
        """H_k - G F (5, k SIZE) of all hypotheses; zero for those that stand for no frame."""
        k = len(self.start)
        D = -(G @ self._F[: self._n]).reshape(_ROWS, k, SIZE)
        ramps = self.kind == RAMP
        share = np.where(ramps, (t - np.where(self.used, self.start_time, t)) / RAMP_S, 1.0) * self.used
        D += H[:, None, :] * share[None, :, None]
        # a clock does not creep with the scanner: it may have jumped
        D[:, ramps, CLOCK] += H[:, None, CLOCK] * (self.used[ramps] - share[ramps])
        return np.asarray(D.reshape(_ROWS, -1))

    def _accumulate(self, D: Array, K: Array, w: Array) -> None:
        on = self.used
        self._F[: self._n] += K @ D
        Dk = D.reshape(_ROWS, len(on), SIZE).transpose(1, 2, 0)  # (k, SIZE, 5)
        self.information += Dk @ Dk.transpose(0, 2, 1)
        self.vector += Dk @ w
        self.squares[on] += float(w @ w)
        self.frames[on] += 1

    def absorb(self, k: int, change: Array, covariance: Array) -> None:
        """Take hypothesis k, with its change (SIZE,) and covariance (SIZE, SIZE), for the truth.

        The estimate is from then on that of the pose after the change; the field that was learnt before it stays.
        Clears the hypotheses.
        """
        n = self._n
        share = 1.0
        if self.kind[k] == RAMP:
            assert self._time is not None
            share = (self._time - float(self.start_time[k])) / RAMP_S
        E = -self._F[:n, k * SIZE : (k + 1) * SIZE]
        E[:SIZE] += np.diag([share] * CLOCK + [1.0 if self.kind[k] == RAMP else share] + [share] * (SIZE - CLOCK - 1))
        self._x[:n] += E @ change
        self._P[:n, :n] += E @ covariance @ E.T
        self.clear()

    def _least_missed(self, slots: NDArray[np.intp]) -> int:
        """Return the hypothesis whose neighbours in time stand for it best: they stay closer the younger they are."""
        order = slots[np.argsort(self.start[slots])]
        s = self.start[order].astype(float)
        gap = (s[2:] - s[:-2]) / (self.count - s[1:-1] + 8.0)
        return int(order[1 + int(np.argmin(gap))])
