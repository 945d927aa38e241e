"""Captures that follow the advice of `weldcal capture` beside poses at random: the error at the work point."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from tests.figures.harness import Run, figure
from weldcal.calibration.capture.session import LEAST, ArmPose
from weldcal.calibration.capture.tasks import next_scan
from weldcal.calibration.eye_on_base.few_poses import calibrate_from_few
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, skew

CAPTURES = 8
WORK_C = np.array([0.0, 0.0, 0.7])
_CENTRE_M, _NORMAL_RAD, _ARM_M, _BIAS_M = (
    5e-5,
    1e-3,
    5e-5,
    1e-4,
)  # of a scan, of the arm, and of the centre on the flange


def looked_at(X_BC: RigidTransform, X_CR: RigidTransform, bias: np.ndarray, rng: np.random.Generator) -> Observation:
    """What a scan of a flange at X_CR gives, beside the pose that the controller states."""
    stated = X_BC @ X_CR
    R = stated.rotation()
    p = X_CR @ bias + _CENTRE_M * rng.normal(size=3)
    n = exp_rotation(_NORMAL_RAD * rng.normal(size=3)) @ X_CR.rotation().matrix()[:, 2]
    return Observation("", RigidTransform(R, stated.translation() + _ARM_M * rng.normal(size=3)), p, n)


def at_random(rng: np.random.Generator, tilt_rad: float) -> RigidTransform:
    """A pose of the flange before the scanner, as a person finds one who is told to vary it."""
    z = rng.uniform(0.55, 0.85)
    R = RollPitchYaw(np.pi + rng.uniform(-tilt_rad, tilt_rad), rng.uniform(-tilt_rad, tilt_rad), rng.uniform(-1.0, 1.0))
    return RigidTransform(R, [*(z * rng.uniform(-0.2, 0.2, 2)), z])


def error_m(poses: list[RigidTransform], X_BC: RigidTransform) -> float:
    """Rms error at the work point of a calibration from flanges at these X_CR: of noise, and of the unknown bias."""
    N, pulled = np.zeros((6, 6)), np.zeros((6, 3))
    var_p, var_n = _CENTRE_M**2 + _ARM_M**2, _NORMAL_RAD**2
    for X_CR in poses:
        X = X_BC @ X_CR
        R, lever = X.rotation().matrix(), X.translation() - X_BC @ WORK_C
        J, Jn = np.hstack([-skew(lever), np.eye(3)]), np.hstack([-skew(R[:, 2]), np.zeros((3, 3))])
        N += J.T @ J / var_p + Jn.T @ Jn / var_n
        pulled += J.T @ R / var_p
    V = np.linalg.inv(N)
    return float(np.sqrt(np.trace(V[3:, 3:]) + _BIAS_M**2 * ((V @ pulled)[3:] ** 2).sum()))


@figure(
    "capture-guidance", "error at the work point after eight captures: guided, at random, and the best of many sets"
)
def capture_guidance(run: Run) -> None:
    """Compare guided sessions with random ones."""
    sets, ratios, of_best, rows = run.size(100, 1000), [], [], []
    for seed in run.seeds(6, 50):
        rng = np.random.default_rng(seed)
        X_BC = RigidTransform(
            RollPitchYaw(np.pi + rng.uniform(-0.3, 0.3), 0.2, rng.uniform(-3.0, 3.0)), [0.5, 0.2, 1.2]
        )
        bias, tilt = _BIAS_M * rng.normal(size=3), np.radians(30.0)
        seen = [looked_at(X_BC, at_random(rng, tilt), bias, rng) for _ in range(LEAST)]
        guess = calibrate_from_few(seen, {}).X_BC
        while len(seen) < CAPTURES:
            advice = next_scan(seen, guess, RigidTransform(), "", ArmPose())
            assert advice is not None
            assert advice.X_BF is not None
            seen.append(looked_at(X_BC, X_BC.inverse() @ advice.X_BF, bias, rng))
        guided = error_m([X_BC.inverse() @ o.X_BR for o in seen], X_BC)
        others = [error_m([at_random(rng, tilt) for _ in range(CAPTURES)], X_BC) for _ in range(sets)]
        ratios.append(guided / float(np.median(others)))
        of_best.append(guided / float(np.min(others)))
        rows.append((1e3 * guided, 1e3 * float(np.median(others)), 1e3 * float(np.min(others))))
    guided, random, best = np.median(rows, axis=0)
    heads = ("sessions", "guided, mm", "random, mm", "best set, mm", "guided / random", "guided / best")
    of = f"{np.median(ratios):.2f}", f"{np.median(of_best):.2f}"
    run.table("", heads, [(str(len(rows)), f"{guided:.3f}", f"{random:.3f}", f"{best:.3f}", *of)])
