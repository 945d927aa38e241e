"""Fits the flange in every frame of a recording.

A search in some frames, then near where the robot's stream says it is.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.motion_dataset import FrameTime, MotionDataset
from weldcal.calibration.errors import FlangeNotFound, TooFewPoses
from weldcal.calibration.flange.face import IN_MOTION
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.calibration.motion.observed import ObservedFrames, choose_clock
from weldcal.calibration.motion.start import search_in_hand, search_start
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

_FIRST, _LEAST_FIRST = 12, 5  # frames that are searched whole, and how many must show the flange
_MOST_TRIED = 48
_AGAIN = 60  # fits after which the prediction is made anew
_RADIUS = 0.85  # of the flange's diameter: about the predicted centre, some 15 mm wrong with a jitter of 15 ms
_MOST_LOST = 12  # frames in a row that a whole search does not help either
# Edges of a rough face at a slant scatter by their share of its noise, beside the common error that the calibration
# estimates.
_ROUGH_M, _SLANT = 3e-4, 1.0

Tell = Callable[[float], None]


class FittedFrames:
    """Fits of the frames of a recording.

    ``observed`` as arrays, ``fits`` by id, and (id, reason) of those ``refused``.
    """

    def __init__(self, data: MotionDataset) -> None:
        self.fits: dict[str, FlangeFit] = {}
        self.refused: list[tuple[str, str]] = list(data.refused)
        self._frames = data.frames

    @property
    def observed(self) -> ObservedFrames:
        """Frames that show the flange, in the order of arrival."""
        return observed_frames([f for f in self._frames if f.id in self.fits], self.fits)


def observed_frames(frames: list[FrameTime], fits: dict[str, FlangeFit]) -> ObservedFrames:
    """Return times and fits of frames as arrays; a rough face at a slant has less weight along the slant."""
    device = np.array([np.nan if f.device is None else f.device for f in frames])
    found = [fits[f.id] for f in frames]
    return ObservedFrames(
        ids=tuple(f.id for f in frames),
        arrival=np.array([f.arrival for f in frames], dtype=float),
        device=device if np.isfinite(device).any() else None,
        p_C=np.array([f.center_C for f in found]).reshape(-1, 3),
        n_C=np.array([f.normal_C for f in found]).reshape(-1, 3),
        covariance=np.array([fit_covariance(f) for f in found]).reshape(-1, 3, 3),
        normal_sigma=np.array([f.normal_sigma for f in found], dtype=float),
        slide=np.array([f.plane_rms_m * _slant(f) for f in found]).reshape(-1, 3),
    )


def fit_covariance(fit: FlangeFit) -> Array:
    """Covariance (3, 3) m^2 of a fit's centre, with what the noise of a face at a slant does to its edges."""
    slant = _slant(fit)
    rough = _SLANT * max(fit.plane_rms_m - _ROUGH_M, 0.0)
    return np.asarray(fit.center_covariance + rough**2 * np.outer(slant, slant))


def _slant(fit: FlangeFit) -> Array:
    """How far a centre (3,) moves across the face per metre that its edges are taken too low.

    The line of sight slides along the face.
    """
    view = fit.center_C / np.linalg.norm(fit.center_C)
    along = float(view @ fit.normal_C)
    return np.asarray((view - along * fit.normal_C) / max(abs(along), 0.1))


