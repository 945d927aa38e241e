"""Simulates a scanner beside a UR10e with factory-size errors, and how much of them --refine finds in planned scans."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.stats import f as fisher

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.scanner_fit import from_motion
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.joints import flange_poses
from weldcal.calibration.refinement.kinematics_fit import (
    ArmErrors,
    FactoryPrior,
    KinematicsFit,
    arm_errors,
    fit_kinematics,
)
from weldcal.models.arms.chain import Chain, load_chain
from weldcal.models.arrays import Array
from weldcal.systems.runner import Progress, no_progress

SCANS, NEW = 20, 25
_CENTRE_M, _NORMAL_RAD = 2e-5, float(np.radians(0.01))  # of a scan's fit, and of the arm's repeatability, per axis
_REPEAT_M = 2e-5
_MIDDLE = np.radians([20.0, -80.0, 105.0, -115.0, -90.0, 30.0])
_SPREAD_RAD = np.array([0.5, 0.4, 0.5, 0.8, 0.8, 1.5])
_CANDIDATES = 250


@dataclass(frozen=True)
class Station:
    """One world: stated observations at joint angles q, and the errors (n, 6) of the arm that no estimate is given."""

    observations: list[Observation]
    q: Array
    new: list[Observation]
    new_q: Array
    errors: Array


def station(seed: int, scans: int = SCANS, new: int = NEW, *, planned: bool = True, links: bool = True) -> Station:
    """A UR10e with offsets of 0.02 to 0.05 degrees and axes off by 0.1 to 0.3 mm and 0.02 degrees, and a scanner 0.65 m from its flange with
    a scale error of 0.1 %, a gradient of 0.05 % per 100 mm and a radial distortion that the correction's polynomial has only in part.

    ``planned``: the scans are those of 250 candidates that tell most about the arm (greedy, D-optimal); the new ones are random.
    Without ``links`` only the joints' zeros are wrong.
    """
    rng, arm = np.random.default_rng(seed), load_chain("ur10e")
    errors = np.zeros((arm.n, 6))
    sign = rng.choice([-1.0, 1.0], (arm.n, 6))
    errors[:, 2] = np.radians(rng.uniform(0.02, 0.05, arm.n)) * sign[:, 2]
    errors[:, :2] = np.radians(0.02) * rng.normal(size=(arm.n, 2))
    errors[:, 3:] = rng.uniform(1e-4, 3e-4, (arm.n, 3)) / np.sqrt(3.0) * sign[:, 3:]
    if not links:
        errors[:, [0, 1, 3, 4, 5]] = 0.0
    flange = flange_poses(arm, _MIDDLE[None], np.zeros((arm.n, 6)))[0]
    X_BC = flange @ pose(
        exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(0.2 * rng.normal(size=3)), np.array([0.0, 0.0, 0.65])
    )
    q = _visible(arm, X_BC, rng, _CANDIDATES + new)
    chosen = _planned(arm, X_BC, q[:_CANDIDATES], scans) if planned else np.arange(scans)
    bend = (1e-3 * rng.normal(), 5e-3 * rng.normal(size=2), 3e-3 * rng.normal())
    one, other = q[chosen], q[_CANDIDATES:]
    return Station(
        _seen(arm, one, errors, X_BC, bend, rng, "p"),
        one,
        _seen(arm, other, errors, X_BC, bend, rng, "n"),
        other,
        errors,
    )


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


def _planned(arm: Chain, X_BC: Array, q: Array, n: int) -> NDArray[np.int64]:
    """Indices (n,) of the candidates that fix camera, scanner and arm best."""
    plain = _observations(arm, q, X_BC)
    every = arm_errors(arm, "links")
    X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BC[:3, :3]), X_BC[:3, 3])
    fit = KinematicsFit(X, ScannerCorrection(), np.zeros(len(every.which)), np.eye(1), 1e-4, 1e-3, 1.0, every)
    J = fit.sensitivity(plain, q)
    J[:, :3] /= 1e-4
    J[:, 3:] /= 1e-3
    terms = J.shape[2] - 6 - len(every.which)
    A = np.diag(np.concatenate([np.full(6, 1e-2), np.full(terms, 1e2), np.ones(len(every.which))]))
    chosen: list[int] = []
    for _ in range(n):
        V = np.linalg.inv(A)
        gain = np.linalg.slogdet(np.eye(6) + J @ V @ np.swapaxes(J, 1, 2))[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        A = A + J[best].T @ J[best]
    return np.array(chosen)


def _observations(arm: Chain, q: Array, X_BC: Array) -> list[Observation]:
    stated = flange_poses(arm, q, np.zeros((arm.n, 6)))
    X = inverse(X_BC) @ stated
    return [_observation(str(i), stated[i], X[i, :3, 3], X[i, :3, 2]) for i in range(len(q))]


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
) -> list[Observation]:
    """What the wrong scanner sees of the wrong arm, beside the poses that the controller states."""
    stated, real = flange_poses(arm, q, np.zeros((arm.n, 6))), flange_poses(arm, q, errors)
    out = []
    for i, X in enumerate(inverse(X_BC) @ real):
        p = X[:3, 3] + _REPEAT_M * rng.normal(size=3)
        # the face is where the scanner puts the ends of two of its diameters
        a, b = (_distorted(p + 0.03 * X[:3, k], bend) - _distorted(p - 0.03 * X[:3, k], bend) for k in (0, 1))
        z = np.cross(a, b)
        z = exp_rotation(_NORMAL_RAD * rng.normal(size=3)) @ (z / np.linalg.norm(z))
        out.append(_observation(f"{name}{i}", stated[i], _distorted(p, bend) + _CENTRE_M * rng.normal(size=3), z))
    return out


def _distorted(p: Array, bend: tuple[float, Array, float]) -> Array:
    scale, gradient, radial = bend
    x = p[:2] / p[2]
    return np.asarray(p * (1.0 + scale + gradient @ p[:2] + radial * float(x @ x)))


@dataclass(frozen=True)
class Found:
    """One world: errors (m,) m at new scans of the plain and of the refined calibration, whether they lie in the stated 95 % regions, and
    the joint offsets' errors in units of their sigma."""

    plain_m: Array
    refined_m: Array
    inside: Array
    offsets_sigma: Array


