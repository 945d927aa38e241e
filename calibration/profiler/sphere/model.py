"""The sphere problem: measurements, unknowns, and whitened residuals with derivatives.

Every profile point lies on the sphere, and so does the tip at every touch. The error of the robot's position, which all
points of a scan share, is taken out by whitening with it rather than by unknowns of its own; docs/profiler.md derives
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.profiler.arm_errors import ARM_ERRORS, OFFSET_JOINTS, SAG_JOINTS, DhArm, ProfilerArmErrors
from weldcal.calibration.profiler.motion import FlangePoses, Floats, left_jacobian
from weldcal.calibration.profiler.sensor import SensorCorrection

POINTS_PER_POSE = 120
ROBUST: dict[str, Any] = {"loss": "soft_l1", "f_scale": 3.0, "max_nfev": 60}


@dataclass(frozen=True, kw_only=True)
class SphereSigmas:
    """What is known before.

    Of the sensor's points, the robot's position at a scan and at a touch (m), and the priors.
    """

    sensor_m: float = 0.05e-3
    robot_m: float = 0.03e-3  # per axis: a repeatability of 0.05 mm by ISO 9283 is a radius
    touch_m: float = 0.05e-3
    affine: float = 0.03
    joint_rad: float = np.radians(0.05)
    sag_rad_m: float = np.radians(0.1)
    length_m: float = (
        0.2e-3  # of the arm's own lengths, and its twists below: an arm that was built well and not measured
    )
    twist_rad: float = np.radians(0.02)
    tip_m: float = 10e-3

    @property
    def arm(self) -> Floats:
        """Of the arm's errors (24,), in their order."""
        table = np.tile([self.length_m, self.twist_rad, self.length_m], 6)
        return np.concatenate(
            [np.full(len(OFFSET_JOINTS), self.joint_rad), np.full(len(SAG_JOINTS), self.sag_rad_m), table]
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereData:
    """One calibration's measurements.

    Attributes:
        poses: flange at each scan; profiles: (m, 2) [x, z] m of the sphere in each; radius_m: of the sphere.
        touches: flange at each touch, tip: (3,) m in F as far as it is known; both or none.
        arm, q, touch_q: the arm's table and its joints (n, 6) rad at scans and touches, for the model with joints.
        sensor: what is known of the profiler's scale and shear before: the model rigid takes it as it is, the others
            start from it and hold it by its covariance.
    """

    poses: FlangePoses
    profiles: Sequence[Floats]
    radius_m: float
    touches: FlangePoses | None = None
    tip: Floats | None = None
    arm: DhArm | None = None
    q: Floats | None = None
    touch_q: Floats | None = None
    sensor: SensorCorrection | None = None

    def scans(self, radius_m: float) -> SphereData:
        """Return the scans alone, of a sphere of this radius."""
        return SphereData(poses=self.poses, profiles=self.profiles, radius_m=radius_m, sensor=self.sensor)

    def without(self, *scans: int) -> SphereData:
        """Return the same but for these scans."""
        keep = ~np.isin(np.arange(len(self.poses)), scans)
        q = None if self.q is None else self.q[keep]
        profiles = [p for p, kept in zip(self.profiles, keep, strict=True) if kept]
        return replace(self, poses=self.poses[keep], profiles=profiles, q=q)


def corrected(p: Floats, affine: Floats, origin: Floats) -> Floats:
    """Profile points (n, 2) as (n, 3) in S, through [x scale, z scale, shear] about an origin."""
    a, b, h = affine
    u = p - origin
    x = u[:, 0] * (1.0 + a) + u[:, 1] * h + origin[0]
    z = u[:, 0] * h + u[:, 1] * (1.0 + b) + origin[1]
    return np.column_stack([x, np.zeros(len(p)), z])


@dataclass(frozen=True)
class ParameterLayout:
    """Hold the index of each unknown in the vector: pose, centre, tip, affine, joints."""

    tip: bool
    affine: bool
    joints: bool

    def unpack(self, x: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """(w and t (6,), centre (3,), tip change (3,), affine (3,), the arm's errors (24,))."""
        k, parts = 9, []
        for size, used in ((3, self.tip), (3, self.affine), (ARM_ERRORS, self.joints)):
            parts.append(x[k : k + size] if used else np.zeros(size))
            k += size if used else 0
        return x[:6], x[6:9], parts[0], parts[1], parts[2]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 9 + 3 * self.tip + 3 * self.affine + ARM_ERRORS * self.joints

    def sigmas(self, s: SphereSigmas) -> Floats:
        """Of the priors; infinite where there is none."""
        known: list[float] = [np.inf] * 9
        known += [s.tip_m] * 3 * self.tip + [s.affine] * 3 * self.affine
        return np.concatenate([known, s.arm]) if self.joints else np.array(known)


class _Points(NamedTuple):
    """Where the unknowns `x`, with the turn `R0` before them, place everything.

    `at` (m, 3) and `felt` (k, 3): from the centre to all profile points, and to the tip at all touches. `rotation` (m,
    3, 3): of the flange at each point. `R`: of the sensor. `turned` (m, 3): the points about the sensor's origin, by
    F's axes.
    """

    x: Floats
    R0: Floats
    at: Floats
    felt: Floats
    poses: FlangePoses
    touches: FlangePoses | None
    rotation: Floats
    R: Floats
    turned: Floats


class SphereProblem:
    """The whitened residuals of one model on one set of measurements."""

    def __init__(self, data: SphereData, layout: ParameterLayout, sigmas: SphereSigmas) -> None:
        self.data, self.layout, self.sigmas = data, layout, sigmas
        self.profiles = [_thinned(p[np.isfinite(p).all(axis=1)]) for p in data.profiles]
        self.count = np.array([len(p) for p in self.profiles])
        self.of = np.repeat(np.arange(len(self.profiles)), self.count)
        self.p = np.vstack(self.profiles)
        self.origin = self.p.mean(axis=0)
        sensor = data.sensor
        self.affine = np.zeros(3) if sensor is None else sensor.values  # the unknowns are what is added to it
        self._prior = np.diag(1.0 / layout.sigmas(sigmas))[9:]
        if sensor is not None and layout.affine:
            k = 3 * layout.tip
            self._prior[k : k + 3, 9 + k : 12 + k] = np.linalg.inv(np.linalg.cholesky(sensor.covariance))
        self._R0, self._t0 = np.eye(3), np.zeros(3)
        self._whiten: list[tuple[Floats, Floats]] | None = None
        self._slant = np.ones(len(self.p))
        self._placed: _Points | None = None
        self._rotation, self._translation = data.poses.rotation[self.of], data.poses.translation[self.of]
        arm, q, touch_q = data.arm, data.q, data.touch_q
        self._loads = arm.loads(q) if arm is not None and q is not None else None
        self._touch_loads = arm.loads(touch_q) if arm is not None and touch_q is not None else None

    def solved(self, R: Floats, t: Floats, x: Floats) -> tuple[Floats, OptimizeResult]:
        """Least squares from a start, twice: the second time with the robot's own error of each scan taken out."""
        self._R0 = R
        x = np.array(x)
        x[3:6] += t
        prior = 1.0 / self.layout.sigmas(self.sigmas)
        scale = np.concatenate(
            [[0.1] * 3, [0.01] * 6, np.where(prior[9:] > 0, 1.0 / np.where(prior[9:] > 0, prior[9:], 1), 1)]
        )
        self._whiten = None
        found = least_squares(self.residual, x, jac=self.derivatives, x_scale=scale, **ROBUST)
        self.share_robot_error(found.x)
        found = least_squares(self.residual, found.x, jac=self.derivatives, x_scale=scale, **ROBUST)
        return R, found

    @property
    def corrected_profiles(self) -> list[Floats]:
        """Profiles (m, 2), as what is known before corrects them."""
        return [corrected(p, self.affine, self.origin)[:, [0, 2]] for p in self.profiles]

    def linearise_about(self, rotation: Floats) -> None:
        """R_FS (3, 3) to which the first three unknowns are a turn in F."""
        self._R0 = rotation

    def share_robot_error(self, x: Floats) -> None:
        """Whiten from now on with the robot's error at each scan, linearised at x."""
        self._whiten = self._robot_error(x)

    def _poses(self, values: Floats) -> tuple[FlangePoses, FlangePoses | None]:
        data = self.data
        if not self.layout.joints:
            return data.poses, data.touches
        assert data.arm is not None
        assert data.q is not None
        assert self._loads is not None
        errors, touches = ProfilerArmErrors.of(values), None
        if data.touch_q is not None and self._touch_loads is not None:
            touches = data.arm.with_errors(data.touch_q, errors, self._touch_loads)
        return data.arm.with_errors(data.q, errors, self._loads), touches

    def off(self, x: Floats) -> tuple[Floats, Floats, FlangePoses]:
        """Vectors (m, 3) from the centre to all profile points, and to the tip at all touches (k, 3)."""
        points = self._points(x)
        return points.at, points.felt, points.poses

    def _points(self, x: Floats) -> _Points:
        """Return the points placed by x.

        The last answer is kept: a solver asks for residuals and derivatives at the same x.
        """
        last = self._placed
        if last is not None and last.R0 is self._R0 and np.array_equal(last.x, x):
            return last
        pose, c, tip, affine, arm = self.layout.unpack(x)
        poses, touches = self._poses(arm)
        rotation, translation = self._rotation, self._translation
        if poses is not self.data.poses:
            rotation, translation = poses.rotation[self.of], poses.translation[self.of]
        R = exp_rotation(pose[:3]) @ self._R0
        turned = corrected(self.p, self.affine + affine, self.origin) @ R.T
        at = np.einsum("nij,nj->ni", rotation, turned + pose[3:]) + translation - c
        felt = np.empty((0, 3))
        if touches is not None and self.data.tip is not None:
            felt = touches.rotation @ (self.data.tip + tip) + touches.translation - c
        self._placed = _Points(
            x=np.array(x),
            R0=self._R0,
            at=at,
            felt=felt,
            poses=poses,
            touches=touches,
            rotation=rotation,
            R=R,
            turned=turned,
        )
        return self._placed

    def residual(self, x: Floats) -> Floats:
        at, felt, _ = self.off(x)
        R = self.data.radius_m
        r = (np.linalg.norm(at, axis=1) - R) / self.sigmas.sensor_m
        r = self._whitened(r[:, None])[:, 0]
        touch = (np.linalg.norm(felt, axis=1) - R) / self.sigmas.touch_m
        return np.concatenate([r, touch, self._prior @ x])

    def _whitened(self, columns: Floats) -> Floats:
        """Rows (m, k) of the profiles' points, in sigmas of independent errors once these are known."""
        if self._whiten is None:
            return columns
        out, start = columns / self._slant[:, None], 0
        for (U, less), n in zip(self._whiten, self.count, strict=True):
            part = out[start : start + n]
            out[start : start + n] = part - U @ (less[:, None] * (U.T @ part))
            start += n
        return np.asarray(out)

    def shared(self, r: Floats) -> float:
        """Sum the squares of what the residuals of each scan share with an error of the robot's position.

        The residuals (m,) are whitened.
        """
        ends = np.cumsum(self.count)
        parts = zip(self._whiten or [], ends - self.count, ends, strict=False)
        return float(sum(np.sum((U.T @ r[a:b]) ** 2) for (U, _), a, b in parts))

    def derivatives(self, x: Floats) -> Floats:
        """Jacobian of `residual`."""
        pose, c, _, _, arm = self.layout.unpack(x)
        _, _, at, felt, _, touches, rotation, R, turned = self._points(x)
        n_B = at / np.linalg.norm(at, axis=1, keepdims=True)
        n_F = np.einsum("nij,ni->nj", rotation, n_B)
        m_B = felt / np.linalg.norm(felt, axis=1, keepdims=True)
        m = len(felt)
        scan = [np.cross(turned, n_F) @ left_jacobian(pose[:3]), n_F, -n_B]
        touch = [np.zeros((m, 6)), -m_B]
        if self.layout.tip:
            scan.append(np.zeros((len(at), 3)))
            assert touches is not None
            touch.append(np.einsum("nij,ni->nj", touches.rotation, m_B))
        if self.layout.affine:
            n_S, u = n_F @ R, self.p - self.origin
            scan.append(
                np.column_stack([n_S[:, 0] * u[:, 0], n_S[:, 2] * u[:, 1], n_S[:, 0] * u[:, 1] + n_S[:, 2] * u[:, 0]])
            )
            touch.append(np.zeros((m, 3)))
        if self.layout.joints:
            assert self.data.arm is not None
            errors = ProfilerArmErrors.of(arm)
            for q, loads, p_B, normal, of, columns in (
                (self.data.q, self._loads, at + c, n_B, self.of, scan),
                (self.data.touch_q, self._touch_loads, felt + c, m_B, np.arange(m), touch),
            ):
                if q is None or loads is None or not len(p_B):
                    continue
                w, v = self.data.arm.twists(q, errors, loads)
                by = np.einsum("nki,ni->nk", w[of], np.cross(p_B, normal)) + np.einsum("nki,ni->nk", v[of], normal)
                columns.append(by)
        top = self._whitened(np.hstack(scan) / self.sigmas.sensor_m)
        bottom = np.hstack(touch) / self.sigmas.touch_m if m else np.empty((0, self.layout.size))
        return np.vstack([top, bottom, self._prior])

    def by_radius(self) -> Floats:
        """Derivative of `residual` by the sphere's radius (1/m)."""
        m = 0 if self.data.touches is None else len(self.data.touches)
        scan = self._whitened(np.full((len(self.p), 1), -1.0 / self.sigmas.sensor_m))[:, 0]
        return np.concatenate([scan, np.full(m, -1.0 / self.sigmas.touch_m), np.zeros(self.layout.size - 9)])

    def _robot_error(self, x: Floats) -> list[tuple[Floats, Floats]]:
        """Per scan (U, less) that whiten residuals which share the robot's error: C^-1/2 r = r - U less U^T r."""
        at, _, poses = self.off(x)
        normals = at / np.linalg.norm(at, axis=1, keepdims=True)
        # noise lies in the scan plane, and the sphere's normal does not: only its part in the plane carries noise
        y_F = exp_rotation(x[:3]) @ self._R0[:, 1]
        y_B = np.einsum("nij,j->ni", poses.rotation, y_F)[self.of]
        self._slant = np.sqrt(np.maximum(1.0 - np.einsum("ni,ni->n", normals, y_B) ** 2, 0.01))
        normals = normals / self._slant[:, None]
        ratio, out, start = (self.sigmas.robot_m / self.sigmas.sensor_m) ** 2, [], 0
        for n in self.count:
            U, s, _ = np.linalg.svd(normals[start : start + n], full_matrices=False)
            out.append((U, 1.0 - 1.0 / np.sqrt(1.0 + ratio * s**2)))
            start += n
        return out


def _thinned(p: Floats) -> Floats:
    step = max(1, int(np.ceil(len(p) / POINTS_PER_POSE)))
    return np.asarray(p[::step])
