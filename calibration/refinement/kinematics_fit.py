"""Fit errors of the arm, camera and scanner together, and choose the poses whose scans show most of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.linalg import block_diag

from weldcal.calibration.adjustment import Kind, Observed, Unknowns, adjust, helmert, most_informative, plain
from weldcal.calibration.data.scanner_correction import TERMS, ScannerCorrection, correction_of
from weldcal.calibration.eye_on_base.scanner_fit import CIRCLE_OWN, CorrectionEstimate
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, flange_poses, inverse, pose, skew
from weldcal.models.arms.kinematics import Chain
from weldcal.models.arrays import Array

KINDS = ("joints", "links")
_STEP = 1e-3  # of the prior, for differences
_USUAL_SCANNER = np.array([2e-3, 1.5e-2, 1.5e-2])  # as in the correction from few poses
_BEND_PRIOR = 0.05  # 1/m^2 and 1/m^3: a tenth of a per cent at the edge of the field
_FACE_M = 0.03  # a face is seen that far around its centre
_LEAST_ORDER = 2  # the arm's errors must not stand in for bends that a plain calibration does without
_PARTS = ("turn x", "turn y", "offset", "shift x", "shift y", "shift z")

_POSITION_M, _NORMAL_RAD = 1e-4, 1e-3  # what arms and scanners leave of a scan
_BEFORE = 0.1  # of X_BC (rad, m) and the scanner's factors before any scan: next to nothing is known


@dataclass(frozen=True)
class FactoryPrior:
    """Standard deviations of what a maker's arm is off.

    Zero of a joint, turn of its axis (rad), place of its axis (m).
    """

    offset_rad: float = float(np.radians(0.035))
    turn_rad: float = float(np.radians(0.02))
    length_m: float = 1.2e-4

    def times(self, factor: float) -> FactoryPrior:
        """Return the same, wider by this factor."""
        return FactoryPrior(factor * self.offset_rad, factor * self.turn_rad, factor * self.length_m)


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """Errors of an arm that are sought.

    ``which`` (k,) of its 6 n numbers, their ``scale`` (k,) (prior, rad or m) and ``names``.
    """

    arm: Chain
    which: NDArray[np.int64]
    scale: Array
    names: tuple[str, ...]

    def errors(self, u: Array) -> Array:
        """Return the errors (n, 6) for u (k,) in units of the prior."""
        out = np.zeros(6 * self.arm.n)
        out[self.which] = u * self.scale
        return out.reshape(-1, 6)

    def after(self, q: Array, X_BR: Array) -> Array:
        """What stated poses (n, 4, 4) add to those of the arm without errors at joint angles q (n, joints)."""
        return np.asarray(inverse(flange_poses(self.arm, q, np.zeros((self.arm.n, 6)))) @ X_BR)

    def moved(self, q: Array, after: Array, u: Array) -> Array:
        """Poses (n, 4, 4) that the arm with these errors reaches at joint angles q (n, joints)."""
        return np.asarray(flange_poses(self.arm, q, self.errors(u)) @ after)


def unsought(arm: Chain, kind: str) -> ArmErrors | None:
    """Return the errors of the links that ``kind`` does not seek; None where it seeks all."""
    if kind == "links":
        return None
    every, sought = arm_errors(arm, "links"), set(arm_errors(arm, kind).which.tolist())
    left = np.array([i for i, w in enumerate(every.which.tolist()) if w not in sought])
    return ArmErrors(arm, every.which[left], every.scale[left], tuple(every.names[i] for i in left))


def arm_errors(arm: Chain, kind: str, prior: FactoryPrior | None = None) -> ArmErrors:
    """Return the errors of the arm that a scanner beside it can separate from its own pose.

    ``kind`` is "joints" for joint offsets, or "links" for all errors of the links.

    All of the first joint moves the base as a whole, and the turn of the last one about its axis does not show on a
    flange: both are left out.
    """
    prior = prior or FactoryPrior()
    each = np.array([prior.turn_rad, prior.turn_rad, prior.offset_rad, *[prior.length_m] * 3])
    wanted = [6 * j + p for j in range(1, arm.n) for p in ((2,) if kind == "joints" else range(6))]
    which = np.array([i for i in wanted if i != 6 * (arm.n - 1) + 2])
    names = tuple(f"{arm.joint_names[i // 6]} {_PARTS[i % 6]}" for i in which)
    return ArmErrors(arm, which, each[which % 6], names)


@dataclass(frozen=True, eq=False, kw_only=True)
class KinematicsFit:
    """Camera pose, correction and errors u (k,) in units of their prior.

    ``covariance`` (6 + K + k,) of all: rotation on the base side about the camera's origin, its displacement, factors,
    u. The sigmas are the scatter per axis, ``redundancy`` the spare numbers of positions. ``sigma_considered`` (k,):
    standard deviations of u where other errors of the arm were considered.
    """

    X_BC: RigidTransform
    correction: ScannerCorrection
    u: Array
    covariance: Array
    sigma_position_m: float
    sigma_normal_rad: float
    redundancy: float
    errors: ArmErrors
    sigma_considered: Array | None = None

    @property
    def values(self) -> Array:
        """The errors (k,), rad or m."""
        return self.u * self.errors.scale

    @property
    def sigma(self) -> Array:
        """Their standard deviations (k,), with what errors that were not sought may add."""
        if self.sigma_considered is not None:
            return self.sigma_considered * self.errors.scale
        k = len(self.u)
        return np.asarray(np.sqrt(np.diag(self.covariance)[-k:]) * self.errors.scale)

    def corrected_stack(self) -> Array:
        """Return the arm's link transforms (n, 4, 4) with the errors found: m, rad."""
        errors = self.errors.errors(self.u)
        return np.asarray(self.errors.arm.stack @ pose(exp_rotation(errors[:, :3]), errors[:, 3:]))

    def applied(self, observations: Sequence[Observation], q: Array) -> list[Observation]:
        """Observations with corrected centres and normals and with the poses that the corrected arm reaches."""
        data = _arrays(observations, self.errors, q)
        poses = self.errors.moved(q, data.after, self.u)
        c, m = _corrected(self.correction, data)
        return [
            replace(o, X_BR=as_transform(X), p_CR=p, n_C=None if o.n_C is None else n)
            for o, X, p, n in zip(observations, poses, c, m, strict=True)
        ]

    def sensitivity(self, observations: Sequence[Observation], q: Array) -> Array:
        """Return the derivatives (n, 6, 6 + K + k) of each scan by everything that is estimated.

        A scan is its position (m) and normal (rad).
        """
        n = len(observations)
        J = _jacobian(self, _arrays(observations, self.errors, q), q)
        return np.concatenate([J[: 3 * n].reshape(n, 3, -1), J[3 * n :].reshape(n, 3, -1)], axis=1)

    def predicted(self, observations: Sequence[Observation], q: Array) -> Array:
        """Covariance (n, 3, 3) m^2 of the position error at new poses.

        Of everything estimated, and of the scan itself.
        """
        data = _arrays(observations, self.errors, q)
        J = self.sensitivity(observations, q)[:, :3]
        R = self.X_BC.rotation().matrix()
        own = R @ data.own @ R.T + self.sigma_position_m**2 * np.eye(3)
        return np.asarray(J @ self.covariance @ np.swapaxes(J, 1, 2) + own)


