"""Algorithm 1 of the flange paper: a pool of four pairs, improved by its verification figure, an ICP (Eq. 13)."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import MAD
from weldcal.calibration.geometry.se3 import exp_rotation, fit_rigid, rotation_vector
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_mesh

COMPONENTS = (
    "tilt about x",
    "tilt about y",
    "rotation about the flange axis",
    "in the flange plane, x",
    "in the flange plane, y",
    "along the flange normal",
)
"""Names of the six components of an error at the flange, [rotation; translation] in frame R."""

UNOBSERVABLE_SHARE = 0.01  # a choice between 0.005 of stray points and 0.04 of chamfers, see below
"""A component is called unobservable where less than one point in a hundred speaks for it: the chamfers of a whole ISO
9409-1-50 face hold one in six, at 45 degrees, and speak for a shift with 4 %; stray points at an edge make half a per
cent."""

Cost = Callable[[Array], float]

POOL_SIZE = 4


def surface_normals(points_R: Array, standard: FlangeStandard) -> Array:
    """Outward normals (n, 3) of the flange's face or chamfer, whichever is nearest to each point (n, 3) m in R.

    From the standard itself, not from samples of it: the nearest sample of a flat point beside the edge may lie on the
    chamfer and would lend it a slope that it does not have.
    """
    rho = np.maximum(np.linalg.norm(points_R[:, :2], axis=1), 1e-12)
    radial = points_R[:, :2] / rho[:, None]
    c, inner, outer = standard.chamfer_m, standard.face_inner_radius_m, standard.face_outer_radius_m
    profile = [((inner, 0.0), (outer, 0.0)), ((outer, 0.0), (outer + c, -c)), ((inner - c, -c), (inner, 0.0))]
    at = np.column_stack([rho, points_R[:, 2]])
    distance = np.array([_to_segment(at, np.array(a), np.array(b)) for a, b in profile])
    slope = np.array([0.0, 1.0, -1.0])[np.argmin(distance, axis=0)]
    return np.asarray(np.column_stack([slope[:, None] * radial, np.ones(len(rho))]) / np.hypot(slope, 1.0)[:, None])


def information(points_R: Array, normals_R: Array) -> Array:
    """Information matrix (6, 6), order [rotation.

    Translation], about the origin of R, of points (n, 3) m that each measure their distance along their normal (n, 3),
    in units of one measurement (1 for each point).
    """
    J = np.hstack([np.cross(points_R, normals_R), normals_R])
    return np.asarray(J.T @ J)


def sigmas(matrix: Array, noise_m: float) -> Array:
    """Standard deviation (6,), rad and m, of each component, the others unknown as well.

    Infinite where unobservable.
    """
    values, vectors = np.linalg.eigh(_scaled(matrix))
    variance = np.where(values > 1e-9 * max(float(values[-1]), 1e-30), 1.0 / np.maximum(values, 1e-30), np.inf)
    share = vectors**2
    with np.errstate(invalid="ignore"):
        total = np.where(share > 1e-9, share * variance, 0.0).sum(axis=1)
    out = noise_m * np.sqrt(total) / _units(matrix)
    return np.asarray(np.where(_shares(matrix) < UNOBSERVABLE_SHARE, np.inf, out))


def unobservable_components(matrix: Array) -> tuple[str, ...]:
    """Names of the components along which a displacement of the flange changes the surface (nearly) not at all."""
    return tuple(name for name, s in zip(COMPONENTS, _shares(matrix), strict=True) if s < UNOBSERVABLE_SHARE)


def _shares(matrix: Array) -> Array:
    """Share (6,) of the points that speak for each component when the other five are free (Schur complement)."""
    A = _scaled(matrix)
    n = max(float(np.trace(matrix[3:, 3:])), 1e-30)  # each unit normal adds one
    out = np.zeros(6)
    for k in range(6):
        rest = [i for i in range(6) if i != k]
        cross = A[k, rest]
        out[k] = max(float(A[k, k] - cross @ np.linalg.pinv(A[np.ix_(rest, rest)], rcond=1e-9) @ cross), 0.0) / n
    return out


def _units(matrix: Array) -> Array:
    """Metres that each component moves the surface by: 1, and the rms lever of the tilts for the rotations."""
    lever = np.sqrt(max(float(np.trace(matrix[:2, :2])) / 2.0, 0.0) / max(float(matrix[5, 5]), 1e-30))
    return np.array([max(lever, 1e-6)] * 3 + [1.0] * 3)


def _scaled(matrix: Array) -> Array:
    u = _units(matrix)
    return np.asarray(matrix / np.outer(u, u))


def _to_segment(at: Array, a: Array, b: Array) -> Array:
    t = np.clip((at - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-30), 0.0, 1.0)
    return np.asarray(np.linalg.norm(at - a - t[:, None] * (b - a), axis=1))


Method = Literal["point_to_point", "point_to_plane"]

# share of points with a partner, a choice: a third of a face registers; with less any surface would do
_MIN_FITNESS = 0.3
_UNSEEN_SHARE = 0.5  # a component of which less than half shows is called unseen


@dataclass(frozen=True)
class VerificationError:
    """Pose error of the verification flange under a calibration, relative to the robot's pose of it.

    ``value`` (6,): rotation vector (rad) and displacement of the flange centre (m), both in the axes of the feature
    frame R; all infinite where the registration failed. ``X_CpC`` is Eq. (21)'s e, camera in the calculated camera, or
    None. ``fitness`` (0..1) is the share of points that found a partner. ``unobservable`` names the components (of
    COMPONENTS) for which nothing was seen that could show them: they count as zero in ``value`` and in ``X_CpC``, and
    `components` gives no number for them. ``sigma`` (6,) rad and m is what noise alone does to each, infinite where
    unobservable.
    """

    value: Array
    X_CpC: RigidTransform | None
    fitness: float
    unobservable: tuple[str, ...] = ()
    sigma: Array | None = None

    @property
    def found(self) -> bool:
        """False where the registration failed and the error is infinite."""
        return bool(np.isfinite(self.value).all())

    @property
    def components(self) -> tuple[tuple[str, float, bool], ...]:
        """Return (name, value in rad or m, whether it is observable) of each degree of freedom, at the flange centre.

        NaN where it could not.
        """
        seen = [n not in self.unobservable for n in COMPONENTS]
        return tuple(
            (n, float(v) if s else float("nan"), s) for n, v, s in zip(COMPONENTS, self.value, seen, strict=True)
        )


FAILED = VerificationError(np.full(6, np.inf), None, 0.0)


class Verifier(Protocol):
    """Anything that scores a calibration at a pose held out for the purpose."""

    def __call__(self, X_BC: RigidTransform) -> VerificationError:
        """Error of the calibration at the verification pose."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Verification:
    """A verification scan: face points (N, 3) m in C, the feature's pose X_BR, and the model in R (points, normals).

    ``standard`` is what the model was made from; without it the unobservable components are judged by the model's
    normals.
    """

    points_C: Array
    X_BR: RigidTransform
    model_R: Array
    model_normals_R: Array
    method: Method = "point_to_point"
    max_distance_m: float = 0.01
    standard: FlangeStandard | None = None

    def __call__(self, X_BC: RigidTransform) -> VerificationError:
        """See icp_error."""
        return icp_error(X_BC, self)


