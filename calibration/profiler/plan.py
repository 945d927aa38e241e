"""Plans profiler poses that reduce the uncertainty in the measuring field most, one after the other.

The measure is the mapped covariance: how uncertain a profile point's place in the flange is, averaged over the field of
view, by what the poses so far and the ones chosen tell together (docs/profiler.md).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from weldcal.calibration.adjustment import most_informative
from weldcal.calibration.geometry.se3 import skew
from weldcal.calibration.profiler.edge.model import EdgeState, measurement_covariance, predicted, whitened
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.models.errors import InputError

FLOOR = 1e-6  # of the largest information: what nothing was learnt of counts as known to 1/1000 of that only
MINIMUM_CROSSING = 0.45  # of edge and scan plane's normal: below, the crossing is not seen well
ARC_POINTS = 40
ARC_RAD = np.radians(60.0)


@dataclass(frozen=True)
class Field:
    """Where the profiler measures (m)."""

    half_width_m: float = 0.020
    near_m: float = 0.060
    far_m: float = 0.092

    @property
    def points(self) -> Floats:
        """Nine profile points (9, 2) of it."""
        x = np.linspace(-self.half_width_m, self.half_width_m, 3)
        z = np.linspace(self.near_m, self.far_m, 3)
        return np.array([[a, b] for a in x for b in z])


@dataclass(frozen=True, eq=False)
class PosePlan:
    """Indices of the candidates in the order of taking them, and the uncertainty with each.

    ``rms_m`` (1 + len) m is that before and after each.
    """

    chosen: tuple[int, ...]
    rms_m: Floats


def plan_edge_poses(
    state: EdgeState,
    poses: FlangePoses,
    candidates: FlangePoses,
    count: int,
    *,
    sigma_robot_m: float,
    sigma_xz_m: ArrayLike,
    field: Field | None = None,
) -> PosePlan:
    """Choose candidates to add to an edge's scans; those without the edge in the field are excluded.

    Raises:
        InputError: no candidate sees the edge, or fewer than asked for.
    """
    f, sigmas = field or Field(), np.asarray(sigma_xz_m, float)

    def information(X: FlangePoses) -> Floats:
        p, J, by_robot = predicted(state, X)
        covariance = measurement_covariance(by_robot, sigma_robot_m, sigmas)
        _, Jw = whitened(covariance, np.zeros_like(p), J)
        return np.asarray(np.einsum("nai,naj->nij", Jw, Jw))

    p, _, _ = predicted(state, candidates)
    crossing = np.abs((candidates.rotation @ state.rotation)[:, :, 1] @ state.direction)
    seen = (np.abs(p[:, 0]) <= f.half_width_m) & (p[:, 1] >= f.near_m) & (p[:, 1] <= f.far_m)
    usable = np.flatnonzero(seen & (crossing > MINIMUM_CROSSING))
    # turns of the state are in S (right), so the point turns before R_FS
    maps = np.array(
        [np.hstack([-state.rotation @ skew(np.array([x, 0.0, z])), np.eye(3), np.zeros((3, 4))]) for x, z in f.points]
    )
    return _greedy(information(poses).sum(axis=0), information(candidates[usable]), usable, maps, count)


def plan_sphere_poses(
    rotation: Floats,
    translation: Floats,
    center: Floats,
    radius_m: float,
    poses: FlangePoses,
    candidates: FlangePoses,
    count: int,
    *,
    sigmas: SphereSigmas | None = None,
    field: Field | None = None,
) -> PosePlan:
    """Choose candidates to add to a sphere's scans, with the sensor's scale and shear unknown as their prior says.

    Args:
        rotation, translation: R_FS and p_FS (3,) m as far as they are known; center: (3,) m in B.

    Raises:
        InputError: no candidate sees the sphere, or fewer than asked for.
    """
    f, s = field or Field(), sigmas or SphereSigmas()
    origin = f.points.mean(axis=0)

    def centre_S(X: FlangePoses) -> Floats:
        p_F = np.einsum("nji,nj->ni", X.rotation, center - X.translation)
        return np.asarray((p_F - translation) @ rotation)

    def information(X: FlangePoses) -> Floats:
        found = np.zeros((len(X), 12, 12))
        angle = np.linspace(-ARC_RAD, ARC_RAD, ARC_POINTS)
        for k, c in enumerate(centre_S(X)):
            r = np.sqrt(max(radius_m**2 - c[1] ** 2, 0.0))
            p = np.column_stack([c[0] + r * np.sin(angle), np.zeros(ARC_POINTS), c[2] - r * np.cos(angle)])
            n_S = (p - c) / radius_m
            n_F = n_S @ rotation.T
            u = p[:, [0, 2]] - origin
            sensor = [n_S[:, 0] * u[:, 0], n_S[:, 2] * u[:, 1], n_S[:, 0] * u[:, 1] + n_S[:, 2] * u[:, 0]]
            J = np.column_stack([np.cross(p @ rotation.T, n_F), n_F, -n_F @ X.rotation[k].T, *sensor])
            slant = np.hypot(n_S[:, 0], n_S[:, 2])
            C = np.diag((s.sensor_m * slant) ** 2) + s.robot_m**2 * n_F @ n_F.T
            found[k] = J.T @ np.linalg.solve(C, J)
        return found

    c = centre_S(candidates)
    z = c[:, 2] - radius_m
    seen = (np.abs(c[:, 0]) <= f.half_width_m) & (z >= f.near_m) & (z <= f.far_m) & (np.abs(c[:, 1]) < 0.9 * radius_m)
    usable = np.flatnonzero(seen)
    maps = []
    for x, z_S in f.points:
        a, b = np.array([x, z_S]) - origin
        affine = rotation[:, [0, 2]] @ np.array([[a, 0.0, b], [0.0, b, a]])
        maps.append(np.hstack([-skew(rotation @ np.array([x, 0.0, z_S])), np.eye(3), np.zeros((3, 3)), affine]))
    known = information(poses).sum(axis=0) + np.diag([0.0] * 9 + [1.0 / s.affine**2] * 3)
    return _greedy(known, information(candidates[usable]), usable, np.array(maps), count)


def _greedy(known: Floats, gains: Floats, names: NDArray[np.intp], maps: Floats, count: int) -> PosePlan:
    """Return the best candidate at each step, by the mean trace of the mapped covariance of the sum."""
    if len(names) < count:
        raise InputError(
            f"Of the candidate poses {len(names)} see the object in the field, fewer than the {count} asked for: give"
            " more."
        )
    unit = np.sqrt(np.diag(known + gains.sum(axis=0)))
    chosen, values = most_informative(known, gains, count, lambda H: -_rms(H, maps, unit))
    return PosePlan(tuple(names[chosen].tolist()), np.array([float(_rms(known, maps, unit)), *np.negative(values)]))


def _rms(H: Floats, maps: Floats, unit: Floats) -> Floats:
    """Root mean trace (...) of the mapped covariances of informations (..., m, m)."""
    scaled = H / np.outer(unit, unit)
    covariance = np.linalg.inv(scaled + FLOOR * np.eye(len(unit))) / np.outer(unit, unit)
    return np.asarray(np.sqrt(np.einsum("fij,...jk,fik->...", maps, covariance, maps) / len(maps)))


def sample_edge_poses(
    state: EdgeState, count: int, seed: int, field: Field | None = None, tilt_deg: float = 35.0
) -> FlangePoses:
    """Draw flange poses from which the edge crosses the field of view.

    They are tilted and turned at random about looking down on it.
    """
    f, rng = field or Field(), np.random.default_rng(seed)
    down = np.array([0.0, 0.0, -1.0])
    x = np.cross(state.direction, down)
    x /= np.linalg.norm(x)
    base = np.column_stack([x, np.cross(down, x), down])
    turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, (count, 3)) * [60.0, tilt_deg, tilt_deg], degrees=True)
    R = base @ turn.as_matrix() @ state.rotation.T
    at = state.point + rng.uniform(-0.06, 0.06, (count, 1)) * state.direction
    return FlangePoses(R, at - _seen_at(R, state.rotation, state.translation, f, rng))


def sample_sphere_poses(
    rotation: Floats,
    translation: Floats,
    center: Floats,
    radius_m: float,
    count: int,
    seed: int,
    field: Field | None = None,
    tilt_deg: float = 25.0,
) -> FlangePoses:
    """Flange poses from which the scan plane cuts the sphere in the field of view, tilted and turned at random."""
    f, rng = field or Field(), np.random.default_rng(seed)
    base = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, (count, 3)) * [40.0, tilt_deg, tilt_deg], degrees=True)
    R = base @ turn.as_matrix() @ rotation.T
    beside = rng.uniform(-0.7, 0.7, count) * radius_m
    return FlangePoses(R, center - _seen_at(R, rotation, translation, f, rng, beside, radius_m))


def _seen_at(
    R_BF: Floats,
    rotation: Floats,
    translation: Floats,
    f: Field,
    rng: np.random.Generator,
    y: Floats | float = 0.0,
    deeper: float = 0.0,
) -> Floats:
    """Vectors (n, 3) in B from the flange to a random place of the field in the scanner."""
    n = len(R_BF)
    p_S = np.column_stack(
        [rng.uniform(-0.9, 0.9, n) * f.half_width_m, np.broadcast_to(y, n), rng.uniform(f.near_m, f.far_m, n) + deeper]
    )
    return np.asarray(np.einsum("nij,nj->ni", R_BF, p_S @ rotation.T + translation))
