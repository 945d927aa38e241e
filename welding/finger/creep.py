"""Estimates a soft tip's creep and loss from a cycle of loading and unloading."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from weldcal.models.errors import InputError
from weldcal.models.tools.elastomers import TRANSITION_M, Elastomer
from weldcal.welding.numerics import Array

FEWEST_ROWS = 40  # a choice: five for each of eight unknowns
LEAST_PRESS_M = 0.5e-3  # a choice, as in calibrate_tip
MOST_PRESS_M = 0.02  # a choice: no finger of this kind moves as far; more is another unit
ALIKE_SPANS = 2.0  # a choice: largest ratio of indentation and deflection on a rigid plate
SPARSE_S = 0.25  # a choice: at more between two rows, the friction's turn is not seen in a press of seconds
SLOWEST_ROWS_S = 5.0  # a choice: between two rows of a table in s; more is another unit
BACK = 0.5  # share of the largest indentation that the unloading must take back
HELD = 1.5  # relaxation times that the table must last from the first press on
SEEN = 3.0  # standard deviations from zero that an estimate needs to be one
ALIKE = 0.35  # a choice: correlation of neighbouring residuals above which they are no noise
_TIMES = 12  # starting relaxation times
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
        residuals: rms of what the fit leaves, of the force in N, of the deflection in m, as far as given.
        concerns: sentences on what the cycle does not show.
    """

    tip: Elastomer
    sigmas: Array
    stiffness_N_per_m: float | None
    residuals: tuple[float, ...]
    concerns: tuple[str, ...]


def response(unknowns: Array, time_s: Array, indentation_m: Array) -> tuple[Array, Array]:
    """Return the force (n,) N and the deflection (n,) m of a tip that is pressed on a rigid plate.

    `unknowns` (9,): log of the relaxation time in s, r and b (see models/tools/elastomers), log of the deflection in m
    over which the friction turns, stiffness N/m, offset of the force N, curvature of the spring 1/m, what contact and
    robot give way over the tip's deflection, offset of the deflection m. A plate cannot pull: a tip that would hang on
    it is free, and recovers.
    """
    log_time, relaxing, friction, log_turn, stiffness, force_0, curvature, yielding, shown_0 = unknowns.tolist()
    time, moved = math.exp(log_time), np.diff(indentation_m, prepend=0.0)
    dt = np.diff(time_s, prepend=time_s[0] - 1.0)
    decays, turns = np.exp(-dt / time), np.exp(-np.abs(moved) / math.exp(log_turn))
    follows = time * (1.0 - decays) / dt
    strain = lag = side = 0.0  # the lag is the strain less v
    found = np.empty((2, len(time_s)))
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
        found[:, k] = force, held
    return stiffness * found[0] + force_0, found[1] + shown_0


