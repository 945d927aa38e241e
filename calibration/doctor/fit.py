"""Fits a model of the scans, X_BC with the scanner's usual error and what a cause adds, and gives its log-likelihood.

Model: e_k = X_g(k) s(c_k) - b_k + D_k a, with a camera pose for each group g of scans, the scanner's scale and
gradients s held to their usual size, and columns D_k (3, p) of the cause. Residuals of centres and of normals follow
Student's t (6 free), so that a few outliers decide nothing. Gauss-Newton, reweighted (Lange, Little and Taylor 1989).
Models are compared by the Bayesian information criterion (Schwarz 1978) with the factor of Hurvich and Tsai for few
residuals.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from weldcal.calibration.adjustment import Kind, Observed, Unknowns, adjust, likeliest, scanned
from weldcal.calibration.doctor.case import DoctorCase
from weldcal.calibration.eye_on_base.solve import SolveConfig, robust_start
from weldcal.calibration.geometry.se3 import pose, skew
from weldcal.models.arrays import Array

NU = 6.0  # degrees of freedom of Student's t, a choice between heavy tails (3) and normal noise (30)
FLOOR_M, FLOOR_RAD = 2e-5, 3e-4  # below any arm and scanner
_USUAL = np.array([2e-3, 1.5e-2, 1.5e-2, 2e-2])  # what scanners err: scale, and its gradients over x, y and z (1/m)
_STEPS = 25
_START = SolveConfig(hypotheses=300)


@dataclass(frozen=True, eq=False, kw_only=True)
class CauseFit:
    """A fitted model: camera poses R (G, 3, 3), p (G, 3); scanner terms; the cause's numbers a (p,).

    Residuals of centres e (n, 3) m and of normals (n,) rad; spreads per axis; log-likelihood.

    ``size`` counts the free parameters, not those with a prior (the scanner's, the arm's). ``occam`` is the penalty of
    those with a prior: the logarithm of how much the scans narrow them (Laplace's approximation of the evidence).
    """

    R: Array
    p: Array
    scanner: Array
    a: Array
    e: Array
    tilt: Array
    sigma_m: float
    sigma_rad: float
    loglik: float
    size: int
    n: int
    occam: float = 0.0

    @property
    def rms(self) -> float:
        """Of the centres' residuals, m, over the middle half of the scans: a few outliers decide nothing."""
        return float(np.median(np.linalg.norm(self.e, axis=1)))

    @property
    def bic(self) -> float:
        """The criterion; less is better."""
        count = 3.0 * self.n
        few = count / max(count - self.size - 1.0, 1.0)
        return float(-2.0 * self.loglik + self.size * np.log(count) * few + self.occam)


def fit(
    case: DoctorCase,
    *,
    groups: NDArray[np.int64] | None = None,
    columns: Array | None = None,
    start: CauseFit | None = None,
    normals: bool = True,
    turning: Array | None = None,
    prior: Array | None = None,
) -> CauseFit:
    """The best numbers of a model; ``columns`` (n, 3, p) of the cause, ``groups`` (n,) the camera pose of each scan.

    ``turning`` (n, 3, p) is what the cause does to the normals z; ``prior`` (p,) one sigma of its numbers about zero.
    The arm's usual errors are in the model, too, where the case has them.
    """
    n, b, c = case.n, case.b, case.c
    g = np.zeros(n, dtype=int) if groups is None else groups
    G, own_numbers = int(g.max()) + 1, 0 if columns is None else columns.shape[2]
    D = np.zeros((n, 3, 0)) if columns is None else columns
    T = np.zeros((n, 3, own_numbers)) if turning is None else turning
    sigmas = np.full(own_numbers, np.inf) if prior is None else prior
    if case.arm is not None:
        D, T = np.concatenate([D, case.arm.D], axis=2), np.concatenate([T, case.arm.T], axis=2)
        sigmas = np.concatenate([sigmas, case.arm.sigma])
    p = len(sigmas)
    held = np.isfinite(sigmas)
    weak = np.where(held, 1.0 / sigmas, 0.0)
    has: NDArray[np.bool_] = np.isfinite(case.m).all(axis=1) & np.full(n, normals)
    m = np.where(has[:, None], case.m, 0.0)
    terms = np.column_stack([np.ones(n), c - c.mean(axis=0)])
    if start is not None and len(start.R) == G:
        first = tuple(pose(R, p) for R, p in zip(start.R, start.p, strict=True))
    else:
        first = tuple(np.asarray(robust_start(b[g == k], c[g == k], _START).GetAsMatrix4()) for k in range(G))
    at_a, size = 6 * G + 4, 6 * G + 4 + p

    def normals_at(at: Unknowns) -> tuple[Array, Array, Array]:
        """Measured u (n, 3) and expected normals z (n, 3) in the base; what lies between them (n, 3)."""
        u = np.einsum("kij,kj->ki", np.array(at.poses)[g, :3, :3], m)
        z = case.z + T @ at.numbers[4:]
        z = z / np.linalg.norm(z, axis=1)[:, None]
        e = np.cross(u, z)
        backward = (u * z).sum(axis=1) < 0.0
        e[backward] /= np.maximum(np.linalg.norm(e[backward], axis=1), 1e-9)[:, None]  # no division by zero
        return u, z, e

    def linearised(at: Unknowns) -> tuple[Observed, Observed]:
        s, a = at.numbers[:4], at.numbers[4:]
        q, J, Jn = np.zeros((n, 3)), np.zeros((n, 3, size)), np.zeros((n, 3, size))
        u, z, en = normals_at(at)
        turned = skew(z) @ skew(u)  # change of u x z by a rotation of u
        for k, X in enumerate(at.poses):
            own, block = g == k, slice(6 * k, 6 * k + 6)
            q[own], J[own, :, block], J[own, :, 6 * G : at_a] = scanned(X, c[own], terms[own], s)
            Jn[own, :, 6 * k : 6 * k + 3] = turned[own]
        J[:, :, at_a:], Jn[:, :, at_a:] = D, skew(u) @ T
        return Observed(q - b + D @ a, J), Observed(en[has], Jn[has])

    found = adjust(
        Unknowns(first, np.zeros(4 + p)),
        linearised,
        (
            Kind(rank=3, loss=_student, spread=likeliest, floor=FLOOR_M),
            Kind(rank=2, loss=_student, spread=likeliest, floor=FLOOR_RAD),
        ),
        prior=np.diag(np.concatenate([1.0 / _USUAL, weak]) ** 2),
        steps=_STEPS,
    )
    (sigma, sigma_n), s, a = found.sigmas, found.at.numbers[:4], found.at.numbers[4:]
    e, (u, z, _) = linearised(found.at)[0].e, normals_at(found.at)
    tilt = np.where(has, np.arctan2(np.linalg.norm(np.cross(u, z), axis=1), (u * z).sum(axis=1)), np.nan)
    loglik = student(np.sqrt((e**2).sum(axis=1)), sigma, 3) - 0.5 * float(((s / _USUAL) ** 2).sum())
    if has.any():
        loglik += student(tilt[has], sigma_n, 2)
    free = 6 * G + int(np.count_nonzero(~held))
    loglik -= 0.5 * float(((a * weak) ** 2).sum())
    occam = 0.0
    if held.any():
        occam = _narrowed(found.information, np.concatenate([np.zeros(at_a, dtype=bool), held]), sigmas[held])
    return CauseFit(
        R=np.array([X[:3, :3] for X in found.at.poses]),
        p=np.array([X[:3, 3] for X in found.at.poses]),
        scanner=s,
        a=a[:own_numbers],
        e=e,
        tilt=tilt,
        sigma_m=sigma,
        sigma_rad=sigma_n,
        loglik=loglik,
        size=free,
        n=n,
        occam=occam,
    )


def _student(square: Array, rank: float) -> Array:
    """Weights of Student's t (Lange, Little and Taylor 1989)."""
    return np.asarray((NU + rank) / (NU + square))


def _narrowed(H: Array, held: NDArray[np.bool_], sigma: Array) -> float:
    """Logarithm of how much information H (m, m) narrows the numbers that a prior holds, all others free.

    Twice Laplace's factor.
    """
    cross = H[np.ix_(~held, held)]
    kept = H[np.ix_(held, held)] - cross.T @ np.linalg.lstsq(H[np.ix_(~held, ~held)], cross, rcond=1e-12)[0]
    return float(np.linalg.slogdet(kept * np.outer(sigma, sigma))[1])


def student(r: Array, sigma: float, d: int) -> float:
    """Log-likelihood of distances r (n,) in d dimensions under Student's t with NU free."""
    constant = gammaln((NU + d) / 2) - gammaln(NU / 2) - 0.5 * d * np.log(NU * np.pi) - d * np.log(sigma)
    return float(len(r) * constant - 0.5 * (NU + d) * np.log1p((r / sigma) ** 2 / NU).sum())
