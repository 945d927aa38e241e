"""X_FS from a sphere in any poses, by its raw profile points and touches of it: one problem, no circles, no sides, no roots.

Every profile point lies on the sphere, and so does the tip at every touch. The sensor's scale and shear in its plane and,
where the joint angles are given, the arm's offsets and sag may be estimated with it, each held by a prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.arm_errors import OFFSET_JOINTS, SAG_JOINTS, DhArm
from weldcal.calibration.profiler.errors import DegenerateMotion, InconsistentData, TooFewTranslations
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.result import ProfilerEstimate, worst_direction
from weldcal.calibration.profiler.sphere_start import sphere_starts
from weldcal.models.errors import InputError

Model = Literal["rigid", "affine", "affine+joints"]
MINIMUM_POSES = 5
SINGULAR = 1e-5
POINTS_PER_POSE = 120
WRONG_POSE = 5.0  # sigmas by which one pose's mean residual may be off before it is named


@dataclass(frozen=True)
class SphereSigmas:
    """What is known before: of the sensor's points, the robot's position at a scan and at a touch (m), and the priors."""

    sensor_m: float = 0.05e-3
    robot_m: float = 0.03e-3  # per axis: a repeatability of 0.05 mm by ISO 9283 is a radius
    touch_m: float = 0.05e-3
    affine: float = 0.03
    joint_rad: float = np.radians(0.05)
    sag_rad_m: float = np.radians(0.1)
    tip_m: float = 10e-3


@dataclass(frozen=True, eq=False)
class SphereData:
    """One calibration's measurements.

    Attributes:
        poses: flange at each scan; profiles: (m, 2) [x, z] m of the sphere in each; radius_m: of the sphere.
        touches: flange at each touch, tip: (3,) m in F as far as it is known; both or none.
        arm, q, touch_q: the arm's table and its joints (n, 6) rad at scans and touches, for the model with joints.
    """

    poses: FlangePoses
    profiles: Sequence[Floats]
    radius_m: float
    touches: FlangePoses | None = None
    tip: Floats | None = None
    arm: DhArm | None = None
    q: Floats | None = None
    touch_q: Floats | None = None

    def without(self, k: int) -> SphereData:
        """The same but for scan k."""
        keep = np.arange(len(self.poses)) != k
        q = None if self.q is None else self.q[keep]
        profiles = [p for j, p in enumerate(self.profiles) if j != k]
        return SphereData(self.poses[keep], profiles, self.radius_m, self.touches, self.tip, self.arm, q, self.touch_q)


@dataclass(frozen=True, eq=False)
class SphereEstimate(ProfilerEstimate):
    """X_FS and what was estimated with it.

    Attributes:
        center: (3,) m in B; tip: (3,) m in F or None; affine: (3,) [x scale, z scale, shear] about `origin` (2,) m.
        offsets: (4,) rad of joints 2 to 5; sag: (2,) rad/m; zero where the model has them not.
        wrong_poses: scans whose points lie off the sphere together.
    """

    center: Floats = field(default_factory=lambda: np.zeros(3))
    tip: Floats | None = None
    affine: Floats = field(default_factory=lambda: np.zeros(3))
    origin: Floats = field(default_factory=lambda: np.zeros(2))
    offsets: Floats = field(default_factory=lambda: np.zeros(len(OFFSET_JOINTS)))
    sag: Floats = field(default_factory=lambda: np.zeros(len(SAG_JOINTS)))
    wrong_poses: tuple[int, ...] = ()

    def points_F(self, profile: ArrayLike) -> Floats:
        """Profile points (n, 2) m, corrected by the sensor's model, in F (n, 3)."""
        return np.asarray(
            corrected(np.asarray(profile, float), self.affine, self.origin) @ self.rotation.T + self.translation
        )


def corrected(p: Floats, affine: Floats, origin: Floats) -> Floats:
    """Profile points (n, 2) as (n, 3) in S, through [x scale, z scale, shear] about an origin."""
    a, b, h = affine
    u = p - origin
    x = u[:, 0] * (1.0 + a) + u[:, 1] * h + origin[0]
    z = u[:, 0] * h + u[:, 1] * (1.0 + b) + origin[1]
    return np.column_stack([x, np.zeros(len(p)), z])


