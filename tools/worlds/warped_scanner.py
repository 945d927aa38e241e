"""Observations by a scanner that errs by another model than the one that is fitted, and calibrations from them."""

from dataclasses import replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.ndimage import map_coordinates, spline_filter

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import CoplanarPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.planning.observability import check_diversity
from weldcal.models.arrays import Array
from weldcal.models.depth_noise import device_warp
from weldcal.tools.worlds.flange_frames import facing

WARP_M = 0.8e-3
"""Largest depth error at ``REFERENCE_M``: 0.2 % of it, as a real scanner showed."""
REFERENCE_M = 0.4
X_BC = RigidTransform(RollPitchYaw(2.6, 0.1, 0.4), [0.4, -0.7, 0.5])
NOISE_M, NOISE_RAD, NOISE_RATIO = 1e-4, 1e-3, 6e-4  # of a centre and a normal per axis, and of a hole circle's ratio
_FIELD = 0.5  # half of what the scanner sees over its distance
_BORDER = 12  # pixels
_ARM_WAVE_M = 0.8
_REACH = np.array([0.12, 0.10, 0.06])  # m, of the places round the middle of the field
_MIDDLE = np.array([0.0, 0.0, REFERENCE_M])
WORK_C = np.array([0.02, -0.05, 0.38])


@cache
def _splines(device: int, warp_m: float) -> Array:
    """Coefficients of the cubic splines through the device's depth errors, with room for the border's continuation."""
    image = np.pad(np.asarray(device_warp((401, 401), warp_m, device), dtype=float), _BORDER, mode="edge")
    return np.asarray(spline_filter(image, 3, mode="nearest"))


def warped_point(p_C: Array, device: int, warp_m: float = WARP_M) -> Array:
    """Where a scanner whose depth is off by a field of cosines over its image puts a point (3,) m; no polynomial in x
    and y."""
    column, row = ((1.0 + p_C[k] / p_C[2] / _FIELD) * 200.0 for k in (0, 1))
    place = [[row + _BORDER], [column + _BORDER]]
    off = float(map_coordinates(_splines(device, warp_m), place, order=3, mode="nearest", prefilter=False)[0])
    return np.asarray(p_C * (1.0 + off * (p_C[2] / REFERENCE_M) ** 2 / p_C[2]))


def warped_observations(
    device: int, n: int, seed: int, warp_m: float = WARP_M, arm_m: float = 0.0
) -> tuple[list[Observation], dict[str, HolePattern]]:
    """Observations (n) and hole circles by such a scanner; both follow from where it puts the points of the flange.

    The arm's stated positions are off by a smooth field of ``arm_m`` (per axis, rms).
    """
    rng, observations, patterns, h = np.random.default_rng((device, seed)), [], {}, 0.02
    for k in range(n):
        true = _MIDDLE + rng.uniform(-_REACH, _REACH)
        R_CR = RollPitchYaw(
            np.pi + rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-3, 3)
        ).ToRotationMatrix()
        x, y = (
            (warped_point(true + h * axis, device, warp_m) - warped_point(true - h * axis, device, warp_m)) / (2.0 * h)
            for axis in R_CR.matrix().T[:2]
        )
        normal = np.cross(x, y)
        normal = normal / np.linalg.norm(normal) + NOISE_RAD * rng.standard_normal(3)
        p_C = warped_point(true, device, warp_m) + NOISE_M * rng.standard_normal(3)
        name = f"p{k:02d}"
        X_BR = X_BC @ RigidTransform(R_CR, true)
        if arm_m:
            X_BR = RigidTransform(X_BR.rotation(), X_BR.translation() - arm_error(X_BR.translation(), device, arm_m))
        observations.append(Observation(name, X_BR, p_C, normal / np.linalg.norm(normal)))
        ratio = 0.5 * float(np.linalg.norm(x) + np.linalg.norm(y)) + NOISE_RATIO * rng.standard_normal()
        patterns[name] = HolePattern(
            holes_C=np.zeros((4, 3)),
            angles_rad=np.zeros(4),
            center_C=p_C,
            X_CR=RigidTransform(R_CR, p_C),
            ratio=ratio,
            rms_m=0.0,
        )
    return observations, patterns


def arm_error(p_B: Array, device: int, arm_m: float) -> Array:
    """By how much (3,) m an arm misses a place: six waves of about 0.8 m, as kinematics that are off by hundredths of a
    degree do."""
    rng = np.random.default_rng([device, 41])
    waves, phases = 2.0 * np.pi / _ARM_WAVE_M * rng.standard_normal((6, 3)), rng.uniform(0.0, 2.0 * np.pi, 6)
    along = arm_m * np.sqrt(2.0 / 6.0) * rng.standard_normal((6, 3))
    return np.asarray(np.cos(waves @ np.asarray(p_B) + phases) @ along)


