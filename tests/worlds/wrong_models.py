"""Observations by a scanner and by an arm that err by another model than the fitted one, and calibrations from them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.ndimage import map_coordinates, spline_filter
from scipy.stats import f as fisher

from tests.worlds.cell import HOME, Bend, bend, distorted, factory_errors, scanned, visible
from tests.worlds.flange_frames import facing
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import CoplanarPoses
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, corrected_observation
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, solve_jointly
from weldcal.calibration.eye_on_base.scanner_fit import from_holes
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, flange_poses, inverse, pose
from weldcal.calibration.planning.observability import check_diversity
from weldcal.calibration.refinement.kinematics_fit import (
    ArmErrors,
    FactoryPrior,
    KinematicsFit,
    arm_errors,
    fit_kinematics,
    informative_poses,
    unsought,
)
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import Chain
from weldcal.models.arrays import Array
from weldcal.models.depth_noise import device_warp

WARP_M = 0.8e-3
"""Largest depth error at ``REFERENCE_M``: 0.2 % of it, as a real scanner showed."""
REFERENCE_M = 0.4
X_BC = RigidTransform(RollPitchYaw(2.6, 0.1, 0.4), [0.4, -0.7, 0.5])
NOISE_M, NOISE_RAD, NOISE_RATIO = 1e-4, 1e-3, 6e-4  # of a centre and a normal per axis, and of a hole circle's ratio
_FIELD = 0.5  # half of what the scanner sees over its distance
_BORDER = 12  # pixels
_RING_M = 0.02  # radius of the ring by which such a scanner sees a face
_ARM_WAVE_M = 0.8
_REACH = np.array([0.12, 0.10, 0.06])  # m, of the places round the middle of the field
_CENTRE = np.array([0.0, 0.0, REFERENCE_M])
WORK_C = np.array([0.02, -0.05, 0.38])


@cache
def _splines(device: int, warp_m: float) -> Array:
    """Return coefficients of the cubic splines through the device's depth errors, padded for the border."""
    image = np.pad(np.asarray(device_warp((401, 401), warp_m, device), dtype=float), _BORDER, mode="edge")
    return np.asarray(spline_filter(image, 3, mode="nearest"))


def warped_point(p_C: Array, device: int, warp_m: float = WARP_M) -> Array:
    """Where a scanner whose depth is off by a field of cosines over its image puts a point (3,) m.

    No polynomial in x and y.
    """
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
    rng, observations, patterns = np.random.default_rng((device, seed)), [], {}
    for k in range(n):
        true = _CENTRE + rng.uniform(-_REACH, _REACH)
        R_CR = RollPitchYaw(
            np.pi + rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-3, 3)
        ).ToRotationMatrix()
        X_CR = RigidTransform(R_CR, true)
        p_C, normal, ratio = scanned(lambda p: warped_point(p, device, warp_m), X_CR, _RING_M, rng, NOISE_M, NOISE_RAD)
        name = f"p{k:02d}"
        X_BR = X_BC @ X_CR
        if arm_m:
            X_BR = RigidTransform(X_BR.rotation(), X_BR.translation() - arm_error(X_BR.translation(), device, arm_m))
        observations.append(Observation(name, X_BR, p_C, normal))
        ratio += NOISE_RATIO * rng.standard_normal()
        patterns[name] = _circle(RigidTransform(R_CR, p_C), p_C, ratio)
    return observations, patterns


def _circle(X_CR: RigidTransform, center_C: Array, ratio: float) -> HolePattern:
    """Return the hole circle of a flange of which only the size counts: ``ratio`` times the drawn one."""
    return HolePattern(holes_C=np.zeros((4, 3)), center_C=center_C, X_CR=X_CR, ratio=ratio, rms_m=0.0)


def arm_error(p_B: Array, device: int, arm_m: float) -> Array:
    """By how much (3,) m an arm misses a place.

    Six waves of about 0.8 m, as kinematics that are off by hundredths of a degree do.
    """
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
    """Observations (n) of a flange and the camera's true pose X_BC.

    Arm and scanner are off by ``SIGMA_M`` and ``SIGMA_RAD`` an axis, the fit by what its own covariance says (0.02 to
    0.06 mm). Places that lie in one plane, which a calibration refuses, are drawn again.
    """
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


def measured_by_a_wrong_scanner(
    observations: list[Observation], rng: np.random.Generator
) -> tuple[list[Observation], dict[str, HolePattern]]:
    """Return the same observations by a scanner that needs WRONG, and the hole circle that it sees in each."""
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
        patterns[o.id] = _circle(RigidTransform(R, seen), seen, ratio)
    return out, patterns


def as_measured(p_C: Array) -> Array:
    """Where the scanner that needs WRONG puts a point (3,) m that truly is at p_C."""
    seen = p_C.copy()
    for _ in range(20):  # a contraction: the correction is near the identity
        seen = seen + p_C - WRONG.points(seen)
    return seen


SCANS, NEW = 20, 25
_CENTRE_M, _NORMAL_RAD = 2e-5, float(np.radians(0.01))  # of a scan's fit, and of the arm's repeatability, per axis
_REPEAT_M = 2e-5
_REACH_M, _RATIO = 0.025, 3e-4  # radius of the hole circle, and how well a scan measures its size
_CANDIDATES = 250


@dataclass(frozen=True)
class WrongArmStation:
    """Hold one world of an arm with errors.

    Stated observations at joint angles q with their hole circles, and the errors (n, 6) of the arm that no estimate is
    given.
    """

    observations: list[Observation]
    q: Array
    new: list[Observation]
    new_q: Array
    errors: Array
    patterns: dict[str, HolePattern]