@dataclass(frozen=True)
class _Layout:
    """Where each unknown stands in the vector: pose, centre, tip, affine, joints."""

    tip: bool
    affine: bool
    joints: bool

    def unpack(self, x: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """(w and t (6,), centre (3,), tip change (3,), affine (3,), offsets (4,), sag (2,))."""
        k, parts = 9, []
        for size, used in (
            (3, self.tip),
            (3, self.affine),
            (len(OFFSET_JOINTS), self.joints),
            (len(SAG_JOINTS), self.joints),
        ):
            parts.append(x[k : k + size] if used else np.zeros(size))
            k += size if used else 0
        return x[:6], x[6:9], parts[0], parts[1], parts[2], parts[3]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 9 + 3 * self.tip + 3 * self.affine + (len(OFFSET_JOINTS) + len(SAG_JOINTS)) * self.joints

    def sigmas(self, s: SphereSigmas) -> Floats:
        """Of the priors; infinite where there is none."""
        known: list[float] = [np.inf] * 9
        known += [s.tip_m] * 3 * self.tip + [s.affine] * 3 * self.affine
        known += ([s.joint_rad] * len(OFFSET_JOINTS) + [s.sag_rad_m] * len(SAG_JOINTS)) * self.joints
        return np.array(known)


def sphere_joint(
    data: SphereData, model: Model = "affine", sigmas: SphereSigmas | None = None, init: SphereEstimate | None = None
) -> SphereEstimate:
    """The pose of a profiler on the flange from profiles of a sphere, and touches of it where there are any.

    Without `init` the 24 orientations of a cube are tried.

    Raises:
        InputError: measurements that do not belong together, or joints asked for and not given.
        TooFewTranslations: fewer than five scans. DegenerateMotion: the motion leaves a direction open, which is named.
        InconsistentData: no sphere of this radius explains the profiles.
    """
    s = sigmas or SphereSigmas()
    _check(data, model)
    layout = _Layout(tip=data.touches is not None, affine=model != "rigid", joints=model == "affine+joints")
    problem = _Problem(data, layout, s)
    rigid = _Problem(data, _Layout(tip=layout.tip, affine=False, joints=False), s)
    best = None
    given = [] if init is None else [(init.rotation, init.translation, init.center)]
    starts = given or sphere_starts(data.poses, problem.profiles, data.radius_m)
    for R, t, c in starts:
        found = rigid.solved(R, t, np.concatenate([np.zeros(6), c, np.zeros(3 * layout.tip)]))
        if best is None or found[1].cost < best[1].cost:
            best = found
    assert best is not None
    R, result = best
    x = np.zeros(layout.size)
    x[: 9 + 3 * layout.tip] = result.x
    if layout.size > len(result.x):
        _, result = problem.solved(R, np.zeros(3), x)
    return problem.estimate(R, result.x)


def leave_one_out_m(data: SphereData, model: Model, sigmas: SphereSigmas | None = None) -> Floats:
    """Rms distance (n,) m of each scan's points to the sphere, by the calibration that did not see it."""
    errors = []
    whole = sphere_joint(data, model, sigmas)
    for k in range(len(data.poses)):
        estimate = sphere_joint(data.without(k), model, sigmas, init=whole)
        poses, p = data.poses, data.profiles[k]
        if data.arm is not None and data.q is not None:
            loads = data.arm.loads(data.q)
            poses = data.arm.poses(data.q, estimate.offsets, estimate.sag, loads)
        at = estimate.points_F(p[np.isfinite(p).all(axis=1)]) @ poses.rotation[k].T + poses.translation[k]
        distance = np.linalg.norm(at - estimate.center, axis=1) - data.radius_m
        errors.append(np.sqrt(np.mean(distance**2)))
    return np.array(errors)


def choose_model(data: SphereData, sigmas: SphereSigmas | None = None) -> tuple[Model, dict[Model, float]]:
    """The model with the least leave-one-scan-out error (rms m of each is returned); the simpler one where they are equal."""
    names: list[Model] = ["rigid", "affine"]
    if data.arm is not None:
        names.append("affine+joints")
    errors = {name: float(np.sqrt(np.mean(leave_one_out_m(data, name, sigmas) ** 2))) for name in names}
    best = min(errors.values())
    return next(name for name in names if errors[name] <= 1.02 * best), errors


def _check(data: SphereData, model: Model) -> None:
    n = len(data.poses)
    if len(data.profiles) != n:
        raise InputError(f"{n} poses need {n} profiles, not {len(data.profiles)}.")
    if n < MINIMUM_POSES:
        raise TooFewTranslations(
            f"{n} scans of the sphere are too few: take {MINIMUM_POSES} or more, in different orientations."
        )
    if (data.touches is None) != (data.tip is None):
        raise InputError("Touches need the tip's place in the flange frame, and the tip needs touches.")
    no_joints = data.arm is None or data.q is None or (data.touches is not None and data.touch_q is None)
    if model == "affine+joints" and no_joints:
        raise InputError("The model with joints needs the arm's table and its joints at every scan and touch.")
    for k, p in enumerate(data.profiles):
        if p.ndim != 2 or p.shape[1] != 2 or np.isfinite(p).all(axis=1).sum() < 5:
            raise InputError(f"Profile {k} has fewer than five points of the sphere: leave that scan out.")


class _Problem:
    """The whitened residuals of one model on one set of measurements."""

    def __init__(self, data: SphereData, layout: _Layout, sigmas: SphereSigmas) -> None:
        self._data, self._layout, self._s = data, layout, sigmas
        self.profiles = [_thinned(p[np.isfinite(p).all(axis=1)]) for p in data.profiles]
        self._count = np.array([len(p) for p in self.profiles])
        self._of = np.repeat(np.arange(len(self.profiles)), self._count)
        self._p = np.vstack(self.profiles)
        self.origin = self._p.mean(axis=0)
        self._R0, self._t0 = np.eye(3), np.zeros(3)
        self._whiten: list[tuple[Floats, Floats]] | None = None
        arm, q, touch_q = data.arm, data.q, data.touch_q
        self._loads = arm.loads(q) if arm is not None and q is not None else None
        self._touch_loads = arm.loads(touch_q) if arm is not None and touch_q is not None else None

    def solved(self, R: Floats, t: Floats, x: Floats) -> tuple[Floats, OptimizeResult]:
        """Least squares from a start, twice: the second time with the robot's own error of each scan taken out."""
        self._R0 = R
        x = np.array(x)
        x[3:6] += t
        prior = 1.0 / self._layout.sigmas(self._s)
        scale = np.concatenate(
            [[0.1] * 3, [0.01] * 6, np.where(prior[9:] > 0, 1.0 / np.where(prior[9:] > 0, prior[9:], 1), 1)]
        )
        self._whiten = None
        found = least_squares(self._residual, x, x_scale=scale, loss="soft_l1", f_scale=3.0, max_nfev=60)
        self._whiten = self._robot_error(found.x)
        found = least_squares(self._residual, found.x, x_scale=scale, loss="soft_l1", f_scale=3.0, max_nfev=60)
        return R, found

    def _poses(self, offsets: Floats, sag: Floats) -> tuple[FlangePoses, FlangePoses | None]:
        data = self._data
        if not self._layout.joints:
            return data.poses, data.touches
        assert data.arm is not None
        assert data.q is not None
        assert self._loads is not None
        touches = None
        if data.touch_q is not None and self._touch_loads is not None:
            touches = data.arm.poses(data.touch_q, offsets, sag, self._touch_loads)
        return data.arm.poses(data.q, offsets, sag, self._loads), touches

    def _off(self, x: Floats) -> tuple[Floats, Floats, FlangePoses]:
        """Vectors (m, 3) from the centre to all profile points, and to the tip at all touches (k, 3)."""
        pose, c, tip, affine, offsets, sag = self._layout.unpack(x)
        poses, touches = self._poses(offsets, sag)
        R = Rotation.from_rotvec(pose[:3]).as_matrix() @ self._R0
        p_F = corrected(self._p, affine, self.origin) @ R.T + pose[3:]
        at = np.einsum("nij,nj->ni", poses.rotation[self._of], p_F) + poses.translation[self._of] - c
        felt = np.empty((0, 3))
        if touches is not None and self._data.tip is not None:
            felt = touches.rotation @ (self._data.tip + tip) + touches.translation - c
        return at, felt, poses

    def _residual(self, x: Floats) -> Floats:
        at, felt, _ = self._off(x)
        R = self._data.radius_m
        r = (np.linalg.norm(at, axis=1) - R) / self._s.sensor_m
        if self._whiten is not None:
            start = 0
            for (U, less), n in zip(self._whiten, self._count, strict=True):
                part = r[start : start + n]
                r[start : start + n] = part - U @ (less * (U.T @ part))
                start += n
        touch = (np.linalg.norm(felt, axis=1) - R) / self._s.touch_m
        prior = x / self._layout.sigmas(self._s)
        return np.concatenate([r, touch, prior[9:]])

    def _robot_error(self, x: Floats) -> list[tuple[Floats, Floats]]:
        """Per scan (U, less) that whiten residuals which share the robot's error: C^-1/2 r = r - U less U^T r."""
        at, _, _ = self._off(x)
        normals = at / np.linalg.norm(at, axis=1, keepdims=True)
        ratio, out, start = (self._s.robot_m / self._s.sensor_m) ** 2, [], 0
        for n in self._count:
            U, s, _ = np.linalg.svd(normals[start : start + n], full_matrices=False)
            out.append((U, 1.0 - 1.0 / np.sqrt(1.0 + ratio * s**2)))
            start += n
        return out

    def estimate(self, R0: Floats, x: Floats) -> SphereEstimate:
        """The result with its covariance, and whether it may be believed."""
        self._R0 = R0
        pose, c, tip, affine, offsets, sag = self._layout.unpack(x)
        J, r = self._jacobian(x)
        unit = np.linalg.norm(J, axis=0)
        singular = np.linalg.svd(J / np.where(unit > 0, unit, 1.0), compute_uv=False)
        H = J.T @ J
        condition = float(singular[-1] / singular[0])
        if condition < SINGULAR:
            of_pose = H[:6, :6] - H[:6, 6:] @ np.linalg.pinv(H[6:, 6:]) @ H[6:, :6]
            raise DegenerateMotion(
                f"These scans leave the {worst_direction(of_pose)} open: turn the flange about two different axes between them."
            )
        m = len(self._p)
        distance = np.linalg.norm(self._off(x)[0], axis=1) - self._data.radius_m
        freedom = max(len(r) - len(x), 1)
        chi2 = float(np.median(np.abs(r[:m])) / 0.6745) ** 2
        if chi2 > 100.0:
            raise InconsistentData(
                f"The profiles lie {1e3 * float(np.median(np.abs(distance))):.2f} mm off any sphere of "
                f"{1e3 * self._data.radius_m:.2f} mm: check the radius, the poses and that only the sphere is in the profiles."
            )
        per_pose = np.array([np.mean(distance[self._of == k]) for k in range(len(self._count))])
        spread = max(1.4826 * float(np.median(np.abs(per_pose))), 0.2 * self._s.robot_m)
        wrong = tuple(int(k) for k in np.flatnonzero(np.abs(per_pose) > WRONG_POSE * spread))
        return SphereEstimate(
            rotation=np.asarray(Rotation.from_rotvec(pose[:3]).as_matrix() @ R0),
            translation=np.asarray(pose[3:]),
            covariance=np.asarray(np.linalg.inv(H)[:6, :6]),
            residuals=np.asarray(distance),
            inliers=np.abs(r[:m]) < 5.0,
            rms_m=float(np.sqrt(np.mean(distance**2))),
            reduced_chi2=float(r @ r / freedom),
            condition=condition,
            center=np.asarray(c),
            tip=None if self._data.tip is None else self._data.tip + tip,
            affine=np.asarray(affine),
            origin=self.origin,
            offsets=np.asarray(offsets),
            sag=np.asarray(sag),
            wrong_poses=wrong,
        )

    def _jacobian(self, x: Floats) -> tuple[Floats, Floats]:
        steps = np.array([1e-6] * 3 + [1e-7] * 6 + [1e-7] * (len(x) - 9))
        columns = [
            (self._residual(x + h * e) - self._residual(x - h * e)) / (2 * h)
            for h, e in zip(steps, np.eye(len(x)), strict=True)
        ]
        return np.column_stack(columns), self._residual(x)


def _thinned(p: Floats) -> Floats:
    step = max(1, int(np.ceil(len(p) / POINTS_PER_POSE)))
    return np.asarray(p[::step])
