"""Estimates a soft tip's creep and loss from a cycle of loading and unloading."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from weldcal.models.errors import InputError
from weldcal.models.tools.elastomers import TRANSITION_M, Elastomer
from weldcal.welding.numerics import Array

FEWEST_ROWS = 40  # a choice: five for each of eight unknowns
LEAST_PRESS_M = 0.5e-3  # a choice, as in calibrate_tip
MOST_PRESS_M = 0.02  # a choice: no finger of this kind moves as far; more is another unit
SLOWEST_ROWS_S = 5.0  # a choice: between two rows of a table in s; more is another unit
BACK = 0.5  # share of the largest indentation that the unloading must take back
HELD = 1.5  # relaxation times that the table must last from the first press on
SEEN = 3.0  # standard deviations from zero that an estimate needs to be one
ALIKE = 0.35  # a choice: correlation of neighbouring residuals above which they are no noise
_TIMES = 24  # starting relaxation times
_MOST = 0.9  # largest share that is searched


class LoadingError(InputError):
    """A loading cycle that cannot show creep and loss."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LoadingEstimate:
    """Creep and loss of a tip.

    Attributes:
        tip: relaxation time in s, share of the force that relaxes, share of a slow press's work that is lost.
        sigmas: (3,) of these, in the same order.
        stiffness_N_per_m: after relaxation; None without a force.
        residual: rms of what the fit leaves, N or m.
        concerns: sentences on what the cycle does not show.
    """

    tip: Elastomer
    sigmas: Array
    stiffness_N_per_m: float | None
    residual: float
    concerns: tuple[str, ...]


def response(unknowns: Array, time_s: Array, indentation_m: Array, tag: bool) -> Array:
    """Return what a tip answers to an indentation (n,) m: the force, or with `tag` its deflection as the tag shows it.

    `unknowns` (7,): stiffness N/m (with `tag` the contact's over the tip's), offset of the answer, log of the relaxation
    time in s, r and b (see models/tools/elastomers), log of the deflection in m over which the friction turns, and the
    spring's curvature in 1/m (not with `tag`). A plate cannot pull: a tip that would hang on it is free, and recovers.
    """
    stiffness, offset, log_time, relaxing, friction, log_turn, curvature = unknowns.tolist()
    time, moved = math.exp(log_time), np.diff(indentation_m, prepend=0.0)
    dt = np.diff(time_s, prepend=time_s[0] - 1.0)
    decays, turns = np.exp(-dt / time), np.exp(-np.abs(moved) / math.exp(log_turn))
    follows = time * (1.0 - decays) / dt
    yielding = 1.0 / stiffness if tag else 0.0
    strain = lag = side = 0.0  # the lag is the strain less v
    answer = np.empty(len(time_s))
    steps = zip(indentation_m.tolist(), moved.tolist(), decays.tolist(), turns.tolist(), follows.tolist(), strict=True)
    for k, (u, way, decay, turn, follow) in enumerate(steps):
        base = lag * decay - follow * strain
        if u > 0.0 and way != 0.0:
            side = math.copysign(1.0, way) * (1.0 - turn) + side * turn
        slope = 1.0 + relaxing * follow + friction * side  # force = slope strain + relaxing base
        held = (u - yielding * relaxing * base) / (1.0 + yielding * slope) + curvature * u * u
        force = slope * held + relaxing * base
        if force < 0.0 or u <= 0.0:
            force, held = 0.0, max(-relaxing * base / slope, 0.0)
        strain, lag = held, base + follow * held
        answer[k] = held if tag else stiffness * force
    return answer + offset


