"""Variances of what is random in frames taken in motion, by restricted maximum likelihood, and the weights that
follow."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

_FLOOR = np.array([1e-6, 1e-14, 1e-14, 1e-14])  # factor, m^2, rad^2, s^2
_TOLD = 0.5  # residuals that a variance explains: with fewer it is not estimated
_MOST_JITTER_S = 0.2  # a choice: as two frames at 10 Hz; beyond, no clock can be fitted
FREE_S2 = 1.0  # variance of the time of a frame that is grossly late


@dataclass(frozen=True, eq=False)
class Variances:
    """``factor`` of the fits' own covariances; ``spread`` m^2 and ``lean`` rad^2 beyond them, an axis; ``jitter``
    s^2."""

    factor: float
    spread: float
    lean: float
    jitter: float

    @property
    def array(self) -> Array:
        """The four as an array."""
        return np.array([self.factor, self.spread, self.lean, self.jitter])


@dataclass(eq=False)
class LinearisedStream:
    """The model linearised at the frames' capture times: residuals extrapolated to the nominal times y (N, 5),
    Jacobians J (N, 5, 15), rates g (N, 5) and the unit covariances of the three kinds of noise in 5 x 5."""

    y: Array
    J: Array
    g: Array
    own: Array
    own_lean: Array


def total_variances(linear: LinearisedStream, variances: Variances, keep: Flags) -> Array:
    """Mean variances of a centre and a normal, an axis, and of the time: what the weights follow from.

    The share of the fits' own noise in them converges slowly, and matters little.
    """
    own = np.einsum("nii->", linear.own[keep]) / (3.0 * np.count_nonzero(keep))
    lean = np.einsum("nii->", linear.own_lean[keep]) / (2.0 * np.count_nonzero(keep))
    return np.array(
        [variances.factor * own + variances.spread, variances.factor * lean + variances.lean, variances.jitter]
    )


def noise_covariances(linear: LinearisedStream, variances: Variances) -> Array:
    """Covariances (N, 5, 5) without the jitter."""
    P = variances.factor * (linear.own + linear.own_lean)
    P[:, range(3), range(3)] += variances.spread
    P[:, range(3, 5), range(3, 5)] += variances.lean
    return P


def frame_weights(linear: LinearisedStream, variances: Variances, late: Flags) -> Array:
    """Inverse covariances (N, 5, 5) with the jitter."""
    j = np.where(late, FREE_S2, variances.jitter)
    V = noise_covariances(linear, variances) + j[:, None, None] * linear.g[:, :, None] * linear.g[:, None, :]
    V[~np.isfinite(V[:, 0, 0])] = np.eye(5)
    return np.asarray(np.linalg.inv(V))


def new_variances(
    linear: LinearisedStream,
    variances: Variances,
    W: Array,
    information: Array,
    keep: Flags,
    late: Flags,
    index: NDArray[np.int64],
) -> Variances:
    """One step of the equations q_g = tr(P V_g) of restricted maximum likelihood (Patterson and Thompson 1971)."""
    w, J = W[keep], linear.J[keep][:, :, index]
    y = linear.y[keep]
    wy = np.einsum("nij,nj->ni", w, y)
    wJ = w @ J
    d = np.sqrt(np.maximum(np.diag(information), 1e-30))
    inverse = np.linalg.pinv(information / np.outer(d, d), rcond=1e-11, hermitian=True) / np.outer(d, d)
    g = linear.g[keep] * np.where(late[keep], 0.0, 1.0)[:, None]
    kinds = [
        linear.own[keep] + linear.own_lean[keep],
        np.broadcast_to(np.diag([1.0, 1.0, 1.0, 0.0, 0.0]), (len(y), 5, 5)),
        np.broadcast_to(np.diag([0.0, 0.0, 0.0, 1.0, 1.0]), (len(y), 5, 5)),
        g[:, :, None] * g[:, None, :],
    ]
    values = variances.array
    for k, V in enumerate(kinds):
        q = float(np.einsum("ni,nij,nj->", wy, V, wy))
        t = float(np.einsum("nij,nji->", w, V)) - float(
            np.einsum("jk,nij,nil,nlk->", inverse, wJ, V, wJ, optimize=True)
        )
        # what no frame tells stays as it is: an arm at rest says nothing of the jitter
        if t * values[k] > _TOLD:
            values[k] *= np.clip(q / t, 0.05, 20.0)
    factor, spread, lean, jitter = np.maximum(values, _FLOOR)
    # the fit's own covariance and the common spread are told apart only where it differs from frame to frame
    return Variances(min(float(factor), 1.0), float(spread), float(lean), min(float(jitter), _MOST_JITTER_S**2))