@dataclass(frozen=True)
class CentreVerification:
    """A verification pair without a cloud: the error of its centre only; rotations count as zero, being unseen."""

    observation: Observation

    def __call__(self, X_BC: RigidTransform) -> VerificationError:
        """Displacement of the flange centre in R, in place of Eq. (13)."""
        o = self.observation
        error_B = X_BC @ o.p_CR - o.p_BR
        in_R = o.X_BR.rotation().inverse() @ error_B
        correction = RigidTransform(-(X_BC.rotation().inverse() @ error_B))
        value = np.concatenate([np.zeros(3), in_R])
        return VerificationError(value, correction, 1.0, COMPONENTS[:3])


def make_verification(
    points_C: Array,
    X_BR: RigidTransform,
    standard: FlangeStandard,
    *,
    method: Method = "point_to_point",
    max_points: int = 3000,
    seed: int = 0,
) -> Verification:
    """A verification scan against the standard's own surface (face and chamfers), both thinned to ``max_points``.

    ``points_C`` (N, 3) m: the flange alone (crop the scene first). Raises InputError when fewer than 100 points are
    finite.
    """
    points = np.asarray(points_C, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise InputError(f"A verification cloud needs at least 100 valid points; this one has {len(points)}.")
    rng = np.random.default_rng(seed)
    if len(points) > max_points:
        points = points[np.sort(rng.choice(len(points), max_points, replace=False))]
    model, normals = flange_mesh(standard).sample(12 * max_points, rng)
    up = (normals[:, 2] > 0.2) & (model[:, 2] > -1.5 * standard.chamfer_m - 1e-6)
    return Verification(
        points_C=points,
        X_BR=X_BR,
        model_R=model[up][: 4 * max_points],
        model_normals_R=normals[up][: 4 * max_points],
        method=method,
        standard=standard,
    )


def icp_error(X_BC: RigidTransform, verification: Verification) -> VerificationError:
    """Register the verification cloud, placed by ``X_BC``, to the model placed by the robot (paper, Eq. (13)).

    Iterations and stop rule are Open3D's defaults (30, relative change 1e-6), as in the paper's code. A registration
    that matches less than 30 % of the points has failed: the error is then infinite, never the identity. The six
    numbers are taken at the flange centre, not at the camera origin, where rotation and translation mix over the
    working distance. A component along which the matched surface does not change is named unobservable, from the
    information that the points carry along its normals: the turn about the flange's axis always (the model is one of
    revolution but for its holes), the plane of a face whose chamfers were not scanned. Point-to-point registration sees
    less than that: `sight` measures how much.
    """
    X_RC, model = verification.X_BR.inverse() @ X_BC, verification.model_R
    placed = (X_RC @ verification.points_C.T).T
    result = registered(placed, model, verification.model_normals_R, verification.max_distance_m, verification.method)
    if result.fitness < _MIN_FITNESS or not np.isfinite(result.transformation).all():
        return FAILED
    E_R = _without_last_digits(np.asarray(result.transformation))
    pairs = np.asarray(result.correspondence_set)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    matched = (E_R @ X_RC @ verification.points_C[pairs[:, 0]].T).T
    standard = verification.standard
    normals = verification.model_normals_R[pairs[:, 1]] if standard is None else surface_normals(matched, standard)
    matrix = information(matched, normals)
    off = ((matched - verification.model_R[pairs[:, 1]]) * verification.model_normals_R[pairs[:, 1]]).sum(axis=1)
    noise = MAD * float(np.median(np.abs(off)))
    unobservable = unobservable_components(matrix)
    seen = E_R.inverse()
    value = np.concatenate([rotation_vector(seen.rotation()), seen.translation()])
    value[[name in unobservable for name in COMPONENTS]] = 0.0
    correction = X_RC.inverse() @ RigidTransform(RotationMatrix(exp_rotation(value[:3])), value[3:]).inverse() @ X_RC
    return VerificationError(value, correction, float(result.fitness), unobservable, sigmas(matrix, noise))


def registered(points: Array, model: Array, normals: Array, reach: float, method: Method) -> Any:
    """Open3D's ICP result of points (n, 3) on a model (m, 3) with normals (m, 3), partners at most ``reach`` apart."""
    import open3d as o3d  # slow to import

    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points, model))
    target.normals = o3d.utility.Vector3dVector(normals)
    ways = o3d.pipelines.registration
    to_plane, to_point = ways.TransformationEstimationPointToPlane, ways.TransformationEstimationPointToPoint
    estimation = to_plane() if method == "point_to_plane" else to_point()
    return ways.registration_icp(source, target, reach, np.eye(4), estimation)