def study_station(world: Station, kind: str = "links", prior: FactoryPrior | None = None) -> Found:
    """Calibrate one world plain (scanner corrected by motion) and refined, and judge both on its new scans."""
    arm = load_chain("ur10e")
    sought: ArmErrors = arm_errors(arm, kind, prior)
    plain = from_motion(world.observations, {}, order=2, usual=True)
    assert plain.X_BC is not None
    nothing = KinematicsFit(
        plain.X_BC, plain.correction, np.zeros(len(sought.which)), np.eye(1), 1e-4, 1e-3, 1.0, sought
    )
    fit = fit_kinematics(world.observations, world.q, sought, plain.X_BC, plain.correction)
    before, after = (
        np.array([f.X_BC @ o.p_CR - o.p_BR for o in f.applied(world.new, world.new_q)]) for f in (nothing, fit)
    )
    C = fit.predicted(world.new, world.new_q)
    square = np.einsum("ni,nij,nj->n", after, np.linalg.inv(C), after)
    inside = square < 3.0 * fisher.ppf(0.95, 3, fit.redundancy)
    rows = [i for i, w in enumerate(sought.which) if w % 6 == 2]
    off = (fit.values - world.errors.ravel()[sought.which])[rows] / fit.sigma[rows]
    return Found(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1), inside, off)


def run_wrong_arm(runs: int, seed: int = 0, kind: str = "links", progress: Progress = no_progress) -> dict[str, object]:
    """``runs`` worlds: mean errors at new scans before and after, the share inside the stated regions, and how many offsets lie within
    three sigma. Worlds of the kind "joints" have wrong zeros of the joints only."""
    found = []
    for k in range(runs):
        found.append(study_station(station(seed + k, links=kind == "links"), kind))
        progress("wrong arms", (k + 1) / runs)
    before, after = (1e3 * np.concatenate([getattr(f, name) for f in found]) for name in ("plain_m", "refined_m"))
    off = np.concatenate([np.abs(f.offsets_sigma) for f in found])
    return {
        "state": "done",
        "worlds": runs,
        "kind": kind,
        "plain_mm": float(before.mean()),
        "refined_mm": float(after.mean()),
        "ratio": float(after.mean() / before.mean()),
        "inside_95_percent": 100.0 * float(np.concatenate([f.inside for f in found]).mean()),
        "offsets_within_3_sigma_percent": 100.0 * float((off < 3.0).mean()),
    }
