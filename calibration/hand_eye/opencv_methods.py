"""Runs OpenCV's hand-eye methods on the same observations, for comparison."""

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import IDENTITY, inverse, nearest_rotation, pose
from weldcal.calibration.hand_eye.problem import Problem, full_problem, residuals
from weldcal.calibration.hand_eye.repeats import one_per_pose
from weldcal.calibration.hand_eye.solve import HandEyeHeldOut, fold_labels
from weldcal.models.arrays import Array

HAND_EYE = {
    "TSAI": cv2.CALIB_HAND_EYE_TSAI,
    "PARK": cv2.CALIB_HAND_EYE_PARK,
    "HORAUD": cv2.CALIB_HAND_EYE_HORAUD,
    "ANDREFF": cv2.CALIB_HAND_EYE_ANDREFF,
    "DANIILIDIS": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
ROBOT_WORLD = {"SHAH": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "LI": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
MOST_COMPARED = 200
"""Poses that a command fits these methods to: their time and memory grow with the square of the number."""
_MANY = 1000  # pairs from which on half as many are compared
METHODS = (*HAND_EYE, *ROBOT_WORLD)


def most_compared(n: int) -> int:
    """Poses of each fold that a command fits OpenCV's methods to, of n pairs."""
    return MOST_COMPARED if n <= _MANY else MOST_COMPARED // 2


def opencv_solve(method: str, F: Array, G: Array) -> tuple[Array, Array] | None:
    """(X, Y) of F_i X G_i = Y by one of METHODS; None where it throws or returns no finite rigid pose.

    Y is the mean over the poses for every method: calibrateHandEye gives X alone, and the Y of
    calibrateRobotWorldHandEye fits worse than that mean (camera 1 of the workcell, LI: 1.35 against 1.01 mm held out).
    """
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # a refusal is told in the table
    try:
        if method in HAND_EYE:
            R, t = cv2.calibrateHandEye(
                list(F[:, :3, :3]), list(F[:, :3, 3]), list(G[:, :3, :3]), list(G[:, :3, 3]), method=HAND_EYE[method]
            )
            X = _checked(R, t)
        else:
            # its second answer is the hand in the camera
            W = inverse(F)
            _, _, R, t = cv2.calibrateRobotWorldHandEye(
                list(G[:, :3, :3]), list(G[:, :3, 3]), list(W[:, :3, :3]), list(W[:, :3, 3]), method=ROBOT_WORLD[method]
            )
            found = _checked(R, t)
            X = None if found is None else inverse(found)
    except (cv2.error, np.linalg.LinAlgError):
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if X is None:
        return None
    M = F @ X @ G
    return X, pose(nearest_rotation(M[:, :3, :3].sum(axis=0)), M[:, :3, 3].mean(axis=0))


def opencv_held_out(
    method: str,
    F: Array,
    G: Array,
    folds: int = 5,
    most: int | None = None,
    observation: NDArray[np.int64] | None = None,
) -> HandEyeHeldOut:
    """Held-out errors of one of METHODS on the folds that weldcal uses; NaN where a fold gave no answer.

    ``observation``: of each sample, as weldcal's result has it. ``most``: fit each fold to so many of its poses at
    most, evenly spaced; calibrateHandEye holds all pairs of poses in memory.
    """
    n = len(F)
    if observation is None:
        observation = one_per_pose(full_problem(F, G)).observation
    label = fold_labels(int(observation.max()) + 1, folds)[observation]
    out = HandEyeHeldOut(np.full(n, np.nan), np.full(n, np.nan))
    for k in range(folds):
        train, test = np.flatnonzero(label != k), label == k
        if most is not None and len(train) > most:
            train = train[np.linspace(0, len(train) - 1, most).round().astype(int)]
        found = opencv_solve(method, F[train], G[train])
        if found is None or not test.any():
            continue
        rest = int(test.sum())
        H = np.broadcast_to(IDENTITY, (rest, 4, 4))
        problem = Problem(F=F[test], G=G[test], H=H, full=np.ones(rest, dtype=bool), normal=np.zeros(rest, dtype=bool))
        w, d = residuals(problem, (*found, IDENTITY))
        out.rotation_rad[test], out.translation[test] = np.linalg.norm(w, axis=1), np.linalg.norm(d, axis=1)
    return out


def _checked(R: Array, t: Array) -> Array | None:
    R, t = np.asarray(R, dtype=float), np.asarray(t, dtype=float).reshape(-1)
    if not (np.isfinite(R).all() and np.isfinite(t).all()) or abs(float(np.linalg.det(R)) - 1.0) > 0.1:
        return None
    return pose(nearest_rotation(R), t)