@dataclass(frozen=True)
class _Data:
    after: Array
    c: Array
    m: Array
    has: NDArray[np.bool_]
    own: Array


def fit_kinematics(
    observations: Sequence[Observation],
    q: Array,
    errors: ArmErrors,
    X_BC: RigidTransform,
    correction: ScannerCorrection,
    *,
    holes: CorrectionEstimate | None = None,
    fixed_scanner: bool = False,
    considered: ArmErrors | None = None,
) -> KinematicsFit:
    """Fit everything to observations (n) at joint angles q (n, joints), from a plain calibration.

    ``holes`` is what the hole circles say of the scanner. ``fixed_scanner`` holds the correction.

    Gauss-Newton with derivatives by differences; maximum a posteriori (arm: ``errors``' prior; scanner: what scanners
    usually are off). The scatters of positions and normals follow from the residuals (Helmert). ``considered``: errors
    that the arm may have besides, with their prior; they are not fitted, but widen the standard deviations of those
    that are (consider covariance, Schmidt 1966).
    """
    data = _arrays(observations, errors, q)
    k, terms = len(errors.which), TERMS[correction.order if fixed_scanner else max(correction.order, _LEAST_ORDER)]
    start = np.zeros(terms)
    start[: len(correction.values)] = correction.values - np.eye(len(correction.values))[0]
    correction = correction_of(start, correction.field_m or _field(data))
    mean, information = _scanner_prior(terms, holes, fixed_scanner, start)
    prior = block_diag(information, np.eye(k))
    first = KinematicsFit(
        X_BC=X_BC,
        correction=correction,
        u=np.zeros(k),
        covariance=np.eye(6 + terms + k),
        sigma_position_m=1e-4,
        sigma_normal_rad=1e-3,
        redundancy=1.0,
        errors=errors,
    )
    n = len(data.c)
    own = np.trace(data.own, axis1=1, axis2=2) / 3.0

    def at_(at: Unknowns) -> KinematicsFit:
        change = correction_of(at.numbers[:terms], correction.field_m)
        return replace(first, X_BC=as_transform(at.poses[0]), correction=change, u=at.numbers[terms:])

    def linearised(at: Unknowns) -> tuple[Observed, Observed]:
        f = at_(at)
        J, e = _jacobian(f, data, q), _residuals(f, data, errors.moved(q, data.after, f.u))
        (e_p, e_n), (J_p, J_n) = e.reshape(2, n, 3), J.reshape(2, n, 3, -1)
        return Observed(e_p, J_p, own), Observed(e_n[data.has], J_n[data.has])

    end = adjust(
        Unknowns((np.asarray(X_BC.GetAsMatrix4()),), np.concatenate([start, np.zeros(k)])),
        linearised,
        (
            Kind(rank=3, loss=plain, spread=helmert, sigma=first.sigma_position_m),
            Kind(rank=2, loss=plain, spread=helmert, sigma=first.sigma_normal_rad),
        ),
        prior=prior,
        mean=np.concatenate([mean, np.zeros(k)]),
    )
    found = replace(
        at_(end.at),
        covariance=end.covariance,
        redundancy=end.spare[0],
        sigma_position_m=end.sigmas[0],
        sigma_normal_rad=end.sigmas[1],
    )
    if considered is None or not k:
        return found
    # at the errors found: what one standard deviation of each other error does to the estimate
    other = replace(found, errors=considered, u=np.zeros(len(considered.which)))
    moved = replace(
        data,
        after=inverse(flange_poses(errors.arm, q, np.zeros((errors.arm.n, 6))))
        @ found.errors.moved(q, data.after, found.u),
    )
    weights = np.concatenate([1.0 / (own + end.sigmas[0] ** 2), data.has / end.sigmas[1] ** 2])
    w = np.repeat(weights, 3)[:, None]
    gain = found.covariance @ (_jacobian(found, data, q) * w).T @ _jacobian(other, moved, q)[:, 6 + terms :]
    square = np.diag(found.covariance) + (gain**2).sum(axis=1)
    return replace(found, sigma_considered=np.sqrt(square[-k:]))