def _without_last_digits(X: Array) -> RigidTransform:
    """Return a pose (4, 4) to 1e-10 m and rad.

    Open3D's threads add up in any order, so that the last digits are others in each run.
    """
    R, p = np.round(X[:3, :3], 10), np.round(X[:3, 3], 10)
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), p)


@dataclass(frozen=True)
class Sight:
    """How much of a true error a verification reports, per component of COMPONENTS (1 all, 0 nothing), measured."""

    share: Array

    @property
    def unseen(self) -> tuple[str, ...]:
        """Names of the components of which less than half shows."""
        return tuple(name for name, s in zip(COMPONENTS, self.share, strict=True) if s < _UNSEEN_SHARE)


def sight(
    X_BC: RigidTransform, verification: Verification, *, shift_m: float = 3e-4, turn_rad: float = float(np.radians(0.3))
) -> Sight:
    """Measure the share of known small errors at the flange that the registration reports.

    0.3 mm and 0.3 degrees are sizes worth seeing; both signs are tried and averaged.
    """
    share = np.zeros(6)
    for k in range(6):
        size = turn_rad if k < 3 else shift_m
        reported = []
        for sign in (1.0, -1.0):
            d = np.zeros(6)
            d[k] = sign * size
            D_R = RigidTransform(RotationMatrix(exp_rotation(d[:3])), d[3:])
            moved = verification.X_BR @ D_R @ verification.X_BR.inverse() @ X_BC
            reported.append(icp_error(moved, verification).value[k])
        share[k] = (reported[0] - reported[1]) / (2.0 * size)
    return Sight(np.nan_to_num(share, nan=0.0, posinf=0.0, neginf=0.0))


