"""Refines a hand-eye calibration by reprojection of board corners, with an optional shift of the principal point."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import difference, pose
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.problem import NAMES, full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

_LEVEL = 0.01  # at which a shift of the principal point is no chance
_STEP_PX = 0.1  # of the differences that carry its uncertainty into the poses
_WIDEST_SHARE = 0.1  # of the image's half width: beyond it the model is wrong, not its principal point
_COLUMN_LOSS = 0.01  # how much worse one column may get held out while the other gets better


@dataclass(frozen=True)
class CornerRefinement:
    """Result of the refinement by corners.

    ``shift_px``, ``sigma_px`` (2,): estimated shift of the principal point and its standard deviation; ``accepted``:
    applied in ``result`` (else ``result`` is that of the poses as given); ``sentence`` says why.
    """

    shift_px: Array
    sigma_px: Array
    accepted: bool
    result: HandEyeResult
    sentence: str


def poses_from_corners(pairs: PosePairs, shift_px: Array, least: int = 6) -> Array:
    """Poses (n, 4, 4) of the board in the camera that reproject best, the principal point moved by ``shift_px``.

    Raises DatasetError where the file has no corners, fewer than ``least`` in an image, or arrays that do not belong
    together.
    """
    if pairs.img is None or pairs.obj is None or pairs.K is None:
        raise DatasetError(f"'{pairs.source}' holds no corners (img, obj, K): omit --corners.")
    n, m = len(pairs.camera), len(pairs.obj)
    wanted = {"img": (n, m, 2), "obj": (m, 3), "K": (3, 3)}
    for name, array in (("img", pairs.img), ("obj", pairs.obj), ("K", pairs.K)):
        if array.shape != wanted[name]:
            raise DatasetError(
                f"'{name}' of '{pairs.source}' has the shape {array.shape}, and it must be {wanted[name]}."
            )
    K = pairs.K.copy()
    K[:2, 2] += shift_px
    dist = np.zeros(5) if pairs.dist is None else pairs.dist
    out = np.empty_like(pairs.camera)
    for i, X in enumerate(pairs.camera):
        seen = np.isfinite(pairs.img[i]).all(axis=1)
        if int(seen.sum()) < least:
            raise DatasetError(f"Image {i} of '{pairs.source}' has only {int(seen.sum())} corners; {least} are needed.")
        start = cv2.Rodrigues(X[:3, :3])[0]
        turn, shift = cv2.solvePnPRefineLM(pairs.obj[seen], pairs.img[i][seen], K, dist, start.copy(), X[:3, 3:].copy())
        out[i] = pose(np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64), np.asarray(shift, dtype=np.float64)[:, 0])
    return out


def refine_with_corners(pairs: PosePairs, config: HandEyeConfig | None = None) -> CornerRefinement:
    """Estimate the shift of the principal point together with the poses and apply it only if the data allow.

    A principal point that is off turns every board about the camera: hand-eye motion shows it, reprojection does not.
    The shift maximises the likelihood of the hand-eye residuals. It is applied if it is no chance (likelihood ratio, 1
    %), if it lies within a tenth of the image, and if the held-out errors fall. Its uncertainty then goes into the
    covariance. Raises as poses_from_corners and solve_problem.
    """
    config = config or HandEyeConfig()
    quick = replace(config, folds=0, usual_discord_rad=0.0)
    plain = solve_problem(full_problem(pairs.F, poses_from_corners(pairs, np.zeros(2)), pairs.H), config=config)
    n = 3.0 * len(np.unique(plain.observation[plain.inliers]))

    def solved(shift: Array, how: HandEyeConfig = quick) -> HandEyeResult:
        return solve_problem(full_problem(pairs.F, poses_from_corners(pairs, shift), pairs.H), config=how)

    def deviance(shift: Array) -> float:
        try:
            r = solved(shift)
        except WeldcalError:
            return 1e9
        return float(n * (2.0 * np.log(r.sigma_rotation_rad) + 2.0 * np.log(r.sigma_translation)))

    first = deviance(np.zeros(2))
    simplex = np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, -1.0]])
    from scipy.optimize import minimize  # only where corners are used: it takes a fifth of a second to import

    found = minimize(
        deviance,
        np.zeros(2),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.05, "maxfev": 80},
    )
    shift = np.asarray(found.x, dtype=float)
    sigma = _sigma(deviance, shift, float(found.fun))
    said = f"principal point shifted by ({shift[0]:+.2f}, {shift[1]:+.2f}) px (+- {sigma[0]:.2f}, {sigma[1]:.2f})"
    half = 0.5 * float(np.nanmax(np.asarray(pairs.img), initial=0.0))

    def refused(why: str) -> CornerRefinement:
        return CornerRefinement(
            shift, sigma, False, plain, f"Corners: {said} does not help: {why}; poses used as given."
        )

    if first - float(found.fun) < float(chi2_quantile(1.0 - _LEVEL, 2)):
        return refused("it may be chance")
    if float(np.abs(shift).max()) > _WIDEST_SHARE * half or not np.isfinite(sigma).all():
        return refused("it is too far or too vague to be the principal point")
    try:
        better = solved(shift, config)
    except WeldcalError:
        return refused("no calibration agrees with it")
    deg = better.held_out.rms_deg / plain.held_out.rms_deg
    mm = better.held_out.rms_translation / plain.held_out.rms_translation
    if deg * mm >= 1.0 or max(deg, mm) > 1.0 + _COLUMN_LOSS:
        return refused(f"held-out errors change by {100 * (deg - 1):+.1f} % (deg) and {100 * (mm - 1):+.1f} % (mm)")
    return CornerRefinement(
        shift,
        sigma,
        True,
        _with_shift_uncertainty(better, solved, shift, sigma),
        f"Corners: {said}; held-out errors change by {100 * (deg - 1):+.1f} % (deg) and {100 * (mm - 1):+.1f} % (mm).",
    )


def _sigma(deviance: Callable[[Array], float], shift: Array, least: float) -> Array:
    """Standard deviations (2,) from the curvature of the deviance (twice the negative log-likelihood)."""
    h = 0.5
    H = np.zeros((2, 2))
    for i in range(2):
        e = h * np.eye(2)[i]
        H[i, i] = (deviance(shift + e) - 2.0 * least + deviance(shift - e)) / h**2
    e, f = h * np.eye(2)
    H[0, 1] = H[1, 0] = (
        deviance(shift + e + f) - deviance(shift + e - f) - deviance(shift - e + f) + deviance(shift - e - f)
    ) / (4.0 * h**2)
    if float(np.linalg.eigvalsh(H)[0]) <= 0.0:
        return np.full(2, np.inf)
    return np.asarray(np.sqrt(np.diag(2.0 * np.linalg.inv(H))))


def _with_shift_uncertainty(
    result: HandEyeResult, solved: Callable[[Array], HandEyeResult], shift: Array, sigma: Array
) -> HandEyeResult:
    """Return the covariance of the poses with what they change when the principal point does."""
    joint = result.joint_covariance.copy()
    for k in range(2):
        e = _STEP_PX * np.eye(2)[k]
        up, down = solved(shift + e), solved(shift - e)
        slope = np.concatenate(
            [
                difference(np.asarray(down.poses[x].GetAsMatrix4()), np.asarray(up.poses[x].GetAsMatrix4()))
                for x in result.poses
            ]
        ) / (2.0 * _STEP_PX)
        joint += sigma[k] ** 2 * np.outer(slope, slope)
    order = [x for x in NAMES if x in result.poses]
    return replace(
        result,
        joint_covariance=joint,
        covariance={x: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, x in enumerate(order)},
    )
