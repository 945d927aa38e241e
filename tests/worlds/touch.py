"""A light world of a cell.

Its true arm, scanner and tip, the calibration from its scans, and touches of plates, spheres, an edge and a point.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.cell import Bend, bend, distorted, factory_errors, scanned, wrong_arm
from weldcal.calibration.data.results import CalibrationResult, PoseRecord
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.stated_error import observed_document, orientations_of
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.calibration.touch.touches import EDGE, PLANE, POINT, SPHERE, Touch
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

SCANS = 12
FEATURES = (PLANE, PLANE, SPHERE, SPHERE, EDGE, POINT)
_WORK = np.array([0.65, 0.0, 0.05])
_HOME = np.radians([190.0, -90.0, 110.0, -110.0, -90.0, 90.0])
_X_FR = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 0.02])
_TIP, _TIP_RADIUS, _SPHERE = np.array([0.0, 0.05, 0.20]), 2.5e-3, 12.7e-3
_REPEAT_M = 2e-5  # of the arm, per axis
_CENTRE_M, _NORMAL_RAD = 2e-5, float(np.radians(0.01))  # of a ring's fit, per axis
_PLANE_M, _PLANE_RAD, _SPHERE_M, _EDGE_M, _POINT_M = (
    2e-5,
    float(np.radians(0.05)),
    3e-5,
    4e-5,
    5e-5,
)  # of a scanned feature
_TAUGHT_M, _BALL_M, _CONTACT_M = 5e-5, 2e-5, 2e-5  # tip as taught, per axis; its radius at most; when contact is seen


@dataclass(frozen=True, eq=False)
class TouchWorld:
    """What calibration and judge are given: the result, and the touches."""

    result: CalibrationResult
    touches: tuple[Touch, ...]


def touch_world(seed: int, scans: int = SCANS) -> TouchWorld:
    """The cell of this seed. What no estimate is given, and no model of the estimator has:

    an arm with zeros off by 0.02 to 0.05 degrees and axes by 0.1 to 0.3 mm and 0.02 degrees, that repeats to 0.035 mm;
    a scanner with a scale error of 0.1 %, a gradient of 0.05 % per 100 mm and a radial distortion; a tip that is taught
    to 0.05 mm per axis and whose ball is up to 0.02 mm too large or small; contact that is seen 0.02 mm early or late.
    """
    rng, nominal = np.random.default_rng(seed), load_arm("ur10e")
    true = wrong_arm(nominal, factory_errors(rng))
    down = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), np.add(_WORK, [0.0, 0.0, 0.80]))
    X_BC = down @ RigidTransform(
        RotationMatrix.ProjectToRotationMatrix(exp_rotation(0.15 * rng.normal(size=3))), np.zeros(3)
    )
    scanner = _Scanner(X_BC.inverse(), bend(rng))
    observations = [_scan(f"p{i}", nominal, true, scanner, rng) for i in range(scans)]
    tip = _TIP + _TAUGHT_M * rng.normal(size=3)
    ball = _TIP_RADIUS + _BALL_M * rng.uniform(-1.0, 1.0)
    touches = tuple(
        _touch(f"{kind}{k}", kind, nominal, true, scanner, tip, ball, rng) for k, kind in enumerate(FEATURES)
    )
    return TouchWorld(_calibrated(observations), touches)


@dataclass(frozen=True, eq=False)
class _Scanner:
    X_CB: RigidTransform
    bend: Bend

    def sees(self, p_B: Array) -> Array:
        """Where the scanner puts a point (3,) m of the base."""
        return distorted(np.asarray(self.X_CB.multiply(p_B)), self.bend)


def _upright(rng: np.random.Generator, tilt_rad: float) -> RotationMatrix:
    """Return a flange that points down, tilted by up to ``tilt_rad`` and turned by up to 60 degrees."""
    around, tilt = rng.uniform(0.0, 2.0 * np.pi), tilt_rad * np.sqrt(rng.uniform())
    lean = exp_rotation(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
    return (
        RotationMatrix.ProjectToRotationMatrix(lean)
        @ RollPitchYaw(np.pi, 0.0, rng.uniform(-1.0, 1.0)).ToRotationMatrix()
    )


def _joints(arm: ArmModel, X_BF: RigidTransform) -> Array:
    q = nearest_solution(arm, X_BF, _HOME)
    if q is None:
        raise InputError("a pose of the light world is out of reach")
    return np.asarray(q)


def _scan(id: str, nominal: ArmModel, true: ArmModel, scanner: _Scanner, rng: np.random.Generator) -> Observation:
    place = _WORK + [0.0, 0.0, 0.12] + rng.uniform(-1.0, 1.0, 3) * [0.15, 0.15, 0.10]
    R_BF = _upright(rng, np.radians(25.0))
    q = _joints(nominal, RigidTransform(R_BF, place) @ RigidTransform(-np.asarray(_X_FR.translation())))
    X_CR = scanner.X_CB @ forward_kinematics(true, q) @ _X_FR
    X_CR.set_translation(X_CR.translation() + _REPEAT_M * rng.normal(size=3))
    c, z, _ = scanned(lambda p: distorted(p, scanner.bend), X_CR, 0.03, rng, _CENTRE_M, _NORMAL_RAD)
    return Observation(id, forward_kinematics(nominal, q) @ _X_FR, c, z, _CENTRE_M**2 * np.eye(3), _NORMAL_RAD)


def _calibrated(observations: list[Observation]) -> CalibrationResult:
    """As a live calibration writes it."""
    e, _ = estimate_jointly(observations)
    return CalibrationResult(
        X_BC=e.X_BC,
        covariance=e.covariance,
        held_out_mm={"p95": 1e3 * float(np.percentile(e.held_out.position_m, 95))},
        tilt_deg={},
        poses=tuple(PoseRecord(id=o.id, used=bool(k)) for o, k in zip(observations, e.inliers, strict=True)),
        robot="ur10e",
        sigma_position_mm=1e3 * e.sigma_position_m,
        sigma_normal_deg=float(np.degrees(e.sigma_normal_rad)),
        scanner_correction=None if e.correction is None else e.correction.document(),
        joint_covariance=e.joint,
        orientations=orientations_of([o for o, k in zip(observations, e.inliers, strict=True) if k], _X_FR),
        observed=observed_document([o for o, k in zip(observations, e.inliers, strict=True) if k], _X_FR),
    )


def _touch(
    id: str,
    kind: str,
    nominal: ArmModel,
    true: ArmModel,
    scanner: _Scanner,
    tip: Array,
    ball: float,
    rng: np.random.Generator,
) -> Touch:
    p = _WORK + rng.uniform(-1.0, 1.0, 3) * [0.12, 0.12, 0.03]
    n = exp_rotation(np.radians(25.0) * rng.uniform(-1.0, 1.0, 3)) @ np.array([0.0, 0.0, 1.0])
    along = np.cross(n, rng.normal(size=3))
    along /= np.linalg.norm(along)
    radius, sphere = (0.0 if kind == POINT else ball), _SPHERE + 5e-6 * rng.uniform(-1.0, 1.0)
    away = {POINT: 0.0, SPHERE: sphere + radius}.get(kind, radius)
    centre = p + (away + _CONTACT_M * rng.normal()) * n
    R_BF = _upright(rng, np.radians(20.0))
    q = _joints(true, RigidTransform(R_BF, centre - R_BF.multiply(tip)))  # the true tip lies where it touches
    X_BF = forward_kinematics(nominal, q)
    X_BF = RigidTransform(X_BF.rotation(), X_BF.translation() + _REPEAT_M * rng.normal(size=3))
    seen, direction = scanner.sees(p), None
    if kind == PLANE:
        direction = _seen_direction(scanner, p, n, _PLANE_RAD, rng)
        seen = seen + _PLANE_M * rng.normal() * direction
    elif kind == EDGE:
        ends = [scanner.sees(p + s * along) for s in (0.02, -0.02)]
        direction = exp_rotation(_PLANE_RAD * rng.normal(size=3)) @ (
            (ends[0] - ends[1]) / np.linalg.norm(ends[0] - ends[1])
        )
        seen = seen + _EDGE_M * rng.normal(size=3) + 2e-3 * rng.uniform(-1.0, 1.0) * direction
    else:
        seen = seen + (_SPHERE_M if kind == SPHERE else _POINT_M) * rng.normal(size=3)
    taught = 0.0 if kind == POINT else _TIP_RADIUS
    return Touch(
        id=id,
        feature=kind,
        X_BF=X_BF,
        p_FT=_TIP,
        radius=taught,
        p_C=seen,
        direction_C=direction,
        feature_radius=_SPHERE if kind == SPHERE else 0.0,
    )


def _seen_direction(scanner: _Scanner, p: Array, n: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Return the normal that the scanner gives a small plate at p with normal n."""
    a = np.cross(n, [0.0, 1.0, 0.0])
    a /= np.linalg.norm(a)
    ends = [scanner.sees(p + 0.01 * d) - scanner.sees(p - 0.01 * d) for d in (a, np.cross(n, a))]
    z = np.cross(ends[0], ends[1])
    z = z if float(z @ scanner.X_CB.rotation().multiply(n)) > 0.0 else -z
    return np.asarray(exp_rotation(sigma * rng.normal(size=3)) @ (z / np.linalg.norm(z)))
