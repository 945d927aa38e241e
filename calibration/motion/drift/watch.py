"""Monitor a calibration over a recording: synchronise, test for drift, separate scanner from base, recalibrate."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.data.scanner_correction import DEVICE, correction_from_document
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.motion.drift.residuals import CLOCK, FrameNoise, Rows, measured_noise, rows_of
from weldcal.calibration.motion.drift.sequential import WARM_UP, DriftConfig, DriftEvent, DriftTest, drift_config
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.motion.synchronise import Synchronised, synchronise
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

Mask = NDArray[np.bool_]

_STILL_M = 2e-3  # robust spread of a pixel's depth that shows the same thing in all frames
_SEEN = 0.6  # of the frames that must measure a pixel
_STEP_M = 0.004  # in depth between neighbours: an edge, whose normal says nothing
_LEAST_PIXELS = 2000
_SURE = 0.15  # sigma of the share from which on it decides
_CORRELATED = 25.0  # pixels that share their noise
_CLIP = 4.0  # robust deviations, a choice: 6 in 100,000 normal draws lie beyond

SCANNER, BASE = "the scanner moved", "the robot's base moved, and the scanner did not"

_GROSS = 60.0  # chi-square with 5 of a frame that shows something else
_LARGE_M, _LARGE_RAD = 1e-3, 2e-3  # a move that may have disturbed the clock's fit
_ARRIVAL_JITTER_S, _DEVICE_JITTER_S = 0.015, 3e-4  # where too few frames show it


@dataclass(frozen=True)
class BackgroundMove:
    """How much of the predicted move the still background made in the camera.

    ``share`` is 1 where the scanner moved and 0 where the base did; with its ``sigma``, from so many ``pixels``.
    """

    share: float
    sigma: float
    pixels: int

    @property
    def cause(self) -> str | None:
        """What moved, as a sentence without a full stop; None where the background does not decide."""
        if self.sigma > _SURE:
            return None
        if abs(self.share - 1.0) < 0.35:
            return SCANNER
        return BASE if abs(self.share) < 0.35 else None


def background_move(before: Sequence[Array], after: Sequence[Array], X_AB: RigidTransform) -> BackgroundMove | None:
    """Compare organised clouds (H, W, 3) m of before and after a change.

    If the scanner moved, a still thing at p before is at X_AB p in the camera after it.

    Each pixel's median over the frames shows what stands still; the arm passes through. Along the normal, a still
    surface at p moves by n . (X_AB p - p) under its ray, and the share of it that shows is a weighted mean over all
    pixels. What the scanner errs at a pixel is the same before and after. None where the clouds are not organised or
    little stands still.
    """
    clouds = [*before, *after]
    if not before or not after or any(c.ndim != 3 or c.shape != clouds[0].shape for c in clouds):
        return None
    first, still = _median(before)
    second, also = _median(after)
    normal, smooth = _normals(first)
    use = still & also & smooth & (np.abs(second[..., 2] - first[..., 2]) < 10.0 * _STILL_M)
    if int(use.sum()) < _LEAST_PIXELS:
        return None
    p, n = first[use], normal[use]
    told = (n * (second[use] - p)).sum(axis=1)
    moved = p @ X_AB.rotation().matrix().T + X_AB.translation() - p
    expected = (n * moved).sum(axis=1)
    weight = np.ones(len(p))
    share = 0.0
    for _ in range(6):
        share = float((weight * told * expected).sum() / max(float((weight * expected**2).sum()), 1e-18))
        e = told - share * expected
        scale = MAD * float(np.median(np.abs(e))) + 1e-7
        weight = (np.abs(e) < _CLIP * scale).astype(float)
    sigma = float(np.sqrt(_CORRELATED * scale**2 / max(float((weight * expected**2).sum()), 1e-18)))
    return BackgroundMove(share, sigma, int(weight.sum()))


def _median(clouds: Sequence[Array]) -> tuple[Array, Mask]:
    """Return the median point of each pixel (H, W, 3), and whether the pixel shows one object at rest."""
    z = np.stack([c[..., 2] for c in clouds])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that no frame measured
        middle = np.nanmedian(z, axis=0)
        spread = MAD * np.nanmedian(np.abs(z - middle), axis=0)
        ray = np.nanmedian(np.stack([c[..., :2] / c[..., 2:] for c in clouds]), axis=0)
    seen = np.isfinite(z).mean(axis=0) >= _SEEN
    point = np.concatenate([ray * middle[..., None], middle[..., None]], axis=-1)
    return point, np.asarray(seen & (spread < _STILL_M))


def _normals(p: Array) -> tuple[Array, Mask]:
    """Unit normals (H, W, 3) from differences over five pixels, and where they are those of one smooth surface."""
    across, down = np.full_like(p, np.nan), np.full_like(p, np.nan)
    across[:, 2:-2], down[2:-2] = p[:, 4:] - p[:, :-4], p[4:] - p[:-4]
    n = np.cross(across, down)
    size = np.linalg.norm(n, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        n = n / size[..., None]
        steps = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
        smooth = np.isfinite(n).all(axis=-1) & (steps < 4.0 * _STEP_M)
    return np.where(smooth[..., None], n, 0.0), np.asarray(smooth)


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftHistory:
    """What a recording says of a calibration, for its N tracked frames in the order of their times.

    ``rows`` are the residuals against the calibration at the nominal capture times. ``residuals`` (N, 3) m and
    ``tilts`` (N, 2) rad those after each frame's own time is taken out as far as the jitter allows. ``offsets`` (N,) s
    is by how much each frame was later than nominal. ``before`` (N, 3) m are the residuals of frames taken for as old
    as their arrival, ``after`` (N, 3) m those against the pose that held at the time. ``gross`` (N,) frames show
    something else. ``statistic`` (N,) is the drift test's largest, over ``threshold``. ``X_BC`` and ``covariance`` (6,
    6) are those at the end; ``since_s`` is from when on they hold. ``dropped`` lists (id, reason).
    """

    ids: tuple[str, ...]
    rows: Rows
    residuals: Array
    tilts: Array
    before: Array
    after: Array
    offsets: Array
    gross: NDArray[np.bool_]
    statistic: Array
    threshold: float
    events: tuple[DriftEvent, ...]
    X_BC: RigidTransform
    covariance: Array
    since_s: float
    clock: Synchronised
    noise: FrameNoise
    dropped: tuple[tuple[str, str], ...] = field(default_factory=tuple)

    @property
    def rms_m(self) -> float:
        """Root mean square distance (m) between flange and robot, against the calibration as it was given."""
        return _rms(self.residuals, self.gross)

    @property
    def rms_after_m(self) -> float:
        """The same against the pose that held at each time."""
        return _rms(self.after, self.gross)


def watch(
    result: CalibrationResult,
    frames: ObservedFrames,
    motion: ContinuousMotion,
    *,
    X_FR: RigidTransform | None = None,
    dropped: Sequence[tuple[str, str]] = (),
    config: DriftConfig | None = None,
) -> DriftHistory:
    """Watch a calibration over the frames of a recording.

    Raises InputError where no frame lies within the robot's stream.
    """
    frames = _corrected(result, frames)
    clock = synchronise(frames, motion, result.X_BC, X_FR=X_FR, known=result.clock)
    found = _tested(result, frames, motion, clock, X_FR, dropped, config)
    moved = [e for e in found.events if e.kind != WARM_UP]
    large = any(
        float(np.linalg.norm(e.translation_m)) > _LARGE_M or float(np.linalg.norm(e.rotation_rad)) > _LARGE_RAD
        for e in moved
    )
    if large and clock.source == "recording":
        p_C, n_C = _as_before(result.X_BC, moved, clock.times, frames)
        clock = synchronise(replace(frames, p_C=p_C, n_C=n_C), motion, result.X_BC, X_FR=X_FR, known=result.clock)
        found = _tested(result, frames, motion, clock, X_FR, dropped, config)
    return found


def _tested(
    result: CalibrationResult,
    frames: ObservedFrames,
    motion: ContinuousMotion,
    clock: Synchronised,
    X_FR: RigidTransform | None,
    dropped: Sequence[tuple[str, str]],
    config: DriftConfig | None,
) -> DriftHistory:
    at = motion.feature(clock.times, X_FR)
    inside = np.isfinite(at.p).all(axis=1) & np.isfinite(at.v).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(clock.times[inside], kind="stable")]
    if not len(order):
        raise InputError("No frame was taken while the robot's stream was recorded; give both on the robot's clock.")
    said = [
        *dropped,
        *((frames.ids[k], "The robot's stream has no data at its capture.") for k in np.flatnonzero(~inside)),
    ]
    pivot = at.p[order].mean(axis=0)

    def rows_with(p_C: Array, n_C: Array) -> Rows:
        """Return the residuals with these centres and normals of the frames."""
        seen = (p_C, n_C, frames.covariance, frames.normal_sigma)
        return rows_of(result.X_BC, pivot, *(a[order] for a in (clock.times, at.p, at.n, at.v, at.turn, *seen)))

    rows = rows_with(frames.p_C, frames.n_C)
    usual = clock.jitter_s or (_DEVICE_JITTER_S if clock.clock.kind == DEVICE else _ARRIVAL_JITTER_S)
    noise = measured_noise(rows) or FrameNoise(jitter_s=usual)
    interval = float(np.median(np.diff(rows.times))) if len(rows) > 1 else 0.05
    test = DriftTest(
        result.X_BC,
        result.covariance,
        pivot,
        drift_config(1e-3 * result.sigma_position_mm, clock.sigma_s, config),
        noise,
        1.0 / max(interval, 1e-3),
    )
    statistic, events = np.zeros(len(rows)), []
    for i in range(len(rows)):
        events += test.update(rows.part(slice(i, i + 1)))
        statistic[i] = test.statistic
    events += test.finish()
    X, covariance = test.current()
    moves = [e for e in events if e.kind != WARM_UP]
    p_C, n_C = _as_before(result.X_BC, moves, clock.times, frames)
    held = rows_with(p_C, n_C)
    late, gross = _lateness(held, noise)
    moved = late[:, None] * rows.derivatives[:, :, CLOCK]
    residuals, tilts = (rows.residuals - moved)[:, :3], (rows.residuals - moved)[:, 3:]
    at_arrival = motion.feature(clock.clock.base[order], X_FR).p
    before = rows.residuals[:, :3] + at.p[order] - at_arrival
    after = held.residuals[:, :3] - moved[:, :3]
    return DriftHistory(
        ids=tuple(frames.ids[k] for k in order),
        rows=rows,
        residuals=residuals,
        tilts=tilts,
        before=before,
        after=after,
        offsets=late,
        gross=gross,
        statistic=statistic,
        threshold=test.threshold,
        events=tuple(events),
        X_BC=X,
        covariance=covariance,
        since_s=moves[-1].time_s if moves else float(rows.times[0]),
        clock=clock,
        noise=noise,
        dropped=tuple(said),
    )


def _lateness(rows: Rows, noise: FrameNoise) -> tuple[Array, NDArray[np.bool_]]:
    """Return how much later than nominal each frame was most probably taken (N,) s, and the gross frames (N,).

    Gross frames show something else.
    """
    u = rows.derivatives[:, :, CLOCK]
    factors = np.repeat([noise.center, noise.normal], [3, 2])
    S = rows.covariances * np.outer(factors, factors)
    Wu = np.linalg.solve(S, u[:, :, None])[:, :, 0]
    told = np.einsum("ni,ni->n", Wu, u) + 1.0 / max(noise.jitter_s, 1e-7) ** 2
    late = np.einsum("ni,ni->n", Wu, rows.residuals) / told
    # a frame that shows something else is far from its neighbours
    away = rows.residuals - np.array(
        [np.median(rows.residuals[max(0, i - 7) : i + 8], axis=0) for i in range(len(rows))]
    )
    rest = away - (np.einsum("ni,ni->n", Wu, away) / told)[:, None] * u
    gross = np.einsum("ni,ni->n", rest, np.linalg.solve(S, rest[:, :, None])[:, :, 0]) > _GROSS
    return late, np.asarray(gross)


def _as_before(
    X_BC: RigidTransform, moves: Sequence[DriftEvent], times: Array, frames: ObservedFrames
) -> tuple[Array, Array]:
    """Return centres and normals (N, 3) as the scanner would have measured them from X_BC, had it not moved.

    A creep counts from its middle.
    """
    p_C, n_C = frames.p_C.copy(), frames.n_C.copy()
    for e, following in zip(moves, [*moves[1:], None], strict=False):
        now = times >= e.time_s
        if following is not None:
            now &= times < following.time_s
        D = X_BC.inverse() @ e.X_BC_after
        p_C[now] = (D @ frames.p_C[now].T).T
        n_C[now] = frames.n_C[now] @ D.rotation().matrix().T
    return p_C, n_C


def _corrected(result: CalibrationResult, frames: ObservedFrames) -> ObservedFrames:
    correction = correction_from_document(result.scanner_correction)
    if correction is None:
        return frames
    return replace(frames, p_C=correction.points(frames.p_C), n_C=correction.normals(frames.p_C, frames.n_C))


def _rms(residuals: Array, gross: NDArray[np.bool_]) -> float:
    """Root mean square length of residuals (N, 3), without gross frames unless all are."""
    used = residuals if gross.all() else residuals[~gross]
    return float(np.sqrt((used**2).sum(axis=1).mean()))