def _field(data: _Data) -> tuple[float, float, float, float]:
    """Smallest and largest x, then y, of the faces (m): where bends hold."""
    x, y = data.c[:, 0], data.c[:, 1]
    return float(x.min()) - _FACE_M, float(x.max()) + _FACE_M, float(y.min()) - _FACE_M, float(y.max()) + _FACE_M


def usual_scanner(terms: int, corrected: bool) -> Array:
    """Standard deviations (K,) of a scanner's factors before it is asked; next to nothing where none is estimated."""
    if not corrected:
        return np.full(terms, 1e-9)
    return np.concatenate([_USUAL_SCANNER, np.full(max(terms - 3, 0), _BEND_PRIOR)])[:terms]


def _scanner_prior(terms: int, holes: CorrectionEstimate | None, fixed: bool, start: Array) -> tuple[Array, Array]:
    """Mean (K,) and information (K, K) of the factors' change before the robot is asked."""
    sigma = usual_scanner(terms, not fixed)
    if fixed:
        return start, np.diag(1.0 / sigma**2)
    information, pull = np.diag(1.0 / sigma**2), np.zeros(terms)
    if holes is not None:
        seen = np.linalg.inv(holes.covariance[:3, :3] + np.diag(CIRCLE_OWN**2))
        information[:3, :3] += seen
        pull[:3] = seen @ (holes.values[:3] - np.eye(3)[0])
    return np.asarray(np.linalg.solve(information, pull), dtype=np.float64), information


def _arrays(observations: Sequence[Observation], errors: ArmErrors, q: Array) -> _Data:
    zero = np.zeros(3)
    return _Data(
        errors.after(q, np.array([o.X_BR.GetAsMatrix4() for o in observations])),
        np.array([o.p_CR for o in observations], dtype=float),
        np.array([zero if o.n_C is None else o.n_C for o in observations], dtype=float),
        np.array([o.n_C is not None for o in observations]),
        np.array([np.zeros((3, 3)) if o.center_covariance is None else o.center_covariance for o in observations]),
    )


def _corrected(correction: ScannerCorrection, data: _Data) -> tuple[Array, Array]:
    safe = np.where(data.has[:, None], data.m, [0.0, 0.0, -1.0])
    return correction.points(data.c), correction.normals(data.c, safe)


def _residuals(f: KinematicsFit, data: _Data, X: Array) -> Array:
    """Return position residuals (3 n) m, then those of the observed normals (3 n) rad, in the base.

    The latter lie beside the normals of the reached poses X (n, 4, 4).
    """
    return _beside(*_seen(f, data), data, X)