def calibrate_warped(device: int, n: int, warp_m: float = WARP_M) -> tuple[CalibrationEstimate, CalibrationEstimate]:
    """Without a correction, and as ``weldcal calibrate`` does it."""
    observations, patterns = warped_observations(device, n, 0, warp_m)
    rigid = estimate_eye_on_base(observations, SolveConfig(hypotheses=60))
    return rigid, estimate_jointly(observations, patterns, config=SolveConfig(hypotheses=60))[0]


def new_errors(device: int, estimate: CalibrationEstimate, warp_m: float = WARP_M) -> Array:
    """Errors (60,) m at places that the calibration did not use, with an observation's noise."""
    new, _ = warped_observations(device, 60, 1, warp_m)
    correction = estimate.correction
    return position_errors(
        estimate.X_BC, new if correction is None else [corrected_observation(correction, o) for o in new]
    )


SIGMA_M, SIGMA_RAD, SIGMA_RATIO = 1e-4, 1e-3, 1e-3  # of a centre and a normal per axis, and of a hole circle's ratio


def simulated_observations(n: int, rng: np.random.Generator) -> tuple[list[Observation], RigidTransform]:
    """Observations (n) of a flange and the camera's true pose X_BC: arm and scanner are off by ``SIGMA_M`` and
    ``SIGMA_RAD`` an axis, the fit by what its own covariance says (0.02 to 0.06 mm). Places that lie in one plane,
    which a calibration refuses, are drawn again."""
    X_BC = RigidTransform(
        RollPitchYaw(rng.uniform(np.array([2.8, -0.3, -3.1]), np.array([3.4, 0.3, 3.1]))), rng.uniform(-0.6, 1.0, 3)
    )
    while True:
        out = [_simulated_observation(f"p{k}", X_BC, rng) for k in range(n)]
        try:
            check_diversity(np.array([o.p_BR for o in out]), np.ones(n, dtype=bool))
        except CoplanarPoses:
            continue
        return out, X_BC


def _simulated_observation(id: str, X_BC: RigidTransform, rng: np.random.Generator) -> Observation:
    p = np.array([rng.uniform(-0.18, 0.18), rng.uniform(-0.13, 0.13), rng.uniform(0.5, 0.9)])
    X_CR = facing(p, np.radians(rng.uniform(0.0, 30.0)), rng.uniform(0.0, 6.28), rng.uniform(0.0, 6.28))
    A = np.linalg.qr(rng.standard_normal((3, 3)))[0] * rng.uniform(2e-5, 6e-5, 3)
    covariance = A @ A.T
    normal_sigma = rng.uniform(2e-5, 2e-4)
    seen = p + A @ rng.standard_normal(3) + SIGMA_M * rng.standard_normal(3)
    z = X_CR.rotation().matrix()[:, 2]
    lean = float(np.hypot(SIGMA_RAD, normal_sigma)) * rng.standard_normal(3)
    normal = exp_rotation(lean - z * float(z @ lean)) @ z
    return Observation(id, X_BC @ X_CR, seen, normal, covariance, normal_sigma)


WRONG = ScannerCorrection(1.002, (0.006, -0.004))
"""What the simulated scanner needs: 0.2 % in scale, and up to 0.06 % per 100 mm across its image."""


def seen_by_a_wrong_scanner(
    observations: list[Observation], rng: np.random.Generator
) -> tuple[list[Observation], dict[str, HolePattern]]:
    """The same observations by a scanner that needs WRONG, and the hole circle that it sees in each."""
    out, patterns = [], {}
    for o in observations:
        seen = as_measured(np.asarray(o.p_CR))
        J = WRONG.jacobian(seen)
        assert o.n_C is not None
        normal = J.T @ o.n_C
        out.append(replace(o, p_CR=seen, n_C=normal / np.linalg.norm(normal)))
        x, y = np.linalg.svd(np.asarray(o.n_C)[None])[2][1:]
        ratio = 2.0 / float(x @ J @ x + y @ J @ y) + SIGMA_RATIO * rng.standard_normal()
        R = RotationMatrix(np.column_stack([x, np.cross(o.n_C, x), o.n_C]))
        patterns[o.id] = HolePattern(
            holes_C=np.zeros((4, 3)),
            angles_rad=np.zeros(4),
            center_C=seen,
            X_CR=RigidTransform(R, seen),
            ratio=ratio,
            rms_m=0.0,
        )
    return out, patterns


def as_measured(p_C: Array) -> Array:
    """Where the scanner that needs WRONG puts a point (3,) m that truly is at p_C."""
    seen = p_C.copy()
    for _ in range(20):  # a contraction: the correction is near the identity
        seen = seen + p_C - WRONG.points(seen)
    return seen
