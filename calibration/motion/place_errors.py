"""Finds errors of robot and scanner that depend on the place, and what they add to the covariance of a calibration.

Frames of a stream are many, and near each other: what the arm's kinematics or the scanner's warp do at one place they do in all
frames there, so that their error does not average away with the number of frames. The covariance of residuals at two places is
modelled as variance * exp(-(distance / length)^2 / 2), from products of residuals of different frames (an empirical covariogram,
Cressie 1993, section 2.4), and carried through the weighted fit (the sandwich formula).
"""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.motion.clock_fit import ClockFit
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.models.arrays import Array

_LENGTHS_M = (0.02, 0.04, 0.08, 0.16)
_NEAR_M = 0.02  # products at places so near decide whether there is any such error
_SIGNIFICANT = 4.0  # standard deviations
_MOST = 900  # frames whose pairs are looked at


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """Errors that depend on the place: ``sigma_m`` an axis of the centre and ``sigma_rad`` an axis of the normal, correlated over
    ``length_m``; ``found`` whether they are significant; ``meat`` (K, K): covariance of the fit's scores that they add."""

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
            f"The errors depend on the place by {1e3 * self.sigma_m:.3f} mm and {np.degrees(self.sigma_rad):.3f} degrees an axis (arm or "
            f"scanner, over some {1e3 * self.length_m:.0f} mm); the stated covariance includes them."
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
    """Variance and length of the correlated error from products of residuals (P,) at distances d (P,); None where there is none."""
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
