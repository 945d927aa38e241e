"""Simulates a scanner beside a UR10e with factory-size errors, and how much of them --refine finds in planned scans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.stats import f as fisher

from weldcal.calibration.eye_on_base.joint_fit import solve_jointly
from weldcal.calibration.eye_on_base.scanner_fit import from_holes
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, flange_poses, inverse, pose
from weldcal.calibration.refinement.kinematics_fit import (
    ArmErrors,
    FactoryPrior,
    KinematicsFit,
    arm_errors,
    fit_kinematics,
    informative_poses,
    unsought,
)
from weldcal.models.arms.chain import Chain, load_chain
from weldcal.models.arrays import Array

SCANS, NEW = 20, 25
_CENTRE_M, _NORMAL_RAD = 2e-5, float(np.radians(0.01))  # of a scan's fit, and of the arm's repeatability, per axis
_REPEAT_M = 2e-5
_REACH_M, _RATIO = 0.025, 3e-4  # radius of the hole circle, and how well a scan measures its size
_MIDDLE = np.radians([20.0, -80.0, 105.0, -115.0, -90.0, 30.0])
_SPREAD_RAD = np.array([0.5, 0.4, 0.5, 0.8, 0.8, 1.5])
_CANDIDATES = 250


@dataclass(frozen=True)
class WrongArmStation:
    """One world: stated observations at joint angles q with their hole circles, and the errors (n, 6) of the arm that
    no estimate is given."""

    observations: list[Observation]
    q: Array
    new: list[Observation]
    new_q: Array
    errors: Array
    patterns: dict[str, HolePattern]


def station(
    seed: int, scans: int = SCANS, new: int = NEW, *, planned: bool = True, links: bool = True, size: float = 1.0
) -> WrongArmStation:
    """A UR10e with offsets of 0.02 to 0.05 degrees and axes off by 0.1 to 0.3 mm and 0.02 degrees, and a scanner 0.65 m
    from its flange with a scale error of 0.1 %, a gradient of 0.05 % per 100 mm and a radial distortion that the
    correction's polynomial has only in part.

    ``planned``: the scans are those of 250 candidates that tell most (informative_poses); the new ones are random.
    Without ``links`` only the joints' zeros are wrong; ``size`` multiplies the errors.
    """
    rng, arm = np.random.default_rng(seed), load_chain("ur10e")
    errors = np.zeros((arm.n, 6))
    sign = rng.choice([-1.0, 1.0], (arm.n, 6))
    errors[:, 2] = np.radians(rng.uniform(0.02, 0.05, arm.n)) * sign[:, 2]
    errors[:, :2] = np.radians(0.02) * rng.normal(size=(arm.n, 2))
    errors[:, 3:] = rng.uniform(1e-4, 3e-4, (arm.n, 3)) / np.sqrt(3.0) * sign[:, 3:]
    if not links:
        errors[:, [0, 1, 3, 4, 5]] = 0.0
    errors *= size
    flange = flange_poses(arm, _MIDDLE[None], np.zeros((arm.n, 6)))[0]
    X_BC = flange @ pose(
        exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(0.2 * rng.normal(size=3)), np.array([0.0, 0.0, 0.65])
    )
    q = _visible(arm, X_BC, rng, _CANDIDATES + new)
    guess = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BC[:3, :3]), X_BC[:3, 3])
    chosen = informative_poses(arm, guess, q[:_CANDIDATES], scans) if planned else np.arange(scans)
    bend = (1e-3 * rng.normal(), 5e-3 * rng.normal(size=2), 3e-3 * rng.normal())
    one, other = q[chosen], q[_CANDIDATES:]
    seen, patterns = _seen(arm, one, errors, X_BC, bend, rng, "p")
    return WrongArmStation(seen, one, _seen(arm, other, errors, X_BC, bend, rng, "n")[0], other, errors, patterns)


def _visible(arm: Chain, X_BC: Array, rng: np.random.Generator, n: int) -> Array:
    """Joint angles (n, 6) at which the flange faces the scanner within 40 degrees, in its field and range."""
    out: list[Array] = []
    while len(out) < n:
        q = _MIDDLE + _SPREAD_RAD * rng.uniform(-1.0, 1.0, (4000, arm.n))
        X = inverse(X_BC) @ flange_poses(arm, q, np.zeros((arm.n, 6)))
        p, z = X[:, :3, 3], X[:, :3, 2]
        good = (p[:, 2] > 0.4) & (p[:, 2] < 0.95) & (np.abs(p[:, :2]) < 0.35 * p[:, 2:]).all(axis=1)
        good &= -(z * p).sum(axis=1) > np.cos(np.radians(40.0)) * np.linalg.norm(p, axis=1)
        out += list(q[good])
    return np.array(out[:n])


def _observation(id: str, stated: Array, p: Array, z: Array) -> Observation:
    X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(stated[:3, :3]), stated[:3, 3])
    return Observation(id, X, p, z / np.linalg.norm(z), _CENTRE_M**2 * np.eye(3), _NORMAL_RAD)


def _seen(
    arm: Chain,
    q: Array,
    errors: Array,
    X_BC: Array,
    bend: tuple[float, Array, float],
    rng: np.random.Generator,
    name: str,
) -> tuple[list[Observation], dict[str, HolePattern]]:
    """What the wrong scanner sees of the wrong arm, and of its hole circles, beside the poses that the controller
    states."""
    stated, real = flange_poses(arm, q, np.zeros((arm.n, 6))), flange_poses(arm, q, errors)
    out, patterns = [], {}
    for i, X in enumerate(inverse(X_BC) @ real):
        p = X[:3, 3] + _REPEAT_M * rng.normal(size=3)
        # the face is where the scanner puts the ends of two of its diameters
        a, b = (_distorted(p + _REACH_M * X[:3, k], bend) - _distorted(p - _REACH_M * X[:3, k], bend) for k in (0, 1))
        ratio = float(np.linalg.norm(a) + np.linalg.norm(b)) / (4.0 * _REACH_M) + _RATIO * rng.normal()
        z = np.cross(a, b)
        z = exp_rotation(_NORMAL_RAD * rng.normal(size=3)) @ (z / np.linalg.norm(z))
        c = _distorted(p, bend) + _CENTRE_M * rng.normal(size=3)
        out.append(_observation(f"{name}{i}", stated[i], c, z))
        X_CR = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), c)
        patterns[out[-1].id] = HolePattern(
            holes_C=np.zeros((4, 3)), angles_rad=np.zeros(4), center_C=c, X_CR=X_CR, ratio=ratio, rms_m=0.0
        )
    return out, patterns


def _distorted(p: Array, bend: tuple[float, Array, float]) -> Array:
    scale, gradient, radial = bend
    x = p[:2] / p[2]
    return np.asarray(p * (1.0 + scale + gradient @ p[:2] + radial * float(x @ x)))


@dataclass(frozen=True)
class Found:
    """One world: errors (m,) m at new scans of the plain and of the refined calibration, whether they lie in the stated
    95 % regions, and the joint offsets' errors in units of their sigma."""

    plain_m: Array
    refined_m: Array
    inside: Array
    offsets_sigma: Array


def study_station(world: WrongArmStation, kind: str = "links", prior: FactoryPrior | None = None) -> Found:
    """Calibrate one world plain, with the choice of the scanner's correction, and refined, and judge both on its new
    scans."""
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
    """Mean errors (mm) at new scans before and after, the share inside the stated regions, and of offsets within three
    sigma."""
    before, after = (1e3 * np.concatenate([getattr(f, name) for f in worlds]) for name in ("plain_m", "refined_m"))
    off = np.concatenate([np.abs(f.offsets_sigma) for f in worlds])
    return {
        "plain_mm": float(before.mean()),
        "refined_mm": float(after.mean()),
        "ratio": float(after.mean() / before.mean()),
        "inside_95_percent": 100.0 * float(np.concatenate([f.inside for f in worlds]).mean()),
        "offsets_within_3_sigma_percent": 100.0 * float((off < 3.0).mean()),
    }