def estimate_loading(time_s: Array, indentation_m: Array, answer: Array, tag: bool = False) -> LoadingEstimate:
    """Estimate creep and loss from a cycle: the tip is pressed on a rigid plate, held, let go, and observed.

    Least squares over `response`. The covariance is that of the fit, enlarged where its residuals vary together.

    Args:
        time_s: (n,); indentation_m: (n,), commanded, zero at contact; answer: (n,) N, the force, or with `tag` m, the
        deflection that the tag shows.

    Raises:
        LoadingError: the table shows no unloading, is too short, or its times or units are wrong.
    """
    _check(time_s, indentation_m)
    u, deepest = indentation_m, int(np.argmax(indentation_m))
    y = answer if answer[deepest] >= answer[0] else -answer  # a force of the tip on the plate
    span, press = float(np.ptp(y)), float(np.ptp(u))
    if not span > 0.0:
        raise LoadingError("The tip's answer is the same in all rows: check the column of the force or the deflection.")
    lasts = float(time_s[-1] - time_s[int(np.argmax(u > 0.1 * u.max()))])
    apart = float(np.median(np.diff(time_s)))
    stiff = 10.0 if tag else span / press
    low = [stiff / 100.0, y.min() - span, math.log(0.5 * apart), 0.0, 0.0, math.log(1e-6), -0.3 / press]
    high = [stiff * 100.0, y.max() + span, math.log(20.0 * lasts), 9.0, _MOST, math.log(0.5 * press), 1.0 / press]
    scale = np.array([0.3 * stiff, 0.1 * span, 0.3, 0.1, 0.1, 0.5, 0.1 / press])
    free = np.array([True] * 6 + [not tag])

    def whole(unknowns: Array) -> Array:
        return np.concatenate([unknowns, np.zeros(7 - len(unknowns))])

    def residuals(unknowns: Array) -> Array:
        return np.asarray((response(whole(unknowns), time_s, u, tag) - y) / span)

    times = np.geomspace(2.0 * apart, lasts, _TIMES)
    starts = [
        np.array([0.8 * stiff, float(y[0]), math.log(t), r, 0.1, math.log(0.3 * TRANSITION_M), 0.0])[free]
        for t in times
        for r in (0.1, 0.3)
    ]
    start = min(starts, key=lambda found: float((residuals(found) ** 2).sum()))
    bounds = (np.array(low)[free], np.array(high)[free])
    fit = least_squares(residuals, start, bounds=bounds, x_scale=scale[free])
    left, J = fit.fun, fit.jac * scale[free]
    variance = float(left @ left) / (len(left) - int(free.sum())) * _correlated(left)
    sigma = np.sqrt(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-12, hermitian=True)) * variance) * scale[free]
    stiffness, _, log_time, relaxing, friction = (float(v) for v in fit.x[:5])
    time = math.exp(log_time)
    creeps = relaxing > SEEN * sigma[3]
    if creeps and time > lasts / HELD:
        raise LoadingError(
            f"The cycle lasts {lasts:.1f} s, and the tip still creeps: its relaxation time is about {time:.0f} s. Hold"
            f" the tip pressed for {HELD * time:.0f} s or more."
        )
    if creeps and time < 2.0 * apart:
        raise LoadingError(f"The tip relaxes within {time:.2g} s, and the rows are {apart:.2g} s apart: record faster.")
    concerns = []
    if not creeps:
        concerns.append("No creep is seen: the relaxation time stays open.")
    if friction <= SEEN * sigma[4]:
        concerns.append("No loss is seen beyond creep.")
    if float(left[1:] @ left[:-1]) > ALIKE * float(left @ left):
        concerns.append("One relaxation time does not explain this cycle: the sigmas are of its best one.")
    return LoadingEstimate(
        tip=Elastomer(time, relaxing / (1.0 + relaxing), 2.0 * friction / (1.0 + friction)),
        sigmas=np.array([time * sigma[2], sigma[3] / (1.0 + relaxing) ** 2, 2.0 * sigma[4] / (1.0 + friction) ** 2]),
        stiffness_N_per_m=None if tag else stiffness,
        residual=span * float(np.sqrt(np.mean(left**2))),
        concerns=tuple(concerns),
    )


def _correlated(left: Array) -> float:
    """How much more the residuals (n,) vary together than as many independent ones (1 or more)."""
    whole, total = float(left @ left), 1.0
    for k in range(1, len(left) // 4):
        share = float(left[k:] @ left[:-k]) / max(whole, 1e-30)
        if share < 2.0 / np.sqrt(len(left)):  # two standard deviations of white noise's
            break
        total += 2.0 * share
    return total


def _check(time_s: Array, indentation_m: Array) -> None:
    """Raise LoadingError where the table cannot be a cycle of loading and unloading."""
    if len(time_s) < FEWEST_ROWS:
        raise LoadingError(f"The table has {len(time_s)} rows, and {FEWEST_ROWS} are needed: record faster.")
    if not (np.diff(time_s) > 0.0).all():
        k = int(np.argmax(np.diff(time_s) <= 0.0))
        raise LoadingError(
            f"Time does not grow from row {k + 1} to row {k + 2} ({time_s[k]:g} s, {time_s[k + 1]:g} s): sort the table"
            " and leave out what is there twice."
        )
    if float(np.median(np.diff(time_s))) > SLOWEST_ROWS_S:
        raise LoadingError(
            f"The rows are {np.median(np.diff(time_s)):g} s apart: t_s is in seconds, and yours seem to be milliseconds."
        )
    press = float(np.ptp(indentation_m))
    if not LEAST_PRESS_M <= press <= MOST_PRESS_M:
        raise LoadingError(
            f"The indentation spans {1e3 * press:g} mm: give indentation_mm in millimetres, pressed by"
            f" {1e3 * LEAST_PRESS_M:g} to {1e3 * MOST_PRESS_M:g} mm."
        )
    deepest = int(np.argmax(indentation_m))
    back = (indentation_m[deepest] - indentation_m[deepest:].min()) / press
    if back < BACK:
        raise LoadingError(
            f"The table has no unloading: after {time_s[deepest]:g} s the indentation falls by {100.0 * back:.0f} % only."
            " Record until the tip is free."
        )