def translation_cost(error: Array) -> float:
    """Norm of the translation of the error (6,), m: the paper's default."""
    return float(np.linalg.norm(error[3:]))


@dataclass(frozen=True, kw_only=True)
class Algorithm1State:
    """State of Algorithm 1 after k new scans; immutable, each step returns the next one.

    ``pool``: up to four pairs. ``X_BC`` and ``error`` are H_optimal and e_optimal, ``cost`` its cost (m), infinite
    until a registration succeeds. ``history`` has one (scans used, cost) entry per scan from the fourth on.
    """

    e_required: float
    k_max: int
    pool: tuple[Observation, ...] = ()
    X_BC: RigidTransform | None = None
    error: VerificationError = FAILED
    cost: float = float("inf")
    k: int = 0
    history: tuple[tuple[int, float], ...] = field(default=())

    @property
    def done(self) -> bool:
        """True when the cost has come down to the required one or the scans are used up (line 4)."""
        return len(self.pool) == POOL_SIZE and (self.cost <= self.e_required or self.k >= self.k_max)

    @property
    def X_BC_compensated(self) -> RigidTransform | None:
        """Eq. (21): H_optimal e_optimal, which makes the figure itself zero and says nothing about any other pose."""
        return None if self.X_BC is None or self.error.X_CpC is None else self.X_BC @ self.error.X_CpC


def algorithm1_start(e_required: float = 2e-4, k_max: int = 100) -> Algorithm1State:
    """An empty pool. ``e_required`` in m. Raises InputError unless both are positive."""
    if not e_required > 0.0 or k_max < 1:
        raise InputError("Algorithm 1 needs a required error above zero (metres) and at least one iteration.")
    return Algorithm1State(e_required=e_required, k_max=k_max)


def algorithm1_step(
    state: Algorithm1State,
    observation: Observation,
    verification: Verifier,
    cost: Cost = translation_cost,
    *,
    as_printed: bool = False,
) -> Algorithm1State:
    """One new pair (paper, Algorithm 1, lines 5 to 15); the first four fill the pool (lines 2 and 3).

    Each of the four is replaced in turn by the new pair; a replacement stays only if the cost falls. The new pair
    enters at most once, as in the authors' program: with it twice, three distinct points would be left. ``as_printed``
    follows lines 6 to 15 to the letter, where a replacement that stays is there when the next one is tried, so that the
    pool may come to hold the same pair two or three times. A finished state is returned unchanged.
    """
    if state.done:
        return state
    if len(state.pool) < POOL_SIZE:
        pool = (*state.pool, observation)
        if len(pool) < POOL_SIZE:
            return replace(state, pool=pool)
        X, error, value = _score(pool, verification, cost)
        return replace(state, pool=pool, X_BC=X, error=error, cost=value, history=((POOL_SIZE, value),))
    best = (state.pool, state.X_BC, state.error, state.cost)
    for i in range(POOL_SIZE):
        old = best[0] if as_printed else state.pool
        pool = (*old[:i], observation, *old[i + 1 :])
        X, error, value = _score(pool, verification, cost)
        if value < best[3]:
            best = (pool, X, error, value)
    k = state.k + 1
    return replace(
        state,
        pool=best[0],
        X_BC=best[1],
        error=best[2],
        cost=best[3],
        k=k,
        history=(*state.history, (POOL_SIZE + k, best[3])),
    )


def _score(
    pool: tuple[Observation, ...], verification: Verifier, cost: Cost
) -> tuple[RigidTransform | None, VerificationError, float]:
    try:
        X = fit_rigid(np.array([o.p_BR for o in pool]), np.array([o.p_CR for o in pool]))
    except ValueError:
        return None, FAILED, float("inf")
    error = verification(X)
    return X, error, cost(error.value) if error.found else float("inf")