def see_frames(
    data: MotionDataset,
    standard: FlangeStandard,
    motion: ContinuousMotion,
    *,
    X_BC: RigidTransform | None = None,
    seed: int = 0,
    tell: Tell = lambda fraction: None,
) -> FittedFrames:
    """Fit the flange in every frame.

    Some frames, spread over the recording, are searched whole. They give a first X_BC and delay, and with them the
    robot's stream says where the flange is in each other frame. Where it is not there, the whole frame is searched.
    ``X_BC``: pose to begin with. An inverted ``motion`` is that of a fixed target before a scanner on the flange.
    Deterministic for ``seed``. Raises TooFewPoses where too few frames show the flange to begin.
    """
    seen = FittedFrames(data)
    finder = _Finder(data, standard, seed)
    X_start = None if motion.inverted else X_BC or data.X_BC_guess
    reach = _RADIUS * standard.outer_m
    if data.header.scanner_guess is not None and X_BC is None:
        reach += data.header.scanner_guess.radius_m
    count = len(data.frames)
    spread = np.unique(np.linspace(0, count - 1, min(count, _MOST_TRIED)).astype(int))
    order = [int(k) for k in spread[np.argsort(_scattered(len(spread)), kind="stable")]]
    tried = set()
    for k in order:
        if len(seen.fits) >= min(_FIRST, count):
            break
        tried.add(k)
        tell(0.1 * len(seen.fits) / _FIRST)
        frame = data.frames[k]
        near = None
        if X_start is not None:
            near = _place(data, motion, X_start, frame.arrival, reach)
        finder.fit(frame.id, near, seen, whole=True)
    if len(seen.fits) < min(_LEAST_FIRST, count):
        raise TooFewPoses(_nothing(seen, len(tried)))
    prediction = _Prediction(data, motion, seen)
    lost, since = 0, 0
    for k, frame in enumerate(data.frames):
        if k in tried:
            continue
        tell(0.1 + 0.9 * k / count)
        near = prediction.guess(k, _RADIUS * standard.outer_m)
        whole = near is None or lost < _MOST_LOST
        found = finder.fit(frame.id, near, seen, whole=whole)
        lost = 0 if found else lost + int(whole)
        since += found
        if since == _AGAIN:
            prediction = _Prediction(data, motion, seen)
    return seen


class _Finder:
    def __init__(self, data: MotionDataset, standard: FlangeStandard, seed: int) -> None:
        self.data, self.standard, self.config = data, standard, replace(IN_MOTION, seed=seed)

    def fit(self, id: str, near: FlangeGuess | None, seen: FittedFrames, *, whole: bool) -> bool:
        """Fit one frame; the reason of a refusal is noted."""
        try:
            points = self.data.cloud(id)
        except CloudError as e:
            seen.refused.append((id, e.reason))
            return False
        reason = ""
        for guess in ([near] if near is not None else []) + ([None] if whole else []):
            try:
                seen.fits[id] = fit_flange(points, self.standard, guess=guess, config=self.config)
                return True
            except FlangeNotFound as e:
                reason = reason or e.reason
        seen.refused.append((id, reason))
        return False


class _Prediction:
    """Where the flange is in each frame, from a first X_BC and delay."""

    def __init__(self, data: MotionDataset, motion: ContinuousMotion, seen: FittedFrames) -> None:
        observed = seen.observed
        clock = choose_clock(observed)
        start = (
            search_in_hand(observed, clock, motion)
            if motion.inverted
            else search_start(observed, clock, motion, data.X_FR)
        )
        self.p = np.full((len(data.frames), 3), np.nan)
        self.n = self.p.copy()
        if start is None:
            return
        by_device = clock.sign > 0.0
        base = np.array(
            [(np.nan if f.device is None else f.device + clock.shift) if by_device else f.arrival for f in data.frames]
        )
        at = motion.feature(base - start.delay_s, start.X_FR if motion.inverted else data.X_FR)
        R = start.X_BC.rotation().matrix()
        self.p, self.n = (at.p - start.X_BC.translation()) @ R, at.n @ R

    def guess(self, k: int, radius: float) -> FlangeGuess | None:
        """Where to look in frame k; None where the stream has no data or the place is behind the scanner."""
        if not np.isfinite(self.p[k]).all() or self.p[k, 2] <= 0.0:
            return None
        return FlangeGuess(self.p[k], radius, self.n[k])


def _place(
    data: MotionDataset, motion: ContinuousMotion, X_BC: RigidTransform, t: float, radius: float
) -> FlangeGuess | None:
    at = motion.feature(np.array([t]), data.X_FR)
    if not np.isfinite(at.p).all():
        return None
    R = X_BC.rotation().matrix()
    return FlangeGuess((at.p[0] - X_BC.translation()) @ R, radius, at.n[0] @ R)


def _scattered(n: int) -> Array:
    """Ranks (n,) that visit a row of n things evenly from the first few on.

    Van der Corput's sequence by the golden ratio.
    """
    return np.asarray(np.mod(np.arange(n) * 0.6180339887498949, 1.0))


def _nothing(seen: FittedFrames, tried: int) -> str:
    reasons = Counter(reason for _, reason in seen.refused)
    common = reasons.most_common(1)[0][0] if reasons else "there are too few frames"
    return (
        f"Only {len(seen.fits)} of {tried} frames spread over the recording show the flange; {_LEAST_FIRST} are needed"
        f" to begin. Most frequent reason: {common}"
    )