def _seen(f: KinematicsFit, data: _Data) -> tuple[Array, Array]:
    """Corrected centres (n, 3) m and normals (n, 3) in the base."""
    c, m = _corrected(f.correction, data)
    R = f.X_BC.rotation().matrix()
    return c @ R.T + f.X_BC.translation(), m @ R.T


def _beside(p: Array, normal: Array, data: _Data, X: Array) -> Array:
    """Return the residuals of these centres and normals in the base."""
    e_p = p - X[:, :3, 3]
    e_n = np.where(data.has[:, None], np.cross(X[:, :3, 2], normal), 0.0)
    return np.concatenate([e_p.ravel(), e_n.ravel()])


def _moved(f: KinematicsFit, step: Array) -> KinematicsFit:
    terms = len(f.correction.values)
    X = RigidTransform(
        RotationMatrix.ProjectToRotationMatrix(exp_rotation(step[:3]) @ f.X_BC.rotation().matrix()),
        f.X_BC.translation() + step[3:6],
    )
    change = f.correction.values - np.eye(terms)[0] + step[6 : 6 + terms]
    return replace(f, X_BC=X, correction=correction_of(change, f.correction.field_m), u=f.u + step[6 + terms :])


def _jacobian(f: KinematicsFit, data: _Data, q: Array) -> Array:
    """Derivatives (6 n, 6 + K + k) of the residuals."""
    terms, k, n = len(f.correction.values), len(f.u), len(data.c)
    J = np.zeros((6 * n, 6 + terms + k))
    c, m = _corrected(f.correction, data)
    R = f.X_BC.rotation().matrix()
    poses = f.errors.moved(q, data.after, f.u)
    normal = poses[:, :3, 2]
    J[: 3 * n, :3] = -skew(c @ R.T).reshape(-1, 3)
    J[: 3 * n, 3:6] = np.tile(np.eye(3), (n, 1))
    turned = -skew(normal) @ skew(m @ R.T)
    J[3 * n :, :3] = np.where(data.has[:, None, None], turned, 0.0).reshape(-1, 3)
    for j in range(6, 6 + terms):
        step = np.zeros(6 + terms + k)
        step[j] = 1e-5
        plus, minus = (_residuals(_moved(f, s), data, poses) for s in (step, -step))
        J[:, j] = (plus - minus) / 2e-5
    # errors of the arm leave what the scanner saw as it is
    seen = _seen(_moved(f, np.zeros(6 + terms + k)), data)
    for j, u in enumerate(_STEP * np.eye(k), 6 + terms):
        plus, minus = (_beside(*seen, data, f.errors.moved(q, data.after, f.u + s)) for s in (u, -u))
        J[:, j] = (plus - minus) / (2.0 * _STEP)
    return J


def informative_poses(arm: Chain, X_BC: RigidTransform, q: Array, n: int, kind: str = "links") -> NDArray[np.int64]:
    """Choose indices (n,) of joint angles q (m, joints) rad to scan for `--refine`.

    The scanner sees the flange at their poses.

    Greedy: each next pose lowers the expected squared position error over all m poses most (V-optimal design, Atkinson,
    Donev and Tobias 2007, 10.6). The first ones say most.
    """
    stated = flange_poses(arm, q, np.zeros((arm.n, 6)))
    seen = inverse(np.asarray(X_BC.GetAsMatrix4())) @ stated
    sought = arm_errors(arm, kind)
    k = len(sought.which)
    fit = KinematicsFit(
        X_BC=X_BC,
        correction=ScannerCorrection(),
        u=np.zeros(k),
        covariance=np.eye(1),
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=sought,
    )
    scans = [
        Observation(str(i), as_transform(X), c[:3, 3], c[:3, 2])
        for i, (X, c) in enumerate(zip(stated, seen, strict=True))
    ]
    J = fit.sensitivity(scans, q)
    wanted = np.einsum("nij,nik->jk", J[:, :3], J[:, :3])
    J = J / np.repeat([_POSITION_M, _NORMAL_RAD], 3)[:, None]
    terms = J.shape[2] - 6 - k
    sigma = np.concatenate([np.full(6 + terms, _BEFORE), np.ones(k)])
    J, wanted = J * sigma, wanted * np.outer(sigma, sigma)  # unit priors; a covariance that is taken down loses digits

    def known(information: Array) -> Array:
        return -np.asarray(np.trace(np.linalg.solve(information, wanted), axis1=-2, axis2=-1))

    return np.array(most_informative(np.eye(len(sigma)), np.swapaxes(J, 1, 2) @ J, min(n, len(q)), known)[0])
