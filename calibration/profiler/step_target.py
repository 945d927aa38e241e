"""Estimates a profiler's scale, shear and plane of light from profiles of a step target in several orientations.

The faces are parallel and their heights known. In a profile the height is g . [x, z] plus a constant. With D the
sensor's correction, n the target's normal in B and P the rows x and z, g = D^T P R_FS^T R_BF^T n. The flange's position
and the target's place do not enter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from weldcal.calibration.errors import DegenerateMotion, FeatureNotFound, InconsistentData, TooFewRotations
from weldcal.calibration.geometry.se3 import angle_of, exp_rotation, frames_along, skew
from weldcal.calibration.profiler.edge.joint import cube_rotations
from weldcal.calibration.profiler.features.step import StepFaces, step_faces
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.sensor import SensorCorrection
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.models.errors import InputError

MINIMUM_PROFILES = 5  # ten numbers, for eight unknowns
ROBOT_RAD = np.radians(0.03)  # a choice: of the flange's orientation; 0.1 mm at 200 mm
ALTERNATIONS, POLISHED = 12, 3  # of sensor and normal from each start; starts that are solved
OPEN = 1 / 3  # a choice, of the prior's sigma: what the profiles do not narrow to it, they do not show
WRONG = 5.0  # sigmas of the others at which a profile is named
MOST_WRONG = 0.25  # of the profiles may be excluded as wrong
WORST_CHI2 = 100.0  # as sphere_joint has it
MEDIAN_CHI2 = 2.0 * np.log(2.0)  # of chi-square with 2 degrees


@dataclass(frozen=True, eq=False, kw_only=True)
class StepEstimate:
    """Scale and shear of the sensor, and where its plane of light lies on the flange.

    Attributes:
        correction: of the sensor. normal_F: (3,) of the plane of light in F, its side as S has y, and its sigma.
        wrong: numbers of the profiles that were excluded.
        reduced_chi2: of the whitened residuals; it has widened the covariance where it exceeds 1.
    """

    correction: SensorCorrection
    normal_F: Floats
    normal_sigma_rad: float
    reduced_chi2: float
    wrong: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class ShownSteps:
    """Where profiles show the step: numbers (m,) of them, gradients (m, 2) of its height, covariances (m, 2, 2)."""

    number: NDArray[np.intp]
    gradient: Floats
    covariance: Floats


def shown_steps(profiles: Sequence[Floats], heights_m: Floats) -> ShownSteps:
    """Find a step target in profiles (m, 2) [x, z] m; heights_m: (k,) of its faces, in order from either end.

    Raises:
        InputError: heights that are no steps, or not in m. FeatureNotFound: no profile shows the step.
        TooFewRotations: fewer than five do.
    """
    heights = np.asarray(heights_m, float)
    returns = [q for p in profiles if len(q := p[np.isfinite(p).all(axis=1)])]
    size = max((float(np.ptp(q, axis=0).max()) for q in returns), default=0.0)
    least = float(np.diff(heights).min(initial=np.inf))
    if not 0.0 < least < np.inf:
        raise InputError("Each step's height is above 0 mm.")
    if least > size:
        raise InputError(
            f"A step of {1e3 * least:.5g} mm does not fit into profiles of {1e3 * size:.3g} mm. Give --height in mm,"
            " and check the unit of the profiles."
        )
    orders = [heights, heights[-1] - heights[::-1]]  # z may grow either way
    found: dict[int, StepFaces] = {}
    for order in orders[: 1 if np.allclose(*orders) else 2]:
        faces: dict[int, StepFaces] = {}
        for k, p in enumerate(profiles):
            try:
                faces[k] = step_faces(p, order)
            except FeatureNotFound as error:
                reason = error
        if sum(len(f.faces) for f in faces.values()) > sum(len(f.faces) for f in found.values()):
            found = faces
    if not found:
        raise FeatureNotFound(f"None of the {len(profiles)} profiles shows the step. {reason}")
    if len(found) < MINIMUM_PROFILES:
        raise TooFewRotations(
            f"{len(found)} of {len(profiles)} profiles show the step. Take {MINIMUM_PROFILES} or more in which the"
            " laser line crosses it, the flange tilted by 15 to 30 deg to all sides, and check --height."
        )
    of = list(found.values())
    return ShownSteps(np.array(list(found)), np.array([f.gradient for f in of]), np.array([f.covariance for f in of]))


def step_sensor(rotation: Floats, profiles: Sequence[Floats], shown: ShownSteps) -> StepEstimate:
    """Return scale and shear of a profiler from profiles of a step target, in any orientations.

    Args:
        rotation: (n, 3, 3) R_BF at each profile; profiles: (m, 2) [x, z] m; shown: the step in them.

    Raises:
        InputError: poses and profiles that are not as many.
        DegenerateMotion: the orientations leave a scale or the shear open.
        InconsistentData: the profiles do not show one target.
    """
    if len(profiles) != len(rotation):
        raise InputError(f"{len(rotation)} poses need {len(rotation)} profiles, not {len(profiles)}.")
    every = np.vstack([p[np.isfinite(p).all(axis=1)] for p in profiles])
    R, g, C = np.asarray(rotation, float)[shown.number], shown.gradient, shown.covariance
    keep = np.ones(len(g), bool)
    for _ in range(len(g)):
        fit = fit_step(R[keep], g[keep], C[keep])
        square = np.sum(fit.off**2, axis=1)
        if keep.sum() <= max(MINIMUM_PROFILES, (1.0 - MOST_WRONG) * len(g)):
            break
        worst = int(np.argmax(square))
        if square[worst] < WRONG**2 * max(1.0, float(np.median(square)) / MEDIAN_CHI2):
            break
        keep[np.flatnonzero(keep)[worst]] = False
    chi2 = float(np.sum(fit.result.fun**2)) / max(2 * int(keep.sum()) - 5, 1)
    if float(np.median(square)) / MEDIAN_CHI2 > WORST_CHI2:
        raise InconsistentData(
            f"The profiles contradict one target with these heights ({np.sqrt(chi2):.0f} times their sigmas): check the"
            " heights, the poses and that the target did not move."
        )
    whole = np.asarray(np.linalg.inv(fit.result.jac.T @ fit.result.jac) * max(1.0, chi2))
    sigma, prior = np.sqrt(np.diag(whole))[:3], SphereSigmas().affine
    if sigma.max() > OPEN * prior:
        name = ("x scale", "z scale", "shear")[int(np.argmax(sigma))]
        spread = max(float(np.degrees(angle_of(R[keep][0].T @ R[keep]).max())), 0.0)
        raise DegenerateMotion(
            f"The profiles leave the sensor's {name} open by {100.0 * sigma.max():.1f} %: their orientations differ by"
            f" {spread:.0f} deg. Tilt the flange by 15 to 30 deg about two axes between the profiles."
        )
    scales = fit.result.x[:2]
    if np.abs(scales).min() > prior and scales[0] * scales[1] > 0.0:
        raise InconsistentData(
            f"Both scales are off by {100.0 * scales.mean():+.1f} %: the steps look like"
            f" {100.0 / (1.0 + scales.mean()):.1f} % of --height. Measure the target, and give its height in mm."
        )
    correction = SensorCorrection(
        values=fit.result.x[:3], covariance=whole[:3, :3], field_m=np.array([every.min(axis=0), every.max(axis=0)])
    )
    return StepEstimate(
        correction=correction,
        normal_F=fit.rotation[:, 1],
        normal_sigma_rad=float(np.sqrt(whole[3, 3] + whole[5, 5])),
        reduced_chi2=chi2,
        wrong=tuple(int(k) for k in shown.number[~keep]),
    )


@dataclass(frozen=True, eq=False)
class StepFit:
    """The solution, its whitened residuals off (n, 2), and R_FS (3, 3)."""

    result: OptimizeResult
    off: Floats
    rotation: Floats


def fit_step(R_BF: Floats, g: Floats, C: Floats) -> StepFit:
    """Solve from the best of 24 orientations; the covariances are those of the first solution."""
    starts = sorted((_alternated(R_BF, g, R) for R in cube_rotations()), key=lambda one: one[2])
    fits = [_polished(R_BF, g, C, R, n) for R, n, _ in starts[:POLISHED]]
    return min(fits, key=lambda fit: float(fit.result.cost))


def _alternated(R_BF: Floats, g: Floats, R: Floats) -> tuple[Floats, Floats, float]:
    """R_FS, n and the rms by linear steps for one, then the other, from an R_FS."""
    K, n = R.T[[0, 2]], np.zeros(3)
    for _ in range(ALTERNATIONS):
        n = np.linalg.lstsq(np.einsum("ij,nkj->nik", K, R_BF).reshape(-1, 3), g.ravel(), rcond=None)[0]
        n = n / max(float(np.linalg.norm(n)), 1e-12)
        m = np.einsum("nij,i->nj", R_BF, n)
        K = np.linalg.lstsq(m, g, rcond=None)[0].T
        U, _, Vt = np.linalg.svd(K, full_matrices=False)
        K = U @ Vt
    off = float(np.sqrt(np.mean((g - m @ K.T) ** 2)))
    return np.column_stack([K[0], np.cross(K[1], K[0]), K[1]]), n, off


def _polished(R_BF: Floats, g: Floats, C: Floats, R0: Floats, n0: Floats) -> StepFit:
    prior, across = SphereSigmas().affine, frames_along(n0[None])[0, :, :2]
    whiten = np.tile(np.eye(2), (len(g), 1, 1))

    def placed(x: Floats) -> tuple[Floats, Floats, Floats]:
        """D (2, 2), R_FS and the normals in F (n, 3)."""
        n = n0 + across @ x[6:8]
        D = np.array([[1.0 + x[0], x[2]], [x[2], 1.0 + x[1]]])
        return D, R0 @ exp_rotation(x[3:6]), np.einsum("nij,i->nj", R_BF, n / np.linalg.norm(n))

    def residual(x: Floats) -> Floats:
        D, R, m = placed(x)
        off = np.einsum("nij,nj->ni", whiten, g - (m @ R)[:, [0, 2]] @ D)
        return np.concatenate([off.ravel(), x[:3] / prior])

    x = np.zeros(8)
    for _ in range(2):
        D, R, m = placed(x)
        by_turn = np.einsum("ij,njk->nik", D @ R.T[[0, 2]], skew(m))
        total = C + ROBOT_RAD**2 * by_turn @ np.swapaxes(by_turn, 1, 2)
        whiten = np.linalg.inv(np.linalg.cholesky(total))
        found = least_squares(residual, x, x_scale=[prior] * 3 + [0.1] * 5, max_nfev=100)
        x = np.asarray(found.x)
    _, R, m = placed(x)
    n = R_BF[0] @ m[0]
    if n[int(np.argmax(np.abs(n)))] < 0.0:  # both turned about y fit as well
        R = R * [-1.0, 1.0, -1.0]
    return StepFit(found, found.fun[:-3].reshape(-1, 2), R)