def estimate_loading(
    time_s: Array, indentation_m: Array, force_N: Array | None = None, shown_m: Array | None = None
) -> LoadingEstimate:
    """Estimate creep and loss from a cycle: the tip is pressed on a rigid plate, held, let go, and observed.

    Least squares over `response`, each series weighted by what it leaves. The covariance is that of the fit, enlarged
    where its residuals vary together.

    Args:
        time_s: (n,); indentation_m: (n,), commanded, zero at contact; force_N: (n,); shown_m: (n,), the deflection that
        the tag shows. One of the two, or both: a force alone takes what contact and robot give way for the tip's.

    Raises:
        LoadingError: the table shows no unloading, is too short, or its times or units are wrong.
    """
    _check(time_s, indentation_m, shown_m)
    u, deepest = indentation_m, int(np.argmax(indentation_m))
    press, lasts = float(np.ptp(u)), float(time_s[-1] - time_s[int(np.argmax(u > 0.1 * u.max()))])
    apart = float(np.median(np.diff(time_s)))
    if force_N is not None and force_N[deepest] < force_N[0]:
        force_N = -force_N  # of the tip on the plate
    series = [y for y in (force_N, shown_m) if y is not None]
    spans = [float(np.ptp(y)) for y in series]
    if not series or min(spans) <= 0.0:
        raise LoadingError("The tip's answer is the same in all rows: check the columns of force and deflection.")
    forced, shown = force_N is not None, shown_m is not None
    stiff, first = (spans[0] / press, float(series[0][0])) if forced else (1.0, 0.0)
    free = np.array([True] * 4 + [forced, forced, forced and not shown, shown, shown])
    low = np.array([math.log(0.5 * apart), 0.0, 0.0, math.log(1e-6), stiff / 99.0, -99.0, -0.3 / press, 0.0, -press])
    high = np.array(
        [math.log(20.0 * lasts), 9.0, _MOST, math.log(0.5 * press), 99.0 * stiff, 99.0, 1.0 / press, 3.0, press]
    )
    scale = np.array([0.3, 0.1, 0.1, 0.5, 0.3 * stiff, 0.1 * stiff * press, 0.1 / press, 0.1, 0.1 * press])
    low[5], high[5] = first - spans[0], first + spans[0]
    start = np.array([0.0, 0.0, 0.1, math.log(0.3 * TRANSITION_M), 0.8 * stiff, first, 0.0, 0.1 * shown, 0.0])

    def residuals(given: Array, weights: list[float]) -> Array:
        unknowns = np.zeros(len(free))
        unknowns[free] = given
        found = response(unknowns, time_s, u)
        pairs = zip((y for y, there in zip(found, (forced, shown), strict=True) if there), series, weights, strict=True)
        return np.concatenate([(model - y) * weight for model, y, weight in pairs])

    weights, starts = [1.0 / span for span in spans], []
    for time, relaxing in product(np.geomspace(2.0 * apart, lasts, _TIMES), (0.1, 0.3)):
        starts.append(np.r_[math.log(time), relaxing, start[2:]][free])
    best = min(starts, key=lambda given: float((residuals(given, weights) ** 2).sum()))
    for _ in range(2):
        fit = least_squares(residuals, best, bounds=(low[free], high[free]), x_scale=scale[free], args=(weights,))
        best, parts = fit.x, np.split(fit.fun, len(series))
        left = [float(np.sqrt(np.mean(part**2))) / weight for part, weight in zip(parts, weights, strict=True)]
        if len(series) == 1:
            break
        weights = [1.0 / max(rms, 1e-6 * span) for rms, span in zip(left, spans, strict=True)]
    J, alike = fit.jac * scale[free], max(_correlated(part) for part in parts)
    variance = float(fit.fun @ fit.fun) / (len(fit.fun) - int(free.sum())) * alike
    sigma = np.sqrt(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-12, hermitian=True)) * variance) * scale[free]
    time, relaxing, friction = math.exp(best[0]), float(best[1]), float(best[2])
    creeps = relaxing > SEEN * sigma[1]
    if creeps and time > lasts / HELD:
        raise LoadingError(
            f"The cycle lasts {lasts:.1f} s, and the tip still creeps: its relaxation time is about {time:.0f} s. Hold"
            f" the tip pressed for {HELD * time:.0f} s or more."
        )
    if creeps and time < 2.0 * apart:
        raise LoadingError(f"The tip relaxes within {time:.2g} s, and the rows are {apart:.2g} s apart: record faster.")
    concerns = [] if creeps else ["No creep is seen: the relaxation time stays open."]
    if friction <= SEEN * sigma[2]:
        concerns.append("No loss is seen beyond creep.")
    if not shown:
        concerns.append("Without deflection_mm what contact and robot give way counts as the tip's.")
    if max(float(part[1:] @ part[:-1]) / max(float(part @ part), 1e-30) for part in parts) > ALIKE:
        concerns.append("One relaxation time does not explain this cycle: the sigmas are of its best one.")
    return LoadingEstimate(
        tip=Elastomer(time, relaxing / (1.0 + relaxing), 2.0 * friction / (1.0 + friction)),
        sigmas=np.array([time * sigma[0], sigma[1] / (1.0 + relaxing) ** 2, 2.0 * sigma[2] / (1.0 + friction) ** 2]),
        stiffness_N_per_m=float(best[4]) if forced else None,
        residuals=tuple(left),
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


def _check(time_s: Array, indentation_m: Array, shown_m: Array | None) -> None:
    """Raise LoadingError where the table cannot be a cycle of loading and unloading."""
    if len(time_s) < FEWEST_ROWS:
        raise LoadingError(f"The table has {len(time_s)} rows, and {FEWEST_ROWS} are needed: record faster.")
    if not (np.diff(time_s) > 0.0).all():
        k = int(np.argmax(np.diff(time_s) <= 0.0))
        raise LoadingError(
            f"Time does not grow from row {k + 1} to row {k + 2} ({time_s[k]:g}, {time_s[k + 1]:g} s): sort the table"
            " and leave out what is there twice."
        )
    if float(np.median(np.diff(time_s))) > SLOWEST_ROWS_S:
        raise LoadingError(
            f"The rows are {np.median(np.diff(time_s)):g} s apart: t_s is in seconds, yours seem to be milliseconds."
        )
    if float(np.median(np.diff(time_s))) > SPARSE_S:
        raise LoadingError(f"The rows are {np.median(np.diff(time_s)):g} s apart: record ten rows a second or more.")
    press = float(np.ptp(indentation_m))
    if -indentation_m.min() > 0.5 * press:
        raise LoadingError("The indentation is negative: give it zero at contact and positive into the tip.")
    if not LEAST_PRESS_M <= press <= MOST_PRESS_M:
        raise LoadingError(
            f"The indentation spans {1e3 * press:g} mm: give indentation_mm in millimetres, pressed by"
            f" {1e3 * LEAST_PRESS_M:g} to {1e3 * MOST_PRESS_M:g} mm."
        )
    deepest = int(np.argmax(indentation_m))
    back = (indentation_m[deepest] - indentation_m[deepest:].min()) / press
    if back < BACK:
        raise LoadingError(
            f"The table has no unloading: after {time_s[deepest]:.1f} s the indentation falls by {100.0 * back:.0f} %"
            " only. Record until the tip is free."
        )
    if shown_m is not None and not 1.0 / ALIKE_SPANS <= np.ptp(shown_m) / press <= ALIKE_SPANS:
        raise LoadingError(
            f"The tag shows {1e3 * np.ptp(shown_m):g} mm for an indentation of {1e3 * press:g} mm: give both in"
            " millimetres, along the same axis, pressed on a rigid plate."
        )
