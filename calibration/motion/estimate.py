"""Calibrates from frames in motion: chooses the clock and the model, fits, and says what the motion leaves open.

Frames of a stream are many, and near each other: what the arm's kinematics or the scanner's warp do at one place they
do in all frames there, so that their error does not average away with the number of frames. The covariance of residuals
at two places is modelled as variance * exp(-(distance / length)^2 / 2), from products of residuals of different frames
(an empirical covariogram, Cressie 1993, section 2.4), and carried through the weighted fit (the sandwich formula).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import DEVICE, ScannerClock
from weldcal.calibration.errors import InconsistentPoses, TooFewPoses, UndeterminedPoses
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.motion.clock_fit import DRIFT, EDGE, OFFSET, ROLLING, TARGET, ClockFit, fit_clock
from weldcal.calibration.motion.observed import FrameClock, ObservedFrames, arrival_clock, choose_clock
from weldcal.calibration.motion.start import Start, search_in_hand, search_start
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array

_LENGTHS_M = (0.02, 0.04, 0.08, 0.16)
_NEAR_M = 0.02  # products at places so near decide whether there is any such error
_SIGNIFICANT = 4.0  # standard deviations
_MOST = 900  # frames whose pairs are looked at


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """Errors that depend on the place.

    ``sigma_m`` an axis of the centre and ``sigma_rad`` an axis of the normal, correlated over ``length_m``. ``found``
    whether they are significant. ``meat`` (K, K): covariance of the fit's scores that they add.
    """

    found: bool
    sigma_m: float
    sigma_rad: float
    length_m: float
    meat: Array

    def excess(self, inverse: Array) -> Array:
        """What they add to the covariance ``inverse`` (K, K) of the unknowns."""
        return np.asarray(inverse @ self.meat @ inverse)

    @property
    def sentence(self) -> str:
        """One sentence for the user."""
        return (
            f"The errors depend on the place by {1e3 * self.sigma_m:.3f} mm and {np.degrees(self.sigma_rad):.3f}"
            f" degrees an axis (arm or scanner, over some {1e3 * self.length_m:.0f} mm); the stated covariance includes"
            " them."
        )


def find_place_errors(fit: ClockFit, frames: ObservedFrames) -> PlaceErrors:
    """Errors of robot and scanner that depend on the place, from the residuals of a fit of N frames."""
    k = len(fit.free)
    none = PlaceErrors(False, 0.0, 0.0, 0.0, np.zeros((k, k)))
    used = np.flatnonzero(fit.keep)
    if len(used) < 20:
        return none
    used = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), _MOST)).astype(int))]
    place = frames.p_C[used]
    # of a pair, each residual as far as the frame's own time leaves it: across the motion
    e, m = fit.centre[used], fit.lean[used]
    v = fit.rates[used]
    speed = np.maximum(np.linalg.norm(v, axis=1), 1e-9)
    noise = fit.variances.spread + fit.variances.factor * np.trace(frames.covariance[used], axis1=1, axis2=2) / 3.0
    left = noise / (noise + fit.variances.jitter * speed**2)  # of a residual along the motion
    u = v / speed[:, None]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    i, j = np.nonzero(np.triu(apart < 2.0 * max(_LENGTHS_M), 1))
    d = apart[i, j]
    products = (e[i] * e[j]).sum(axis=1)
    cosine = (u[i] * u[j]).sum(axis=1)
    li, lj = 1.0 - left[i], 1.0 - left[j]
    share = 3.0 - li - lj + li * lj * cosine**2  # trace of the product of both projections
    turns = (m[i] * m[j]).sum(axis=1)
    position = _covariogram(d, products, share)
    lean = _covariogram(d, turns, np.full(len(d), 2.0))
    if position is None and lean is None:
        return none
    length = max(found[1] for found in (position, lean) if found is not None)
    var_p = 0.0 if position is None else position[0]
    var_n = 0.0 if lean is None else lean[0]
    every = np.flatnonzero(fit.keep)
    WJ = fit.weights[every] @ fit.jacobian[every]
    at = frames.p_C[every]
    meat = np.zeros((k, k))
    for begin in range(0, len(every), 500):
        part = slice(begin, begin + 500)
        near = np.exp(-0.5 * ((at[part, None] - at[None]) ** 2).sum(axis=2) / length**2)
        for rows, variance in ((slice(0, 3), var_p), (slice(3, 5), var_n)):
            if variance > 0.0:
                summed = np.einsum("ab,bij->aij", near, WJ[:, rows], optimize=True)
                meat += variance * np.einsum("aik,ail->kl", WJ[part, rows], summed, optimize=True)
    return PlaceErrors(True, float(np.sqrt(var_p)), float(np.sqrt(var_n)), length, 0.5 * (meat + meat.T))


def _covariogram(d: Array, products: Array, share: Array) -> tuple[float, float] | None:
    """Variance and length of the correlated error from products of residuals (P,) at distances d (P,).

    None where there is none.
    """
    near = d < _NEAR_M
    if np.count_nonzero(near) < 20:
        return None
    total = float(products[near].sum())
    # without correlation the products are uncorrelated with each other
    if total < _SIGNIFICANT * float(np.sqrt((products[near] ** 2).sum())):
        return None
    best: tuple[float, float, float] | None = None
    for length in _LENGTHS_M:
        inside = d < 2.0 * length
        shape = np.exp(-0.5 * (d[inside] / length) ** 2) * share[inside]
        variance = float((shape * products[inside]).sum() / (shape**2).sum())
        every = np.exp(-0.5 * (d / length) ** 2) * share
        misfit = float(((products - variance * every) ** 2).sum())
        if variance > 0.0 and (best is None or misfit < best[0]):
            best = (misfit, variance, length)
    return None if best is None else (best[1], best[2])


Flags = NDArray[np.bool_]

FEWEST = 6  # frames
_FOLDS = 5
_ROLLING_SIGMAS = 4.0  # beyond which a rolling shutter counts as seen
_LEAST_SHARE = 0.5  # of the frames must agree on one pose
_WORST_M = 0.02  # spread of the residuals across the motion: beyond, nothing fits
# what an unknown may vary by (one sigma) and still count as determined: rad, m, s, s/s, s
_OPEN = np.array([1e-2] * 3 + [5e-3] * 3 + [2e-2, 1e-3, 2e-2, 1e2] + [5e-3] * 3 + [1e-2] * 2)
_WEAK = 0.2  # of that: worth a sentence
_UNEVEN_S = 0.005  # a device's clock that jitters by more may be worse than the arrivals
_NAMES = (
    "rotation about x",
    "rotation about y",
    "rotation about z",
    "x",
    "y",
    "z",
    "clock offset",
    "clock drift",
    "rolling time",
    "edge",
    "target's x",
    "target's y",
    "target's z",
    "target's tilt about x",
    "target's tilt about y",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionEstimate:
    """Calibration from N frames in motion.

    ``covariance`` (6, 6) of X_BC as in CalibrationResult; ``joint`` (6 + K, 6 + K) with the clock's unknowns behind it,
    offset (s), drift, rolling (s) as far as ``names`` lists them. ``clock`` what was found of it. ``inliers`` (N,)
    frames used. ``capture`` (N,) s their most probable capture times on the robot's clock. ``residual_m`` (N,) distance
    of the centres there, ``along_m`` (N,) along the motion at the time that the clock says, ``before_m`` (N,) the same
    if arrivals are taken for captures (X_BC fitted so), ``tilt_rad`` (N,). ``held_out_m``,
    ``held_out_tilt_rad`` (N,) from fits without the frame's own block of time. ``speed`` (N,) m/s.
    """

    X_BC: RigidTransform
    covariance: Array
    joint: Array
    names: tuple[str, ...]
    clock: ScannerClock
    fit: ClockFit
    start: Start
    places: PlaceErrors
    inliers: Flags
    capture: Array
    speed: Array
    residual_m: Array
    along_m: Array
    before_m: Array
    tilt_rad: Array
    held_out_m: Array
    held_out_tilt_rad: Array
    unobservable: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def sigma_position_m(self) -> float:
        """Spread of the centres beyond the noise of their fits, an axis."""
        return float(np.sqrt(self.fit.variances.spread))

    @property
    def sigma_normal_rad(self) -> float:
        """Spread of the normals beyond the noise of their fits, an axis."""
        return float(np.sqrt(self.fit.variances.lean))


def estimate_in_motion(
    frames: ObservedFrames, motion: ContinuousMotion, X_FR: RigidTransform | None = None, *, held_out: bool = True
) -> MotionEstimate:
    """X_BC and the scanner's clock from frames in motion.

    With an inverted ``motion``, of a scanner on the flange that sees a fixed target, X_FC takes the place of X_BC, and
    the target's pose, found with it, is ``fit.X_FR``. ``X_FR`` is then not used.

    The device's clock is used where it runs evenly, else the arrivals. The clock's drift is estimated for a device, a
    rolling time within the frame where it is significant. Without motion that shows the offset, X_BC comes from the
    frames as they are and the offset is None. Raises TooFewPoses, InconsistentPoses, and UndeterminedPoses where the
    motion leaves X_BC open.
    """
    if len(frames) < FEWEST:
        raise TooFewPoses(f"Only {len(frames)} frames show the flange; {FEWEST} are needed, some hundred are good.")
    clock = choose_clock(frames)
    start, fit = _fitted(frames, clock, motion, X_FR)
    said: list[str] = []
    if clock.kind == DEVICE and fit.variances.jitter > _UNEVEN_S**2:
        other = arrival_clock(frames, "The device's times jitter more than the arrivals.")
        other_start, other_fit = _fitted(frames, other, motion, X_FR)
        if other_fit.variances.jitter < fit.variances.jitter:
            clock, start, fit = other, other_start, other_fit
    _check(fit, frames)
    places = find_place_errors(fit, frames)
    inverse, open_names, weak = _determined(fit, places)
    if OFFSET in fit.free and "clock offset" in open_names:
        fit = fit_clock(
            frames,
            clock,
            motion,
            fit.X_BC,
            -clock.sign * start.delay_s,
            X_FR=fit.X_FR,
            free=(0, 1, 2, 3, 4, 5, *(() if frames.slide is None else (EDGE,)), *_target(motion)),
        )
        places = find_place_errors(fit, frames)
        inverse, open_names, weak = _determined(fit, places)
        told = [
            "The motion does not show the clock's offset: the arm hardly moves, or all of it can as well be a shift of"
            " the scanner."
        ]
    else:
        told = []
    if open_names:
        raise UndeterminedPoses(
            f"The motion leaves X_BC open ({', '.join(open_names)}): move the flange in more than one direction, to and"
            " fro, and tilt it by ten degrees or more."
        )
    told += [f"The motion shows {name} only to about {sigma}." for name, sigma in weak]
    outside = ~np.isfinite(fit.centre[:, 0]) | ~(motion.known(fit.nominal))
    if outside.any():
        said.append(
            f"{int(outside.sum())} frames were taken outside the robot's stream or in its gaps; they are not used."
        )
    if fit.late.any():
        said.append(
            f"{int(fit.late.sum())} frames came grossly late or early; they do not count for the clock's offset."
        )
    if clock.kind != DEVICE and frames.device is not None:
        said.append(f"The device times are not used. {clock.reason}")
    if places.found:
        said.append(places.sentence)
    T = np.eye(len(inverse))
    T[3:6, :3] = -skew(np.asarray(fit.X_BC.translation()) - fit.pivot)
    joint = T @ inverse @ T.T
    kept = [k for k, name in enumerate(fit.free) if name < EDGE]
    joint = 0.5 * (joint + joint.T)[np.ix_(kept, kept)]
    names = tuple(_NAMES[fit.free[k]] for k in kept)
    held = _held_out(frames, clock, motion, fit, fit.X_FR) if held_out else (np.full(len(frames), np.nan),) * 2
    before, speed, along = _along(frames, clock, motion, fit, start, fit.X_FR)
    return MotionEstimate(
        X_BC=fit.X_BC,
        covariance=joint[:6, :6],
        joint=joint,
        names=names,
        clock=_scanner_clock(fit, clock, frames, dict(zip(names, np.sqrt(np.diag(joint)), strict=True))),
        fit=fit,
        start=start,
        places=places,
        inliers=fit.keep,
        capture=fit.capture,
        speed=speed,
        residual_m=np.linalg.norm(fit.centre, axis=1),
        along_m=along,
        before_m=before,
        tilt_rad=np.linalg.norm(fit.lean, axis=1),
        held_out_m=held[0],
        held_out_tilt_rad=held[1],
        unobservable=tuple(told),
        warnings=tuple(said),
    )


def _fitted(
    frames: ObservedFrames, clock: FrameClock, motion: ContinuousMotion, X_FR: RigidTransform | None
) -> tuple[Start, ClockFit]:
    """Start and fit with the unknowns that the data ask for."""
    start = search_in_hand(frames, clock, motion) if motion.inverted else search_start(frames, clock, motion, X_FR)
    if start is None:
        begin, end = motion.span
        raise InconsistentPoses(
            f"Too few frames were taken within the robot's stream ({begin:.3f} to {end:.3f} s); record both over the"
            " same time."
        )
    X_FR = start.X_FR if motion.inverted else X_FR
    edge = () if frames.slide is None else (EDGE,)
    target = _target(motion)
    plain = (0, 1, 2, 3, 4, 5, OFFSET, *((DRIFT,) if clock.kind == DEVICE else ()))
    free = (*plain, *edge, *target)
    fit = fit_clock(frames, clock, motion, start.X_BC, -clock.sign * start.delay_s, X_FR=X_FR, free=free)
    rolling = fit_clock(
        frames, clock, motion, fit.X_BC, fit.offset, X_FR=fit.X_FR, free=(*plain, ROLLING, *edge, *target), after=fit
    )
    covariance, _ = _inverse(rolling.information, rolling.free)
    sigma = float(np.sqrt(covariance[len(plain), len(plain)]))
    if abs(rolling.rolling) > _ROLLING_SIGMAS * sigma and sigma < _OPEN[ROLLING]:
        again = fit_clock(
            frames,
            clock,
            motion,
            rolling.X_BC,
            rolling.offset,
            X_FR=rolling.X_FR,
            free=(*plain, ROLLING, *edge, *target),
        )
        return start, again
    return start, fit


def _target(motion: ContinuousMotion) -> tuple[int, ...]:
    """Hold the unknowns of a fixed target, where there is one."""
    return TARGET if motion.inverted else ()


def _corrected(frames: ObservedFrames, fit: ClockFit) -> Array:
    """Centres (N, 3) m in the camera frame, with the edges at the height that the fit found."""
    return frames.p_C if frames.slide is None else frames.p_C + fit.edge * frames.slide


def _check(fit: ClockFit, frames: ObservedFrames) -> None:
    used = int(fit.keep.sum())
    if used < FEWEST:
        raise TooFewPoses(
            f"Only {used} of {len(frames)} frames agree with one pose of the scanner; {FEWEST} are needed."
        )
    if used < _LEAST_SHARE * int(np.isfinite(fit.centre[:, 0]).sum()) or fit.variances.spread > _WORST_M**2:
        raise InconsistentPoses(
            f"Only {used} of {len(frames)} frames agree with one pose of the scanner (spread"
            f" {1e3 * fit.variances.spread**0.5:.1f} mm); check units, the quaternion order and that stream.csv holds"
            " the flange's poses."
        )


def _inverse(information: Array, free: tuple[int, ...]) -> tuple[Array, Array]:
    """Covariance (K, K) and, in units of what counts as determined, its principal variances (K,) ascending."""
    unit = _OPEN[list(free)]
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    variances = 1.0 / np.maximum(values, 1e-9)
    root = vectors * np.sqrt(variances)
    return np.asarray(unit[:, None] * (root @ root.T) * unit), variances[::-1]


def _determined(fit: ClockFit, places: PlaceErrors) -> tuple[Array, tuple[str, ...], list[tuple[str, str]]]:
    """Return the covariance of the unknowns about the pivot, and names of those that the motion leaves open or weak."""
    inverse, _ = _inverse(fit.information, fit.free)
    inverse = inverse + places.excess(inverse)
    sigma = np.sqrt(np.diag(inverse))
    share = sigma / _OPEN[list(fit.free)]
    names = [_NAMES[k] for k in fit.free]
    opened = tuple(n for n, s in zip(names, share, strict=True) if s > 1.0)
    weak = []
    for k, name, s, value in zip(fit.free, names, share, sigma, strict=True):
        if _WEAK < s <= 1.0 and k < DRIFT:
            text = f"{np.degrees(value):.2f} degrees" if k < 3 else f"{1e3 * value:.1f} " + ("mm" if k < 6 else "ms")
            weak.append((name, text))
    return inverse, opened, weak


def _scanner_clock(fit: ClockFit, clock: FrameClock, frames: ObservedFrames, sigma: dict[str, float]) -> ScannerClock:
    offset, drift, rolling = (_NAMES[k] for k in (OFFSET, DRIFT, ROLLING))
    known = offset in sigma
    device = clock.kind == DEVICE
    return ScannerClock(
        kind=clock.kind,
        offset_s=fit.offset + clock.shift if known else None,
        sigma_s=float(sigma[offset]) if known else None,
        jitter_s=float(np.sqrt(fit.variances.jitter)) if known else None,
        # the device's own time
        reference_s=clock.reference - clock.shift,
        drift=fit.drift if device and drift in sigma else None,
        drift_sigma=float(sigma[drift]) if device and drift in sigma else None,
        rolling_s=fit.rolling if rolling in sigma else None,
        rolling_sigma_s=float(sigma[rolling]) if rolling in sigma else None,
        late=tuple(id for id, late in zip(frames.ids, fit.late, strict=True) if late),
        reason=clock.reason,
    )


def _along(
    frames: ObservedFrames,
    clock: FrameClock,
    motion: ContinuousMotion,
    fit: ClockFit,
    start: Start,
    X_FR: RigidTransform | None,
) -> tuple[Array, Array, Array]:
    """Residuals along the motion (N,) m without and with the clock's offset, and the speeds (N,) m/s."""
    plain = search_start(frames, arrival_clock(frames), motion, X_FR, delays=np.array([0.0]))
    out = []
    for X, t in ((plain.X_BC if plain is not None else start.X_BC, frames.arrival), (fit.X_BC, fit.nominal)):
        at = motion.feature(t, X_FR)
        e = _corrected(frames, fit) @ X.rotation().matrix().T + X.translation() - at.p
        speed = np.linalg.norm(at.v, axis=1)
        out.append(np.where(speed > 1e-3, (e * at.v).sum(axis=1) / np.maximum(speed, 1e-3), np.nan))
    return out[0], speed, out[1]


def _held_out(
    frames: ObservedFrames, clock: FrameClock, motion: ContinuousMotion, fit: ClockFit, X_FR: RigidTransform | None
) -> tuple[Array, Array]:
    """Errors (N,) of each frame by a fit without its own block of time.

    Of the centre (m) at its most probable capture time, and of the normal (rad).
    """
    n = len(frames)
    position, tilt = np.full((2, n), np.nan)
    used = np.flatnonzero(fit.keep)
    if len(used) < 2 * _FOLDS:
        return position, tilt
    for block in np.array_split(used, _FOLDS):
        keep = fit.keep.copy()
        keep[block] = False
        try:
            without = fit_clock(
                frames, clock, motion, fit.X_BC, fit.offset, X_FR=X_FR, free=fit.free, keep=keep, after=fit
            )
        except (np.linalg.LinAlgError, TooFewPoses):
            continue
        _, variances = _inverse(without.information, without.free)
        if variances.max() > 1.0:
            continue  # this block alone shows what the others leave open
        position[block] = np.linalg.norm(without.centre[block], axis=1)
        tilt[block] = np.linalg.norm(without.lean[block], axis=1)
    return position, tilt