def station(
    seed: int, scans: int = SCANS, new: int = NEW, *, planned: bool = True, links: bool = True, size: float = 1.0
) -> WrongArmStation:
    """Draw a UR10e with wrong joints and axes, and a distorting scanner 0.65 m from its flange.

    Joint offsets of 0.02 to 0.05 degrees, axes off by 0.1 to 0.3 mm and 0.02 degrees. The scanner has a scale error of
    0.1 %, a gradient of 0.05 % per 100 mm and a radial distortion that the correction's polynomial has only in part.

    ``planned``: the scans are those of 250 candidates that tell most (informative_poses); the new ones are random.
    Without ``links`` only the joints' zeros are wrong; ``size`` multiplies the errors.
    """
    rng, arm = np.random.default_rng(seed), load_chain("ur10e")
    errors = factory_errors(rng) * size
    if not links:
        errors[:, [0, 1, 3, 4, 5]] = 0.0
    flange = flange_poses(arm, HOME[None], np.zeros((arm.n, 6)))[0]
    X_BC = flange @ pose(
        exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(0.2 * rng.normal(size=3)), np.array([0.0, 0.0, 0.65])
    )
    q = visible(arm, X_BC, rng, _CANDIDATES + new)
    guess = as_transform(X_BC)
    chosen = informative_poses(arm, guess, q[:_CANDIDATES], scans) if planned else np.arange(scans)
    bent = bend(rng)
    one, other = q[chosen], q[_CANDIDATES:]
    seen, patterns = _seen(arm, one, errors, X_BC, bent, rng, "p")
    return WrongArmStation(seen, one, _seen(arm, other, errors, X_BC, bent, rng, "n")[0], other, errors, patterns)


def _seen(
    arm: Chain, q: Array, errors: Array, X_BC: Array, bent: Bend, rng: np.random.Generator, name: str
) -> tuple[list[Observation], dict[str, HolePattern]]:
    """Observe the wrong arm with the wrong scanner, and its hole circles, beside the poses that the controller states."""
    stated, real = flange_poses(arm, q, np.zeros((arm.n, 6))), flange_poses(arm, q, errors)
    out, patterns = [], {}
    for i, X in enumerate(inverse(X_BC) @ real):
        X_CR = as_transform(X)
        X_CR.set_translation(X[:3, 3] + _REPEAT_M * rng.normal(size=3))
        c, z, ratio = scanned(lambda p: distorted(p, bent), X_CR, _REACH_M, rng, _CENTRE_M, _NORMAL_RAD)
        ratio += _RATIO * rng.normal()
        out.append(Observation(f"{name}{i}", as_transform(stated[i]), c, z, _CENTRE_M**2 * np.eye(3), _NORMAL_RAD))
        patterns[out[-1].id] = _circle(RigidTransform(X_CR.rotation(), c), c, ratio)
    return out, patterns


@dataclass(frozen=True)
class Found:
    """Hold the errors of one world.

    Errors (m,) m at new scans of the plain and of the refined calibration, whether they lie in the stated 95 % regions,
    and the joint offsets' errors in units of their sigma.
    """

    plain_m: Array
    refined_m: Array
    inside: Array
    offsets_sigma: Array


def study_station(world: WrongArmStation, kind: str = "links", prior: FactoryPrior | None = None) -> Found:
    """Calibrate one world plain, with the choice of the scanner's correction, and refined.

    Both are judged on its new scans.
    """
    arm = load_chain("ur10e")
    sought: ArmErrors = arm_errors(arm, kind, prior)
    X_BC, correction = solve_jointly(world.observations, world.patterns)
    nothing = KinematicsFit(
        X_BC=X_BC,
        correction=correction,
        u=np.zeros(len(sought.which)),
        covariance=np.eye(1),
        sigma_position_m=1e-4,
        sigma_normal_rad=1e-3,
        redundancy=1.0,
        errors=sought,
    )
    holes = from_holes(world.observations, world.patterns)
    fit = fit_kinematics(
        world.observations, world.q, sought, X_BC, correction, holes=holes, considered=unsought(arm, kind)
    )
    before, after = (
        np.array([f.X_BC @ o.p_CR - o.p_BR for o in f.applied(world.new, world.new_q)]) for f in (nothing, fit)
    )
    C = fit.predicted(world.new, world.new_q)
    square = np.einsum("ni,nij,nj->n", after, np.linalg.inv(C), after)
    inside = square < 3.0 * fisher.ppf(0.95, 3, fit.redundancy)
    rows = [i for i, w in enumerate(sought.which) if w % 6 == 2]
    off = (fit.values - world.errors.ravel()[sought.which])[rows] / fit.sigma[rows]
    return Found(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1), inside, off)


def judged(worlds: Sequence[Found]) -> dict[str, float]:
    """Compute mean errors (mm) at new scans before and after, and two shares.

    The share inside the stated regions, and of offsets within three sigma.
    """
    before, after = (1e3 * np.concatenate([getattr(f, name) for f in worlds]) for name in ("plain_m", "refined_m"))
    off = np.concatenate([np.abs(f.offsets_sigma) for f in worlds])
    return {
        "plain_mm": float(before.mean()),
        "refined_mm": float(after.mean()),
        "ratio": float(after.mean() / before.mean()),
        "inside_95_percent": 100.0 * float(np.concatenate([f.inside for f in worlds]).mean()),
        "offsets_within_3_sigma_percent": 100.0 * float((off < 3.0).mean()),
    }
